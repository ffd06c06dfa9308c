"""Light on opaque surfaces: straight from the lights, and from the cloud; and what the surfaces send back to the cloud."""

from __future__ import annotations

import math
from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepclouds.backend import lanes_of, vectors_of
from deepclouds.medium.optical_depth import optical_depth
from deepclouds.medium.phase import rotate_to, sample_two_lobe_cosine, two_lobe
from deepclouds_runtime import stratified
from deepclouds_runtime._mitsuba import channels, mitsuba, plain
from deepclouds_runtime.disc import Disc, discs
from deepclouds_runtime.lights import Beam, Environment, LightSource, directions_of_cells, on_host
from deepclouds_runtime.scene_lights import Sun
from deepclouds_runtime.stratified import Stratified
from deepclouds_runtime.transport import Cloud, Counts, Lights, cloud_light

# Of the rays that look for light of the cloud, those toward suns at most; the peak of a phase function that gets half of them; and what
# is not worth the while.
_MOST_HALO, _PEAK, _LEAST_HALO = 0.4, 6.0, 0.05
_PROBE_ROWS = 32
# Rays into each cell of the table; more where surfaces lie inside of the cloud, which sees them near by.
_PROBE_PARTS, _PROBE_PARTS_INSIDE = 4, 64
# A sample beside the middle sees lit surfaces where the middle sees the cloud's own shadow: many directions ignore the table.
_PROBE_UNIFORM = 0.5


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
    Light between surfaces is not part of it.
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
    # From inside of the sphere the cone is the whole sphere of directions.
    widest = dr.select(distance > radius, dr.safe_sqrt(1 - dr.square(radius / distance)), -1.0)
    of_cone = dr.rcp(2 * dr.pi * dr.maximum(1 - widest, 1e-7))

    pick = numbers.number(stratified.SURFACE_W)
    u, v = numbers.number(stratified.SURFACE_U), numbers.number(stratified.SURFACE_V)
    halo = _halo(cloud, lights)
    of_halo = 0.0 if halo is None else halo.share
    half = 0.5 * (1 - of_halo)
    aim, bounce = pick < half, (pick >= half) & (pick < 2 * half)
    rest = dr.clip((pick - half) / half, 0, 0.99999994)
    # Around the axis: cosine uniform between that of the cone's edge and 1.
    aimed = rotate_to(axis, 1 - u * (1 - widest), 2 * dr.pi * v)
    sample, sampled = bsdf.sample(context, interaction, mi.Float(rest), mi.Point2f(u, v), valid)
    omega = dr.select(aim, aimed, plain(types, interaction.to_world(sample.wo)))
    if halo is not None:
        omega = dr.select(aim | bounce, omega, halo.sample(dr.clip((pick - 2 * half) / of_halo, 0, 0.99999994), u, v))
    local = interaction.to_local(mi.Vector3f(omega))
    density = half * (plain(types, bsdf.pdf(context, interaction, local, valid)) + dr.select(dr.dot(omega, axis) >= widest, of_cone, 0))
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


class Reflectors:
    """The surfaces around a cloud as a light source: what they reflect reaches the cloud's samples.

    Directions are drawn from a table of what the surfaces look like from the middle of the cloud's box. The radiance of the lights that
    they reflect is that of the surface seen from the sample; the cloud's own light that they send back is looked up in the table, where
    the middle sees the same place.

    Parameters
    ----------
    cloud, lights
        what dims the light on its way to the surfaces, and the lights.
    on_cloud
        what lights the cloud, whose own light the surfaces send back.
    seed
        32 bits, of the table's random numbers.
    counts
        is updated.
    """

    def __init__(self, cloud: Cloud, lights: Lights, on_cloud: Lights, seed: int, counts: Counts) -> None:
        self._cloud, self._lights, self._types = cloud, lights, cloud.field.types
        colours, thrown = self._probe(on_cloud, seed, counts)
        self._table = Environment(self._types, self._nothing, colours, uniform=_PROBE_UNIFORM)
        self._thrown = [lanes_of(self._types.Float, thrown[:, c]) for c in range(thrown.shape[1])]
        self._middle = self._probed()
        self.sample, self.density, self.beams = self._table.sample, self._table.density, self._table.beams

    def arriving(self, points: Any, direction: Any, numbers: Stratified) -> list[Any]:
        """Radiance of the surface seen from `points`, 0 where there is none; see `LightSource`."""
        interaction = self._seen(points, direction)
        shown = plain(self._types, interaction.is_valid())
        direct = reflected(self._cloud, self._lights, interaction, numbers.unrelated())
        # What the middle sees where the point's ray ends; it may be something before that.
        there = plain(self._types, interaction.p) - self._middle
        there = dr.select(shown, there / dr.maximum(dr.norm(there), 1e-20), direction)
        return [d + dr.select(shown, self._table.lookup(t, there), 0) for d, t in zip(direct, self._thrown, strict=True)]

    def reach(self, points: Any, direction: Any) -> Any:
        """Distance to the surface seen from `points`, where that may lie inside of the cloud; see `LightSource`."""
        shade = self._lights.shade
        return shade.reach(points, direction) if shade.inside else self._types.Float(math.inf)

    def arriving_beam(self, points: Any, beam: Beam, numbers: Stratified) -> list[Any]:
        """Irradiance of a beam: the surface that `points` see in its direction stands for all of its part; see `LightSource`."""
        omega = self._types.Array3f(*(dr.opaque(self._types.Float, v) for v in beam.omega))
        direction = dr.zeros(self._types.Array3f, dr.width(points)) + omega
        solid_angle = dr.opaque(self._types.Float, beam.solid_angle)
        return [value * solid_angle for value in self.arriving(points, direction, numbers)]

    def _seen(self, points: Any, direction: Any) -> Any:
        mi = mitsuba()
        return self._lights.shade.surfaces.ray_intersect(mi.Ray3f(mi.Point3f(points), mi.Vector3f(direction)))

    def _nothing(self, direction: Any) -> list[Any]:
        return [dr.zeros(self._types.Float, dr.width(direction)) for _ in self._cloud.albedo]

    def _probed(self) -> Any:
        """The box's middle (Array3f)."""
        lower, upper = self._cloud.field.volume.bounds
        return self._types.Array3f(*(dr.opaque(self._types.Float, float(v)) for v in 0.5 * (lower + upper)))

    def _probe(self, on_cloud: Lights, seed: int, counts: Counts) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Colour (rows, columns, channels) of the surfaces around the box's middle; the cloud's light they send (cells, channels)."""
        types: ModuleType = self._types
        rows, columns = _PROBE_ROWS, 2 * _PROBE_ROWS
        middle = self._probed()
        parts = _PROBE_PARTS_INSIDE if self._lights.shade.inside else _PROBE_PARTS
        cells, n = rows * columns, rows * columns * parts
        places = np.random.default_rng(seed).random((parts, 2))
        local = np.concatenate([directions_of_cells(rows, columns, (float(u), float(v))).reshape(-1, 3) for u, v in places])
        lane, one = dr.arange(types.UInt32, n), dr.opaque(types.UInt32, cells)
        part = lane // one
        numbers = Stratified(types, lane - part * one, part, dr.opaque(types.UInt32, parts), dr.opaque(types.UInt32, seed)).unrelated()
        interaction = self._seen(dr.zeros(types.Array3f, n) + middle, vectors_of(types, local))
        dr.eval(interaction)
        direct = reflected(self._cloud, self._lights, interaction, numbers)
        sent = on_host(reflected_from_cloud(self._cloud, on_cloud, interaction, dr.full(types.Float, 1, n), numbers, counts), n)
        thrown = sent.reshape(parts, cells, -1).mean(axis=0)
        colours = on_host(direct, n).reshape(parts, cells, -1).mean(axis=0) + thrown
        return colours.reshape(rows, columns, -1), thrown
