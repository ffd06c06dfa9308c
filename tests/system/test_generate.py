"""The label generator: reproducible, resumable, whole or absent; and what its data set commands say."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from deepclouds_training import shards as shards_module
from deepclouds_training.cloud_plan import CloudPlan
from deepclouds_training.dataset_info import relative_errors
from deepclouds_training.generate import generate
from deepclouds_training.label_config import GenerateConfig, load_config
from deepclouds_training.points import sample_albedo, sample_phase
from deepclouds_training.shards import FIRST_COLLISION, Shard, open_dataset, read_shard
from deepclouds_training.train_config import read_config

from deepclouds.cli import main
from deepclouds.errors import InputError

SMALL = GenerateConfig(
    seed=3, train_shards=2, valid_shards=1, points=96, suns=2, walks=(8, 16), resolution=(12, 16), coarse=0.0, size=(4.0, 12.0)
)
COMMAND = (sys.executable, "-c", "import sys; from deepclouds.cli import main; sys.exit(main(sys.argv[1:]))")


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def written(config: GenerateConfig, path: Path) -> Path:
    """The configuration as a TOML file."""
    lines = [f"{name} = {json.dumps(value)}" for name, value in config.model_dump(mode="json").items() if not isinstance(value, dict)]
    path.write_text("\n".join(lines))
    return path


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
        assert shard.half.shape == (n, k, m, 2)
        assert shard.walks.min() >= 8
        assert shard.walks.max() <= 16
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


def test_a_second_run_keeps_finished_shards_and_mends_damaged_ones(made: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    generate(SMALL, tmp_path, limit=1)
    kept = open_dataset(tmp_path).shards[0]
    before = (tmp_path / kept.file).stat().st_mtime_ns
    generate(SMALL, tmp_path)
    assert (tmp_path / kept.file).stat().st_mtime_ns == before
    assert contents(tmp_path) == contents(made)
    damaged = tmp_path / kept.file
    damaged.write_bytes(damaged.read_bytes()[:-100])
    with pytest.raises(InputError, match="not a readable shard"):
        read_shard(damaged)
    assert main(["dataset", "verify", str(tmp_path)]) == 2
    assert str(damaged) in capsys.readouterr().err
    generate(SMALL, tmp_path)
    assert main(["dataset", "verify", str(tmp_path)]) == 0
    assert contents(tmp_path) == contents(made)


def test_a_killed_run_goes_on_to_the_same_bytes(made: Path, tmp_path: Path) -> None:
    """Rationale: machines stop. Expected: killed after its first shard and started again, a run ends like one that nobody disturbed."""
    folder = tmp_path / "set"
    command = [*COMMAND, "generate", str(written(SMALL, tmp_path / "labels.toml")), "-o", str(folder)]
    run = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        for _ in range(6000):
            if list(folder.glob("shard_*.npz")) or run.poll() is not None:
                break
            time.sleep(0.02)
    finally:
        os.killpg(run.pid, signal.SIGKILL)
        run.wait()
    assert list(folder.glob("shard_*.npz"))
    # What a run leaves that was killed between a shard's file and its record, or in the middle of a file.
    for record in list(folder.glob("shard_*.json"))[:1]:
        record.unlink()
    (folder / ".shard_00000.12345.tmp.npz").write_bytes(b"PK")
    generate(SMALL, folder)
    assert contents(folder) == contents(made)


def test_parts_in_one_folder_or_in_several_are_the_whole(made: Path, tmp_path: Path) -> None:
    shared, parts = tmp_path / "shared", [tmp_path / "a", tmp_path / "b"]
    for i, folder in enumerate(parts):
        generate(SMALL, shared, part=(i, 2))
        generate(SMALL, folder, part=(i, 2))
    assert [s.index for s in open_dataset(parts[1]).shards] == [1]
    assert contents(shared) == contents(made)
    assert main(["dataset", "merge", str(parts[1]), str(parts[0]), "-o", str(tmp_path / "joined")]) == 0
    assert contents(tmp_path / "joined") == contents(made)


def test_parts_that_contradict_each_other_are_not_joined(made: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    other = tmp_path / "other"
    shutil.copytree(made, other)
    info = open_dataset(other).shards[0]
    shard, header = read_shard(other / info.file)
    digest = shards_module.write_shard(other / info.file, replace(shard, error=shard.error + 1), header)
    shards_module.write_record(other, replace(info, sha256=digest))
    assert main(["dataset", "merge", str(made), str(other), "-o", str(tmp_path / "joined")]) == 2
    assert "differ" in capsys.readouterr().err


@pytest.mark.parametrize("threads", ["1", "3"])
def test_bytes_do_not_depend_on_threads(made: Path, tmp_path: Path, threads: str) -> None:
    folder = tmp_path / "set"
    script = f"import drjit, sys; drjit.set_thread_count({threads}); from deepclouds.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", script, "generate", str(written(SMALL, tmp_path / "labels.toml")), "-o", str(folder), "--limit", "1"]
    environment = {**os.environ, "OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads}
    subprocess.run(command, check=True, env=environment, capture_output=True, timeout=300)
    assert contents(folder).items() <= contents(made).items()


def test_a_full_disk_costs_one_shard_and_says_so(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    folder, config = tmp_path / "set", written(SMALL, tmp_path / "labels.toml")
    generate(SMALL, folder, limit=1)
    kept = contents(folder)
    largest = max(len(data) for data in kept.values())
    script = f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({largest // 4}, {largest // 4}))\n" + COMMAND[2]
    ended = subprocess.run([COMMAND[0], COMMAND[1], script, "generate", str(config), "-o", str(folder)], text=True, capture_output=True)
    assert ended.returncode == 2
    assert re.search(r"shard_\d+\.npz: cannot be written \(File too large\)", ended.stderr)
    assert "Traceback" not in ended.stderr
    assert contents(folder) == kept


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
        ("walks = [4, 64]", "multiples of 8"),
        ("families = ['nimbus']", "nimbus"),
        ("families = ['plume']", "held out"),
        ("resolution = [64, 32]", "increasing"),
        ("coarse_resolution = [4, 16]", "at least 8"),
        ("seed = -1", "seed"),
        ("beside = 0.8\nanywhere = 0.4", "shares"),
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


@pytest.mark.parametrize("part", ["2/2", "-1/2", "1", "a/b"])
def test_a_part_that_is_none_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str], part: str) -> None:
    config = written(SMALL, tmp_path / "labels.toml")
    assert main(["generate", str(config), "-o", str(tmp_path / "out"), f"--shard={part}"]) == 2
    assert f"--shard {part}" in capsys.readouterr().err


def test_a_limit_below_one_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "labels.toml"
    path.write_text("points = 8\n")
    assert main(["generate", str(path), "-o", str(tmp_path / "out"), "--limit", "-1"]) == 2
    assert "--limit -1" in capsys.readouterr().err


def test_the_command_ends_quietly(tmp_path: Path) -> None:
    """Rationale: clouds are made by another process, whose end must not race with the interpreter's. Expected: no word of a traceback."""
    path = tmp_path / "labels.toml"
    path.write_text("train_shards = 1\nvalid_shards = 0\npoints = 8\nwalks = [8, 8]\nresolution = [8, 8]\nsize = [2.0, 3.0]\n")
    ended = subprocess.run([*COMMAND, "generate", str(path), "-o", str(tmp_path / "out")], capture_output=True, text=True, timeout=300)
    assert ended.returncode == 0
    assert "Traceback" not in ended.stderr


def test_a_missing_or_foreign_data_set_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["dataset", "info", str(tmp_path)]) == 2
    assert "no data set there" in capsys.readouterr().err
    (tmp_path / "manifest.json").write_text(json.dumps({"schema": 99}))
    assert main(["dataset", "info", str(tmp_path)]) == 2
    assert "schema 99" in capsys.readouterr().err


def test_info_and_stencils(made: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    picture = tmp_path / "histograms.png"
    assert main(["dataset", "info", str(made), "--picture", str(picture)]) == 0
    text = capsys.readouterr().out
    assert "3 of 3 shards, 288 points" in text
    assert picture.read_bytes().startswith(b"\x89PNG")
    shards = [open_dataset(made).load(info) for info in open_dataset(made).shards]
    exact = sum(float((1 / (1 + relative_errors(s) ** 2)).sum()) for s in shards)
    assert f"{288 * 4} labels, worth {exact:.0f} exact ones" in text
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
        if path.stem.endswith("labels"):
            load_config(path)
        else:
            read_config(path, {})


def test_users_ranges_are_covered() -> None:
    rng = np.random.default_rng(5)
    phase, albedo = sample_phase(rng, 100_000), sample_albedo(rng, 100_000)
    two = phase[:, 2] < 1
    assert two.mean() == pytest.approx(0.35, abs=0.01)
    for column, low, high in ((0, 0.3, 0.95), (1, -0.5, 0.5), (2, 0.5, 0.98)):
        assert (phase[two, column].min(), phase[two, column].max()) == pytest.approx((low, high), abs=0.01)
    g = phase[~two, 0]
    assert (g.min(), g.max()) == pytest.approx((-0.3, 0.95), abs=0.01)
    assert (g == 0).mean() == pytest.approx(0.12, abs=0.01)
    assert (g > 0.9).mean() > 0.05
    assert (phase[~two, 1] == 0).all()
    assert (albedo[:, 0] == 1).all()
    assert (albedo[:, 1] < 0.5).mean() == pytest.approx(0.05, abs=0.005)
    plans = [CloudPlan(GenerateConfig(train_shards=2000), i) for i in range(2000)]
    resolution, size = np.array([p.resolution for p in plans]), np.array([p.size for p in plans])
    assert (size / resolution).max() <= 10.0001
    assert size.min() < 1.1
    assert size.max() > 1800
    assert (resolution.min(), resolution.max()) == pytest.approx((8, 384), abs=4)
    assert (resolution < 32).mean() == pytest.approx(0.15, abs=0.03)


CONVERGED = GenerateConfig(
    seed=12,
    train_shards=0,
    valid_shards=2,
    points=64,
    suns=2,
    walks=(64, 1048576),
    target=0.05,
    meet="every",
    pilot=4096,
    slow_size=1e9,
    resolution=(12, 16),
    coarse=0.0,
    size=(3.0, 20.0),
    volpath_every=2,
)


@pytest.fixture(scope="module")
def converged(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Shard]]:
    folder = tmp_path_factory.mktemp("converged") / "set"
    generate(CONVERGED, folder)
    dataset = open_dataset(folder)
    return folder, [dataset.load(info) for info in dataset.shards]


def test_converged_labels_meet_their_target(converged: tuple[Path, list[Shard]]) -> None:
    """Rationale: a pilot fixes the number of walks. Expected: nearly all labels end within the target or just above, none far from it."""
    relative = np.concatenate([relative_errors(shard).ravel() for shard in converged[1]])
    assert (relative <= 1.15 * CONVERGED.target).mean() > 0.9
    assert relative.max() < 3 * CONVERGED.target


def test_halves_are_independent_and_as_noisy_as_they_say(converged: tuple[Path, list[Shard]]) -> None:
    """Rationale: (p - A)(p - B) is free of noise if the halves share none, and the errors are what they are called.

    Expected: (A - B) / (2 error) has variance 1, which it would not have if the halves were correlated by more than a few per cent.
    """
    shard = converged[1][1]
    # One label a point, since those of a point share their walks; the second cloud's points share no phase function either.
    label, half, error = shard.label[:, 0, 0], shard.half[:, 0, 0], shard.error[:, 0, 0]
    z = ((half[:, 0] - half[:, 1]) / (2 * error))[label > 0]
    n = len(z)
    assert n > 50
    assert abs(z.mean()) < 4 / np.sqrt(n)
    assert abs((z**2).mean() - 1) < 4 * np.sqrt(3 / n)


@pytest.mark.usefixtures("scalar_mitsuba")
def test_labels_from_mitsuba_agree(converged: tuple[Path, list[Shard]], tmp_path: Path) -> None:
    """Rationale: the two tracers share the points and nothing else.

    Expected: Welch's test finds no difference of the mean over points, with errors that would show one of 2 %.
    """
    config = CONVERGED.model_copy(update={"walks": (4096, 4096)})
    other = tmp_path / "volpath"
    generate(config, other, tracer="mitsuba")
    assert [s.index for s in open_dataset(other).shards] == [0]
    a, b = converged[1][0], open_dataset(other).load(open_dataset(other).shards[0])
    for name in ("point", "w", "phase", "omega_sun", "albedo"):
        assert np.array_equal(getattr(a, name), getattr(b, name))
    assert np.array_equal(a.volume.density, b.volume.density)
    assert len(np.unique(a.phase, axis=0)) == 2
    # The mean over points and suns, albedo 1; the errors of a point's labels are bounded as if they were all one.
    mine, volpath = (shard.label[..., 0].astype(float) for shard in (a, b))
    noise = np.sqrt(sum((shard.error[..., 0].sum(axis=1, dtype=float) ** 2).sum() for shard in (a, b)))
    assert noise < 0.015 * mine.sum()
    assert abs(mine.sum() - volpath.sum()) < 3.3 * noise
    # Both phase functions on their own, more coarsely: each has half of the points.
    for group in (slice(0, None, 2), slice(1, None, 2)):
        assert mine[group].sum() == pytest.approx(volpath[group].sum(), rel=0.1)


@pytest.mark.parametrize("interrupted", [True, False])
def test_parts_of_a_job_end_together(root: Path, tmp_path: Path, interrupted: bool) -> None:
    """Rationale: what a shell runs in the background does not hear Ctrl-C, and would go on beside the next attempt.
    Expected: no part is left after an interruption, or once another one has failed."""
    (tmp_path / "Makefile").write_text(f"include {root / 'Makefile'}\ntry:\n\t$(call generate,nothing)\n")
    fails = "" if interrupted else 'case "$4" in 0/*) sleep 1; exit 3;; esac\n'
    command = tmp_path / "deepclouds"
    command.write_text(f"#!/bin/sh\necho $$ > {tmp_path}/part$$.pid\n{fails}exec sleep 60\n")
    command.chmod(0o755)
    nproc = tmp_path / "nproc"
    nproc.write_text("#!/bin/sh\necho 2\n")
    nproc.chmod(0o755)
    how = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    job = subprocess.Popen(["make", "-s", "try", f"BIN={tmp_path}"], cwd=tmp_path, env=how, start_new_session=True)
    deadline = time.monotonic() + 30
    while len(list(tmp_path.glob("*.pid"))) < 2 and time.monotonic() < deadline:
        time.sleep(0.05)
    # Once both have begun for good.
    time.sleep(0.2)
    if interrupted:
        os.killpg(job.pid, signal.SIGINT)
    assert job.wait(timeout=30) != 0
    parts = [int(path.read_text()) for path in tmp_path.glob("*.pid")]
    assert len(parts) == 2
    for part in parts:
        with pytest.raises(ProcessLookupError):
            os.kill(part, 0)
