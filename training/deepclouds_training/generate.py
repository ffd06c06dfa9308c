"""`deepclouds generate`: path-trace procedural clouds into shards of labelled points."""

from __future__ import annotations

import argparse
import logging
import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from deepclouds.backend import backend, vectors_of
from deepclouds.errors import InputError
from deepclouds.medium.field import Field
from deepclouds.medium.multiple_scattering import trace_walks
from deepclouds.medium.optical_depth import optical_depth
from deepclouds.volume import Volume
from deepclouds.volume.pyramid import mean_extinction
from deepclouds_training.cloud_plan import CloudPlan, make_planned_cloud
from deepclouds_training.label_config import GenerateConfig, load_config
from deepclouds_training.labels import GROUP, Tracer, estimate, needed_walks
from deepclouds_training.points import sample_albedo, sample_phase, sample_points, sample_suns
from deepclouds_training.shards import (
    MANIFEST,
    SCHEMA,
    Shard,
    ShardInfo,
    check_shard,
    open_dataset,
    record_file,
    shard_file,
    write_manifest,
    write_record,
    write_shard,
)

log = logging.getLogger(__name__)

# Clouds are made ahead on other processes while the current one is traced: the largest take as long to make as to trace.
_MAKERS = 2
_AHEAD = 3
# Different suns, phase functions and albedos in a cloud that volpath can label: it needs a scene for each.
_SHARED = 2
# Mean free paths along a cloud beyond which volpath's share of the walks falls with the inverse square of the size: about so grow the
# cost of its paths, whose majorant is global, and their number of scatterings.
_VOLPATH_SIZE = 40.0


def make_shard(
    config: GenerateConfig, plan: CloudPlan, volume: Volume, tracer: Literal["own", "mitsuba"], backend_name: str
) -> tuple[Shard, dict[str, Any]]:
    """Label the points of one cloud; returns the shard and its header."""
    longest = float(np.linalg.norm(volume.to_world[:3, :3], axis=0).max())
    scale = plan.size / (longest * mean_extinction(volume))
    types = backend(backend_name)
    field = Field(types, volume, scale)
    rng = plan.points
    point, w, kind = sample_points(rng, field, config.points, config.second, config.beside, config.inside, config.anywhere)
    n = len(point)
    different = min(_SHARED, n) if plan.shared else n
    group = np.arange(n) % different
    phase, albedo = sample_phase(rng, different)[group], sample_albedo(rng, different)[group]
    suns = sample_suns(rng, w[:different], config.suns)[group]
    if plan.shared:
        albedo = np.maximum(albedo, np.float32(0.01))
    tau = optical_depth(
        field,
        vectors_of(types, np.repeat(point, config.suns, axis=0)),
        vectors_of(types, suns.reshape(-1, 3)),
        types.Float(0),
        types.Float(np.inf),
        types.Bool(True),
        opaque=1e9,
    )

    def trace(rows: NDArray[np.int64], walks: int, seed: int) -> NDArray[np.float32]:
        return trace_walks(field, point[rows], w[rows], phase[rows], suns[rows], albedo[rows], walks, seed, connect=config.connect)

    def trace_volpath(rows: NDArray[np.int64], walks: int, seed: int) -> NDArray[np.float32]:
        from deepclouds_training.mitsuba_tracer import trace_walks_mitsuba

        return trace_walks_mitsuba(volume, scale, point[rows], w[rows], phase[rows], suns[rows], albedo[rows], walks, seed)

    walks = _walks(config, plan, trace, n, (config.suns, albedo.shape[1]))
    if tracer == "mitsuba":
        share = config.volpath_walks * min(1.0, _VOLPATH_SIZE / plan.size) ** 2
        walks = np.maximum(GROUP, GROUP * np.round(share * walks / GROUP)).astype(np.int64)
    # The two tracers must not share a seed: what is compared has to be independent.
    final, seed = (trace, plan.walk_seed) if tracer == "own" else (trace_volpath, plan.walk_seed ^ 1)
    try:
        labels = estimate(final, walks, (config.suns, albedo.shape[1]), seed)
    except FloatingPointError as error:
        raise FloatingPointError(f"{plan.family}, seed {plan.cloud_seed}, resolution {plan.resolution}: {error}") from error
    shard = Shard(
        volume=volume,
        scale=scale,
        point=point,
        w=w,
        phase=phase,
        kind=kind,
        omega_sun=suns,
        tau_sun=np.array(tau).reshape(n, config.suns).astype(np.float32),
        albedo=albedo,
        half=labels.half.astype(np.float32),
        error=labels.error.astype(np.float32),
        walks=walks.astype(np.int32),
    )
    header = {
        "schema": SCHEMA,
        "config_hash": config.hash(),
        "index": plan.index,
        "family": plan.family,
        "split": plan.split,
        "cloud_seed": plan.cloud_seed,
        "resolution": plan.resolution,
        "size": plan.size,
        "tracer": tracer,
    }
    return shard, header


def _walks(config: GenerateConfig, plan: CloudPlan, trace: Tracer, n: int, labels_per_point: tuple[int, int]) -> NDArray[np.int64]:
    least, most = config.walks
    # Walks through a large cloud are long: fewer of them bound the cost of a shard.
    share = min(1.0, config.slow_size / plan.size)
    most = max(least, GROUP * round(most * share / GROUP))
    if least == most:
        return np.full(n, least)
    pilot = estimate(trace, np.full(n, config.pilot), labels_per_point, plan.pilot_seed)
    return needed_walks(pilot, config.target, config.meet == "every", least, most)


def _finished(folder: Path, config: GenerateConfig, tracer: str, mine: Sequence[int]) -> set[int]:
    """Which of the shards `mine` are there already, each checked by its hash; refuses a folder made from another configuration."""
    if not (folder / MANIFEST).exists():
        return set()
    dataset = open_dataset(folder)
    if dataset.manifest.get("config_hash") != config.hash() or dataset.manifest.get("tracer") != tracer:
        raise InputError(f"{folder}: holds a data set of another configuration or tracer; give another folder or delete it")
    wanted, done = set(mine), set()
    for info in dataset.shards:
        if info.index not in wanted:
            continue
        try:
            check_shard(folder / info.file, info.sha256)
            done.add(info.index)
        except InputError:
            log.warning("%s is missing or damaged: it is made again", folder / info.file)
    return done


def generate(
    config: GenerateConfig,
    folder: Path,
    tracer: Literal["own", "mitsuba"] = "own",
    backend_name: str = "llvm",
    limit: int | None = None,
    part: tuple[int, int] = (0, 1),
) -> None:
    """Make the shards of `config` that `folder` does not hold yet; an interruption loses the current one.

    Parameters
    ----------
    config
        what to make.
    folder
        where; several machines may write different parts into one folder, or each into its own (`deepclouds dataset merge` joins those).
    tracer
        ``mitsuba`` takes the shards alone that `volpath_every` marks.
    backend_name
        Dr.Jit's.
    limit
        at most so many shards now.
    part
        (i, n): the shards whose number leaves i when divided by n.

    Notes
    -----
    Training and validation shards alternate in proportion, so that an unfinished data set has both.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    total = config.train_shards + config.valid_shards
    shards = total if tracer == "own" else sum(CloudPlan(config, i).shared for i in range(total))
    plans = {i: CloudPlan(config, i) for i in range(part[0], total, part[1])}
    if tracer == "mitsuba":
        plans = {i: plan for i, plan in plans.items() if plan.shared}
        if not plans:
            raise InputError("--tracer mitsuba: the configuration marks no clouds for it; set volpath_every, see docs/dataset.md")
    mine = sorted(plans, key=lambda i: _place(config, i))
    folder.mkdir(parents=True, exist_ok=True)
    done = _finished(folder, config, tracer, mine)
    if not (folder / MANIFEST).exists():
        write_manifest(
            folder, {"config": config.model_dump(mode="json"), "config_hash": config.hash(), "tracer": tracer, "total_shards": shards}
        )
    todo = [i for i in mine if i not in done][:limit]
    if not todo:
        log.info("%s: all %d shards are there", folder, len(done))
        return
    for index in todo:
        # Left by a run that was killed; another machine's files have other numbers.
        for stray in (*folder.glob(f".{Path(shard_file(index)).stem}.*.tmp*"), folder / record_file(shard_file(index))):
            stray.unlink(missing_ok=True)
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("labels", total=len(mine), completed=len(done))
        for plan, volume in _clouds([plans[i] for i in todo]):
            shard, header = make_shard(config, plan, volume, tracer, backend_name)
            path = folder / shard_file(plan.index)
            sha256 = write_shard(path, shard, header)
            write_record(folder, ShardInfo(plan.index, path.name, plan.family, plan.split, config.points, sha256))
            done.add(plan.index)
            progress.update(task, completed=len(done), description=f"labels ({plan.family})")
            if not console.is_terminal and (len(done) % 10 == 0 or len(done) == len(mine)):
                log.info("%d of %d shards", len(done), len(mine))


def _clouds(plans: Sequence[CloudPlan]) -> Iterator[tuple[CloudPlan, Volume]]:
    """Every plan with its cloud, made ahead on other processes."""
    queue: dict[int, Future[Volume]] = {}
    with ProcessPoolExecutor(min(_MAKERS, len(plans)), mp_context=multiprocessing.get_context("spawn")) as pool:
        try:
            for place, plan in enumerate(plans):
                for ahead in plans[place : place + 1 + _AHEAD]:
                    if ahead.index not in queue:
                        queue[ahead.index] = pool.submit(make_planned_cloud, ahead.family, ahead.cloud_seed, ahead.resolution)
                # The place stays taken: a cloud is handed out once.
                yield plan, queue[plan.index].result()
                queue[plan.index] = Future()
        finally:
            # Waiting for the cloud in the making takes a moment; without it the interpreter's exit races with the pool's.
            pool.shutdown(cancel_futures=True)


def _place(config: GenerateConfig, index: int) -> float:
    """Where shard `index` stands in the order of work, as a share of the whole."""
    if index < config.train_shards:
        return (index + 0.5) / config.train_shards
    return (index - config.train_shards + 0.5) / config.valid_shards


def _part(text: str) -> tuple[int, int]:
    try:
        i, n = (int(v) for v in text.split("/"))
    except ValueError:
        raise InputError(f"--shard {text}: give i/n, such as 0/4, with 0 <= i < n") from None
    if not 0 <= i < n:
        raise InputError(f"--shard {text}: give i/n, such as 0/4, with 0 <= i < n")
    return i, n


def main(argv: Sequence[str], prog: str) -> int:
    """Run `deepclouds generate CONFIG.toml -o DIR`."""
    parser = argparse.ArgumentParser(prog=prog, description=__doc__)
    parser.add_argument("config", type=Path, help="TOML file; see configs/")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the data set")
    parser.add_argument("--shard", default="0/1", metavar="I/N", help="make only the shards whose number leaves I when divided by N")
    parser.add_argument("--tracer", choices=("own", "mitsuba"), default="own", help="own: Dr.Jit walks; mitsuba: volpath, the slow twin")
    parser.add_argument("--backend", choices=("llvm", "cuda"), default="llvm")
    parser.add_argument("--limit", type=int, help="make at most so many shards now")
    arguments = parser.parse_args(argv)
    if arguments.limit is not None and arguments.limit < 1:
        raise InputError(f"--limit {arguments.limit}: at least one shard must be allowed")
    part = _part(arguments.shard)
    if arguments.tracer == "mitsuba":
        import mitsuba as mi

        # The fastest of its variants at this, and one that computes on all cores.
        mi.set_variant("scalar_rgb")
    generate(load_config(arguments.config), arguments.output, arguments.tracer, arguments.backend, arguments.limit, part)
    dataset = open_dataset(arguments.output)
    points = sum(s.count for s in dataset.shards)
    print(f"{arguments.output}: {len(dataset.shards)} shards, {points} points; `deepclouds dataset info` says more")
    return 0
