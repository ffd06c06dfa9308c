"""The stencil's shape: what the generator, the network and every renderer agree on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LEVELS = 10
POINTS = 225
# Spacing of the finest level, in units of length; each level doubles it.
FIRST_SPACING = 0.5


def offsets() -> NDArray[np.float64]:
    """Place of the 225 points in spacings, (225, 3), x fastest: x and y in -2..2, z, toward the light, in -2..6."""
    z, y, x = np.meshgrid(np.arange(-2, 7), np.arange(-2, 3), np.arange(-2, 3), indexing="ij")
    return np.stack([x, y, z], axis=-1).reshape(POINTS, 3).astype(np.float64)
