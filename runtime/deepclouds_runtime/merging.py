"""Several clouds of a scene in one grid, which is what everything else renders."""

from __future__ import annotations

import itertools

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepclouds.errors import InputError
from deepclouds.medium.field import Field
from deepclouds.volume import Volume
from deepclouds_runtime._mitsuba import mitsuba, types_of
from deepclouds_runtime.scene_medium import Medium

# 256 MB of densities. Voxels are half as wide as those of the finest grid, for resampling blurs; to fit, they may be twice as wide.
_MOST_VOXELS = 1 << 26
_FINER, _COARSEST = 0.5, 2.0
# Points a voxel and axis that its density is the mean of, for grids that are turned or shifted against the common one.
_POINTS = 2


def merged(media: list[Medium], notes: list[str]) -> Medium:
    """One medium in place of several.

    Parameters
    ----------
    media
        two or more, of one albedo and one phase function, whose boxes do not overlap.
    notes
        is told about the resampling.

    Raises
    ------
    InputError
        when albedo or phase function differ, an albedo varies in space, boxes overlap, or the clouds are too small for their distance.

    Notes
    -----
    The common grid is aligned with the world. Its voxels are half as wide as those of the finest grid, or as wide as memory asks for; what
    is finer is averaged, so that hard edges become ramps of a voxel's width.
    """
    first = media[0]
    if any(medium.varying is not None for medium in media):
        raise InputError(f"{len(media)} clouds, and an albedo that varies in space: make it one number, or render one cloud at a time")
    for other in media[1:]:
        for name in ("albedo", "phase"):
            if not np.allclose(getattr(first, name), getattr(other, name), rtol=1e-5, atol=1e-6):
                raise InputError(
                    f"{len(media)} clouds with different {name}: {getattr(first, name)} and {getattr(other, name)}; "
                    "deepclouds renders several clouds of one medium: make them equal, or render one cloud at a time"
                )
    _check_apart([medium.volume for medium in media])
    corners = np.array([medium.volume.bounds for medium in media])
    lower, upper = corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)
    finest = min(float(medium.volume.voxel_size.min()) for medium in media)
    voxel = max(_FINER * finest, float(np.prod(upper - lower) / _MOST_VOXELS) ** (1 / 3))
    if voxel > _COARSEST * finest:
        raise InputError(
            f"{len(media)} clouds with voxels of {finest:g} in a space of {' x '.join(f'{v:g}' for v in upper - lower)}: no common grid "
            "of them fits into memory; render one cloud at a time, or use coarser grids"
        )
    shape = np.maximum(np.ceil((upper - lower) / voxel - 1e-6), 1).astype(int)
    density = np.zeros(shape[::-1], np.float32)
    for medium, (low, high) in zip(media, corners, strict=True):
        begin = np.clip(np.floor((low - lower) / voxel - 1e-6), 0, shape - 1).astype(int)
        end = np.clip(np.ceil((high - lower) / voxel + 1e-6), 1, shape).astype(int)
        (x, y, z), (x_end, y_end, z_end) = begin, end
        density[z:z_end, y:y_end, x:x_end] += _extinction(medium, lower + begin * voxel, voxel, end - begin)
    notes.append(f"{len(media)} clouds are resampled into one grid of {' x '.join(str(n) for n in shape)} voxels of {voxel:g}")
    top = float(density.max())
    scale = top if top > 0 else 1.0
    return Medium(Volume.from_box(density / np.float32(scale), lower, lower + shape * voxel), scale, first.albedo, first.phase)


def _check_apart(volumes: list[Volume]) -> None:
    """Refuse boxes that overlap: which medium a place there belongs to would depend on the way to it."""
    for a, b in itertools.combinations(volumes, 2):
        to_other = np.linalg.inv(b.to_world) @ a.to_world
        from_other = np.linalg.inv(to_other)
        # Two parallelepipeds are apart when a face normal of one of them, or a cross product of their edges, separates them.
        edges_a, edges_b = np.eye(3), from_other[:3, :3].T
        normals = [np.cross(e[i], e[(i + 1) % 3]) for e in (edges_a, edges_b) for i in range(3)]
        normals += [np.cross(p, q) for p in edges_a for q in edges_b]
        corners = np.array(list(np.ndindex(2, 2, 2)), np.float64)
        other = corners @ from_other[:3, :3].T + from_other[:3, 3]
        if not any(_separates(normal, corners, other) for normal in normals):
            raise InputError("two clouds overlap: their containers must lie apart; merge them into one grid")


def _separates(normal: NDArray[np.float64], first: NDArray[np.float64], second: NDArray[np.float64]) -> bool:
    a, b = first @ normal, second @ normal
    slack = 1e-5 * (np.ptp(a) + np.ptp(b))
    return bool(slack > 0 and (a.max() <= b.min() + slack or b.max() <= a.min() + slack))


def _extinction(medium: Medium, lower: NDArray[np.float64], voxel: float, shape: NDArray[np.int_]) -> NDArray[np.float32]:
    """Mean extinction (nz, ny, nx) of a medium in voxels from the corner `lower` on."""
    types = types_of(mitsuba())
    field = Field(types, medium.volume, medium.scale)
    nx, ny, nz = (int(n) for n in shape)
    total = np.zeros((nz, ny, nx), np.float32)
    for part in np.ndindex(_POINTS, _POINTS, _POINTS):
        x, y, z = (
            types.Float((lower[axis] + (np.arange(n) + (part[axis] + 0.5) / _POINTS) * voxel).astype(np.float32))
            for axis, n in enumerate((nx, ny, nz))
        )
        index = dr.arange(types.UInt32, nx * ny * nz)
        plane = index // (nx * ny)
        rest = index - plane * (nx * ny)
        row = rest // nx
        points = types.Array3f(dr.gather(types.Float, x, rest - row * nx), dr.gather(types.Float, y, row), dr.gather(types.Float, z, plane))
        total += np.array(field.sigma_t(points)).reshape(nz, ny, nx)
    return total / np.float32(_POINTS**3)
