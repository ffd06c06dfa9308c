"""The picture of a model's errors: by cloud family, size, phase function, albedo, angle and depth."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from deepclouds.replacing import replacing
from deepclouds_training.evaluate import Labels, noise_free

_BINS = 7
_LEAST = 40


def write_evaluated_plot(path: Path, sets: Sequence[Labels], names: Sequence[str], title: str) -> None:
    """Draw noise-free relative error and energy, with 95 % intervals, of every set of labels; raises OSError when it cannot be written."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 7.5), dpi=80, layout="constrained")
    figure.suptitle(f"{title}: error against held-out labels, free of their noise; 95 % intervals over clouds")
    axes = figure.subplots(2, 6, sharey="row")
    quantities = ("size", "g", "albedo", "gamma", "tau")
    for number, labels in enumerate(sets):
        families = np.unique(labels.family)
        groups = {"family": [(i + 0.12 * number, labels.family == f) for i, f in enumerate(families)]}
        axes[0, 0].set_xticks(range(len(families)), families)
        axes[1, 0].set_xticks(range(len(families)), families)
        for quantity in quantities:
            values = getattr(labels, quantity)
            edges = np.unique(np.quantile(values, np.linspace(0, 1, _BINS + 1)))
            bins = [(values >= a) & ((values < b) | (b == edges[-1])) for a, b in pairwise(edges)]
            groups[quantity] = [(float(np.median(values[b])), b) for b in bins if np.count_nonzero(b) >= _LEAST]
        for column, (quantity, parts) in enumerate(groups.items()):
            for row, key in enumerate(("rRMSE", "energy")):
                found = [(x, noise_free(labels.where(chosen))[key]) for x, chosen in parts]
                if not found:
                    continue
                x = [p for p, _ in found]
                y = np.array([[100 * f.value, 100 * max(f.value - f.low, 0), 100 * max(f.high - f.value, 0)] for _, f in found]).T
                axis = axes[row, column]
                axis.errorbar(x, y[0], yerr=y[1:], fmt="o-" if column else "o", markersize=3, capsize=2, label=names[number])
                axis.grid(alpha=0.3)
                axis.set_xlabel(quantity)
                if quantity in ("size", "tau"):
                    axis.set_xscale("symlog" if quantity == "tau" else "log")
    axes[0, 0].set_ylabel("rRMSE, %")
    axes[1, 0].set_ylabel("energy, %")
    axes[0, 0].legend(fontsize=7)
    with replacing(path, ".png") as temporary:
        figure.savefig(temporary, format="png")
