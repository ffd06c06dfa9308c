"""Pyro: the rolling smoke of a fire or an explosion, with sharp billows and thin hot cells."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from deepclouds_training.clouds._heap import HeapParameters, heap
from deepclouds_training.clouds._noise import Array, CellNoise
from deepclouds_training.clouds._parameters import Streams, number
from deepclouds_training.clouds._raster import Field, Grid
from deepclouds_training.clouds._turrets import bud


@dataclass(frozen=True, kw_only=True)
class PyroParameters(HeapParameters):
    """Parameters of a fire's or an explosion's cloud."""

    billow: float = number(0.6, 1.0, "height of the cauliflower knobs on the billows")
    erosion: float = number(0.0, 0.3, "how far air eats into the edges, in ragged patches")
    softness: float = number(0.01, 0.06, "width of the edge over the size of a billow", log=True)
    mean_to_max: float = number(0.24, 0.5, "extinction-weighted mean density over the maximum")
    height: float = number(0.7, 2.6, "height over the width of the head; below 1 it is a fireball on the ground", log=True)
    stem: float = number(0.2, 0.6, "width of the stem over that of the head")
    roll: float = number(0.0, 1.0, "how far the head has rolled up into a ring")
    wind: float = number(0.0, 0.4, "how far the head drifts, over the height")
    contrast: float = number(0.3, 1.5, "deviation of the logarithm of density between hot cells and soot")


def build(parameters: PyroParameters, streams: Streams) -> Field:
    """Density of a rolling cloud over space; it stands on the ground y = 0 and its head is about 1 wide."""
    rng = streams("billows")
    height = parameters.height
    head = max(height - 0.42, 0.3)
    balls = []
    count = 9
    for k in range(count):
        # The ring vortex of the head: its outside rolls over and down.
        angle = 2 * np.pi * (k + 0.5 * rng.random()) / count
        radius = rng.uniform(0.19, 0.26)
        out = 0.25 + 0.08 * parameters.roll
        balls.append((out * np.cos(angle), head - (0.02 + 0.1 * parameters.roll) + rng.normal(0, 0.03), out * np.sin(angle), radius))
    for _ in range(3):
        balls.append((rng.normal(0, 0.06), head + rng.uniform(0.06, 0.2), rng.normal(0, 0.06), rng.uniform(0.2, 0.26)))
    y = 0.06
    while y < head:
        share = y / head
        # The stem flares where it meets the ground and where it feeds the head.
        radius = 0.5 * parameters.stem * (0.8 + 0.35 * (1 - share) ** 3 + 0.2 * share) * rng.uniform(0.8, 1.2)
        balls.append((rng.normal(0, 0.05), y, rng.normal(0, 0.05), radius))
        y += 0.55 * radius
    trunk = np.array(balls)
    trunk[:, 0] += parameters.wind * trunk[:, 1] ** 2 / height
    body = heap(bud(rng, trunk, 2, 8, 0.44, upward=0.15, floor=-0.05), parameters, streams, turret=0.27, foot=1.0)
    cells = CellNoise.draw(streams("cells"))

    def evaluate(grid: Grid) -> Array:
        # Soot gathers in the walls between cells of hot gas, which are thin.
        hot = cells.octaves(grid, 5.0, 3, 0.6)
        return np.asarray(body.evaluate(grid) * np.exp(np.float32(-4 * parameters.contrast) * (hot - np.float32(0.5))), np.float32)

    return replace(body, evaluate=evaluate)
