"""Pictures of the accuracy: one a part."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy_confidence import ConfidenceResult
from benchmarks.accuracy_furnace import ASYMMETRIES, FurnaceCloud
from benchmarks.accuracy_labels import LabelsResult
from benchmarks.accuracy_scenes import SceneResult
from benchmarks.accuracy_slabs import DEPTHS, SlabResult
from benchmarks.accuracy_special import CaseResult
from deepclouds.replacing import replacing

_COLOURS = ("#b3122a", "#2a55a8", "#b08a2e")


def write_pictures(
    folder: Path,
    scenes: Sequence[SceneResult],
    furnace: Sequence[FurnaceCloud],
    slabs: Sequence[SlabResult],
    labels: Sequence[LabelsResult],
    special: Sequence[CaseResult],
    confidence: Sequence[ConfidenceResult] = (),
) -> list[Path]:
    """Write `accuracy_*.png` into `folder`; returns the files, none without matplotlib."""
    if find_spec("matplotlib") is None:
        return []
    drawn = {"scenes": _scenes(scenes), "furnace": _furnace(furnace), "slabs": _slabs(slabs), "special": _special(special)}
    if confidence:
        drawn["confidence"] = _confidence(confidence, special)
    written = []
    for name, figure in drawn.items():
        written.append(folder / f"accuracy_{name}.png")
        with replacing(written[-1], ".png") as temporary:
            figure.savefig(temporary, format="png")
    if labels:
        from deepclouds_training.evaluated_plot import write_evaluated_plot

        written.append(folder / "accuracy_labels.png")
        write_evaluated_plot(written[-1], [r.labels for r in labels], [r.name for r in labels], "held-out clouds")
    return written


def _figure(width: float, height: float) -> Any:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=100, layout="constrained")


def _scenes(scenes: Sequence[SceneResult]) -> Any:
    figure = _figure(2.6 * len(scenes) + 0.8, 7.6)
    axes = figure.subplots(3, len(scenes), squeeze=False)
    shown = None
    for column, scene in enumerate(scenes):
        white = np.quantile(scene.reference, 0.995)
        for row, (image, name) in enumerate(((scene.image, "deepclouds"), (scene.reference, "path traced"))):
            axes[row, column].imshow(np.clip(image / white, 0, 1) ** (1 / 2.2))
            axes[row, column].set_title(f"{scene.name}, {name}", fontsize=8)
        reference = scene.reference.mean(axis=2)
        # Over the pixel where it is bright, over a tenth of the white where it is not.
        difference = (scene.image.mean(axis=2) - reference) / np.maximum(reference, 0.1 * white)
        shown = axes[2, column].imshow(100 * difference, cmap="RdBu_r", vmin=-25, vmax=25)
        axes[2, column].set_title("difference, %", fontsize=8)
    for axis in axes.ravel():
        axis.set_axis_off()
    figure.colorbar(shown, ax=axes[2].tolist(), shrink=0.9)
    return figure


def _furnace(clouds: Sequence[FurnaceCloud]) -> Any:
    figure = _figure(6.4, 3.8)
    axis = figure.subplots()
    for g, colour in zip(ASYMMETRIES, _COLOURS, strict=True):
        for family, marker in zip(sorted({c.family for c in clouds}), "os", strict=False):
            chosen = [c for c in clouds if (c.g, c.family) == (g, family)]
            if not chosen:
                continue
            axis.errorbar(
                [c.size for c in chosen],
                [100 * c.mean for c in chosen],
                [100 * c.rms for c in chosen],
                fmt=marker,
                color=colour,
                capsize=2,
                label=f"{family}, g {g}",
            )
    axis.axhline(0, color="#888888", lw=0.8)
    axis.set(
        xscale="log", xlabel="size of the cloud, mean free paths", ylabel="deviation from 1, %", title="white furnace: mean, rms as bar"
    )
    axis.legend(frameon=False, fontsize=7, ncols=2)
    return figure


def _slabs(slabs: Sequence[SlabResult]) -> Any:
    figure = _figure(8, 3.6)
    axes = figure.subplots(1, 2, sharey=True)
    for which, (axis, name) in enumerate(zip(axes, ("reflected", "transmitted"), strict=True)):
        for g, colour in zip(ASYMMETRIES, _COLOURS, strict=True):
            for height, marker in ((1.0, "o"), (0.5, "^")):
                chosen = [r for r in slabs if (r.slab.g, r.slab.height) == (g, height)]
                axis.plot(
                    [r.slab.tau for r in chosen],
                    [r.found[which] - r.exact[which] for r in chosen],
                    marker,
                    color=colour,
                    label=f"g {g}, sun at {np.degrees(np.arccos(height)):.0f}°",
                )
        axis.axhline(0, color="#888888", lw=0.8)
        axis.set(xscale="log", xlabel="optical depth", title=name, xticks=DEPTHS, xticklabels=[f"{d:g}" for d in DEPTHS])
        axis.minorticks_off()
    axes[0].set_ylabel("flux, found - exact")
    axes[1].legend(frameon=False, fontsize=7)
    return figure


def _special(cases: Sequence[CaseResult]) -> Any:
    from matplotlib.ticker import NullFormatter

    figure = _figure(3 * len(cases), 3.3)
    axes = figure.subplots(1, len(cases), squeeze=False)[0]
    for axis, case in zip(axes, cases, strict=True):
        label: NDArray[np.float64] = 0.5 * (case.half_a + case.half_b)
        noise = 0.5 * np.abs(case.half_a - case.half_b)
        brightest = float(max(label.max(), case.predicted.max()))
        # What no walk found any light at has no place on a logarithmic axis.
        dimmest = float(min(v[v > 1e-4 * brightest].min() for v in (label, case.predicted)))
        limits = [0.7 * dimmest, 1.4 * brightest]
        axis.plot(limits, limits, color="#888888", lw=0.8)
        axis.errorbar(label, case.predicted, xerr=noise, fmt="o", markersize=3, lw=0.8, color=_COLOURS[0])
        axis.set(xscale="log", yscale="log", xlim=limits, ylim=limits, aspect="equal", xlabel="j, walks", title=case.name)
        for ticks in (axis.xaxis, axis.yaxis):
            ticks.set_minor_formatter(NullFormatter())
    axes[0].set_ylabel("j, predicted")
    return figure


def _confidence(results: Sequence[ConfidenceResult], special: Sequence[CaseResult]) -> Any:
    figure = _figure(9, 4)
    axes = figure.subplots(1, 2, sharey=True)
    for result, colour in zip(results, _COLOURS, strict=False):
        for axis, tenths, x in (
            (axes[0], result.by_expected, [100 * d.expected for d in result.by_expected]),
            (axes[1], result.by_distance, [d.distance for d in result.by_distance]),
        ):
            value, low, high = (100 * np.array([getattr(d.found, end) for d in tenths]) for end in ("value", "low", "high"))
            axis.errorbar(x, value, [value - low, high - value], fmt="o-", markersize=4, lw=0.8, capsize=2, color=colour, label=result.name)
    for case, marker in zip(special, "s^Dv", strict=False):
        if case.expected is not None:
            figures = case.row.figures
            at, found = 100 * figures["expected"].value, 100 * figures["found"].value
            axes[0].plot([at], [found], marker, color="#444444", markersize=6, label=case.name)
    ends = [4, 100]
    axes[0].plot(ends, ends, color="#888888", lw=0.8)
    axes[0].set(
        xscale="log", yscale="log", xlabel="expected error, %", ylabel="error found, % of j + 0.05", title="tenths by expected error"
    )
    axes[1].set(xscale="log", xlabel="distance from the training data", title="tenths by distance alone")
    ticks = [5, 10, 20, 50, 100]
    axes[0].set(xticks=ticks, xticklabels=ticks, yticks=ticks, yticklabels=ticks, xlim=ends, ylim=ends)
    distances = [0.5, 1, 2, 4]
    axes[1].set(xticks=distances, xticklabels=distances)
    for axis in axes:
        axis.minorticks_off()
    axes[0].legend(frameon=False, fontsize=7)
    return figure
