"""Figures of a model as a file that its card is made of: `deepclouds card` reads it."""

from __future__ import annotations

import json
import shlex
import shutil
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from deepclouds_runtime.predictor import BATCH, Predictor

from benchmarks.accuracy_figures import Row
from deepclouds.model import AUX, LEVELS, POINTS
from deepclouds.replacing import replacing

ROOT = Path(__file__).resolve().parents[1]
# Figures of the released models, and how a picture of one is called.
FOLDER, IMAGES = ROOT / "docs" / "figures", ROOT / "docs" / "images"
# What a card shows of the pictures.
SHOWN = ("labels", "special", "confidence")
_BATCHES = 40


def write_figures(path: Path, predictor: Predictor, command: str, machine: str, headline: str, rows: Sequence[Row]) -> None:
    """Write what was measured of a model, with the command that did it, the machine, and the speed of the network alone."""
    content = {
        "model": predictor.metadata.name,
        "weights": predictor.metadata.initialisers_sha256,
        "command": command,
        "machine": machine,
        "headline": headline,
        "queries_a_core_second": round(queries_a_core_second(predictor), -2),
        "rows": [
            {"part": row.part, "case": row.case, "figures": {name: figure.text for name, figure in row.figures.items()}} for row in rows
        ],
    }
    with replacing(path, ".json") as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def keep(figures: Path, pictures: Sequence[Path], name: str) -> list[Path]:
    """Copy figures and pictures of the model `name` to where `make card` looks for them; returns the copies."""
    FOLDER.mkdir(exist_ok=True)
    copies = {figures: FOLDER / f"{name}.json"}
    for picture in pictures:
        part = picture.stem.removeprefix("accuracy_")
        if part in SHOWN:
            copies[picture] = IMAGES / f"card_{name}_{part}.png"
    for source, target in copies.items():
        shutil.copyfile(source, target)
    return list(copies.values())


def as_typed(arguments: Sequence[str] | None) -> str:
    """The command line, folders outside of this project by their last name alone, and without where results go."""
    words: list[str] = []
    given = list(sys.argv[1:] if arguments is None else arguments)
    for before, word in zip(["", *given], given, strict=False):
        if "--out" in (before, word):
            continue
        path = Path(word)
        words.append(path.name if path.is_absolute() or word.startswith("..") else word)
    return shlex.join(["python", "-m", "benchmarks.accuracy", *words])


def queries_a_core_second(predictor: Predictor) -> float:
    """Queries of the network alone, without stencils, in a second of one processor."""
    one = Predictor(predictor.path, threads=1)
    rng = np.random.default_rng(0)
    stencil = rng.uniform(0, 0.1, (BATCH, LEVELS, POINTS)).astype(np.float32)
    aux = np.tile(np.array([[1.0, 0.8, 0.0, 1.0, 1.0, 1.0]], np.float32), (BATCH, 1))
    assert aux.shape[1] == len(AUX)
    one.predict(stencil, aux)
    spent = []
    for _ in range(_BATCHES):
        clock = time.process_time()
        one.predict(stencil, aux)
        spent.append(time.process_time() - clock)
    # Other work on the machine only ever adds.
    return BATCH / float(np.quantile(spent, 0.25))
