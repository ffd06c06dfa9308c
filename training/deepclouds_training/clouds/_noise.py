"""Periodic noise, sampled on grids by separable interpolation: a matrix product an axis instead of a gather a voxel."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from deepclouds_training.clouds._raster import Grid

Array = NDArray[np.float32]
# Standard deviation of a cubic B-spline over unit white noise, averaged over the cell: (151 / 315) ** (3 / 2).
_SPLINE_DEVIATION = (151 / 315) ** 1.5


def _spline_weights(u: NDArray[np.float64], n: int) -> Array:
    """Rows of cubic B-spline weights (len(u), n) at positions u, in units of the lattice, periodic."""
    base = np.floor(u).astype(np.int64)
    f = u - base
    taps = ((1 - f) ** 3 / 6, (3 * f**3 - 6 * f**2 + 4) / 6, (-3 * f**3 + 3 * f**2 + 3 * f + 1) / 6, f**3 / 6)
    return _scatter([(base + k - 1, w) for k, w in enumerate(taps)], n)


def _linear_weights(u: NDArray[np.float64], n: int) -> Array:
    """Rows of linear interpolation weights (len(u), n) at positions u, in units of the lattice, periodic."""
    base = np.floor(u).astype(np.int64)
    return _scatter([(base, 1 - (u - base)), (base + 1, u - base)], n)


def _scatter(taps: list[tuple[NDArray[np.int64], NDArray[np.float64]]], n: int) -> Array:
    rows = np.arange(len(taps[0][0]))
    weights = np.zeros((len(rows), n), np.float32)
    for index, weight in taps:
        np.add.at(weights, (rows, index % n), weight.astype(np.float32))
    return weights


def _separable(lattice: Array, wx: Array, wy: Array, wz: Array) -> Array:
    """Interpolate a lattice (m, m, m) with weights along x, y, z: array (nz, ny, nx)."""
    # Along y first: sheets have a single row there.
    out = np.matmul(wy, lattice) @ wx.T
    return np.asarray((wz @ out.reshape(len(lattice), -1)).reshape(len(wz), len(wy), len(wx)), np.float32)


@dataclass(frozen=True)
class SmoothNoise:
    """Sum of octaves of B-spline noise (fractional Brownian motion), mean 0 and deviation about 1."""

    lattice: Array
    offsets: NDArray[np.float64]

    @staticmethod
    def draw(rng: np.random.Generator, size: int = 32) -> SmoothNoise:
        """Draw a lattice of `size` cells a side and the octaves' offsets."""
        lattice = rng.standard_normal((size, size, size)).astype(np.float32)
        return SmoothNoise(lattice / np.float32(_SPLINE_DEVIATION), rng.random((12, 3)) * size)

    def octaves(
        self, grid: Grid, frequency: float, octaves: int, gain: float = 0.5, stretch: tuple[float, float, float] = (1, 1, 1)
    ) -> Array:
        """Noise (nz, ny, nx) whose first octave has `frequency` cells a unit of length; `stretch` lengthens features along x, y, z.

        Octaves with cells below two samples are left out: they would alias.
        """
        total = np.zeros(grid.shape, np.float32)
        power = 0.0
        axes = (grid.x, grid.y, grid.z)
        for k in range(octaves):
            f = frequency * 2.0**k
            if k > 0 and f * float(np.min(grid.spacing / np.array(stretch))) > 0.6:
                break
            w = [_spline_weights(axes[a].astype(np.float64) * f / stretch[a] + self.offsets[k, a], len(self.lattice)) for a in range(3)]
            total += np.float32(gain**k) * _separable(self.lattice, *w)
            power += gain ** (2 * k)
        return total / np.float32(np.sqrt(power))


@dataclass(frozen=True)
class CellNoise:
    """Distance to the nearest of jittered points (Worley 1996), in units of a cell, sampled from a periodic texture of 8 cells a side."""

    texture: Array
    offsets: NDArray[np.float64]
    cells: int = 8

    @staticmethod
    def draw(rng: np.random.Generator) -> CellNoise:
        """Draw the points and tabulate the distance at 8 samples a cell."""
        cells, per_cell = 8, 8
        points = rng.random((cells, cells, cells, 3)).astype(np.float32)
        local = ((np.arange(per_cell) + 0.5) / per_cell).astype(np.float32)
        nearest = np.full((cells, per_cell, cells, per_cell, cells, per_cell), 9.0, np.float32)
        for shift in itertools.product((-1, 0, 1), repeat=3):
            there = np.roll(points, tuple(-s for s in shift), axis=(0, 1, 2)) + np.array(shift, np.float32)
            dz = (there[:, :, :, 0, None] - local) ** 2
            dy = (there[:, :, :, 1, None] - local) ** 2
            dx = (there[:, :, :, 2, None] - local) ** 2
            squared = (
                dz.transpose(0, 3, 1, 2)[:, :, :, None, :, None]
                + dy.transpose(0, 1, 3, 2)[:, None, :, :, :, None]
                + dx[:, None, :, None, :, :]
            )
            np.minimum(nearest, squared, out=nearest)
        side = cells * per_cell
        return CellNoise(np.sqrt(nearest).reshape(side, side, side), rng.random((12, 3)) * cells)

    def octaves(self, grid: Grid, frequency: float, octaves: int, gain: float = 0.5) -> Array:
        """Billows (nz, ny, nx): 1 minus the distance, summed over octaves from `frequency` cells a unit of length; roughly 0 to 1."""
        total = np.zeros(grid.shape, np.float32)
        weight = 0.0
        per_cell = len(self.texture) / self.cells
        for k in range(octaves):
            f = frequency * 2.0**k
            if k > 0 and f * float(grid.spacing.min()) > 0.4:
                break
            w = [
                _linear_weights((axis.astype(np.float64) * f + self.offsets[k, a]) * per_cell - 0.5, len(self.texture))
                for a, axis in enumerate((grid.x, grid.y, grid.z))
            ]
            total += np.float32(gain**k) * (1 - _separable(self.texture, *w))
            weight += gain**k
        return total / np.float32(weight)


@dataclass(frozen=True)
class CellSheet:
    """Cells in a plane around jittered points (Worley 1996), without a period; 1 unit of length holds `frequency` of them."""

    tree: cKDTree
    frequency: float

    @staticmethod
    def draw(rng: np.random.Generator, frequency: float, jitter: float = 1.0, reach: float = 0.9) -> CellSheet:
        """Draw the points of the square from -`reach` to `reach`: one a cell, moved from its middle by at most half of `jitter`."""
        n = int(np.ceil(reach * frequency)) + 2
        lattice = np.stack(np.meshgrid(np.arange(-n, n), np.arange(-n, n), indexing="ij"), axis=-1).reshape(-1, 2)
        # Every second row is shifted by half a cell: convection prefers hexagons to squares.
        points = lattice + 0.5 + jitter * (rng.random(lattice.shape) - 0.5)
        points[:, 0] += 0.5 * (lattice[:, 1] % 2)
        return CellSheet(cKDTree(points), frequency)

    def _distances(self, x: Array, z: Array, count: int) -> NDArray[np.float64]:
        at = np.stack(np.broadcast_arrays(x, z), axis=-1).astype(np.float64) * self.frequency
        return np.asarray(self.tree.query(at, k=count)[0])

    def nearest(self, x: Array, z: Array) -> Array:
        """Distance to the nearest point in units of a cell, at positions x, z that broadcast."""
        return np.asarray(self._distances(x, z, 1), np.float32)

    def wall(self, x: Array, z: Array) -> Array:
        """Distance from the walls between cells, with mean about 0 and deviation about 1: about -1.3 on a wall."""
        near = self._distances(x, z, 2)
        return np.asarray((near[..., 1] - near[..., 0] - 0.33) / 0.25, np.float32)


@dataclass(frozen=True)
class WarpedNoise:
    """Fractional Brownian motion tabulated on a periodic texture, for positions that are not on a grid."""

    texture: Array
    cells: int

    @staticmethod
    def draw(rng: np.random.Generator, cells: int = 8, octaves: int = 4, gain: float = 0.55, samples: int = 96) -> WarpedNoise:
        """Tabulate `octaves` octaves of B-spline noise, the first of `cells` cells a period; mean 0, deviation about 1."""
        u = np.arange(samples) / samples
        texture = np.zeros((samples, samples, samples), np.float32)
        for k in range(octaves):
            n = cells * 2**k
            lattice = rng.standard_normal((n, n, n)).astype(np.float32)
            w = _spline_weights(u * n, n)
            texture += np.float32(gain**k) * _separable(lattice, w, w, w)
        return WarpedNoise((texture - texture.mean()) / texture.std(), cells)

    def at(self, x: Array, y: Array, z: Array, frequency: float) -> Array:
        """Noise at positions x, y, z (arrays of one shape), `frequency` first-octave cells a unit of length."""
        scale = np.float32(frequency * len(self.texture) / self.cells)
        positions = np.stack([z, y, x]) * scale
        return np.asarray(map_coordinates(self.texture, positions, order=1, mode="grid-wrap"), np.float32)


def smoothstep(low: float, high: float, value: Array) -> Array:
    """0 below `low`, 1 above `high`, a smooth cubic between."""
    t = np.clip((value - np.float32(low)) * np.float32(1 / (high - low)), 0, 1)
    return np.asarray(t * t * (3 - 2 * t), np.float32)
