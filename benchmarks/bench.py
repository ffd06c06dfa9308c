"""Run time against error: deepclouds, path tracing, path tracing denoised and single scattering, side by side in one run.

    python -m benchmarks.bench [--scenes DIR] [--size 96] [--only name,...] [--out out/bench] [--quick] [--docs]

A folder of scenes holds `<name>/scene.xml` (parameters integrator and size), `ref_a.exr` and `ref_b.exr`. Each method runs in a process
of its own, one after the other. Writes `bench.csv`, a plot of time against error a scene and `bench.md`; the last lines printed are the
speed-up of deepclouds at equal error, scene by scene, and the medians of the scenes under suns alone and of those under an environment.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import platform
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

from benchmarks.equal_error import Bounded, Timing, interpolated_seconds, unbiased_seconds
from benchmarks.page import write_results
from benchmarks.worker import DEFAULT_SPP, METHODS
from deepclouds.errors import InputError
from deepclouds.exr import read_exr
from deepclouds.metrics import ErrorReport, error_report
from deepclouds.replacing import replacing

ROOT = Path(__file__).resolve().parent.parent
_LABELS = {
    "deepclouds": "deepclouds",
    "reference": "deepclouds, every sample asks",
    "volpath": "volpath",
    "oidn": "volpath + OIDN",
    "single": "single scattering",
}


@dataclass(frozen=True)
class Row:
    """One image of one method: what it cost and how wrong it is."""

    method: str
    scene: str
    spp: int
    seconds_warm: float
    seconds_cold: float | None
    report: ErrorReport

    @property
    def spp_text(self) -> str:
        """The spp, or the word for a renderer's own choice."""
        return "default" if self.spp == DEFAULT_SPP else str(self.spp)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark; returns 0, or 1 when a method failed on a scene. Raises InputError for bad input."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bench", description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--scenes", type=Path, default=Path(__file__).parent / "scenes", help="folder of scenes (default: our own small ones)"
    )
    parser.add_argument("--size", type=int, help="pixels a side, a multiple of the references' size (default 96; with --quick that size)")
    parser.add_argument("--only", help="comma-separated names of scenes")
    parser.add_argument("--methods", default=",".join(METHODS), help="comma-separated, out of %(default)s")
    parser.add_argument(
        "--spp", help="spp of the peers at the references' size, fewer for more pixels (default 16,64,256; with --quick 4,16)"
    )
    parser.add_argument("--ours", help="spp of deepclouds, 0 for its own choice (default 0,1,4,16; with --quick 0)")
    parser.add_argument("--model", help="another model for deepclouds than the released one")
    parser.add_argument("--seed", type=int, default=7, help="first seed (default %(default)s); share none with the references")
    parser.add_argument("--out", type=Path, default=Path("out/bench"), help="folder for images, table and plots (default %(default)s)")
    parser.add_argument("--quick", action="store_true", help="few samples: a check that it runs, not a measurement")
    parser.add_argument("--docs", action="store_true", help="also write docs/images/bench_*.png and the table in docs/benchmark.md")
    options = parser.parse_args(argv)
    scenes = find_scenes(options.scenes, options.only)
    methods = options.methods.split(",")
    unknown = [m for m in methods if m not in METHODS]
    if unknown:
        raise InputError(f"--methods: unknown {', '.join(unknown)}; there are {', '.join(METHODS)}")
    # The denoised run holds the noisy images too: tracing them twice would only cost time.
    if "oidn" in methods and "volpath" in methods:
        methods.remove("volpath")
    peers = _spp_list("--spp", options.spp or ("4,16" if options.quick else "16,64,256"), least=1)
    ours = _spp_list("--ours", options.ours or ("0" if options.quick else "0,1,4,16"), least=0)

    print(machine())
    rows: list[Row] = []
    failures: list[str] = []
    for scene in scenes:
        references = [read_exr(scene / f"ref_{name}.exr").rgb() for name in "ab"]
        side = references[0].shape[0]
        size = options.size or (side if options.quick else max(96, side))
        if size % side:
            raise InputError(f"--size {size} is not a multiple of the references of {scene.name}, {side} x {side}")
        for method in methods:
            folder = options.out / scene.name
            # As many samples in all, whatever the number of pixels that they are spread over.
            spps = ours if method == "deepclouds" else sorted({max(1, spp * side**2 // size**2) for spp in peers})
            problem = run_worker(method, scene / "scene.xml", size, spps, options.seed, folder, options.model)
            if problem is not None:
                failures.append(f"{scene.name}: {_LABELS[method]} did not run: {problem}")
                print(failures[-1], file=sys.stderr)
                continue
            for entry in json.loads((folder / f"{method}.json").read_text()):
                image = read_exr(folder / entry["file"]).rgb()
                report = error_report(image, *references, flip=find_spec("flip_evaluator") is not None)
                rows.append(Row(entry["method"], scene.name, entry["spp"], entry["seconds_warm"], entry["seconds_cold"], report))
                print(_line(rows[-1]), flush=True)
    write_csv(options.out / "bench.csv", rows)
    table = markdown(rows)
    (options.out / "bench.md").write_text(f"{machine()}\n\n{table}\n")
    plotted = write_plots(options.out, rows)
    if options.docs:
        write_docs(rows, table)
    print(f"wrote {options.out}/bench.csv, bench.md" + (f" and {plotted} plots" if plotted else "; no plots: matplotlib is missing"))
    kinds = {scene.name: light_of(scene / "scene.xml") for scene in scenes}
    for line in [*failures, *speed_ups(rows), medians(rows, kinds)]:
        print(line)
    return 1 if failures else 0


def find_scenes(folder: Path, only: str | None) -> list[Path]:
    """Folders below `folder` that hold a scene and its references, by name.

    Raises
    ------
    InputError
        when there is none, a name of `only` is unknown, or a reference is missing.
    """
    found = {p.parent.name: p.parent for p in sorted(folder.glob("*/scene.xml"))}
    if not found:
        raise InputError(
            f"{folder}: no scene; a scene is a folder with scene.xml, ref_a.exr and ref_b.exr (benchmarks.make_scenes writes ours)"
        )
    names = list(found) if only is None else only.split(",")
    unknown = [n for n in names if n not in found]
    if unknown:
        raise InputError(f"--only: no scene {', '.join(unknown)} in {folder}; there are {', '.join(found)}")
    for name in names:
        for reference in ("ref_a.exr", "ref_b.exr"):
            if not (found[name] / reference).is_file():
                raise InputError(f"{found[name] / reference}: missing; render two independent references of the scene")
    return [found[n] for n in names]


def run_worker(method: str, scene: Path, size: int, spps: Sequence[int], seed: int, out: Path, model: str | None) -> str | None:
    """Run one method in a fresh process; returns the last line of its complaint, or None when all went well."""
    command = [sys.executable, "-m", "benchmarks.worker", method, str(scene), "--size", str(size), "--seed", str(seed)]
    command += ["--spp", ",".join(map(str, spps)), "--out", str(out), *(["--model", model] if model else [])]
    # The child finds the same packages as this process, however they were put on the path.
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in (str(ROOT), *sys.path) if p)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode == 0:
        return None
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    return lines[-1] if lines else f"exit code {done.returncode}"


def machine() -> str:
    """One line on where this runs: processor, usable cores, load, versions."""
    try:
        text = Path("/proc/cpuinfo").read_text()
        processor = next((line.split(":", 1)[1].strip() for line in text.splitlines() if line.startswith("model name")), platform.machine())
    except OSError:
        processor = platform.machine()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    versions = []
    for package in ("deepclouds", "mitsuba", "drjit", "onnxruntime", "mitsuba-oidn"):
        try:
            versions.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            continue
    return (
        f"{processor}, {cores} cores, load {os.getloadavg()[0]:.1f} at the start; Python {platform.python_version()}, {', '.join(versions)}"
    )


def equal_error(rows: Sequence[Row], ours: Row, error: float | None = None) -> dict[str, Bounded]:
    """Seconds that each peer needs on the scene of `ours` to reach an error (default: that of `ours`)."""
    target = ours.report.rrmse if error is None else error
    peers: dict[str, Bounded] = {}
    for method, seconds in (("volpath", unbiased_seconds), ("oidn", interpolated_seconds)):
        timings = [Timing(r.seconds_warm, r.report.rrmse) for r in rows if (r.method, r.scene) == (method, ours.scene)]
        if timings and target > 0 and all(t.error > 0 for t in timings):
            peers[method] = seconds(timings, target)
    return peers


def speed_ups(rows: Sequence[Row]) -> list[str]:
    """One line a scene: deepclouds' time and error, what its peers need to the same error, and the ratios.

    The row with deepclouds' own choice of samples counts, else the one with most. The range in brackets is the ratio at both ends of
    the interval of deepclouds' error.
    """
    lines = []
    for scene in dict.fromkeys(r.scene for r in rows):
        candidates = [r for r in rows if r.scene == scene and r.method == "deepclouds"]
        if not candidates:
            lines.append(f"{scene}: no speed-up, deepclouds was not run")
            continue
        ours = next((r for r in candidates if r.spp == DEFAULT_SPP), max(candidates, key=lambda r: r.spp))
        parts = []
        for method, needed in equal_error(rows, ours).items():
            low, high = (equal_error(rows, ours, e).get(method) for e in reversed(ours.report.rrmse_interval))
            spread = f" [{low.over(ours.seconds_warm)}, {high.over(ours.seconds_warm)}]" if low is not None and high is not None else ""
            parts.append(f"{needed.over(ours.seconds_warm)} x{spread} against {_LABELS[method]} ({needed} s)")
        reached = f"{scene}: deepclouds reaches {100 * ours.report.rrmse:.2f} % in {ours.seconds_warm:.3g} s"
        lines.append(f"{reached}; at equal error {'; '.join(parts)}" if parts else f"{reached}; no peer to compare with")
    return lines


def light_of(scene: Path) -> str:
    """What lights a scene file: "environment", or "sun" where there is none."""
    kinds = {emitter.get("type") for emitter in ElementTree.parse(scene).getroot().iter("emitter")}
    return "environment" if kinds & {"envmap", "constant"} else "sun"


def medians(rows: Sequence[Row], kinds: Mapping[str, str]) -> str:
    """Medians over scenes of the speed-up at equal error, under suns alone and under an environment."""

    def median(kind: str, method: str) -> str:
        ratios = []
        for scene in (s for s in dict.fromkeys(r.scene for r in rows) if kinds[s] == kind):
            candidates = [r for r in rows if (r.scene, r.method) == (scene, "deepclouds")]
            if not candidates:
                continue
            ours = next((r for r in candidates if r.spp == DEFAULT_SPP), max(candidates, key=lambda r: r.spp))
            needed = equal_error(rows, ours).get(method)
            if needed is not None:
                ratios.append(needed.over(ours.seconds_warm))
        if not ratios:
            return "unknown"
        ratios.sort(key=lambda r: r.value)
        low, high = ratios[(len(ratios) - 1) // 2], ratios[len(ratios) // 2]
        bounds = {b for b in (low.bound, high.bound) if b}
        return str(Bounded(0.5 * (low.value + high.value), bounds.pop() if len(bounds) == 1 else ""))

    sun = f"sun {median('sun', 'volpath')} x volpath, {median('sun', 'oidn')} x volpath+OIDN"
    return f"speed: {sun}; environment {median('environment', 'volpath')} x volpath"


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write one line an image; fractions, not per cent; an empty field is a figure that was not measured."""
    path.parent.mkdir(parents=True, exist_ok=True)
    names = ["method", "scene", "spp", "seconds_warm", "seconds_cold", "rrmse", "rrmse_low", "rrmse_high"]
    names += ["energy", "energy_low", "energy_high", "dark_energy", "worst_tile", "flip"]

    with replacing(path, ".csv") as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(names)
        for row in rows:
            r = row.report
            cold = "" if row.seconds_cold is None else f"{row.seconds_cold:.6g}"
            figures = [r.rrmse, *r.rrmse_interval, r.energy, *r.energy_interval, r.dark_energy, r.worst_tile]
            texts = [f"{x:.6g}" for x in figures] + ["" if r.flip is None else f"{r.flip:.6g}"]
            writer.writerow([row.method, row.scene, row.spp_text, f"{row.seconds_warm:.6g}", cold, *texts])


def markdown(rows: Sequence[Row]) -> str:
    """Lay the rows out as a table, in per cent, with the time that the peers need to the error of each deepclouds row."""
    lines = [
        "| scene | method | spp | warm s | cold s | rRMSE % | energy % | worst tile % | FLIP | volpath to the same | OIDN to the same |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        r = row.report
        interval = f"{100 * r.rrmse:.2f} [{100 * r.rrmse_interval[0]:.2f}, {100 * r.rrmse_interval[1]:.2f}]"
        energy = f"{100 * r.energy:+.2f} [{100 * r.energy_interval[0]:+.2f}, {100 * r.energy_interval[1]:+.2f}]"
        peers = equal_error(rows, row) if row.method in ("deepclouds", "reference") else {}
        needed = [f"{peers[m]} s ({peers[m].over(row.seconds_warm)} x)" if m in peers else "" for m in ("volpath", "oidn")]
        cold = "" if row.seconds_cold is None else f"{row.seconds_cold:.3g}"
        flip = "" if r.flip is None else f"{r.flip:.4f}"
        cells = [
            row.scene,
            _LABELS[row.method],
            row.spp_text,
            f"{row.seconds_warm:.3g}",
            cold,
            interval,
            energy,
            f"{100 * r.worst_tile:+.1f}",
            flip,
        ]
        lines.append("| " + " | ".join([*cells, *needed]) + " |")
    return "\n".join(lines)


def write_plots(folder: Path, rows: Sequence[Row]) -> int:
    """Write `bench_<scene>.png`, time against error; returns how many, 0 without matplotlib."""
    if find_spec("matplotlib") is None:
        return 0
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    scenes = list(dict.fromkeys(r.scene for r in rows))
    folder.mkdir(parents=True, exist_ok=True)
    styles = {
        "deepclouds": ("#b3122a", "o"),
        "reference": ("#d98a94", "D"),
        "volpath": ("#444444", "s"),
        "oidn": ("#2a55a8", "^"),
        "single": ("#b08a2e", "x"),
    }
    for scene in scenes:
        figure = Figure(figsize=(5.2, 3.9), dpi=130, layout="constrained")
        FigureCanvasAgg(figure)
        axis = figure.subplots()
        for method, (colour, marker) in styles.items():
            points = sorted(
                (r for r in rows if (r.scene, r.method) == (scene, method) and r.report.rrmse > 0), key=lambda r: r.seconds_warm
            )
            if not points:
                continue
            errors = [100 * p.report.rrmse for p in points]
            bars = [
                [e - 100 * p.report.rrmse_interval[0] for e, p in zip(errors, points, strict=True)],
                [100 * p.report.rrmse_interval[1] - e for e, p in zip(errors, points, strict=True)],
            ]
            bars = [[max(0.0, b) for b in side] for side in bars]
            axis.errorbar(
                [p.seconds_warm for p in points], errors, bars, color=colour, marker=marker, capsize=2, lw=1.2, label=_LABELS[method]
            )
        axis.set(xscale="log", yscale="log", xlabel="seconds, warm", ylabel="rRMSE, %", title=scene)
        axis.grid(which="both", color="#dddddd", lw=0.5)
        axis.legend(frameon=False, fontsize=8)

        with replacing(folder / f"bench_{scene}.png", ".png") as temporary:
            figure.savefig(temporary, format="png")
    return len(scenes)


def write_docs(rows: Sequence[Row], table: str, docs: Path = ROOT / "docs") -> None:
    """Put plots into `docs/images` and the table between the marks of `docs/benchmark.md`.

    Raises
    ------
    InputError
        when the page or its marks are missing.
    """
    scenes = dict.fromkeys(r.scene for r in rows)
    pictures = "\n".join(f"![time against error, {s}](images/bench_{s}.png)" for s in scenes) if find_spec("matplotlib") is not None else ""
    ratios = "\n".join(f"- {line}" for line in speed_ups(rows))
    write_results(docs / "benchmark.md", "bench", f"Measured on: {machine()}\n\n{ratios}\n\n{table}\n\n{pictures}")
    write_plots(docs / "images", rows)


def _spp_list(flag: str, text: str, least: int) -> list[int]:
    try:
        values = [int(v) for v in text.split(",")]
    except ValueError:
        values = []
    if not values or min(values) < least:
        raise InputError(f"{flag} {text}: needs comma-separated whole numbers of at least {least}")
    return values


def _line(row: Row) -> str:
    r = row.report
    cold = "" if row.seconds_cold is None else f", cold {row.seconds_cold:.3g} s"
    return (
        f"{row.scene:16} {_LABELS[row.method]:17} {row.spp_text:>7} spp  {row.seconds_warm:8.3g} s{cold}  "
        f"rRMSE {100 * r.rrmse:.2f} % [{100 * r.rrmse_interval[0]:.2f}, {100 * r.rrmse_interval[1]:.2f}]  energy {100 * r.energy:+.2f} %"
    )


if __name__ == "__main__":
    try:
        raise SystemExit(main())
    except InputError as error:
        print(f"benchmarks.bench: {error}", file=sys.stderr)
        raise SystemExit(2) from None
