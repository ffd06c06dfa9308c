"""Extinction on the device: the trilinear field, cut hard at its box, that every kernel looks up."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np

from deepclouds.medium.elementary import whole
from deepclouds.medium.grid import BrickGrid, DenseGrid, Grid, trilinear
from deepclouds.medium.majorants import BRICK, Majorants
from deepclouds.volume import SparseVolume, Volume

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
        edge of a brick of `majorants`, in voxels; None for one brick, the whole box. Those of a volume in bricks are its own.

    Attributes
    ----------
    majorants
        local bounds of the extinction, for tracking and for skipping what is empty.
    majorant
        the largest extinction, 1 / world length.
    grid
        the samples on the device.
    samples, last
        how many there are along x, y and z, and the largest index that a cell of interpolation begins at, on the device.

    Notes
    -----
    Lookups are exact trilinear interpolation between cell centres in float32; outside of the box extinction is zero. A `SparseVolume` stays
    in bricks: the same values at the cost of one more gather a lookup.
    """

    def __init__(self, types: ModuleType, volume: Volume, scale: float = 1.0, brick: int | None = BRICK) -> None:
        if not (np.isfinite(scale) and scale >= 0):
            raise ValueError(f"scale must be finite and not negative, got {scale}")
        self.types = types
        self.volume = volume
        self.scale = float(scale)
        edges = np.linalg.norm(volume.to_world[:3, :3], axis=0)
        self.grid: Grid
        if isinstance(volume, SparseVolume):
            size = np.array(volume.resolution)
            self.majorants = Majorants(types, volume.bricks, edges / size, brick, self.scale)
            self.grid = BrickGrid(types, volume.bricks, self.scale)
            # A brick holds the sample after the last one too, which a single sample along an axis is never mixed with.
            self.majorant, last = float(self.majorants.bound.max()), np.maximum(size - 2, 0)
        else:
            # One sample along an axis would leave no pair to interpolate between: repeat it.
            grid = volume.density
            repeat = [(0, 1 if n == 1 else 0) for n in grid.shape]
            grid = np.pad(grid, repeat, mode="edge")
            sigma = (grid.astype(np.float64) * scale).astype(np.float32)
            size = np.array(sigma.shape[::-1])
            self.majorants = Majorants(types, sigma, edges / size, brick)
            self.grid = DenseGrid(types, sigma)
            self.majorant, last = float(sigma.max()), size - 2
        inverse = np.linalg.inv(volume.to_world)
        self._to_unit = [[dr.opaque(types.Float, float(v)) for v in row] for row in inverse[:3]]
        self._to_world = [[dr.opaque(types.Float, float(v)) for v in row] for row in volume.to_world[:3]]
        self.samples = [dr.opaque(types.Float, float(n)) for n in volume.resolution]
        self.last = [dr.opaque(types.Float, float(n)) for n in last]

    @property
    def nbytes(self) -> int:
        """Bytes of the volume, of the samples on the device, and of the majorants."""
        volume = self.volume.bricks.nbytes if isinstance(self.volume, SparseVolume) else self.volume.density.nbytes
        return volume + self.grid.nbytes + self.majorants.nbytes

    def to_unit(self, p: Any) -> Any:
        """World points to coordinates in the unit cube of the grid's box."""
        return _affine(self._to_unit, p)

    def to_world(self, p: Any) -> Any:
        """Coordinates in the unit cube of the grid's box to world points."""
        return _affine(self._to_world, p)

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
        inside = active & self.holds_unit(unit)
        low, frac = self._cells(unit)
        return trilinear(self.grid, [whole(self.types, index) for index in low], frac, inside)

    def drawn_unit(self, unit: Any, numbers: list[Any], active: Any = True) -> Any:
        """One of the eight samples around points of the unit cube, drawn by the weights that interpolation gives them.

        Its mean is `sigma_t_unit`, for an eighth of the memory read: enough where a collision is real with a probability that is in
        proportion to the extinction, which is then the same (Hofmann et al. 2021; Pharr et al. 2024, "stochastic texture filtering").

        Parameters
        ----------
        unit
            points in the box.
        numbers
            three independent uniform numbers in [0, 1), independent of everything else.
        active
            lanes to look up; the others return 0.
        """
        low, frac = self._cells(unit)
        one = self.types.UInt32(1)
        chosen = [whole(self.types, index) + dr.select(u < f, one, 0) for index, f, u in zip(low, frac, numbers, strict=True)]
        return dr.gather(self.types.Float, self.grid.data, self.grid.place(chosen, active), active)

    def _cells(self, unit: Any) -> tuple[list[Any], list[Any]]:
        """The sample before each point, x first, as a float, and how far the point lies from it toward the next, 0 to 1."""
        low, frac = [], []
        for value, n, last in zip(unit, self.samples, self.last, strict=True):
            cell = dr.clip(dr.fma(value, n, -0.5), 0.0, n - 1)
            index = dr.minimum(dr.floor(cell), last)
            low.append(index)
            frac.append(cell - index)
        return low, frac

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


def _affine(m: list[list[Any]], p: Any) -> Any:
    return type(p)(*(dr.fma(p.x, r[0], dr.fma(p.y, r[1], dr.fma(p.z, r[2], r[3]))) for r in m))
