"""The light-aligned frame and the ten-level stencil that describes the cloud around a point."""

from deepclouds.descriptor._descriptor import Descriptor, default_unit
from deepclouds.descriptor._layout import FIRST_SPACING, LEVELS, POINTS, offsets

__all__ = ["FIRST_SPACING", "LEVELS", "POINTS", "Descriptor", "default_unit", "offsets"]
