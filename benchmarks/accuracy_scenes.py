"""Images against two independent path-traced references each: rRMSE and energy of every scene of a folder, also where walks correct it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from deepclouds_runtime.loading import load
from deepclouds_runtime.scattering import Predicts
from numpy.typing import NDArray

from benchmarks.accuracy_figures import Figure, Row
from deepclouds.exr import read_exr
from deepclouds.metrics import error_report

Floats = NDArray[np.float64]
# The references' seeds lie far above.
_SEED = 41


@dataclass(frozen=True)
class SceneResult:
    """The figures of one scene, as predicted and corrected by audit walks, and its predicted image and mean reference (h, w, 3)."""

    name: str
    row: Row
    corrected: Row
    image: Floats
    reference: Floats


def measure_scene(folder: Path, predictor: Predicts, spp: int) -> SceneResult:
    """Render at the references' size, as two halves of `spp` / 2 samples with different seeds, whose difference tells the noise."""
    a, b = (np.asarray(read_exr(folder / f"ref_{name}.exr").rgb(), np.float64) for name in "ab")
    renderer = load(folder / "scene.xml", defines={"size": str(a.shape[0])}, predictor=predictor)
    rows, images = [], []
    for part, correct in (("scene", False), ("corrected", True)):
        halves = [np.asarray(renderer.render(max(1, spp // 2), seed, correct=correct).rgb, np.float64) for seed in (_SEED, _SEED + 1)]
        images.append(0.5 * (halves[0] + halves[1]))
        report = error_report(images[-1], a, b)
        noise = error_report(halves[0], a, b, second_seed=halves[1], resamples=0).noise or 0.0
        figures = {
            "rRMSE": Figure(report.rrmse, *report.rrmse_interval),
            "energy": Figure(report.energy, *report.energy_interval, signed=True),
            "darkest third": Figure(report.dark_energy, *report.dark_energy_interval, signed=True),
        }
        rows.append(Row(part, f"{folder.name} (noise {100 * noise / np.sqrt(2):.1f} %)", figures))
    return SceneResult(folder.name, rows[0], rows[1], images[0], 0.5 * (a + b))
