"""The convective cloud body that the heaped families share: budding balls, billows, erosion, a flat base."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deepclouds_training.clouds._noise import Array, CellNoise, SmoothNoise, smoothstep
from deepclouds_training.clouds._parameters import CloudParameters, Streams, number
from deepclouds_training.clouds._parcel import condensation, entrainment
from deepclouds_training.clouds._raster import Field, Grid
from deepclouds_training.clouds._turrets import Balls, distance, extent

# Gain of an octave that gives outlines the dimension 4/3 of real cumuli (Lovejoy 1982): 2 ** -(2 - 4 / 3).
_ROUGH = 2 ** (-2 / 3)


@dataclass(frozen=True, kw_only=True)
class HeapParameters(CloudParameters):
    """How the surface and the inside of a convective cloud look."""

    billow: float = number(0.3, 1.0, "height of the cauliflower knobs on the turrets")
    erosion: float = number(0.0, 0.8, "how far dry air eats into the edges, in ragged patches")
    softness: float = number(0.02, 0.2, "width of the edge over the size of a turret", log=True)
    mean_to_max: float = number(0.24, 0.75, "extinction-weighted mean density over the maximum", log=True)


def heap(balls: Balls, parameters: HeapParameters, streams: Streams, turret: float, foot: float = 0.3, lid: float = np.inf) -> Field:
    """Density around `balls` above the condensation level y = 0.

    Parameters
    ----------
    turret
        radius of a typical turret, the unit of all lengths here.
    foot
        extinction at the base over that at the top of an undiluted parcel; 1 for smoke, which does not condense.
    lid
        height above which the extinction grows no more; by default it grows to the top of the cloud.
    """
    knobs = CellNoise.draw(streams("knobs"))
    ragged = SmoothNoise.draw(streams("ragged"))
    bulge = 0.42 * turret * parameters.billow
    lower, upper = extent(balls, bulge + 0.05 * turret)
    lower[1] = -0.12 * turret
    top = min(float(upper[1]), lid)

    def evaluate(grid: Grid) -> Array:
        depth = -distance(grid, balls, 1.3 * bulge + 0.1 * turret)
        depth += np.float32(2 * bulge) * (knobs.octaves(grid, 1.6 / turret, 5, _ROUGH) - np.float32(0.5))
        noise = ragged.octaves(grid, 0.9 / turret, 6, 0.62)
        # Erosion bites in patches: where the slow noise is low nothing happens, so crisp and frayed edges stand side by side.
        depth -= np.float32(0.2 * turret * parameters.erosion) * np.maximum(noise, 0)
        y = grid.open()[1]
        # The condensation level: flat but for a few per cent, and firmer than the sides.
        depth = np.minimum(depth, 1.5 * (y + np.float32(0.03 * turret) * noise))
        edge = smoothstep(0.0, parameters.softness * turret, depth)
        inside = condensation(y / np.float32(top), foot) * entrainment(depth, 0.8 * turret)
        return np.asarray(edge * inside * np.exp(np.float32(0.22) * noise), np.float32)

    return Field(tuple(lower), tuple(upper), evaluate, mean_to_max=parameters.mean_to_max)
