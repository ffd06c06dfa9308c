"""The configuration of a training run: defaults here, a TOML file over them, flags over both."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from deepclouds.errors import InputError
from deepclouds_training.config_file import config_hash, read_toml, validated
from deepclouds_training.network import NetworkConfig
from deepclouds_training.samples import SampleConfig


class TrainConfig(BaseModel):
    """Everything that decides how a run goes.

    Attributes
    ----------
    data
        folder of the data set.
    start
        folder of a finished run of the same network, from whose averaged weights this one sets out; None starts afresh.
    seed
        root of all random streams.
    steps
        optimiser steps, the length of the schedule unless `minutes` is given.
    minutes
        training time; the learning rate then follows the time elapsed.
    batch
        samples a step.
    learning_rate, final_learning_rate, warmup
        the rate rises over `warmup` steps and falls on a cosine to the final one.
    ema
        decay of the weights' running mean.
    power
        exponent of the loss's weight.
    precision
        arithmetic of the hidden layers' products in training; weights, loss, averages and validation are float32 either way. Where the
        device would emulate ``bfloat16``, they are computed in float32 too.
    network, samples
        the network's shape and the samples' selection.
    companion
        shape of a small network that is trained on the same batches beside the large one and learns from it; None trains none.
    companion_mix
        what it learns from: this part of the large network's prediction, the rest of the label. The label is unbiased and noisy, the
        prediction nearly free of noise, but the large network's errors are in it.
    frozen
        do not train the large network, which `start` names: it is the teacher of the companion alone.
    valid_shards, valid_queries, valid_every
        validation clouds, queries drawn from each, and steps between validations.
    checkpoint_seconds
        longest time between checkpoints.
    patience
        validations in a row without a new best rRMSE or energy that end the run before its schedule does; None never ends it.
    tensorboard
        write TensorBoard events as well, to the folder ``events`` of the run.
    device
        where the networks are trained: ``auto`` takes a CUDA device if there is one. Stencils are built where `samples.backend` says.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    data: str
    start: str | None = None
    seed: int = Field(default=0, ge=0)
    steps: int = Field(default=20000, ge=1)
    minutes: float | None = Field(default=None, gt=0)
    batch: int = Field(default=1024, ge=1)
    learning_rate: float = Field(default=1e-3, gt=0)
    final_learning_rate: float = Field(default=1e-5, ge=0)
    warmup: int = Field(default=200, ge=0)
    ema: float = Field(default=0.999, ge=0, lt=1)
    power: float = Field(default=1.5, ge=0, le=2)
    precision: Literal["float32", "bfloat16"] = "float32"
    network: NetworkConfig = NetworkConfig()
    samples: SampleConfig = SampleConfig()
    companion: NetworkConfig | None = None
    companion_mix: float = Field(default=0.5, ge=0, le=1)
    frozen: bool = False
    valid_shards: int = Field(default=48, ge=1)
    valid_queries: int = Field(default=1024, ge=2)
    valid_every: int = Field(default=1000, ge=1)
    checkpoint_seconds: float = Field(default=100.0, ge=0, le=120)
    patience: int | None = Field(default=None, ge=1)
    tensorboard: bool = False
    device: Literal["auto", "cpu", "cuda"] = "auto"

    @property
    def hash(self) -> str:
        """sha256 of the resolved configuration."""
        return config_hash(self)


def read_config(path: Path, overrides: Mapping[str, Any]) -> TrainConfig:
    """Read a TOML file; `overrides` that are not None win.

    Raises
    ------
    InputError
        for a file that is missing or no TOML, and for unknown keys or values out of range.
    """
    return checked({**read_toml(path), **{key: value for key, value in overrides.items() if value is not None}}, str(path))


def checked(values: Mapping[str, Any], source: str) -> TrainConfig:
    """Validate a dictionary read from `source`.

    Raises
    ------
    InputError
        for unknown keys, missing ones, or values out of range.
    """
    config = validated(TrainConfig, values, source)
    pool = config.samples.shards * config.samples.queries
    if config.batch > pool:
        raise InputError(f"{source}: batch {config.batch} exceeds a pool of {pool} samples; raise samples.shards or samples.queries")
    if config.frozen and (config.start is None or config.companion is None):
        raise InputError(f"{source}: frozen trains a companion alone; name the teacher's run with start, and give a [companion] table")
    return config
