"""The random choices of one shard: which cloud, how large, and the streams of everything that follows."""

from __future__ import annotations

import numpy as np

from deepclouds.volume import Volume
from deepclouds_training.clouds import make_cloud
from deepclouds_training.label_config import GenerateConfig


class CloudPlan:
    """What shard `index` is made of: a function of the configuration and the index alone, whoever makes the shard, and when.

    Attributes
    ----------
    split, family, cloud_seed, resolution
        of the cloud.
    size
        length of the longest side in mean free paths at the mean extinction.
    points
        random stream of the points, directions, suns, phase functions and albedos.
    pilot_seed, walk_seed
        roots of the walks' streams.
    shared
        whether the points share two suns, phase functions and albedos.
    """

    def __init__(self, config: GenerateConfig, index: int) -> None:
        streams = np.random.SeedSequence([config.seed, index]).spawn(5)
        rng = np.random.default_rng(streams[0])
        self.index = index
        self.split = "train" if index < config.train_shards else "valid"
        names = config.families if self.split == "train" else config.held_out
        weights = np.array([config.family_weights.get(name, 1.0) for name in names])
        self.family = str(rng.choice(names, p=weights / weights.sum()))
        resolution = config.coarse_resolution if rng.random() < config.coarse else config.resolution
        self.resolution = round(float(np.exp(rng.uniform(*np.log(resolution)))))
        largest = max(min(config.size[1], config.voxel_depth * self.resolution), config.size[0])
        self.size = float(np.exp(rng.uniform(np.log(config.size[0]), np.log(largest))))
        self.cloud_seed = _number(streams[1])
        self.points = np.random.default_rng(streams[2])
        self.pilot_seed, self.walk_seed = _number(streams[3]), _number(streams[4])
        self.shared = config.volpath_every > 0 and index % config.volpath_every == 0


def make_planned_cloud(family: str, seed: int, resolution: int) -> Volume:
    """The cloud, its density rounded to what a shard stores: labels must belong to exactly that."""
    volume = make_cloud(family, seed, resolution)
    return Volume(volume.density.astype(np.float16).astype(np.float32), volume.to_world)


def _number(stream: np.random.SeedSequence) -> int:
    return int(stream.generate_state(1, np.uint64)[0] >> np.uint64(1))
