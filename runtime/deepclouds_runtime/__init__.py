"""Renders clouds with a trained network, in Python, on the command line and as a Mitsuba integrator."""

from __future__ import annotations

# Bound here once, for good: a later import of the module of the same name does not put the module in the function's place.
from deepclouds_runtime.render import render

__all__ = ["render"]
