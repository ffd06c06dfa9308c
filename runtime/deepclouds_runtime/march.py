"""Marches of the fast mode: one that adds up a known source along rays, and one that finds several depths at once.

Both cross the cells of `deepclouds.medium.optical_depth`, so that their optical depths are its own.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from deepclouds.medium.cells import Cells, linear_place
from deepclouds.medium.field import Field
from deepclouds_runtime.octree import DeviceOctree
from deepclouds_runtime.transport import depth_of, opacity_of, taker

# The share of light that is left behind this depth is below a float32's digits of what came before it. Nothing is seen through it: what
# lies behind may be a sun.
OPAQUE = 16.0


@dr.syntax
def gathered(
    field: Field, sources: list[DeviceOctree], origin: Any, direction: Any, end: Any, place: Any, active: Any
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
    place
        which of the collisions in a cell stands for all of them, in [0, 1).
    active
        lanes to compute; the others return 0.
    """
    types = field.types
    cells = Cells(field, origin, direction, types.Float(0), end)
    starts, aheads = [s.to_local(origin) for s in sources], [s.direction_to_local(direction) for s in sources]
    distance, planes = cells.first + dr.zeros(types.Float, dr.width(origin, direction)), cells.planes(cells.first)
    tau = dr.zeros(types.Float, dr.width(distance))
    sums = [[dr.zeros(types.Float, dr.width(distance)) for _ in range(source.fields)] for source in sources]
    going = active & (distance < cells.last)
    while going:
        after, planes, empty = cells.step(distance, planes, going)
        width = after - distance
        first, second = cells.values(distance, after, going & ~empty)
        depth = 0.5 * width * (first + second)
        filled = going & (depth > 0)
        hidden = opacity_of(depth)
        # A collision inside the cell, drawn from what the cell hides.
        inside = linear_place(first * width, second * width, depth_of(place * hidden))
        share = dr.exp(-tau) * hidden
        at = dr.fma(inside, width, distance)
        for i in range(len(sources)):
            values = sources[i].lookup(dr.fma(aheads[i], at, starts[i]), filled)
            for k in range(len(values)):
                sums[i][k] += dr.select(filled, share * values[k], 0)
        tau += depth
        distance = after
        going = going & (distance < cells.last) & (tau < OPAQUE)
    return tau, sums


@dr.syntax
def depths(field: Field, origin: Any, direction: Any, end: Any, hidden: Any, shift: Any, count: int, active: Any) -> Any:
    """Distances of `count` collisions a ray, one in each equal share of what the ray's cloud hides.

    Parameters
    ----------
    hidden
        Float: ``1 - exp(-tau)`` of the rays' optical depth up to `end`.
    shift
        Float in [0, 1): where in its share each collision lies.

    Returns
    -------
    Float of ``n * count`` distances, those of a ray together; rays that are not `active` give 0.
    """
    types = field.types
    n = dr.width(origin, direction)
    cells = Cells(field, origin, direction, types.Float(0), end)
    # Of the cell that holds each collision: where it begins and ends, and the optical depth in it before the collision.
    near, far, depth = (dr.zeros(types.Float, n * count) for _ in range(3))
    many = dr.opaque(types.Float, count)
    slot = dr.arange(types.UInt32, n) * dr.opaque(types.UInt32, count)
    last = slot + dr.opaque(types.UInt32, count)
    distance, planes = cells.first + dr.zeros(types.Float, n), cells.planes(cells.first)
    tau = dr.zeros(types.Float, n)
    asked = shift + dr.zeros(types.Float, n)
    target = depth_of(asked / many * hidden)
    going = active & (distance < cells.last)
    while going:
        after, planes, empty = cells.step(distance, planes, going)
        first, second = cells.values(distance, after, going & ~empty)
        reached = tau + 0.5 * (after - distance) * (first + second)
        # A cell may hold several collisions; the end of the ray holds what rounding left over.
        found = going & ((reached >= target) | (after >= cells.last))
        while found:
            dr.scatter(near, distance, slot, found)
            dr.scatter(far, after, slot, found)
            dr.scatter(depth, dr.maximum(target - tau, 0), slot, found)
            slot += 1
            asked += 1
            target = depth_of(asked / many * hidden)
            found = found & (slot < last) & ((reached >= target) | (after >= cells.last))
        tau = reached
        distance = after
        going = going & (slot < last) & (distance < cells.last)
    dr.eval(near, far, depth)
    ray = dr.arange(types.UInt32, n * count) // dr.opaque(types.UInt32, count)
    take = taker(types, ray)
    return Cells(field, take(origin), take(direction), types.Float(0), take(end)).within(near, far, depth, types.Bool(True))
