"""Pair: two bodies some way apart, each in the other's shadow under some suns and lit by it under others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepclouds.volume import Volume
from deepclouds_training.clouds import cumulonimbus, cumulus, fractus, pyro, shapes
from deepclouds_training.clouds._noise import Array
from deepclouds_training.clouds._parameters import CloudParameters, Streams, choice, number, resolve
from deepclouds_training.clouds._raster import Field, Grid, rasterise

_BODIES: dict[str, tuple[type[CloudParameters], Callable[[Any, Streams], Field]]] = {
    "cumulus": (cumulus.CumulusParameters, cumulus.build),
    "cumulonimbus": (cumulonimbus.CumulonimbusParameters, cumulonimbus.build),
    "fractus": (fractus.FractusParameters, fractus.build),
    "pyro": (pyro.PyroParameters, pyro.build),
    "shapes": (shapes.ShapesParameters, shapes.build),
}
# Samples along a body's longest side before it is placed.
_RESOLUTION = 80


@dataclass(frozen=True, kw_only=True)
class PairParameters(CloudParameters):
    """Parameters of two bodies."""

    first: str = choice(tuple(_BODIES), "family of the one")
    second: str = choice(tuple(_BODIES), "family of the other")
    size: float = number(0.5, 1.0, "size of the other over that of the one")
    level: float = number(0.2, 1.0, "largest density of the other over that of the one", log=True, usual=1.0, usual_share=0.3)
    gap: float = number(0.05, 3.0, "free way between the spheres about them over the sum of their radii", log=True)


def build(parameters: PairParameters, streams: Streams) -> Field:
    """Density of both over space; where they meet, the denser one counts."""
    bodies = [_body(kind, streams, name) for kind, name in ((parameters.first, "first"), (parameters.second, "second"))]
    sizes = np.array([1.0, parameters.size])
    halves = [size * body.bounds[1] for size, body in zip(sizes, bodies, strict=True)]
    away = streams("placement").standard_normal(3)
    away *= (1 + parameters.gap) * np.linalg.norm(halves, axis=1).sum() / np.linalg.norm(away) / np.sqrt(3)
    centres = (-away / 2, away / 2)

    def evaluate(grid: Grid) -> Array:
        out = np.zeros(grid.shape, np.float32)
        for body, half, centre, level in zip(bodies, halves, centres, (1.0, parameters.level), strict=True):
            placed = _resampled(
                body.density, [(axis - c + h) / (2 * h) for axis, c, h in zip((grid.x, grid.y, grid.z), centre, half, strict=True)]
            )
            np.maximum(out, np.float32(level) * placed, out=out)
        return out

    lower = np.min([c - h for c, h in zip(centres, halves, strict=True)], axis=0)
    upper = np.max([c + h for c, h in zip(centres, halves, strict=True)], axis=0)
    return Field(tuple(lower), tuple(upper), evaluate)


def _body(kind: str, streams: Streams, name: str) -> Volume:
    parameters, make = _BODIES[kind]
    seed = int(streams(name).integers(2**31))
    for attempt in range(16):
        values = resolve(parameters, kind, {}, _prefixed(seed, f"{attempt} parameter "))
        volume = rasterise(make(values, _prefixed(seed, f"{attempt} ")), _RESOLUTION, values.voxel_aspect)
        if volume is not None:
            return volume
    return Volume.from_box(np.ones((1, 1, 1), np.float32), (-1, -1, -1), (1, 1, 1))


def _prefixed(seed: int, prefix: str) -> Streams:
    """The streams of one body, apart from those of the pair and of the other body."""
    return lambda part: np.random.default_rng(np.random.SeedSequence(seed, spawn_key=tuple((prefix + part).encode())))


def _resampled(density: NDArray[np.float32], shares: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    """Linear between cell centres, zero outside of the box: `density` (nz, ny, nx) at shares of its sides along x, y and z."""
    out = density
    for axis, share in zip((2, 1, 0), shares, strict=True):
        n = density.shape[axis]
        at = np.clip(share * n - 0.5, 0, n - 1)
        low = np.minimum(at.astype(np.int64), max(n - 2, 0))
        weight = (at - low).astype(np.float32) * ((share >= 0) & (share <= 1))
        rest = (1 - (at - low)).astype(np.float32) * ((share >= 0) & (share <= 1))
        shape = [1, 1, 1]
        shape[axis] = len(share)
        out = out.take(low, axis) * rest.reshape(shape) + out.take(np.minimum(low + 1, n - 1), axis) * weight.reshape(shape)
    return out
