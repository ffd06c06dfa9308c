"""Rationale: a cloud in bricks must be the same cloud in every part of a render.

Expected behaviour: from one file, read as a dense grid and as bricks, both modes give the same picture but for rounding, from the same
camera and with the same extinction; a large box with little in it renders in little memory, and the report says how much.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from deepclouds_runtime.renderer import Renderer
from deepclouds_runtime.result import RenderResult
from deepclouds_runtime.volume_scene import VolumeOptions, volume_scene
from numpy.typing import NDArray

from deepclouds.exr import read_exr
from deepclouds.volume import Bricks, SparseVolume, Volume, pyramid, read_vdb, write_vdb

# A small stand-in for the network is as good here: what differs would differ before it.
OPTIONS = VolumeOptions(size=(40, 30), view=(20, 15), optical_depth=8)


class Smooth:
    """Stands in for a network, moved by every level of the stencil."""

    def predict(self, stencil: NDArray[np.float32], aux: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return j (n,)."""
        value: NDArray[np.float32] = (0.3 + stencil.mean(axis=(1, 2))) * np.exp(-0.5 * aux[:, 5]).astype(np.float32)
        return value


def blobs() -> Volume:
    """Balls of noise far apart, in a box of uneven edges."""
    rng = np.random.default_rng(4)
    density = np.zeros((75, 90, 110), np.float32)
    z, y, x = np.ogrid[:75, :90, :110]
    for _ in range(6):
        c = [int(rng.integers(9, n - 9)) for n in density.shape]
        ball = np.clip(1 - np.sqrt((z - c[0]) ** 2 + (y - c[1]) ** 2 + (x - c[2]) ** 2) / 8, 0, 1)
        density = np.maximum(density, ball * rng.uniform(0.3, 1, density.shape)).astype(np.float32)
    return Volume.from_box(density, (-1, -1, -1), (2, 1.5, 1))


@pytest.mark.parametrize("mode", ["fast", "reference"])
def test_the_picture_does_not_depend_on_how_the_grid_is_kept(
    mode: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, llvm_mitsuba: ModuleType
) -> None:
    write_vdb(tmp_path / "a.vdb", blobs())
    dense, sparse = (read_vdb(tmp_path / "a.vdb", dense_voxels=most) for most in (10**6, 0))
    assert isinstance(sparse, SparseVolume)

    def image(volume: Volume) -> tuple[RenderResult, float]:
        scene = volume_scene(volume, OPTIONS, "a.vdb")
        return Renderer(scene, Smooth(), mode=mode).render(spp=4, seed=3), scene.scale

    expected, scale = image(dense)
    monkeypatch.setattr(pyramid, "_MOST_DENSE_CELLS", 0)
    found, scale_of_bricks = image(sparse)
    assert scale_of_bricks == pytest.approx(scale, rel=1e-12)
    assert expected.channels["volume_opacity"].max() > 0.9
    np.testing.assert_allclose(found.channels["volume_opacity"], expected.channels["volume_opacity"], atol=1e-5)
    for layer in ("volume_direct", "volume_indirect"):
        a, b = (np.stack([r.channels[f"{layer}.{c}"] for c in "RGB"]) for r in (expected, found))
        assert a.max() > 0
        assert np.abs(b - a).mean() < 1e-5 * a.mean()
    memory = found.statistics.memory
    assert memory["field"] < 0.5 * expected.statistics.memory["field"]
    assert memory["peak"] > memory["field"] + memory["levels"] > 0


def test_a_large_box_costs_what_it_holds(tmp_path: Path) -> None:
    """Four blobs in a box of 1.7e9 voxels, 6.4 GiB as a dense grid: loaded and rendered in a process of its own, within 2 GiB."""
    blob = Bricks.from_dense(blobs().density[:40, :40, :40])
    corners = np.array([[0, 0, 0], [145, 145, 145], [0, 145, 0], [100, 90, 140]], np.int32)
    places = np.concatenate([blob.places + c for c in corners])
    bricks = Bricks((1200, 1200, 1200), places, np.concatenate([blob.values] * len(corners)))
    write_vdb(tmp_path / "a.vdb", SparseVolume(bricks, np.eye(4)))
    arguments = ["render", "a.vdb", "-o", "a.exr", "--size", "32x24", "--spp", "1", "--max-depth", "2"]
    code = f"import sys; from deepclouds.cli import main; sys.exit(main({arguments}))"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "memory: peak" in done.stdout + done.stderr
    record = json.loads(str(read_exr(tmp_path / "a.exr").attributes["deepclouds"]))
    memory = record["statistics"]["memory"]
    assert memory["field"] < memory["peak"] < 2 * 2**30
    assert record["seconds"]["load"] > 0
