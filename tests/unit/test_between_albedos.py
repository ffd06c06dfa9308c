"""Rationale: a cloud of three albedos needs the network for two of them: between these the logarithm of J lies at one place.

Expected behaviour: what is made of two is what paths of known lengths give, within a fiftieth; queries that tell otherwise have all albedos
asked for; places without light stay dark; of one or two albedos nothing is learned or changed.
"""

from __future__ import annotations

import numpy as np
import pytest
from deepclouds_runtime.between_albedos import BetweenAlbedos


def _of_paths(albedos: list[float], lengths: np.ndarray) -> np.ndarray:
    """J at points whose light was scattered a number of times that is geometrically distributed about a mean length."""
    stay = 1 - 1 / lengths[:, None]
    return (1 - stay) / (1 - np.array(albedos) * stay)


def test_the_middle_of_three_is_made_of_two() -> None:
    albedos, random = [0.8, 0.92, 0.99], np.random.default_rng(1)
    lengths = 8 * random.uniform(0.7, 1.4, 4000)
    j = (_of_paths(albedos, lengths) * random.gamma(2.0, 1.0, (4000, 1))).astype(np.float32)
    between = BetweenAlbedos(albedos)
    assert between.asked == albedos
    assert not between.learned
    between.learn(j[:500])
    assert between.learned
    assert between.asked == [0.8, 0.99]
    found, _ = between.filled(j[:, [0, 2]], np.zeros((4000, 2), np.float32))
    assert found.shape == j.shape
    np.testing.assert_allclose(found[:, [0, 2]], j[:, [0, 2]], rtol=1e-5)
    error = found[:, 1] / j[:, 1] - 1
    assert 1e-4 < np.sqrt(np.mean(error**2)) < 0.02


def test_queries_that_tell_otherwise_have_all_asked_for() -> None:
    random = np.random.default_rng(2)
    between = BetweenAlbedos([0.5, 0.7, 0.9, 0.99])
    between.learn(random.gamma(2.0, 1.0, (500, 4)).astype(np.float32))
    assert between.learned
    assert between.asked == [0.5, 0.7, 0.9, 0.99]
    j, errors = random.random((2, 10, 4))
    assert all(a is b for a, b in zip(between.filled(j, errors), (j, errors), strict=True))


def test_where_no_light_comes_none_is_made() -> None:
    between = BetweenAlbedos([0.8, 0.9, 0.99])
    between.learn(np.array([[1.0, 1.5, 2.0], [2.0, 3.0, 4.0]], np.float32))
    j, errors = between.filled(np.array([[0.0, 0.0], [1.0, 2.0]], np.float32), np.array([[0.1, 0.2], [0.3, 0.5]], np.float32))
    assert np.all(j[0] < 1e-25)
    assert j[1, 1] == pytest.approx(1.5, rel=1e-4)
    assert np.all((errors[:, 1] > errors[:, 0]) & (errors[:, 1] < errors[:, 2]))


def test_nothing_is_learned_of_a_dark_cloud() -> None:
    between = BetweenAlbedos([0.8, 0.9, 0.99])
    between.learn(np.zeros((20, 3), np.float32))
    assert between.learned
    assert between.asked == [0.8, 0.9, 0.99]


@pytest.mark.parametrize("albedos", [[0.9], [0.5, 0.9]])
def test_of_two_albedos_both_are_asked_for(albedos: list[float]) -> None:
    between = BetweenAlbedos(albedos)
    assert between.learned
    assert between.asked == albedos
