"""Training runs of seconds on the small data set."""

from __future__ import annotations

from pathlib import Path

from deepclouds_training.run_folder import RunFolder
from deepclouds_training.shards import open_dataset
from deepclouds_training.train_config import TrainConfig, checked
from deepclouds_training.trainer import Trainer


def settings(data: Path, **changes: object) -> TrainConfig:
    """Four steps of a network of width 8 on `data`, or what `changes` say."""
    values = {
        "data": str(data),
        "steps": 4,
        "batch": 16,
        "warmup": 2,
        "valid_queries": 16,
        "valid_every": 3,
        "network": {"width": 8},
        # Three batches a pool: the resumed run begins in the middle of one.
        "samples": {"shards": 3, "queries": 16},
    }
    return checked({**values, **changes}, "test")


def trainer(folder: Path, config: TrainConfig) -> Trainer:
    """The run in `folder`, new or continued."""
    dataset = open_dataset(config.data)
    run = RunFolder(folder)
    if not (folder / "config.json").exists():
        run.begin(config, dataset)
    return Trainer(config, run, dataset, run.shards(dataset))
