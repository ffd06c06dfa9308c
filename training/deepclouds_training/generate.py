"""`deepclouds generate`: path-trace procedural clouds into shards of labelled points."""

from __future__ import annotations

import argparse
import hashlib
import logging
import multiprocessing
from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from deepclouds.backend import backend
from deepclouds.errors import InputError
from deepclouds.medium.field import Field as MediumField
from deepclouds.medium.multiple_scattering import trace_walks
from deepclouds.medium.optical_depth import optical_depth
from deepclouds.volume import Volume
from deepclouds.volume.pyramid import mean_extinction
from deepclouds_training.clouds import FAMILIES, HELD_OUT, TRAINING, make_cloud
from deepclouds_training.config_file import config_hash, read_toml, validated
from deepclouds_training.points import sample_g, sample_points, sample_suns
from deepclouds_training.shards import (
    MANIFEST,
    SCHEMA,
    Shard,
    ShardInfo,
    open_dataset,
    read_shard,
    shard_file,
    write_manifest,
    write_shard,
)

log = logging.getLogger(__name__)

# Clouds are made ahead on another process while the current one is traced.
_AHEAD = 2
_MITSUBA_GROUPS = 2


class GenerateConfig(BaseModel):
    """What a data set is made of; unknown keys are errors.

    Attributes
    ----------
    seed
        root of every random stream.
    train_shards, valid_shards
        number of clouds from the training and from the held-out families.
    points, suns, walks
        points a cloud, suns a point, walks a point; every walk serves all suns and albedos.
    connect
        see `deepclouds.medium.multiple_scattering.trace_walks`.
    families, held_out
        names of cloud families; the two must not overlap.
    family_weights
        relative frequency of families, 1 where not given.
    resolution
        least and largest number of samples along the longest axis, log-uniform.
    size
        least and largest length of the longest side in units of length (mean free paths at the mean extinction), log-uniform.
    deeper, anywhere
        shares of the points that are second collisions, or anywhere in and around the box.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    seed: int = 1
    train_shards: Annotated[int, Field(ge=0)] = 8
    valid_shards: Annotated[int, Field(ge=0)] = 2
    points: Annotated[int, Field(ge=1, le=2**20)] = 8192
    suns: Annotated[int, Field(ge=1, le=16)] = 4
    walks: Annotated[int, Field(ge=2)] = 64
    connect: Annotated[float, Field(gt=0)] = 0.25
    families: tuple[str, ...] = TRAINING
    held_out: tuple[str, ...] = HELD_OUT
    family_weights: dict[str, Annotated[float, Field(gt=0)]] = {}
    resolution: tuple[int, int] = (48, 128)
    size: tuple[float, float] = (2.0, 300.0)
    deeper: Annotated[float, Field(ge=0, le=1)] = 0.15
    anywhere: Annotated[float, Field(ge=0, le=1)] = 0.1

    @model_validator(mode="after")
    def _consistent(self) -> GenerateConfig:
        unknown = [f for f in (*self.families, *self.held_out, *self.family_weights) if f not in FAMILIES]
        if unknown:
            raise ValueError(f"unknown cloud families {unknown}; there are: {', '.join(FAMILIES)}")
        both = set(self.families) & set(self.held_out)
        if both:
            raise ValueError(f"families {sorted(both)} are both trained on and held out")
        if not 4 <= self.resolution[0] <= self.resolution[1]:
            raise ValueError(f"resolution {self.resolution} must be an increasing pair of at least 4")
        if not 0 < self.size[0] <= self.size[1]:
            raise ValueError(f"size {self.size} must be an increasing pair above 0")
        if self.deeper + self.anywhere > 1:
            raise ValueError("deeper and anywhere are shares of the points: their sum must not exceed 1")
        if (self.train_shards and not self.families) or (self.valid_shards and not self.held_out):
            raise ValueError("shards are asked for from an empty list of families")
        return self

    def hash(self) -> str:
        """SHA-256 of the resolved configuration."""
        return config_hash(self)


def load_config(path: Path) -> GenerateConfig:
    """Read a TOML file into a `GenerateConfig`; InputError when it is missing, malformed or holds unknown keys."""
    return validated(GenerateConfig, read_toml(path), str(path))


class _Plan:
    """The random choices of one shard, each from its own named stream."""

    def __init__(self, config: GenerateConfig, index: int) -> None:
        streams = np.random.SeedSequence([config.seed, index]).spawn(4)
        rng = np.random.default_rng(streams[0])
        self.split = "train" if index < config.train_shards else "valid"
        names = config.families if self.split == "train" else config.held_out
        weights = np.array([config.family_weights.get(name, 1.0) for name in names])
        self.family = str(rng.choice(names, p=weights / weights.sum()))
        low, high = np.log(config.resolution)
        self.resolution = round(float(np.exp(rng.uniform(low, high))))
        self.size = float(np.exp(rng.uniform(*np.log(config.size))))
        self.cloud_seed = int(streams[1].generate_state(1, np.uint64)[0] >> np.uint64(1))
        self.points = np.random.default_rng(streams[2])
        self.walk_seed = int(streams[3].generate_state(1, np.uint64)[0] >> np.uint64(1))


def _make_volume(family: str, seed: int, resolution: int) -> Volume:
    volume = make_cloud(family, seed, resolution)
    # Labels must belong to the density that is stored: round it first.
    return Volume(volume.density.astype(np.float16).astype(np.float32), volume.to_world)


def _make_shard(
    config: GenerateConfig, plan: _Plan, volume: Volume, tracer: Literal["own", "mitsuba"], backend_name: str
) -> tuple[Shard, dict[str, Any]]:
    longest = float(np.linalg.norm(volume.to_world[:3, :3], axis=0).max())
    scale = plan.size / (longest * mean_extinction(volume))
    types = backend(backend_name)
    field = MediumField(types, volume, scale)
    rng = plan.points
    points, w, kind = sample_points(rng, field, config.points, config.deeper, config.anywhere)
    n = len(points)
    # volpath needs a scene for every (g, sun, albedo): its points share a few of them.
    own = n if tracer == "own" else min(_MITSUBA_GROUPS, n)
    group = np.arange(n) % own
    g = sample_g(rng, own)[group]
    suns = sample_suns(rng, w, config.suns)[group]
    # Most clouds scatter nearly everything: half the labels have albedo 1, the others crowd toward it.
    albedo = np.ones((n, 2), np.float32)
    albedo[:, 1] = (1 - rng.random(own) ** 2)[group]
    origin = types.Array3f(np.ascontiguousarray(np.repeat(points, config.suns, axis=0).T))
    toward = types.Array3f(np.ascontiguousarray(suns.reshape(-1, 3).T))
    tau = optical_depth(field, origin, toward, types.Float(0), types.Float(np.inf), types.Float(0.5), types.Bool(True), opaque=1e9)
    if tracer == "mitsuba":
        from deepclouds_training.mitsuba_tracer import trace_walks_mitsuba

        estimates = trace_walks_mitsuba(volume, scale, points, w, g, suns, np.maximum(albedo, 1e-3), config.walks, plan.walk_seed)
    else:
        estimates = trace_walks(field, points, w, g, suns, albedo, config.walks, plan.walk_seed, connect=config.connect)
    label = estimates.mean(axis=1, dtype=np.float64)
    error = estimates.std(axis=1, dtype=np.float64, ddof=1) / np.sqrt(config.walks)
    if not (np.isfinite(label).all() and (label >= 0).all()):
        raise FloatingPointError(f"the tracer returned NaN, Inf or negative labels for {plan.family}, seed {plan.cloud_seed}")
    shard = Shard(
        volume=volume,
        scale=scale,
        point=points,
        w=w,
        g=g,
        kind=kind,
        omega_sun=suns,
        tau_sun=np.array(tau).reshape(n, config.suns).astype(np.float32),
        albedo=albedo,
        label=label.astype(np.float32),
        error=error.astype(np.float32),
    )
    header = {
        "schema": SCHEMA,
        "config_hash": config.hash(),
        "family": plan.family,
        "split": plan.split,
        "cloud_seed": plan.cloud_seed,
        "resolution": plan.resolution,
        "size": plan.size,
        "tracer": tracer,
        "walks": config.walks,
    }
    return shard, header


def _finished(folder: Path, config: GenerateConfig, tracer: str) -> dict[int, ShardInfo]:
    """The shards of an earlier run in `folder`, each checked by its hash; refuses a folder made from another configuration."""
    if not (folder / MANIFEST).exists():
        return {}
    dataset = open_dataset(folder)
    if dataset.manifest.get("config_hash") != config.hash() or dataset.manifest.get("tracer") != tracer:
        raise InputError(f"{folder}: holds a data set of another configuration or tracer; give another folder or delete it")
    done: dict[int, ShardInfo] = {}
    for info in dataset.shards:
        path = folder / info.file
        if path.exists() and hashlib.sha256(path.read_bytes()).hexdigest() == info.sha256:
            done[info.index] = info
        else:
            log.warning("%s is missing or damaged: it is made again", path)
    return done


def generate(
    config: GenerateConfig, folder: Path, tracer: Literal["own", "mitsuba"] = "own", backend_name: str = "llvm", limit: int | None = None
) -> None:
    """Make every shard of `config` that `folder` does not hold yet, at most `limit` of them; an interruption loses the current one.

    Training and validation shards alternate in proportion, so that an unfinished data set has both.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    folder.mkdir(parents=True, exist_ok=True)
    done = _finished(folder, config, tracer)
    total = config.train_shards + config.valid_shards
    order = sorted(range(total), key=lambda i: _place(config, i))
    todo = [i for i in order if i not in done][:limit]
    manifest = {"config": config.model_dump(mode="json"), "config_hash": config.hash(), "tracer": tracer, "total_shards": total}
    write_manifest(folder, manifest, done)
    if not todo:
        log.info("%s: all %d shards are there", folder, len(done))
        return
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    plans = {i: _Plan(config, i) for i in todo}
    with (
        ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool,
        Progress(*columns, console=console, disable=not console.is_terminal) as progress,
    ):
        task = progress.add_task("labels", total=total, completed=len(done))
        queue: dict[int, Future[Volume]] = {}
        try:
            for place, index in enumerate(todo):
                for ahead in todo[place : place + 1 + _AHEAD]:
                    if ahead not in queue:
                        p = plans[ahead]
                        queue[ahead] = pool.submit(_make_volume, p.family, p.cloud_seed, p.resolution)
                volume = queue.pop(index).result()
                shard, header = _make_shard(config, plans.pop(index), volume, tracer, backend_name)
                path = folder / shard_file(index)
                sha256 = write_shard(path, shard, {**header, "index": index})
                done[index] = ShardInfo(index, path.name, header["family"], header["split"], config.points, sha256)
                write_manifest(folder, manifest, done)
                progress.update(task, completed=len(done), description=f"labels ({header['family']})")
                if not console.is_terminal and (len(done) % 10 == 0 or len(done) == total):
                    log.info("%d of %d shards", len(done), total)
        finally:
            # Waiting for the cloud in the making takes a moment; without it the interpreter's exit races with the pool's.
            pool.shutdown(cancel_futures=True)


def _place(config: GenerateConfig, index: int) -> float:
    """Where shard `index` stands in the order of work, as a share of the whole."""
    if index < config.train_shards:
        return (index + 0.5) / config.train_shards
    return (index - config.train_shards + 0.5) / config.valid_shards


def describe(folder: Path, sample: int = 64) -> dict[str, float]:
    """Counts of a data set, and the mean relative standard error of up to `sample` evenly chosen shards' labels."""
    dataset = open_dataset(folder)
    chosen = dataset.shards[:: max(1, len(dataset.shards) // sample)]
    points = sum(s.count for s in dataset.shards)
    ratio, labels = [], 0
    for info in chosen:
        shard, _ = read_shard(folder / info.file)
        labels = shard.label[0].size
        seen = shard.label > 0.01 * shard.label.mean()
        ratio.append(float((shard.error[seen] / shard.label[seen]).mean()) if seen.any() else 0.0)
    return {
        "shards": len(dataset.shards),
        "points": points,
        "labels": points * labels,
        "mean_relative_error": float(np.mean(ratio)) if ratio else 0.0,
    }


def main(argv: Sequence[str], prog: str) -> int:
    """Run `deepclouds generate CONFIG.toml -o DIR`."""
    parser = argparse.ArgumentParser(prog=prog, description=__doc__)
    parser.add_argument("config", type=Path, help="TOML file; see configs/")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the data set")
    parser.add_argument("--tracer", choices=("own", "mitsuba"), default="own", help="own: Dr.Jit walks; mitsuba: volpath, the slow twin")
    parser.add_argument("--backend", choices=("llvm", "cuda"), default="llvm")
    parser.add_argument("--limit", type=int, help="make at most so many shards now")
    arguments = parser.parse_args(argv)
    if arguments.limit is not None and arguments.limit < 1:
        raise InputError(f"--limit {arguments.limit}: at least one shard must be allowed")
    if arguments.tracer == "mitsuba":
        import mitsuba as mi

        mi.set_variant("llvm_ad_mono" if arguments.backend == "llvm" else "cuda_ad_mono")
    generate(load_config(arguments.config), arguments.output, arguments.tracer, arguments.backend, arguments.limit)
    summary = describe(arguments.output)
    print(
        f"{arguments.output}: {summary['shards']:.0f} shards, {summary['points']:.0f} points, {summary['labels']:.0f} labels, "
        f"mean relative standard error {summary['mean_relative_error']:.2f}"
    )
    return 0
