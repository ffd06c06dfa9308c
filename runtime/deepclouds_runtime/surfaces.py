"""Light that opaque surfaces reflect straight from the lights, through the cloud and past other surfaces."""

from __future__ import annotations

from typing import Any

import drjit as dr

from deepclouds.medium.optical_depth import optical_depth
from deepclouds_runtime import stratified
from deepclouds_runtime._mitsuba import channels, mitsuba, plain
from deepclouds_runtime.stratified import Stratified
from deepclouds_runtime.transport import Cloud, Lights


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
    Light between surfaces, and light scattered by the cloud onto them, are not part of it.
    """
    mi, types = mitsuba(), cloud.field.types
    context = mi.BSDFContext()
    bsdf = interaction.bsdf()
    valid = interaction.is_valid()
    n = dr.width(interaction.p)
    total = [dr.zeros(types.Float, n) for _ in cloud.albedo]
    jitter = numbers.number(stratified.SHADOW)

    def through(omega: Any) -> Any:
        """Share of the light from direction `omega` that arrives."""
        ray = interaction.spawn_ray(mi.Vector3f(omega))
        tau = optical_depth(
            cloud.field, plain(types, ray.o), omega, types.Float(0), dr.largest(types.Float), jitter, plain(types, valid)
        )
        return dr.select(plain(types, valid & ~lights.surfaces.ray_test(ray, active=valid)), dr.exp(-tau), 0)

    def facing(omega: Any) -> list[Any]:
        return channels(types, bsdf.eval(context, interaction, interaction.to_local(mi.Vector3f(omega)), valid))

    for sun in lights.suns:
        omega = types.Array3f(*(dr.opaque(types.Float, v) for v in sun.omega_sun))
        share = through(omega)
        for c, value in enumerate(facing(omega)):
            total[c] += value * share * dr.opaque(types.Float, sun.irradiance[c])
    for environment, _ in lights.environments:
        omega, density = environment.sample(numbers.number(stratified.LIGHT_U), numbers.number(stratified.LIGHT_V))
        other = plain(types, bsdf.pdf(context, interaction, interaction.to_local(mi.Vector3f(omega)), valid))
        share = through(omega) / (density + other)
        for c, (value, light) in enumerate(zip(facing(omega), environment.radiance(omega), strict=True)):
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
        share = dr.select(drawn > 0, through(omega) * dr.select(smooth, 1, drawn / (drawn + environment.density(omega))), 0)
        for c, (value, light) in enumerate(zip(channels(types, weight), environment.radiance(omega), strict=True)):
            total[c] += value * light * share
    return [dr.select(plain(types, valid), value, 0) for value in total]
