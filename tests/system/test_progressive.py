"""Rationale: a render that takes long is watched and stopped; nothing that was computed may be lost, and nothing half written remain.

Expected behaviour: pictures on the way begin with a quick look and do not change the final image; an interruption ends the render after the
running pass with an image of what there is, exit code 130, and no temporary file beside it.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType
from typing import Any

import deepclouds_runtime
import numpy as np
import pytest
from deepclouds_runtime.loading import load
from deepclouds_runtime.output import is_complete, save
from deepclouds_runtime.renderer import Renderer
from deepclouds_runtime.result import RenderResult
from numpy.typing import NDArray

from deepclouds.exr import read_exr, write_exr
from tests.system.smooth_network import Smooth

CLOUD = Path(deepclouds_runtime.__file__).parent / "data" / "demo.vdb"


@pytest.fixture(autouse=True)
def mi(llvm_mitsuba: ModuleType) -> ModuleType:
    return llvm_mitsuba


@pytest.fixture
def renderer() -> Renderer:
    return load(CLOUD, predictor=Smooth(), size=(40, 30))


@pytest.mark.parametrize("spp", [None, 11])
def test_pictures_on_the_way_do_not_change_the_image(renderer: Renderer, spp: int | None) -> None:
    plain = renderer.render(spp, seed=3, error=0.03)
    seen: list[RenderResult] = []
    noises: list[float] = []
    watched = renderer.render(spp, seed=3, error=0.03, partial=seen.append, estimate=noises.append)
    np.testing.assert_allclose(watched.rgb, plain.rgb, rtol=1e-4, atol=1e-6)
    assert watched.statistics.complete
    assert watched.statistics.spp == plain.statistics.spp
    # The look, then one after each round but the last.
    assert len(seen) == len(noises) + 1 >= 3
    assert noises[-1] == watched.statistics.noise
    assert not any(picture.statistics.complete for picture in seen)
    assert [picture.statistics.spp for picture in seen[:2]] == [1, 1]
    assert seen[0].statistics.sources["suns"]["nodes"] < 0.5 * seen[1].statistics.sources["suns"]["nodes"]
    # The look shows the image: another sample of it would differ by the noise of one sample.
    for picture in seen:
        assert picture.rgb.mean() == pytest.approx(plain.rgb.mean(), rel=0.03)
    errors = [np.sqrt(np.mean((p.rgb - plain.rgb) ** 2)) for p in seen[1:]]
    assert errors[-1] < errors[0]


@pytest.mark.parametrize(("spp", "after"), [(None, 1), (None, 3), (64, 1), (64, 4)])
def test_an_interruption_leaves_an_image_of_what_there_is(renderer: Renderer, spp: int | None, after: int) -> None:
    asked = iter(range(1, 1000))
    result = renderer.render(spp, seed=3, error=1e-3, interrupted=lambda: next(asked) >= after)
    assert not result.statistics.complete
    assert 1 <= result.statistics.mean_spp < 64
    assert np.all(np.isfinite(result.rgb))
    full = renderer.render(64, seed=3)
    assert result.rgb.mean() == pytest.approx(full.rgb.mean(), rel=0.03)


@pytest.mark.parametrize(
    ("how", "noise"), [({}, 0.01), ({"mode": "reference"}, 0.01), ({"unbiased": True}, 0.1)], ids=["fast", "reference", "unbiased"]
)
def test_a_number_of_samples_and_the_time_end_at_what_comes_first(how: dict[str, Any], noise: float) -> None:
    renderer = load(CLOUD, predictor=Smooth(), size=(40, 30), **how)
    short = renderer.render(4096, seed=3, time_limit=1e-6)
    assert (short.statistics.mean_spp, short.statistics.complete) == (1, True)
    alone, timed = renderer.render(24, seed=3), renderer.render(24, seed=3, time_limit=1e9)
    assert (alone.statistics.spp, timed.statistics.spp, timed.statistics.mean_spp) == (24, 24, 24)
    # Depths are spread otherwise where the number may be cut, but over as much.
    assert timed.rgb.mean() == pytest.approx(alone.rgb.mean(), rel=noise)


def test_an_interruption_between_passes_keeps_them(renderer: Renderer, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pixels then have taken different numbers of samples, and each is divided by its own."""
    monkeypatch.setattr("deepclouds_runtime.frame._PASS", 1000)
    # Asked before the second round, and before each of its two passes; what is asked during the prediction does not count.
    asked, network = iter(range(1, 1000)), renderer._network
    assert network is not None
    result = renderer.render(16, seed=3, interrupted=lambda: network.stop is None and next(asked) >= 3)
    assert 1 < result.statistics.mean_spp < result.statistics.spp == 2
    np.testing.assert_allclose(result.rgb.mean(axis=(0, 1)), renderer.render(64, seed=3).rgb.mean(axis=(0, 1)), rtol=0.03)
    empty = result.channels["volume_opacity"] == 0
    sky = np.array([0.09, 0.17, 0.34])
    assert empty.any()
    np.testing.assert_allclose(result.rgb[empty] / sky, 1, rtol=1e-5)


def test_an_image_says_whether_it_is_complete(renderer: Renderer, tmp_path: Path) -> None:
    path = tmp_path / "image.exr"
    result = renderer.render(2, interrupted=lambda: True)
    save(result, path)
    assert not is_complete(path)
    save(renderer.render(1), path)
    assert is_complete(path)
    write_exr(path, {"R": np.zeros((2, 2), np.float32)})
    assert is_complete(path)
    path.write_bytes(path.read_bytes()[:60])
    assert not is_complete(path)


def test_an_interruption_does_not_wait_for_the_prediction(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whole, it would ask for all nodes; given up, for the batches so far and the nodes of a quick look."""
    monkeypatch.setattr("deepclouds_runtime.scattering._CHUNK", 256)
    asked: list[int] = []

    class Asked(Smooth):
        def predict(self, stencil: NDArray[np.float32], aux: NDArray[np.float32]) -> NDArray[np.float32]:
            asked.append(len(stencil))
            return super().predict(stencil, aux)

    renderer = load(CLOUD, predictor=Asked(), size=(40, 30))
    full = renderer.render(8, seed=3)
    whole, asked[:] = sum(asked), []
    looked: list[RenderResult] = []
    renderer.render(1, seed=3, partial=looked.append)
    look = sum(asked) - whole
    asked.clear()
    stopped = renderer.render(8, seed=3, interrupted=lambda: len(asked) >= 2)
    assert asked[:2] == [256, 256]
    # No batch more of it: what follows is the quick look, whole.
    assert sum(asked) == 512 + look < whole
    assert not stopped.statistics.complete
    assert stopped.statistics.mean_spp == 1
    assert stopped.rgb.mean() == pytest.approx(full.rgb.mean(), rel=0.03)
    assert renderer.render(8, seed=3).rgb.mean() == pytest.approx(full.rgb.mean(), rel=1e-4)


def _started(root: Path, arguments: list[str]) -> subprocess.Popen[str]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(str(root / part) for part in (".", "training", "runtime"))}
    code = "import sys; from deepclouds.cli import main; sys.exit(main())"
    command = [sys.executable, "-u", "-c", code, "render", str(CLOUD), *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)


def _until(process: subprocess.Popen[str], path: Path) -> None:
    end = time.monotonic() + 240
    while not path.exists():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.05)


@pytest.mark.parametrize(("number", "how"), [(signal.SIGINT, []), (signal.SIGTERM, ["--unbiased"])])
def test_a_signal_ends_the_command_with_what_there_is(root: Path, tmp_path: Path, number: int, how: list[str]) -> None:
    out = tmp_path / "out.exr"
    arguments = ["-o", str(out), "--png", "--size", "48x36", "--spp", "500000", "--progressive", "0", *how]
    with _started(root, arguments) as process:
        # The first image is there long before the last.
        _until(process, out)
        assert not is_complete(out)
        process.send_signal(number)
        printed, said = process.communicate(timeout=240)
    assert process.returncode == 130, said
    assert f"interrupted: wrote {out} and {out.with_suffix('.png')} with" in said
    assert "Traceback" not in said
    image = read_exr(out)
    statistics = json.loads(str(image.attributes["deepclouds"]))["statistics"]
    assert not statistics["complete"]
    assert 1 <= statistics["mean_spp"] < 500000
    assert image.channels["volume_opacity"].max() > 0.9
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out.exr", "out.png"]
    assert "wrote" not in printed


def test_a_second_signal_ends_at_once(root: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.exr"
    with _started(root, ["-o", str(out), "--size", "48x36", "--spp", "500000", "--progressive", "1000", "--unbiased"]) as process:
        _until(process, out)
        stamp = out.stat().st_mtime_ns
        for _ in range(2):
            process.send_signal(signal.SIGINT)
            time.sleep(0.02)
        _, said = process.communicate(timeout=240)
    # The first signal may be done with, image and all, before the second one comes: that one ends a program on its way out,
    # which a shell calls 130 too.
    late = "interrupted: wrote" in said and process.returncode == -signal.SIGINT
    assert process.returncode == 130 or late, said
    assert said.rstrip().endswith("interrupted") or "interrupted: wrote" in said
    assert "Traceback" not in said
    assert [p.name for p in tmp_path.iterdir()] == ["out.exr"]
    read_exr(out)
    assert ("interrupted: wrote" in said) == (out.stat().st_mtime_ns != stamp)
