"""Light of the cloud along camera rays: two short marches, a few shadow rays, and multiple scattering.

Multiple scattering is known already, and summed along the ray without any query; or, where several orders are kept exact or all are
path-traced, it is sampled at one collision of each ray.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import drjit as dr

from deepclouds_runtime import stratified
from deepclouds_runtime.frame_source import FrameSource
from deepclouds_runtime.march import OPAQUE, depths, gathered
from deepclouds_runtime.stratified import Stratified
from deepclouds_runtime.transport import (
    Cloud,
    CloudLight,
    Counts,
    Lights,
    opacity_of,
    scatter,
    scatter_on,
    scatter_paths,
    single_scattering,
    taker,
)


def fast_cloud_light(
    cloud: Cloud,
    lights: Lights,
    sources: Sequence[FrameSource],
    origin: Any,
    direction: Any,
    end: Any,
    numbers: Stratified,
    counts: Counts,
    count: int,
    sampled: bool = False,
) -> CloudLight:
    """Light that the cloud sends back along camera rays, and what it hides.

    Multiple scattering of `sources` is summed along the whole ray; single scattering is taken at `count` collisions, one in each equal
    share of what the ray's cloud hides.

    Parameters
    ----------
    cloud, lights
        the medium and what lights it.
    sources
        multiple scattering of this camera.
    origin, direction, end
        the rays, world units.
    numbers
        random numbers of the lanes.
    counts
        is updated.
    count
        collisions a ray.
    sampled
        whether the multiple scattering of the cloud's own `scattering`, past its `exact` orders, or of its `paths` is sampled at one of
        these collisions.
    """
    types, medium = cloud.field.types, cloud.field
    n, channels = dr.width(origin, direction, end), len(cloud.albedo)
    enter, leave = medium.intersect(origin, direction)
    meets = dr.minimum(leave, end) > enter
    dr.eval(origin, direction, end, meets)
    result = CloudLight(dr.zeros(types.Float, n), dr.full(types.Float, 1, n), dr.zeros(types.Float, n))
    result.direct = [dr.zeros(types.Float, n) for _ in range(channels)]
    result.indirect = [dr.zeros(types.Float, n) for _ in range(channels)]
    lanes: Any = dr.compress(meets)
    if len(lanes) == 0:
        return result
    o, d, e = map(taker(types, lanes), (origin, direction, end))
    own = numbers.take(lanes)
    octrees = [source.octree for source in sources]
    tau, sums = gathered(medium, octrees, o, d, e, own.number(stratified.PLACE), types.Bool(True))
    hidden = opacity_of(tau)
    indirect = [dr.zeros(types.Float, len(lanes)) for _ in range(channels)]
    for source, values in zip(sources, sums, strict=True):
        indirect = [a + b for a, b in zip(indirect, source.colours(values), strict=True)]
    dr.eval(hidden, tau, indirect, o, d, e)
    dr.scatter(result.opacity, hidden, lanes)
    dr.scatter(result.transmittance, dr.select(tau < OPAQUE, dr.exp(-tau), 0), lanes)
    for c in range(channels):
        dr.scatter(result.indirect[c], indirect[c], lanes)
    filled: Any = dr.compress(hidden > 0)
    counts.cloud_samples += len(filled)
    if len(filled) == 0:
        return result
    lanes = dr.gather(types.UInt32, lanes, filled)
    o, d, e, hidden = map(taker(types, filled), (o, d, e, hidden))
    own = own.take(filled)
    distance = depths(medium, o, d, e, hidden, own.number(stratified.SHARE), count, types.Bool(True))
    dr.eval(distance)
    dr.scatter(result.distance, dr.block_sum(distance, count) * (1 / count), lanes)
    if any(a > 0 for a in cloud.albedo):
        lane = dr.arange(types.UInt32, len(filled) * count) // dr.opaque(types.UInt32, count)
        take = taker(types, lane)
        w = take(d)
        points = dr.fma(w, distance, take(o))
        single = single_scattering(replace(cloud, scattering=None), lights, points, w, own.several(count))
        dr.eval(single)
        for c in range(channels):
            dr.scatter(result.direct[c], dr.block_sum(single[c], count) * hidden * (1 / count), lanes)
        if sampled and (cloud.scattering is not None or cloud.paths is not None):
            n = len(filled)
            many = dr.opaque(types.UInt32, count)
            slot = dr.minimum(types.UInt32(own.number(stratified.PLACE) * types.Float(many)), many - 1)
            place = dr.fma(d, dr.gather(types.Float, distance, dr.arange(types.UInt32, n) * many + slot), o)
            dr.eval(place)
            # Its single scattering is there already: all that is kept of it is what was scattered again.
            again = CloudLight(hidden, hidden, hidden)
            again.direct, again.indirect = ([dr.zeros(types.Float, n) for _ in range(channels)] for _ in range(2))
            go_on = scatter_paths if cloud.paths is not None else scatter_on if cloud.exact > 1 else scatter
            go_on(cloud, lights, place, d, hidden, types.Float(1), own, counts, dr.arange(types.UInt32, n), again)
            for c in range(channels):
                dr.scatter_add(result.indirect[c], again.indirect[c], lanes)
    return result
