"""What a trained variant is worth on held-out clouds, and what it costs."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from deepclouds_training.evaluate import Floats, Labels, labels_of, noise_free, percentiles
from deepclouds_training.export import to_onnx
from deepclouds_training.network import Network
from deepclouds_training.samples import SampleConfig, Samples, SampleSource
from deepclouds_training.shards import open_dataset
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.ablation_training import Readings, hidden
from deepclouds.model import INPUT_AUX, INPUT_STENCIL, LEVELS, POINTS, aux_inputs

BATCHES = (128, 256, 512, 1024, 2048)
ROWS = 2048


@dataclass(frozen=True)
class HeldOut:
    """All labels of one cloud that no network was trained on."""

    samples: Samples
    cloud: int
    family: str
    size: float


def held_out(folder: Path) -> list[HeldOut]:
    """The held-out clouds of a data set."""
    dataset = open_dataset(folder)
    shards = tuple(s for s in dataset.shards if s.split == "valid")
    source = SampleSource(dataset, shards, SampleConfig(cache_gb=0), seed=0)
    found = []
    for info in shards:
        samples, size = source.all_of(info)
        found.append(HeldOut(samples, info.index, info.family, size))
    return found


@torch.no_grad()
def predictions(networks: dict[str, Network], readings: Readings, clouds: list[HeldOut]) -> dict[str, Labels]:
    """What each network says of all labels, in float32."""
    parts: dict[str, list[Labels]] = {name: [] for name in networks}
    for cloud in clouds:
        s = cloud.samples
        found: dict[str, list[Floats]] = {name: [] for name in networks}
        for first in range(0, len(s), ROWS):
            inputs = readings.of(s.stencil[first : first + ROWS], s.aux[first : first + ROWS], torch.float32)
            for name, network in networks.items():
                found[name].append(network.leave(hidden(network, inputs)).numpy().astype(np.float64))
        for name, values in found.items():
            parts[name].append(labels_of(s, np.concatenate(values), cloud.cloud, cloud.family, cloud.size))
    return {name: Labels(**{key: np.concatenate([getattr(p, key) for p in each]) for key in vars(each[0])}) for name, each in parts.items()}


def figures(converged: Labels, halves: Labels) -> dict[str, float]:
    """The figures of one network on both held-out sets."""
    found = {"converged": noise_free(converged), "halves": noise_free(halves)}
    result = {f"{name} {key}": figure.value for name, both in found.items() for key, figure in both.items()}
    return {**result, **{key: percentiles(converged)[key].value for key in ("median", "95 %")}}


def weights(network: Network) -> int:
    """Numbers that training changes."""
    return sum(p.numel() for p in network.parameters())


def multiply_adds(network: Network) -> int:
    """Multiply-adds of all matrix products of one query."""
    rows = 8
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        network(torch.zeros(rows, LEVELS, POINTS), torch.zeros(rows, 6))
    return int(counter.get_total_flops()) // (2 * rows)


def query_seconds(networks: dict[str, Network], rounds: int = 3) -> dict[str, tuple[float, int]]:
    """Processor seconds that onnxruntime takes for a query on one thread, and at which batch: the best of all batches and rounds."""
    sessions = {name: _session(to_onnx(network).SerializeToString()) for name, network in networks.items()}
    rng = np.random.default_rng(5)
    stencil = rng.exponential(0.3, (max(BATCHES), LEVELS, POINTS)).astype(np.float32)
    n = len(stencil)
    aux = aux_inputs(rng.uniform(0, np.pi, n), rng.uniform(0, 0.9, n), 0.0, 1.0, rng.random(n), rng.exponential(3.0, n))
    best = {name: (np.inf, 0) for name in sessions}
    for _ in range(rounds):
        for name, session in sessions.items():
            for batch in BATCHES:
                best[name] = min(best[name], (_seconds(session, {INPUT_STENCIL: stencil[:batch], INPUT_AUX: aux[:batch]}) / batch, batch))
    return best


def _seconds(session: Any, feed: dict[str, Any], least: float = 0.1) -> float:
    session.run(None, feed)
    started, count = time.process_time(), 0
    while time.process_time() - started < least:
        session.run(None, feed)
        count += 1
    return (time.process_time() - started) / count


def _session(data: bytes) -> Any:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
