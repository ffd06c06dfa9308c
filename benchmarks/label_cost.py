"""Core-seconds until labels at fixed points reach a standard error, for both tracers and with the noise between labels counted."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from deepclouds_training.clouds import make_cloud, scale_for_optical_depth
from deepclouds_training.label_config import GenerateConfig
from deepclouds_training.labels import FLOOR
from deepclouds_training.points import sample_points, uniform_directions
from numpy.typing import NDArray

from benchmarks.label_volpath import VolpathLabels
from deepclouds.backend import backend
from deepclouds.medium.field import Field
from deepclouds.medium.multiple_scattering import trace_walks
from deepclouds.volume import Volume

Singles = NDArray[np.float32]
Doubles = NDArray[np.float64]
# What the data set asks of a point.
PHASES = (0.0, 0.6, 0.85)
ALBEDOS = (1.0, 0.95)
SUNS = 4
TARGET = 0.02
CONNECT = float(GenerateConfig().connect)


@dataclass(frozen=True)
class Cloud:
    """A cloud of the generator: name in the tables, family, seed and optical depth of its densest column."""

    name: str
    family: str
    seed: int
    optical_depth: float


CLOUDS = (
    Cloud("dense cumulus", "cumulus", 3, 40.0),
    Cloud("sparse field", "cumulus_field", 5, 15.0),
    Cloud("thin stratus", "stratus", 7, 2.0),
)


@dataclass(frozen=True)
class Task:
    """Labels asked for: points in groups of one phase function, the suns of all of them, and means good to about a per cent.

    Attributes
    ----------
    groups
        for each of `PHASES` the points (n, 3) and directions (n, 3).
    suns
        (4, 3) unit vectors TOWARD the suns.
    means
        for each group the labels (n, 4, 2).
    """

    cloud: Cloud
    volume: Volume
    scale: float
    groups: tuple[tuple[Singles, Singles], ...]
    suns: Singles
    means: tuple[Doubles, ...]

    @property
    def needed(self) -> tuple[Doubles, ...]:
        """Largest standard error allowed: 2 % of the label, or of a tenth of the cloud's mean label where the label is below that."""
        floor = FLOOR * float(np.concatenate(self.means).mean())
        return tuple(TARGET * np.maximum(mean, floor) for mean in self.means)


@dataclass(frozen=True)
class Cost:
    """What one repetition of one tracer found.

    Attributes
    ----------
    seconds
        core-seconds until every label reaches the target.
    typical
        the same with the variance of a point's labels averaged rather than the worst of them: less noisy.
    paths_per_second
        paths traced per core-second; all of them start in the cloud.
    load
        core-seconds to load scene and sensors, or to build the field; not part of `seconds`.
    effective
        independent labels that a walk's eight are worth (eight for independent paths).
    """

    seconds: float
    typical: float
    paths_per_second: float
    load: float
    effective: float


def make_task(cloud: Cloud, resolution: int, points: int, walks: int) -> Task:
    """Draw the points of `cloud`, a third for each phase function, and trace the mean of `walks` walks for each."""
    volume = make_cloud(cloud.family, cloud.seed, resolution)
    scale = scale_for_optical_depth(volume, cloud.optical_depth)
    field = Field(backend(), volume, scale)
    streams = np.random.SeedSequence([71, cloud.seed]).spawn(3)
    rng = np.random.default_rng(streams[0])
    suns = uniform_directions(rng, SUNS)
    at, w, _ = sample_points(rng, field, points, second=0.2, beside=0.0, inside=0.15, anywhere=0.0)
    groups = tuple((at[i :: len(PHASES)], w[i :: len(PHASES)]) for i in range(len(PHASES)))
    seeds = streams[1].generate_state(len(PHASES))
    means = []
    for (p, d), g, seed in zip(groups, PHASES, seeds, strict=True):
        means.append(walk(field, p, d, g, suns, walks, int(seed))[0].mean(axis=1))
    return Task(cloud, volume, scale, groups, suns, tuple(means))


def walk(field: Field, points: Singles, w: Singles, g: float, suns: Singles, walks: int, seed: int) -> tuple[Doubles, float]:
    """Walks of our tracer (n, walks, 4, 2), and the process time of the call."""
    n = len(points)
    started = time.process_time()
    values = trace_walks(
        field,
        points,
        w,
        np.full(n, g, np.float32),
        np.broadcast_to(suns, (n, *suns.shape)),
        np.broadcast_to(np.array(ALBEDOS, np.float32), (n, len(ALBEDOS))),
        walks,
        seed,
        connect=CONNECT,
    )
    seconds = time.process_time() - started
    return values.astype(np.float64), seconds


def compile_seconds() -> float:
    """Process time of the first call of our tracer, which compiles its kernel or loads it from Dr.Jit's cache on disk."""
    field = Field(backend(), Volume.from_box(np.ones((2, 2, 2)), (0, 0, 0), (1, 1, 1)), 1.0)
    ahead = np.array([[0, 0, 1]], np.float32)
    return walk(field, np.full((1, 3), 0.5, np.float32), ahead, 0.0, np.repeat(ahead, SUNS, axis=0), 8192, 1)[1]


def our_cost(task: Task, walks: int, seed: int) -> Cost:
    """Cost of the labels by our tracer: one walk serves four suns and two albedos, so the worst of a point's labels sets its walks."""
    started = time.process_time()
    field = Field(backend(), task.volume, task.scale)
    load = time.process_time() - started
    worst, typical, spent, effective = 0.0, 0.0, 0.0, []
    for number, ((points, w), g, allowed) in enumerate(zip(task.groups, PHASES, task.needed, strict=True)):
        values, seconds = walk(field, points, w, g, task.suns, walks, seed + number)
        needed = values.var(axis=1, ddof=1) / allowed**2
        each = seconds / (len(points) * walks)
        worst += each * float(needed.max(axis=(1, 2)).sum())
        typical += each * float(needed.mean(axis=(1, 2)).sum())
        spent += seconds
        effective += [effective_labels(v.reshape(walks, -1)) for v in values]
    total = sum(len(points) for points, _ in task.groups) * walks
    return Cost(worst, typical, total / spent, load, float(np.median(effective)))


def volpath_cost(task: Task, walks: int, seed: int) -> Cost:
    """Cost of the labels by volpath: every sun and every albedo needs paths of its own."""
    total, load, spent, paths = 0.0, 0.0, 0.0, 0
    seeds = iter(np.random.SeedSequence(seed).generate_state(len(PHASES) * SUNS * len(ALBEDOS)).tolist())
    for number, ((points, w), g, allowed) in enumerate(zip(task.groups, PHASES, task.needed, strict=True)):
        for m, albedo in enumerate(ALBEDOS):
            rng = np.random.default_rng([seed, number, m])
            labels = VolpathLabels(task.volume, task.scale, g, albedo, points, w, walks, rng)
            load += labels.load_seconds
            for k, sun in enumerate(task.suns):
                values, seconds = labels.trace(sun.astype(np.float64), next(seeds))
                needed = values.var(axis=1, ddof=1) / allowed[:, k, m] ** 2
                total += seconds / values.size * float(needed.sum())
                spent += seconds
                paths += values.size
    return Cost(total, total, paths / spent, load, float(SUNS * len(ALBEDOS)))


def volpath_speed(task: Task, walks: int) -> float:
    """Paths per core-second of volpath under Mitsuba's present variant, its kernels compiled."""
    points, w = task.groups[1]
    labels = VolpathLabels(task.volume, task.scale, PHASES[1], ALBEDOS[0], points, w, walks, np.random.default_rng(5))
    for seed in (1, 2):
        values, seconds = labels.trace(task.suns[0].astype(np.float64), seed)
    return values.size / seconds


def effective_labels(walks: Doubles) -> float:
    """Independent labels that correlated ones (walks, labels) are worth: labels^2 over the sum of their correlation matrix.

    It is the ratio of the variance that the mean of the standardised labels would have if all were one, to what it has, for labels
    that never vary left out.
    """
    varying = walks[:, walks.std(axis=0) > 0]
    if varying.shape[1] == 0:
        return 0.0
    correlation = np.atleast_2d(np.corrcoef(varying, rowvar=False))
    return float(varying.shape[1] ** 2 / correlation.sum())
