"""Stratocumulus: a deck of closed cells with gaps between them, of open cells, or of rolls."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deepclouds_training.clouds._layer import KOLMOGOROV, LayerParameters, covered, fade, layer, sheet
from deepclouds_training.clouds._noise import Array, CellSheet, SmoothNoise
from deepclouds_training.clouds._parameters import Streams, choice, number
from deepclouds_training.clouds._raster import Field, Grid


@dataclass(frozen=True, kw_only=True)
class StratocumulusParameters(LayerParameters):
    """Parameters of a stratocumulus."""

    pattern: str = choice(("closed", "open"), "cells that are cloudy in the middle, or along their walls")
    thickness: float = number(0.03, 0.1, "thickness of a column of mean optical depth over the width of the deck", log=True)
    coverage: float = number(0.6, 1.0, "share of the sky that is covered", usual=1.0, usual_share=0.25)
    cells: float = number(3.0, 14.0, "cells across the width", log=True)
    rolls: float = number(1.0, 4.0, "length of a cell over its width", log=True, usual=1.0, usual_share=0.5)
    variability: float = number(0.35, 0.8, "deviation of the logarithm of a column's optical depth")


def build(parameters: StratocumulusParameters, streams: Streams) -> Field:
    """Density of a deck over space; it is 1 wide and hangs from an inversion above y = 0."""
    cells = CellSheet.draw(streams("cells"), parameters.cells)
    swells = SmoothNoise.draw(streams("swells"))
    warps = [SmoothNoise.draw(streams(f"warp {axis}")) for axis in "xz"]
    fine = SmoothNoise.draw(streams("fine"))
    ragged = SmoothNoise.draw(streams("ragged"))
    thick, half_z = parameters.thickness, parameters.depth / 2
    cut = parameters.edges == "cut"
    sign = np.float32(1 if parameters.pattern == "closed" else -1)

    def evaluate(grid: Grid) -> Array:
        plane = sheet(grid)
        x, _, z = grid.open()
        bend = 0.35 / parameters.cells
        wx, wz = (np.float32(bend) * w.octaves(plane, parameters.cells, 5, 0.55) for w in warps)
        wall = cells.wall(np.asarray((x + wx) / np.float32(parameters.rolls), np.float32), z + wz)
        plan = np.float32(0.75) * sign * wall + np.float32(0.66) * swells.octaves(plane, 2.0, 9, KOLMOGOROV)
        column = covered(np.float32(parameters.variability) * plan, parameters.coverage)
        if not cut:
            column = column * fade(grid, parameters.depth, ragged)
        noise = fine.octaves(grid, 0.7 / thick, 5, 0.62, stretch=(1.5, 1, 1.5))
        return layer(grid, column, thick, noise, foot=0.1, sag=0.4)

    return Field((-0.5, -2 * thick, -half_z), (0.5, 3 * thick, half_z), evaluate, cut=(cut, False, cut))
