"""Distances from the training data and errors to expect: against exact cases, and that a file's numbers are checked."""

from __future__ import annotations

import json

import numpy as np
import pytest
from deepclouds_training.calibrate import Judged, fitted, whitened

from deepclouds.descriptor import offsets
from deepclouds.model import AUX, LEVELS, POINTS, ModelMetadata, Trust, aux_inputs
from deepclouds.model.trust import FLOOR, LARGEST, SUMMARY, design, summaries


def trust(**changes: object) -> Trust:
    plain = {
        "mean": (0.0,) * SUMMARY,
        "whitening": tuple(tuple(row) for row in np.eye(SUMMARY).tolist()),
        "quantiles": {"0.5": 1.0, "0.99": 2.0},
        "coefficients": (-4.0, 1.5, -0.5, 0.0),
        "least": 0.05,
        "queries": 10,
        "labels": 20,
        "labels_hash": "f" * 64,
    }
    return Trust.model_validate({**plain, **changes})


def queries(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    stencil = (10 ** rng.uniform(-3, 1, (n, 1, 1)) * rng.random((n, LEVELS, POINTS))).astype(np.float32)
    return stencil, aux_inputs(rng.uniform(0, np.pi, n), rng.uniform(-0.3, 0.9, n), 0.0, 1.0, rng.uniform(0.5, 1, n), rng.exponential(5, n))


def test_summaries_are_the_documented_ones() -> None:
    stencil, aux = queries(5, 1)
    found = summaries(stencil, aux)
    assert found.shape == (5, SUMMARY)
    x, y, z = offsets().T
    ahead = (x == 0) & (y == 0) & (z > 0)
    assert ahead.sum() == 6
    for k in range(LEVELS):
        expected = [(stencil[:, k, chosen].mean(axis=1) * 2.0**k + 0.05) ** 0.25 for chosen in (np.ones(POINTS, bool), ahead)]
        np.testing.assert_allclose(found[:, 2 * k : 2 * k + 2].T, expected, rtol=1e-5)
    gamma, g, _, _, albedo, log1p_tau = aux.T.astype(np.float64)
    phase = (1 - g**2) / (1 + g**2 - 2 * g * np.cos(gamma)) ** 1.5
    np.testing.assert_allclose(found[:, 20], np.cos(gamma), atol=1e-6)
    np.testing.assert_allclose(found[:, 21], 0.25 * np.log(phase), atol=1e-5)
    np.testing.assert_allclose(found[:, 25], np.sqrt((1 - albedo) / (1 - albedo * g)), atol=1e-5)
    np.testing.assert_allclose(found[:, 26], 0.25 * log1p_tau, atol=1e-6)


def test_mirrored_stencils_are_as_far_away() -> None:
    """Mirroring across the plane of sun and view changes nothing in J, so that it must change nothing in what is expected of it."""
    stencil, aux = queries(6, 2)
    mirrored = stencil.reshape(6, LEVELS, 9, 5, 5)[..., ::-1].reshape(6, LEVELS, POINTS)
    np.testing.assert_allclose(trust().distance(mirrored, aux), trust().distance(stencil, aux), rtol=1e-5)


def test_whitened_data_are_at_distance_one_and_others_are_not() -> None:
    training = summaries(*queries(1500, 3))
    mean, whitening = whitened(training)
    one = trust(mean=tuple(mean.tolist()), whitening=tuple(map(tuple, whitening.tolist())))
    near = one.distance(*queries(500, 4))
    # Four of the inputs do not vary in these queries.
    assert 0.6 < np.sqrt(np.mean(near**2)) < 1.1
    stencil, aux = queries(500, 5)
    # Queries span four decades of density; these lie beyond.
    assert np.median(one.distance(1000 * stencil, aux)) > 2 * np.median(near)
    # A lobe that no query had.
    aux[:, 2] = 0.5
    assert one.distance(stencil, aux).min() > near.max()


def test_the_expected_error_rises_with_the_distance_and_stays_in_bounds() -> None:
    one = trust()
    distance = np.array([0.1, 1.0, 2.0, 4.0, 1e6])
    error = one.expected_error(distance, np.full(5, 1.0))
    assert error[0] == error[1]
    assert np.all(np.diff(error[1:]) > 0)
    assert error[-1] == LARGEST
    np.testing.assert_allclose(error[2], np.exp(0.5 * (-4 + 1.5 * np.log(2) - 0.5 * np.log(1 + FLOOR))), rtol=1e-6)
    # Brighter places have smaller relative errors, by these coefficients, down to the least.
    assert one.expected_error(np.ones(1), np.array([1e6]))[0] == 0.05


@pytest.mark.parametrize("seed", [6, 7])
def test_a_planted_law_is_found_under_the_noise_of_labels(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = 40_000
    distance, j = np.exp(rng.normal(0, 0.5, n)), np.exp(rng.normal(-1, 0.7, n))
    planted = np.array([-4.0, 1.2, -0.6, 0.0])
    expected = np.exp(0.5 * design(distance, j) @ planted)
    truth = j + expected * (j + FLOOR) * rng.normal(size=n)
    noise = 0.15 * j
    half_a, half_b = (truth + np.sqrt(2) * noise * rng.normal(size=n) for _ in range(2))
    judged = Judged(distance, j, half_a, half_b, noise, np.zeros(n, np.int64))
    found = np.exp(0.5 * design(distance, j) @ fitted(design(distance, j), judged))
    # The ends of the quadratic, where hardly a label lies, are known less well.
    assert np.quantile(np.abs(found / expected - 1), 0.99) < 0.08


def test_an_error_that_falls_with_the_distance_is_not_believed() -> None:
    rng = np.random.default_rng(8)
    n = 20_000
    distance, j = np.exp(rng.normal(0.5, 0.5, n)), np.ones(n)
    half = j + 0.3 / distance * rng.normal(size=n)
    judged = Judged(distance, j, half, half, np.full(n, 1e-3), np.zeros(n, np.int64))
    assert fitted(design(distance, j), judged)[1] == 0


def test_trust_survives_the_trip_and_other_versions_of_it_are_left_out() -> None:
    metadata = ModelMetadata(
        name="m",
        created_by="test",
        ranges={**{a.name: (0.0, 1.0) for a in AUX}, "tau": (0.0, 1.0)},
        config_hash="",
        dataset_hash="",
        metrics={},
        initialisers_sha256="",
        data="some clouds",
        size=(1.0, 300.0),
        trust=trust(),
    )
    properties = metadata.to_properties()
    assert ModelMetadata.from_properties(properties, "m.onnx") == metadata
    later = json.dumps({"version": "2", "another": "meaning"})
    assert ModelMetadata.from_properties({**properties, "deepclouds.trust": later}, "m.onnx").trust is None
    # A file from before there was any of this.
    old = {key: value for key, value in properties.items() if key not in ("deepclouds.trust", "deepclouds.size", "deepclouds.data")}
    assert ModelMetadata.from_properties(old, "m.onnx") == metadata.model_copy(update={"trust": None, "size": None, "data": ""})
    assert not {"deepclouds.trust", "deepclouds.size"} & set(ModelMetadata.from_properties(old, "m.onnx").to_properties())


@pytest.mark.parametrize(
    "change", [{"mean": (0.0, 1.0)}, {"whitening": ((1.0,),)}, {"quantiles": {"0.5": 1.0}}, {"coefficients": (0.0, 0.0, 0.0, float("nan"))}]
)
def test_damaged_numbers_are_refused(change: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=next(iter(change))):
        trust(**change)
