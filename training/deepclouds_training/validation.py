"""How far predictions are from noisy labels, free of the labels' own noise, by cloud family."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

RESAMPLES = 400
BLOCKS = 64


@dataclass(frozen=True)
class Figures:
    """Error of predictions over a set of samples, each figure with the ends of its 95 % bootstrap interval over clouds.

    Attributes
    ----------
    rrmse
        sqrt(mean((p - y)^2 - e^2)) / mean(y), e the label's standard error: the labels' noise drops out in expectation.
    squared
        mean((p - y)^2 - e^2) / mean(y)^2, the square of `rrmse` before it is kept from going negative: what to average over runs.
    relative
        sqrt(mean(((p - y)^2 - e^2) / (p + 0.05)^2)): every sample counts alike.
    energy
        sum(p) / sum(y) - 1.
    calibration_dark
        the same over the third of the samples with the smallest predictions: 0 where the prediction is the mean of what it stands for.
    """

    samples: int
    clouds: int
    rrmse: float
    rrmse_low: float
    rrmse_high: float
    squared: float
    relative: float
    energy: float
    energy_low: float
    energy_high: float
    calibration_dark: float

    def as_dict(self) -> dict[str, float]:
        """The figures by name."""
        return asdict(self)


def figures(
    prediction: NDArray[np.float32], label: NDArray[np.float32], error: NDArray[np.float32], cloud: NDArray[np.int64], seed: int = 0
) -> Figures:
    """Figures of `prediction` against noisy unbiased `label` with standard error `error`; all (n,), as is the `cloud` each came from.

    The interval resamples clouds, which differ more than samples of one cloud do; a single cloud is cut into random blocks instead.
    """
    p, y, e = (np.asarray(v, np.float64) for v in (prediction, label, error))
    rng = np.random.default_rng(seed)
    names, group = np.unique(cloud, return_inverse=True)
    clouds = len(names)
    if clouds == 1:
        group = rng.permutation(len(p)) % min(BLOCKS, len(p))
    squares = (p - y) ** 2 - e**2
    # Sorted into thirds by the prediction, which knows nothing of the label's noise: sorting by the label would bias the sums.
    dark = p <= np.quantile(p, 1 / 3)
    sums = np.stack([np.bincount(group, weights=v) for v in (np.ones_like(p), squares, p, y)])
    groups = sums.shape[1]
    picks = rng.multinomial(groups, np.full(groups, 1 / groups), size=RESAMPLES).astype(np.float64)
    resampled: NDArray[np.float64] = sums @ picks.T
    rrmse_low, rrmse_high = np.quantile(_rrmse(resampled), [0.025, 0.975])
    energy_low, energy_high = np.quantile(_energy(resampled), [0.025, 0.975])
    total = sums.sum(axis=1, keepdims=True)
    return Figures(
        samples=len(p),
        clouds=clouds,
        rrmse=float(_rrmse(total)[0]),
        rrmse_low=float(rrmse_low),
        rrmse_high=float(rrmse_high),
        squared=float(squares.mean() / max(float(y.mean()), 1e-12) ** 2),
        relative=float(np.sqrt(max(0.0, float(np.mean(squares / (p + 0.05) ** 2))))),
        energy=float(_energy(total)[0]),
        energy_low=float(energy_low),
        energy_high=float(energy_high),
        calibration_dark=float(_ratio(p[dark].sum(), y[dark].sum()) - 1),
    )


def figures_by_family(
    prediction: NDArray[np.float32],
    label: NDArray[np.float32],
    error: NDArray[np.float32],
    cloud: NDArray[np.int64],
    families: Mapping[int, str],
) -> dict[str, Figures]:
    """Figures of all samples under ``all`` and of every family of clouds under its name."""
    family = np.array([families[int(c)] for c in cloud])
    found = {"all": figures(prediction, label, error, cloud)}
    for name in sorted(set(families[int(c)] for c in np.unique(cloud))):
        mine = family == name
        found[name] = figures(prediction[mine], label[mine], error[mine], cloud[mine])
    return found


def energy_by_cloud(
    prediction: NDArray[np.float32], label: NDArray[np.float32], cloud: NDArray[np.int64]
) -> dict[int, tuple[float, float]]:
    """For every cloud sum(p) / sum(y) - 1 and its standard error (delta method)."""
    found = {}
    for number in np.unique(cloud):
        p, y = (v[cloud == number].astype(np.float64) for v in (prediction, label))
        ratio = _ratio(p.sum(), y.sum())
        spread = np.std(p - ratio * y) / np.sqrt(len(p))
        found[int(number)] = (float(ratio - 1), float(_ratio(spread, y.mean())))
    return found


def _rrmse(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    count, squares, _, y = sums
    value: NDArray[np.float64] = np.sqrt(np.maximum(0.0, squares / count)) / np.maximum(y / count, 1e-12)
    return value


def _energy(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    _, _, p, y = sums
    ratio: NDArray[np.float64] = p / np.maximum(y, 1e-12) - 1
    return ratio


def _ratio(a: float, b: float) -> float:
    return float(a / b) if b > 0 else 0.0
