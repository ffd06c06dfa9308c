"""Render time of one cloud in a process of its own, where the numbers of threads and processors can be chosen.

    python -m benchmarks.scaling_point cloud.vol --out point.json [--size 256] [--optical-depth 60] [--cores N] [--model NAME]

Writes what `Point` holds as JSON, or `null` where the model was not trained on such a cloud.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from deepclouds.errors import InputError
from deepclouds.replacing import replacing


@dataclass(frozen=True)
class Point:
    """What a render took.

    Attributes
    ----------
    pixels, optical_depth, cores
        what was asked for: pixels of the image, depth of the densest line along the longest edge, processors.
    active_voxels, box_voxels
        voxels that hold something, and all of the box.
    model
        that was asked.
    seconds
        of a warm render with its own choice of samples: all that depends on sun or camera. The quickest of several seeds.
    processor_seconds, prediction_seconds
        of the same: summed over threads, and the part in which the network is asked.
    load_seconds
        to load cloud and model, once.
    queries, mean_spp
        asked of the network, and samples a pixel.
    field_bytes, peak_bytes
        memory of the extinction, and the most that the process had.
    """

    pixels: int
    optical_depth: float
    cores: int
    active_voxels: int
    box_voxels: int
    model: str
    seconds: float
    processor_seconds: float
    prediction_seconds: float
    load_seconds: float
    queries: int
    mean_spp: float
    field_bytes: int
    peak_bytes: int


def usable() -> list[int]:
    """Numbers of the processors that this process may use."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))


def measure(cloud: Path, size: int, optical_depth: float, up: str, cores: int | None, model: str | None, repeats: int) -> Point | None:
    """Load a cloud, render it once to warm up and `repeats` times with other seeds, under a sun alone.

    Returns None where the model was not trained on such a cloud.
    """
    import numpy as np
    from deepclouds_runtime.loading import load

    from deepclouds.volume import SparseVolume

    started = time.perf_counter()
    renderer = load(cloud, model=model, threads=cores, size=(size, size), optical_depth=optical_depth, sky=(0.0,), up=up)
    loaded = time.perf_counter() - started
    if renderer.model_hash is None:
        return None
    renderer.render(seed=1)
    quickest, processor, result = float("inf"), 0.0, None
    for repeat in range(repeats):
        wall, busy = time.perf_counter(), time.process_time()
        rendered = renderer.render(seed=2 + repeat)
        spent = time.perf_counter() - wall
        if spent < quickest:
            quickest, processor, result = spent, time.process_time() - busy, rendered
    assert result is not None
    volume = renderer.scene.volume
    values = volume.bricks.values if isinstance(volume, SparseVolume) else volume.density
    return Point(
        size * size,
        optical_depth,
        len(usable()) if cores is None else cores,
        int(np.count_nonzero(values)),
        int(np.prod(volume.resolution, dtype=np.int64)),
        Path(getattr(renderer.predictor, "path", "unknown")).stem,
        quickest,
        processor,
        result.seconds.get("prediction", 0.0),
        loaded,
        result.counts.queries,
        result.statistics.mean_spp,
        result.statistics.memory["field"],
        result.statistics.memory["peak"],
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and write; returns 0."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scaling_point", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("cloud", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--optical-depth", type=float, default=60.0)
    parser.add_argument("--up", default="y")
    parser.add_argument("--cores", type=int)
    parser.add_argument("--model")
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args(argv)
    if options.cores is not None:
        if not 1 <= options.cores <= len(usable()):
            raise InputError(f"--cores {options.cores}: this process may use {len(usable())}")
        # Before anything starts a thread: what has none of its own to set, as the compiler of kernels, keeps to these too.
        if hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(0, usable()[: options.cores])
    point = measure(options.cloud, options.size, options.optical_depth, options.up, options.cores, options.model, options.repeats)
    with replacing(options.out, ".json") as temporary:
        temporary.write_text(json.dumps(None if point is None else asdict(point)), encoding="utf-8")
    return 0


if __name__ == "__main__":
    try:
        raise SystemExit(main())
    except InputError as error:
        print(error, file=sys.stderr)
        raise SystemExit(2) from None
