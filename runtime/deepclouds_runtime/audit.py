"""Measures how wrong the predicted multiple scattering of a frame is, with walks from points drawn as the image shows them.

Walks are noisy and unbiased. In two independent halves of them the noise is independent too: the product of what both find in a region of
the image is, on the mean, the square of the prediction's error there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepclouds.medium.multiple_scattering import trace_walks
from deepclouds.medium.one_sun import trace_one_sun
from deepclouds_runtime import stratified
from deepclouds_runtime.correction import FLOOR, Correction, Walks
from deepclouds_runtime.frame_source import FrameSource, seen_by, upload
from deepclouds_runtime.lights import on_host
from deepclouds_runtime.stratified import Stratified
from deepclouds_runtime.transport import Cloud, Lights

Array = NDArray[Any]
# Regions along the longer side of an image.
_REGIONS = 24
# Regions darker than this share of the brightest ones do not count.
_DARK = 0.02
# Directions of light from all around that a walk is connected to.
_BEAMS = 4
# Collisions of a ray that walks may start from, and the fewest rays that look for them.
_DEPTHS, _LEAST_RAYS = 4, 1 << 13
# Walks of the first round; a round has two batches for each half, and every further round as many walks as all before.
_FIRST = 1 << 16
# Walks by default: so many a pixel, within these limits.
WALKS_A_PIXEL, FEWEST, MOST = 4, 1 << 18, 1 << 22
# Standard deviations of an interval of 95 %.
_INTERVAL = 1.96


@dataclass(frozen=True)
class RegionError:
    """Error of the predicted multiple scattering, over its mean in the image.

    Attributes
    ----------
    energy, energy_deviation
        of the whole image, positive where the prediction is too bright, and the standard deviation of this estimate.
    squared, squared_deviation
        mean of the squared error of the regions, without the noise of the walks; below 0 where chance has it so.
    """

    energy: float
    energy_deviation: float
    squared: float
    squared_deviation: float

    def summary(self) -> dict[str, Any]:
        """For a report: root of the mean square and energy, each with its 95 % interval."""
        reach = _INTERVAL * self.squared_deviation
        root = [math.sqrt(max(v, 0.0)) for v in (self.squared, self.squared - reach, self.squared + reach)]
        ends = [self.energy - _INTERVAL * self.energy_deviation, self.energy + _INTERVAL * self.energy_deviation]
        return {
            "error": round(root[0], 5),
            "error_interval": [round(v, 5) for v in root[1:]],
            "energy": round(self.energy, 5),
            "energy_interval": [round(v, 5) for v in ends],
        }


class Audit:
    """Walks of one frame.

    Parameters
    ----------
    cloud, lights
        the medium and all that lights it.
    sources
        what is audited.
    rays
        pixels and random numbers -> origin, direction and end of camera rays.
    size
        (width, height) of the image, pixels.
    seed
        of all random numbers.
    """

    def __init__(
        self,
        cloud: Cloud,
        lights: Lights,
        sources: Sequence[FrameSource],
        rays: Callable[[Any, Stratified], tuple[Any, Any, Any]],
        size: tuple[int, int],
        seed: int,
    ) -> None:
        self._cloud, self._lights, self._sources, self._rays, self._size = cloud, lights, sources, rays, size
        self._seed = np.random.SeedSequence([seed & 0xFFFFFFFF, 0xA0D17])
        self._parts: list[tuple[Array, ...]] = []
        self._batches = 0

    @property
    def count(self) -> int:
        """Walks so far."""
        return sum(len(part[0]) for part in self._parts)

    def extend(self, walks: int) -> None:
        """Trace `walks` more walks, in two batches for each half."""
        for _ in range(4):
            self._add(max(walks // 4, 1))

    def _add(self, walks: int) -> None:
        types = self._cloud.field.types
        (own,) = self._seed.spawn(1)
        random = np.random.default_rng(own)
        key = int(random.integers(1 << 32))
        width, height = self._size
        rays = max(walks // 2, _LEAST_RAYS)
        chosen = ((np.arange(rays) + random.random(rays)) * (width * height / rays)).astype(np.int64)
        chosen = np.minimum(chosen, width * height - 1)
        pixel = types.UInt32(chosen.astype(np.uint32))
        one = dr.opaque(types.UInt32, 1)
        numbers = Stratified(types, pixel, dr.arange(types.UInt32, rays), one, dr.opaque(types.UInt32, key)).unrelated()
        origin, direction, end = self._rays(pixel, numbers)
        seen = seen_by(self._cloud.field, origin, direction, end, numbers.number(stratified.SHARE), _DEPTHS)
        batch, self._batches = self._batches, self._batches + 1
        if not len(seen.points):
            return
        along = np.broadcast_to(np.array(direction).T, (rays, 3))[seen.rays]
        predicted = predicted_at(self._sources, seen.points)
        share = seen.weights / rays
        # Walks are noisier where J is larger; some must be left for where the network sees nothing.
        level = predicted.mean(axis=1)
        wanted = share * (level + max(FLOOR * float(np.average(level, weights=share)), 1e-30))
        total = np.cumsum(wanted)
        place = (np.arange(walks) + random.random()) / walks * total[-1]
        drawn = np.minimum(np.searchsorted(total, place), len(total) - 1)
        weights = share[drawn] / (wanted[drawn] / total[-1])
        walked = self._walked(seen.points[drawn], along[drawn], key, random)
        half = np.full(walks, batch % 2, np.int8)
        quarter = np.full(walks, batch // 2 % 2, np.int8)
        self._parts.append((seen.points[drawn], weights, predicted[drawn], walked, half, quarter, chosen[seen.rays[drawn]]))

    def _walked(self, points: Array, along: Array, key: int, random: np.random.Generator) -> Array:
        """J (n, channels) of one walk a point, under every sun and a few directions of each other light."""
        cloud, types, n = self._cloud, self._cloud.field.types, len(points)
        x = upload(types, points)
        toward, arriving = [], []
        for sun in self._lights.suns:
            omega = types.Array3f(*(dr.opaque(types.Float, float(v)) for v in sun.omega_sun))
            visible = np.broadcast_to(np.array(self._lights.shade.visible(x, omega)), n)
            toward.append(np.broadcast_to(np.array(sun.omega_sun, np.float32), (n, 3)))
            arriving.append(visible[:, None] * np.array(sun.irradiance, np.float64))
        for source, _ in self._lights.sources:
            start = random.random((2, n))
            for k in range(_BEAMS):
                # Roberts' sequence, shifted at random: the directions of one walk lie apart.
                u, v = ((start[a] + k * step) % 1 for a, step in enumerate((0.7548776662466927, 0.5698402909980532)))
                omega, density = source.sample(*(types.Float(np.minimum(t, 1 - 1e-7).astype(np.float32)) for t in (u, v)))
                lanes, one = dr.arange(types.UInt32, n), dr.opaque(types.UInt32, 1)
                numbers = Stratified(types, lanes, dr.full(types.UInt32, k, n), one, dr.opaque(types.UInt32, key)).unrelated()
                light = source.arriving(x, omega, numbers)
                dr.eval(light, omega, density)
                likely: Array = np.maximum(np.broadcast_to(np.array(density, np.float64), n), 1e-30)
                toward.append(np.broadcast_to(np.array(omega, np.float32).T, (n, 3)))
                arriving.append(on_host(light, n) / (_BEAMS * likely[:, None]))
        albedos = tuple(sorted({a for a in cloud.albedo if a > 0}))
        result = np.zeros((n, len(cloud.albedo)))
        if not toward or not albedos:
            return result
        phase = np.broadcast_to(np.array(cloud.phase, np.float32), (n, 3))
        many = np.broadcast_to(np.array(albedos, np.float32), (n, len(albedos)))
        start32, along32 = points.astype(np.float32), along.astype(np.float32)
        if len(toward) == 1:
            j = trace_one_sun(cloud.field, start32, along32, phase, toward[0], many, 1, key)
        else:
            j = trace_walks(cloud.field, start32, along32, phase, np.stack(toward, axis=1), many, 1, key)[:, 0]
        j = j.reshape(n, len(toward), len(albedos))
        for k, irradiance in enumerate(arriving):
            for c, a in enumerate(cloud.albedo):
                if a > 0:
                    result[:, c] += irradiance[:, c] * (a * a / (4 * math.pi)) * j[:, k, albedos.index(a)]
        return result

    def before(self) -> RegionError:
        """Error of what is audited."""
        return self._judged(self._all()[2])

    def of(self, sources: Sequence[FrameSource]) -> RegionError:
        """Error of other sources, which these walks have not corrected."""
        return self._judged(predicted_at(sources, self._all()[0]))

    def correction(self) -> Correction:
        """The correction that all walks ask for."""
        return Correction(self._walks(self._all()))

    def remaining(self) -> RegionError:
        """Error that a correction leaves: each half is corrected with what the other half says. That of all walks leaves less."""
        everything = self._all()
        points, weights, predicted, _, half, quarter, _ = everything
        changed = np.empty_like(predicted)
        for other in (0, 1):
            own = half == other
            correction = Correction(self._walks(everything).of(~own, quarter))
            changed[own] = predicted_at(corrected_sources(self._sources, correction, predicted, weights), points[own])
        return self._judged(predicted, changed)

    def corrected(self, correction: Correction) -> list[FrameSource]:
        """The sources with a correction in them."""
        _, weights, predicted, *_ = self._all()
        return corrected_sources(self._sources, correction, predicted, weights)

    def _all(self) -> tuple[Array, ...]:
        return tuple(np.concatenate(parts) for parts in zip(*self._parts, strict=True))

    @staticmethod
    def _walks(everything: tuple[Array, ...]) -> Walks:
        points, weights, predicted, walked, half, _, _ = everything
        return Walks(points, weights, predicted.mean(axis=1), walked.mean(axis=1), half)

    def _judged(self, predicted: Array, changed: Array | None = None) -> RegionError:
        """Error of J (n, channels) at the points; or of `changed`, whose change in each half does not depend on that half's walks."""
        _, weights, _, walked, half, _, pixels = self._all()
        width, height = self._size
        side = max(1, math.ceil(max(width, height) / _REGIONS))
        columns, rows = -(-width // side), -(-height // side)
        region = pixels // width // side * columns + pixels % width // side
        y, x = np.divmod(np.arange(width * height), width)
        area: Array = np.bincount(y // side * columns + x // side, minlength=columns * rows) / (width * height)
        truth = weights * walked.mean(axis=1)
        if not truth.mean() > 0:
            return RegionError(0.0, 0.0, 0.0, 0.0)
        level = np.bincount(region, truth, len(area)) / len(truth) / area
        lit = level > _DARK * np.quantile(level, 0.999)

        def of_regions(values: Array, h: int) -> Array:
            own = half == h
            sums: Array = np.bincount(region[own], values[own], len(area))[lit].astype(np.float64)
            sums /= max(np.count_nonzero(own), 1)
            return sums

        residual = weights * predicted.mean(axis=1) - truth
        errors = [of_regions(residual, h) for h in (0, 1)]
        product = errors[0] * errors[1]
        if changed is not None:
            change = weights * (changed - predicted).mean(axis=1)
            # Of (e + c)^2 the first part is known as the product of the halves, the others are linear in the noise of one half alone.
            for h in (0, 1):
                step = of_regions(change, h)
                product = product + 0.5 * (2 * errors[h] * step + np.square(step))
            residual = residual + change
        product /= area[lit]
        # Over the mean of the lit part, as the error of an image is.
        shown = float(area[lit].sum())
        norm = float((level * area)[lit].sum()) ** 2 / shown
        mean = float(truth.mean())
        return RegionError(
            float(residual.mean()) / mean,
            float(residual.std()) / math.sqrt(len(truth)) / mean,
            float(product.sum()) / norm,
            float(np.sqrt(np.square(product).sum())) / norm,
        )


def predicted_at(sources: Sequence[FrameSource], points: Array) -> Array:
    """J (n, channels) of all sources at world points (n, 3)."""
    types = sources[0].octree.types
    x = upload(types, points)
    total: Array | None = None
    for source in sources:
        values = source.octree.lookup(source.octree.to_local(x), types.Bool(True))
        found = on_host(source.colours(values), len(points))
        total = found if total is None else total + found
    assert total is not None
    return total


def corrected_sources(sources: Sequence[FrameSource], correction: Correction, predicted: Array, weights: Array) -> list[FrameSource]:
    """The sources with a correction in the values at their nodes; `predicted` (n, channels) and `weights` are those of the walks."""
    if not correction.levels:
        return list(sources)
    mean = float(np.average(predicted.mean(axis=1), weights=weights))
    return [source.corrected(correction, FLOOR * mean / len(sources)) for source in sources]


@dataclass(frozen=True)
class Outcome:
    """Sources to render with, and what the audit found, for a report."""

    sources: list[FrameSource]
    found: dict[str, Any]


def audited(audit: Audit, sources: Sequence[FrameSource], correct: bool, error: float, most: int, more: Callable[[], bool]) -> Outcome:
    """Audit sources and, where it helps, correct them.

    Parameters
    ----------
    audit, sources
        walks of the frame, and what they audit.
    correct
        whether to correct.
    error
        the error to stop at.
    most
        most walks.
    more
        is asked between rounds whether to go on.

    Returns
    -------
    The sources, and what was found; nothing where the camera sees no cloud.
    """
    audit.extend(min(_FIRST, most))
    if not audit.count:
        return Outcome(list(sources), {})
    while True:
        before = audit.before()
        reached = audit.remaining() if correct else before
        if max(reached.squared, 0.0) + reached.squared_deviation <= error**2 or 2 * audit.count > most or not more():
            break
        audit.extend(audit.count)
    found: dict[str, Any] = {"walks": audit.count, "network": before.summary(), "corrected": False}
    if correct:
        correction = audit.correction()
        # What the halves do not find to help is not done.
        if correction.levels and reached.squared < before.squared:
            found |= {"corrected": True, "levels": correction.levels, "remaining": reached.summary()}
            return Outcome(audit.corrected(correction), found)
    return Outcome(list(sources), found)
