"""Light at a sample of the cloud: the collision along a ray, single scattering there, and multiple scattering from the network.

    L = int T sigma_t (S1 + J) dt,   estimated by   (1 - exp(-tau)) (S1 + J)   at one point drawn from T sigma_t

The optical depth and the point are found without random numbers, so all noise left is that of the point's position and of the
directions drawn from environments.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepclouds.backend import lanes_of
from deepclouds.medium.albedo import AlbedoField
from deepclouds.medium.field import Field
from deepclouds.medium.optical_depth import TAU_OPAQUE, distance_at, optical_depth
from deepclouds.medium.phase import rotate_to, sample_two_lobe_cosine, two_lobe
from deepclouds_runtime import stratified
from deepclouds_runtime._mitsuba import mitsuba, plain
from deepclouds_runtime.disc import discs
from deepclouds_runtime.lights import LightSource, Shade
from deepclouds_runtime.scattering import MultipleScattering
from deepclouds_runtime.scene_lights import Sun
from deepclouds_runtime.stratified import Stratified

# A sample that hides less than this of what is behind it is sent to the network with a probability in proportion, weighted up.
_ROULETTE = 0.02
# The march toward a light goes on beyond `optical_depth`'s limit, for the network is told the whole depth.
_DEEP = 1e6


@dataclass
class Counts:
    """How much work a render did."""

    camera_samples: int = 0
    cloud_samples: int = 0
    queries: int = 0
    skipped: int = 0


@dataclass(frozen=True)
class Cloud:
    """The medium as the transport sees it.

    Parameters
    ----------
    field
        extinction.
    albedo
        single-scattering albedo, one value a colour channel; the largest ones, where it varies in space.
    phase
        phase function (g1, g2, weight), see `deepclouds.medium.phase`.
    scattering
        source of J, or None for single scattering alone.
    known
        J of each colour channel as a function of points and directions, where it is known without `scattering`.
    exact
        orders of scattering that are sampled before `scattering` is asked: with 1 it is asked at the first collision of a ray, with 2 at
        the second one, and so on.
    varying
        the albedo, where it varies in space. `scattering` knows one a query: it is asked for what is interpolated alone.
    paths
        in place of `scattering`, all of J by path tracing: lights, points and directions (Array3f) -> (n, channels).
    """

    field: Field
    albedo: tuple[float, ...]
    phase: tuple[float, float, float]
    scattering: MultipleScattering | None
    known: Callable[[Any, Any], list[Any]] | None = None
    exact: int = 1
    varying: AlbedoField | None = None
    paths: Callable[[Lights, Any, Any], NDArray[np.float64]] | None = None

    def albedo_at(self, points: Any) -> list[Any]:
        """Albedo of each channel at world points (Array3f)."""
        if self.varying is not None:
            return self.varying(points)
        return [dr.opaque(self.field.types.Float, a) for a in self.albedo]


@dataclass(frozen=True)
class Lights:
    """Every light of a scene.

    Parameters
    ----------
    suns
        distant lights, points and discs.
    sources
        pairs of a light from many directions and how many of them a sample draws.
    shade
        what the surfaces keep away from the suns.
    smooth
        those of the sources whose single scattering is taken for a part of J, and interpolated with it.
    """

    suns: tuple[Sun, ...]
    sources: tuple[tuple[LightSource, int], ...]
    shade: Shade
    smooth: tuple[LightSource, ...] = ()


@dataclass
class CloudLight:
    """What the cloud adds along rays, lane by lane; colours as one array a channel."""

    opacity: Any
    transmittance: Any
    distance: Any
    direct: list[Any] = field(default_factory=list)
    indirect: list[Any] = field(default_factory=list)


def opacity_of(tau: Any) -> Any:
    """Return ``1 - exp(-tau)`` with full precision for thin media."""
    return dr.select(tau < 1e-2, tau * (1 - tau * (0.5 - tau * (1 / 6))), 1 - dr.exp(-tau))


def depth_of(hidden: Any) -> Any:
    """Return ``-log(1 - hidden)``, the inverse of `opacity_of`."""
    return dr.select(hidden < 1e-2, hidden * (1 + hidden * (0.5 + hidden * (1 / 3))), -dr.log(dr.maximum(1 - hidden, 1e-30)))


def cloud_light(
    cloud: Cloud, lights: Lights, origin: Any, direction: Any, end: Any, numbers: Stratified, counts: Counts, weight: Any = None
) -> CloudLight:
    """Light that the cloud sends back along rays, and what it hides.

    Parameters
    ----------
    cloud, lights
        the medium and what lights it.
    origin, direction
        Array3f: world points and unit vectors of the rays.
    end
        Float: the rays end here, world units.
    numbers
        random numbers of the lanes.
    counts
        is updated.
    weight
        Float: how much of what a ray brings counts in the image (default 1). It thins the queries out, and does NOT scale the result;
        rays of weight 0 are not traced.
    """
    types, medium = cloud.field.types, cloud.field
    weight = types.Float(1) if weight is None else weight
    n = dr.width(origin, direction, end)
    tau = optical_depth(medium, origin, direction, types.Float(0), end, weight > 0)
    opacity = opacity_of(tau)
    target = depth_of(numbers.number(stratified.DEPTH) * opacity)
    distance = distance_at(medium, origin, direction, types.Float(0), end, target, tau > 0)
    # Optical depths end there, and what lies behind may be a sun.
    result = CloudLight(opacity, dr.select(tau < TAU_OPAQUE, dr.exp(-tau), 0), distance)
    channel_count = len(cloud.albedo)
    result.direct = [dr.zeros(types.Float, n) for _ in range(channel_count)]
    result.indirect = [dr.zeros(types.Float, n) for _ in range(channel_count)]
    dr.eval(result.opacity, result.transmittance, result.distance, origin, direction)
    lanes: Any = dr.compress(result.opacity > 0)
    counts.cloud_samples += len(lanes)
    if len(lanes) == 0 or not any(a > 0 for a in cloud.albedo):
        return result
    take = taker(types, lanes)
    d = take(direction)
    points = dr.fma(d, take(distance), take(origin))
    scatter(cloud, lights, points, d, take(opacity), take(weight), numbers.take(lanes), counts, lanes, result)
    return result


def taker(types: Any, lanes: Any) -> Callable[[Any], Any]:
    """Function that takes the lanes with these indices out of a Float or an Array3f; what is the same for all lanes stays as it is."""

    def take(value: Any) -> Any:
        if dr.depth_v(value) > 1:
            return types.Array3f(*(take(c) for c in value))
        return value if dr.width(value) == 1 else dr.gather(type(value), value, lanes)

    return take


def scatter(
    cloud: Cloud,
    lights: Lights,
    points: Any,
    w: Any,
    opacity: Any,
    importance: Any,
    numbers: Stratified,
    counts: Counts,
    lanes: Any,
    result: CloudLight,
) -> None:
    """Add single and multiple scattering at points of the cloud to lanes of `result`, for every light.

    Parameters
    ----------
    cloud, lights, counts
        as for `cloud_light`.
    points, w
        Array3f: the points, and the unit directions in which they are seen.
    opacity
        Float: the light is multiplied by it.
    importance
        Float: how much of that counts in the image.
    numbers
        random numbers of the points.
    lanes
        UInt32: lane of `result` that each point adds to.
    result
        is updated, but for what its rays hide.
    """
    types = cloud.field.types
    channel_count = len(cloud.albedo)
    if cloud.exact > 1 and (cloud.scattering is not None or cloud.known is not None):
        for c, value in enumerate(single_scattering(replace(cloud, scattering=None), lights, points, w, numbers)):
            dr.scatter(result.direct[c], value * opacity, lanes)
        scatter_on(cloud, lights, points, w, opacity, importance, numbers, counts, lanes, result)
        return
    if cloud.paths is not None:
        scatter_paths(cloud, lights, points, w, opacity, importance, numbers, counts, lanes, result)
    # Which samples are worth a query is the same for all lights: one that lies in a thin place is so for each of them.
    queries, weight = _worth_it(types, opacity, importance, numbers) if cloud.scattering is not None else (types.UInt32(), types.Float())
    take = taker(types, queries)
    target = dr.gather(types.UInt32, lanes, queries)

    def predict(omega: Any, radiance: list[Any], tau: Any) -> None:
        if len(queries):
            assert cloud.scattering is not None
            different = tuple(sorted(set(cloud.albedo)))
            counts.queries += len(queries) * len(different)
            counts.skipped += (len(lanes) - len(queries)) * len(different)
            j = cloud.scattering(take(points), take(w), take(omega), cloud.phase, different, take(tau))
            for c, albedo in enumerate(cloud.albedo):
                own = dr.opaque(types.Float, albedo * albedo * (0.25 / math.pi))
                value = lanes_of(types.Float, j[:, different.index(albedo)]) * own * weight * take(radiance[c])
                dr.scatter_add(result.indirect[c], value, target)

    direct = single_scattering(cloud, lights, points, w, numbers, None if cloud.scattering is None else predict)
    if cloud.known is not None:
        for total, value in zip(result.indirect, cloud.known(points, w), strict=True):
            dr.scatter(total, value * opacity, lanes)
    for c in range(channel_count):
        dr.scatter(result.direct[c], direct[c] * opacity, lanes)


def _worth_it(types: Any, opacity: Any, importance: Any, numbers: Stratified) -> tuple[Any, Any]:
    """Samples that are worth a query or a walk (UInt32), and their opacities, larger for those left out."""
    keep = dr.minimum(opacity * importance * (1 / _ROULETTE), 1)
    chosen: Any = dr.compress(numbers.number(stratified.ROULETTE) < keep)
    return chosen, dr.gather(types.Float, opacity / keep, chosen)


def scatter_paths(
    cloud: Cloud,
    lights: Lights,
    points: Any,
    w: Any,
    opacity: Any,
    importance: Any,
    numbers: Stratified,
    counts: Counts,
    lanes: Any,
    result: CloudLight,
) -> None:
    """Add multiple scattering at points of the cloud to lanes of `result` by the cloud's `paths`; parameters are those of `scatter`."""
    types = cloud.field.types
    chosen, weight = _worth_it(types, opacity, importance, numbers)
    counts.skipped += dr.width(points) - len(chosen)
    if cloud.paths is None or len(chosen) == 0:
        return
    counts.queries += len(chosen)
    take = taker(types, chosen)
    j = cloud.paths(lights, take(points), take(w))
    target = dr.gather(types.UInt32, lanes, chosen)
    for c in range(len(cloud.albedo)):
        dr.scatter_add(result.indirect[c], lanes_of(types.Float, j[:, c]) * weight, target)


def scatter_on(
    cloud: Cloud,
    lights: Lights,
    points: Any,
    w: Any,
    opacity: Any,
    importance: Any,
    numbers: Stratified,
    counts: Counts,
    lanes: Any,
    result: CloudLight,
) -> None:
    """Add multiple scattering at points of the cloud to lanes of `result` by one more exact order: along a ray from each of them.

    J(x, w) = albedo int p(w . w') L(x, w') dw' with one direction w' from the phase function, and L, along it, of all that was scattered
    at least once: S1 + J at a collision, where one order less is left to be sampled. The ray ends at surfaces: what they send to x is one
    of the lights. Parameters are those of `scatter`.
    """
    types = cloud.field.types
    # As for queries: what adds little is followed seldom.
    follow, weight = _worth_it(types, opacity, importance, numbers)
    counts.skipped += dr.width(points) - len(follow)
    if len(follow) == 0:
        return
    take = taker(types, follow)
    numbers = numbers.take(follow)
    cosine = sample_two_lobe_cosine(numbers.number(stratified.PHASE_U), *(dr.opaque(types.Float, v) for v in cloud.phase))
    omega = rotate_to(take(w), cosine, 2 * dr.pi * numbers.number(stratified.PHASE_V))
    origin = take(points)
    dr.eval(origin, omega, weight)
    end = dr.full(types.Float, math.inf, len(follow))
    if lights.shade.surfaces is not None:
        mi = mitsuba()
        hit = lights.shade.surfaces.ray_intersect(mi.Ray3f(mi.Point3f(origin), mi.Vector3f(omega)))
        end = dr.select(plain(types, hit.is_valid()), plain(types, hit.t), end)
    deeper = replace(cloud, exact=cloud.exact - 1)
    brings = weight * take(importance) * dr.opaque(types.Float, max(cloud.albedo))
    # What the image has of cloud samples are the first collisions of its rays.
    own = Counts()
    light = cloud_light(deeper, lights, origin, omega, end, numbers.unrelated(cloud.exact), own, brings)
    counts.queries += own.queries
    counts.skipped += own.skipped
    target = dr.gather(types.UInt32, lanes, follow)
    for c, albedo in enumerate(cloud.albedo_at(origin)):
        value = (light.direct[c] + light.indirect[c]) * (weight * albedo)
        dr.scatter_add(result.indirect[c], value, target)


def single_scattering(
    cloud: Cloud, lights: Lights, points: Any, w: Any, numbers: Stratified, each: Callable[[Any, list[Any], Any], None] | None = None
) -> list[Any]:
    """S1 of all lights at points of the cloud seen along `w`; one array a colour channel.

    Parameters
    ----------
    cloud, lights
        the medium and what lights it.
    points, w
        Array3f: world points and unit directions of the camera rays' travel.
    numbers
        random numbers of the lanes.
    each
        is called for every direction that light was drawn from, with the direction, the radiance that arrives over the direction's density
        (the irradiance, of a sun), and the whole optical depth toward it.
    """
    types, medium = cloud.field.types, cloud.field
    channel_count, n = len(cloud.albedo), dr.width(points)
    albedo = cloud.albedo_at(points)
    lobes = [dr.opaque(types.Float, v) for v in cloud.phase]
    direct = [dr.zeros(types.Float, n) for _ in range(channel_count)]
    # A network is told the whole depth.
    deepest = _DEEP if each is not None else TAU_OPAQUE

    def light(omega: Any, radiance: list[Any], share: Any, end: Any) -> None:
        """One direction: `radiance` is what arrives over the density of the direction, from the distance `end`."""
        tau = optical_depth(medium, points, omega, types.Float(0), end, types.Bool(True), deepest)
        single = two_lobe(dr.dot(w, omega), *lobes) * dr.exp(-tau) * share
        for c in range(channel_count):
            direct[c] += albedo[c] * radiance[c] * single
        if each is not None:
            dr.eval(tau, direct, radiance)
            each(omega, radiance, tau)

    far = types.Float(math.inf)
    for disc in discs(types, lights.suns, lights.shade):
        # A disc is small: directions drawn from it alone do where the phase function's peak is no narrower.
        omega, density = disc.sample(numbers.number(stratified.LIGHT_U), numbers.number(stratified.LIGHT_V))
        light(omega, [value / density for value in disc.arriving(points, omega, numbers)], 1, far)
    for sun in lights.suns:
        if sun.radius > 0:
            continue
        omega = types.Array3f(*(dr.opaque(types.Float, v) for v in sun.omega_sun))
        seen = lights.shade.visible(points, omega)
        light(omega, [dr.select(seen, dr.opaque(types.Float, e), 0) for e in sun.irradiance], 1, far)
    for source, directions in lights.sources:
        for k in range(directions if source not in lights.smooth else 0):
            numbers_of = functools.partial(numbers.number, part=k, parts=directions)
            omega, density = source.sample(numbers_of(stratified.LIGHT_U), numbers_of(stratified.LIGHT_V))
            radiance = [v / (density * directions) for v in source.arriving(points, omega, numbers)]
            light(omega, radiance, density / (density + two_lobe(dr.dot(w, omega), *lobes)), source.reach(points, omega))
            # The other half of the pair: a direction from the phase function, for a strong peak that the source's table knows nothing of.
            cosine = sample_two_lobe_cosine(numbers_of(stratified.PHASE_U), *lobes)
            omega = rotate_to(w, cosine, 2 * dr.pi * numbers_of(stratified.PHASE_V))
            drawn = two_lobe(cosine, *lobes)
            tau = optical_depth(medium, points, omega, types.Float(0), source.reach(points, omega), types.Bool(True))
            share = drawn / (drawn + source.density(omega)) * (1.0 / directions) * dr.exp(-tau)
            for c, value in enumerate(source.arriving(points, omega, numbers)):
                direct[c] += albedo[c] * value * share
            dr.eval(direct)
    return direct
