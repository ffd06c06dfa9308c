"""Run time against error: deepclouds, path tracing, path tracing denoised, octaves and single scattering, side by side in one run.

    python -m benchmarks.bench [--scenes DIR] [--size 96] [--only name,...] [--out out/bench] [--quick] [--docs]

A folder of scenes holds `<name>/scene.xml` (parameters integrator and size), `ref_a.exr` and `ref_b.exr`. Each method runs in a process
of its own, one after the other, and deepclouds once with each released model that was trained on the scene's medium, the default first.
Writes `bench.csv`, a plot of time against error a scene and `bench.md`; the last lines printed are the speed-up of deepclouds at equal
error, scene by scene, and the medians of the scenes under suns alone and of those under an environment: of each model, and in the last
line of the first.
"""

from __future__ import annotations

import argparse
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
from typing import Any

import numpy as np
from deepclouds_runtime.predictor import RELEASED, find_model
from numpy.typing import NDArray

from benchmarks.bench_plots import write_plots
from benchmarks.bench_rows import Row, label, markdown, medians, models, speed_ups, write_csv
from benchmarks.page import write_results
from benchmarks.worker import DEFAULT_SPP, METHODS, OURS, TIMED
from deepclouds.errors import InputError
from deepclouds.exr import read_exr
from deepclouds.metrics import error_report

ROOT = Path(__file__).resolve().parent.parent


@dataclass(frozen=True)
class Plan:
    """What is run on every scene: methods, models for those that ask one, and samples a pixel of deepclouds and, at the references' size,
    of its peers; the first seed; the folder of images; seconds of an image that is limited in time, by what lights a scene.
    """

    methods: Sequence[str]
    models: Sequence[str]
    ours: Sequence[int]
    peers: Sequence[int]
    seed: int
    out: Path
    times: Mapping[str, float]


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
    parser.add_argument(
        "--time",
        type=float,
        nargs=2,
        metavar=("SUN", "SKY"),
        help="also render ours in so many seconds, scenes under suns and under an environment",
    )
    parser.add_argument(
        "--models",
        help=f"comma-separated names or files of models (default {','.join(RELEASED)}; with --quick the first)",
    )
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
    asked = options.models.split(",") if options.models else RELEASED[:1] if options.quick else RELEASED
    for model in asked:
        find_model(model)
    plan = Plan(
        methods,
        asked,
        _spp_list("--ours", options.ours or ("0" if options.quick else "0,1,4,16"), least=0),
        _spp_list("--spp", options.spp or ("4,16" if options.quick else "16,64,256"), least=1),
        options.seed,
        options.out,
        dict(zip(("sun", "environment"), options.time, strict=True)) if options.time else {},
    )

    print(machine())
    rows: list[Row] = []
    failures: list[str] = []
    for scene in scenes:
        references = [read_exr(scene / f"ref_{name}.exr").rgb() for name in "ab"]
        side = references[0].shape[0]
        size = options.size or (side if options.quick else max(96, side))
        if size % side:
            raise InputError(f"--size {size} is not a multiple of the references of {scene.name}, {side} x {side}")
        measure(scene, size, references, plan, rows, failures)
    write_csv(options.out / "bench.csv", rows)
    table = markdown(rows)
    (options.out / "bench.md").write_text(f"{machine()}\n\n{table}\n")
    plotted = write_plots(options.out, rows)
    if options.docs:
        write_docs(rows, table)
    print(f"wrote {options.out}/bench.csv, bench.md" + (f" and {plotted} plots" if plotted else "; no plots: matplotlib is missing"))
    kinds = {scene.name: light_of(scene / "scene.xml") for scene in scenes}
    of_each = [medians(rows, kinds, model) for model in models(rows)]
    for line in [*failures, *speed_ups(rows), *(of_each if len(of_each) > 1 else []), medians(rows, kinds)]:
        print(line)
    return 1 if failures else 0


def measure(
    scene: Path, size: int, references: Sequence[NDArray[np.floating[Any]]], plan: Plan, rows: list[Row], failures: list[str]
) -> None:
    """Run every method on one scene and add its rows, and what failed, in words."""
    # As many samples in all, whatever the number of pixels that they are spread over.
    spread = sorted({max(1, spp * len(references[0]) ** 2 // size**2) for spp in plan.peers})
    # Octaves have no choice of their own.
    spps = {
        "deepclouds": plan.ours,
        "corrected": [DEFAULT_SPP],
        TIMED: [DEFAULT_SPP],
        "octaves": [n for n in plan.ours if n != DEFAULT_SPP] or [4],
    }
    seconds = plan.times.get(light_of(scene / "scene.xml"))
    for method in (*plan.methods, *([] if seconds is None else [TIMED])):
        for model in plan.models if method in OURS else [None]:
            name = "" if model is None else model_name(model)
            folder = plan.out / scene.name / name
            problem = run_worker(method, scene / "scene.xml", size, spps.get(method, spread), plan.seed, folder, model, seconds)
            if problem is not None:
                failures.append(f"{scene.name}: {label(method, name)} did not run: {problem}")
                print(failures[-1], file=sys.stderr)
                continue
            entries = json.loads((folder / f"{method}.json").read_text())
            if not entries:
                print(f"{scene.name}: {label(method, name)} was left out: the model was not trained on such a medium")
            for entry in entries:
                image, other = (read_exr(folder / name).rgb() for name in entry["files"])
                report = error_report(image, *references, second_seed=other, flip=find_spec("flip_evaluator") is not None)
                spent = entry["seconds_warm"], entry["seconds_cold"]
                rows.append(Row(entry["method"], scene.name, entry["spp"], *spent, report, entry["model"]))
                print(_line(rows[-1]), flush=True)


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


def run_worker(
    method: str, scene: Path, size: int, spps: Sequence[int], seed: int, out: Path, model: str | None, seconds: float | None = None
) -> str | None:
    """Run one method in a fresh process; returns the last line of its complaint, or None when all went well."""
    command = [sys.executable, "-m", "benchmarks.worker", method, str(scene), "--size", str(size), "--seed", str(seed)]
    command += ["--spp", ",".join(map(str, spps)), "--out", str(out), *(["--model", model] if model else [])]
    command += ["--time", str(seconds)] if method == TIMED else []
    # The child finds the same packages as this process, however they were put on the path.
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in (str(ROOT), *sys.path) if p)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode == 0:
        return None
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    return lines[-1] if lines else f"exit code {done.returncode}"


def model_name(model: str) -> str:
    """What a model is called in results: a released one's name, a file's without folder and suffix."""
    return Path(model).stem


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


def light_of(scene: Path) -> str:
    """What lights a scene file: "environment", or "sun" where there is none."""
    kinds = {emitter.get("type") for emitter in ElementTree.parse(scene).getroot().iter("emitter")}
    return "environment" if kinds & {"envmap", "constant", "sunsky"} else "sun"


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
        f"{row.scene:16} {row.label:36} {row.spp_text:>7} spp  {row.seconds_warm:8.3g} s{cold}  "
        f"rRMSE {100 * r.rrmse:.2f} % [{100 * r.rrmse_interval[0]:.2f}, {100 * r.rrmse_interval[1]:.2f}]  "
        f"a pixel {100 * row.error:.2f} %  energy {100 * r.energy:+.2f} %"
    )


if __name__ == "__main__":
    try:
        raise SystemExit(main())
    except InputError as error:
        print(f"benchmarks.bench: {error}", file=sys.stderr)
        raise SystemExit(2) from None
