"""`deepclouds card MODEL`: a page about models, made of their own metadata and of measured figures.

Nothing on the page is typed in twice: ranges, data, hashes and calibration are the files' own, figures are those that
`python -m benchmarks.accuracy --card` wrote, and both name the weights that they belong to.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from deepclouds.errors import InputError
from deepclouds.model import ModelMetadata
from deepclouds.replacing import replacing

_PARTS = {
    "scene": "Images of scenes against path-traced references",
    "corrected": "The same, corrected by audit walks as `deepclouds render` does by default",
    "furnace": "White furnace: deviation from 1",
    "furnace, corrected": "The same, corrected by audit walks as `deepclouds render` does by default",
    "slabs": "Flux of plane-parallel slabs against the discrete-ordinate method",
    "labels": "Held-out labels",
    "special": "Cases known to be hard",
}
# A picture's own noise, which differs from model to model.
_NOISE = re.compile(r" \(noise [^)]*\)")
_HEAD = """\
Written by `deepclouds card` from the files' metadata and measured figures: `make card` writes it anew. `deepclouds info` prints all that a
file says, `deepclouds verify NAME` checks what it computes on this machine. A render without `--model` takes `accurate`."""
_DATA = """\
Labels are path-traced by `deepclouds generate` in procedural clouds ([clouds.md](clouds.md), [dataset.md](dataset.md)); no measured and no
third-party volume was used for training."""
_INTENDED = """\
Predicting `J`, the source of light scattered more than once, at points that camera rays see in clouds, fog and smoke under distant
lights: by way of `deepclouds render`, the Mitsuba integrator, or any ONNX runtime ([contract.md](contract.md),
[renderer_authors.md](renderer_authors.md)). For pictures. Not for measurements, retrievals or forecasts: errors are several percent of
an image, and more than that in places."""
_LIMITS = """\
- Outside of the ranges above a render traces paths in place of the network, and says so; other programs must look at
  `deepclouds.ranges` themselves.
- The relative error has a long tail: in deep shade, where there is little light, predictions are off by half and more.
- The sharpest light is the least certain: within 10 degrees of the sun, and where a thin fringe stands before it.
- Hard shadows from afar, and shapes with hard edges that no cloud has, are harder than clouds: see the cases below. The expected error
  does not see all of them: where it is too small, the table says so.
- Surfaces are unknown to the network: what they shade and reflect comes from the renderer."""
_MEASURED = """\
With 95 % intervals; [accuracy.md](accuracy.md) says how each is measured. Held-out labels and slabs cover all that users may set, also what
a model's ranges leave out. By"""
_TRUST = """\
A query's *distance* is how far a summary of its stencil and inputs lies from the training data, in units of their spread; half of the
training data lie within the first figure, 99 % within the second. The *expected error* grows with it, and is calibrated on held-out
labels; it is in units of j + 0.05. Below, labels that the calibration did not see (`valid_converged`) and those that it did
(`valid_halves`), in tenths by expected error."""


@dataclass(frozen=True)
class Subject:
    """A model as its card describes it: file name, bytes, weights, multiply-adds of a query, metadata, and figures if there are any."""

    name: str
    size: int
    weights: int
    multiply_adds: int
    metadata: ModelMetadata
    figures: dict[str, Any] | None


def main(argv: Sequence[str], prog: str = "deepclouds card") -> int:
    """Write the page; returns 0, raises InputError for models that cannot be read and figures that belong to other weights."""
    parser = argparse.ArgumentParser(prog=prog, description="Write the card of one or several models: a page made of their metadata.")
    parser.add_argument("models", metavar="MODEL", nargs="+", help="an .onnx file or the name of a released model")
    parser.add_argument(
        "--figures", metavar="PATH", type=Path, action="append", default=[], help="accuracy.json of a model, or a folder of such files"
    )
    parser.add_argument("-o", "--output", metavar="CARD.md", type=Path, required=True, help="file to write")
    options = parser.parse_args(argv)
    if not options.output.parent.is_dir():
        raise InputError(f"{options.output}: the folder {options.output.parent} does not exist; create it first")
    subjects = [describe(model, options.figures) for model in options.models]
    _refuse_unused(options.figures, [subject.metadata.initialisers_sha256 for subject in subjects])
    with replacing(options.output, ".md") as temporary:
        temporary.write_text(page(subjects, options.output.parent), encoding="utf-8")
    missing = [subject.name for subject in subjects if subject.figures is None]
    print(f"wrote {options.output}" + (f"; no figures for {', '.join(missing)}" if missing else ""))
    return 0


def describe(model: str, figures: Sequence[Path]) -> Subject:
    """Read a model and find its figures: those that name its weights."""
    import onnx

    from deepclouds_runtime.multiply_adds import multiply_adds
    from deepclouds_runtime.predictor import Predictor

    predictor = Predictor(model, threads=1)
    arrays = [onnx.numpy_helper.to_array(i) for i in onnx.load(predictor.path).graph.initializer]
    return Subject(
        predictor.path.stem,
        predictor.path.stat().st_size,
        sum(a.size for a in arrays),
        multiply_adds(predictor.path.read_bytes()),
        predictor.metadata,
        _figures(figures, predictor.metadata.initialisers_sha256),
    )


def _figures(paths: Sequence[Path], weights: str) -> dict[str, Any] | None:
    for path in paths:
        for file in sorted(path.glob("*.json")) if path.is_dir() else [path]:
            content = _read(file)
            if content["weights"] == weights:
                return content
    return None


def _read(file: Path) -> dict[str, Any]:
    try:
        content: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        content["weights"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{file}: not the figures of a model ({error}); `make accuracy` writes them") from error
    return content


def _refuse_unused(paths: Sequence[Path], weights: Sequence[str]) -> None:
    """Refuse, by InputError, files that belong to none of the models; those of a folder may."""
    for path in paths:
        if not path.is_dir() and (other := str(_read(path)["weights"])) not in weights:
            known = ", ".join(f"{own[:12]}..." for own in weights)
            raise InputError(f"{path}: belongs to the weights {other[:12]}..., not {known}; measure anew")


def page(subjects: Sequence[Subject], folder: Path) -> str:
    """The page's text; pictures are those in ``folder / "images"``."""
    names = " and ".join(f"`{subject.name}`" for subject in subjects)
    sections = {
        "What they are for": [_INTENDED],
        "At a glance": _table(subjects, _glance(subjects)),
        "Ranges": ["Of the training data.", "", *_table(subjects, _ranges(subjects))],
        "Data": [*_data(subjects), "", _DATA],
        "Errors": _errors(subjects),
        "When not to trust them": _trust(subjects),
        "Known limits": [_LIMITS],
        "Pictures": _pictures(subjects, folder),
        "How to make them again": _again(subjects),
        "Licence": ["Apache-2.0, as the code ([LICENSE](../LICENSE))."],
    }
    lines = [f"# Model card: {names}", "", _HEAD, ""]
    for title, content in sections.items():
        if content:
            lines += [f"## {title}", "", *content, ""]
    return "\n".join(lines)


def _data(subjects: Sequence[Subject]) -> list[str]:
    return [f"- `{s.name}`: {s.metadata.data or 'not recorded in the file'}. Hash {s.metadata.dataset_hash[:16]}." for s in subjects]


def _table(subjects: Sequence[Subject], rows: dict[str, list[str]]) -> list[str]:
    lines = [f"| | {' | '.join(f'`{s.name}`' for s in subjects)} |", "|---" * (1 + len(subjects)) + "|"]
    return lines + [f"| {name} | {' | '.join(cells)} |" for name, cells in rows.items()]


def _glance(subjects: Sequence[Subject]) -> dict[str, list[str]]:
    return {
        "weights": [f"{s.weights:,}" for s in subjects],
        "multiply-adds a query": [f"{s.multiply_adds:,}" for s in subjects],
        "file": [f"{s.size / 1e6:.1f} MB" for s in subjects],
        "queries in a second of one processor, stencils aside": [
            "not measured" if s.figures is None else f"{s.figures['queries_a_core_second']:,.0f}" for s in subjects
        ],
        "contract": [s.metadata.contract for s in subjects],
        "sha256 of the weights": [s.metadata.initialisers_sha256[:16] for s in subjects],
        "made by": [s.metadata.created_by for s in subjects],
    }


def _ranges(subjects: Sequence[Subject]) -> dict[str, list[str]]:
    rows = {
        name: [f"{s.metadata.ranges[name][0]:.3g} to {s.metadata.ranges[name][1]:.4g}" for s in subjects]
        for name in ("gamma", "g1", "g2", "lobe_weight", "albedo", "tau")
    }
    sizes = [s.metadata.size for s in subjects]
    rows["longest side of the cloud, mean free paths"] = ["not recorded" if z is None else f"{z[0]:g} to {z[1]:g}" for z in sizes]
    return rows


def _errors(subjects: Sequence[Subject]) -> list[str]:
    measured = [s for s in subjects if s.figures is not None]
    if not measured:
        return ["Not measured: `python -m benchmarks.accuracy --card` writes the figures of a model."]
    lines = [_MEASURED, ""]
    lines += [f"- `{s.name}`: `{s.figures['command']}`, {s.figures['machine']}" for s in measured if s.figures]
    lines += ["", *(f"- `{s.name}`: {s.figures['headline']}" for s in measured if s.figures)]
    for part, title in _PARTS.items():
        found: dict[str, dict[str, str]] = {}
        for subject in measured:
            for row in (subject.figures or {})["rows"]:
                if row["part"] == part:
                    for name, text in row["figures"].items():
                        found.setdefault(f"{_NOISE.sub('', row['case'])}: {name}", {})[subject.name] = text
        if found:
            rows = {case: [cells.get(s.name, "") for s in measured] for case, cells in found.items()}
            lines += ["", f"### {title}", "", *_table(measured, rows)]
    return lines


def _trust(subjects: Sequence[Subject]) -> list[str]:
    lines = [_TRUST, ""]
    for subject in subjects:
        trust = subject.metadata.trust
        if trust is None:
            lines += [f"- `{subject.name}` says nothing about its errors: only the ranges tell what it does not know."]
            continue
        lines += [
            f"- `{subject.name}`: distances of {trust.quantiles['0.5']:.2f} and {trust.quantiles['0.99']:.2f} ({trust.queries:,} queries "
            f"of the training data); calibrated on {trust.labels:,} held-out labels (hash {trust.labels_hash[:16]})."
        ]
    for subject in subjects:
        rows = [row for row in (subject.figures or {"rows": []})["rows"] if row["part"] == "confidence" and "expected error" in row["case"]]
        if rows:
            lines += ["", f"| `{subject.name}` | expected | found |", "|---|---|---|"]
            lines += [f"| {row['case']} | {row['figures']['expected']} | {row['figures']['found']} |" for row in rows]
    return lines


def _pictures(subjects: Sequence[Subject], folder: Path) -> list[str]:
    titles = {
        "labels": "errors on held-out labels",
        "special": "hard cases: what it predicts against what walks find",
        "confidence": "the error it expects against the error that is found",
    }
    found = [
        (f"images/card_{subject.name}_{part}.png", f"{subject.name}: {title}")
        for subject in subjects
        if subject.figures is not None
        for part, title in titles.items()
    ]
    shown = [(path, title) for path, title in found if (folder / path).is_file()]
    return [line for path, title in shown for line in (f"![{title}]({path})", "")][:-1]


def _again(subjects: Sequence[Subject]) -> list[str]:
    lines = ["`make train-model` makes labels, trains and exports; the recipes in `configs/` have hardware and wall time on top. Then", ""]
    lines += ["    deepclouds calibrate NAME.onnx --data work/labels --labels work/valid_halves"]
    lines += ["    python -m deepclouds_runtime.conformance NAME"]
    lines += ["    python -m benchmarks.accuracy --model NAME --labels work/valid_converged --labels work/valid_halves --card"]
    lines += ["    make card", ""]
    for s in subjects:
        steps = s.metadata.metrics.get("step")
        trained = "" if steps is None else f", {steps:,.0f} steps"
        lines.append(f"- `{s.name}`: configuration {s.metadata.config_hash[:16]}, data {s.metadata.dataset_hash[:16]}{trained}")
    return lines
