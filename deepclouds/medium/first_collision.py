"""Where rays first collide: delta tracking with local majorants."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepclouds.backend import rows, vectors_of
from deepclouds.medium.field import Field


def first_collisions(
    field: Field, origins: NDArray[np.float32], directions: NDArray[np.float32], seed: int
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Draw the first collision of every ray.

    Parameters
    ----------
    field
        the extinction.
    origins, directions
        (n, 3) world points and unit vectors.
    seed
        of the random stream; ray i draws from stream i.

    Returns
    -------
    points
        (n, 3) world points of the collisions; the origin where there is none.
    hit
        (n,) whether the ray collided.

    Notes
    -----
    Woodcock et al. 1965. The probability of no collision is exp(-tau) exactly.
    """
    types = field.types
    n = len(origins)
    if n == 0 or field.majorant == 0.0:
        return np.array(origins, np.float32), np.zeros(n, np.bool_)
    o, d = vectors_of(types, origins), vectors_of(types, directions)
    key = dr.opaque(types.UInt64, int(np.random.SeedSequence(seed).generate_state(1, np.uint64)[0]))
    distance, hit = _track(field, o, d, types.PCG32(n, initstate=key))
    points = dr.fma(d, dr.select(hit, distance, 0), o)
    dr.eval(points, hit)
    return rows(points), np.array(hit)


@dr.syntax
def _track(field: Field, origin: Any, direction: Any, rng: Any) -> tuple[Any, Any]:
    types = field.types
    enter, leave = field.intersect(origin, direction)
    start, along = dr.clip(field.to_unit(dr.fma(direction, enter, origin)), 0, 1), field.direction_to_unit(direction)
    going = leave > enter
    distance = dr.zeros(types.Float, dr.width(enter))
    hit = dr.zeros(types.Bool, dr.width(enter))
    while going:
        distance, tentative, mean_path = field.majorants.step(start, along, distance, rng.next_float32(), going)
        unit = dr.fma(along, distance, start)
        inside = field.holds_unit(unit)
        hit = inside & tentative & (rng.next_float32() < field.sigma_t_unit(unit, inside & tentative) * mean_path)
        going = inside & ~hit
    return enter + distance, hit
