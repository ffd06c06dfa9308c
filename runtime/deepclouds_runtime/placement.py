"""Where the grid of a Mitsuba medium lies in the world: candidates from its container, decided by asking the medium itself."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import permutations, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepclouds.errors import InputError
from deepclouds.medium.albedo import AlbedoGrid
from deepclouds.volume import Volume

Matrix = NDArray[np.float64]

# 8 corners of the unit cube and of Mitsuba's `cube`, which spans -1..1.
_UNIT_TO_CUBE = np.array([[2.0, 0, 0, -1], [0, 2, 0, -1], [0, 0, 2, -1], [0, 0, 0, 1]])


def cube_transform(positions: NDArray[np.floating[Any]], canonical: NDArray[np.floating[Any]]) -> Matrix | None:
    """Unit cube to world for a Mitsuba `cube`, by least squares from its vertices.

    Parameters
    ----------
    positions
        (n, 3) world positions of the shape's vertices.
    canonical
        (n, 3) positions of an untransformed `cube`, in the same order.

    Returns
    -------
    4 x 4 affine matrix, or None when the vertices are no affine image of the cube's.
    """
    if positions.shape != canonical.shape:
        return None
    a = np.c_[canonical, np.ones(len(canonical))].astype(np.float64)
    solution, *_ = np.linalg.lstsq(a, positions.astype(np.float64), rcond=None)
    if np.abs(a @ solution - positions).max() > 1e-4 * np.ptp(positions, axis=0).max():
        return None
    matrix = np.eye(4)
    matrix[:3] = solution.T
    transform: Matrix = matrix @ _UNIT_TO_CUBE
    return transform


def box_transform(lower: NDArray[np.float64], upper: NDArray[np.float64]) -> Matrix:
    """Unit cube to the world-aligned box between two corners."""
    matrix = np.diag(np.append(upper - lower, 1.0))
    matrix[:3, 3] = lower
    return matrix


def orientations(transform: Matrix) -> Iterator[Matrix]:
    """All 48 ways to lay the unit cube's axes into the box of `transform`, the given one first."""
    for order in permutations(range(3)):
        for signs in product((1, -1), repeat=3):
            turn = np.zeros((4, 4))
            turn[3, 3] = 1
            for axis, (source, sign) in enumerate(zip(order, signs, strict=True)):
                turn[axis, source] = sign
                turn[axis, 3] = 0.5 * (1 - sign)
            yield transform @ turn


def locate(density: NDArray[np.float32], scale: float, boxes: list[Matrix], sigma_t: Any, seed: int = 0) -> Volume:
    """The placement whose extinction agrees with what the medium itself says at random points.

    Parameters
    ----------
    density
        (nz, ny, nx) values of the grid.
    scale
        extinction per unit of density, 1 / world length.
    boxes
        candidate maps from the unit cube to the world; each is tried in all 48 orientations.
    sigma_t
        callable (n, 3) world points -> (n,) extinction, as the renderer that owns the medium evaluates it.
    seed
        of the random points.

    Raises
    ------
    InputError
        when none agrees.
    """
    random = np.random.default_rng(seed)
    top = scale * float(density.max())
    unit = random.random((96, 3))
    # Points beside filled voxels decide; in empty regions every placement agrees.
    filled = np.argwhere(density > 0)
    if len(filled):
        chosen = filled[random.integers(0, len(filled), 160)][:, ::-1] + random.random((160, 3))
        unit = np.concatenate([unit, np.minimum(chosen / np.array(density.shape[::-1]), 1.0)])
    unit = 0.002 + 0.996 * unit
    worst = np.inf
    for box in boxes:
        points = unit @ box[:3, :3].T + box[:3, 3]
        truth = sigma_t(points)
        for candidate in orientations(box):
            volume = Volume(density, candidate)
            error = np.abs(scale * volume.sample(points) - truth)
            # A steep edge turns the last digit of a position into a visible difference, at few points.
            mismatch = float(np.quantile(error, 0.98)) / top if top > 0 else 0.0
            if mismatch < 2e-3:
                return volume
            worst = min(worst, mismatch)
    raise InputError(
        f"cannot place the grid of the medium: at random points its extinction differs from the medium's by up to {100 * worst:.2g} % "
        "of the largest value; use a gridvolume with filter_type 'trilinear' whose box is that of the cube around it"
    )


def locate_albedo(values: NDArray[np.float32], boxes: list[Matrix], volume: Volume, albedo: Any, seed: int = 0) -> AlbedoGrid:
    """The placement in which a grid of albedos agrees with what the medium itself says at random points.

    Parameters
    ----------
    values
        (nz, ny, nx, channels).
    boxes
        candidate maps from the unit cube to the world; each is tried in all 48 orientations.
    volume
        the density: where it is 0 the medium has no albedo.
    albedo
        callable (n, 3) world points -> (n, channels) albedo, and (n,) whether there is any medium.
    seed
        of the random points.

    Raises
    ------
    InputError
        when none agrees.
    """
    random = np.random.default_rng(seed)
    filled = np.argwhere(volume.density > 0)
    # Without any medium every placement agrees.
    if not len(filled):
        return AlbedoGrid(values, boxes[0])
    chosen = filled[random.integers(0, len(filled), 512)][:, ::-1] + random.random((512, 3))
    points = chosen / np.array(volume.resolution) @ volume.to_world[:3, :3].T + volume.to_world[:3, 3]
    truth, known = albedo(points)
    if not known.any():
        return AlbedoGrid(values, boxes[0])
    worst = np.inf
    for box in boxes:
        for candidate in orientations(box):
            grid = AlbedoGrid(values, candidate)
            mismatch = float(np.quantile(np.abs(grid.sample(points[known]) - truth[known]).max(axis=1), 0.98))
            if mismatch < 2e-3:
                return grid
            worst = min(worst, mismatch)
    raise InputError(
        f"cannot place the grid of the albedo: at random points it differs from the medium's own by up to {worst:.2g}; "
        "use a gridvolume with filter_type 'trilinear' and the to_world of the density's grid"
    )
