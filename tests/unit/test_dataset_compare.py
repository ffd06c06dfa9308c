"""Two label sets held together: the rate of false alarms, the power, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from deepclouds_training.dataset_compare import Difference, difference, together
from deepclouds_training.shards import Shard, ShardInfo, shard_file, write_manifest, write_record, write_shard

from deepclouds.cli import main
from deepclouds.errors import InputError
from deepclouds.volume import Volume

N, K, M = 40, 2, 2


def label_set(seed: int, relative: float = 0.1, bias: float = 1.0, understated: float = 1.0) -> Shard:
    """Labels of always the same points with noise of `seed`, which the labels of a point share in part."""
    rng = np.random.default_rng(1)
    truth = np.exp(rng.normal(size=(N, K, M)))
    unit = rng.normal(size=(N, K, 3))
    noise = np.random.default_rng([2, seed])
    common, own = noise.normal(size=(N, 1, 1, 2)), noise.normal(size=(N, K, M, 2))
    half = bias * truth[..., None] * (1 + relative * np.sqrt(2) * (0.8 * common + 0.6 * own))
    return Shard(
        volume=Volume.from_box(np.ones((2, 2, 2)), (0, 0, 0), (1, 1, 1)),
        scale=1.0,
        point=rng.random((N, 3)).astype(np.float32),
        w=np.tile(np.array([0, 0, 1], np.float32), (N, 1)),
        phase=np.tile(np.array([0.5, 0, 1], np.float32), (N, 1)),
        kind=np.zeros(N, np.uint8),
        omega_sun=(unit / np.linalg.norm(unit, axis=2, keepdims=True)).astype(np.float32),
        tau_sun=np.zeros((N, K), np.float32),
        albedo=np.tile(np.array([1, 0.9], np.float32), (N, 1)),
        half=half.astype(np.float32),
        error=(understated * relative * truth).astype(np.float32),
        walks=np.full(N, 64, np.int32),
    )


def pairs(count: int, **second: float) -> list[Difference]:
    return [difference(label_set(2 * i), label_set(2 * i + 1, **second)) for i in range(count)]


def test_true_nulls_are_rejected_as_rarely_as_asked_for() -> None:
    found = pairs(600)
    alarms = np.mean([d.p < 0.05 for d in found])
    # Four standard errors of a share of 600.
    assert 0.05 - 4 * 0.0089 < alarms < 0.05 + 4 * 0.0089
    assert np.mean([d.ratio for d in found]) == pytest.approx(1, abs=4 * found[0].error / np.sqrt(600))
    assert np.mean([d.error for d in found]) == pytest.approx(np.std([d.ratio for d in found]), rel=0.15)
    assert np.mean([d.beyond for d in found], axis=0) == pytest.approx([0.0455, 0.0027], rel=0.25)


def test_many_clouds_together_keep_the_rate_and_shrink_the_error() -> None:
    found = pairs(600)
    sums = [together(found[start : start + 4]) for start in range(0, 600, 4)]
    assert np.mean([d.p < 0.05 for d in sums]) < 0.05 + 4 * 0.018
    assert np.mean([d.error for d in sums]) == pytest.approx(0.5 * np.mean([d.error for d in found]), rel=0.1)
    assert sums[0].points == 4 * N
    assert sums[0].labels == 4 * N * K * M


def test_a_bias_is_found() -> None:
    """One of four standard errors nearly always, wherever it points."""
    error = pairs(1)[0].error
    for bias in (1 - 4 * error, 1 + 4 * error):
        assert np.mean([d.p < 0.05 for d in pairs(100, bias=bias)]) > 0.9


def test_errors_that_are_too_small_are_found() -> None:
    two, three = np.mean([d.beyond for d in pairs(20, understated=0.3)], axis=0)
    assert two > 0.1
    assert three > 0.02


def test_sets_of_different_points_or_clouds_are_refused() -> None:
    first = label_set(1)
    with pytest.raises(InputError, match="`albedo`"):
        difference(first, replace(first, albedo=first.albedo * np.float32(0.5)))
    with pytest.raises(InputError, match="different clouds"):
        difference(first, replace(first, scale=2.0))
    with pytest.raises(InputError, match="nothing to compare"):
        difference(first, replace(first, half=0 * first.half))


def written(folder: Path, index: int, shard: Shard) -> Path:
    folder.mkdir()
    write_manifest(folder, {"tracer": folder.name, "total_shards": 1})
    sha256 = write_shard(folder / shard_file(index), shard, {"index": index})
    write_record(folder, ShardInfo(index, shard_file(index), "plume", "valid", N, sha256))
    return folder


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    own, other = written(tmp_path / "own", 3, label_set(1)), written(tmp_path / "mitsuba", 3, label_set(2, bias=0.8))
    assert main(["dataset", "compare", str(own), str(other)]) == 0
    lines = capsys.readouterr().out.splitlines()
    d = difference(label_set(1), label_set(2, bias=0.8))
    assert d.ratio == pytest.approx(1.25, abs=0.15)
    assert "1 clouds" in lines[0]
    for line, name in zip(lines[2:], ("3 plume", "all"), strict=True):
        assert line.split()[: len(name.split())] == name.split()
        assert f"{d.ratio:.4f} +- {d.error:.4f}  {d.p:.3f}" in line
    alone = written(tmp_path / "alone", 4, label_set(1))
    assert main(["dataset", "compare", str(own), str(alone)]) == 2
    assert "no cloud in common" in capsys.readouterr().err
