"""A field of fair-weather cumuli: several separate clouds on one condensation level."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deepclouds_training.clouds._heap import HeapParameters, heap
from deepclouds_training.clouds._parameters import Streams, number
from deepclouds_training.clouds._raster import Field
from deepclouds_training.clouds._turrets import bud
from deepclouds_training.clouds.cumulus import towers


@dataclass(frozen=True, kw_only=True)
class CumulusFieldParameters(HeapParameters):
    """Parameters of a cumulus field."""

    clouds: int = number(3, 8, "clouds in the field", integer=True)
    spacing: float = number(1.0, 1.4, "distance between neighbours over the sum of their radii")
    spread: float = number(0.2, 0.7, "how much the clouds differ in size: share by which the smallest is smaller than the largest")


def build(parameters: CumulusFieldParameters, streams: Streams) -> Field:
    """Density of a field of cumuli over space; the bases lie at y = 0."""
    rng = streams("field")
    placed: list[tuple[float, float, float]] = []
    every = []
    for k in range(parameters.clouds):
        size = 1 - parameters.spread * k / (parameters.clouds - 1)
        radius, reach = 0.8 * size, 0.0
        while True:
            angle = rng.uniform(0, 2 * np.pi)
            x, z = reach * np.cos(angle), reach * np.sin(angle)
            if all(np.hypot(x - a, z - b) > parameters.spacing * (radius + r) for a, b, r in placed):
                break
            reach += 0.05 * radius
        placed.append((x, z, radius))
        body = towers(
            rng, int(rng.integers(2, 6)), 1.3 * size, rng.uniform(0.6, 1.0), rng.uniform(0, 0.3), height=size * rng.uniform(0.6, 1)
        )
        body = bud(rng, body, 2, 5, 0.46, upward=0.35, floor=0.0)
        body[:, [0, 2]] += (x, z)
        every.append(body)
    return heap(np.concatenate(every), parameters, streams, turret=0.26, base=0.0)
