"""The convective cloud body that cumulus, its fields and congestus share: budding balls, billows, erosion, a flat base."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deepclouds_training.clouds._noise import Array, CellNoise, SmoothNoise, smoothstep
from deepclouds_training.clouds._parameters import CloudParameters, Streams, number
from deepclouds_training.clouds._raster import Field, Grid
from deepclouds_training.clouds._turrets import Balls, distance, extent


@dataclass(frozen=True, kw_only=True)
class HeapParameters(CloudParameters):
    """How the surface and the inside of a convective cloud look."""

    billow: float = number(0.3, 1.0, "height of the cauliflower knobs on the turrets")
    erosion: float = number(0.0, 0.8, "how far dry air eats into the edges, in ragged patches")
    softness: float = number(0.02, 0.2, "width of the edge over the size of a turret", log=True)
    mean_to_max: float = number(0.3, 0.75, "extinction-weighted mean density over the maximum")


def heap(balls: Balls, parameters: HeapParameters, streams: Streams, turret: float, base: float) -> Field:
    """Density around `balls` above the height `base`; `turret` is the radius of a typical turret, the unit of all lengths here."""
    knobs = CellNoise.draw(streams("knobs"))
    ragged = SmoothNoise.draw(streams("ragged"))
    bulge = 0.42 * turret * parameters.billow
    lower, upper = extent(balls, bulge + 0.05 * turret)
    lower[1] = base - 0.12 * turret
    top = float(upper[1])

    def evaluate(grid: Grid) -> Array:
        depth = -distance(grid, balls, 1.3 * bulge + 0.1 * turret)
        depth += np.float32(2 * bulge) * (knobs.octaves(grid, 1.6 / turret, 4, 0.55) - np.float32(0.5))
        noise = ragged.octaves(grid, 0.9 / turret, 6, 0.62)
        # Erosion bites in patches: where the slow noise is low nothing happens, so crisp and frayed edges stand side by side.
        depth -= np.float32(0.2 * turret * parameters.erosion) * np.maximum(noise, 0)
        y = grid.open()[1]
        # The condensation level: flat but for a few per cent, and firmer than the sides.
        above = y - np.float32(base) + np.float32(0.03 * turret) * noise
        depth = np.minimum(depth, 1.5 * above)
        edge = smoothstep(0.0, parameters.softness * turret, depth)
        # Liquid water grows with height above the base; mixing with dry air thins the outer shell.
        wetness = np.float32(0.35) + np.float32(0.65) * np.sqrt(np.clip((y - base) / np.float32(top - base), 0, 1))
        core = np.float32(0.45) + np.float32(0.55) * smoothstep(0.0, 0.8 * turret, depth)
        return np.asarray(edge * wetness * core * np.exp(np.float32(0.22) * noise), np.float32)

    return Field(tuple(lower), tuple(upper), evaluate, mean_to_max=parameters.mean_to_max)
