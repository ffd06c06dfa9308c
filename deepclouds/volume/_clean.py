"""What a density file may not hold, and what clamping makes of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from deepclouds.errors import InputError


def clean(density: NDArray[np.float32], source: str, clamp: bool) -> NDArray[np.float32]:
    """Return `density` without negative values and NaN.

    Parameters
    ----------
    density
        float32 array of any shape.
    source
        the file (and grid) for the error message.
    clamp
        set negative values and NaN to 0 in a copy; otherwise they are errors.

    Raises
    ------
    InputError
        on +infinity, and on negative values or NaN unless `clamp`.
    """
    infinite = int(np.count_nonzero(np.isposinf(density)))
    if infinite:
        raise InputError(f"{source} holds {infinite} infinite values, which no clamping can repair")
    nan = int(np.count_nonzero(np.isnan(density)))
    negative = int(np.count_nonzero(density < 0))
    if not nan and not negative:
        return density
    if not clamp:
        found = " and ".join(f"{count} {what}" for count, what in ((negative, "negative values"), (nan, "NaN")) if count)
        raise InputError(f"{source} holds {found} among {density.size} voxels; clamp=True (--clamp) sets them to 0")
    return np.where(density > 0, density, np.float32(0))
