"""The ablations' table and picture for docs/ablations.md."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from deepclouds.replacing import replacing

PICTURE = "images/ablations.png"
LINK = f"![Change of the error against the base, and error against cost]({PICTURE})"
# Medians above this, in percent, would squeeze the others.
WORST_DRAWN = 20.0
# Key in the results, heading, signed.
COLUMNS = (
    ("halves rRMSE", "rRMSE, halves", False),
    ("converged rRMSE", "rRMSE, converged", False),
    ("median", "median", False),
    ("95 %", "95th percentile", False),
    ("halves energy", "energy, halves", True),
    ("converged energy", "energy, converged", True),
)


def body(results: dict[str, Any]) -> str:
    """The table: means of the seeds, half their spread, and for the main figures the ratio to the base."""
    base = next((r for r in results["rows"] if r["name"] == results["base"]), results["rows"][0])
    lines = [
        f"Commit {results['commit']}, {results['samples']:,} samples, {results['minutes']:.0f} minutes for all networks together on two "
        f"cores, {len(base['seeds'])} seeds. Errors in percent, mean of the seeds and half their difference; `vs base` is the mean of the "
        "relative changes of the four errors.",
        "",
        "| variant | weights | multiply-adds | us/query | " + " | ".join(title for _, title, _ in COLUMNS) + " | vs base |",
        "|" + "---|" * (5 + len(COLUMNS)),
    ]
    group = None
    for row in results["rows"]:
        if row["group"] != group:
            group = row["group"]
            lines.append(f"| **{group}** |" + " |" * (4 + len(COLUMNS)))
        cells = [f"{row['name']}: {row['what']}", f"{row['weights']:,}", f"{row['multiply_adds']:,}", f"{1e6 * row['seconds']:.2f}"]
        cells += [_cell(row, key, signed) for key, _, signed in COLUMNS]
        mean, half = change(row, base)
        cells.append("" if row is base else f"{100 * mean:+.1f} +- {100 * half:.1f}")
        lines.append("| " + " | ".join(cells) + " |")
    large = results["large"]
    lines += [
        "",
        "Processor time a query on one thread of onnxruntime, at the best of its batches. The network of width 192 "
        f"({large['weights']:,} weights, {large['multiply_adds']:,} multiply-adds) takes {1e6 * large['seconds']:.2f} us in the same run.",
    ]
    return "\n".join(lines)


def change(row: dict[str, Any], base: dict[str, Any]) -> tuple[float, float]:
    """Mean relative change of the four errors against the base's mean, and half the range of the seeds' own."""
    keys = [key for key, _, signed in COLUMNS if not signed]
    expected = {key: np.mean([s[key] for s in base["seeds"]]) for key in keys}
    each = [float(np.mean([s[key] / expected[key] - 1 for key in keys])) for s in row["seeds"]]
    return float(np.mean(each)), 0.5 * (max(each) - min(each))


def _cell(row: dict[str, Any], key: str, signed: bool) -> str:
    values = 100 * np.array([s[key] for s in row["seeds"]])
    return f"{values.mean():{'+' if signed else ''}.2f} +- {0.5 * np.ptp(values):.2f}"


def draw(found: list[dict[str, Any]], path: Path) -> None:
    """Left: change against the base of the same run, a dot a seed. Right: error against processor time a query."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    bases = [next(r for r in results["rows"] if r["name"] == results["base"]) for results in found]
    rows = [
        (row, base)
        for results, base in zip(found, bases, strict=True)
        for row in results["rows"]
        if row is base or row["name"] != base["name"]
    ]
    figure, (left, right) = plt.subplots(1, 2, figsize=(13, 0.24 * len(rows) + 1.2), width_ratios=[1.1, 1])
    colours = {g: f"C{i}" for i, g in enumerate(dict.fromkeys(row["group"] for row, _ in rows))}
    for place, (row, base) in enumerate(rows):
        for seed in row["seeds"]:
            left.plot(100 * change({**row, "seeds": [seed]}, base)[0], -place, "o", color=colours[row["group"]])
    left.axvline(0, color="0.6", lw=1)
    left.set_yticks([-i for i in range(len(rows))], [row["name"] for row, _ in rows])
    left.set_xscale("symlog", linthresh=40)
    marks = [-20, -10, 0, 10, 20, 40, 100, 200]
    left.set_xticks(marks, [str(m) for m in marks])
    left.set_xlabel("change of the errors against the base, % (below 0 is better)")
    left.grid(axis="x", alpha=0.3)
    for row, _ in rows:
        error = 100 * np.mean([s["median"] for s in row["seeds"]])
        if error < WORST_DRAWN:
            right.plot(1e6 * row["seconds"], error, "o", color=colours[row["group"]], label=row["group"])
            right.annotate(row["name"], (1e6 * row["seconds"], error), xytext=(4, 3), textcoords="offset points", fontsize=7)
    handles = dict(zip(*reversed(right.get_legend_handles_labels()), strict=True))
    right.legend(handles.values(), handles.keys(), fontsize=8)
    right.set_xscale("log")
    costs = [1, 2, 4, 8]
    right.set_xticks(costs, [str(c) for c in costs])
    right.minorticks_off()
    right.set_xlabel("processor time a query, microseconds")
    right.set_ylabel("median relative error on held-out clouds (converged), %")
    right.grid(alpha=0.3)
    figure.tight_layout()
    with replacing(path, ".png") as temporary:
        figure.savefig(temporary, dpi=100)
    plt.close(figure)
