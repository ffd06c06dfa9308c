"""Altocumulus: a thin sheet of many small rounded elements, in patches and often in rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deepclouds_training.clouds._layer import LayerParameters, fade, layer, sheet
from deepclouds_training.clouds._noise import Array, CellSheet, SmoothNoise
from deepclouds_training.clouds._parameters import Streams, number
from deepclouds_training.clouds._raster import Field, Grid


@dataclass(frozen=True, kw_only=True)
class AltocumulusParameters(LayerParameters):
    """Parameters of an altocumulus."""

    elements: float = number(7.0, 20.0, "elements across the width", log=True)
    thickness: float = number(0.2, 0.6, "thickness of an element over its width")
    coverage: float = number(0.25, 0.75, "share of the sky that is covered, before the edges fade")
    rows: float = number(0.0, 1.0, "how strongly waves arrange the elements in rows", usual=0.0, usual_share=0.3)
    patchiness: float = number(0.0, 1.0, "how unevenly the elements cover the sky")


def build(parameters: AltocumulusParameters, streams: Streams) -> Field:
    """Density of a sheet of small elements over space; it is 1 wide and centred near y = 0."""
    rng = streams("rows")
    elements = CellSheet.draw(streams("elements"), parameters.elements, jitter=0.8)
    patches = SmoothNoise.draw(streams("patches"))
    warps = [SmoothNoise.draw(streams(f"warp {axis}")) for axis in "xz"]
    fine = SmoothNoise.draw(streams("fine"))
    ragged = SmoothNoise.draw(streams("ragged"))
    thick = parameters.thickness / parameters.elements
    half_z = parameters.depth / 2
    cut = parameters.edges == "cut"
    heading, start = rng.uniform(0, np.pi), rng.uniform(0, 2 * np.pi)

    def evaluate(grid: Grid) -> Array:
        plane = sheet(grid)
        x, _, z = grid.open()
        bend = np.float32(0.12 / parameters.elements)
        wx, wz = (bend * w.octaves(plane, 1.5 * parameters.elements, 4, 0.6) for w in warps)
        fill = np.float32(1.2) - np.float32(1.6) * elements.nearest(x + wx, z + wz)
        # Gravity waves lift the air in bands two elements apart; they bend slowly.
        along = np.float32(np.cos(heading)) * x + np.float32(np.sin(heading)) * z + np.float32(0.05) * patches.octaves(plane, 1.2, 2)
        wave = np.sin(np.float32(np.pi * parameters.elements) * along + np.float32(start))
        fill = fill + np.float32(0.45 * parameters.rows) * wave
        fill = fill + np.float32(0.45 * parameters.patchiness) * patches.octaves(plane, 2.0, 3, 0.6)
        column = np.maximum(fill - np.quantile(fill, 1 - parameters.coverage), 0).astype(np.float32) * np.float32(2.2)
        if not cut:
            column = column * fade(grid, parameters.depth, ragged)
        noise = fine.octaves(grid, 1.2 / thick, 4, 0.6)
        return layer(grid, column, thick, noise, foot=0.4, sag=0.35)

    return Field((-0.5, -2 * thick, -half_z), (0.5, 3 * thick, half_z), evaluate, cut=(cut, False, cut))
