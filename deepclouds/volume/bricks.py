"""Values on a grid of which most are zero: only the bricks that hold something are kept.

The idea of a brick atlas is that of GigaVoxels (Crassin et al. 2009) and of NanoVDB's leaves (Museth 2021); ours is one level deep.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

# Voxels along a brick's edge: that of OpenVDB's leaves.
EDGE = 8
BRICK_VOXELS = EDGE**3
_Kind = TypeVar("_Kind", bound=np.generic)


@dataclass(frozen=True, eq=False)
class Bricks:
    """A grid (nz, ny, nx) that is zero outside of some bricks of 8 x 8 x 8.

    Attributes
    ----------
    shape
        (nz, ny, nx) of the grid; bricks at its upper ends may stick out.
    places
        int32 (n, 3): brick (z, y, x) of each kept one, no two the same; it holds the samples ``8 place`` to ``8 place + 7``.
    values
        float32 (n, 8, 8, 8), in the order z, y, x; zero where a brick sticks out of the grid.
    """

    shape: tuple[int, int, int]
    places: NDArray[np.int32]
    values: NDArray[np.float32]

    @property
    def grid(self) -> tuple[int, int, int]:
        """Number of bricks along z, y and x that cover the grid."""
        bz, by, bx = (-(-n // EDGE) for n in self.shape)
        return bz, by, bx

    @property
    def nbytes(self) -> int:
        """Bytes of places and values."""
        return self.places.nbytes + self.values.nbytes

    @staticmethod
    def from_dense(dense: NDArray[np.float32]) -> Bricks:
        """The bricks of a dense grid (nz, ny, nx) that hold anything but zeros."""
        split = into_bricks(np.pad(dense, [(0, -n % EDGE) for n in dense.shape]))
        places = np.argwhere(split.any(axis=(3, 4, 5))).astype(np.int32)
        nz, ny, nx = dense.shape
        return Bricks((nz, ny, nx), places, np.ascontiguousarray(split[tuple(places.T)], np.float32))

    def dense(self) -> NDArray[np.float32]:
        """The whole grid (nz, ny, nx)."""
        nz, ny, nx = self.shape
        result = np.zeros(tuple(EDGE * n for n in self.grid), np.float32)
        into_bricks(result)[tuple(self.places.T)] = self.values
        return np.ascontiguousarray(result[:nz, :ny, :nx])

    def numbers(self) -> NDArray[np.int32]:
        """Number of the brick at each place (bz, by, bx); -1 where none is kept."""
        result = np.full(self.grid, -1, np.int32)
        result[tuple(self.places.T)] = np.arange(len(self.places), dtype=np.int32)
        return result

    def at(self, z: NDArray[np.int64], y: NDArray[np.int64], x: NDArray[np.int64]) -> NDArray[np.float32]:
        """Samples at indices inside of the grid."""
        number = self.numbers()[z // EDGE, y // EDGE, x // EDGE]
        found = np.zeros(len(number), np.float32)
        kept = number >= 0
        found[kept] = self.values[number[kept], z[kept] % EDGE, y[kept] % EDGE, x[kept] % EDGE]
        return found

    def layers(self, axis: int) -> Iterator[tuple[int, tuple[slice | NDArray[np.int32], ...], NDArray[np.float32]]]:
        """The bricks layer by layer along an axis (0 is z).

        Yields
        ------
        layer
            number of the layer of bricks.
        where
            index into an array (b, b', 8, 8), bricks and then samples along the other two axes, that picks the columns of these bricks.
        values
            (m, 8, 8, 8) of the layer's bricks.
        """
        first, second = (a for a in range(3) if a != axis)
        order = np.argsort(self.places[:, axis], kind="stable")
        ends = np.searchsorted(self.places[order, axis], np.arange(self.grid[axis] + 1))
        for layer, (begin, end) in enumerate(itertools.pairwise(ends)):
            chosen = order[begin:end]
            if len(chosen):
                yield layer, (self.places[chosen, first], self.places[chosen, second]), self.values[chosen]

    def sums(self, axis: int) -> NDArray[np.float64]:
        """Sums along an axis (0 is z): float64, of the grid's shape without it."""
        first, second = (a for a in range(3) if a != axis)
        total = np.zeros((self.grid[first], self.grid[second], EDGE, EDGE))
        for _, where, values in self.layers(axis):
            total[where] += values.sum(axis=1 + axis, dtype=np.float64)
        return from_columns(total)[: self.shape[first], : self.shape[second]]

    def row_ends(self, above: float | np.float32) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """The rows along x with a sample larger than `above`: (z, y) of each (m, 2), and its first and last such sample (m,)."""
        nz, ny, nx = self.grid
        first = np.full((nz, ny, EDGE, EDGE), EDGE * nx, np.int32)
        last = np.full((nz, ny, EDGE, EDGE), -1, np.int32)
        for layer, where, values in self.layers(2):
            filled = values > above
            found = filled.any(axis=3)
            first[where] = np.where(found, np.minimum(first[where], EDGE * layer + filled.argmax(axis=3)), first[where])
            last[where] = np.where(found, EDGE * layer + EDGE - 1 - filled[..., ::-1].argmax(axis=3), last[where])
        rows = np.argwhere(from_columns(last) >= 0)
        ends = [from_columns(end)[tuple(rows.T)].astype(np.int64) for end in (first, last)]
        return rows, ends[0], ends[1]

    def window_maxima(self, before: bool) -> NDArray[np.float32]:
        """Largest sample of every brick (bz, by, bx), kept or not, and of the samples that touch it.

        Parameters
        ----------
        before
            whether the samples one before the brick count; those one after it always do.
        """
        # Of every brick the maxima of its first sample, of all, and of the last sample along each axis.
        table = self.values
        for axis in (1, 2, 3):
            along = np.moveaxis(table, axis, 0)
            table = np.stack([along[0], table.max(axis=axis), along[-1]], axis=axis)
        bz, by, bx = self.grid
        result = np.zeros((bz, by, bx), np.float32)
        for dz, dy, dx in np.ndindex(3, 3, 3):
            # What the brick `step` further on shows to this one: 0 from the one before, its last sample; 2 from the one after, its first.
            step = np.array((dz, dy, dx)) - 1
            if not before and step.min() < 0:
                continue
            seen = np.zeros((bz, by, bx), np.float32)
            seen[tuple(self.places.T)] = table[:, 1 - step[0], 1 - step[1], 1 - step[2]]
            here = tuple(slice(max(0, -s), n - max(0, s)) for s, n in zip(step, self.grid, strict=True))
            there = tuple(slice(max(0, s), n - max(0, -s)) for s, n in zip(step, self.grid, strict=True))
            result[here] = np.maximum(result[here], seen[there])
        return result


def into_bricks(dense: NDArray[np.float32]) -> NDArray[np.float32]:
    """View (bz, by, bx, 8, 8, 8) of a grid whose edges are multiples of 8."""
    nz, ny, nx = (n // EDGE for n in dense.shape)
    return dense.reshape(nz, EDGE, ny, EDGE, nx, EDGE).transpose(0, 2, 4, 1, 3, 5)


def from_columns(columns: NDArray[_Kind]) -> NDArray[_Kind]:
    """Array (8 b, 8 b') from columns of bricks (b, b', 8, 8)."""
    b, c = columns.shape[:2]
    return columns.transpose(0, 2, 1, 3).reshape(EDGE * b, EDGE * c)
