"""From a density defined over space to a tightly cropped grid."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepclouds.volume import Volume

# Below this share of the maximum a voxel is set to exactly zero, so that the crop is tight and files are sparse.
_FLOOR = 2e-3
# Resolution of the first pass, which only looks for the cloud's bounds.
_SCOUT = 56
# Grids coarser than this are averaged down from finer ones.
_FINE_ENOUGH = 48


@dataclass(frozen=True)
class Grid:
    """Sample positions as three axes: x (nx,), y (ny,), z (nz,), float32, and the spacing (3,) along them."""

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    z: NDArray[np.float32]
    spacing: NDArray[np.float64]

    @staticmethod
    def over(lower: NDArray[np.float64], upper: NDArray[np.float64], counts: NDArray[np.int64]) -> Grid:
        """Cell-centred samples of a box: `counts` along x, y and z."""
        spacing = (upper - lower) / counts
        x, y, z = ((low + (np.arange(n) + 0.5) * h).astype(np.float32) for low, n, h in zip(lower, counts, spacing, strict=True))
        return Grid(x, y, z, spacing)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape (nz, ny, nx) of an array over the grid."""
        return len(self.z), len(self.y), len(self.x)

    def open(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Positions that broadcast to the grid: x (1, 1, nx), y (1, ny, 1), z (nz, 1, 1)."""
        return self.x[None, None, :], self.y[None, :, None], self.z[:, None, None]


@dataclass(frozen=True)
class Field:
    """A density over space.

    Parameters
    ----------
    lower, upper
        corners (x, y, z) of a box that holds the cloud; units are the family's own, Y is up.
    evaluate
        density on a `Grid`: array (nz, ny, nx), not negative, any maximum; it draws no random numbers.
    cut
        for x, y and z: whether the cloud is meant to reach the faces of the box (no crop, no empty margin there).
    mean_to_max
        extinction-weighted mean density over its maximum to aim at by raising the density to a power; None leaves it as it is.
    fewest
        voxels that are not empty below which the field counts as empty.
    averaged
        whether coarse grids average over finer samples; False for bodies that are defined by the voxels themselves.
    """

    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    evaluate: Callable[[Grid], NDArray[np.float32]]
    cut: tuple[bool, bool, bool] = (False, False, False)
    mean_to_max: float | None = None
    fewest: int = 8
    averaged: bool = True


def weighted_mean(density: NDArray[np.float32]) -> float:
    """Extinction-weighted mean of the density over its maximum: 1 for a homogeneous body, 0.24 to 0.35 for smoke and simulated clouds."""
    flat = density.ravel().astype(np.float64)
    return float(np.dot(flat, flat) / flat.sum() / flat.max())


def rasterise(field: Field, resolution: int, voxel_aspect: float) -> Volume | None:
    """Sample a field on a tight grid whose most finely divided axis has `resolution` samples; None when the field is empty.

    The longest side of the box becomes 2 world units, centred on the origin; the largest density becomes 1. Axes that the field
    does not cut get one empty voxel on both sides. A first coarse pass finds the bounds; details finer than it that stick out are lost.
    """
    shape = np.array([1.0, voxel_aspect, 1.0])
    lower, upper = np.array(field.lower, np.float64), np.array(field.upper, np.float64)
    cut = np.array(field.cut)
    if not cut.all():
        # A body that is a number of voxels thick must not look thinner here than on the grid itself.
        finest = _SCOUT if field.averaged else min(_SCOUT, resolution)
        scout = Grid.over(lower, upper, _counts(upper - lower, np.ones(3), finest))
        density = _sharpen(field.evaluate(scout), field)
        if density is None:
            return None
        for axis in np.flatnonzero(~cut):
            inside = np.flatnonzero(density.any(axis=tuple(a for a in range(3) if a != 2 - axis)))
            h = scout.spacing[axis]
            upper[axis] = min(upper[axis], lower[axis] + (inside[-1] + 1.5) * h)
            lower[axis] = max(lower[axis], lower[axis] + (inside[0] - 0.5) * h)
    margin = np.where(cut, 0, 1)
    sides = (upper - lower) / shape
    h = float(np.max(sides / (resolution - 2 * margin)))
    counts = np.clip(np.rint(sides / h).astype(np.int64), 1, resolution - 2 * margin) + 2 * margin
    # Axes that are cut keep their exact extent; the others keep the voxel's shape and grow their margin by what rounding leaves.
    middle, half = (lower + upper) / 2, np.where(cut, (upper - lower) / 2, counts * h * shape / 2)
    # A coarse grid could step over thin layers and shreds: its voxels are averages over finer samples instead.
    finer = 1 if cut.all() or not field.averaged else -(-_FINE_ENOUGH // resolution)
    values = field.evaluate(Grid.over(middle - half, middle + half, counts * finer)).astype(np.float32)
    if finer > 1:
        nx, ny, nz = counts
        values = values.reshape(nz, finer, ny, finer, nx, finer).mean(axis=(1, 3, 5), dtype=np.float32)
    for axis in np.flatnonzero(~cut):
        faces = np.moveaxis(values, 2 - axis, 0)
        faces[0] = 0
        faces[-1] = 0
    density = _sharpen(values, field)
    if density is None:
        return None
    half = half / half.max()
    return Volume.from_box(density, -half, half)


def _counts(sides: NDArray[np.float64], shape: NDArray[np.float64], resolution: int) -> NDArray[np.int64]:
    cells = sides / shape
    counts: NDArray[np.int64] = np.maximum(np.rint(cells / cells.max() * resolution).astype(np.int64), 4)
    return counts


def _sharpen(values: NDArray[np.float32], field: Field) -> NDArray[np.float32] | None:
    """Scale the maximum to 1, raise to the power that meets the field's mean, drop what is below the floor; None for too little."""
    top = float(values.max(initial=0.0))
    if not np.isfinite(top) or top <= 0:
        return None
    density = np.asarray(values / np.float32(top), np.float32)
    if field.mean_to_max is not None:
        density = density ** np.float32(_power(density, field.mean_to_max))
    density[density < _FLOOR] = 0
    return density if np.count_nonzero(density) >= field.fewest else None


def _power(density: NDArray[np.float32], target: float) -> float:
    """Exponent between 1/4 and 4 that brings the extinction-weighted mean to `target`, or as low as it goes.

    The mean first falls as the exponent grows, then rises again when only the densest voxels are left: the first crossing counts.
    """
    count, edges = np.histogram(density[density > _FLOOR], bins=1024, range=(0.0, 1.0))
    value = (edges[:-1] + edges[1:]) / 2
    exponents = np.geomspace(0.25, 4.0, 97)
    powers = value ** exponents[:, None]
    means = (powers * powers) @ count / np.maximum(powers @ count, 1e-30)
    below = np.flatnonzero(means <= target)
    if len(below) == 0:
        return float(exponents[means.argmin()])
    k = below[0]
    if k == 0:
        return float(exponents[0])
    share = (means[k - 1] - target) / (means[k - 1] - means[k])
    return float(exponents[k - 1] + share * (exponents[k] - exponents[k - 1]))
