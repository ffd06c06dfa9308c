"""Rationale: three corrections are made of the same walks, and share what is known of where these began.

Expected behaviour: what is shared belongs to the walks that there are: after more of them a correction is that of all; sums of halved cells
are those of the cells in them, and a correction finds a smooth error where it is.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from deepclouds_runtime.correction import GROUPS, Correction, Sums
from numpy.typing import NDArray

Array = NDArray[Any]
LOWER, UPPER = np.array([-1.0, 0.0, 2.0]), np.array([1.0, 0.5, 3.5])


def wrong_by(points: Array) -> Array:
    """What walks find more than the prediction of 1, in two channels (n, 2)."""
    return np.stack([0.3 * points[:, 0], np.full(len(points), -0.2)], axis=1)


def walks(n: int, seed: int) -> tuple[Array, Array, Array, Array, NDArray[np.int64]]:
    rng = np.random.default_rng(seed)
    points = rng.uniform(LOWER, UPPER, (n, 3))
    predicted = np.ones((n, 2))
    walked = (predicted + wrong_by(points)) * rng.exponential(size=(n, 1))
    return points, np.ones(n), predicted, walked, np.arange(n) % GROUPS


def sums_of(*seeds: int, between: bool = False) -> Sums:
    sums = Sums(LOWER, UPPER, np.array([0.02, 0.02]))
    for seed in seeds:
        sums.add(*walks(60_000, seed))
        if between:
            Correction(sums)
    return sums


def test_corrections_are_of_all_walks_that_there_are() -> None:
    points = walks(500, 9)[0]
    for halves in (((0, 1), (2, 3)), ((2,), (3,))):
        one, other = (Correction(sums_of(1, 2, between=between), halves)(points) for between in (False, True))
        np.testing.assert_array_equal(one, other)
    assert np.abs(Correction(sums_of(1))(points) - one).max() > 1e-3


def test_a_smooth_error_is_found_where_it_is() -> None:
    points = walks(500, 9)[0]
    found = Correction(sums_of(1, 2, 3))(points)
    assert np.sqrt(np.mean((found * 1.02 - wrong_by(points)) ** 2)) < 0.03


@pytest.mark.parametrize("times", range(6))
def test_halved_cells_hold_what_is_in_them(times: int) -> None:
    sums = sums_of(1)
    lattices = sums.lattices()
    values: Array = sums.residual[:, :, lattices.filled]
    for k in range(times + 1):
        values = lattices.halved(values, k)
    size = np.array([64, 16, 48])
    numbers = np.stack(np.unravel_index(lattices.filled, tuple(size))) >> (times + 1)
    keys, into = np.unique(np.ravel_multi_index(tuple(numbers), (64, 64, 64)), return_inverse=True)
    assert values.shape == (GROUPS, 2, len(keys))
    for g in range(GROUPS):
        for c in range(2):
            np.testing.assert_allclose(values[g, c], np.bincount(into, sums.residual[g, c, lattices.filled]), rtol=1e-9, atol=1e-9)
