"""The layer cloud that the decks share: a plan of column optical depths, turned into a layer that is thick where the column is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deepclouds_training.clouds._noise import Array, SmoothNoise, smoothstep
from deepclouds_training.clouds._parameters import CloudParameters, choice, number
from deepclouds_training.clouds._parcel import condensation
from deepclouds_training.clouds._raster import Grid

# Gain of an octave that gives power spectra falling as the wave number to the power -5/3: 2 ** (-1/3).
KOLMOGOROV = 2 ** (-1 / 3)


@dataclass(frozen=True, kw_only=True)
class LayerParameters(CloudParameters):
    """The outline of a layer, which is 1 wide."""

    depth: float = number(0.5, 1.0, "depth of the layer over its width")
    edges: str = choice(("cut", "faded"), "whether the sides of the box cut the layer or it thins out before them")


def sheet(grid: Grid) -> Grid:
    """The plan of a grid: its x and z at the single height 0."""
    return Grid(grid.x, np.zeros(1, np.float32), grid.z, grid.spacing)


def covered(log_column: Array, coverage: float) -> Array:
    """Column optical depth from its logarithm, such that a share `coverage` of the plan is not empty."""
    column = np.exp(log_column)
    if coverage >= 1:
        return column
    # Real decks end within a short distance: the column rises over less than half of the logarithm's deviation.
    rise = (log_column - np.quantile(log_column, 1 - coverage)) / (0.4 * log_column.std() + 1e-12)
    return np.asarray(column * np.clip(rise, 0, 1), np.float32)


def fade(grid: Grid, depth: float, ragged: SmoothNoise) -> Array:
    """Factor (nz, 1, nx) that thins a layer out before the sides of its box, along a ragged line."""
    x, _, z = grid.open()
    side = np.minimum(0.5 - np.abs(x), depth / 2 - np.abs(z))
    inset = side + np.float32(0.09) * ragged.octaves(sheet(grid), 2.5, 6, 0.6) - np.float32(0.09)
    # However ragged, the layer ends before the sides.
    return smoothstep(0.0, 0.12, np.minimum(inset, 2 * side))


def layer(grid: Grid, column: Array, thickness: float, noise: Array, foot: float, sag: float, roughness: float = 0.12) -> Array:
    """Density of a layer.

    Parameters
    ----------
    column
        relative optical depth (nz, 1, nx) of the columns, 0 where there is no cloud; `thickness` is that of a column of 1.
    noise
        fractal noise (nz, ny, nx), deviation about 1, that roughens top and base by `roughness` times the local thickness.
    foot
        extinction at the base over that `thickness` above it.
    sag
        share of the local thickness that hangs below y = 0; 0 for a flat base.
    """
    # Extinction that grows as the power 2/3 of height sums up to the power 5/3 of the thickness.
    local = np.asarray(np.float32(thickness) * column ** np.float32(0.6), np.float32)
    above = grid.open()[1] + np.float32(sag) * local + np.float32(roughness) * noise * local
    inner = np.minimum(above, local - above)
    edge = smoothstep(0.0, 0.15 * thickness, inner)
    wet = condensation(np.asarray(above / np.float32(1.5 * thickness), np.float32), foot)
    return np.asarray(edge * wet * np.exp(np.float32(0.2) * noise), np.float32)
