"""Elementary functions of small ranges against NumPy's in float64."""

from __future__ import annotations

import numpy as np

from deepclouds.backend import backend
from deepclouds.medium.elementary import circle, log_of_share, whole


def test_circle() -> None:
    u = np.concatenate([np.linspace(0, 1, 100_001), [0.25, 0.5, 0.75, np.nextafter(np.float32(1), 0)]]).astype(np.float32)
    cosine, sine = (np.array(v, np.float64) for v in circle(backend().Float(u)))
    angle = 2 * np.pi * u.astype(np.float64)
    np.testing.assert_allclose(cosine, np.cos(angle), atol=3e-7)
    np.testing.assert_allclose(sine, np.sin(angle), atol=3e-7)


def test_logarithm_of_a_share() -> None:
    # All that a random number of 24 bits leaves of 1, and much smaller ones.
    steps = np.concatenate([np.arange(1, 2**16), 2**24 - np.arange(2**16), np.random.default_rng(3).integers(1, 2**24, 200_000)])
    v = np.concatenate([steps / 2**24, np.geomspace(1e-37, 1, 1000)]).astype(np.float32)
    found = np.array(log_of_share(backend(), backend().Float(v)), np.float64)
    np.testing.assert_allclose(found, np.log(v.astype(np.float64)), rtol=4e-7)
    assert np.all(found[v == 1] == 0)


def test_whole_numbers_are_rounded_down() -> None:
    v = np.array([0, 0.25, 0.999, 1, 7.5, 2**23 + 1, 2**30], np.float32)
    np.testing.assert_array_equal(np.array(whole(backend(), backend().Float(v))), np.floor(v).astype(np.uint32))
