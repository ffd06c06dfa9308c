"""The stencil in plain NumPy: the readable twin of the Dr.Jit kernel."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepclouds.descriptor._descriptor import PARALLEL_SINE
from deepclouds.descriptor._layout import FIRST_SPACING, LEVELS, POINTS, offsets
from deepclouds.volume import Volume
from deepclouds.volume.pyramid import filtered_levels, mean_extinction, volume_frame


def light_frame(w: NDArray[np.float64], omega_sun: NDArray[np.float64], azimuth: float = 0.0) -> NDArray[np.float64]:
    """Rows are the stencil's x, y and z axes in the world: z toward the light, x across the plane of light and view.

    Where the two are parallel any x perpendicular to the light will do; `azimuth` (radians) chooses it.
    """
    across = np.cross(omega_sun, w)
    sine = float(np.linalg.norm(across))
    if sine > PARALLEL_SINE:
        x_axis = across / sine
    else:
        sign = -1.0 if omega_sun[2] < 0 else 1.0
        a = -1.0 / (sign + omega_sun[2])
        b = omega_sun[0] * omega_sun[1] * a
        s = np.array([1 + sign * omega_sun[0] ** 2 * a, sign * b, -sign * omega_sun[0]])
        t = np.array([b, sign + omega_sun[1] ** 2 * a, -omega_sun[1]])
        x_axis = s * np.cos(azimuth) + t * np.sin(azimuth)
    return np.stack([x_axis, np.cross(omega_sun, x_axis), omega_sun])


def stencils(
    volume: Volume,
    scale: float,
    points: ArrayLike,
    w: ArrayLike,
    omega_sun: ArrayLike,
    unit: float | None = None,
    origin: ArrayLike | None = None,
) -> NDArray[np.float64]:
    """Stencils (n, 10, 225) of `sigma_t * unit`; arguments as for `deepclouds.descriptor.Descriptor`, points and directions (n, 3)."""
    points, w, omega_sun = (np.asarray(a, np.float64) for a in (points, w, omega_sun))
    unit = 1.0 / (scale * mean_extinction(volume)) if unit is None else unit
    frame = volume_frame(volume, None if origin is None else np.asarray(origin, np.float64))
    spacings = [FIRST_SPACING * 2.0**k * unit for k in range(LEVELS)]
    raw = sum(s <= volume.voxel_size.min() for s in spacings)
    filtered = filtered_levels(volume, frame, spacings[raw:])
    result = np.zeros((len(points), LEVELS, POINTS))
    for i, point in enumerate(points):
        axes = light_frame(w[i], omega_sun[i])
        for k, spacing in enumerate(spacings):
            places = point + spacing * offsets() @ axes
            if k < raw:
                result[i, k] = volume.sample(places) * scale * unit
                continue
            level = filtered[k - raw]
            # A volume of the cells with a rim of zeros, in cell coordinates, reads like any other.
            cells = np.pad(level.dense(), 1)
            lower = level.first - 1
            upper = lower + np.array(cells.shape[::-1])
            local = (places - frame.origin) @ frame.axes / spacing
            result[i, k] = Volume.from_box(cells, lower, upper).sample(local) * scale * unit
    return result
