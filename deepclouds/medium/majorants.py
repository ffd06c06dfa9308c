"""Local majorants: around every brick of the grid a block and the largest extinction in it, for tracking and for skipping what is empty.

Delta tracking is memoryless, so at any point it may go on with the majorant of any block that contains the point, and start again
where the block ends (Novak et al. 2018, CGF 37(2), section 5.3). Blocks overlap: each brick has its own, as large as pays.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepclouds.backend import lanes_of
from deepclouds.medium.elementary import log_of_share, whole, with_sign
from deepclouds.volume.bricks import EDGE, Bricks

# Edge of a brick, in voxels of the smallest edge.
BRICK = 4
# Blocks end this far beyond their last brick, in voxels: more than float32 rounds, less than the half voxel that the bound allows.
_BEYOND = 0.01
# Stands for a majorant of 0 where it is divided by, 1 / world length.
_LEAST = np.float32(1e-30)
# Of a block's entry, the bits that hold its radius; the others are those of a float32, its mean free path cut by up to a 2048th.
_RADIUS = 0xFFF
# Mean distance from the centre of a cube of edge 1 to its surface.
_MEAN_EXIT = 0.61


class Majorants:
    """Bricks over a grid, each with the block around it that tracking crosses at the least cost.

    Parameters
    ----------
    types
        ``drjit.llvm`` or ``drjit.cuda``.
    sigma
        (nz, ny, nx) extinction at the samples, 1 / world length, or its bricks.
    voxel_size
        (3,) edges of a voxel, x first, world units.
    brick
        edge of a brick in voxels of the smallest edge; None for one brick that is the whole box, the readable twin. Where `sigma` is in
        bricks they serve for any other edge.
    scale
        factor for `sigma`.

    Attributes
    ----------
    bricks
        (3,) voxels in a brick along x, y and z.
    bound
        (bz, by, bx) largest extinction of the trilinear field in each brick and up to half a voxel around it.
    radius
        (bz, by, bx) bricks that each brick's block reaches beyond it, on all sides.
    block_bound
        (bz, by, bx) largest extinction in that block.
    empty_radius
        (bz, by, bx) the same for the largest block without extinction; -1 where the brick itself has some.
    any_empty
        whether a brick is empty.
    nbytes
        of all tables, those on the device included.

    Notes
    -----
    A lane of tracking spends one step on every tentative collision and one on every end of a block: per unit of length the majorant
    and the inverse of the mean way out. The block of least sum is chosen. In a homogeneous or thin medium it is the whole box.
    """

    def __init__(
        self,
        types: ModuleType,
        sigma: NDArray[np.float32] | Bricks,
        voxel_size: NDArray[np.float64],
        brick: int | None = BRICK,
        scale: float = 1.0,
    ) -> None:
        shape = np.array(sigma.shape[::-1])
        if isinstance(sigma, Bricks):
            self.bricks = shape if brick is None else np.full(3, EDGE)
            bound = sigma.window_maxima(before=True)
            self.bound = bound.max(keepdims=True) if brick is None else bound
        else:
            self.bricks = shape if brick is None else np.clip(np.round(brick * voxel_size.min() / voxel_size), 1, shape).astype(int)
            self.bound = _brick_maxima(sigma, self.bricks)
        self.bound = (self.bound.astype(np.float64) * scale).astype(np.float32)
        self.radius, self.block_bound, self.empty_radius = _choose_blocks(self.bound, self.bricks * voxel_size)
        self.any_empty = bool(np.any(self.empty_radius >= 0))
        count = self.bound.shape[::-1]
        self._types = types
        self._table = lanes_of(types.UInt32, packed(self.block_bound, self.radius).ravel())
        self._empty = lanes_of(types.Float, self.empty_radius.ravel())
        kept = (self.bound, self.radius, self.block_bound, self.empty_radius)
        self.nbytes = sum(a.nbytes for a in kept) + 4 * 2 * self.bound.size
        self._per_unit = [dr.opaque(types.Float, float(n / b)) for n, b in zip(shape, self.bricks, strict=True)]
        self._edge = [dr.opaque(types.Float, float(b / n)) for n, b in zip(shape, self.bricks, strict=True)]
        self._half = [dr.opaque(types.Float, float(0.5 * b / n)) for n, b in zip(shape, self.bricks, strict=True)]
        self._beyond = [dr.opaque(types.Float, float((0.5 * b + _BEYOND) / n)) for n, b in zip(shape, self.bricks, strict=True)]
        self._last = [dr.opaque(types.Float, float(n - 1)) for n in count]
        self._stride_y, self._stride_z = dr.opaque(types.UInt32, count[0]), dr.opaque(types.UInt32, count[0] * count[1])

    def step(self, origin: Any, along: Any, distance: Any, u: Any, active: Any) -> tuple[Any, Any, Any]:
        """One step of delta tracking: to a tentative collision, or to the end of the block.

        Parameters
        ----------
        origin, along
            the ray in the unit cube's coordinates, `origin` inside of the cube; `along` is not normalised.
        distance
            where on the ray the lane is, world units.
        u
            random numbers in [0, 1).
        active
            lanes to move.

        Returns
        -------
        distance
            where the lane is then; never less than before.
        tentative
            whether there is a tentative collision.
        mean_path
            mean free path in the block, world length: with probability ``sigma_t * mean_path`` the tentative collision is real.
        """
        cell, index = self._brick(dr.fma(along, distance, origin))
        packed = dr.gather(self._types.UInt32, self._table, index, active)
        mean_path = dr.reinterpret_array(self._types.Float, packed & (0xFFFFFFFF ^ _RADIUS))
        radius = self._types.Float(packed & _RADIUS)
        end = self._exit(cell, radius, origin, along)
        reached = dr.fma(-log_of_share(self._types, 1 - u), mean_path, distance)
        return dr.maximum(dr.minimum(reached, end), distance), reached < end, mean_path

    def empty(self, at: Any, active: Any) -> tuple[Any, Any]:
        """Whether the bricks at `at`, points in the unit cube of the box, are empty, and the radii of their empty blocks for `end`."""
        _, index = self._brick(at)
        radius = dr.gather(self._types.Float, self._empty, index, active)
        return active & (radius >= 0), radius

    def end(self, at: Any, radius: Any, origin: Any, along: Any) -> Any:
        """Distance from `origin` along the ray at which the block of `radius` around the brick at `at` ends; see `step`."""
        cell, _ = self._brick(at)
        return self._exit(cell, radius, origin, along)

    def _brick(self, at: Any) -> tuple[list[Any], Any]:
        cell = [dr.clip(dr.floor(v * n), 0, last) for v, n, last in zip(at, self._per_unit, self._last, strict=True)]
        index = [whole(self._types, c) for c in cell]
        return cell, index[0] + index[1] * self._stride_y + index[2] * self._stride_z

    def _exit(self, cell: list[Any], radius: Any, origin: Any, along: Any) -> Any:
        # On each axis the way to the middle of the block and half of its edge, over the speed; the least of the three by one division.
        way: Any = None
        speed: Any = None
        for c, edge, half, beyond, o, a in zip(cell, self._edge, self._half, self._beyond, origin, along, strict=True):
            own_way, own_speed = dr.fma(radius, edge, beyond) + with_sign(dr.fma(c, edge, half) - o, a), dr.abs(a)
            if way is None:
                way, speed = own_way, own_speed
                continue
            sooner = own_way * speed < way * own_speed
            way, speed = dr.select(sooner, own_way, way), dr.select(sooner, own_speed, speed)
        return way / speed


def _brick_maxima(sigma: NDArray[np.float32], bricks: NDArray[Any]) -> NDArray[np.float32]:
    """Largest sample that interpolation reads inside of each brick, or up to half a voxel beyond it."""
    bound = sigma
    for axis, n in zip((2, 1, 0), bricks, strict=True):
        # Inside voxels a to b - 1 the field reads the samples a - 1 to b.
        starts = np.arange(0, bound.shape[axis], n)
        here = np.maximum.reduceat(bound, starts, axis=axis)
        before = np.take(bound, np.maximum(starts - 1, 0), axis=axis)
        after = np.take(bound, np.minimum(starts + n, bound.shape[axis] - 1), axis=axis)
        bound = np.maximum(here, np.maximum(before, after))
    return bound


def packed(bound: NDArray[np.float32], radius: NDArray[Any]) -> NDArray[np.uint32]:
    """Mean free path and radius of each block in one number: what tracking waits for is memory."""
    mean_path = 1 / np.maximum(bound, _LEAST)
    bits: NDArray[np.uint32] = mean_path.view(np.uint32) & np.uint32(0xFFFFFFFF ^ _RADIUS) | np.minimum(radius, _RADIUS).astype(np.uint32)
    return bits


def _choose_blocks(bound: NDArray[np.float32], edge: NDArray[np.float64]) -> tuple[NDArray[Any], NDArray[np.float32], NDArray[Any]]:
    """The radius of least cost for each brick, the maximum in that block, and the largest radius that is empty."""
    mean_edge = 3 / np.sum(1 / edge)
    radius, empty = np.zeros(bound.shape, np.int32), np.where(bound > 0, np.int32(-1), np.int32(0))
    best, majorant = bound + 1 / (_MEAN_EXIT * mean_edge), bound
    largest, reach = bound, 0
    while reach < max(bound.shape):
        wider = max(1, reach)
        largest = _widened(largest, wider)
        reach += wider
        cost = largest + 1 / (_MEAN_EXIT * mean_edge * (2 * reach + 1))
        better = cost < best
        radius[better] = reach
        best, majorant = np.where(better, cost, best), np.where(better, largest, majorant)
        empty[largest == 0] = reach
    return radius, majorant, empty


def _widened(values: NDArray[np.float32], reach: int) -> NDArray[np.float32]:
    """Largest value within `reach` along each axis; nothing lies beyond the array."""
    for axis in range(3):
        n = values.shape[axis]
        cumulated = values
        # A window of 2 reach + 1 from windows of powers of two.
        width, total = 1, 2 * reach + 1
        padding = [(0, 0)] * 3
        padding[axis] = (reach, reach)
        cumulated = np.pad(values, padding)
        while width < total:
            shift = min(width, total - width)
            length = cumulated.shape[axis] - shift
            cumulated = np.maximum(_part(cumulated, axis, 0, length), _part(cumulated, axis, shift, length))
            width += shift
        values = _part(cumulated, axis, 0, n)
    return values


def _part(values: NDArray[np.float32], axis: int, start: int, length: int) -> NDArray[np.float32]:
    where = [slice(None)] * 3
    where[axis] = slice(start, start + length)
    return values[tuple(where)]
