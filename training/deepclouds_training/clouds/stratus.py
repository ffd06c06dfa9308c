"""Stratus: an even layer, closed or nearly so, that may run on beyond the box."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deepclouds_training.clouds._layer import KOLMOGOROV, LayerParameters, covered, fade, layer, sheet
from deepclouds_training.clouds._noise import Array, SmoothNoise
from deepclouds_training.clouds._parameters import Streams, number
from deepclouds_training.clouds._raster import Field, Grid


@dataclass(frozen=True, kw_only=True)
class StratusParameters(LayerParameters):
    """Parameters of a stratus."""

    thickness: float = number(0.04, 0.2, "thickness of the layer over its width", log=True)
    coverage: float = number(0.7, 1.0, "share of the sky that is covered", usual=1.0, usual_share=0.6)
    undulations: float = number(1.5, 6.0, "slow swells across the width", log=True)
    waviness: float = number(0.1, 0.5, "deviation of the logarithm of a column's optical depth")
    mean_to_max: float = number(0.4, 0.75, "extinction-weighted mean density over the maximum")


def build(parameters: StratusParameters, streams: Streams) -> Field:
    """Density of an even layer over space; it is 1 wide and its base lies near y = 0."""
    swells = SmoothNoise.draw(streams("swells"))
    fine = SmoothNoise.draw(streams("fine"))
    ragged = SmoothNoise.draw(streams("ragged"))
    thick, half_z = parameters.thickness, parameters.depth / 2
    cut = parameters.edges == "cut"

    def evaluate(grid: Grid) -> Array:
        plan = swells.octaves(sheet(grid), parameters.undulations, 7, KOLMOGOROV)
        column = covered(np.float32(parameters.waviness) * plan, parameters.coverage)
        if not cut:
            column = column * fade(grid, parameters.depth, ragged)
        noise = fine.octaves(grid, 0.3 / thick, 5, 0.55, stretch=(2.0, 1, 2.0))
        return layer(grid, column, thick, noise, foot=0.35, sag=0.2, roughness=0.06)

    return Field((-0.5, -thick, -half_z), (0.5, 3 * thick, half_z), evaluate, cut=(cut, False, cut), mean_to_max=parameters.mean_to_max)
