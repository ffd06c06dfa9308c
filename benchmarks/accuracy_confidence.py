"""Whether a model knows when not to be trusted: the error it expects of its predictions against the error that labels show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from deepclouds_runtime.predictor import Predictor
from deepclouds_training.calibrate import Judged, judge
from deepclouds_training.shards import open_dataset

from benchmarks.accuracy_figures import Figure, Floats, Row, bootstrap

DECILES = 10
# A single label's squared relative error counts for no more: in deep shade a prediction may be off by any factor.
_MOST_SQUARED = 9.0


@dataclass(frozen=True)
class Decile:
    """A tenth of the labels: mean distance from the training data, the error expected of them, and the error found, with its interval."""

    distance: float
    expected: float
    found: Figure


@dataclass(frozen=True)
class ConfidenceResult:
    """Labels of one data set by tenths of the error expected of them, and by tenths of their distance from the training data."""

    name: str
    by_expected: list[Decile]
    by_distance: list[Decile]

    @property
    def rows(self) -> list[Row]:
        """One a decile, of both kinds."""
        return [
            Row(
                "confidence",
                f"{self.name}, tenth {k + 1} by {kind}",
                {"distance": Figure(d.distance, d.distance, d.distance, percent=False), "expected": _exact(d.expected), "found": d.found},
            )
            for kind, deciles in (("expected error", self.by_expected), ("distance", self.by_distance))
            for k, d in enumerate(deciles)
        ]


def _exact(value: float) -> Figure:
    return Figure(value, value, value)


def measure_confidence(folder: Path, predictor: Predictor) -> ConfidenceResult | None:
    """Hold the errors that the model expects against those over the labels of a data set's held-out clouds; None where it expects none."""
    trust = predictor.metadata.trust
    if trust is None:
        return None
    judged = judge(predictor.path.read_bytes(), trust, open_dataset(folder))
    expected = trust.expected_error(judged.distance, judged.prediction)
    return ConfidenceResult(folder.name, tenths(judged, expected, expected), tenths(judged, expected, judged.distance))


def tenths(judged: Judged, expected: Floats, order: Floats) -> list[Decile]:
    """Labels sorted by `order` (n,) and cut into tenths; intervals are over clouds."""
    place = np.argsort(np.argsort(order, kind="stable"), kind="stable") * DECILES // len(order)
    squared = np.clip(judged.squared, -_MOST_SQUARED, _MOST_SQUARED)
    result = []
    for k in range(DECILES):
        mine = place == k
        _, cloud = np.unique(judged.cloud[mine], return_inverse=True)
        sums = np.stack([np.bincount(cloud, squared[mine]), np.bincount(cloud)], axis=1).astype(np.float64)
        found = bootstrap(sums, _root_mean)
        result.append(Decile(float(judged.distance[mine].mean()), float(np.sqrt(np.mean(np.square(expected[mine])))), found))
    return result


def _root_mean(values: Floats) -> Floats:
    """Root of the mean square of (resamples, n, 2): sums of squares and counts."""
    total = values.sum(axis=1)
    return np.asarray(np.sqrt(np.maximum(total[:, 0], 0) / total[:, 1]))


def rise(deciles: Sequence[Decile]) -> float:
    """By what factor the error found in the last two tenths exceeds that in the first two."""
    squares = [d.found.value**2 for d in deciles]
    return float(np.sqrt(sum(squares[-2:]) / max(sum(squares[:2]), 1e-12)))
