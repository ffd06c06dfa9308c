"""Renders clouds with a trained network: in Python, on the command line, and as the Mitsuba integrator ``deepclouds``.

Importing it is cheap: Mitsuba and onnxruntime are imported by what needs them. The integrator is registered with every Mitsuba variant
that is set before or after.
"""

from __future__ import annotations

from deepclouds_runtime._registration import install
from deepclouds_runtime.prediction import predict

# Bound here once, for good: a later import of the module of the same name does not put the module in the function's place.
from deepclouds_runtime.render import render

__all__ = ["predict", "render"]

install()
