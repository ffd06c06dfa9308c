"""How the time of a render grows with pixels, optical depth, active voxels and processors.

    python -m benchmarks.scaling [--only pixels,depth,voxels,cores] [--models name,...] [--out out/scaling] [--quick] [--docs]

One thing is varied at a time, under a sun, with deepclouds' own choice of samples, by each released model. Every point is a process of its
own (`benchmarks.scaling_point`), one after the other in one run; only ratios between points mean anything on another machine. The clouds
are our own: a cumulus of the generator at several resolutions, and cumuli scattered over a box of which 2 % holds something
(`benchmarks.large_cloud`). Writes `scaling_<what>.csv` and a plot of each; ``--docs`` also puts them into `docs/figures` and
`docs/images`, and the table into `docs/benchmark.md`.

Last line: `scaling: pixels 256 x, time N x; ...`, from the first to the last point of the first series of each.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
from deepclouds_runtime.predictor import RELEASED, find_model

from benchmarks.bench import ROOT, machine, model_name
from benchmarks.large_cloud import scattered_cumuli
from benchmarks.page import write_results
from benchmarks.scaling_plots import write_plot
from benchmarks.scaling_point import Point, usable
from deepclouds.errors import InputError
from deepclouds.replacing import replacing
from deepclouds.volume import SparseVolume, write_vdb, write_vol

PAGE = ROOT / "docs" / "benchmark.md"
_FAMILY, _SEED = "cumulus", 4
_FILLED = 0.02


@dataclass(frozen=True)
class Cloud:
    """A cloud by name: a cumulus with samples along its longest edge, or cumuli scattered over a box of (x, y, z) voxels."""

    resolution: int | tuple[int, int, int]

    @property
    def family(self) -> str:
        """In words, the same for all resolutions."""
        return "cumulus" if isinstance(self.resolution, int) else "scattered cumuli"

    @property
    def up(self) -> str:
        """Axis that points up."""
        return "y" if isinstance(self.resolution, int) else "z"

    def write(self, folder: Path) -> Path:
        """The cloud's file, made unless it is there."""
        if isinstance(self.resolution, int):
            path = folder / f"{_FAMILY}_{self.resolution}.vol"
            if not path.exists():
                from deepclouds_training.clouds import make_cloud

                write_vol(path, make_cloud(_FAMILY, _SEED, self.resolution))
            return path
        path = folder / f"scattered_{'_'.join(map(str, self.resolution))}.vdb"
        if not path.exists():
            longest = max(self.resolution)
            write_vdb(path, SparseVolume(scattered_cumuli(self.resolution, _FILLED, 0), np.diag([*self.resolution, longest]) / longest))
        return path


@dataclass(frozen=True)
class Setting:
    """One point to measure."""

    cloud: Cloud
    size: int = 256
    optical_depth: float = 60.0
    cores: int | None = None


@dataclass(frozen=True)
class Axis:
    """What is varied: its name in files, which figure of a `Point` it is, in words, and the settings."""

    name: str
    figure: str
    words: str
    settings: tuple[Setting, ...]


@dataclass(frozen=True)
class Measured:
    """A point of a series: what was varied, which cloud, and what it took."""

    axis: Axis
    family: str
    point: Point

    @property
    def x(self) -> float:
        """The figure that was varied."""
        return float(getattr(self.point, self.axis.figure))


def axes(quick: bool) -> dict[str, Axis]:
    """Everything that is measured; `quick`, only what shows that it runs."""
    middle = Cloud(16 if quick else 128)
    size = 24 if quick else 256
    count = len(usable())
    cores = [n for n in (1, 2, 4, 8, 16, 32, 64, 128) if n < count] + [count]
    resolutions: list[int | tuple[int, int, int]] = [12, 16] if quick else [32, 64, 128, 256, 384]
    resolutions += [(40, 32, 48)] if quick else [(100, 70, 125), (200, 140, 250), (400, 280, 500), (800, 560, 1000)]
    sizes = (16, 32) if quick else (64, 128, 256, 512, 1024)
    depths = (4.0, 16.0) if quick else (1.0, 4.0, 16.0, 64.0, 256.0, 1024.0)
    found = (
        Axis("pixels", "pixels", "pixels", tuple(Setting(middle, size=n) for n in sizes)),
        Axis("depth", "optical_depth", "optical depth", tuple(Setting(middle, size, depth) for depth in depths)),
        Axis("voxels", "active_voxels", "active voxels", tuple(Setting(Cloud(n), size) for n in resolutions)),
        Axis("cores", "cores", "processors", tuple(Setting(middle, size, cores=n) for n in cores)),
    )
    return {axis.name: axis for axis in found}


def run_point(setting: Setting, cloud: Path, model: str, repeats: int) -> Point | None:
    """Measure one point in a fresh process; raises InputError with its complaint when it fails."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "point.json"
        command = [sys.executable, "-m", "benchmarks.scaling_point", str(cloud), "--out", str(out), "--size", str(setting.size)]
        command += ["--optical-depth", str(setting.optical_depth), "--up", setting.cloud.up, "--model", model, "--repeats", str(repeats)]
        command += [] if setting.cores is None else ["--cores", str(setting.cores)]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in (str(ROOT), *sys.path) if p)}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            lines = [line for line in done.stderr.splitlines() if line.strip()]
            raise InputError(f"{cloud.name}: {lines[-1] if lines else f'exit code {done.returncode}'}")
        found = json.loads(out.read_text(encoding="utf-8"))
    return None if found is None else Point(**found)


def measure(axis: Axis, models: Sequence[str], folder: Path, repeats: int) -> list[Measured]:
    """All points of an axis, series by series; says which the models were not trained for."""
    rows = []
    for model in models:
        for setting in axis.settings:
            point = run_point(setting, setting.cloud.write(folder), model, repeats)
            if point is None:
                print(f"{axis.words}, {model}: left out, it was not trained on such a cloud ({setting})")
                continue
            rows.append(Measured(axis, setting.cloud.family, point))
            print(f"{axis.words} {rows[-1].x:g}, {setting.cloud.family}, {model}: {point.seconds:.3g} s", flush=True)
    return rows


def series(rows: Sequence[Measured]) -> dict[tuple[str, str], list[Measured]]:
    """Points of one model and one kind of cloud, in ascending order of what is varied."""
    found: dict[tuple[str, str], list[Measured]] = {}
    for row in rows:
        found.setdefault((row.point.model, row.family), []).append(row)
    return {key: sorted(points, key=lambda r: r.x) for key, points in found.items()}


def write_csv(path: Path, rows: Sequence[Measured]) -> None:
    """One line a point: its series, all figures, and the time over that of the first point of its series."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path, ".csv") as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["varied", "cloud", *(f.name for f in fields(Point)), "time_over_first"])
        for points in series(rows).values():
            for row in points:
                values = asdict(row.point).values()
                texts = [f"{v:.6g}" if isinstance(v, float) else str(v) for v in values]
                writer.writerow([row.axis.name, row.family, *texts, f"{row.point.seconds / points[0].point.seconds:.6g}"])


def markdown(rows: Sequence[Measured]) -> str:
    """A table of all points."""
    lines = [
        "| varied | model, cloud | value | seconds | over first | prediction s | processor s | queries | spp | load s | memory GiB |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for axis in dict.fromkeys(r.axis for r in rows):
        for (model, family), points in series([r for r in rows if r.axis == axis]).items():
            for row in points:
                p = row.point
                cells = [
                    axis.words,
                    f"{model}, {family}",
                    f"{row.x:,.0f}",
                    f"{p.seconds:.3g}",
                    f"{p.seconds / points[0].point.seconds:.3g}",
                ]
                cells += [f"{p.prediction_seconds:.3g}", f"{p.processor_seconds:.3g}", f"{p.queries:,}", f"{p.mean_spp:.3g}"]
                lines.append("| " + " | ".join([*cells, f"{p.load_seconds:.3g}", f"{p.peak_bytes / 2**30:.2f}"]) + " |")
    return "\n".join(lines)


def summary(rows: Sequence[Measured]) -> str:
    """From the first to the last point of the first series of each."""
    parts = []
    for axis in dict.fromkeys(r.axis for r in rows):
        points = next(iter(series([r for r in rows if r.axis == axis]).values()))
        first, last = points[0], points[-1]
        parts.append(f"{axis.words} {last.x / first.x:.3g} x, time {last.point.seconds / first.point.seconds:.3g} x")
    return f"scaling: {'; '.join(parts)}"


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print, write tables and plots, and with ``--docs`` the page; returns 0."""
    every = axes(quick=False)
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scaling", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", default=",".join(every), help="comma-separated, out of %(default)s")
    parser.add_argument("--models", default=",".join(RELEASED), help="comma-separated names or files (default: the released, %(default)s)")
    parser.add_argument("--repeats", type=int, default=3, help="renders of which the quickest counts (default %(default)s; --quick: 1)")
    parser.add_argument("--out", type=Path, default=Path("out/scaling"), help="folder of clouds, tables and plots (default %(default)s)")
    parser.add_argument("--quick", action="store_true", help="small images of small clouds: a check that it runs, not a measurement")
    parser.add_argument("--docs", action="store_true", help="also write docs/images, docs/figures and the table in docs/benchmark.md")
    options = parser.parse_args(argv)
    names, models = options.only.split(","), options.models.split(",")
    if unknown := [n for n in names if n not in every]:
        raise InputError(f"--only: unknown {', '.join(unknown)}; there are {', '.join(every)}")
    if options.repeats < 1:
        raise InputError(f"--repeats {options.repeats}: at least one render is timed")
    if options.docs and names != list(every):
        raise InputError(f"--docs writes a page of all results: leave out --only {options.only}")
    for model in models:
        find_model(model)
    options.out.mkdir(parents=True, exist_ok=True)
    print(machine())
    rows: list[Measured] = []
    for name in names:
        axis = axes(options.quick)[name]
        found = measure(axis, models, options.out, 1 if options.quick else options.repeats)
        rows += found
        folders = [(options.out, options.out)] + ([(PAGE.parent / "figures", PAGE.parent / "images")] if options.docs else [])
        for figures, images in folders:
            write_csv(figures / f"scaling_{name}.csv", found)
            write_plot(images / f"scaling_{name}.png", axis.words, drawn(found))
    table = markdown(rows)
    if options.docs:
        pictures = "\n".join(f"![render time against {every[n].words}](images/scaling_{n}.png)" for n in names)
        csvs = ", ".join(f"[{n}](figures/scaling_{n}.csv)" for n in names)
        write_results(PAGE, "scaling", f"Measured on: {machine()}\n\nTables: {csvs}\n\n{pictures}\n\n{table}")
    print(table, f"wrote {options.out}/scaling_*.csv and plots", summary(rows), sep="\n")
    return 0


def drawn(rows: Sequence[Measured]) -> dict[str, list[tuple[float, float, float]]]:
    """Series by name as what is varied, seconds, and seconds of prediction."""
    return {
        f"{model_name(model)}, {family}": [(r.x, r.point.seconds, r.point.prediction_seconds) for r in points]
        for (model, family), points in series(rows).items()
    }


if __name__ == "__main__":
    try:
        raise SystemExit(main())
    except InputError as error:
        print(f"benchmarks.scaling: {error}", file=sys.stderr)
        raise SystemExit(2) from None
