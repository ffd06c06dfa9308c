"""Marches of the fast mode: one that adds up a known source along rays, and one that finds several depths at once.

Both walk the steps of `deepclouds.medium.optical_depth` with its jitter and leave out empty bricks as it does, so that their optical
depths are its own.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from deepclouds.medium.field import Field
from deepclouds.medium.optical_depth import empty_steps, steps_along
from deepclouds_runtime.octree import DeviceOctree
from deepclouds_runtime.transport import depth_of

# The share of light that is left behind this depth is below a float32's digits of what came before it.
_OPAQUE = 16.0


@dr.syntax
def gathered(
    field: Field, sources: list[DeviceOctree], origin: Any, direction: Any, end: Any, jitter: Any, place: Any, active: Any
) -> tuple[Any, list[list[Any]]]:
    """Optical depth of rays and the integrals of sources along them, ``int T sigma_t source dt``: a list of one Float a field for each.

    Parameters
    ----------
    field
        the extinction.
    sources
        what is added up.
    origin, direction, end
        the rays, world units; `end` is a distance.
    jitter
        place of the extinction's sample in each step, in [0, 1).
    place
        which of the collisions in a step stands for all of them, in [0, 1).
    active
        lanes to compute; the others return 0.
    """
    types = field.types
    first, steps, width, base, along = steps_along(field, origin, direction, types.Float(0), end, active)
    starts, aheads = [s.to_local(origin) for s in sources], [s.direction_to_local(direction) for s in sources]
    tau = dr.zeros(types.Float, dr.width(steps))
    index = dr.zeros(types.Float, dr.width(steps))
    sums = [[dr.zeros(types.Float, dr.width(steps)) for _ in range(source.fields)] for source in sources]
    going = active & (steps > 0)
    while going:
        near = first + index * width
        at = dr.fma(along, near + jitter * width, base)
        empty, leap = empty_steps(field, at, base, along, first, width, index, jitter, going)
        sigma = field.sigma_t_unit(at, going & ~empty)
        filled = going & (sigma > 0)
        step = sigma * width
        hidden = dr.select(step < 1e-2, step * (1 - 0.5 * step), 1 - dr.exp(-step))
        # A collision inside the step, drawn from what the step hides; where it hides little that is `place` itself.
        offset = dr.select(step < 1e-2, place, -dr.log(dr.maximum(1 - place * hidden, 1e-30)) / dr.maximum(step, 1e-20))
        share = dr.exp(-tau) * hidden
        distance = near + dr.minimum(offset, 1) * width
        for i in range(len(sources)):
            values = sources[i].lookup(dr.fma(aheads[i], distance, starts[i]), filled)
            for k in range(len(values)):
                sums[i][k] += dr.select(filled, share * values[k], 0)
        tau += step
        index += leap
        going = going & (index < steps) & (tau < _OPAQUE)
    return tau, sums


@dr.syntax
def depths(field: Field, origin: Any, direction: Any, end: Any, jitter: Any, hidden: Any, shift: Any, count: int, active: Any) -> Any:
    """Distances of `count` collisions a ray, one in each equal share of what the ray's cloud hides.

    Parameters
    ----------
    hidden
        Float: ``1 - exp(-tau)`` of the rays' optical depth up to `end`, from the march with the same `jitter`.
    shift
        Float in [0, 1): where in its share each collision lies.

    Returns
    -------
    Float of ``n * count`` distances, those of a ray together; rays that are not `active` give 0.
    """
    types = field.types
    n = dr.width(origin, direction)
    first, steps, width, base, along = steps_along(field, origin, direction, types.Float(0), end, active)
    found = dr.zeros(types.Float, n * count)
    many = dr.opaque(types.Float, count)
    slot = dr.arange(types.UInt32, n) * dr.opaque(types.UInt32, count)
    last = slot + dr.opaque(types.UInt32, count)
    tau = dr.zeros(types.Float, n)
    index = dr.zeros(types.Float, n)
    asked = shift + dr.zeros(types.Float, n)
    target = depth_of(asked / many * hidden)
    going = active & (steps > 0)
    while going:
        near = first + index * width
        at = dr.fma(along, near + jitter * width, base)
        # A target that is reached already lies at the end of the first step.
        empty, leap = empty_steps(field, at, base, along, first, width, index, jitter, going & (tau < target))
        sigma = field.sigma_t_unit(at, going & ~empty)
        reached = tau + width * sigma
        # The end of the ray holds what rounding left over.
        left = steps - index
        inside = going & ((reached >= target) | (leap >= left))
        fraction = dr.select(sigma > 0, dr.clip((target - tau) / dr.maximum(sigma * width, 1e-30), 0, 1), dr.minimum(leap, left))
        dr.scatter(found, near + fraction * width, slot, inside)
        # A step may hold several collisions: it is left when the next one lies beyond it.
        if inside:
            slot += 1
            asked += 1
            target = depth_of(asked / many * hidden)
        else:
            tau = reached
            index += leap
        going = going & (slot < last) & (index < steps)
    return found
