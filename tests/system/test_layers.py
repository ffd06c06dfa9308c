"""Rationale: a thin wide layer fills little of the cells that its light is interpolated in, and their corners lie above and below it.

Expected behaviour: where corners do not tell what cells err, points inside do: of a layer seen from below, against the light, the fast mode
gives the image that the reference mode gives, and what it says of its interpolation is measured.
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from deepclouds_runtime.loading import load
from deepclouds_training.clouds import make_cloud

from deepclouds.volume import write_vol

SIZE = 48
VIEW: dict[str, Any] = {
    "optical_depth": 10.0,
    "g": 0.85,
    "albedo": 1.0,
    "view": (0, -50),
    "sun": (180, 30),
    "sky": 0.0,
    "size": (SIZE, SIZE),
}


@pytest.fixture
def layer(tmp_path: Path, llvm_mitsuba: ModuleType) -> Path:
    path = tmp_path / "layer.vol"
    write_vol(path, make_cloud("stratus", 5, 96))
    return path


def test_a_layer_against_the_light_is_what_the_network_says(layer: Path) -> None:
    truth = [load(layer, mode="reference", **VIEW).render(32, seed=s).rgb.astype(np.float64) for s in (1, 2)]
    found = load(layer, **VIEW).render(64, seed=3)
    assert found.statistics.sources["suns"]["error"] < 0.18
    tiles = [image.reshape(8, SIZE // 8, 8, SIZE // 8, 3).mean(axis=(1, 3)) for image in (*truth, found.rgb.astype(np.float64))]
    a, b, fast = tiles
    level = float((a + b).mean() / 2)
    assert fast.mean() == pytest.approx(level, rel=0.01)
    # The noises of both references are independent; that of the fast image counts, and is small.
    assert float(np.sqrt(max(((fast - a) * (fast - b)).mean(), 0.0))) / level < 0.035
