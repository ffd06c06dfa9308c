"""The light-aligned ten-level density stencil of a point, in Dr.Jit (Kallweit et al. 2017, section 4)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepclouds.backend import lanes_of, vectors_of
from deepclouds.descriptor._layout import FIRST_SPACING, LEVELS, POINTS
from deepclouds.medium.field import Field
from deepclouds.medium.grid import BrickGrid, DenseGrid, Grid, trilinear
from deepclouds.volume.bricks import EDGE, Bricks
from deepclouds.volume.pyramid import FilteredLevel, each_filtered_level, mean_extinction, volume_frame

# Below this sine the plane of light and view is not defined and the given azimuth turns the stencil.
PARALLEL_SINE = 1e-3
_ROWS = POINTS // 5


def default_unit(field: Field) -> float:
    """Mean free path at the extinction-weighted mean extinction, world units; 1 for an empty field."""
    mean = field.scale * mean_extinction(field.volume)
    return 1.0 / mean if mean > 0 else 1.0


class _Level:
    """One filtered level on the device; what differs between levels is opaque, so that all share one kernel."""

    def __init__(self, types: ModuleType, level: FilteredLevel, factor: float) -> None:
        # A rim of zeros makes the clamped lookup read zero beyond the stored cells: one cell, or one brick.
        grid: Grid
        if isinstance(level.values, Bricks):
            rim = EDGE
            nz, ny, nx = (n + 2 * rim for n in level.values.shape)
            grid = BrickGrid(types, Bricks((nz, ny, nx), level.values.places + 1, level.values.values), float(np.float32(factor)))
        else:
            rim = 1
            values = np.pad(level.values, rim) * np.float32(factor)
            nz, ny, nx = values.shape
            grid = DenseGrid(types, values.astype(np.float32, copy=False))
        self.grid = grid
        self.inverse_spacing = dr.opaque(types.Float, 1.0 / level.spacing)
        # Cell centre c sits at c + 0.5 from the origin.
        self.shift = types.Array3f(*(dr.opaque(types.Float, rim - 0.5 - float(c)) for c in level.first))
        self._last = [dr.opaque(types.Float, n - 1.0) for n in (nx, ny, nz)]

    def lookup(self, types: ModuleType, cell: Any) -> Any:
        """Trilinear value at cell coordinates `cell`, where whole numbers are the stored samples."""
        low, frac = [], []
        for value, last in zip(cell, self._last, strict=True):
            clipped = dr.clip(value, 0.0, last)
            index = dr.minimum(dr.floor(clipped), last - 1)
            low.append(types.UInt32(index))
            frac.append(clipped - index)
        return trilinear(self.grid, low, frac)


class Descriptor:
    """Stencils of one field: ten levels of 5 x 5 x 9 values of ``sigma_t * unit`` around a point.

    Level k is sampled with the spacing ``0.5 * 2^k * unit``, its z axis toward the light, its x axis perpendicular to the plane of
    light and view. A level whose spacing exceeds the voxels reads the field averaged over cells of that spacing.

    Parameters
    ----------
    field
        the extinction.
    unit
        unit of length, world units: by default the mean free path at the extinction-weighted mean extinction,
        ``1 / (int sigma_t^2 / int sigma_t)``. Keep it fixed for a sequence.
    origin
        (3,) world point the filter's cells are aligned to: by default the centre of mass. Keep it fixed for a sequence.

    Raises
    ------
    InputError
        when the grid is sheared.
    """

    def __init__(self, field: Field, unit: float | None = None, origin: ArrayLike | None = None) -> None:
        self.field = field
        self.empty = field.majorant == 0.0
        self.unit = default_unit(field) if unit is None else float(unit)
        if not (math.isfinite(self.unit) and self.unit > 0):
            raise ValueError(f"the unit of length must be positive and finite, got {self.unit}")
        self._frame = volume_frame(field.volume, None if origin is None else np.asarray(origin, np.float64))
        smallest = float(field.volume.voxel_size.min())
        spacings = [FIRST_SPACING * 2.0**k * self.unit for k in range(LEVELS)]
        self._raw_levels = sum(s <= smallest for s in spacings)
        types = field.types
        filtered = each_filtered_level(field.volume, self._frame, [] if self.empty else spacings[self._raw_levels :])
        self._levels = [_Level(types, level, field.scale * self.unit) for level in filtered]
        self._spacings = [dr.opaque(types.Float, s) for s in spacings]
        self._opaque_unit = dr.opaque(types.Float, self.unit)

    @property
    def nbytes(self) -> int:
        """Bytes of the filtered levels."""
        return sum(level.grid.nbytes for level in self._levels)

    def levels(
        self,
        points: Any,
        w: Any,
        omega_sun: Any,
        azimuth: Any | None = None,
        side: Any | None = None,
        wanted: Sequence[int] = range(LEVELS),
    ) -> list[Any]:
        """Stencils of n points, one Dr.Jit array of n * 225 float32 for each level, layout [point][z][y][x], finest level first.

        Parameters
        ----------
        points
            Array3f of world points.
        w
            Array3f, unit directions of the camera rays' travel.
        omega_sun
            Array3f, unit directions TOWARD the light.
        azimuth
            Float, angle in radians that turns the stencil where view and light are parallel (default 0).
        side
            Float, 1 or -1: where -1, the stencil is mirrored across the plane of light and view, which leaves J unchanged (default 1).
        wanted
            the levels to build, by default all ten.
        """
        types = self.field.types
        n = dr.width(points, w, omega_sun)
        if self.empty or n == 0:
            return [dr.zeros(types.Float, n * POINTS) for _ in wanted]
        x_axis, y_axis, z_axis = self._axes(w, omega_sun, azimuth)
        if side is not None:
            x_axis = x_axis * side
        # A lane does one row of five points along x, so that what it gathers of its point is shared by five lookups.
        lane = dr.arange(types.UInt32, n * _ROWS)
        point = lane // _ROWS
        row = lane - point * _ROWS
        iz = row // 5
        iy = row - iz * 5
        y_offset, z_offset = (types.Float(types.Int32(i)) - 2 for i in (iy, iz))
        # Five plain stores and a gather that interleaves them take half the time of five scatters.
        place = dr.arange(types.UInt32, n * POINTS)
        interleave = place // 5
        interleave = interleave + (place - interleave * 5) * dr.opaque(types.UInt32, n * _ROWS)
        # As `dr.concat` does it, in which the number of points would be a constant of the kernel, compiled anew for each number.
        starts = [lane + dr.opaque(types.UInt32, i * n * _ROWS) for i in range(5)]

        def start(axes: list[Any], base: Any) -> tuple[Any, Any]:
            """Middle of the row, and the step from one of its points to the next."""
            x, y, z = (self._gather(axis, point) for axis in axes)
            return dr.fma(z, z_offset, dr.fma(y, y_offset, self._gather(base, point))), x

        # Every level's lookup is affine in the point and the axes: bring them to its own coordinates once a point.
        unit_axes = [self.field.direction_to_unit(a) for a in (x_axis, y_axis, z_axis)]
        unit_point = self.field.to_unit(points)
        frame_axes = [self._to_frame(a) for a in (x_axis, y_axis, z_axis)]
        frame_point = self._to_frame(points - types.Array3f(*(float(v) for v in self._frame.origin)))
        dr.eval(unit_axes, unit_point, frame_axes, frame_point)
        result = []
        for k in wanted:
            if k < self._raw_levels:
                middle, step = start([a * self._spacings[k] for a in unit_axes], unit_point)
                values = [self.field.sigma_t_unit(dr.fma(step, i - 2.0, middle)) * self._opaque_unit for i in range(5)]
            else:
                level = self._levels[k - self._raw_levels]
                middle, step = start(frame_axes, dr.fma(frame_point, level.inverse_spacing, level.shift))
                values = [level.lookup(types, dr.fma(step, i - 2.0, middle)) for i in range(5)]
            dr.eval(values)
            joined = dr.empty(types.Float, n * POINTS)
            for value, index in zip(values, starts, strict=True):
                dr.scatter(joined, value, index)
            result.append(dr.gather(types.Float, joined, interleave))
            dr.eval(result[-1])
        return result

    def stencils_numpy(
        self,
        points: ArrayLike,
        w: ArrayLike,
        omega_sun: ArrayLike,
        azimuth: ArrayLike | None = None,
        side: ArrayLike | None = None,
        out: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32]:
        """Stencils (n, 10, 225) of NumPy arrays of points and directions, each (n, 3), and azimuths and sides (n,); into `out` if given."""
        types = self.field.types
        x, d, sun = (vectors_of(types, a) for a in (points, w, omega_sun))
        turn, flip = (None if a is None else lanes_of(types.Float, a) for a in (azimuth, side))
        n = len(np.asarray(points))
        result = np.empty((n, LEVELS, POINTS), np.float32) if out is None else out
        for k, level in enumerate(self.levels(x, d, sun, turn, flip)):
            result[:, k] = level.numpy().reshape(n, POINTS)
        return result

    def _axes(self, w: Any, omega_sun: Any, azimuth: Any | None) -> tuple[Any, Any, Any]:
        types = self.field.types
        across = dr.cross(omega_sun, w)
        sine = dr.norm(across)
        sign = dr.select(omega_sun.z < 0, -1.0, 1.0)
        a = -dr.rcp(sign + omega_sun.z)
        b = omega_sun.x * omega_sun.y * a
        s = types.Array3f(1 + sign * omega_sun.x * omega_sun.x * a, sign * b, -sign * omega_sun.x)
        t = types.Array3f(b, sign + omega_sun.y * omega_sun.y * a, -omega_sun.y)
        sin_a, cos_a = dr.sincos(types.Float(0) if azimuth is None else azimuth)
        x_axis = dr.select(sine > PARALLEL_SINE, across / dr.maximum(sine, PARALLEL_SINE), s * cos_a + t * sin_a)
        return x_axis, dr.cross(omega_sun, x_axis), omega_sun

    def _to_frame(self, vector: Any) -> Any:
        columns = self._frame.axes
        return type(vector)(*(sum(vector[r] * float(columns[r, c]) for r in range(3)) for c in range(3)))

    def _gather(self, vector: Any, index: Any) -> Any:
        Float = self.field.types.Float
        return type(vector)(*(dr.gather(Float, c, index) if dr.width(c) > 1 else c for c in vector))
