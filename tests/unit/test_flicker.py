"""The measure of flicker: it finds what comes and goes, and nothing that stays or moves evenly."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.flicker import flicker

Frames = list[list[NDArray[np.float64]]]


def _moving(seed: int, noise: float) -> Frames:
    """Three triples of frames that brighten faster and faster, with independent noise."""
    rng = np.random.default_rng(seed)
    base = np.random.default_rng(99).uniform(0.5, 1.5, (3, 40, 40, 3))
    return [[b * (1 + 0.1 * k + 0.02 * k * k) + noise * rng.normal(size=b.shape) for k in range(3)] for b in base]


def test_independent_noise_flickers_by_itself() -> None:
    level = 1.12
    found = flicker(_moving(1, 0.05), _moving(2, 0.04), _moving(3, 0.04))
    assert found.pixel == pytest.approx(0.05 / level, rel=0.1)
    assert found.whole < 0.005
    # Half of what is left of the square of time, 0.02, of values whose square is 13 / 12 on average.
    assert found.real == pytest.approx(0.02 * np.sqrt(13 / 12 / 1.5) / level, rel=0.1)


def test_what_stays_or_moves_evenly_does_not_flicker() -> None:
    stays = np.random.default_rng(4).normal(scale=0.3, size=(40, 40, 3))
    wrong = [[image * 1.0 + stays * (1 + k) for k, image in enumerate(frames)] for frames in _moving(1, 0.0)]
    found = flicker(wrong, _moving(2, 0.01), _moving(3, 0.01))
    assert found.pixel < 0.002


def test_a_whole_image_that_flickers_is_found() -> None:
    wrong = [[image * (1.02 if k == 1 else 1.0) for k, image in enumerate(frames)] for frames in _moving(1, 0.0)]
    found = flicker(wrong, _moving(2, 0.01), _moving(3, 0.01))
    assert found.whole == pytest.approx(0.02 / np.sqrt(1.5), rel=0.03)
