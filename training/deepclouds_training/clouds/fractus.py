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
    cover: float = number(0.15, 0.4, "share of the envelope that holds any cloud")
    mean_to_max: float = number(0.2, 0.4, "extinction-weighted mean density over the maximum")


def build(parameters: FractusParameters, streams: Streams) -> Field:
    """Density of torn shreds over space; the envelope is 1 wide across the wind."""
    eddies = [SmoothNoise.draw(streams(f"eddies {axis}")) for axis in "xyz"]
    shreds = WarpedNoise.draw(streams("shreds"), cells=6, octaves=4, gain=0.6)
    frayed = SmoothNoise.draw(streams("frayed"))
    length, height = parameters.length, parameters.height
    start = (streams("start").random(3) * 10).astype(np.float32)

    def evaluate(grid: Grid) -> Array:
        x, y, z = grid.open()
        swing = 0.2 * parameters.tearing
        dx, dy, dz = (np.float32(swing) * e.octaves(grid, parameters.shreds * 0.7, 6, 0.6) for e in eddies)
        # Wind draws the shreds out along x; shear tilts them.
        along = (x + dx) / np.float32(1.8) + np.float32(0.6) * y + start[0]
        up, across = (y + dy) * np.float32(1.2) + start[1], z + dz + start[2]
        lump = shreds.at(along, up, across, parameters.shreds)
        # Filaments lie where a second noise passes through zero.
        filament = 1 - np.abs(shreds.at(across, along, up, parameters.shreds * 1.3))
        fine = frayed.octaves(grid, parameters.shreds * 2.5, 5, 0.7, stretch=(1.8, 1, 1))
        value = lump + np.float32(0.8 * parameters.tearing) * filament + np.float32(0.35) * fine
        inside = (x / np.float32(0.5 * length)) ** 2 + (y / np.float32(0.5 * height)) ** 2 + (z / np.float32(0.5)) ** 2
        envelope = 1 - inside - dx / np.float32(0.5)
        value = value - np.float32(2.0) * np.maximum(np.float32(0.6) - envelope, 0)
        held = value[envelope > 0]
        threshold = float(np.quantile(held[::7], 1 - parameters.cover)) if len(held) > 50 else 0.0
        # A tail without a ceiling: a few dense cores among thin shreds.
        return np.asarray(
            smoothstep(threshold, threshold + 0.9, value) * np.exp(np.float32(1.2) * (value - np.float32(threshold))), np.float32
        )

    return Field(
        (-0.62 * length, -0.62 * height, -0.62), (0.62 * length, 0.62 * height, 0.62), evaluate, mean_to_max=parameters.mean_to_max
    )
