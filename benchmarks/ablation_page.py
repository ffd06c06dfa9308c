"""The ablations' table and picture for docs/ablations.md."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from deepclouds.replacing import replacing

PICTURE = "images/ablations.png"
LINK = f"![Change of the error against the base, and error against cost]({PICTURE})"
# Key in the results, heading, factor, signed.
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


def draw(results: dict[str, Any], path: Path) -> None:
    """Left: change against the base, a dot a seed. Right: error against processor time a query."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    rows = results["rows"]
    base = next(r for r in rows if r["name"] == results["base"])
    figure, (left, right) = plt.subplots(1, 2, figsize=(13, 0.26 * len(rows) + 1.2), width_ratios=[1.1, 1])
    groups = list(dict.fromkeys(r["group"] for r in rows))
    colours = {g: f"C{i}" for i, g in enumerate(groups)}
    for place, row in enumerate(rows):
        for seed in row["seeds"]:
            mean, _ = change({**row, "seeds": [seed]}, base)
            left.plot(100 * mean, -place, "o", color=colours[row["group"]])
    left.axvline(0, color="0.6", lw=1)
    left.set_yticks([-i for i in range(len(rows))], [r["name"] for r in rows])
    left.set_xscale("symlog", linthresh=10)
    left.set_xlabel("change of the errors against the base, % (below 0 is better)")
    left.grid(axis="x", alpha=0.3)
    for row in rows:
        if row["group"] in ("base", "width", "levels", "small networks") or row["name"] == "symmetric":
            error = 100 * np.mean([s["halves rRMSE"] for s in row["seeds"]])
            right.plot(1e6 * row["seconds"], error, "o", color=colours[row["group"]])
            right.annotate(row["name"], (1e6 * row["seconds"], error), xytext=(4, 3), textcoords="offset points", fontsize=8)
    right.set_xscale("log")
    right.set_xlabel("processor time a query, microseconds")
    right.set_ylabel("noise-free rRMSE on held-out clouds (halves), %")
    right.grid(alpha=0.3, which="both")
    figure.tight_layout()
    with replacing(path, ".png") as temporary:
        figure.savefig(temporary, dpi=100)
    plt.close(figure)
