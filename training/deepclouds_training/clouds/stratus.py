"""Stratus: a layer, closed or broken, that may run on beyond the box."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deepclouds_training.clouds._noise import Array, CellNoise, SmoothNoise, smoothstep
from deepclouds_training.clouds._parameters import CloudParameters, Streams, choice, number
from deepclouds_training.clouds._raster import Field, Grid


@dataclass(frozen=True, kw_only=True)
class StratusParameters(CloudParameters):
    """Parameters of a stratus."""

    thickness: float = number(0.05, 0.22, "thickness of the layer over its width", log=True)
    depth: float = number(0.5, 1.0, "depth of the layer over its width")
    coverage: float = number(0.4, 1.0, "share of the sky that is covered", usual=1.0, usual_share=0.3)
    cells: float = number(2.5, 10.0, "convective cells or rolls across the width", log=True)
    waviness: float = number(0.1, 0.7, "how far the top rises and sinks, over the thickness")
    edges: str = choice(("cut", "faded"), "whether the sides of the box cut the layer or it thins out before them")
    mean_to_max: float = number(0.35, 0.7, "extinction-weighted mean density over the maximum")


def build(parameters: StratusParameters, streams: Streams) -> Field:
    """Density of a layer over space; it is 1 wide and its base lies at y = 0."""
    cells = CellNoise.draw(streams("cells"))
    smooth = SmoothNoise.draw(streams("smooth"))
    fine = SmoothNoise.draw(streams("fine"))
    thick, half_z = parameters.thickness, parameters.depth / 2
    cut = parameters.edges == "cut"

    def evaluate(grid: Grid) -> Array:
        x, y, z = grid.open()
        # One sheet of cells at a single height gives the layer's plan; the third dimension enters through the fine noise only.
        sheet = Grid(grid.x, np.zeros(1, np.float32), grid.z, grid.spacing)
        plan = 2.2 * cells.octaves(sheet, parameters.cells, 4, 0.6) - 1.2 + 0.35 * smooth.octaves(sheet, parameters.cells / 2, 6)
        if parameters.coverage < 1:
            fill = plan - np.float32(np.quantile(plan, 1 - parameters.coverage))
            body = smoothstep(-0.05, 0.45, fill)
        else:
            body = np.clip(0.75 + 0.35 * plan, 0.25, 1.2).astype(np.float32)
        if not cut:
            inset = (
                np.minimum(0.5 - np.abs(x), half_z - np.abs(z)) + np.float32(0.07) * smooth.octaves(sheet, 3.0, 6, 0.6) - np.float32(0.05)
            )
            body = body * smoothstep(0.0, 0.3, inset)
        noise = fine.octaves(grid, 0.7 / thick, 6, 0.6, stretch=(1.5, 1, 1.5))
        top = np.float32(thick) * (1 - parameters.waviness + parameters.waviness * body) * np.sqrt(np.clip(body, 0, 1))
        base = np.float32(0.12 * thick) * (1 - np.clip(body, 0, 1))
        inner = np.minimum(top - y, 2 * (y - base)) + np.float32(0.16 * thick) * noise * np.minimum(body * 4, 1)
        edge = smoothstep(0.0, 0.18 * thick, inner) * smoothstep(0.0, 0.15, body * np.ones_like(inner))
        # Liquid water grows from the base to just below the top.
        wetness = np.float32(0.3) + np.float32(0.7) * np.clip(y / np.float32(thick), 0, 1)
        return np.asarray(edge * wetness * np.exp(np.float32(0.25) * noise), np.float32)

    return Field(
        (-0.5, -0.4 * thick, -half_z), (0.5, 1.7 * thick, half_z), evaluate, cut=(cut, False, cut), mean_to_max=parameters.mean_to_max
    )
