"""A density field on a regular grid, as every other part of deepclouds sees it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepclouds.errors import InputError


@dataclass(frozen=True)
class Volume:
    """Cell-centred density inside a box: trilinear within, zero outside, a hard cut at the box.

    Sample ``(k, j, i)`` sits at ``((i + 0.5) / nx, (j + 0.5) / ny, (k + 0.5) / nz)`` of the unit cube; between the outermost
    samples and the faces of the box the field is constant, as in Mitsuba's ``gridvolume`` with ``wrap_mode = clamp``.

    Parameters
    ----------
    density
        float32 array (nz, ny, nx), finite and not negative, at least one sample along each axis.
    to_world
        float64 array (4, 4), affine: unit cube to world space (the ``to_world`` of Mitsuba's ``gridvolume``).

    Raises
    ------
    InputError
        when the array is not three-dimensional, holds NaN, Inf or negative values, or the transform is not an invertible affine map.
    """

    density: NDArray[np.float32]
    to_world: NDArray[np.float64]

    def __post_init__(self) -> None:
        density = np.ascontiguousarray(self.density, dtype=np.float32)
        if density.ndim != 3 or density.size == 0:
            raise InputError(f"a density grid needs three axes (z, y, x) and at least one sample, got shape {density.shape}")
        density, to_world = checked(density, self.to_world)
        object.__setattr__(self, "density", density)
        object.__setattr__(self, "to_world", to_world)

    @staticmethod
    def from_box(density: ArrayLike, lower: ArrayLike, upper: ArrayLike) -> Volume:
        """Place a (nz, ny, nx) grid in the axis-aligned world box from `lower` to `upper` (x, y, z; world units)."""
        lower, upper = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
        to_world = np.diag(np.append(upper - lower, 1.0))
        to_world[:3, 3] = lower
        return Volume(np.asarray(density, np.float32), to_world)

    @property
    def resolution(self) -> tuple[int, int, int]:
        """Number of samples along x, y and z."""
        nz, ny, nx = self.density.shape
        return nx, ny, nz

    @property
    def stored(self) -> NDArray[np.float32]:
        """Every sample that may differ from 0, as an array of three axes in any order."""
        return self.density

    def sums(self, axis: int | tuple[int, int]) -> NDArray[np.float64]:
        """Sums of the density along an axis, or two in growing order (0 is z), float64."""
        total: NDArray[np.float64] = self.density.sum(axis=axis, dtype=np.float64)
        return total

    def row_ends(self, above: float | np.float32) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """The rows along x with a sample larger than `above`: (z, y) of each (m, 2), and its first and last such sample (m,)."""
        filled = self.density > above
        rows = np.argwhere(filled.any(axis=2))
        first = filled.argmax(axis=2)[tuple(rows.T)]
        last = filled.shape[2] - 1 - filled[:, :, ::-1].argmax(axis=2)[tuple(rows.T)]
        return rows, first, last

    @property
    def voxel_size(self) -> NDArray[np.float64]:
        """Edge lengths of a voxel along the grid's own x, y and z axes, in world units."""
        edges: NDArray[np.float64] = np.linalg.norm(self.to_world[:3, :3], axis=0) / np.array(self.resolution)
        return edges

    @property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower and upper corner of the world-aligned box around the grid's box."""
        corners = np.array([[x, y, z, 1.0] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) @ self.to_world.T
        return corners[:, :3].min(axis=0), corners[:, :3].max(axis=0)

    def sample(self, points: ArrayLike) -> NDArray[np.float64]:
        """Density at world `points` (n, 3): the readable twin of the lookup inside every kernel. Returns (n,)."""
        points = np.asarray(points, np.float64)
        unit = (points - self.to_world[:3, 3]) @ np.linalg.inv(self.to_world[:3, :3]).T
        inside = np.all((unit >= 0) & (unit <= 1), axis=1)
        n = np.array(self.resolution)
        cell = np.clip(unit * n - 0.5, 0, n - 1)
        low = np.minimum(np.floor(cell).astype(np.int64), np.maximum(n - 2, 0))
        frac = cell - low
        value = np.zeros(len(points))
        for corner in np.ndindex(2, 2, 2):
            index = np.minimum(low + corner, n - 1)
            weight = np.prod(np.where(np.array(corner) == 1, frac, 1 - frac), axis=1)
            value += weight * self._at(index[:, 2], index[:, 1], index[:, 0])
        return np.where(inside, value, 0.0)

    def _at(self, z: NDArray[np.int64], y: NDArray[np.int64], x: NDArray[np.int64]) -> NDArray[np.float32]:
        found: NDArray[np.float32] = self.density[z, y, x]
        return found


def checked(samples: NDArray[np.float32], to_world: ArrayLike) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """The samples of a density grid and its place, both read-only; raises InputError for what no `Volume` may hold."""
    matrix = np.array(to_world, dtype=np.float64)
    bad = int(np.count_nonzero(~np.isfinite(samples)))
    if bad:
        raise InputError(f"the density grid holds {bad} NaN or infinite values; clean the grid or clamp it on reading")
    negative = int(np.count_nonzero(samples < 0))
    if negative:
        raise InputError(f"the density grid holds {negative} negative values; clean the grid or clamp it on reading")
    if matrix.shape != (4, 4) or not np.all(np.isfinite(matrix)) or not np.allclose(matrix[3], (0, 0, 0, 1)):
        raise InputError("to_world must be a finite affine 4 x 4 matrix")
    size = np.linalg.norm(matrix[:3, :3], axis=0)
    if np.any(size == 0) or abs(np.linalg.det(matrix[:3, :3] / size)) < 1e-6:
        raise InputError("to_world is not invertible: the grid's box has no volume")
    samples.flags.writeable = False
    matrix.flags.writeable = False
    return samples, matrix
