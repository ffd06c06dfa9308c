"""The levels of the filtered pyramid of a grid in bricks, in bricks themselves; `deepclouds.volume.pyramid` has their dense twins."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from deepclouds.volume.bricks import EDGE, Bricks, into_bricks

# Bricks along the edge of a block that is averaged at once: larger ones hold more that is empty, smaller ones are too many.
_BLOCK = 4


def averaged(bricks: Bricks, weights: Sequence[NDArray[np.float32]], first: NDArray[np.int64]) -> tuple[Bricks, NDArray[np.int64]]:
    """Cells that are weighted sums of samples, axis by axis.

    Parameters
    ----------
    bricks
        the samples.
    weights
        for x, y and z a matrix (cells, samples), each cell's weights in a row without gaps.
    first
        (3,) coordinates (x, y, z) of the cell that the first rows belong to.

    Returns
    -------
    cells
        all that a kept brick reaches.
    first
        (3,) coordinates (x, y, z) of the returned cells' first one, multiples of the brick's edge.
    """
    matrices = list(weights)[::-1]
    origin = first[::-1]
    # For every brick along an axis the cells that it reaches: from `low` to before `high`, rows of the matrix.
    low, high = zip(*(_reach(matrix, EDGE) for matrix in matrices), strict=True)
    # Bricks of the result lie on multiples of the edge, so that pairs of them halve to whole ones.
    base = np.floor_divide(origin, EDGE)
    offset = origin - base * EDGE
    grid = [-(-(len(m) + int(o)) // EDGE) for m, o in zip(matrices, offset, strict=True)]
    mark = np.zeros(grid, bool)
    first_of = [(low[a][bricks.places[:, a]] + offset[a]) // EDGE for a in range(3)]
    last_of = [(high[a][bricks.places[:, a]] + offset[a] - 1) // EDGE for a in range(3)]
    spans = [int((e - b).max(initial=-1)) + 1 for b, e in zip(first_of, last_of, strict=True)]
    for step in np.ndindex(*spans):
        place = [b + s for b, s in zip(first_of, step, strict=True)]
        within = np.all([p <= e for p, e in zip(place, last_of, strict=True)], axis=0)
        mark[tuple(p[within] for p in place)] = True
    places = np.argwhere(mark)
    numbers = np.full(grid, -1, np.int32)
    numbers[tuple(places.T)] = np.arange(len(places), dtype=np.int32)
    values = np.zeros((len(places), EDGE, EDGE, EDGE), np.float32)
    for corner, block in _blocks(bricks):
        at, parts = [], []
        for axis, matrix in enumerate(matrices):
            brick = corner[axis] // EDGE
            begin, end = int(low[axis][brick]), int(high[axis][brick : brick + _BLOCK][-1])
            at.append(begin + int(offset[axis]))
            parts.append(matrix[begin:end, corner[axis] : corner[axis] + block.shape[axis]])
        _add(values, numbers, _contracted(block, *parts), at)
    shape = tuple(EDGE * n for n in grid)
    return Bricks((shape[0], shape[1], shape[2]), places.astype(np.int32), values), (base * EDGE)[::-1].astype(np.int64)


def halved(bricks: Bricks, first: NDArray[np.int64]) -> tuple[Bricks, NDArray[np.int64]]:
    """Means of 2 x 2 x 2 cells, aligned to even coordinates, and the first one's coordinates; arguments as `averaged` returns them."""
    absolute = bricks.places + (first[::-1] // EDGE).astype(np.int32)
    parents, octant = np.floor_divide(absolute, 2), absolute % 2
    base = np.floor_divide(first[::-1] // EDGE, 2).astype(np.int32)
    last = (first[::-1] // EDGE + np.array(bricks.grid) - 1) // 2
    grid = (last - base + 1).astype(int)
    flat = np.ravel_multi_index(tuple((parents - base).T), tuple(grid))
    kept, number = np.unique(flat, return_inverse=True)
    places = np.stack(np.unravel_index(kept, tuple(grid)), axis=1).astype(np.int32)
    values = np.zeros((len(kept), EDGE, EDGE, EDGE), np.float32)
    half = EDGE // 2
    octants = values.reshape(-1, 2, half, 2, half, 2, half).transpose(0, 1, 3, 5, 2, 4, 6)
    means = bricks.values.reshape(-1, half, 2, half, 2, half, 2).mean(axis=(2, 4, 6))
    octants[number, octant[:, 0], octant[:, 1], octant[:, 2]] = means
    nz, ny, nx = (EDGE * int(n) for n in grid)
    return Bricks((nz, ny, nx), places, values), (base[::-1] * EDGE).astype(np.int64)


def _blocks(bricks: Bricks) -> Iterator[tuple[list[int], NDArray[np.float32]]]:
    """Dense blocks of bricks that are not all empty, each with the index (z, y, x) of its first sample."""
    of_block = bricks.places // _BLOCK
    grid = tuple(-(-n // _BLOCK) for n in bricks.grid)
    flat = np.ravel_multi_index(tuple(of_block.T), grid)
    order = np.argsort(flat, kind="stable")
    bounds = np.flatnonzero(np.diff(flat[order], prepend=-1, append=-1))
    edge = _BLOCK * EDGE
    for begin, end in itertools.pairwise(bounds):
        chosen = order[begin:end]
        block = np.zeros((edge, edge, edge), np.float32)
        into_bricks(block)[tuple((bricks.places[chosen] % _BLOCK).T)] = bricks.values[chosen]
        yield [int(n) * edge for n in of_block[chosen[0]]], block


def _contracted(block: NDArray[np.float32], z: NDArray[np.float32], y: NDArray[np.float32], x: NDArray[np.float32]) -> NDArray[np.float32]:
    """Cells of a block by their weights along each axis.

    Products of stacks of small matrices: of large ones the linear algebra library would make work for all threads, which cost ten times
    what they do.
    """
    inside = block[: z.shape[1], : y.shape[1], : x.shape[1]]
    planes = y @ (inside @ x.T)
    cells: NDArray[np.float32] = (z @ planes.transpose(1, 0, 2)).transpose(1, 0, 2)
    return cells


def _reach(matrix: NDArray[np.float32], width: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First row that each group of `width` columns reaches, and one past the last."""
    parts = [np.flatnonzero(matrix[:, start : start + width].any(axis=1)) for start in range(0, matrix.shape[1], width)]
    return np.array([p[0] for p in parts]), np.array([p[-1] + 1 for p in parts])


def _add(values: NDArray[np.float32], numbers: NDArray[np.int32], block: NDArray[np.float32], at: list[int]) -> None:
    """Add a block of cells, from cell `at` (z, y, x) on, to the bricks that are kept."""
    low = [a // EDGE for a in at]
    high = [-(-(a + n) // EDGE) for a, n in zip(at, block.shape, strict=True)]
    padded = np.zeros([EDGE * (h - b) for b, h in zip(low, high, strict=True)], np.float32)
    inner = tuple(slice(a - EDGE * b, a - EDGE * b + n) for a, b, n in zip(at, low, block.shape, strict=True))
    padded[inner] = block
    number = numbers[tuple(slice(b, h) for b, h in zip(low, high, strict=True))]
    kept = number >= 0
    values[number[kept]] += into_bricks(padded)[kept]
