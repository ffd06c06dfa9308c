"""Rays through the cells of a field, one after the other: between two planes of samples a trilinear field is a cubic along a ray.

Amanatides and Woo, "A Fast Voxel Traversal Algorithm for Ray Tracing", Eurographics 1987, with planes counted in place of distances summed
up, so that no rounding can hold a lane back. Runs of empty bricks are crossed at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr

from deepclouds.medium.field import Field
from deepclouds.medium.grid import corners, mixed

# Gauss's two points of a segment, which integrate a cubic exactly, from its middle, in its lengths; and four points that tell a cubic.
_GAUSS = (-0.28867513459481287, 0.28867513459481287)
_THIRDS = (-1 / 2, -1 / 6, 1 / 6, 1 / 2)
# Steps of Newton's method, kept inside of a shrinking bracket, that place a collision in its cell.
_NEWTON = 8
_FAR = 3.0e38


class Cells:
    """The cells that segments of rays cross inside of the box.

    Parameters
    ----------
    field
        the extinction.
    origin, direction
        world points and unit vectors.
    start, end
        distances, world units; clipped to the box.

    Attributes
    ----------
    base, along
        the rays in the unit cube's coordinates.
    first, last
        where the segments begin and end, world units; they are empty unless `first` < `last`.
    """

    def __init__(self, field: Field, origin: Any, direction: Any, start: Any, end: Any) -> None:
        types = field.types
        enter, leave = field.intersect(origin, direction)
        self._field = field
        self.first, self.last = dr.maximum(enter, start), dr.minimum(leave, end)
        self.base, self.along = field.to_unit(origin), field.direction_to_unit(direction)
        # In samples: number k lies at k.
        samples = types.Array3f(*field.samples)
        self._base, self._along = dr.fma(self.base, samples, -0.5), self.along * samples
        still = dr.abs(self.along) < 1e-12
        self._forward = self.along >= 0
        self._sign = dr.select(self._forward, types.Array3f(1), types.Array3f(-1))
        self._rate = dr.select(still, 0, dr.rcp(dr.select(still, types.Array3f(1), self._along)))
        self._offset = dr.select(still, _FAR, -self._base * self._rate)

    def planes(self, distance: Any) -> Any:
        """Array3f: number of the plane of samples across each axis that rays come to next from `distance` on."""
        at = dr.fma(self._along, distance, self._base)
        return dr.select(self._forward, dr.floor(at) + 1, dr.ceil(at) - 1)

    @dr.syntax
    def step(self, distance: Any, planes: Any, active: Any) -> tuple[Any, Any, Any]:
        """Where the cell ends that rays are in at `distance`, `planes` being what comes next, or the empty bricks that they are in.

        Returns that distance, the planes that come next from there on, and whether all in between is empty.
        """
        times = dr.fma(planes, self._rate, self._offset)
        nearest = dr.minimum(dr.minimum(times.x, times.y), times.z)
        # In every step a plane is passed or the end reached.
        planes = dr.select(times <= nearest, planes + self._sign, planes)
        after = dr.maximum(dr.minimum(nearest, self.last), distance)
        empty = self._field.types.Bool(False)
        if dr.hint(self._field.majorants.any_empty, mode="scalar"):
            at = dr.fma(self.along, distance, self.base)
            empty, radius = self._field.majorants.empty(at, active)
            if empty:
                beyond = self._field.majorants.end(at, radius, self.base, self.along)
                after = dr.minimum(dr.maximum(beyond, after), self.last)
                there = self.planes(after)
                planes = dr.select(self._forward, dr.maximum(there, planes), dr.minimum(there, planes))
        return after, planes, empty

    def values(self, near: Any, after: Any, active: Any) -> tuple[Any, Any]:
        """Extinction at Gauss's two points of segments that lie in one cell: half their sum is the mean. 0 for inactive lanes."""
        first, second = self._at(near, after, _GAUSS, active)
        return first, second

    def _at(self, near: Any, after: Any, places: Sequence[float], active: Any) -> list[Any]:
        """Extinction at places of segments that lie in one cell, whose samples are read once; places are counted from the middle."""
        types, width = self._field.types, after - near
        at = dr.fma(self._along, dr.fma(0.5, width, near), self._base)
        low = [dr.clip(dr.floor(v), 0, last) for v, last in zip(at, self._field.last, strict=True)]
        around = corners(self._field.grid, [types.UInt32(v) for v in low], active)
        # Beyond the outermost samples the field goes on as there.
        return [
            mixed(around, [dr.clip(dr.fma(a, place * width, v - v0), 0, 1) for a, v, v0 in zip(self._along, at, low, strict=True)])
            for place in places
        ]

    def within(self, near: Any, after: Any, depth: Any, active: Any) -> Any:
        """Distances at which the optical depth from `near` reaches `depth`, in segments that lie in one cell; no farther than `after`."""
        width = after - near
        s = [v * width for v in self._at(near, after, _THIRDS, active)]
        # Extinction times width is c0 + c1 x + c2 x^2 + c3 x^3, x from 0 to 1.
        c0 = s[0]
        c1 = -5.5 * s[0] + 9 * s[1] - 4.5 * s[2] + s[3]
        c2 = 9 * s[0] - 22.5 * s[1] + 18 * s[2] - 4.5 * s[3]
        c3 = 4.5 * (s[3] - s[0]) + 13.5 * (s[1] - s[2])
        mean = 0.125 * (s[0] + s[3]) + 0.375 * (s[1] + s[2])
        x = dr.clip(depth / dr.maximum(mean, 1e-30), 0, 1)
        low, high = dr.zeros(type(x), dr.width(x)), dr.full(type(x), 1, dr.width(x))
        for _ in range(_NEWTON):
            reached = x * (c0 + x * (c1 * 0.5 + x * (c2 * (1 / 3) + x * (c3 * 0.25))))
            slope = c0 + x * (c1 + x * (c2 + x * c3))
            short = reached < depth
            low, high = dr.select(short, x, low), dr.select(short, high, x)
            better = x + (depth - reached) / dr.maximum(slope, 1e-30)
            x = dr.select((better >= low) & (better <= high), better, 0.5 * (low + high))
        x = dr.select(depth >= mean, 1, x)
        return dr.fma(x, width, near)


def linear_place(first: Any, second: Any, depth: Any) -> Any:
    """Where in a segment, 0 to 1, the optical depth `depth` is reached, if extinction is the straight line through Gauss's two points.

    `first` and `second` are the values there times the segment's length; the optical depth of the whole is that of the cubic.
    """
    rise = (second - first) * (1 / (_GAUSS[1] - _GAUSS[0]))
    at_start = first - (0.5 + _GAUSS[0]) * rise
    root = dr.sqrt(dr.maximum(dr.fma(at_start, at_start, 2 * rise * depth), 0))
    return dr.clip(2 * depth / dr.maximum(at_start + root, 1e-30), 0, 1)
