"""The light-aligned ten-level density stencil of a point, in Dr.Jit (Kallweit et al. 2017, section 4)."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepclouds.descriptor._layout import FIRST_SPACING, LEVELS, POINTS
from deepclouds.medium.field import Field
from deepclouds.volume.pyramid import FilteredLevel, filtered_levels, mean_extinction, volume_frame

# Below this sine the plane of light and view is not defined and the given azimuth turns the stencil.
PARALLEL_SINE = 1e-3


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
        mean = field.scale * mean_extinction(field.volume)
        self.field = field
        self.empty = mean <= 0 or field.majorant == 0.0
        self.unit = float(unit) if unit is not None else (1.0 / mean if mean > 0 else 1.0)
        if not (math.isfinite(self.unit) and self.unit > 0):
            raise ValueError(f"the unit of length must be positive and finite, got {self.unit}")
        self._frame = volume_frame(field.volume, None if origin is None else np.asarray(origin, np.float64))
        smallest = float(field.volume.voxel_size.min())
        spacings = [FIRST_SPACING * 2.0**k * self.unit for k in range(LEVELS)]
        self._raw_levels = sum(s <= smallest for s in spacings)
        filtered = [] if self.empty else filtered_levels(field.volume, self._frame, spacings[self._raw_levels :])
        self._levels = [self._upload(level) for level in filtered]

    def _upload(self, level: FilteredLevel) -> tuple[Any, tuple[int, int, int], NDArray[np.float64]]:
        # A rim of zeros makes the clamped lookup read zero beyond the stored cells.
        values = np.pad(level.values, 1) * np.float32(self.field.scale * self.unit)
        nz, ny, nx = values.shape
        data = self.field.types.Float(np.ascontiguousarray(values, np.float32).ravel())
        # Cell centre c sits at c + 0.5 from the origin; the rim adds one.
        return data, (nx, ny, nz), level.first.astype(np.float64) - 0.5

    def stencils(self, points: Any, w: Any, omega_sun: Any, azimuth: Any | None = None) -> Any:
        """Stencils of n points as one flat Dr.Jit array of n * 10 * 225 float32, layout [point][level][z][y][x].

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
        """
        types = self.field.types
        n = dr.width(points, w, omega_sun)
        out = dr.zeros(types.Float, n * LEVELS * POINTS)
        if self.empty or n == 0:
            return out
        x_axis, y_axis, z_axis = self._axes(w, omega_sun, azimuth)
        lane = dr.arange(types.UInt32, n * POINTS)
        point = lane // POINTS
        place = lane - point * POINTS
        iz = place // 25
        iy = (place - iz * 25) // 5
        ix = place - iz * 25 - iy * 5
        offset = [types.Float(types.Int32(i)) - 2 for i in (ix, iy, iz)]
        target = point * (LEVELS * POINTS) + place

        def along(vectors: list[Any], base: Any) -> Any:
            """Base plus offset times the three axes, gathered for every lane."""
            total = self._gather(base, point)
            for amount, vector in zip(offset, vectors, strict=True):
                total = dr.fma(self._gather(vector, point), amount, total)
            return total

        # Every level's lookup is affine in the point and the axes: bring them to its own coordinates once a point.
        unit_axes = [self.field.direction_to_unit(a) for a in (x_axis, y_axis, z_axis)]
        unit_point = self.field.to_unit(points)
        frame_axes = [self._to_frame(a) for a in (x_axis, y_axis, z_axis)]
        frame_point = self._to_frame(points - types.Array3f(*(float(v) for v in self._frame.origin)))
        dr.eval(unit_axes, unit_point, frame_axes, frame_point)
        for k in range(LEVELS):
            spacing = FIRST_SPACING * 2.0**k * self.unit
            if k < self._raw_levels:
                position = along([a * dr.opaque(types.Float, spacing) for a in unit_axes], unit_point)
                value = self.field.sigma_t_unit(position) * dr.opaque(types.Float, self.unit)
            else:
                data, size, first = self._levels[k - self._raw_levels]
                base = frame_point * dr.opaque(types.Float, 1.0 / spacing)
                base = base - types.Array3f(*(dr.opaque(types.Float, float(v)) for v in first))
                value = self._lookup(data, size, along(frame_axes, base))
            dr.scatter(out, value, target + k * POINTS)
            dr.eval(out)
        return out

    def stencils_numpy(
        self, points: ArrayLike, w: ArrayLike, omega_sun: ArrayLike, azimuth: ArrayLike | None = None
    ) -> NDArray[np.float32]:
        """Stencils (n, 10, 225) of NumPy arrays of points and directions, each (n, 3), and azimuths (n,)."""
        types = self.field.types
        arrays = [types.Array3f(np.ascontiguousarray(np.asarray(a, np.float32).T)) for a in (points, w, omega_sun)]
        turn = None if azimuth is None else types.Float(np.ascontiguousarray(azimuth, np.float32))
        return np.array(self.stencils(*arrays, turn)).reshape(-1, LEVELS, POINTS)

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

    def _lookup(self, data: Any, size: tuple[int, int, int], cell: Any) -> Any:
        types = self.field.types
        low, frac = [], []
        for value, n in zip(cell, size, strict=True):
            clipped = dr.clip(value, 0.0, dr.opaque(types.Float, n - 1.0))
            index = dr.minimum(dr.floor(clipped), dr.opaque(types.Float, n - 2.0))
            low.append(types.UInt32(index))
            frac.append(clipped - index)
        row = dr.opaque(types.UInt32, size[0])
        plane = dr.opaque(types.UInt32, size[0] * size[1])
        base = low[0] + low[1] * row + low[2] * plane
        rows = []
        for shift in (types.UInt32(0), row, plane, plane + row):
            near = dr.gather(types.Float, data, base + shift)
            rows.append(dr.fma(frac[0], dr.gather(types.Float, data, base + shift + 1) - near, near))
        front = dr.fma(frac[1], rows[1] - rows[0], rows[0])
        back = dr.fma(frac[1], rows[3] - rows[2], rows[2])
        return dr.fma(frac[2], back - front, front)
