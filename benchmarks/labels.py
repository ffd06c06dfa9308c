"""`python -m benchmarks.labels`: what a label costs, by our tracker and by Mitsuba's ``volpath``, side by side in one run.

Three questions, three tables: (a) core-seconds until the labels of 64 points a cloud reach 2 % standard error; (b) the error of one
small network after training on labels from equal core-seconds of either tracer; (c) paths per core-second. All times are process times,
summed over threads: core-seconds; compiling and loading stand apart. The last line is the ratio of (a) over the three clouds together,
the median of three repetitions. docs/labels.md says how volpath is brought to its best case.
"""

from __future__ import annotations

import argparse
import csv
import statistics
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from benchmarks.bench import machine
from benchmarks.label_cost import ALBEDOS, CLOUDS, SUNS, Cost, compile_seconds, make_task, our_cost, volpath_cost, volpath_speed
from benchmarks.label_information import Effort, Worth, information
from benchmarks.label_volpath import VARIANTS
from benchmarks.page import write_results
from deepclouds.errors import InputError
from deepclouds.replacing import replacing

ROOT = Path(__file__).resolve().parents[1]
LABELS_A_WALK = SUNS * len(ALBEDOS)


@dataclass(frozen=True)
class Size:
    """How much is traced: points a cloud, resolution, walks for the means and for either tracer, repetitions, and effort of (b)."""

    points: int
    resolution: int
    mean_walks: int
    our_walks: int
    volpath_walks: int
    repetitions: int
    effort: Effort


FULL = Size(64, 96, 16384, 4096, 256, 3, Effort())
QUICK = Size(6, 24, 1024, 512, 64, 1, Effort(clouds=1, resolution=16, seconds=0.05, steps=8, points=64, walks=16))


@dataclass(frozen=True)
class Row:
    """One repetition on one cloud: what it cost either tracer."""

    cloud: str
    repetition: int
    ours: Cost
    volpath: Cost


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; 0 on success, 2 for bad input."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.labels", description="What a label costs, against Mitsuba's volpath.")
    parser.add_argument("--quick", action="store_true", help="a few seconds: whether it runs; its figures mean nothing")
    parser.add_argument("--out", type=Path, default=ROOT / "out", help="folder for labels.csv and labels.png (default: out)")
    parser.add_argument("--docs", action="store_true", help="write the tables into docs/labels.md")
    options = parser.parse_args(arguments)
    try:
        return run(QUICK if options.quick else FULL, options.out, ROOT / "docs" / "labels.md" if options.docs else None)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def run(size: Size, out: Path, page: Path | None) -> int:
    """Measure, print, and write `labels.csv`, `labels.png` and, if given, the `page`."""
    if find_spec("mitsuba") is None:
        raise InputError("mitsuba is missing: pip install 'deepclouds[bench]'")
    import mitsuba as mi

    before = mi.variant()
    compiling = compile_seconds()
    tasks = [make_task(cloud, size.resolution, size.points, size.mean_walks) for cloud in CLOUDS]
    speeds = {}
    for variant in VARIANTS:
        mi.set_variant(variant)
        speeds[variant] = volpath_speed(tasks[0], min(size.volpath_walks * 2, 512))
    best = max(speeds, key=lambda v: speeds[v])
    mi.set_variant(best)
    variants = ", ".join(f"{v} {s:,.0f} paths/core-s" for v, s in speeds.items())
    print(f"volpath: {variants}; {best} is used. Our first call: {compiling:.2f} core-s", flush=True)
    rows = []
    for repetition in range(size.repetitions):
        for number, task in enumerate(tasks):
            seed = 1000 * (repetition + 1) + 100 * number
            row = Row(task.cloud.name, repetition, our_cost(task, size.our_walks, seed), volpath_cost(task, size.volpath_walks, seed + 50))
            rows.append(row)
            print(f"{row.cloud}, {repetition + 1}: ours {row.ours.seconds:.1f}, volpath {row.volpath.seconds:.0f} core-s", flush=True)
    worth = information(size.effort)
    if before is not None:
        mi.set_variant(before)

    tables = markdown(rows, worth)
    out.mkdir(parents=True, exist_ok=True)
    write_csv(out / "labels.csv", rows)
    plotted = write_plot(out / "labels.png", rows, worth)
    if page is not None:
        notes = (
            f"Measured on: {machine()}. volpath: {variants}; {best} is used. Our first call: {compiling:.2f} core-s "
            "(kernels of earlier runs are cached on disk)."
        )
        write_results(page, "labels", f"{notes}\n\n{tables}")
    print(f"\n{tables}\n\nwrote {out}/labels.csv" + (" and labels.png" if plotted else "; no plot: matplotlib is missing"))
    print(headline(rows))
    return 0


def headline(rows: Sequence[Row]) -> str:
    """The last line: core-seconds of volpath over ours for all clouds together, median of the repetitions."""
    ratios = []
    for repetition in sorted({r.repetition for r in rows}):
        mine = [r for r in rows if r.repetition == repetition]
        ratios.append(sum(r.volpath.seconds for r in mine) / sum(r.ours.seconds for r in mine))
    return f"labels: {statistics.median(ratios):.3g} x cheaper than volpath (median of {len(ratios)})"


def markdown(rows: Sequence[Row], worth: dict[str, Worth]) -> str:
    """The three tables; every figure is the median of the repetitions, with the smallest and the largest ratio beside it."""
    lines = [
        "(a) Core-seconds until every label reaches 2 %; in brackets the range of the repetitions:",
        "",
        "| cloud | ours | volpath | x cheaper | mean label of a point | a walk's eight labels are worth | x cheaper an independent label |",
        "|---|---|---|---|---|---|---|",
    ]
    for cloud in dict.fromkeys(r.cloud for r in rows):
        mine = [r for r in rows if r.cloud == cloud]
        ratio = [r.volpath.seconds / r.ours.seconds for r in mine]
        typical = statistics.median(r.volpath.typical / r.ours.typical for r in mine)
        effective = statistics.median(r.ours.effective for r in mine)
        lines.append(
            f"| {cloud} | {statistics.median(r.ours.seconds for r in mine):.1f} | {statistics.median(r.volpath.seconds for r in mine):.0f} "
            f"| {statistics.median(ratio):.3g} [{min(ratio):.3g}, {max(ratio):.3g}] | {typical:.3g} | {effective:.2g} "
            f"| {typical * effective / LABELS_A_WALK:.3g} |"
        )
    ours, theirs = worth["ours"], worth["volpath"]
    lines += [
        "",
        "(b) The same small network (width 32) after training on labels from at most equal core-seconds; error on unseen clouds,",
        "free of the reference's noise:",
        "",
        "| tracer | core-seconds | labels | rRMSE | energy |",
        "|---|---|---|---|---|",
        *(f"| {n} | {v.seconds:.1f} | {v.labels:,} | {v.rrmse:.1%} | {v.energy:+.1%} |" for n, v in (("ours", ours), ("volpath", theirs))),
        "",
        "(c) Paths per core-second, each of which starts in the cloud, and core-seconds to load a cloud:",
        "",
        "| cloud | ours | volpath | ratio | labels per core-second, ours | volpath | loading, ours | volpath |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for cloud in dict.fromkeys(r.cloud for r in rows):
        mine = [r for r in rows if r.cloud == cloud]
        us, them = (statistics.median(getattr(r, n).paths_per_second for r in mine) for n in ("ours", "volpath"))
        loads = [statistics.median(getattr(r, n).load for r in mine) for n in ("ours", "volpath")]
        lines.append(
            f"| {cloud} | {us:,.0f} | {them:,.0f} | {us / them:.2f} | {us * LABELS_A_WALK:,.0f} | {them:,.0f} "
            f"| {loads[0]:.2f} | {loads[1]:.1f} |"
        )
    return "\n".join(lines)


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """One line for every repetition, cloud and tracer."""
    with replacing(path, ".csv") as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(
            [
                "cloud",
                "repetition",
                "tracer",
                "core_seconds",
                "core_seconds_typical",
                "paths_per_core_second",
                "load_core_seconds",
                "effective_labels",
            ]
        )
        for row in rows:
            for name, c in (("ours", row.ours), ("volpath", row.volpath)):
                writer.writerow([row.cloud, row.repetition, name, c.seconds, c.typical, c.paths_per_second, c.load, c.effective])


def write_plot(path: Path, rows: Sequence[Row], worth: dict[str, Worth]) -> bool:
    """Bars of core-seconds a cloud, and of the networks' errors; whether there was a matplotlib to draw them."""
    if find_spec("matplotlib") is None:
        return False
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3.2), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, width_ratios=[3, 1])
    names = list(dict.fromkeys(r.cloud for r in rows))
    colours = {"ours": "tab:blue", "volpath": "tab:orange"}
    for offset, tracer in ((-0.2, "ours"), (0.2, "volpath")):
        heights = [statistics.median(getattr(r, tracer).seconds for r in rows if r.cloud == name) for name in names]
        left.bar([i + offset for i in range(len(names))], heights, 0.38, label=tracer, color=colours[tracer])
        right.bar(tracer, 100 * worth[tracer].rrmse, color=colours[tracer])
    left.set(yscale="log", ylabel="core-seconds", title="labels to 2 % standard error", xticks=range(len(names)), xticklabels=names)
    left.legend()
    right.set(ylabel="rRMSE, %", title="network")
    with replacing(path, ".png") as temporary:
        figure.savefig(temporary, dpi=120)
    return True


if __name__ == "__main__":
    sys.exit(main())
