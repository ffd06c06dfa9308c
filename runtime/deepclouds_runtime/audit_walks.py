"""Walks from points of the cloud that are drawn as the image shows them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import drjit as dr
import numpy as np

from deepclouds.backend import lanes_of, rows, vectors_of
from deepclouds_runtime import stratified
from deepclouds_runtime.camera import Window
from deepclouds_runtime.correction import FLOOR, GROUPS
from deepclouds_runtime.frame_source import FrameSource, Seen, seen_by
from deepclouds_runtime.light_walks import LightWalks
from deepclouds_runtime.lights import on_host
from deepclouds_runtime.octree import Array
from deepclouds_runtime.stratified import Stratified
from deepclouds_runtime.transport import Cloud, Lights

Rays = Callable[[Any, Stratified], tuple[Any, Any, Any]]
# Collisions of a ray that walks may start from, walks for each ray, and the fewest and the most rays.
_DEPTHS, _WALKS_A_RAY, _LEAST_RAYS, _MOST_RAYS = 4, 8, 1 << 13, 1 << 19
# Share of the rays that should meet the cloud; where fewer do, there are more of them.
_MET = 0.2
# Most walks that are set off together.
AT_ONCE = 1 << 18


@dataclass(frozen=True)
class Batch:
    """Walks from n points, in groups that share nothing: no ray, no random number.

    Attributes
    ----------
    points
        (n, 3) world points.
    pixels
        (n,) numbers of the pixels that see them.
    groups
        (n,) numbers of the groups that they belong to.
    weights
        (n,) what each counts: the mean of weight times J, over any group, is the image's multiple scattering.
    predicted, walked
        (n, channels) J as the image has it, and of one walk each.
    """

    points: Array
    pixels: Array
    groups: Array
    weights: Array
    predicted: Array
    walked: Array

    @classmethod
    def joined(cls, batches: Sequence[Batch]) -> Batch:
        """Several, one after the other."""
        return cls(*(np.concatenate([getattr(batch, of.name) for batch in batches]) for of in fields(cls)))


@dataclass(frozen=True)
class Looked:
    """What rays saw of the cloud, which walks may begin at.

    Attributes
    ----------
    seen
        collisions of the rays; their weights are shares of what the image shows, in one group.
    along, pixels
        directions (r, 3) of the rays, and the numbers (r,) of their pixels.
    predicted
        J (n, channels) at the collisions as the image has it.
    random
        random numbers that nobody has used.
    """

    seen: Seen
    along: Array
    pixels: Array
    predicted: Array
    random: np.random.Generator


@dataclass(frozen=True)
class Drawn:
    """Where walks will begin: a `Batch` without what they find, and the directions (n, 3) in which the camera sees their points."""

    points: Array
    along: Array
    pixels: Array
    groups: Array
    weights: Array
    predicted: Array
    random: np.random.Generator


class Walks:
    """Draws the walks of one frame.

    Parameters
    ----------
    cloud, lights
        the medium and all that lights it.
    sources
        J as the image has it.
    rays
        pixels and random numbers -> origin, direction and end of camera rays.
    window
        outside of which the image shows nothing of the cloud.
    met
        about what share of the rays through the window meet the cloud.
    seed
        of all random numbers.
    """

    def __init__(
        self, cloud: Cloud, lights: Lights, sources: Sequence[FrameSource], rays: Rays, window: Window, met: float, seed: int
    ) -> None:
        self._cloud, self._lights, self._sources, self._rays, self._window = cloud, lights, sources, rays, window
        self._more = max(_MET / max(met, 1e-9), 1.0)
        self._seed = np.random.SeedSequence([seed & 0xFFFFFFFF, 0xA0D17])
        #: J (n, channels) of one walk a point, see `LightWalks`.
        self.walked = LightWalks(cloud, lights)

    def look(self, walks: int) -> Looked | None:
        """Look for where about `walks` walks, `AT_ONCE` at most, may begin; no two calls share a random number.

        None where the camera sees no cloud.
        """
        types = self._cloud.field.types
        (own,) = self._seed.spawn(1)
        random = np.random.default_rng(own)
        key = int(random.integers(1 << 32))
        count = self._window.count
        rays = max(min(int(walks / _WALKS_A_RAY * self._more), _MOST_RAYS), _LEAST_RAYS) // GROUPS * GROUPS
        index = ((np.arange(rays) + random.random(rays)) * (count / rays)).astype(np.int64)
        pixels = self._window.pixels(np.minimum(index, count - 1))
        pixel = lanes_of(types.UInt32, pixels)
        one = dr.opaque(types.UInt32, 1)
        numbers = Stratified(types, pixel, dr.arange(types.UInt32, rays), one, dr.opaque(types.UInt32, key)).unrelated()
        origin, direction, end = self._rays(pixel, numbers)
        seen = seen_by(self._cloud.field, origin, direction, end, numbers.number(stratified.SHARE), _DEPTHS)
        if not len(seen.points):
            return None
        seen = replace(seen, weights=seen.weights * (self._window.share * GROUPS / rays))
        return Looked(seen, np.broadcast_to(rows(direction), (rays, 3)), pixels, predicted_at(self._sources, seen.points), random)

    @staticmethod
    def drawn(looked: Looked, walks: int) -> Drawn:
        """Where `walks` walks begin, an even share for each group; nothing waits for the device."""
        seen, share, random = looked.seen, looked.seen.weights, looked.random
        # Walks are noisier where J is larger; some must be left for where the network sees nothing.
        level = looked.predicted.mean(axis=1)
        wanted = share * (level + max(FLOOR * float(np.average(level, weights=share)), 1e-30))
        each = max(walks // GROUPS, 1)
        drawn, weights, groups = [], [], []
        # Each group has one of every so many rays to itself, by chance: rays are spread evenly, and every so-many-th could meet the same
        # columns of the image each time.
        of_ray = np.argsort(random.random((len(looked.pixels) // GROUPS, GROUPS)), axis=1).ravel()
        group_of = of_ray[seen.rays]
        for group in range(GROUPS):
            own_points = np.flatnonzero(group_of == group)
            if not len(own_points):
                continue
            total = np.cumsum(wanted[own_points])
            place = (np.arange(each) + random.random()) / each * total[-1]
            chosen_points = own_points[np.minimum(np.searchsorted(total, place), len(total) - 1)]
            drawn.append(chosen_points)
            weights.append(share[chosen_points] * (total[-1] / wanted[chosen_points]))
            groups.append(np.full(each, group))
        which = np.concatenate(drawn)
        rays = seen.rays[which]
        points, toward, pixels = seen.points.take(which, 0), looked.along.take(rays, 0), looked.pixels.take(rays)
        return Drawn(points, toward, pixels, np.concatenate(groups), np.concatenate(weights), looked.predicted.take(which, 0), random)

    def begin(self, drawn: Drawn) -> Callable[[], Batch]:
        """Set walks off; what it returns waits for them."""
        walked = self.walked.begin(drawn.points, drawn.along, drawn.random)
        return lambda: Batch(drawn.points, drawn.pixels, drawn.groups, drawn.weights, drawn.predicted, walked())


def predicted_at(sources: Sequence[FrameSource], points: Array) -> Array:
    """J (n, channels) of all sources at world points (n, 3)."""
    types = sources[0].octree.types
    x = vectors_of(types, points)
    totals: list[Any] | None = None
    for source in sources:
        values = source.colours(source.octree.lookup(source.octree.to_local(x), types.Bool(True)))
        totals = values if totals is None else [a + b for a, b in zip(totals, values, strict=True)]
    assert totals is not None
    return on_host(totals, len(points))
