"""Cases that the method is known to find hard: backlit stratus, shapes that are no clouds, and the shadow of a second cloud.

J at first collisions, as predicted, against Monte Carlo walks of our own tracker: unbiased, in two independent halves.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from deepclouds_runtime import predict
from deepclouds_runtime.scattering import Predicts
from deepclouds_training.clouds import make_cloud, scale_for_optical_depth
from deepclouds_training.points import around, random_lines
from numpy.random import Generator
from numpy.typing import NDArray

from benchmarks.accuracy_figures import Figure, Row, bootstrap, noise_free
from deepclouds.backend import backend
from deepclouds.medium.field import Field
from deepclouds.medium.first_collision import first_collisions
from deepclouds.medium.multiple_scattering import trace_walks
from deepclouds.model.trust import FLOOR
from deepclouds.volume import Volume
from deepclouds.volume.pyramid import mean_extinction

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
# Rays that look for points, and walks traced at once.
_RAYS = 4096
_AT_ONCE = 2**20


@dataclass(frozen=True)
class Case:
    """A cloud under one sun.

    Attributes
    ----------
    name, volume, scale, g, omega_sun
        what it is, its density and extinction, the phase function, and the unit vector TOWARD the sun; the albedo is 1.
    rays
        generator, count -> origins and directions (n, 3) of rays that look at it.
    counts
        points (n, 3) -> whether they belong to what is judged.
    """

    name: str
    volume: Volume
    scale: float
    g: float
    omega_sun: Floats
    rays: Callable[[Generator, int], tuple[Singles, Singles]]
    counts: Callable[[Singles], NDArray[np.bool_]]


@dataclass(frozen=True)
class CaseResult:
    """j = 4 pi J / E at n points, as predicted and as two halves of walks, all (n,); and the error that the model expects, if it does."""

    name: str
    predicted: Floats
    half_a: Floats
    half_b: Floats
    expected: Floats | None = None

    @property
    def row(self) -> Row:
        """Noise-free error and energy, intervals over the points."""
        figures = noise_free(self.predicted, self.half_a, self.half_b)
        if self.expected is not None:
            figures |= relative(self.predicted, self.half_a, self.half_b, self.expected)
        return Row("special", f"{self.name}, {len(self.predicted)} points", figures)


def cases() -> list[Case]:
    """The four cases, made from stated seeds."""
    return [_backlit_stratus(), _sphere(), _box(), _shadowed()]


def measure_case(case: Case, predictor: Predicts, points: int, walks: int, seed: int) -> CaseResult:
    """Compare J at `points` first collisions, `walks` walks each."""
    streams = [int(s) for s in np.random.SeedSequence(seed).generate_state(4)]
    rng = np.random.default_rng(streams[0])
    field = Field(backend(), case.volume, case.scale)
    origins, directions = case.rays(rng, _RAYS)
    hits, hit = first_collisions(field, origins, directions, streams[1])
    chosen = np.flatnonzero(hit & case.counts(hits))[:points]
    x, w = hits[chosen], directions[chosen]
    half_a, half_b = (_walked(case, field, x, w, walks // 2, stream) for stream in streams[2:])
    asked = _Asked(predictor)
    j = predict(x, w, volume=case.volume, scale=case.scale, g=case.g, albedo=1.0, omega_sun=case.omega_sun, predictor=asked)
    return CaseResult(case.name, 4 * math.pi * j, half_a, half_b, np.concatenate(asked.errors) if asked.errors else None)


def relative(predicted: Floats, half_a: Floats, half_b: Floats, expected: Floats) -> dict[str, Figure]:
    """Errors in units of ``j + 0.05``, each point alike: ``expected`` by the model, and ``found``; roots of the mean square."""
    unit = np.square(predicted + FLOOR)
    cases = np.stack([np.square(expected) / unit, (predicted - half_a) * (predicted - half_b) / unit], axis=1)

    def root_mean(v: Floats) -> Floats:
        return np.asarray(np.sqrt(np.maximum(v.mean(axis=1), 0)))

    return {name: bootstrap(column, root_mean) for name, column in zip(("expected", "found"), cases.T, strict=True)}


class _Asked:
    """The network, and the errors to expect of what it was asked."""

    def __init__(self, predictor: Predicts) -> None:
        self._predictor = predictor
        self._errors = getattr(predictor, "errors", None)
        self.errors: list[Floats] = []

    def predict(self, stencil: Singles, aux: Singles) -> Singles:
        j = self._predictor.predict(stencil, aux)
        found = None if self._errors is None else self._errors(stencil, aux, j)
        if found is not None:
            self.errors.append(found.astype(np.float64))
        return j


def _walked(case: Case, field: Field, x: Singles, w: Singles, walks: int, seed: int) -> Floats:
    """Mean of so many walks of each point, a portion of them at a time."""
    n = len(x)
    g, white = np.full(n, case.g, np.float32), np.ones((n, 1), np.float32)
    suns = np.broadcast_to(case.omega_sun.astype(np.float32), (n, 1, 3))
    total = np.zeros(n)
    portion = max(1, _AT_ONCE // n)
    for number, first in enumerate(range(0, walks, portion)):
        j = trace_walks(field, x, w, g, suns, white, min(portion, walks - first), seed + number)
        total += j[:, :, 0, 0].sum(axis=1, dtype=np.float64)
    return total / walks


def _everywhere(points: Singles) -> NDArray[np.bool_]:
    return np.ones(len(points), bool)


def _lines(volume: Volume, scale: float) -> Callable[[Generator, int], tuple[Singles, Singles]]:
    """Uniform lines through the bounding sphere."""
    return lambda rng, n: random_lines(rng, Field(backend(), volume, scale), n)


def _direction(vector: list[float]) -> Floats:
    unit: Floats = np.asarray(vector, np.float64) / np.linalg.norm(vector)
    return unit


def _backlit_stratus() -> Case:
    volume = make_cloud("stratus", 9101, 96)
    sun = _direction([0.8, 0.6, 0.0])

    def rays(rng: Generator, n: int) -> tuple[Singles, Singles]:
        # From below, within 35 degrees of the sun.
        w = around(rng, np.tile(sun, (n, 1)).astype(np.float32), np.deg2rad(35) * np.sqrt(rng.random(n)))
        lower, upper = volume.bounds
        through = rng.uniform(lower, upper, (n, 3))
        return (through - 10 * w).astype(np.float32), w

    return Case("backlit stratus", volume, scale_for_optical_depth(volume, 10.0), 0.85, sun, rays, _everywhere)


def _sphere() -> Case:
    axis = (np.arange(64) + 0.5) / 32 - 1
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    # One voxel's width of slope at the surface.
    volume = Volume.from_box(np.clip((0.9 - np.sqrt(x * x + y * y + z * z)) * 32 + 0.5, 0, 1), (-1, -1, -1), (1, 1, 1))
    return Case("sphere", volume, 15.0, 0.85, _direction([0.3, 0.9, 0.3]), _lines(volume, 15.0), _everywhere)


def _box() -> Case:
    volume = Volume.from_box(np.ones((2, 2, 2)), (-1, -1, -1), (1, 1, 1))
    return Case("box", volume, 4.0, 0.0, _direction([0.5, 0.8, 0.2]), _lines(volume, 4.0), _everywhere)


def _shadowed() -> Case:
    """Two clouds side by side: the one at +x, a mirror image of the other, stands between it and the sun."""
    one = make_cloud("cumulus", 9102, 48)
    density = np.concatenate([one.density, np.zeros_like(one.density), one.density[:, :, ::-1]], axis=2)
    lower, upper = one.bounds
    width = upper[0] - lower[0]
    volume = Volume.from_box(density, lower, upper + np.array([2 * width, 0, 0]))
    scale = 40.0 / (2.0 * mean_extinction(one))
    alone = Volume.from_box(one.density, lower, upper)
    return Case(
        "second cloud's shadow", volume, scale, 0.85, _direction([1.0, 0.05, 0.03]), _lines(alone, scale), lambda p: p[:, 0] < upper[0]
    )
