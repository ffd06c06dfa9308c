"""Pictures of the benchmark: time against error, a scene each."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from benchmarks.bench_rows import Row, label
from benchmarks.worker import OURS
from deepclouds.replacing import replacing

# A colour a model, a marker and a line a mode; the peers have both of their own.
_MODELS = ("#b3122a", "#d9822b", "#7a3b8f", "#8c6d5a")
_MODES = {"deepclouds": ("o", "-"), "corrected": ("*", "-"), "reference": ("D", ":"), "timed": ("P", ":")}
_PEERS = {
    "unbiased": ("#777777", "P"),
    "octaves": ("#3d8a5f", "v"),
    "volpath": ("#444444", "s"),
    "oidn": ("#2a55a8", "^"),
    "single": ("#b08a2e", "x"),
}


def write_plots(folder: Path, rows: Sequence[Row]) -> int:
    """Write `bench_<scene>.png`, time against error; returns how many, 0 without matplotlib.

    An image whose error cannot be told from 0 is a hollow mark at the upper end of its interval.
    """
    if find_spec("matplotlib") is None:
        return 0
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    scenes = list(dict.fromkeys(r.scene for r in rows))
    folder.mkdir(parents=True, exist_ok=True)
    # A model keeps its colour from scene to scene.
    styles = [
        (method, model, _MODELS[i % len(_MODELS)], marker, line)
        for i, model in enumerate(dict.fromkeys(r.model for r in rows if r.method in OURS))
        for method, (marker, line) in _MODES.items()
    ]
    styles += [(method, "", colour, marker, "-") for method, (colour, marker) in _PEERS.items()]
    for scene in scenes:
        figure = Figure(figsize=(7.4, 4.0), dpi=130, layout="constrained")
        FigureCanvasAgg(figure)
        axis = figure.subplots()
        for method, model, colour, marker, line in styles:
            size = 9 if marker == "*" else 5
            mine = sorted((r for r in rows if (r.scene, r.method, r.model) == (scene, method, model)), key=lambda r: r.seconds_warm)
            points = [r for r in mine if r.error > 0]
            # No logarithm of 0: what cannot be told from it is shown hollow, where its interval ends.
            exact = [r for r in mine if r.error == 0 and r.interval[1] > 0]
            axis.plot(
                [r.seconds_warm for r in exact],
                [100 * r.interval[1] for r in exact],
                color=colour,
                marker=marker,
                ms=size,
                ls="",
                fillstyle="none",
                label=None if points or not exact else label(method, model),
            )
            if not points:
                continue
            errors = [100 * p.error for p in points]
            bars = [
                [e - 100 * p.interval[0] for e, p in zip(errors, points, strict=True)],
                [100 * p.interval[1] - e for e, p in zip(errors, points, strict=True)],
            ]
            bars = [[max(0.0, b) for b in side] for side in bars]
            seconds = [p.seconds_warm for p in points]
            axis.errorbar(
                seconds, errors, bars, color=colour, marker=marker, ms=size, ls=line, capsize=2, lw=1.2, label=label(method, model)
            )
        axis.set(xscale="log", yscale="log", xlabel="seconds, warm", ylabel="error of a pixel, %", title=scene)
        axis.grid(which="both", color="#dddddd", lw=0.5)
        axis.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.01, 1.0))

        with replacing(folder / f"bench_{scene}.png", ".png") as temporary:
            figure.savefig(temporary, format="png")
    return len(scenes)
