"""A single-scattering albedo that varies in space, one value a colour channel, on the host and on the device."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepclouds.errors import InputError
from deepclouds.medium.field import Field
from deepclouds.medium.grid import DenseGrid, trilinear


@dataclass(frozen=True)
class AlbedoGrid:
    """Albedo between the centres of a grid's cells trilinear, beyond them as at the nearest one.

    Attributes
    ----------
    values
        (nz, ny, nx, channels) float32, in 0 to 1.
    to_world
        4 x 4 affine map from the unit cube of the grid's box to the world.

    Raises
    ------
    InputError
        for values outside of 0 to 1, or not finite.
    """

    values: NDArray[np.float32]
    to_world: NDArray[np.float64]

    def __post_init__(self) -> None:
        outside = int(np.count_nonzero(~((self.values >= 0) & (self.values <= 1))))
        if outside:
            raise InputError(f"the albedo's grid holds {outside} values outside of 0 to 1; clamp them, or divide by the largest one")

    @property
    def largest(self) -> tuple[float, ...]:
        """The largest value of each channel."""
        return tuple(float(v) for v in self.values.max(axis=(0, 1, 2)))

    def sample(self, points: ArrayLike) -> NDArray[np.float64]:
        """Albedo (n, channels) at world points (n, 3): the readable twin of the lookup in every kernel."""
        points = np.asarray(points, np.float64)
        unit = (points - self.to_world[:3, 3]) @ np.linalg.inv(self.to_world[:3, :3]).T
        n = np.array(self.values.shape[2::-1])
        cell = np.clip(unit * n - 0.5, 0, n - 1)
        low = np.minimum(np.floor(cell).astype(np.int64), np.maximum(n - 2, 0))
        total = np.zeros((len(points), self.values.shape[3]))
        for corner in np.ndindex(2, 2, 2):
            x, y, z = np.minimum(low + corner, n - 1).T
            weight = np.prod(np.where(np.array(corner) == 1, cell - low, 1 - (cell - low)), axis=1)
            total += weight[:, None] * self.values[z, y, x]
        return total


class AlbedoField:
    """An `AlbedoGrid` on the device.

    Parameters
    ----------
    field
        extinction in whose unit cube points are given.
    grid
        the albedo.

    Attributes
    ----------
    channels
        number of colour channels.
    nbytes
        of the values.
    """

    def __init__(self, field: Field, grid: AlbedoGrid) -> None:
        types = field.types
        self._types, self._field = types, field
        # One sample along an axis would leave no pair to interpolate between: repeat it.
        values = np.pad(grid.values, [(0, 1 if n == 1 else 0) for n in grid.values.shape[:3]] + [(0, 0)], mode="edge")
        self.channels = values.shape[3]
        self._grids = [DenseGrid(types, np.ascontiguousarray(values[..., c], np.float32)) for c in range(self.channels)]
        self.nbytes = sum(g.nbytes for g in self._grids)
        size = np.array(grid.values.shape[2::-1], np.float64)
        # From the unit cube of the extinction to samples of this grid.
        across = np.linalg.inv(grid.to_world) @ field.volume.to_world
        matrix = across[:3] * size[:, None]
        matrix[:, 3] -= 0.5
        self._to_samples = [[dr.opaque(types.Float, float(v)) for v in row] for row in matrix]
        self._top = [dr.opaque(types.Float, float(n - 1)) for n in size]
        self._last = [dr.opaque(types.Float, float(max(n - 2, 0))) for n in size]

    def __call__(self, points: Any, active: Any = True) -> list[Any]:
        """Albedo of each channel at world points (Array3f)."""
        return self.at_unit(self._field.to_unit(points), active)

    def at_unit(self, unit: Any, active: Any = True) -> list[Any]:
        """The same at points of the unit cube of the extinction's box; 0 for inactive lanes."""
        types, low, frac = self._types, [], []
        for row, top, last in zip(self._to_samples, self._top, self._last, strict=True):
            cell = dr.clip(dr.fma(unit.x, row[0], dr.fma(unit.y, row[1], dr.fma(unit.z, row[2], row[3]))), 0.0, top)
            index = dr.minimum(dr.floor(cell), last)
            low.append(types.UInt32(index))
            frac.append(cell - index)
        return [trilinear(grid, low, frac, active) for grid in self._grids]
