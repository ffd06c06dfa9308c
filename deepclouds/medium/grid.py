"""Samples on the device, whole or in bricks, and trilinear interpolation between them."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepclouds.backend import lanes_of
from deepclouds.errors import InputError
from deepclouds.volume.bricks import BRICK_VOXELS, EDGE, Bricks

# A brick on the device has one sample more along each axis, the first of its neighbour: eight corners never need a second brick.
_WIDE = EDGE + 1
_WIDE_VOXELS = _WIDE**3
# Indices are 32-bit numbers, and so are the sizes of arrays.
_MOST = 2**32 - 1


class DenseGrid:
    """Every sample of a grid.

    Parameters
    ----------
    types
        ``drjit.llvm`` or ``drjit.cuda``.
    values
        float32 (nz, ny, nx).

    Attributes
    ----------
    data
        the samples.
    corners
        what to add to the place of a sample for those at (x, y), (x, y + 1), (x, y, z + 1) and (x, y + 1, z + 1).
    nbytes
        of the samples.
    """

    def __init__(self, types: ModuleType, values: NDArray[np.float32]) -> None:
        _, ny, nx = values.shape
        self.types = types
        self.nbytes = values.nbytes
        self.data = lanes_of(types.Float, values.ravel())
        # Opaque, so that kernels compiled for one grid serve all others.
        self._row, self._plane = dr.opaque(types.UInt32, nx), dr.opaque(types.UInt32, nx * ny)
        self.corners = (types.UInt32(0), self._row, self._plane, self._plane + self._row)

    def place(self, low: list[Any], active: Any) -> Any:
        """Where in `data` the samples at indices `low`, x first, lie."""
        return low[0] + low[1] * self._row + low[2] * self._plane


class BrickGrid:
    """The bricks of a grid that hold something, each with the samples beside it that interpolation inside of it reads.

    Parameters
    ----------
    types
        ``drjit.llvm`` or ``drjit.cuda``.
    bricks
        the samples.
    scale
        factor for the samples.

    Attributes
    ----------
    data, corners, nbytes
        as for `DenseGrid`; the first brick of `data` is all zeros and stands for all that are not kept.

    Raises
    ------
    InputError
        when there are more bricks than 32-bit indices reach.
    """

    def __init__(self, types: ModuleType, bricks: Bricks, scale: float) -> None:
        self.types = types
        places = np.argwhere(bricks.window_maxima(before=False) > 0)
        count = len(places) + 1
        if count * _WIDE_VOXELS > _MOST:
            raise InputError(
                f"the grid holds {count - 1} bricks of {EDGE}^3 voxels, more than 32-bit indices reach; resample it to larger voxels"
            )
        table = np.zeros(bricks.grid, np.uint32)
        table[tuple(places.T)] = np.arange(1, count, dtype=np.uint32) * _WIDE_VOXELS
        self._table = lanes_of(types.UInt32, table.ravel())
        _, by, bx = bricks.grid
        self._row, self._plane = dr.opaque(types.UInt32, bx), dr.opaque(types.UInt32, bx * by)
        self.data = _widened(types, bricks, places, scale)
        self.corners = tuple(dr.opaque(types.UInt32, n) for n in (0, _WIDE, _WIDE**2, _WIDE**2 + _WIDE))
        self.nbytes = table.nbytes + 4 * count * _WIDE_VOXELS

    def place(self, low: list[Any], active: Any) -> Any:
        """Where in `data` the samples at indices `low`, x first, lie."""
        x, y, z = (v // EDGE for v in low)
        brick = dr.gather(self.types.UInt32, self._table, x + y * self._row + z * self._plane, active)
        x, y, z = (v & (EDGE - 1) for v in low)
        return brick + x + y * _WIDE + z * _WIDE**2


Grid = DenseGrid | BrickGrid


def trilinear(grid: Grid, low: list[Any], frac: list[Any], active: Any = True) -> Any:
    """Interpolate between the eight samples from indices `low` on, x first, at `frac` in [0, 1]; 0 for inactive lanes."""
    return mixed(corners(grid, low, active), frac)


def corners(grid: Grid, low: list[Any], active: Any = True) -> list[Any]:
    """The eight samples from indices `low` on, x first, in pairs along x; 0 for inactive lanes."""
    base = grid.place(low, active)
    return [dr.gather(grid.types.Float, grid.data, base + (offset + step), active) for offset in grid.corners for step in (0, 1)]


def mixed(samples: list[Any], frac: list[Any]) -> Any:
    """Interpolate between the samples of `corners` at `frac` in [0, 1], x first."""
    rows = [dr.fma(frac[0], b - a, a) for a, b in zip(samples[::2], samples[1::2], strict=True)]
    front = dr.fma(frac[1], rows[1] - rows[0], rows[0])
    back = dr.fma(frac[1], rows[3] - rows[2], rows[2])
    return dr.fma(frac[2], back - front, front)


def _widened(types: ModuleType, bricks: Bricks, places: NDArray[np.int64], scale: float) -> Any:
    """Samples of the bricks at `places`, each with one more along every axis, after a brick of zeros."""
    if not len(bricks.places):
        return dr.zeros(types.Float, _WIDE_VOXELS)
    # One brick of nothing around the upper ends, so that every brick has neighbours.
    numbers = np.full(tuple(n + 1 for n in bricks.grid), -1, np.int32)
    numbers[tuple(bricks.places.T)] = np.arange(len(bricks.places), dtype=np.int32)
    _, row, column = numbers.shape
    # The brick of zeros stands at a corner that has no neighbours.
    first = np.array([[n - 1 for n in numbers.shape]], np.int64)
    corner = np.concatenate([first, places]) @ (row * column, column, 1)
    source, number_of = lanes_of(types.Float, bricks.values.ravel()), lanes_of(types.Int32, numbers.ravel())
    last = dr.opaque(types.UInt32, numbers.size - 1)
    lane = dr.arange(types.UInt32, len(corner) * _WIDE_VOXELS)
    brick = lane // _WIDE_VOXELS
    z, rest = _split(lane - brick * _WIDE_VOXELS, _WIDE**2)
    y, x = _split(rest, _WIDE)
    (bz, z), (by, y), (bx, x) = (_split(v, EDGE) for v in (z, y, x))
    place = dr.gather(types.UInt32, lanes_of(types.UInt32, corner), brick) + bz * (row * column) + by * column + bx
    number = dr.gather(types.Int32, number_of, dr.minimum(place, last))
    value = dr.gather(types.Float, source, types.UInt32(number) * BRICK_VOXELS + z * EDGE**2 + y * EDGE + x, number >= 0)
    # In double precision, which a dense grid's samples are scaled in too.
    scaled = types.Float(types.Float64(value) * scale)
    dr.eval(scaled)
    return scaled


def _split(value: Any, width: int) -> tuple[Any, Any]:
    high = value // width
    return high, value - high * width
