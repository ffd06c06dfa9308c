"""A field of fair-weather cumuli: many separate clouds on one condensation level."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deepclouds_training.clouds._heap import HeapParameters, heap
from deepclouds_training.clouds._parameters import Streams, number
from deepclouds_training.clouds._raster import Field
from deepclouds_training.clouds._turrets import bud
from deepclouds_training.clouds.cumulus import towers

# Cumuli of width l are as many as l to this power (Neggers, Jonker and Siebesma 2003).
_SIZES = -1.7


@dataclass(frozen=True, kw_only=True)
class CumulusFieldParameters(HeapParameters):
    """Parameters of a cumulus field."""

    clouds: int = number(3, 40, "clouds in the field", integer=True, log=True)
    spacing: float = number(1.0, 2.0, "distance between neighbours over the sum of their radii, at least", log=True)
    spread: float = number(0.2, 0.8, "how much the clouds differ in size: share by which the smallest is smaller than the largest")
    flatness: float = number(1.0, 2.5, "how much flatter than wide the clouds are", log=True)


def sizes(count: int, smallest: float) -> list[float]:
    """Widths from 1 down to `smallest`: equal steps of the cumulative power law of cumulus sizes."""
    ends = np.array([1.0, smallest]) ** (_SIZES + 1)
    return [float(v) for v in np.linspace(ends[0], ends[1], count) ** (1 / (_SIZES + 1))]


def build(parameters: CumulusFieldParameters, streams: Streams) -> Field:
    """Density of a field of cumuli over space; the bases lie at y = 0."""
    rng = streams("field")
    placed = np.empty((0, 3))
    every = []
    for size in sizes(parameters.clouds, 1 - parameters.spread):
        radius, reach = 0.65 * size, 0.0
        while True:
            angle = rng.uniform(0, 2 * np.pi)
            x, z = reach * np.cos(angle), reach * np.sin(angle)
            if np.all(np.hypot(x - placed[:, 0], z - placed[:, 1]) > parameters.spacing * (radius + placed[:, 2])):
                break
            reach += 0.05 * radius
        placed = np.vstack([placed, (x, z, radius)])
        height = size * rng.uniform(0.6, 1) / parameters.flatness
        body = towers(rng, int(rng.integers(2, 6)), 1.3 * size, rng.uniform(0.6, 1.0), rng.uniform(0, 0.3), height=height)
        body = bud(rng, body, 2, 5, 0.46, upward=0.35, floor=0.0)
        body[:, [0, 2]] += (x, z)
        every.append(body)
    return heap(np.concatenate(every), parameters, streams, turret=0.26 / np.sqrt(parameters.flatness))
