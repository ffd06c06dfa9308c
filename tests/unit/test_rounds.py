"""Rationale: a time limit is kept by what rounds of samples are seen to take, and by what makes an image of them, which follows each.

Expected behaviour: with a clock of our own no round ends later than it may, whether a sample or the image costs the most, and no time is
left in which another sample would have fitted.
"""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from deepclouds_runtime import rounds
from deepclouds_runtime.rounds import Watch, fixed_rounds, rounds_for_error


class Timed:
    """A frame whose samples and images take known times; an image is made anew only after samples."""

    def __init__(self, sample: float, image: float) -> None:
        self.now, self.samples, self.sample, self.image = 0.0, 0, sample, image
        self.film, self._made = SimpleNamespace(beauty=self._beauty), False

    def _beauty(self) -> Any:
        self.now += 0 if self._made else self.image
        self._made = True
        return np.zeros((1, 3))

    def round(self, first: int, samples: int, *more: Any) -> bool:
        """Take samples."""
        self.samples, self._made = first + samples, False
        self.now += self.sample * samples
        return False

    def settle(self, *what: Any, **how: Any) -> tuple[float, float]:
        """Make the image, and never be content."""
        self._beauty()
        return 1.0, 2.0


def nobody(noise: float) -> Any:
    """Is never asked for an image so far: nobody watches."""
    raise AssertionError(noise)


@pytest.mark.parametrize("fixed", [False, True])
@pytest.mark.parametrize(("sample", "image"), [(0.1, 0.0), (0.1, 0.01), (0.1, 0.4), (0.3, 0.3), (0.01, 0.5)])
def test_rounds_and_the_image_end_in_time(monkeypatch: pytest.MonkeyPatch, sample: float, image: float, fixed: bool) -> None:
    frame: Any = Timed(sample, image)
    monkeypatch.setattr(rounds, "time", SimpleNamespace(perf_counter=lambda: frame.now))
    end = 3.0
    if fixed:
        fixed_rounds(frame, 1 << 20, 0.02, Watch(), nobody, None, end)
    else:
        rounds_for_error(frame, 1 << 20, None, 0.02, end, True, Watch(), nobody)
    frame.film.beauty()
    assert frame.samples >= 1
    assert frame.now <= end + 1e-9
    assert end - frame.now < sample + image + 1e-9


def test_one_sample_there_is_in_any_case(monkeypatch: pytest.MonkeyPatch) -> None:
    frame: Any = Timed(5.0, 1.0)
    monkeypatch.setattr(rounds, "time", SimpleNamespace(perf_counter=lambda: frame.now))
    rounds_for_error(frame, 64, None, 0.02, 3.0, True, Watch(), nobody)
    assert frame.samples == 1
    assert math.isclose(frame.now, 6.0)
