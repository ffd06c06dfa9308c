"""`python -m benchmarks.accuracy`: how far the product is from the truth; time does not count.

Five parts: images of scenes against path-traced references; a white furnace; slabs against the discrete-ordinate method; held-out labels;
and special cases against Monte Carlo walks. Every figure has its 95 % interval. The last line sums up: the largest errors of the
scenes, the furnace's rms deviation and the largest absolute error of a slab's flux. docs/accuracy.md says how each is measured.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from deepclouds_runtime.predictor import Predictor

from benchmarks import accuracy_slabs, accuracy_special
from benchmarks.accuracy_card import as_typed, keep, write_figures
from benchmarks.accuracy_confidence import ConfidenceResult, measure_confidence, rise
from benchmarks.accuracy_figures import Row
from benchmarks.accuracy_furnace import CLOUDS, FurnaceCloud, furnace_rows, measure_furnace
from benchmarks.accuracy_labels import LabelsResult, measure_labels
from benchmarks.accuracy_plots import write_pictures
from benchmarks.accuracy_scenes import SceneResult, measure_scene
from benchmarks.accuracy_slabs import SlabResult, measure_slab, slab_rows
from benchmarks.accuracy_special import CaseResult, measure_case
from benchmarks.bench import find_scenes, machine
from benchmarks.page import write_results
from deepclouds.errors import InputError
from deepclouds.replacing import replacing

ROOT = Path(__file__).resolve().parents[1]
_TITLES = {
    "scene": "Scenes",
    "corrected": "Scenes, corrected by audit walks",
    "furnace": "White furnace",
    "furnace, corrected": "White furnace, corrected by audit walks",
    "slabs": "Slabs",
    "labels": "Held-out labels",
    "special": "Special cases",
    "confidence": "Confidence",
}
_SPECIAL_SEED = 9200


@dataclass(frozen=True)
class Size:
    """How much is measured.

    Attributes
    ----------
    spp, furnace_spp
        samples a pixel of the scenes, and of each of the furnace's renders.
    clouds
        of the furnace.
    every
        every so many-th slab.
    points, walks
        of each special case.
    """

    spp: int = 128
    furnace_spp: int = 32
    clouds: int = CLOUDS
    every: int = 1
    points: int = 256
    walks: int = 65536


QUICK = Size(spp=4, furnace_spp=2, clouds=1, every=10, points=16, walks=64)


@dataclass(frozen=True)
class Results:
    """What was measured, part by part."""

    scenes: list[SceneResult]
    furnace: list[FurnaceCloud]
    slabs: list[SlabResult]
    labels: list[LabelsResult]
    special: list[CaseResult]
    confidence: list[ConfidenceResult]

    @property
    def rows(self) -> list[Row]:
        """All figures."""
        return [
            *(s.row for s in self.scenes),
            *(s.corrected for s in self.scenes),
            *furnace_rows(self.furnace),
            *slab_rows(self.slabs),
            *(row for result in self.labels for row in result.rows),
            *(c.row for c in self.special),
            *(row for result in self.confidence for row in result.rows),
        ]

    @property
    def headline(self) -> str:
        """The last line that is printed."""
        rrmse = max((s.row.figures["rRMSE"] for s in self.scenes), key=lambda f: f.value)
        energy = max((s.row.figures["energy"] for s in self.scenes), key=lambda f: abs(f.value))
        rms, slab = furnace_rows(self.furnace)[0].figures["rms"], slab_rows(self.slabs)[0].figures["largest absolute"]
        return f"accuracy: worst rRMSE {rrmse.bare}, worst energy {energy.bare}, furnace rms {rms.bare}, slab error {slab.bare}"


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print; returns 0. Raises InputError for bad input."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.accuracy", description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--scenes", type=Path, default=Path(__file__).parent / "scenes", help="folder of scenes (default: our own small ones)"
    )
    parser.add_argument("--only", help="comma-separated names of scenes")
    parser.add_argument("--model", help="another model than the released one")
    parser.add_argument("--labels", type=Path, action="append", default=[], help="folder of held-out labels; may be given several times")
    parser.add_argument("--out", type=Path, default=Path("out/accuracy"), help="folder for table and pictures (default %(default)s)")
    parser.add_argument("--quick", action="store_true", help="very little of everything: a check that it runs, not a measurement")
    parser.add_argument("--docs", action="store_true", help="also write docs/accuracy.md and docs/images/accuracy_*.png")
    parser.add_argument("--card", action="store_true", help="also keep figures and pictures for `make card`")
    options = parser.parse_args(argv)
    folders = find_scenes(options.scenes, options.only)
    predictor = Predictor(options.model)
    print(machine())
    print(f"model {predictor.path.name}, weights {predictor.metadata.initialisers_sha256[:12]}")
    results = measure(folders, predictor, QUICK if options.quick else Size(), options.labels)

    options.out.mkdir(parents=True, exist_ok=True)
    body = f"Measured on: {machine()}\n\nModel `{predictor.path.name}`, weights {predictor.metadata.initialisers_sha256[:12]}.\n\n"
    body += f"`{results.headline}`\n\n{markdown(results)}"
    parts = results.scenes, results.furnace, results.slabs, results.labels, results.special, results.confidence
    pictures = write_pictures(options.out, *parts)
    figures = options.out / "accuracy.json"
    write_figures(figures, predictor, as_typed(argv), machine(), results.headline, results.rows)
    kept = keep(figures, pictures, predictor.path.stem) if options.card else []
    with replacing(options.out / "accuracy.md", ".md") as temporary:
        temporary.write_text(f"{body}\n", encoding="utf-8")
    if options.docs:
        for picture in pictures:
            shutil.copyfile(picture, ROOT / "docs" / "images" / picture.name)
        shown = "\n\n".join(f"![{p.stem.replace('_', ', ')}](images/{p.name})" for p in pictures)
        write_results(ROOT / "docs" / "accuracy.md", "accuracy", f"{body}\n\n{shown}")
    print()
    for row in results.rows:
        print(row.line)
    also = (["docs/accuracy.md"] if options.docs else []) + [str(path.relative_to(ROOT)) for path in kept]
    print(f"wrote {', '.join([f'{options.out}/accuracy.md, {figures.name} and {len(pictures)} pictures', *also])}")
    print(results.headline)
    return 0


def measure(folders: Sequence[Path], predictor: Predictor, size: Size, labels: Sequence[Path]) -> Results:
    """Measure part by part, saying after each step what came out."""
    started = time.perf_counter()

    def say(text: str) -> None:
        print(f"{time.perf_counter() - started:5.0f} s  {text}", flush=True)

    results = Results([], [], [], [], [], [])
    for folder in folders:
        results.scenes.append(measure_scene(folder, predictor, size.spp))
        say(results.scenes[-1].row.line)
        say(results.scenes[-1].corrected.line)
    results.furnace.extend(measure_furnace(predictor, size.clouds, size.furnace_spp, say))
    for slab in accuracy_slabs.cases()[:: size.every]:
        results.slabs.append(measure_slab(slab, predictor))
        say(results.slabs[-1].line)
    for folder in labels:
        results.labels.append(measure_labels(folder, predictor.path))
        say(results.labels[-1].rows[0].line)
        if (confidence := measure_confidence(folder, predictor)) is not None:
            results.confidence.append(confidence)
            by = {"expected error": rise(confidence.by_expected), "distance": rise(confidence.by_distance)}
            say(
                f"{confidence.name}: error in the last two tenths over the first two " + ", ".join(f"{v:.2f} by {k}" for k, v in by.items())
            )
    for number, case in enumerate(accuracy_special.cases()):
        results.special.append(measure_case(case, predictor, size.points, size.walks, _SPECIAL_SEED + number))
        say(results.special[-1].row.line)
    return results


def markdown(results: Results) -> str:
    """Tables, one a part; the slabs' cases one by one as well."""
    lines: list[str] = []
    for part, title in _TITLES.items():
        rows = [row for row in results.rows if row.part == part]
        if not rows:
            continue
        names = list(dict.fromkeys(name for row in rows for name in row.figures))
        lines += [f"### {title}", "", f"| case | {' | '.join(names)} |", "|---" * (1 + len(names)) + "|"]
        lines += [f"| {row.case} | {' | '.join(row.figures[n].text if n in row.figures else '' for n in names)} |" for row in rows]
        lines.append("")
    head = "| depth | g | albedo | sun's zenith angle | reflected | exact | transmitted | exact |"
    lines += ["### Slabs, case by case", "", head, "|---" * 8 + "|", *(result.cells for result in results.slabs)]
    return "\n".join(lines)


if __name__ == "__main__":
    try:
        raise SystemExit(main())
    except InputError as error:
        print(f"benchmarks.accuracy: {error}", file=sys.stderr)
        raise SystemExit(2) from None
