"""Optical depth along straight segments, exact but for rounding: the sum of a trilinear field's integrals over the cells of a ray.

Empty bricks are left out: they would add zeros.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from deepclouds.medium.cells import Cells
from deepclouds.medium.field import Field

# exp(-TAU_OPAQUE) is below the last digit of a float32 sum of order 1.
TAU_OPAQUE = 20.0


@dr.syntax
def optical_depth(field: Field, origin: Any, direction: Any, start: Any, end: Any, active: Any, opaque: float = TAU_OPAQUE) -> Any:
    """Optical depth of the segments from `start` to `end` along rays, inside the box; a sum stops once it exceeds `opaque`.

    Parameters
    ----------
    field
        the extinction.
    origin, direction
        world points and unit vectors.
    start, end
        distances, world units; clipped to the box.
    active
        lanes to compute; the others return 0.
    """
    types = field.types
    cells = Cells(field, origin, direction, start, end)
    distance, planes = cells.first + dr.zeros(types.Float, dr.width(origin, direction, active)), cells.planes(cells.first)
    tau = dr.zeros(types.Float, dr.width(distance))
    going = active & (distance < cells.last)
    while going:
        after, planes, empty = cells.step(distance, planes, going)
        first, second = cells.values(distance, after, going & ~empty)
        tau += 0.5 * (after - distance) * (first + second)
        distance = after
        going = going & (distance < cells.last) & (tau < opaque)
    return tau


@dr.syntax
def distance_at(field: Field, origin: Any, direction: Any, start: Any, end: Any, target: Any, active: Any) -> Any:
    """Distance at which the optical depth from `start` reaches `target`; with a target beyond the segment's, that of its end."""
    types = field.types
    cells = Cells(field, origin, direction, start, end)
    distance, planes = cells.first + dr.zeros(types.Float, dr.width(origin, direction, target, active)), cells.planes(cells.first)
    near, far = types.Float(distance), types.Float(distance)
    tau, before = dr.zeros(types.Float, dr.width(distance)), dr.zeros(types.Float, dr.width(distance))
    going = active & (distance < cells.last)
    while going:
        after, planes, empty = cells.step(distance, planes, going)
        first, second = cells.values(distance, after, going & ~empty)
        near, far, before = distance, after, tau
        tau = tau + 0.5 * (after - distance) * (first + second)
        distance = after
        going = going & (distance < cells.last) & (tau < target)
    return cells.within(near, far, dr.maximum(target - before, 0), active)
