"""Held-out labels: what `deepclouds evaluate` measures, by family."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from deepclouds_training import evaluate

from benchmarks.accuracy_figures import Figure, Row


@dataclass(frozen=True)
class LabelsResult:
    """One data set: its name, labels beside predictions, and the rows, all clouds first."""

    name: str
    labels: evaluate.Labels
    rows: list[Row]


def measure_labels(folder: Path, model: Path) -> LabelsResult:
    """Ask the model for all labels of a data set's held-out clouds; raises InputError when there are none."""
    labels = evaluate.predict_labels(model, folder)
    groups = [("all", np.full(len(labels.cloud), True)), *((str(f), labels.family == f) for f in np.unique(labels.family))]
    rows = []
    for name, chosen in groups:
        part = labels.where(chosen)
        found = {**evaluate.noise_free(part), **evaluate.percentiles(part)}
        figures = {key: Figure(f.value, f.low, f.high, signed=key == "energy") for key, f in found.items()}
        rows.append(Row("labels", f"{folder.name} {name}, {len(part.cloud):,} of {len(np.unique(part.cloud))} clouds", figures))
    return LabelsResult(folder.name, labels, rows)
