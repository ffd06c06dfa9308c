"""Light on opaque surfaces: straight from the lights, and from the cloud."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import numpy as np

from deepclouds.medium.optical_depth import optical_depth
from deepclouds.medium.phase import rotate_to, sample_two_lobe_cosine, two_lobe
from deepclouds.medium.walk_parts import direction_around
from deepclouds_runtime import stratified
from deepclouds_runtime._mitsuba import channels, mitsuba, plain
from deepclouds_runtime.disc import Disc, discs
from deepclouds_runtime.lights import LightSource
from deepclouds_runtime.scene_lights import Sun
from deepclouds_runtime.stratified import Stratified
from deepclouds_runtime.transport import Cloud, Counts, Lights, cloud_light, taker

# Of the rays that look for light of the cloud, those toward suns at most; the peak of a phase function that gets half of them; and what
# is not worth the while.
_MOST_HALO, _PEAK, _LEAST_HALO = 0.4, 6.0, 0.05


def reflected(cloud: Cloud, lights: Lights, interaction: Any, numbers: Stratified) -> list[Any]:
    """Radiance that surfaces send back along the rays that hit them, direct light only; one array a colour channel.

    Parameters
    ----------
    cloud, lights
        what dims the light on its way, and the lights.
    interaction
        Mitsuba's surface interactions, one a lane; invalid ones give 0.
    numbers
        random numbers of the lanes.

    Notes
    -----
    Light between surfaces is not part of it: see `reflected_from_surfaces`.
    """
    mi, types = mitsuba(), cloud.field.types
    context = mi.BSDFContext()
    bsdf = interaction.bsdf()
    valid = interaction.is_valid()
    total = [dr.zeros(types.Float, dr.width(interaction.p)) for _ in cloud.albedo]

    def through(omega: Any) -> tuple[Any, Any]:
        """Share of the light from direction `omega` that the cloud lets pass, and where the ray starts."""
        origin = plain(types, interaction.spawn_ray(mi.Vector3f(omega)).o)
        tau = optical_depth(cloud.field, origin, omega, types.Float(0), types.Float(math.inf), plain(types, valid))
        return dr.exp(-tau), origin

    def facing(omega: Any) -> list[Any]:
        return channels(types, bsdf.eval(context, interaction, interaction.to_local(mi.Vector3f(omega)), valid))

    for sun in lights.suns:
        if sun.radius > 0:
            continue
        omega = types.Array3f(*(dr.opaque(types.Float, v) for v in sun.omega_sun))
        share, origin = through(omega)
        share = dr.select(lights.shade.visible(origin, omega), share, 0)
        for c, value in enumerate(facing(omega)):
            total[c] += value * share * dr.opaque(types.Float, sun.irradiance[c])
    wide: list[LightSource | Disc] = [source for source, _ in lights.sources]
    for source in wide + discs(types, lights.suns, lights.shade):
        omega, density = source.sample(numbers.number(stratified.LIGHT_U), numbers.number(stratified.LIGHT_V))
        other = plain(types, bsdf.pdf(context, interaction, interaction.to_local(mi.Vector3f(omega)), valid))
        share, origin = through(omega)
        share = share / (density + other)
        for c, (value, light) in enumerate(zip(facing(omega), source.arriving(origin, omega, numbers), strict=True)):
            total[c] += value * light * share
        sample, weight = bsdf.sample(
            context,
            interaction,
            mi.Float(numbers.number(stratified.SURFACE_W)),
            mi.Point2f(numbers.number(stratified.SURFACE_U), numbers.number(stratified.SURFACE_V)),
            valid,
        )
        omega = plain(types, interaction.to_world(sample.wo))
        drawn = plain(types, sample.pdf)
        smooth = plain(types, mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta))
        share, origin = through(omega)
        share = dr.select(drawn > 0, share * dr.select(smooth, 1, drawn / (drawn + source.density(omega))), 0)
        for c, (value, light) in enumerate(zip(channels(types, weight), source.arriving(origin, omega, numbers), strict=True)):
            total[c] += value * light * share
    return [dr.select(plain(types, valid), value, 0) for value in total]


def reflected_from_surfaces(cloud: Cloud, lights: Lights, source: LightSource, interaction: Any, numbers: Stratified) -> list[Any]:
    """Radiance that surfaces send back of what other surfaces send them: one ray by the BSDF a lane; one array a colour channel.

    Parameters
    ----------
    cloud, lights
        what dims the light on its way, and where surfaces are.
    source
        what surfaces send, see `deepclouds_runtime.reflectors.Reflectors`.
    interaction
        Mitsuba's surface interactions, one a lane; invalid ones give 0.
    numbers
        random numbers of the lanes.

    Notes
    -----
    What the other surfaces send in their turn of each other's light is left out.
    """
    mi, types = mitsuba(), cloud.field.types
    valid = interaction.is_valid()
    sample, weight = interaction.bsdf().sample(
        mi.BSDFContext(),
        interaction,
        mi.Float(numbers.number(stratified.SURFACE_W)),
        mi.Point2f(numbers.number(stratified.SURFACE_U), numbers.number(stratified.SURFACE_V)),
        valid,
    )
    omega = plain(types, interaction.to_world(sample.wo))
    origin = plain(types, interaction.spawn_ray(mi.Vector3f(omega)).o)
    throughput = channels(types, weight)
    end = lights.shade.reach(origin, omega, valid)
    total = [dr.zeros(types.Float, dr.width(interaction.p)) for _ in cloud.albedo]
    dr.eval(origin, omega, throughput, end)
    lanes: Any = dr.compress(end < math.inf)
    if len(lanes):
        take = taker(types, lanes)
        origin, omega, end = take(origin), take(omega), take(end)
        share = dr.exp(-optical_depth(cloud.field, origin, omega, types.Float(0), end, types.Bool(True)))
        for c, light in enumerate(source.arriving(origin, omega, numbers.take(lanes))):
            dr.scatter(total[c], take(throughput[c]) * light * share, lanes)
    return total


def reflected_from_cloud(cloud: Cloud, lights: Lights, interaction: Any, weight: Any, numbers: Stratified, counts: Counts) -> list[Any]:
    """Radiance that surfaces send back of the light the cloud throws on them: one ray into the cloud a lane.

    Parameters
    ----------
    cloud, lights
        the medium and what lights it.
    interaction
        Mitsuba's surface interactions, one a lane.
    weight
        Float: how much of the result counts in the image; 0 leaves a lane out.
    numbers
        random numbers of the lanes.
    counts
        is updated.

    Notes
    -----
    The ray's direction comes from the BSDF or, as often, from the cone around the sphere that encloses the cloud's box; or from the phase
    function around a sun, which thin cloud has a bright halo about. All are weighted by the density of the mixture (Veach and Guibas 1995).
    """
    mi, types = mitsuba(), cloud.field.types
    context = mi.BSDFContext()
    bsdf, valid = interaction.bsdf(), interaction.is_valid()
    lower, upper = cloud.field.volume.bounds
    radius = dr.opaque(types.Float, 0.5 * float(np.linalg.norm(upper - lower)))
    axis = types.Array3f(*(dr.opaque(types.Float, float(v)) for v in 0.5 * (lower + upper))) - plain(types, interaction.p)
    distance = dr.norm(axis)
    axis = axis / dr.maximum(distance, 1e-20)
    # From inside of the sphere the cone is the whole sphere of directions. From far away its edge's cosine is 1 but for the last digits:
    # the sine tells it, and one minus the cosine.
    outside, sine = distance > radius, radius / dr.maximum(distance, radius)
    beside = dr.select(outside, dr.square(sine) / (1 + dr.safe_sqrt(1 - dr.square(sine))), 2.0)
    of_cone = dr.rcp(2 * dr.pi * dr.maximum(beside, 1e-30))

    pick = numbers.number(stratified.SURFACE_W)
    u, v = numbers.number(stratified.SURFACE_U), numbers.number(stratified.SURFACE_V)
    halo = _halo(cloud, lights)
    of_halo = 0.0 if halo is None else halo.share
    half = 0.5 * (1 - of_halo)
    aim, bounce = pick < half, (pick >= half) & (pick < 2 * half)
    rest = dr.clip((pick - half) / half, 0, 0.99999994)
    # Around the axis: cosine uniform between that of the cone's edge and 1.
    aimed = direction_around(axis, u * beside, v)
    sample, sampled = bsdf.sample(context, interaction, mi.Float(rest), mi.Point2f(u, v), valid)
    omega = dr.select(aim, aimed, plain(types, interaction.to_world(sample.wo)))
    if halo is not None:
        omega = dr.select(aim | bounce, omega, halo.sample(dr.clip((pick - 2 * half) / of_halo, 0, 0.99999994), u, v))
    local = interaction.to_local(mi.Vector3f(omega))
    meets = aim | ~outside | ((dr.norm(dr.cross(omega, axis)) <= sine) & (dr.dot(omega, axis) > 0))
    density = half * (plain(types, bsdf.pdf(context, interaction, local, valid)) + dr.select(meets, of_cone, 0))
    if halo is not None:
        density += of_halo * halo.density(omega)
    # A mirror's direction has no density: it is taken as often as the BSDF is asked.
    mirror = bounce & plain(types, mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta))
    smooth = channels(types, bsdf.eval(context, interaction, local, valid))
    throughput = [
        dr.select(mirror, direct / half, dr.select(density > 0, value / dr.maximum(density, 1e-20), 0))
        for direct, value in zip(channels(types, sampled), smooth, strict=True)
    ]
    most = throughput[0]
    for value in throughput[1:]:
        most = dr.maximum(most, value)
    ray = interaction.spawn_ray(mi.Vector3f(omega))
    end = plain(types, lights.shade.surfaces.ray_intersect(ray).t)
    # What the image has of cloud samples are those of its own rays.
    own = Counts()
    light = cloud_light(cloud, lights, plain(types, ray.o), omega, end, numbers, own, dr.select(plain(types, valid), most * weight, 0))
    counts.queries += own.queries
    counts.skipped += own.skipped
    return [t * (s + j) for t, s, j in zip(throughput, light.direct, light.indirect, strict=True)]


class _Halo:
    """Directions around suns, spread as the phase function spreads their light."""

    def __init__(self, types: Any, suns: list[Sun], lobe: tuple[float, float, float], share: float) -> None:
        self._types, self.share = types, dr.opaque(types.Float, share)
        self._lobe = [dr.opaque(types.Float, v) for v in lobe]
        power = np.array([max(sun.irradiance) for sun in suns])
        self._until = [dr.opaque(types.Float, float(v)) for v in np.cumsum(power / power.sum())]
        self._parts = [dr.opaque(types.Float, float(v)) for v in power / power.sum()]
        self._suns = [types.Array3f(*(dr.opaque(types.Float, v) for v in sun.omega_sun)) for sun in suns]

    def sample(self, pick: Any, u: Any, v: Any) -> Any:
        """Unit vectors (Array3f) by numbers in [0, 1): of the sun, and of the place around it."""
        axis = self._suns[-1]
        for sun, until in zip(self._suns[-2::-1], self._until[-2::-1], strict=True):
            axis = dr.select(pick < until, sun, axis)
        return rotate_to(axis + 0 * pick, sample_two_lobe_cosine(u, *self._lobe), 2 * dr.pi * v)

    def density(self, omega: Any) -> Any:
        """Their density, 1/sr."""
        terms = [part * two_lobe(dr.dot(omega, sun), *self._lobe) for part, sun in zip(self._parts, self._suns, strict=True)]
        return sum(terms[1:], terms[0])


def _halo(cloud: Cloud, lights: Lights) -> _Halo | None:
    """None where there are no suns, or the phase function has no peak."""
    suns = [sun for sun in lights.suns if max(sun.irradiance) > 0]
    g = cloud.phase[0]
    # Relative variance of the peak under directions drawn evenly, beside which all other noise is about 1.
    peak = (1 + g * g) / (1 - g * g) ** 2 - 1
    share = _MOST_HALO * peak / (peak + _PEAK)
    return _Halo(cloud.field.types, suns, cloud.phase, share) if suns and share > _LEAST_HALO else None


def diffuse_share(types: Any, interaction: Any) -> tuple[list[Any], Any]:
    """Share of even light that surfaces send back, one Float a channel, and Bool: whether they are matt, alike in all directions."""
    mi = mitsuba()
    bsdf, valid = interaction.bsdf(), interaction.is_valid()
    flags = bsdf.flags()
    shiny = mi.has_flag(flags, mi.BSDFFlags.Glossy) | mi.has_flag(flags, mi.BSDFFlags.Delta)
    share = channels(types, bsdf.eval_diffuse_reflectance(interaction, valid))
    return share, plain(types, valid & ~shiny)
