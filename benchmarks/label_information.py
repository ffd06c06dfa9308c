"""What a core-second of labels is worth to a network: the same small network trained on either tracer's labels from equal core-seconds.

Both tracers label points of the same clouds. The validation error is free of the reference's noise: labels of unseen clouds come in two
independent halves A and B, and ``mean((p - A)(p - B)) / mean^2`` has the expectation of the true squared error.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from deepclouds_training.average import WeightAverage
from deepclouds_training.clouds import make_cloud
from deepclouds_training.loss import relative_squared_error
from deepclouds_training.network import Network, NetworkConfig
from deepclouds_training.points import sample_points, uniform_directions
from deepclouds_training.samples import angle_between
from numpy.random import Generator
from numpy.typing import NDArray

from benchmarks.label_cost import ALBEDOS, CONNECT, PHASES, SUNS
from benchmarks.label_volpath import VolpathLabels
from deepclouds.backend import backend
from deepclouds.descriptor import Descriptor
from deepclouds.medium.field import Field
from deepclouds.medium.multiple_scattering import trace_walks
from deepclouds.medium.optical_depth import optical_depth
from deepclouds.model import aux_inputs
from deepclouds.volume import Volume
from deepclouds.volume.pyramid import mean_extinction

Singles = NDArray[np.float32]
Doubles = NDArray[np.float64]
TRAINING = ("cumulus", "cumulus_field", "stratus", "fractus")
VALIDATION = ("congestus", "plume")
# Paths a label; noisy labels of many points train better than good labels of few.
WALKS = 16
# Different (sun, albedo, g) that volpath labels in a cloud, each with points of its own.
GROUPS = 16


@dataclass(frozen=True)
class Effort:
    """Size of the experiment: clouds a family, their resolution, core-seconds a cloud, training steps, validation points and walks."""

    clouds: int = 3
    resolution: int = 48
    seconds: float = 1.5
    steps: int = 1000
    points: int = 1024
    walks: int = 128


@dataclass(frozen=True)
class Labels:
    """n labels of one cloud: points, directions and suns (n, 3), g, albedo and label (n,), and the core-seconds they took."""

    field: Field
    points: Singles
    w: Singles
    g: Singles
    sun: Singles
    albedo: Singles
    label: Doubles
    seconds: float

    @cached_property
    def descriptor(self) -> Descriptor:
        """Of the field; its filtered levels are made once."""
        return Descriptor(self.field)

    def inputs(self, rows: NDArray[np.int64], rng: Generator) -> tuple[Singles, Singles]:
        """Stencils (m, 10, 225) and aux rows (m, 6) of the labels `rows`."""
        p, w, sun = self.points[rows], self.w[rows], self.sun[rows]
        t, n = self.field.types, len(rows)
        o, d = (t.Array3f(np.ascontiguousarray(v.T)) for v in (p, sun))
        tau = optical_depth(self.field, o, d, t.Float(0), t.Float(1e30), t.Bool(np.ones(n, bool)))
        stencil = self.descriptor.stencils_numpy(p, w, sun, rng.uniform(0, 2 * np.pi, n))
        return stencil, aux_inputs(angle_between(w, sun), self.g[rows], 0.0, 1.0, self.albedo[rows], np.array(tau))


@dataclass(frozen=True)
class Worth:
    """Labels made, their core-seconds, and the network's noise-free relative RMS error and energy on unseen clouds."""

    labels: int
    seconds: float
    rrmse: float
    energy: float


def clouds(families: tuple[str, ...], each: int, resolution: int, seed: int) -> list[Field]:
    """`each` clouds a family, 10 to 200 mean free paths long."""
    rng = np.random.default_rng(seed)
    fields = []
    for family in families:
        for number in range(each):
            volume: Volume = make_cloud(family, seed + number, resolution)
            size = np.exp(rng.uniform(np.log(10), np.log(200)))
            fields.append(Field(backend(), volume, size / (2.0 * mean_extinction(volume))))
    return fields


def points_inside(rng: Generator, field: Field, n: int) -> tuple[Singles, Singles]:
    """Points and directions as the data set draws them, without those that may lie outside of the box."""
    points, w, _ = sample_points(rng, field, n, second=0.15, beside=0.0, inside=0.15, anywhere=0.0)
    return points, w


def our_labels(field: Field, seconds: float, seed: int) -> Labels:
    """As many labels of our tracer as `seconds` of process time give, four suns and two albedos a point."""
    rng = np.random.default_rng([seed, 1])

    def some(n: int, key: int) -> Labels:
        points, w = points_inside(rng, field, n)
        g = rng.choice(np.array(PHASES, np.float32), n)
        suns = uniform_directions(rng, n, SUNS)
        albedo = np.broadcast_to(np.array(ALBEDOS, np.float32), (n, len(ALBEDOS)))
        started = time.process_time()
        values = trace_walks(field, points, w, g, suns, albedo, WALKS, key, connect=CONNECT)
        spent = time.process_time() - started
        label = values.mean(axis=1, dtype=np.float64)
        point, sun, column = (a.ravel() for a in np.indices(label.shape))
        return Labels(field, points[point], w[point], g[point], suns[point, sun], albedo[point, column], label.ravel(), spent)

    some(64, 1)
    # A pilot that is small beside the lanes in flight would find walks several times dearer than they are.
    most = max(256, int(2700 * seconds))
    pilot = some(most, 2)
    return some(max(16, int(most * seconds / pilot.seconds)), seed)


def volpath_labels(field: Field, seconds: float, seed: int) -> Labels:
    """The same by volpath: `GROUPS` groups of points, each under a sun, an albedo and a phase function of its own."""
    rng = np.random.default_rng([seed, 2])
    volume, scale = field.volume, field.scale
    parts: list[Labels] = []
    n = 16
    for number in range(GROUPS + 1):
        points, w = points_inside(rng, field, n)
        g, albedo = PHASES[number % len(PHASES)], ALBEDOS[number % len(ALBEDOS)]
        sun = uniform_directions(rng, 1)
        meters = VolpathLabels(volume, scale, g, albedo, points, w, WALKS, rng)
        values, spent = meters.trace(sun[0].astype(np.float64), int(rng.integers(2**31)))
        ones = np.ones(n, np.float32)
        parts.append(Labels(field, points, w, g * ones, np.repeat(sun, n, axis=0), albedo * ones, values.mean(axis=1), spent))
        # The first group is the pilot; what a label cost so far says how many more fit.
        left = seconds - sum(p.seconds for p in parts[1:])
        cost = sum(p.seconds for p in parts) / sum(len(p.label) for p in parts)
        n = max(4, int(left / cost / max(1, GROUPS - number)))
    arrays = {k: np.concatenate([getattr(p, k) for p in parts[1:]]) for k in ("points", "w", "g", "sun", "albedo", "label")}
    return Labels(field=field, seconds=sum(p.seconds for p in parts[1:]), **arrays)


def validation_labels(field: Field, points: int, walks: int, seed: int) -> tuple[Labels, Doubles]:
    """Labels under one sun and one albedo a point, and a second, independent set of them."""
    rng = np.random.default_rng([seed, 3])
    at, w = points_inside(rng, field, points)
    g = rng.choice(np.array(PHASES, np.float32), points)
    albedo = rng.choice(np.array(ALBEDOS, np.float32), points)
    suns = uniform_directions(rng, points, 1)
    halves = [
        trace_walks(field, at, w, g, suns, albedo[:, None], walks, int(s)).mean(axis=(1, 2, 3), dtype=np.float64)
        for s in rng.integers(2**31, size=2)
    ]
    return Labels(field, at, w, g, suns[:, 0], albedo, halves[0], 0.0), halves[1]


def train(sets: list[Labels], steps: int, seed: int, batch: int = 1024, reuse: int = 4) -> Network:
    """A network of width 32 after `steps` steps of Adam on the sets of all clouds in equal parts, its weights averaged."""
    threads = torch.get_num_threads()
    # Two threads that wait for each other cost more on so small a network than they save.
    torch.set_num_threads(1)
    try:
        return _train(sets, steps, seed, batch, reuse)
    finally:
        torch.set_num_threads(threads)


def _train(sets: list[Labels], steps: int, seed: int, batch: int, reuse: int) -> Network:
    rng = np.random.default_rng([seed, 4])
    torch.manual_seed(seed)
    network = Network(NetworkConfig(width=32))
    optimiser = torch.optim.Adam(network.parameters(), lr=2e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    average = WeightAverage(network, 0.99)
    each = reuse * batch // len(sets) + 1
    for step in range(steps):
        if step % reuse == 0:
            drawn = [rng.integers(0, len(s.label), each) for s in sets]
            inputs = [s.inputs(rows, rng) for s, rows in zip(sets, drawn, strict=True)]
            stencil, aux = (np.concatenate([i[c] for i in inputs]) for c in range(2))
            label = np.concatenate([s.label[rows] for s, rows in zip(sets, drawn, strict=True)]).astype(np.float32)
            if step == 0:
                network.fit_inputs(stencil, label)
            order = rng.permutation(len(label))
        mine = order[(step % reuse) * batch : (step % reuse + 1) * batch]
        prediction = network(torch.from_numpy(stencil[mine]), torch.from_numpy(aux[mine]))
        loss = relative_squared_error(prediction, torch.from_numpy(label[mine]))
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
        average.update()
    return average.averaged(network)


@torch.no_grad()
def judge(network: torch.nn.Module, valid: list[tuple[Labels, Doubles]]) -> tuple[float, float]:
    """Relative RMS error free of the labels' noise, root mean square over the clouds, and the relative error of the mean."""
    squares, energies = [], []
    for number, (first, second) in enumerate(valid):
        stencil, aux = first.inputs(np.arange(len(first.label)), np.random.default_rng(number))
        prediction = network(torch.from_numpy(stencil), torch.from_numpy(aux)).numpy().astype(np.float64)
        mean = 0.5 * float(first.label.mean() + second.mean())
        squares.append(float(np.mean((prediction - first.label) * (prediction - second))) / mean**2)
        energies.append(float(prediction.mean()) / mean - 1)
    return max(0.0, float(np.mean(squares))) ** 0.5, float(np.mean(energies))


def information(effort: Effort, seed: int = 11) -> dict[str, Worth]:
    """The network's error after training on the labels of either tracer: ``ours`` and ``volpath``."""
    fields = clouds(TRAINING, effort.clouds, effort.resolution, seed)
    valid = [
        validation_labels(field, effort.points, effort.walks, seed + 100 + i)
        for i, field in enumerate(clouds(VALIDATION, 2, effort.resolution, seed + 50))
    ]
    result = {}
    for name, labels in (("ours", our_labels), ("volpath", volpath_labels)):
        sets = [labels(field, effort.seconds, seed + i) for i, field in enumerate(fields)]
        rrmse, energy = judge(train(sets, effort.steps, seed), valid)
        result[name] = Worth(sum(len(s.label) for s in sets), sum(s.seconds for s in sets), rrmse, energy)
    return result
