"""Cumulus congestus: a tall tower of rising bulbs without an anvil."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deepclouds_training.clouds._heap import HeapParameters, heap
from deepclouds_training.clouds._parameters import Streams, number
from deepclouds_training.clouds._raster import Field
from deepclouds_training.clouds._turrets import Balls, bud


@dataclass(frozen=True, kw_only=True)
class CongestusParameters(HeapParameters):
    """Parameters of a congestus."""

    height: float = number(1.6, 3.2, "height of the tower over the width of its base")
    bulbs: int = number(4, 8, "bulbs that rise one above the other", integer=True)
    shear: float = number(0.0, 0.35, "how far the top leans over the base, over the height")
    shoulders: int = number(2, 5, "lower towers beside the main one", integer=True)


def tower(rng: np.random.Generator, height: float, bulbs: int, shear: float, shoulders: int, waist: float = 0.14) -> Balls:
    """Balls of a tower of this height on a base about 1 wide at y = 0, with lower towers at its foot; `waist` is how far it narrows."""
    balls = []
    for k in range(bulbs):
        t = k / (bulbs - 1)
        # A waist above the base and a swollen head, as a rising thermal has.
        radius = (0.42 - waist * np.sin(np.pi * min(1.25 * t, 1.0)) - 0.08 * t) * rng.uniform(0.9, 1.15)
        y = 0.15 + t * (height - 0.15 - radius)
        drift = rng.normal(0, 0.07, 2)
        balls.append((shear * y + drift[0], y, drift[1], radius))
        # Between bulbs the tower is filled, or tall thin towers fall apart.
        if k:
            low = balls[-2 if k == 1 else -3]
            balls.append(tuple(0.5 * (np.array(low) + np.array(balls[-1])) * (1, 1, 1, 0.85)))
            balls[-1], balls[-2] = balls[-2], balls[-1]
    for k in range(shoulders):
        angle = 2 * np.pi * (k * 0.618 + 0.2 * rng.random())
        top = height * rng.uniform(0.12, 0.5)
        radius = rng.uniform(0.2, 0.28)
        for y in np.arange(0.1, top, 0.7 * radius):
            balls.append((0.3 * np.cos(angle) + shear * y, y, 0.3 * np.sin(angle), radius * rng.uniform(0.85, 1.1)))
    return np.array(balls)


def build(parameters: CongestusParameters, streams: Streams) -> Field:
    """Density of a congestus over space; the base lies at y = 0 and is about 1 wide."""
    rng = streams("towers")
    trunk = tower(rng, parameters.height, parameters.bulbs, parameters.shear, parameters.shoulders)
    return heap(bud(rng, trunk, 2, 7, 0.45, upward=0.3, floor=0.0), parameters, streams, turret=0.26)
