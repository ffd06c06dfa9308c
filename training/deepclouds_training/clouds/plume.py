"""Plume: buoyant smoke that rises, entrains air and rolls up into swirls."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deepclouds_training.clouds._noise import Array, SmoothNoise, WarpedNoise, smoothstep
from deepclouds_training.clouds._parameters import CloudParameters, Streams, number
from deepclouds_training.clouds._raster import Field, Grid


@dataclass(frozen=True, kw_only=True)
class PlumeParameters(CloudParameters):
    """Parameters of a plume."""

    height: float = number(1.6, 3.0, "height over the width of the head")
    spread: float = number(0.12, 0.25, "growth of the radius with height (entrainment)")
    rings: int = number(3, 6, "vortex rings along the stem", integer=True)
    swirl: float = number(1.0, 3.0, "turn of the rolls at their centre, in radians")
    turbulence: float = number(0.4, 1.0, "strength of the eddies that fold the surface")
    wind: float = number(0.0, 0.35, "how far the head drifts, over the height")
    mean_to_max: float = number(0.24, 0.35, "extinction-weighted mean density over the maximum")


def build(parameters: PlumeParameters, streams: Streams) -> Field:
    """Density of a plume over space; the source lies at the origin."""
    rng = streams("rings")
    eddies = [SmoothNoise.draw(streams(f"eddies {axis}")) for axis in "xyz"]
    smoke = WarpedNoise.draw(streams("smoke"), cells=6, octaves=4, gain=0.62)
    height, spread = parameters.height, parameters.spread
    source = 0.1
    heights = height * (np.linspace(0.25, 0.88, parameters.rings) + rng.uniform(-0.04, 0.04, parameters.rings))
    turns = parameters.swirl * rng.uniform(0.7, 1.2, parameters.rings)
    phase = rng.uniform(0, 2 * np.pi, 2)
    head = source + spread * height

    def evaluate(grid: Grid) -> Array:
        x, y, z = grid.open()
        width = np.float32(source) + np.float32(spread) * np.maximum(y, 0)
        strength = np.float32(0.55 * parameters.turbulence) * width
        dx, dy, dz = (strength * e.octaves(grid, 1.1 / head, 5, 0.55) for e in eddies)
        t = y / np.float32(height)
        middle_x = np.float32(parameters.wind * height) * t**2 + np.float32(0.5) * width * np.sin(np.float32(5) * t + np.float32(phase[0]))
        middle_z = np.float32(0.5) * width * np.sin(np.float32(4) * t + np.float32(phase[1]))
        across, along = x + dx - middle_x, z + dz - middle_z
        out = np.sqrt(across**2 + along**2)
        up = y + dy
        for y0, turn in zip(heights, turns, strict=True):
            # A vortex ring turns the meridional plane about its core: air rises inside and comes down outside.
            core = 0.75 * (source + spread * y0)
            a, b = out - np.float32(core), up - np.float32(y0)
            angle = np.float32(turn) * np.exp(-(a**2 + b**2) / np.float32((0.9 * core) ** 2))
            c, s = np.cos(angle), np.sin(angle)
            out, up = np.float32(core) + a * c - b * s, np.float32(y0) + a * s + b * c
        radius = np.float32(source) + np.float32(spread) * np.clip(up, 0, height)
        # Puffs: the source pulsates, so the stem swells where each ring sits.
        pulse = np.float32(2 * np.pi * (len(heights) - 1) / (0.63 * height))
        radius = radius * (1 + np.float32(0.16) * np.cos((up - np.float32(heights[0])) * pulse))
        side = np.abs(out) / radius
        lid = (np.float32(height) - up) / np.float32(head)
        body = smoothstep(0.0, 0.9, np.minimum(1.35 - side, np.minimum(lid, up / np.float32(source) + 1)))
        noise = smoke.at(across, up, along, 1.4 / head)
        # Mixing dilutes the smoke as it rises.
        thinning = (np.float32(source + 0.25 * head) / (radius + np.float32(0.25 * head))) ** np.float32(0.8)
        return np.asarray(body * thinning * np.exp(np.float32(0.75) * noise), np.float32)

    reach = 1.9 * head
    drift = parameters.wind * height
    return Field((-reach, -source, -reach), (reach + drift, height + 0.6 * head, reach), evaluate, mean_to_max=parameters.mean_to_max)
