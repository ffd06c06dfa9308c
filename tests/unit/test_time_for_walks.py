"""Rationale: under a time limit walks and samples share the seconds that are left; none should be of use to neither.

Expected behaviour: at least one sample a pixel fits in what walks leave; they get what wanted samples leave, within limits; no time is left
that is too short for another sample unless walks have their most.
"""

from __future__ import annotations

import numpy as np
import pytest
from deepclouds_runtime.audit import time_for_walks


def test_one_sample_always_fits() -> None:
    random = np.random.default_rng(3)
    for left, one, more in random.uniform(0.01, 10, (500, 3)):
        seconds = time_for_walks(left, one, one + more)
        if left > one:
            assert 0 < seconds <= 0.9 * (left - one) + 1e-9
        else:
            assert seconds <= 0


def test_what_is_too_short_for_a_sample_is_for_walks() -> None:
    # 0.65 of the 1.1 seconds beside a sample leave 1.285 for samples, of which one takes 0.9.
    assert time_for_walks(2.0, 0.9, 50.0) == pytest.approx(0.9 * 1.1)
    for left in np.linspace(1.0, 9.0, 33):
        seconds = time_for_walks(float(left), 0.7, 50.0)
        unused = (left - seconds) % 0.7
        assert min(unused, 0.7 - unused) < 1e-9 or seconds == pytest.approx(0.9 * (left - 0.7))


def test_walks_have_what_samples_leave() -> None:
    assert time_for_walks(10.0, 0.5, 2.0) == pytest.approx(8.0)
    assert time_for_walks(10.0, 0.5, 1.0) == pytest.approx(0.9 * 9.5)
