"""Figures of predictions against noisy labels: what noise must not change, and what errors must show."""

from __future__ import annotations

import numpy as np
from deepclouds_training.evaluate import Labels, noise_free, percentiles


def made_up(prediction: float, noise: float, seed: int, clouds: int = 20, each: int = 400) -> Labels:
    """Labels of truths between 0.5 and 2; predictions are the truth times `prediction`."""
    rng = np.random.default_rng(seed)
    n = clouds * each
    truth = rng.uniform(0.5, 2.0, n)
    half_a, half_b = (truth * (1 + noise * np.sqrt(2) * rng.standard_normal(n)) for _ in range(2))
    other = np.zeros(n)
    return Labels(
        truth * prediction,
        half_a,
        half_b,
        noise * truth,
        np.repeat(np.arange(clouds), each),
        np.full(n, 1.25),
        np.full(n, "plume"),
        other,
        other,
        other,
        other,
        other,
    )


def test_noise_of_the_labels_drops_out_of_the_error() -> None:
    """A perfect prediction scores about 0 and one that is 10 % too bright about 10 %, whatever the noise."""
    expected = 0.1 * np.sqrt(np.mean(np.linspace(0.5, 2, 10001) ** 2)) / 1.25
    for noise in (0.02, 0.3):
        right, bright = noise_free(made_up(1.0, noise, 1)), noise_free(made_up(1.1, noise, 2))
        assert right["rRMSE"].value < 0.05
        assert right["energy"].low < 0.005
        assert right["energy"].high > -0.005
        assert abs(bright["rRMSE"].value - expected) < 0.03
        assert abs(bright["energy"].value - 0.1) < 0.02
        assert bright["energy"].low > 0.05


def test_percentiles_take_converged_labels_alone() -> None:
    found = percentiles(made_up(1.1, 0.01, 3))
    assert abs(found["median"].value - 0.1) < 0.01
    assert found["median"].low <= found["median"].value <= found["median"].high
    assert abs(found["noise"].value - 0.01) < 1e-3
    assert "median" not in percentiles(made_up(1.1, 0.2, 4))


def test_dark_labels_are_judged_by_their_absolute_error() -> None:
    labels = made_up(1.0, 0.01, 5)
    dark = Labels(
        **{**vars(labels), "half_a": labels.half_a * 1e-4, "half_b": labels.half_b * 1e-4, "prediction": labels.prediction * 0 + 0.0125}
    )
    found = percentiles(dark)
    assert set(found) == {"dark"}
    assert abs(found["dark"].value - 0.01) < 2e-4
