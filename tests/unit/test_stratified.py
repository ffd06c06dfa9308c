"""Rationale: every number is uniform by itself, however many samples of a pixel have been taken, or its integral is wrong by as much.

Expected behaviour: so are those of the first samples where nobody knows how many there will be; where it is known, depths are stratified.
"""

from __future__ import annotations

import numpy as np
import pytest
from deepclouds_runtime.stratified import DEPTH, PIXEL_X, SURFACE_W, Stratified

from deepclouds.backend import backend

types = backend("llvm")
PIXELS = 20_000


def numbers(dimension: int, sample: int, count: int) -> np.ndarray:
    pixel = types.UInt32(np.arange(PIXELS, dtype=np.uint32))
    return np.array(Stratified(types, pixel, types.UInt32(sample), types.UInt32(count), types.UInt32(7)).number(dimension), np.float64)


@pytest.mark.parametrize("dimension", [DEPTH, PIXEL_X, SURFACE_W])
def test_the_first_of_any_number_of_samples_are_uniform(dimension: int) -> None:
    for sample in (0, 1, 5):
        parts = np.histogram(numbers(dimension, sample, 0), 10, (0, 1))[0]
        # Five standard deviations of a tenth of them.
        assert np.abs(parts - PIXELS / 10).max() < 5 * (PIXELS * 0.1 * 0.9) ** 0.5
    two = numbers(dimension, 0, 0), numbers(dimension, 1, 0)
    apart = (two[1] - two[0]) % 1
    assert np.ptp(apart) < 1e-5
    assert 0.2 < apart.mean() < 0.8


def test_depths_of_a_known_number_of_samples_lie_one_in_each_share() -> None:
    for sample in range(4):
        found = numbers(DEPTH, sample, 4)
        assert sample / 4 <= found.min()
        assert found.max() <= (sample + 1) / 4
