"""The field filtered to a spacing: exact averages of the trilinear field over cubic cells, halved level by level."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepclouds.errors import InputError
from deepclouds.volume._brick_levels import averaged, halved
from deepclouds.volume._volume import Volume
from deepclouds.volume.bricks import Bricks
from deepclouds.volume.sparse import SparseVolume

# A level of a volume in bricks stays in bricks as long as all of its cells would be more than these, 64 MB.
_MOST_DENSE_CELLS = 1 << 24


@dataclass(frozen=True)
class Frame:
    """The orthonormal axes along which a volume's grid lies, and the point its filter cells are aligned to.

    Attributes
    ----------
    axes
        (3, 3), columns are the unit vectors of the grid's x, y and z axes in the world.
    origin
        (3,) world point on a corner of the filter cells of every level.
    """

    axes: NDArray[np.float64]
    origin: NDArray[np.float64]


@dataclass(frozen=True)
class FilteredLevel:
    """Cell averages of one level; zero beyond the stored cells.

    Attributes
    ----------
    values
        float32 (nz, ny, nx), mean density of each cell, or its bricks.
    first
        (3,) integer cell coordinates (x, y, z) of ``values[0, 0, 0]``: cell c covers ``[c, c + 1] * spacing`` from the frame's origin.
    spacing
        edge of a cell, world units.
    """

    values: NDArray[np.float32] | Bricks
    first: NDArray[np.int64]
    spacing: float

    def dense(self) -> NDArray[np.float32]:
        """All cells (nz, ny, nx), whether they are kept in bricks or not."""
        return self.values.dense() if isinstance(self.values, Bricks) else self.values


def volume_frame(volume: Volume, origin: NDArray[np.float64] | None = None) -> Frame:
    """Frame of `volume`: its grid axes, and `origin` or the density's centre of mass, which empty padding does not move.

    Raises
    ------
    InputError
        when the grid is sheared.
    """
    edges = volume.to_world[:3, :3]
    axes = edges / np.linalg.norm(edges, axis=0)
    if not np.allclose(axes.T @ axes, np.eye(3), atol=1e-4):
        raise InputError("the grid's axes are not perpendicular: resample the sheared volume to a box first")
    if origin is None:
        mass = volume.sums(0)
        total = float(mass.sum())
        centre = np.full(3, 0.5)
        if total > 0:
            depth = volume.sums((1, 2))
            for axis, weights in enumerate((mass.sum(axis=0), mass.sum(axis=1), depth)):
                centre[axis] = float(weights @ (np.arange(len(weights)) + 0.5)) / total / len(weights)
        origin = edges @ centre + volume.to_world[:3, 3]
    return Frame(axes, np.asarray(origin, np.float64))


def mean_extinction(volume: Volume) -> float:
    """Density averaged with weights of density: ``int d^2 / int d`` over the samples; 0 for an empty grid.

    The reciprocal of `scale` times this is the unit of length of the descriptor.
    """
    stored = volume.stored
    total = float(stored.sum(dtype=np.float64))
    if total <= 0:
        return 0.0
    return float(np.einsum("ijk,ijk->", stored, stored, dtype=np.float64)) / total


def optical_size(volume: Volume, scale: float) -> float:
    """Longest side of the box in units of length of the descriptor: mean free paths at the mean extinction; `scale` as in `Field`."""
    return float(np.linalg.norm(volume.to_world[:3, :3], axis=0).max()) * scale * mean_extinction(volume)


def _cell_weights(samples: int, length: float, start: float, spacing: float) -> tuple[NDArray[np.float64], int]:
    """Matrix (cells, samples) of the exact averages, over cells of `spacing`, of the clamped piecewise linear interpolant along one axis.

    `start` is the coordinate of the box's lower face relative to the cells' origin; returns the number of the first cell too.
    """
    voxel = length / samples
    first = math.floor(start / spacing + 1e-9)
    last = max(first + 1, math.ceil((start + length) / spacing - 1e-9))
    edges = (np.arange(first, last + 1) * spacing - start) / voxel  # in voxels from the lower face
    edges = np.clip(edges, 0.0, samples)

    # Integral from the lower face to `edges` of each sample's hat: the outermost hats continue as constants to the faces.
    centres = np.arange(samples) + 0.5
    x = edges[:, None] - centres[None, :]
    rising = 0.5 * np.clip(x + 1, 0, 1) ** 2
    falling = np.clip(x, 0, 1) - 0.5 * np.clip(x, 0, 1) ** 2
    integral = np.where(x < 0, rising, 0.5 + falling)
    low = np.clip(edges, 0, 0.5)
    high = np.clip(edges - (samples - 0.5), 0, 0.5)
    if samples == 1:
        integral = edges[:, None].copy()
    else:
        integral[:, 0] = low + np.where(x[:, 0] < 0, 0.0, falling[:, 0])
        integral[:, -1] = np.where(x[:, -1] < 0, rising[:, -1], 0.5) + high
    return np.diff(integral, axis=0) * voxel / spacing, first


def filtered_levels(volume: Volume, frame: Frame, spacings: list[float]) -> list[FilteredLevel]:
    """Average the density over cubic cells, one level for each of the `spacings`, each twice the one before.

    The first level holds the exact averages of the trilinear field with its hard cut at the box; each further one averages 2 x 2 x 2
    cells, which is the same as averaging the field itself.
    """
    return list(each_filtered_level(volume, frame, spacings))


def each_filtered_level(volume: Volume, frame: Frame, spacings: list[float]) -> Iterator[FilteredLevel]:
    """The levels of `filtered_levels` one after the other, so that those in bricks need not all be kept at once."""
    level: FilteredLevel | None = None
    for spacing in spacings:
        if level is None:
            level = _first_level(volume, frame, spacing)
        elif isinstance(level.values, Bricks):
            level = _in_bricks(*halved(level.values, level.first), spacing)
        else:
            level = _halved(level.values, level.first, spacing)
        yield level


def _first_level(volume: Volume, frame: Frame, spacing: float) -> FilteredLevel:
    corner = frame.axes.T @ (volume.to_world[:3, 3] - frame.origin)
    lengths = np.linalg.norm(volume.to_world[:3, :3], axis=0)
    axes = [_cell_weights(n, float(lengths[a]), float(corner[a]), spacing) for a, n in enumerate(volume.resolution)]
    first = np.array([cell for _, cell in axes], np.int64)
    weights = [w.astype(np.float32) for w, _ in axes]
    if isinstance(volume, SparseVolume):
        return _in_bricks(*averaged(volume.bricks, weights, first), spacing)
    values = volume.density
    # Contract z, y, x in turn; axis 0 always holds the one to do next, and moves to the end when done.
    for axis in (2, 1, 0):
        values = np.tensordot(values, weights[axis], axes=(0, 1))
    return FilteredLevel(np.ascontiguousarray(values, np.float32), first, spacing)


def _in_bricks(values: Bricks, first: NDArray[np.int64], spacing: float) -> FilteredLevel:
    few = int(np.prod(values.shape, dtype=np.int64)) <= _MOST_DENSE_CELLS
    return FilteredLevel(values.dense() if few else values, first, spacing)


def _halved(values: NDArray[np.float32], first: NDArray[np.int64], spacing: float) -> FilteredLevel:
    new = first // 2
    before = first - 2 * new
    after = (before + np.array(values.shape[::-1])) % 2
    padded = np.pad(values, [(int(before[a]), int(after[a])) for a in (2, 1, 0)])
    nz, ny, nx = padded.shape
    means = padded.reshape(nz // 2, 2, ny // 2, 2, nx // 2, 2).mean(axis=(1, 3, 5))
    return FilteredLevel(np.ascontiguousarray(means, np.float32), new, spacing)
