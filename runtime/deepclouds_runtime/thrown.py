"""Light that the cloud throws on matt surfaces, smoothed between pixels: it varies slowly, but one ray a sample finds it noisily."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepclouds.backend import lanes_of, vectors_of
from deepclouds_runtime.result import Image

# Pixels that are averaged lie so many apart at most, and on the surface no further than this share of the distance to the cloud's box, or,
# near it or inside, of a mean free path.
_REACH, _NEAR = 3, 0.15
# Their normals agree so well, and they lie so flat: height above the other's plane over the distance.
_ALIKE, _FLAT = 0.9, 0.2


class ThrownLight:
    """Samples of the light of every pixel, and of what of it a surface would send back if it were lit evenly.

    The irradiance of a pixel is the ratio of both; that of its neighbours on the same surface is averaged with it. What the surface makes
    of it, texture and the cloud before it included, stays the pixel's own.

    Parameters
    ----------
    types
        Dr.Jit types.
    size
        (width, height) of the image, pixels.
    bounds
        lower and upper corner (3,) of the cloud's box, world.
    unit
        about the mean free path in the cloud, world units.
    """

    def __init__(
        self, types: ModuleType, size: tuple[int, int], bounds: tuple[NDArray[np.float64], NDArray[np.float64]], unit: float = 0.0
    ) -> None:
        self._types, self._size, self._bounds, self._unit = types, size, bounds, unit
        pixels = size[0] * size[1]
        self._light, self._share = np.zeros((pixels, 3), np.float32), np.zeros((pixels, 3), np.float32)
        self._place, self._normal, self._count = np.zeros((pixels, 3)), np.zeros((pixels, 3)), np.zeros(pixels)
        # What is asked for again and again, between two rounds of samples.
        self._smoothed: Image | None = None

    def add(
        self, pixels: NDArray[np.uint32], samples: int, light: list[Any], share: list[Any], place: Any, normal: Any, counted: Any
    ) -> None:
        """Add `samples` samples, one after the other, of each of the `pixels`.

        Parameters
        ----------
        light, share
            one Float a channel: radiance that the surface sends, and the share of even light that it would send.
        place, normal
            Array3f: where on the surface, world.
        counted
            Bool: which samples are on a matt surface; the others add nothing.
        """
        dr.eval(light, share, place, normal, counted)
        self._smoothed = None

        def total(value: Any) -> NDArray[np.float32]:
            return np.array(dr.block_sum(dr.select(counted, value, 0), samples))

        for c in range(3):
            # A monochrome variant has one channel for all.
            self._light[pixels, c] += total(light[min(c, len(light) - 1)])
            self._share[pixels, c] += total(share[min(c, len(share) - 1)])
            self._place[pixels, c] += total(place[c])
            self._normal[pixels, c] += total(normal[c])
        self._count[pixels] += total(self._types.Float(1))

    def smoothed(self) -> Image:
        """Sum of the samples of each pixel (pixels, 3), smoothed: not to be written to."""
        if self._smoothed is None:
            self._smoothed = self._averages()
        return self._smoothed

    def _averages(self) -> Image:
        types, (width, height) = self._types, self._size
        if not self._count.any():
            return self._light
        mean = self._place / np.maximum(self._count, 1)[:, None]
        light, share = ([lanes_of(types.Float, a[:, c]) for c in range(3)] for a in (self._light, self._share))
        place, normal = (vectors_of(types, a) for a in (mean, self._normal))
        lower, upper = (types.Array3f(*(dr.opaque(types.Float, float(v)) for v in corner)) for corner in self._bounds)
        matt = types.Bool(self._count > 0)
        columns, rows = dr.opaque(types.UInt32, width), dr.opaque(types.UInt32, height)
        normal /= dr.maximum(dr.norm(normal), 1e-20)
        unit = dr.opaque(types.Float, self._unit)
        found = _averaged(types, columns, rows, light, share, place, normal, matt, lower, upper, unit)
        result: Image = np.stack([np.array(v) for v in found], axis=1)
        return result


@dr.syntax
def _averaged(
    types: Any, width: Any, height: Any, light: Any, share: Any, place: Any, normal: Any, matt: Any, lower: Any, upper: Any, unit: Any
) -> list[Any]:
    Float, UInt32, Int32, Array3f = types.Float, types.UInt32, types.Int32, types.Array3f
    n = dr.width(light[0])
    pixel = dr.arange(UInt32, n)
    x, y = Int32(pixel % width), Int32(pixel // width)
    outside = dr.maximum(dr.maximum(lower - place, place - upper), 0)
    near = _NEAR * dr.maximum(dr.norm(outside), unit)
    sums = [dr.zeros(Float, n) for _ in range(6)]
    side = 2 * _REACH + 1
    tap = dr.zeros(Int32, n)
    while tap < side * side:
        column, row = x + tap % side - _REACH, y + tap // side - _REACH
        held = matt & (column >= 0) & (column < Int32(width)) & (row >= 0) & (row < Int32(height))
        other = UInt32(row) * width + UInt32(column)
        held &= dr.gather(types.Bool, matt, other, held)
        away = dr.gather(Array3f, place, other, held) - place
        distance = dr.norm(away)
        flat = dr.abs(dr.dot(away, normal)) <= _FLAT * distance
        held &= (distance <= near) & flat & (dr.dot(dr.gather(Array3f, normal, other, held), normal) > _ALIKE) | (other == pixel)
        for c in range(3):
            sums[c] += dr.gather(Float, light[c], other, held)
            sums[3 + c] += dr.gather(Float, share[c], other, held)
        tap += 1
    return [dr.select(matt & (sums[3 + c] > 0), share[c] * sums[c] / dr.maximum(sums[3 + c], 1e-30), light[c]) for c in range(3)]
