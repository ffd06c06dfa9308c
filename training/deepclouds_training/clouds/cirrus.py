"""Cirrus: ice that falls out of small cells and is drawn by the shear of the wind into long fibres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates

from deepclouds_training.clouds._noise import Array, SmoothNoise, smoothstep
from deepclouds_training.clouds._parameters import CloudParameters, Streams, number
from deepclouds_training.clouds._raster import Field, Grid

_SAMPLES = 768


@dataclass(frozen=True, kw_only=True)
class CirrusParameters(CloudParameters):
    """Parameters of a cirrus."""

    depth: float = number(0.4, 1.0, "extent across the wind over that along it")
    fall: float = number(0.1, 0.3, "how deep the ice falls, over the extent along the wind", log=True)
    trail: float = number(0.3, 0.8, "how far the shear draws a fibre out, over the extent along the wind")
    hook: float = number(1.0, 2.2, "shape of a fibre: 1 is straight, 2 a parabola that hooks at its head")
    fibres: float = number(6.0, 20.0, "bundles of fibres across the wind", log=True)
    cover: float = number(0.15, 0.6, "share of the generating level that holds cells")
    tangle: float = number(0.0, 1.0, "how far eddies bend the fibres")
    mean_to_max: float = number(0.3, 0.6, "extinction-weighted mean density over the maximum")


def build(parameters: CirrusParameters, streams: Streams) -> Field:
    """Density of fall streaks over space; the cloud is 1 long along the wind (x) and its generating level lies at y = 0."""
    bundles, threads = SmoothNoise.draw(streams("bundles")), SmoothNoise.draw(streams("threads"))
    lengths, ragged = SmoothNoise.draw(streams("lengths")), SmoothNoise.draw(streams("ragged"))
    eddies = [SmoothNoise.draw(streams(f"eddies {axis}")) for axis in "xyz"]
    fall, half_z = parameters.fall, parameters.depth / 2
    # The pattern of cells on the generating level, tabulated: u along the wind, v across it.
    span = np.array([1.2, 1.0, 1.2 * parameters.depth])
    u, v = (((np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5).astype(np.float32) * np.float32(side) for side in span[[0, 2]])
    level = Grid(u, np.zeros(1, np.float32), v, span / _SAMPLES)
    value = np.float32(0.7) * bundles.octaves(level, parameters.fibres / 2, 4, 0.7, stretch=(2.5, 1, 1))
    value += threads.octaves(level, 2 * parameters.fibres, 5, 0.85, stretch=(5.0, 1, 1))
    # Cells become rare toward the outline, so that the cloud ends in single fibres instead of a fringe.
    outline = np.maximum((u[None, None, :] / np.float32(0.5)) ** 2, (v[:, None, None] / np.float32(half_z)) ** 2)
    value -= np.float32(3) * np.maximum(outline + np.float32(0.3) * ragged.octaves(level, 3.0, 5, 0.6) - np.float32(0.35), 0)
    value = value[:, 0, :]
    threshold = float(np.quantile(value, 1 - parameters.cover))
    cells = (smoothstep(threshold, threshold + 1.5, value) * np.exp(np.float32(0.3) * value)).astype(np.float32)
    reach = np.clip(0.6 + 0.25 * lengths.octaves(level, 4.0, 6, 0.8, stretch=(2.0, 1, 1))[:, 0, :], 0.12, 1.0).astype(np.float32)

    def evaluate(grid: Grid) -> Array:
        x, y, z = grid.open()
        swing = np.float32(0.025 * parameters.tangle)
        dx, dy, dz = (swing * e.octaves(grid, 3.0, 4, 0.5, stretch=(1.5, 0.5, 1)) for e in eddies)
        fallen = np.clip((-y - np.float32(0.3) * dy) / np.float32(fall), -0.2, 1)
        away = np.float32(parameters.trail) * np.maximum(fallen, 0) ** np.float32(parameters.hook)
        # Fibres fan out a little as they fall.
        across = (z + dz) * (1 - np.float32(0.15) * np.maximum(fallen, 0))
        at_u = ((x + dx + away) / np.float32(span[0]) + np.float32(0.5)) * np.float32(_SAMPLES) - np.float32(0.5)
        at_v = (across / np.float32(span[2]) + np.float32(0.5)) * np.float32(_SAMPLES) - np.float32(0.5)
        places = np.stack(np.broadcast_arrays(at_v, at_u))
        ice = map_coordinates(cells, places, order=1, mode="constant")
        length = map_coordinates(reach, places, order=1, mode="nearest")
        # Ice grows below its cell and sublimates toward the end of the fibre.
        life = smoothstep(-0.15, 0.1, fallen * np.ones_like(ice)) * smoothstep(0.0, 0.7, 1 - fallen / length)
        return np.asarray(ice * life, np.float32)

    lower, upper = (-0.55 - parameters.trail, -1.1 * fall, -0.75 * parameters.depth), (0.6, 0.25 * fall, 0.75 * parameters.depth)
    return Field(lower, upper, evaluate, mean_to_max=parameters.mean_to_max)
