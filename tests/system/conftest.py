"""A small data set in the format of the generator, with labels that follow a known rule."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from deepclouds_training.shards import Shard, ShardInfo, shard_file, write_manifest, write_record, write_shard

from deepclouds.volume import Volume

FAMILIES = ("ball", "slab", "ball", "ring")
POINTS, SUNS, ALBEDOS = 64, 3, 2


def _shard(index: int) -> Shard:
    rng = np.random.default_rng([7, index])
    z, y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in (9, 11, 10)), indexing="ij")
    density = np.maximum(0, 1 - x**2 - y**2 - (1 + index) * z**2).astype(np.float16).astype(np.float32)
    w, suns = rng.normal(size=(POINTS, 3)), rng.normal(size=(POINTS, SUNS, 3))
    truth = rng.uniform(0.1, 2.0, (POINTS, SUNS, ALBEDOS))
    return Shard(
        volume=Volume.from_box(density, (-1, -1, -1), (1, 1, 1)),
        scale=4.0 + index,
        point=rng.uniform(-1, 1, (POINTS, 3)).astype(np.float32),
        w=(w / np.linalg.norm(w, axis=-1, keepdims=True)).astype(np.float32),
        phase=np.stack([rng.uniform(-0.3, 0.9, POINTS), rng.uniform(-0.5, 0.5, POINTS), rng.uniform(0.5, 1, POINTS)], 1).astype(np.float32),
        kind=np.zeros(POINTS, np.uint8),
        omega_sun=(suns / np.linalg.norm(suns, axis=-1, keepdims=True)).astype(np.float32),
        tau_sun=rng.uniform(0, 5, (POINTS, SUNS)).astype(np.float32),
        albedo=rng.uniform(0, 1, (POINTS, ALBEDOS)).astype(np.float32),
        half=np.stack([truth, truth], axis=-1).astype(np.float32),
        error=(0.1 * truth).astype(np.float32),
        walks=np.full(POINTS, 64, np.int32),
    )


@pytest.fixture(scope="session")
def small_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a data set of four clouds, the last one for validation."""
    folder = tmp_path_factory.mktemp("dataset")
    for index, family in enumerate(FAMILIES):
        file = shard_file(index)
        digest = write_shard(folder / file, _shard(index), {"family": family})
        split = "valid" if index == len(FAMILIES) - 1 else "train"
        write_record(folder, ShardInfo(index=index, file=file, family=family, split=split, count=POINTS, sha256=digest))
    write_manifest(folder, {})
    return folder
