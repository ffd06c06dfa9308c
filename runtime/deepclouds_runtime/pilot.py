"""Rays that look for what a camera sees of a cloud before anything is predicted or rendered."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepclouds.backend import lanes_of
from deepclouds.medium.field import Field
from deepclouds_runtime import stratified
from deepclouds_runtime.camera import Window
from deepclouds_runtime.frame_source import Seen, seen_by
from deepclouds_runtime.stratified import Stratified

# Rays: at most, for a quick look, and where a pixel may have several; and collisions on each of them.
_MOST, _QUICK, _FEW, _DEPTHS = 1 << 16, 1 << 14, 1 << 14, 4
# A cloud is thin that hides less than this of what is behind it.
_THIN = 0.5


@dataclass(frozen=True)
class Pilot:
    """What pilot rays saw.

    Attributes
    ----------
    seen
        collisions.
    rays
        how many rays there were.
    columns, rows
        of the pixels that the rays are from: row by row all of them, once or more often.
    """

    seen: Seen
    rays: int
    columns: NDArray[np.int64]
    rows: NDArray[np.int64]

    @property
    def met(self) -> float:
        """Share of the rays that met the cloud."""
        return len(self.seen.points) / (_DEPTHS * self.rays)

    @property
    def thin(self) -> bool:
        """Whether the cloud hides little of what is behind it, where these rays met it."""
        return 0 < float(self.seen.weights.sum()) < _THIN * self.met * self.rays


def look(
    types: Any, field: Field, window: Window, rays: Callable[[Any, Stratified], tuple[Any, Any, Any]], seed: Any, quick: bool = False
) -> Pilot:
    """Look for a cloud in a window.

    Parameters
    ----------
    types, field
        Dr.Jit types, and the extinction.
    window
        outside of which the image shows nothing of the cloud.
    rays
        pixels and random numbers -> origin, direction and end of camera rays.
    seed
        UInt32, of the random numbers.
    quick
        by fewer rays.
    """
    pixel, numbers, columns, rows = spread_pixels(types, window, *((_QUICK, 0) if quick else (_MOST, _FEW)), seed)
    origin, direction, end = rays(pixel, numbers)
    seen = seen_by(field, origin, direction, end, numbers.number(stratified.SHARE), _DEPTHS)
    return Pilot(seen, dr.width(pixel), columns, rows)


def spread_pixels(
    types: Any, window: Window, most: int, few: int, seed: Any
) -> tuple[Any, Stratified, NDArray[np.int64], NDArray[np.int64]]:
    """Pixels spread over a window, each as often as makes `few` if it can be, and no more than `most`; random numbers for them.

    And the columns and rows that they are from.
    """
    stride = math.ceil(math.sqrt(window.count / most))
    columns, rows = np.arange(0, window.width, stride) + window.left, np.arange(0, window.height, stride) + window.top
    once = (rows[:, None] * window.size[0] + columns).ravel()
    each = max(few // len(once), 1)
    pixel = lanes_of(types.UInt32, np.tile(once, each))
    sample = lanes_of(types.UInt32, np.repeat(np.arange(each), len(once)))
    return pixel, Stratified(types, pixel, sample, dr.opaque(types.UInt32, 1), seed).unrelated(), columns, rows
