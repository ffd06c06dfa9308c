"""Plots of the time of renders against one thing that is varied."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path

from deepclouds.replacing import replacing

_COLOURS = ("#b3122a", "#2a55a8", "#d9822b", "#3d8a5f", "#7a3b8f", "#8c6d5a")


def write_plot(path: Path, words: str, series: Mapping[str, Sequence[tuple[float, float, float]]]) -> bool:
    """Plot seconds, and those of prediction, against what is varied, on logarithmic axes; False without matplotlib.

    Parameters
    ----------
    words
        what is varied.
    series
        by name: points of what is varied, seconds, and seconds of prediction.
    """
    if find_spec("matplotlib") is None:
        return False
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 3.9), dpi=120, layout="constrained")
    axis = figure.subplots()
    for colour, (name, points) in zip(_COLOURS * len(series), series.items(), strict=False):
        x, seconds, predicting = zip(*points, strict=True)
        axis.plot(x, seconds, color=colour, marker="o", ms=4, lw=1.4, label=name)
        if any(predicting):
            axis.plot(x, predicting, color=colour, marker=".", ms=4, lw=0.9, ls=":", label="of it prediction")
    whole = [(x, seconds) for points in series.values() for x, seconds, _ in points]
    if len({x for x, _ in whole}) > 1:
        # What proportion would look like: falling for processors, which share the work.
        first = min(whole)
        last = max(whole)[0]
        slope = last / first[0] if words != "processors" else first[0] / last
        axis.plot([first[0], last], [first[1], first[1] * slope], color="#999999", lw=0.8, ls="--", label="in proportion")
    # Over several decades proportion would leave the picture, and the points would lie on its floor.
    shown = [value for points in series.values() for _, *values in points for value in values if value > 0]
    axis.set(xscale="log", yscale="log", xlabel=words, ylabel="seconds, warm", ylim=(0.6 * min(shown), 1.7 * max(shown)))
    if words == "processors":
        ticks = sorted({x for x, _ in whole})
        axis.set_xticks(ticks, [f"{t:g}" for t in ticks])
        axis.set_xticks([], minor=True)
    axis.grid(which="both", color="#dddddd", lw=0.5)
    axis.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.01, 1.0))
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path, ".png") as temporary:
        figure.savefig(temporary, format="png")
    return True
