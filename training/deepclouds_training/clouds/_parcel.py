"""What a buoyant parcel does to the extinction: it condenses water as it rises and mixes with dry air from its surface inward."""

from __future__ import annotations

import numpy as np

from deepclouds_training.clouds._noise import Array, smoothstep


def condensation(height: Array, foot: float) -> Array:
    """Extinction over its value at the top, `height` above the condensation level in units of the cloud's depth (clipped to 0 to 1).

    Liquid water grows in proportion to the height (the adiabatic fraction is taken as constant) while the number of droplets stays,
    so that their cross-section and with it the extinction grow as the power 2/3 (Brenguier et al. 2000). `foot` is the
    share that is there at the level itself: haze, and droplets that the updraught brings in; 1 means that nothing condenses.
    """
    return np.asarray(np.float32(foot) + np.float32(1 - foot) * np.cbrt(np.clip(height, 0, 1)) ** 2, np.float32)


def entrainment(depth: Array, shell: float, surface: float = 0.45) -> Array:
    """Share of the extinction that mixing with dry air leaves: `surface` at depth 0 below the cloud's surface, 1 from `shell` on."""
    return np.asarray(np.float32(surface) + np.float32(1 - surface) * smoothstep(0.0, shell, depth), np.float32)
