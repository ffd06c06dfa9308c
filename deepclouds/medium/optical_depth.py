"""Optical depth along straight segments, by a jittered midpoint march with steps of half a voxel.

A trilinear field is smooth inside a cell, so the march errs far less than any tabulated transmittance; the jitter makes it unbiased
in tau. In a homogeneous box it is exact. Runs of steps in empty bricks are left out: they would add zeros.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from deepclouds.medium.field import Field

# exp(-TAU_OPAQUE) is below the last digit of a float32 sum of order 1.
TAU_OPAQUE = 20.0


@dr.syntax
def optical_depth(
    field: Field, origin: Any, direction: Any, start: Any, end: Any, jitter: Any, active: Any, opaque: float = TAU_OPAQUE
) -> Any:
    """Optical depth of the segments from `start` to `end` along rays, inside the box; a march stops once tau exceeds `opaque`.

    Parameters
    ----------
    field
        the extinction.
    origin, direction
        world points and unit vectors.
    start, end
        distances, world units; clipped to the box.
    jitter
        place of the sample inside each step, in [0, 1): 0.5 for the midpoint rule.
    active
        lanes to compute; the others return 0.
    """
    types = field.types
    first, steps, width, base, along = steps_along(field, origin, direction, start, end, active)
    tau = dr.zeros(types.Float, dr.width(steps))
    index = dr.zeros(types.Float, dr.width(steps))
    going = active & (steps > 0)
    while going:
        at = dr.fma(along, first + (index + jitter) * width, base)
        empty, step = empty_steps(field, at, base, along, first, width, index, jitter, going)
        tau += width * field.sigma_t_unit(at, going & ~empty)
        index += step
        going = going & (index < steps) & (tau < opaque)
    return tau


@dr.syntax
def distance_at(field: Field, origin: Any, direction: Any, start: Any, end: Any, jitter: Any, target: Any, active: Any) -> tuple[Any, Any]:
    """Distance at which the optical depth from `start` reaches `target`, by the march of `optical_depth` with the same jitter.

    Returns the distance and the extinction there (that of the march's step); with a target beyond the segment's optical depth the
    distance is that of its end.
    """
    types = field.types
    first, steps, width, base, along = steps_along(field, origin, direction, start, end, active)
    tau = dr.zeros(types.Float, dr.width(steps))
    index = dr.zeros(types.Float, dr.width(steps))
    found = first + dr.zeros(types.Float, dr.width(steps))
    density = dr.zeros(types.Float, dr.width(steps))
    going = active & (steps > 0)
    while going:
        near = first + index * width
        at = dr.fma(along, near + jitter * width, base)
        # A target that is reached already lies at the end of the first step.
        empty, step = empty_steps(field, at, base, along, first, width, index, jitter, going & (tau < target))
        sigma = field.sigma_t_unit(at, going & ~empty)
        reached = tau + width * sigma
        inside = reached >= target
        fraction = dr.select(inside & (sigma > 0), dr.clip((target - tau) / (sigma * width), 0, 1), dr.minimum(step, steps - index))
        found = dr.select(going, near + fraction * width, found)
        density = dr.select(going, sigma, density)
        tau = reached
        index += step
        going = going & (index < steps) & ~inside
    return found, density


@dr.syntax
def empty_steps(
    field: Field, at: Any, base: Any, along: Any, first: Any, width: Any, index: Any, jitter: Any, active: Any
) -> tuple[Any, Any]:
    """Whether step `index`, which reads `at`, lies in an empty brick, and the number of steps to the next that may read something.

    `base`, `along`, `first` and `width` are those of `steps_along`; a march that adds `step` to its index, and reads nothing where the
    brick is empty, sums the same values in the same order as one that takes every step.
    """
    types = field.types
    empty, step = types.Bool(False), types.Float(1)
    if dr.hint(field.majorants.any_empty, mode="scalar"):
        empty, radius = field.majorants.empty(at, active)
        if empty:
            end = field.majorants.end(at, radius, base, along)
            step = dr.maximum(dr.ceil((end - first) / width - jitter) - index, 1)
    return empty, step


def steps_along(field: Field, origin: Any, direction: Any, start: Any, end: Any, active: Any) -> tuple[Any, Any, Any, Any, Any]:
    """A segment inside the box in equal steps: where it starts, their number and width, and the ray in the unit cube's coordinates."""
    enter, leave = field.intersect(origin, direction)
    first = dr.maximum(enter, start)
    length = dr.select(active, dr.maximum(dr.minimum(leave, end) - first, 0), 0)
    steps = dr.ceil(length / dr.opaque(field.types.Float, field.step))
    return first, steps, length / dr.maximum(steps, 1), field.to_unit(origin), field.direction_to_unit(direction)
