"""Fractus: shreds of cloud torn by the wind."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deepclouds_training.clouds._noise import Array, SmoothNoise, WarpedNoise, smoothstep
from deepclouds_training.clouds._parameters import CloudParameters, Streams, number
from deepclouds_training.clouds._raster import Field, Grid


@dataclass(frozen=True, kw_only=True)
class FractusParameters(CloudParameters):
    """Parameters of a fractus."""

    length: float = number(1.0, 2.5, "length along the wind over the width across it")
    height: float = number(0.3, 0.8, "height over the width across the wind")
    shreds: float = number(2.0, 5.0, "shreds across the cloud")
    tearing: float = number(0.3, 1.0, "how strongly eddies tear the shreds into filaments")
    cover: float = number(0.25, 0.55, "share of the envelope that holds any cloud")
    mean_to_max: float = number(0.2, 0.4, "extinction-weighted mean density over the maximum")


def build(parameters: FractusParameters, streams: Streams) -> Field:
    """Density of torn shreds over space; the envelope is 1 wide across the wind."""
    eddies = [SmoothNoise.draw(streams(f"eddies {axis}")) for axis in "xyz"]
    shreds = WarpedNoise.draw(streams("shreds"), cells=6, octaves=4, gain=0.6)
    length, height = parameters.length, parameters.height
    start = streams("start").random(3) * 10

    def evaluate(grid: Grid) -> Array:
        x, y, z = grid.open()
        swing = 0.22 * parameters.tearing
        dx, dy, dz = (np.float32(swing) * e.octaves(grid, parameters.shreds * 0.6, 5, 0.55) for e in eddies)
        # Wind stretches shreds along x; shear tilts them.
        value = shreds.at(
            (x + dx) / np.float32(1.7) + np.float32(0.5) * y + np.float32(start[0]),
            (y + dy) * np.float32(1.2) + np.float32(start[1]),
            z + dz + np.float32(start[2]),
            parameters.shreds,
        )
        inside = (x / np.float32(0.5 * length)) ** 2 + (y / np.float32(0.5 * height)) ** 2 + (z / np.float32(0.5)) ** 2
        envelope = 1 - inside - dx / np.float32(0.5)
        value = value - 2.2 * np.maximum(0.55 - envelope, 0)
        held = value[envelope > 0]
        threshold = float(np.quantile(held[::7], 1 - parameters.cover)) if len(held) > 50 else 0.0
        return smoothstep(threshold, threshold + 2.2, value) ** np.float32(1.3)

    return Field(
        (-0.62 * length, -0.62 * height, -0.62), (0.62 * length, 0.62 * height, 0.62), evaluate, mean_to_max=parameters.mean_to_max
    )
