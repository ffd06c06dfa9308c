"""Cumulus: a heap with a flat base and a cauliflower top."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from deepclouds_training.clouds._heap import HeapParameters, heap
from deepclouds_training.clouds._noise import Array
from deepclouds_training.clouds._parameters import Streams, number
from deepclouds_training.clouds._raster import Field, Grid
from deepclouds_training.clouds._turrets import Balls, bud


@dataclass(frozen=True, kw_only=True)
class CumulusParameters(HeapParameters):
    """Parameters of a cumulus."""

    turrets: int = number(3, 9, "towers that rise from the base", integer=True)
    width: float = number(1.0, 2.4, "width of the base over the height of the cloud")
    depth: float = number(0.5, 1.0, "depth of the base over its width")
    shear: float = number(0.0, 0.5, "how far the top leans over the base, over the height")
    flatness: float = number(1.0, 3.0, "how far fair weather presses the heap flat: 1 is mediocris, 3 humilis", usual=1.0, usual_share=0.5)


def towers(rng: np.random.Generator, count: int, width: float, depth: float, shear: float, height: float = 1.0) -> Balls:
    """Balls of a heap whose base is at y = 0: `count` towers, the tallest near the middle, all covered with buds."""
    columns = []
    for k in range(count):
        angle = 2 * np.pi * (k * 0.618 + rng.random() * 0.2)
        away = np.sqrt((k + 0.3 * rng.random()) / count)
        x, z = 0.5 * width * away * np.cos(angle), 0.5 * width * depth * away * np.sin(angle)
        tall = height * (1 - 0.65 * away**1.5) * rng.uniform(0.8, 1.0)
        radius = min(0.36 * height, 0.42 * tall + 0.05 * width) * rng.uniform(0.85, 1.1)
        y = 0.2 * radius
        while True:
            columns.append((x + shear * y + rng.normal(0, 0.12) * radius, y, z + rng.normal(0, 0.12) * radius, radius))
            if y + radius >= tall:
                break
            radius *= rng.uniform(0.78, 0.92)
            y += 0.75 * radius
    return np.array(columns)


def build(parameters: CumulusParameters, streams: Streams) -> Field:
    """Density of a cumulus over space; the base lies at y = 0, the top near 1 over the flatness."""
    rng = streams("towers")
    trunk = towers(rng, parameters.turrets, parameters.width, parameters.depth, parameters.shear)
    balls = bud(rng, trunk, 2, 7, 0.46, upward=0.35, floor=0.0)
    body = heap(balls, parameters, streams, turret=0.3)
    flat = np.array([1.0, parameters.flatness, 1.0])

    def evaluate(grid: Grid) -> Array:
        return body.evaluate(Grid(grid.x, grid.y * np.float32(parameters.flatness), grid.z, grid.spacing * flat))

    return replace(body, lower=tuple(np.array(body.lower) / flat), upper=tuple(np.array(body.upper) / flat), evaluate=evaluate)
