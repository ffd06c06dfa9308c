"""Extinction on the device: the trilinear field, cut hard at its box, that every kernel looks up."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np

from deepclouds.medium.majorants import BRICK, Majorants
from deepclouds.volume import Volume

# Stands for an infinite distance where a difference of two must stay a number.
_FAR = 3.0e38


class Field:
    """The extinction ``sigma_t(x) = scale * density(x)`` of one volume, ready for Dr.Jit kernels.

    Parameters
    ----------
    types
        ``drjit.llvm`` or ``drjit.cuda`` (see `deepclouds.backend.backend`).
    volume
        the density and its place in the world.
    scale
        extinction per unit of density, 1 / world length; not negative.
    brick
        edge of a brick of `majorants`, in voxels; None for one brick, the whole box.

    Attributes
    ----------
    majorants
        local bounds of the extinction, for tracking and for skipping what is empty.
    majorant
        the largest extinction, 1 / world length.
    step
        half of the smallest voxel edge, world units: the step of deterministic marches.

    Notes
    -----
    Lookups are exact trilinear interpolation between cell centres in float32; outside of the box extinction is zero.
    """

    def __init__(self, types: ModuleType, volume: Volume, scale: float = 1.0, brick: int | None = BRICK) -> None:
        if not (np.isfinite(scale) and scale >= 0):
            raise ValueError(f"scale must be finite and not negative, got {scale}")
        self.types = types
        self.volume = volume
        self.scale = float(scale)
        # One sample along an axis would leave no pair to interpolate between: repeat it.
        grid = volume.density
        repeat = [(0, 1 if n == 1 else 0) for n in grid.shape]
        grid = np.pad(grid, repeat, mode="edge")
        nz, ny, nx = grid.shape
        sigma = (grid.astype(np.float64) * scale).astype(np.float32)
        self.majorant = float(sigma.max())
        self.step = 0.5 * float(volume.voxel_size.min())
        self.majorants = Majorants(types, sigma, np.linalg.norm(volume.to_world[:3, :3], axis=0) / np.array([nx, ny, nz]), brick)
        self._data = types.Float(np.ascontiguousarray(sigma).ravel())
        # Opaque, so that kernels compiled for one volume serve all others.
        self._stride_y, self._stride_z = dr.opaque(types.UInt32, nx), dr.opaque(types.UInt32, nx * ny)
        inverse = np.linalg.inv(volume.to_world)
        self._to_unit = [[dr.opaque(types.Float, float(v)) for v in row] for row in inverse[:3]]
        self._samples = [dr.opaque(types.Float, float(n)) for n in volume.resolution]
        self._last = [dr.opaque(types.Float, float(n - 2)) for n in (nx, ny, nz)]

    def to_unit(self, p: Any) -> Any:
        """World points to coordinates in the unit cube of the grid's box."""
        m = self._to_unit
        return type(p)(*(dr.fma(p.x, r[0], dr.fma(p.y, r[1], dr.fma(p.z, r[2], r[3]))) for r in m))

    def direction_to_unit(self, d: Any) -> Any:
        """World directions to the unit cube's frame (not normalised)."""
        m = self._to_unit
        return type(d)(*(d.x * r[0] + d.y * r[1] + d.z * r[2] for r in m))

    def sigma_t(self, p: Any, active: Any = True) -> Any:
        """Extinction at world points `p`, 1 / world length; zero outside of the box and for inactive lanes."""
        return self.sigma_t_unit(self.to_unit(p), active)

    def holds_unit(self, unit: Any) -> Any:
        """Whether points, given in the unit cube of the box, lie in the box or on its faces."""
        return (unit.x >= 0) & (unit.x <= 1) & (unit.y >= 0) & (unit.y <= 1) & (unit.z >= 0) & (unit.z <= 1)

    def sigma_t_unit(self, unit: Any, active: Any = True) -> Any:
        """Extinction at points given in the unit cube of the box."""
        t = self.types
        inside = active & self.holds_unit(unit)
        low, frac = [], []
        for value, n, last in zip(unit, self._samples, self._last, strict=True):
            cell = dr.clip(dr.fma(value, n, -0.5), 0.0, n - 1)
            index = dr.minimum(dr.floor(cell), last)
            low.append(t.UInt32(index))
            frac.append(cell - index)
        base = low[0] + low[1] * self._stride_y + low[2] * self._stride_z
        rows = []
        for offset in (t.UInt32(0), self._stride_y, self._stride_z, self._stride_z + self._stride_y):
            a = dr.gather(t.Float, self._data, base + offset, inside)
            b = dr.gather(t.Float, self._data, base + (offset + 1), inside)
            rows.append(dr.fma(frac[0], b - a, a))
        front = dr.fma(frac[1], rows[1] - rows[0], rows[0])
        back = dr.fma(frac[1], rows[3] - rows[2], rows[2])
        return dr.fma(frac[2], back - front, front)

    def intersect(self, origin: Any, direction: Any) -> tuple[Any, Any]:
        """Distances at which rays enter (0 where the origin is inside) and leave the box; `leave <= enter` is a miss."""
        o, d = self.to_unit(origin), self.direction_to_unit(direction)
        enter, leave = self.types.Float(0), self.types.Float(_FAR)
        for a, b in zip(o, d, strict=True):
            parallel = dr.abs(b) < 1e-12
            inverse = dr.rcp(dr.select(parallel, 1.0, b))
            t0, t1 = -a * inverse, (1 - a) * inverse
            outside = parallel & ((a < 0) | (a > 1))
            near = dr.select(parallel, 0.0, dr.minimum(t0, t1))
            far = dr.select(parallel, dr.select(outside, -1.0, _FAR), dr.maximum(t0, t1))
            enter, leave = dr.maximum(enter, near), dr.minimum(leave, far)
        return enter, leave
