"""The label generator: reproducible, resumable, whole or absent; and what its data set commands say."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from deepclouds_training.generate import GenerateConfig, generate, load_config
from deepclouds_training.shards import FIRST_COLLISION, open_dataset, read_shard
from deepclouds_training.train_config import read_config

from deepclouds.cli import main

SMALL = GenerateConfig(seed=3, train_shards=2, valid_shards=1, points=96, suns=2, walks=4, resolution=(12, 16), size=(4.0, 12.0))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("labels") / "set"
    generate(SMALL, folder)
    return folder


def test_shards_hold_what_the_manifest_says(made: Path) -> None:
    dataset = open_dataset(made)
    assert [s.split for s in dataset.shards] == ["train", "train", "valid"]
    assert not {s.family for s in dataset.shards if s.split == "train"} & {s.family for s in dataset.shards if s.split == "valid"}
    for info in dataset.shards:
        shard = dataset.load(info)
        n, k, m = info.count, SMALL.suns, 2
        assert shard.point.shape == shard.w.shape == (n, 3)
        assert shard.omega_sun.shape == (n, k, 3)
        assert shard.label.shape == shard.error.shape == (n, k, m)
        assert np.allclose(np.linalg.norm(shard.w, axis=1), 1, atol=1e-5)
        assert np.allclose(np.linalg.norm(shard.omega_sun, axis=2), 1, atol=1e-5)
        assert (shard.albedo[:, 0] == 1).all()
        assert np.isfinite(shard.label).all()
        assert (shard.label >= 0).all()
        # A lower albedo can only take light away: both columns share their walks.
        assert (shard.label[..., 1] <= shard.label[..., 0] * (1 + 1e-5)).all()
        collided = shard.kind == FIRST_COLLISION
        assert (shard.volume.sample(shard.point[collided]) > 0).all()


def test_the_same_configuration_gives_the_same_bytes(made: Path, tmp_path: Path) -> None:
    generate(SMALL, tmp_path, limit=1)
    first = open_dataset(tmp_path).shards[0]
    assert first.sha256 == next(s for s in open_dataset(made).shards if s.index == first.index).sha256


def test_a_second_run_keeps_finished_shards_and_mends_damaged_ones(made: Path, tmp_path: Path) -> None:
    generate(SMALL, tmp_path, limit=1)
    kept = open_dataset(tmp_path).shards[0]
    before = (tmp_path / kept.file).stat().st_mtime_ns
    generate(SMALL, tmp_path)
    assert (tmp_path / kept.file).stat().st_mtime_ns == before
    assert open_dataset(tmp_path).hash == open_dataset(made).hash
    damaged = tmp_path / kept.file
    damaged.write_bytes(damaged.read_bytes()[:-100])
    with pytest.raises(Exception, match="not a readable shard"):
        read_shard(damaged)
    assert main(["dataset", "verify", str(tmp_path)]) == 2
    generate(SMALL, tmp_path)
    assert main(["dataset", "verify", str(tmp_path)]) == 0
    assert not list(tmp_path.glob(".*.tmp*"))


def test_another_configuration_is_not_mixed_in(made: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    config = tmp_path / "other.toml"
    config.write_text("seed = 4\ntrain_shards = 1\nvalid_shards = 0\npoints = 8\n")
    assert main(["generate", str(config), "-o", str(made)]) == 2
    assert "another configuration" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("sed = 3", "sed"),
        ("points = 0", "points"),
        ("families = ['cirrus']", "cirrus"),
        ("families = ['plume']", "held out"),
        ("resolution = [64, 32]", "increasing"),
        ("deeper = 0.8\nanywhere = 0.4", "shares"),
        ("points = ", "no valid TOML"),
        ("[family_weights]\nplume = -1", "family_weights.plume"),
    ],
)
def test_bad_configurations_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, complaint: str) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(text)
    assert main(["generate", str(path), "-o", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert str(path) in error
    assert complaint in error
    assert "pydantic" not in error
    assert not (tmp_path / "out").exists()


def test_a_limit_below_one_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "labels.toml"
    path.write_text("points = 8\n")
    assert main(["generate", str(path), "-o", str(tmp_path / "out"), "--limit", "-1"]) == 2
    assert "--limit -1" in capsys.readouterr().err


def test_the_command_ends_quietly(tmp_path: Path) -> None:
    """Rationale: clouds are made by another process, whose end must not race with the interpreter's. Expected: no word of a traceback."""
    path = tmp_path / "labels.toml"
    path.write_text("train_shards = 1\nvalid_shards = 0\npoints = 8\nwalks = 2\nresolution = [8, 8]\nsize = [2.0, 3.0]\n")
    command = [sys.executable, "-c", "import sys; from deepclouds.cli import main; sys.exit(main(sys.argv[1:]))"]
    ended = subprocess.run([*command, "generate", str(path), "-o", str(tmp_path / "out")], capture_output=True, text=True, timeout=300)
    assert ended.returncode == 0
    assert "Traceback" not in ended.stderr


def test_a_missing_or_foreign_data_set_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["dataset", "info", str(tmp_path)]) == 2
    assert "no data set there" in capsys.readouterr().err
    (tmp_path / "manifest.json").write_text(json.dumps({"schema": 99, "shards": []}))
    assert main(["dataset", "info", str(tmp_path)]) == 2
    assert "schema 99" in capsys.readouterr().err


def test_info_and_stencils(made: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["dataset", "info", str(made)]) == 0
    assert "3 of 3 shards, 288 points" in capsys.readouterr().out
    target = tmp_path / "stencils.npz"
    assert main(["dataset", "export-stencils", str(made), "-o", str(target), "--queries", "16"]) == 0
    with np.load(target) as stored:
        assert stored["stencil"].shape == (32, 10, 225)
        assert stored["aux"].shape == (32, 6)
        assert (stored["label"] >= 0).all()
        assert np.isfinite(stored["stencil"]).all()


def test_merged_sets_hold_the_shards_of_both(made: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    other, joined = tmp_path / "other", tmp_path / "joined"
    generate(SMALL.model_copy(update={"seed": 8, "valid_shards": 0, "train_shards": 1}), other)
    assert main(["dataset", "merge", str(made), str(other), "-o", str(joined)]) == 0
    a, b, both = open_dataset(made), open_dataset(other), open_dataset(joined)
    assert [s.sha256 for s in both.shards] == [s.sha256 for s in (*a.shards, *b.shards)]
    assert [s.index for s in both.shards] == [0, 1, 2, 3]
    assert main(["dataset", "verify", str(joined)]) == 0
    assert main(["dataset", "merge", str(made), "-o", str(joined)]) == 2
    assert "exists already" in capsys.readouterr().err
    swapped = SMALL.model_copy(update={"families": ("plume",), "held_out": ("shapes",), "valid_shards": 0, "train_shards": 1})
    generate(swapped, tmp_path / "swapped")
    assert main(["dataset", "merge", str(made), str(tmp_path / "swapped"), "-o", str(tmp_path / "mixed")]) == 2
    assert "held out in another" in capsys.readouterr().err
    assert not list(tmp_path.glob("*mixed*"))


def test_the_shipped_configurations_are_valid() -> None:
    for path in sorted(Path(__file__).parents[2].glob("configs/*.toml")):
        if path.stem.endswith("_labels"):
            load_config(path)
        else:
            read_config(path, {})


@pytest.mark.usefixtures("mono_mitsuba")
def test_labels_from_mitsuba_agree(tmp_path: Path) -> None:
    """Rationale: the two tracers share the points and nothing else. Expected: means within four standard errors."""
    config = GenerateConfig(seed=9, train_shards=1, valid_shards=0, points=512, suns=2, walks=32, resolution=(12, 16), size=(3.0, 6.0))
    own, other = tmp_path / "own", tmp_path / "mitsuba"
    generate(config, own)
    generate(config, other, tracer="mitsuba")
    a, b = (open_dataset(folder).load(open_dataset(folder).shards[0]) for folder in (own, other))
    assert np.array_equal(a.point, b.point)
    assert np.array_equal(a.volume.density, b.volume.density)
    from deepclouds.backend import backend
    from deepclouds.medium.field import Field
    from deepclouds.medium.multiple_scattering import trace_walks

    field = Field(backend("llvm"), b.volume, b.scale)
    again = trace_walks(field, b.point, b.w, b.g, b.omega_sun, b.albedo, 32, seed=77)
    label = again.mean(axis=1)
    error = again.std(axis=1, ddof=1) / np.sqrt(32)
    difference = float((label - b.label).sum())
    assert abs(difference) < 4 * float(np.sqrt((error**2 + b.error**2).sum()) * np.sqrt(4))
