"""The figures of the validation are free of the labels' noise, and their intervals hold."""

from __future__ import annotations

import numpy as np
import pytest
from deepclouds_training.validation import energy_by_cloud, figures, figures_by_family
from numpy.typing import NDArray

WALKS = 16


def noisy(truth: NDArray[np.float64], rng: np.random.Generator) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Means of 16 exponential draws around `truth` and their standard errors: relative noise 1/4, skewed."""
    draws = truth[:, None] * rng.exponential(1.0, (len(truth), WALKS))
    return draws.mean(axis=1).astype(np.float32), (draws.std(axis=1, ddof=1) / np.sqrt(WALKS)).astype(np.float32)


@pytest.mark.parametrize("wrong", [0.0, 0.05, 0.3])
def test_rrmse_is_that_of_the_prediction_not_of_the_labels(wrong: float) -> None:
    rng = np.random.default_rng(11)
    truth = rng.uniform(0.2, 2.0, 200_000)
    prediction = truth * (1 + wrong * rng.choice([-1.0, 1.0], len(truth)))
    label, error = noisy(truth, rng)
    found = figures(prediction.astype(np.float32), label, error, np.arange(len(truth)) // 1000)
    exact = wrong * np.sqrt(np.mean(truth**2)) / truth.mean()
    # Noise of 27 % of the mean would show as such; what is left of it after 200,000 samples is below 2.5 %.
    assert found.rrmse == pytest.approx(exact, abs=0.025 if wrong == 0 else 0.01)
    assert found.rrmse_low <= found.rrmse <= found.rrmse_high
    assert abs(found.energy) < 0.005
    # Predictions that scatter around the truth are too small where they are smallest: not calibrated, though right on average.
    assert found.calibration_dark < -0.1 if wrong == 0.3 else abs(found.calibration_dark) < 0.02


def test_interval_of_the_energy_covers_the_truth() -> None:
    covered, excluded = 0, 0
    for seed in range(120):
        rng = np.random.default_rng([3, seed])
        cloud = np.repeat(np.arange(24), 50)
        truth = rng.uniform(0.2, 2.0, len(cloud))
        of_cloud = rng.normal(1.0, 0.1, 24)
        label, error = noisy(truth, rng)
        found = figures((truth * of_cloud[cloud]).astype(np.float32), label, error, cloud, seed)
        covered += found.energy_low <= 0 <= found.energy_high
        found = figures((truth * 1.3 * of_cloud[cloud]).astype(np.float32), label, error, cloud, seed)
        excluded += found.energy_low > 0
    # A 95 % bootstrap interval over 24 clouds covers a little less; a prediction 30 % too bright must not slip through.
    assert 0.85 * 120 <= covered < 120
    assert excluded == 120


def test_families_and_clouds_are_told_apart() -> None:
    rng = np.random.default_rng(2)
    cloud = np.repeat(np.array([4, 7, 9], np.int64), 400)
    truth = rng.uniform(0.5, 1.5, len(cloud))
    label, error = noisy(truth, rng)
    prediction = (truth * np.where(cloud == 9, 2.0, 1.0)).astype(np.float32)
    found = figures_by_family(prediction, label, error, cloud, {4: "ball", 7: "ball", 9: "slab"})
    assert set(found) == {"all", "ball", "slab"}
    assert (found["ball"].clouds, found["slab"].clouds, found["all"].samples) == (2, 1, 1200)
    assert found["slab"].energy == pytest.approx(1.0, abs=0.1)
    assert abs(found["ball"].energy) < 0.05
    for number, (energy, spread) in energy_by_cloud(prediction, label, cloud).items():
        assert abs(energy - (1.0 if number == 9 else 0.0)) < 4 * spread < 0.2
