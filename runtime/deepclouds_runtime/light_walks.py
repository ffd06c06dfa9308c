"""Walks under all lights of a scene: J of one walk a point, for audits and for images that are path-traced."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Protocol

import drjit as dr
import numpy as np

from deepclouds.backend import lanes_of, rows, vectors_of
from deepclouds.medium.albedo import AlbedoField
from deepclouds.medium.field import Field
from deepclouds.medium.one_sun import Escapes, begin_to_escape, trace_to_escape
from deepclouds_runtime.lights import BrightPart, Environment, LightSource, Shade, on_host
from deepclouds_runtime.octree import Array
from deepclouds_runtime.scene_lights import Sun
from deepclouds_runtime.stratified import Stratified
from deepclouds_runtime.transport import Cloud, Lights, taker

# Directions of an environment that are so many times brighter than its mean are connected to, as a sun is: walks seldom leave toward them.
BRIGHT = 8.0
# Most walks at the nodes of one octree.
AT_NODES = 1 << 21
# Albedo of walks whose collisions are counted; and collisions until a walk is thinned out, times the share absorbed in each.
_NEARLY_ONE, _THINNED = 0.9999, 3.3


class LightWalks:
    """Estimates J by walks: unbiased, and noisy.

    Parameters
    ----------
    cloud, lights
        the medium and all that lights it.
    smooth
        leave out suns and what is bright of environments. Of the sources that `lights` calls smooth single scattering is a part of J.

    Attributes
    ----------
    lights
        how many there are.
    most
        walks that may be traced at the nodes of one octree.
    """

    def __init__(self, cloud: Cloud, lights: Lights, smooth: bool = False) -> None:
        self._cloud, self._lights = cloud, lights
        self.most = AT_NODES
        self._bright = []
        for source, _ in lights.sources:
            if isinstance(source, Environment) and (part := source.bright_part(BRIGHT)) is not None:
                self._bright.append(_OfBright(source, part))
        self._connected: list[_Connected] = []
        if not smooth:
            self._connected += [_OfSun(sun) for sun in lights.suns if max(sun.irradiance) > 0]
            self._connected += self._bright
        self.lights = len(self._connected) + len(lights.sources)

    def __call__(self, points: Array, along: Array, random: np.random.Generator) -> Array:
        """J (n, channels) of one walk a point, at world points (n, 3) seen along unit vectors (n, 3).

        A walk is connected to one sun, which is drawn for it, and sees all other light where it leaves the cloud.
        """
        return self.begin(points, along, random)()

    def begin(self, points: Array, along: Array, random: np.random.Generator) -> Callable[[], Array]:
        """Set the walks off: what it returns waits for them, and returns what a call of this object would."""
        n = len(points)
        key = int(random.integers(1 << 32))
        result = np.zeros((n, len(self._cloud.albedo)))
        if not any(self._cloud.albedo) or not (self._connected or self._lights.sources):
            return lambda: result
        power = np.array([light.power for light in self._connected])
        share = power / power.sum() if len(power) else np.ones(1)
        if len(share) == 1:
            return self._begin_one(points, along, self._connected[0] if self._connected else None, 1.0, key, random)
        # As many walks for each as it has light, and no walk knows which are beside it.
        places = (random.permutation(n) + random.random()) / n
        which = np.minimum(np.searchsorted(np.cumsum(share), places, side="right"), len(share) - 1)
        begun = []
        for number, of_light in enumerate(share):
            chosen = np.flatnonzero(which == number)
            if len(chosen):
                light = self._connected[number] if self._connected else None
                begun.append((chosen, self._begin_one(points[chosen], along[chosen], light, float(of_light), key + number, random)))

        def finish() -> Array:
            for chosen, walked in begun:
                result[chosen] = walked()
            return result

        return finish

    def collisions(self, points: Array, along: Array, random: np.random.Generator) -> float:
        """How often walks from world points (n, 3) seen along unit vectors (n, 3) collide on the mean, by one walk a point.

        Of absorbed walks those count that are left before the rest is thinned out.
        """
        cloud, n = self._cloud, len(points)
        # The weight of a walk in a medium that absorbs next to nothing tells how often it collided.
        albedos = np.full((n, 1), _NEARLY_ONE, np.float32)
        lobes = np.broadcast_to(np.array(cloud.phase, np.float32), (n, 3))
        key = int(random.integers(1 << 32))
        _, escapes = trace_to_escape(cloud.field, points.astype(np.float32), along.astype(np.float32), lobes, None, albedos, key)
        weight = np.array(escapes.weight[0], np.float64)
        count = np.where(weight > 0, np.log(np.maximum(weight, 1e-30)) / math.log(np.float32(_NEARLY_ONE)), 0)
        brightest = max(cloud.albedo, default=0.0) if cloud.varying is None else 1.0
        most = _THINNED / (1 - brightest) if brightest < 1 else math.inf
        return float(np.minimum(count, most).mean())

    def _begin_one(
        self, points: Array, along: Array, light: _Connected | None, share: float, key: int, random: np.random.Generator
    ) -> Callable[[], Array]:
        """J (n, channels) of walks that are connected to `light`, a `share` of all."""
        cloud, types, n = self._cloud, self._cloud.field.types, len(points)
        shade = self._lights.shade
        if cloud.varying is None:
            own = np.broadcast_to(np.array(cloud.albedo, np.float64), (n, len(cloud.albedo)))
            albedos = tuple(sorted({a for a in cloud.albedo if a > 0}))
            # Which of them each channel has; a black one has any.
            column = [albedos.index(a) if a > 0 else 0 for a in cloud.albedo]
        else:
            own = on_host(cloud.albedo_at(vectors_of(types, points)), n)
            albedos, column = (), list(range(len(cloud.albedo)))
        toward, arriving = (None, np.zeros((n, len(column)))) if light is None else light.arriving(types, n, random)
        found, escapes = begin_to_escape(
            cloud.field,
            points.astype(np.float32),
            along.astype(np.float32),
            np.broadcast_to(np.array(cloud.phase, np.float32), (n, 3)),
            toward,
            np.broadcast_to(np.array(albedos, np.float32), (n, len(albedos))),
            key & 0xFFFFFFFF,
            varying=cloud.varying,
            watched=bool(self._lights.sources),
            shaded=shade.surfaces is not None and not shade.inside,
            ends=shade.reach if shade.inside else None,
            straight=bool(self._lights.smooth),
        )

        def finish() -> Array:
            j = np.array(found).reshape(n, -1)
            light_there = arriving
            if toward is not None and shade.surfaces is not None and not shade.inside:
                light_there = arriving * self._unshaded(escapes.sunlit, toward)[:, None]
            seen = self._seen(escapes, n, key)
            result = np.zeros((n, len(column)))
            for c, m in enumerate(column):
                # The next collision's albedo is in the walk where it varies.
                next_one = own[:, c] if cloud.varying is None else 1.0
                result[:, c] = own[:, c] * (light_there[:, c] * next_one * j[:, m] / (4 * math.pi * share) + seen[m][:, c])
            return result

        return finish

    def _unshaded(self, unit: Any, toward: Array) -> Array:
        """Whether no surface stands between points, given in the unit cube of the box, and what lies toward (n, 3): (n,)."""
        types = self._cloud.field.types
        visible = self._lights.shade.visible(vectors_of(types, self._world(unit)), vectors_of(types, toward))
        return np.broadcast_to(np.array(visible), len(toward))

    def _world(self, unit: Any) -> Array:
        """World points (n, 3) of points given in the unit cube of the box."""
        m = self._cloud.field.volume.to_world
        result: Array = rows(unit).astype(np.float64) @ m[:3, :3].T + m[:3, 3]
        return result

    def _seen(self, escapes: Escapes, n: int, key: int) -> list[Array]:
        """Radiance times weight (n, channels) that walks see where they leave the cloud, for each albedo."""
        types, channels = self._cloud.field.types, len(self._cloud.albedo)
        result = [np.zeros((n, channels)) for _ in escapes.weight]
        if not self._lights.sources:
            return result
        heaviest = escapes.weight[0]
        for weight in escapes.weight[1:]:
            heaviest = dr.maximum(heaviest, weight)
        lanes: Any = dr.compress(heaviest > 0)
        if len(lanes) == 0:
            return result
        take = taker(types, lanes)
        direction, where = take(escapes.direction), np.array(lanes)
        x = vectors_of(types, self._world(take(escapes.position)))
        one = dr.opaque(types.UInt32, 1)
        total = np.zeros((len(lanes), channels))
        # What is seen straight from the first point is no part of J, but for smooth sources.
        once_more = np.array(take(escapes.collided), np.float64)[:, None] if self._lights.smooth else np.ones((1, 1))
        for number, (source, _) in enumerate(self._lights.sources):
            numbers = Stratified(types, lanes, dr.full(types.UInt32, number, len(lanes)), one, dr.opaque(types.UInt32, key & 0xFFFFFFFF))
            counted = 1.0 if source in self._lights.smooth else once_more
            if not isinstance(source, Environment):
                light_of = _from_surfaces(types, source, x, direction, numbers.unrelated(), self._lights.shade, len(lanes), channels)
                total += counted * light_of
                continue
            light = source.seen(x, direction)
            for part in self._bright:
                if part.of is source:
                    light = [dr.select(part.part.holds(direction), 0, value) for value in light]
            total += counted * on_host(light, len(lanes))
        for values, weight in zip(result, escapes.weight, strict=True):
            values[where] = total * np.array(take(weight), np.float64)[:, None]
        return result


def _from_surfaces(
    types: Any, source: LightSource, points: Any, direction: Any, numbers: Stratified, shade: Shade, n: int, channels: int
) -> Array:
    """Radiance (n, channels) of what surfaces send back, which is worked out where there are some only."""
    result = np.zeros((n, channels))
    hit: Any = dr.compress(~shade.visible(points, direction))
    if len(hit):
        take = taker(types, hit)
        result[np.array(hit)] = on_host(source.arriving(take(points), take(direction), numbers.take(hit)), len(hit))
    return result


class Paths:
    """J by path tracing, for an image: a walk for each point, with random numbers of its own in every call.

    Parameters
    ----------
    field, albedo, phase, varying
        see `deepclouds_runtime.transport.Cloud`.
    seed
        of all random numbers.
    """

    def __init__(
        self, field: Field, albedo: tuple[float, ...], phase: tuple[float, float, float], varying: AlbedoField | None, seed: int
    ) -> None:
        self._cloud = Cloud(field, albedo, phase, None, varying=varying)
        self._streams = np.random.SeedSequence([seed & 0xFFFFFFFF, 0x9A75])
        self._walks: list[tuple[Lights, LightWalks]] = []

    def __call__(self, lights: Lights, points: Any, w: Any) -> Array:
        """J (n, channels) at points (Array3f) seen along unit vectors `w`."""
        # The lights of a render are few: those of the surfaces, and those of the cloud.
        known = [walks for of, walks in self._walks if of is lights]
        if not known:
            known = [LightWalks(self._cloud, lights)]
            self._walks.append((lights, known[0]))
        (own,) = self._streams.spawn(1)
        n = dr.width(points)
        return known[0](rows(points), np.broadcast_to(rows(w), (n, 3)), np.random.default_rng(own))


class _Connected(Protocol):
    """A light that walks are connected to."""

    power: float

    def arriving(self, types: Any, n: int, random: np.random.Generator) -> tuple[Array, Array]:
        """Directions (n, 3) TOWARD the light, one a walk, and the irradiance (n, channels) from there where nothing is in the way."""
        ...


class _OfSun:
    """A sun."""

    def __init__(self, sun: Sun) -> None:
        self._sun = sun
        self.power = max(sun.irradiance)

    def arriving(self, types: Any, n: int, random: np.random.Generator) -> tuple[Array, Array]:
        toward = np.broadcast_to(np.array(self._sun.omega_sun, np.float32), (n, 3))
        return toward, np.broadcast_to(np.array(self._sun.irradiance, np.float64), (n, len(self._sun.irradiance)))


class _OfBright:
    """What is bright of an environment: a direction for each walk."""

    def __init__(self, of: Environment, part: BrightPart) -> None:
        self.of, self.part, self.power = of, part, part.irradiance

    def arriving(self, types: Any, n: int, random: np.random.Generator) -> tuple[Array, Array]:
        u, v = (np.minimum((np.argsort(random.random(n)) + random.random(n)) / n, 1 - 1e-7) for _ in range(2))
        omega, density = self.part.light.sample(*(lanes_of(types.Float, t) for t in (u, v)))
        # A direction at a cell's edge may fall into the next one, which escapes see.
        light = [dr.select(self.part.holds(omega), value / density, 0) for value in self.of.radiance(omega)]
        dr.eval(omega, light)
        return np.broadcast_to(rows(omega), (n, 3)), on_host(light, n)
