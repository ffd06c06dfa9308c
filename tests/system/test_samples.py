"""Samples from shards: a pool is a function of its number, and carries what the shards say."""

from __future__ import annotations

import re
import shutil
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from deepclouds_training.samples import SampleConfig, Samples, SampleSource, angle_between
from deepclouds_training.shards import Dataset, open_dataset

from deepclouds.backend import backend
from deepclouds.descriptor import LEVELS, POINTS, Descriptor
from deepclouds.errors import InputError
from deepclouds.medium.field import Field
from deepclouds.volume import Volume


@pytest.fixture(scope="module")
def dataset(small_dataset: Path) -> Dataset:
    return open_dataset(small_dataset)


def copy_of(samples: Samples | None) -> dict[str, np.ndarray]:
    assert samples is not None
    return {field.name: getattr(samples, field.name).copy() for field in fields(Samples)}


def source(dataset: Dataset, seed: int = 1, **changes: object) -> SampleSource:
    return SampleSource(dataset, dataset.shards, SampleConfig(shards=3, queries=16, **changes), seed)  # type: ignore[arg-type]


def test_pool_is_a_function_of_seed_and_number(dataset: Dataset) -> None:
    one, other = source(dataset), source(dataset, cache_gb=0.0)
    pools = [copy_of(one.pool(k)) for k in range(3)]
    for k in (2, 0, 1):
        again = copy_of(other.pool(k))
        assert all(np.array_equal(again[name], pools[k][name]) for name in again)
    assert not np.array_equal(pools[0]["label"], pools[1]["label"])
    assert not np.array_equal(pools[0]["label"], copy_of(source(dataset, seed=2).pool(0))["label"])


def test_every_shard_comes_round_equally_often(dataset: Dataset) -> None:
    one = source(dataset)
    seen = np.concatenate([copy_of(one.pool(k))["shard"][::16] for k in range(4)])
    assert np.all(np.bincount(seen) == 3)


def test_interruption_leaves_no_half_built_pool(dataset: Dataset) -> None:
    assert source(dataset).pool(0, interrupted=lambda: True) is None


def test_samples_carry_what_the_shard_says(dataset: Dataset) -> None:
    info = dataset.shards[1]
    shard = dataset.load(info)
    part = source(dataset).draw(info, 50, np.random.default_rng(0), 1.0, mirror=False)
    for row in range(50):
        i, k, m = (int(v[0]) for v in np.nonzero(shard.label == part.label[row]))
        gamma = np.arccos(np.clip(np.dot(shard.w[i].astype(float), shard.omega_sun[i, k]), -1, 1))
        expected = (gamma, *shard.phase[i], shard.albedo[i, m], np.log1p(shard.tau_sun[i, k]))
        np.testing.assert_allclose(part.aux[row], expected, rtol=1e-5, atol=1e-6)
        assert part.error[row] == shard.error[i, k, m]
        assert np.array_equal(part.half[row], shard.half[i, k, m])
        stencil = Descriptor(Field(backend(), shard.volume, shard.scale)).stencils_numpy(
            shard.point[i : i + 1], shard.w[i : i + 1], shard.omega_sun[i, k][None]
        )
        np.testing.assert_allclose(part.stencil[row], stencil[0], rtol=1e-4, atol=1e-5)


def test_unit_factor_scales_the_stencil(dataset: Dataset) -> None:
    info = dataset.shards[0]
    # Twice the unit makes level k read what level k + 1 read, in values twice as large, wherever both levels are filtered.
    plain = source(dataset).draw(info, 32, np.random.default_rng(0), 1.0, mirror=False)
    doubled = source(dataset).draw(info, 32, np.random.default_rng(0), 2.0, mirror=False)
    np.testing.assert_allclose(doubled.stencil[:, 4:9], 2 * plain.stencil[:, 5:10], rtol=1e-3, atol=1e-5)
    assert np.array_equal(plain.label, doubled.label)


def test_mirrored_stencil_is_the_stencil_of_the_mirrored_cloud() -> None:
    rng = np.random.default_rng(4)
    density = rng.random((8, 9, 10), dtype=np.float32)
    fields_ = [Field(backend(), Volume.from_box(d, (-1, -1, -1), (1, 1, 1)), 3.0) for d in (density, density[:, ::-1])]
    # Sun and view lie in the plane y = 0, across which the second cloud is mirrored.
    angles = rng.uniform(0, 2 * np.pi, (2, 20))
    w, sun = (np.stack([np.cos(a), 0 * a, np.sin(a)], axis=1) for a in angles)
    point = rng.uniform(-1, 1, (20, 3))
    plain = Descriptor(fields_[0], origin=(0, 0, 0)).stencils_numpy(point, w, sun)
    mirrored = Descriptor(fields_[1], origin=(0, 0, 0)).stencils_numpy(point * (1, -1, 1), w, sun)
    flipped = plain.reshape(20, LEVELS, 9, 5, 5)[..., ::-1].reshape(20, LEVELS, POINTS)
    assert not np.allclose(plain, flipped, rtol=1e-2)
    np.testing.assert_allclose(mirrored, flipped, rtol=1e-3, atol=1e-4)


def test_about_half_of_the_stencils_are_mirrored(dataset: Dataset) -> None:
    info = dataset.shards[2]
    plain = source(dataset).draw(info, 200, np.random.default_rng(6), 1.0, mirror=False).stencil
    turned = source(dataset).draw(info, 200, np.random.default_rng(6), 1.0, mirror=True).stencil
    flipped = plain.reshape(-1, LEVELS, 9, 5, 5)[..., ::-1].reshape(-1, LEVELS, POINTS)
    same = np.array([np.array_equal(a, b) for a, b in zip(turned, plain, strict=True)])
    other = np.array([np.array_equal(a, b) for a, b in zip(turned, flipped, strict=True)])
    assert np.all(same | other)
    assert 60 < np.count_nonzero(same & ~other) + np.count_nonzero(same & other) / 2 < 140


def test_angle_is_precise_where_view_and_sun_are_parallel() -> None:
    for gamma in (0.0, 1e-4, 1.0, np.pi - 1e-4):
        w = np.array([[0.0, 0.0, 1.0]], np.float32)
        sun = np.array([[np.sin(gamma), 0.0, np.cos(gamma)]], np.float32)
        assert angle_between(w, sun)[0] == pytest.approx(gamma, rel=1e-5, abs=1e-12)


def test_a_truncated_shard_is_refused(dataset: Dataset, tmp_path: Path) -> None:
    shutil.copytree(dataset.folder, tmp_path / "set")
    path = tmp_path / "set" / dataset.shards[1].file
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(InputError, match=re.escape(str(path))):
        source(open_dataset(path.parent)).pool(0)


def test_no_shards_is_an_input_error(dataset: Dataset) -> None:
    with pytest.raises(InputError, match="no shards"):
        SampleSource(dataset, (), SampleConfig(), 0)
