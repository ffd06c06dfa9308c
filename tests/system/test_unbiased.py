"""Rationale: an unbiased render is the reference that all else is held against, so that its error must be what was asked for.

Expected behaviour: no network is loaded; samples are spent until the noise asked for is reached, as a longer render confirms, or until the
time is over; what it will take is said. That its mean is volpath's is tested in test_render_volpath.py.
"""

from __future__ import annotations

import json
import logging
import time
from pathlib import Path
from types import ModuleType
from typing import Any

import deepclouds_runtime.predictor
import numpy as np
import pytest
from deepclouds_runtime.loading import load
from deepclouds_runtime.render import main
from deepclouds_runtime.renderer import Renderer

from deepclouds.exr import read_exr
from deepclouds.volume import Volume, write_vol

HOW: dict[str, Any] = {"unbiased": True, "size": (24, 16), "optical_depth": 12.0, "g": 0.5}


@pytest.fixture(autouse=True)
def mi(llvm_mitsuba: ModuleType) -> ModuleType:
    return llvm_mitsuba


@pytest.fixture
def cloud(tmp_path: Path) -> Path:
    c = (np.arange(12) + 0.5) / 6 - 1
    z, y, x = np.meshgrid(c, c, c, indexing="ij")
    ball = np.clip(4 * (0.9 - np.sqrt(x * x + y * y + z * z)), 0, 1) * (1.2 + x)
    write_vol(tmp_path / "ball.vol", Volume.from_box(ball.astype(np.float32), (-1, -1, -1), (1, 1, 1)))
    return tmp_path / "ball.vol"


@pytest.fixture
def renderer(cloud: Path, monkeypatch: pytest.MonkeyPatch) -> Renderer:
    def refused(*arguments: object) -> None:
        raise AssertionError("no network is needed")

    monkeypatch.setattr(deepclouds_runtime.predictor, "Predictor", refused)
    return load(cloud, **HOW)


def test_the_error_asked_for_is_reached(renderer: Renderer) -> None:
    a, b = (renderer.render(1024, seed=s).rgb.astype(np.float64) for s in (11, 12))
    truth = 0.5 * (a + b)
    lit = truth > 0.02 * np.quantile(truth, 0.999)
    # The references' own noise, which a difference to them has too.
    own = np.mean(((a - b)[lit]) ** 2) / 4
    taken = []
    for error in (0.12, 0.05):
        found = [renderer.render(seed=s, error=error) for s in (1, 2)]
        squared = [np.mean((f.rgb - truth)[lit] ** 2) - own for f in found]
        measured = float(np.sqrt(np.mean(squared))) / truth[lit].mean()
        # An estimate is stopped at where chance has it low; paths are noisy, and so is what is known of their noise.
        assert 0.5 * error < measured < 1.2 * error
        for f in found:
            assert f.statistics.noise is not None
            assert f.statistics.noise <= error
            assert f.statistics.mode == "path-traced"
            assert f.statistics.complete
            assert f.statistics.error["network"] == {"by": "none"}
            # No pixel rests: what found little light by chance would stay dark.
            assert f.statistics.spp == f.statistics.mean_spp
        taken.append(np.mean([f.statistics.spp for f in found]))
    # Noise falls with the root of the number.
    assert 0.4 * (0.12 / 0.05) ** 2 < taken[1] / taken[0] < 2.5 * (0.12 / 0.05) ** 2


def test_time_alone_decides_where_no_error_is_given(renderer: Renderer) -> None:
    started = time.perf_counter()
    few = renderer.render(seed=1, time_limit=1e-6)
    one = time.perf_counter() - started
    assert few.statistics.mean_spp == 1
    assert few.statistics.noise is None
    # However slow the machine is.
    many = renderer.render(seed=1, time_limit=max(0.5, 20 * one))
    # An error of 2 % would be reached sooner.
    small = renderer.render(seed=1, time_limit=1e9, error=0.3)
    assert small.statistics.noise is not None
    assert small.statistics.noise <= 0.3
    assert many.statistics.mean_spp >= 2


def test_samples_and_error_end_at_what_comes_first(renderer: Renderer) -> None:
    few = renderer.render(4096, seed=1, error=0.3)
    assert few.statistics.noise is not None
    assert few.statistics.noise <= 0.3
    assert few.statistics.complete
    assert few.statistics.mean_spp < 1000
    assert renderer.render(3, seed=1, error=1e-3).statistics.mean_spp == 3


def test_the_command_says_what_it_does(cloud: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture) -> None:
    out = cloud.parent / "image.exr"
    caplog.set_level(logging.INFO)
    arguments = ["--unbiased", "--error", "0.08", "--size", "14x10", "--optical-depth", "12", "--g", "0.5"]
    assert main([str(cloud), "-o", str(out), *arguments]) == 0
    said = capsys.readouterr().out
    assert "note: unbiased: paths are traced with our own tracker until the noise is as asked; no network is asked" in said
    assert "none was asked" in said
    (ahead,) = [r.getMessage() for r in caplog.records if r.getMessage().startswith("path tracing")]
    assert "0.08 takes about" in ahead
    header = json.loads(str(read_exr(out).attributes["deepclouds"]))
    assert header["unbiased"]
    assert header["statistics"]["noise"] <= 0.08
    assert header["statistics"]["error"]["network"] == {"by": "none"}
    assert header["counts"]["queries"] > header["counts"]["camera_samples"] / 4
