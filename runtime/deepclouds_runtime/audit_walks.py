"""Walks from points of the cloud that are drawn as the image shows them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from deepclouds.backend import lanes_of, rows
from deepclouds.medium.multiple_scattering import trace_walks
from deepclouds.medium.one_sun import trace_one_sun
from deepclouds_runtime import stratified
from deepclouds_runtime.correction import FLOOR
from deepclouds_runtime.frame_source import FrameSource, seen_by, upload
from deepclouds_runtime.lights import on_host
from deepclouds_runtime.octree import Array
from deepclouds_runtime.stratified import Stratified
from deepclouds_runtime.transport import Cloud, Lights

Rays = Callable[[Any, Stratified], tuple[Any, Any, Any]]
# Directions of light from all around that a walk is connected to.
_BEAMS = 4
# Collisions of a ray that walks may start from, walks for each ray, and the fewest rays.
_DEPTHS, _WALKS_A_RAY, _LEAST_RAYS = 4, 4, 1 << 13
# Walks that are in memory together.
_AT_ONCE = 1 << 18


@dataclass(frozen=True)
class Batch:
    """Walks from n points.

    Attributes
    ----------
    points
        (n, 3) world points.
    pixels
        (n,) numbers of the pixels that see them.
    weights
        (n,) what each counts: their mean times J is that of the image's multiple scattering.
    predicted, walked
        (n, channels) J as the image has it, and of one walk each.
    """

    points: Array
    pixels: Array
    weights: Array
    predicted: Array
    walked: Array


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
    size
        (width, height) of the image, pixels.
    seed
        of all random numbers.
    """

    def __init__(self, cloud: Cloud, lights: Lights, sources: Sequence[FrameSource], rays: Rays, size: tuple[int, int], seed: int) -> None:
        self._cloud, self._lights, self._sources, self._rays, self._size = cloud, lights, sources, rays, size
        self._seed = np.random.SeedSequence([seed & 0xFFFFFFFF, 0xA0D17])

    def batches(self, walks: int) -> Iterator[Batch]:
        """Trace `walks` walks; batches share no random number. None where the camera sees no cloud."""
        while walks > 0:
            batch = self._batch(min(walks, _AT_ONCE))
            walks -= _AT_ONCE
            if batch is not None:
                yield batch

    def _batch(self, walks: int) -> Batch | None:
        types = self._cloud.field.types
        (own,) = self._seed.spawn(1)
        random = np.random.default_rng(own)
        key = int(random.integers(1 << 32))
        width, height = self._size
        rays = max(walks // _WALKS_A_RAY, _LEAST_RAYS)
        chosen = ((np.arange(rays) + random.random(rays)) * (width * height / rays)).astype(np.int64)
        chosen = np.minimum(chosen, width * height - 1)
        pixel = lanes_of(types.UInt32, chosen)
        one = dr.opaque(types.UInt32, 1)
        numbers = Stratified(types, pixel, dr.arange(types.UInt32, rays), one, dr.opaque(types.UInt32, key)).unrelated()
        origin, direction, end = self._rays(pixel, numbers)
        seen = seen_by(self._cloud.field, origin, direction, end, numbers.number(stratified.SHARE), _DEPTHS)
        if not len(seen.points):
            return None
        along = np.broadcast_to(rows(direction), (rays, 3))
        predicted = predicted_at(self._sources, seen.points)
        share = seen.weights / rays
        # Walks are noisier where J is larger; some must be left for where the network sees nothing.
        level = predicted.mean(axis=1)
        wanted = share * (level + max(FLOOR * float(np.average(level, weights=share)), 1e-30))
        total = np.cumsum(wanted)
        place = (np.arange(walks) + random.random()) / walks * total[-1]
        drawn = np.minimum(np.searchsorted(total, place), len(total) - 1)
        weights = share[drawn] * (total[-1] / wanted[drawn])
        points, of_ray = seen.points[drawn], seen.rays[drawn]
        walked = self.walked(points, along[of_ray], key, random)
        return Batch(points, chosen[of_ray], weights, predicted[drawn], walked)

    def walked(self, points: Array, along: Array, key: int, random: np.random.Generator) -> Array:
        """J (n, channels) of one walk a point, under every sun and a few directions of each other light."""
        cloud, n = self._cloud, len(points)
        toward, arriving = self._arriving(points, key, random)
        albedos = tuple(sorted({a for a in cloud.albedo if a > 0}))
        result = np.zeros((n, len(cloud.albedo)))
        if not toward or not albedos:
            return result
        phase = np.broadcast_to(np.array(cloud.phase, np.float32), (n, 3))
        many = np.broadcast_to(np.array(albedos, np.float32), (n, len(albedos)))
        start, ahead = points.astype(np.float32), along.astype(np.float32)
        if len(toward) == 1:
            j = trace_one_sun(cloud.field, start, ahead, phase, toward[0], many, 1, key, roulette=True)
        else:
            j = trace_walks(cloud.field, start, ahead, phase, np.stack(toward, axis=1), many, 1, key, roulette=True)[:, 0]
        j = j.reshape(n, len(toward), len(albedos))
        for k, irradiance in enumerate(arriving):
            for c, a in enumerate(cloud.albedo):
                if a > 0:
                    result[:, c] += irradiance[:, c] * (a * a / (4 * math.pi)) * j[:, k, albedos.index(a)]
        return result

    def _arriving(self, points: Array, key: int, random: np.random.Generator) -> tuple[list[Array], list[Array]]:
        """Directions (n, 3) TOWARD the lights of a walk, and the irradiance (n, channels) from each over its density."""
        types, n = self._cloud.field.types, len(points)
        x = upload(types, points)
        toward, arriving = [], []
        for sun in self._lights.suns:
            if max(sun.irradiance) <= 0:
                continue
            omega = types.Array3f(*(dr.opaque(types.Float, float(v)) for v in sun.omega_sun))
            visible = np.broadcast_to(np.array(self._lights.shade.visible(x, omega)), n)
            toward.append(np.broadcast_to(np.array(sun.omega_sun, np.float32), (n, 3)))
            arriving.append(visible[:, None] * np.array(sun.irradiance, np.float64))
        for source, _ in self._lights.sources:
            start = random.random((2, n))
            for k in range(_BEAMS):
                # Roberts' sequence, shifted at random: the directions of one walk lie apart.
                u, v = ((start[a] + k * step) % 1 for a, step in enumerate((0.7548776662466927, 0.5698402909980532)))
                omega, density = source.sample(*(lanes_of(types.Float, np.minimum(t, 1 - 1e-7)) for t in (u, v)))
                lanes, one = dr.arange(types.UInt32, n), dr.opaque(types.UInt32, 1)
                numbers = Stratified(types, lanes, dr.full(types.UInt32, k, n), one, dr.opaque(types.UInt32, key)).unrelated()
                light = source.arriving(x, omega, numbers)
                dr.eval(light, omega, density)
                likely: Array = np.maximum(np.broadcast_to(np.array(density, np.float64), n), 1e-30)
                toward.append(np.broadcast_to(rows(omega), (n, 3)))
                arriving.append(on_host(light, n) / (_BEAMS * likely[:, None]))
        return toward, arriving


def predicted_at(sources: Sequence[FrameSource], points: Array) -> Array:
    """J (n, channels) of all sources at world points (n, 3)."""
    types = sources[0].octree.types
    x = upload(types, points)
    totals: list[Any] | None = None
    for source in sources:
        values = source.colours(source.octree.lookup(source.octree.to_local(x), types.Bool(True)))
        totals = values if totals is None else [a + b for a, b in zip(totals, values, strict=True)]
    assert totals is not None
    return on_host(totals, len(points))
