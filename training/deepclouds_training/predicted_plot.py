"""The plot of predictions against noisy labels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deepclouds.replacing import replacing

BINS = 24


def write_predicted_plot(path: Path, prediction: NDArray[np.float32], label: NDArray[np.float32], title: str) -> None:
    """Draw labels (n,) against predictions (n,), both j on logarithmic axes, with the labels' mean in bins of the prediction.

    The labels are noisy, so their cloud is wide even where every prediction is right; the means with their standard errors show whether
    the predictions are. Bins follow the prediction, since bins of the label would sort by its noise.
    """
    from matplotlib.figure import Figure

    p, y = prediction.astype(np.float64), label.astype(np.float64)
    seen = y > 0
    # A label may be smaller than any truth by orders of magnitude: the predictions set the axes, labels beyond stand at the edge.
    low, high = float(np.quantile(p, 0.001)) / 1.5, float(np.quantile(p, 0.999)) * 1.5
    shown = np.clip(y, low, high)
    figure = Figure(figsize=(6, 5.2), dpi=110, layout="constrained")
    axes = figure.add_subplot()
    if np.any(seen):
        limits = (np.log10(low), np.log10(high))
        counts = axes.hexbin(
            p[seen], shown[seen], xscale="log", yscale="log", gridsize=60, bins="log", mincnt=1, extent=(*limits, *limits), cmap="Blues"
        )
        figure.colorbar(counts, label="samples")
    axes.plot([low, high], [low, high], color="0.3", linewidth=1, label="equal")
    edges = np.quantile(p, np.linspace(0, 1, BINS + 1))
    which = np.clip(np.searchsorted(edges, p, side="right") - 1, 0, BINS - 1)
    bins = [which == b for b in range(BINS) if np.count_nonzero(which == b) > 1]
    means = np.array([[p[b].mean(), y[b].mean(), y[b].std(ddof=1) / np.sqrt(np.count_nonzero(b))] for b in bins])
    if len(means):
        axes.errorbar(means[:, 0], means[:, 1], yerr=means[:, 2], fmt="o", markersize=4, color="C3", label="mean label, standard error")
    axes.set(xlim=(low, high), ylim=(low, high), xlabel="predicted j", ylabel="label j (Monte Carlo)", title=title)
    axes.legend(loc="upper left")
    with replacing(path, ".png") as temporary:
        figure.savefig(temporary, format="png")
