"""The camera of a scene: rays through the pixels of its crop window, the direction in which it sees a point, and where it shows points."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepclouds.backend import lanes_of
from deepclouds_runtime import stratified
from deepclouds_runtime._mitsuba import mitsuba, plain
from deepclouds_runtime.stratified import Stratified

# Places on the edge of a lens that tell how far a point is blurred, and how much further its blur may reach between them.
_ON_LENS, _BETWEEN = 16, 1.02


@dataclass(frozen=True)
class Window:
    """Some of an image's columns and rows.

    Attributes
    ----------
    left, top, width, height
        pixels.
    size
        (width, height) of the whole image, pixels.
    """

    left: int
    top: int
    width: int
    height: int
    size: tuple[int, int]

    @classmethod
    def whole(cls, size: tuple[int, int]) -> Window:
        """All of an image of (width, height) pixels."""
        return cls(0, 0, *size, size)

    @property
    def count(self) -> int:
        """How many pixels it has."""
        return self.width * self.height

    @property
    def share(self) -> float:
        """Its share of the image."""
        return self.count / (self.size[0] * self.size[1])

    def pixels(self, index: NDArray[np.int64]) -> NDArray[np.int64]:
        """Numbers in the image of the pixels that have these numbers in the window; both row by row."""
        return (self.top + index // self.width) * self.size[0] + self.left + index % self.width


class Camera:
    """A Mitsuba `perspective`, `thinlens` or `orthographic` sensor.

    Parameters
    ----------
    types
        Dr.Jit types.
    sensor
        Mitsuba's sensor.
    """

    def __init__(self, types: ModuleType, sensor: Any) -> None:
        self._types, self._sensor = types, sensor
        matrix = np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4)
        self._place = matrix[:3, 3]
        self._forward = matrix[:3, 2] / np.linalg.norm(matrix[:3, 2])
        self._parallel = sensor.class_name() == "OrthographicCamera"

    def rays(self, pixel: Any, numbers: Stratified) -> tuple[Any, Any, Any]:
        """Rays through random places of pixels, and of the lens: origin, unit direction, end (a distance).

        Parameters
        ----------
        pixel
            UInt32: numbers of pixels, row by row, in the film's crop window.
        numbers
            random numbers of the lanes.
        """
        mi, types = mitsuba(), self._types
        width, height = (dr.opaque(types.UInt32, int(v)) for v in self._sensor.film().crop_size())
        row = pixel // width
        x = types.Float(pixel - row * width) + numbers.number(stratified.PIXEL_X)
        y = types.Float(row) + numbers.number(stratified.PIXEL_Y)
        place = mi.Point2f(x / types.Float(width), y / types.Float(height))
        lens = mi.Point2f(0.5)
        if self._sensor.needs_aperture_sample():
            lens = mi.Point2f(numbers.number(stratified.LENS_U), numbers.number(stratified.LENS_V))
        ray, _ = self._sensor.sample_ray(mi.Float(self._sensor.shutter_open()), mi.Float(0.5), place, lens)
        # Parallel rays share one direction; here every lane has its own.
        direction = plain(types, ray.d) + dr.zeros(types.Array3f, dr.width(pixel))
        return plain(types, ray.o), direction, plain(types, ray.maxt)

    def toward(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Unit vectors (n, 3) in which the camera sees world points (n, 3); through a lens, those of the rays through its middle."""
        if self._parallel:
            return np.broadcast_to(self._forward, points.shape)
        away = points - self._place
        length = np.linalg.norm(away, axis=1, keepdims=True)
        seen: NDArray[np.float64] = np.where(length > 0, away / np.maximum(length, 1e-30), self._forward)
        return seen

    def footprint(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Edge of a pixel as large as it looks at world points (n, 3) in front of the camera: (n,), world."""
        width, height = self._sensor.film().crop_size()
        ((o, ox, oy), (d, dx, dy)), *_ = self._affine(np.array([[0.5, 0.5]]))
        depth = np.maximum((points - o) @ self._forward, 0)[:, None]
        edges = [np.linalg.norm(side - o + depth * (to - d), axis=1) / n for side, to, n in ((ox, dx, width), (oy, dy, height))]
        edge: NDArray[np.float64] = np.minimum(*edges)
        return edge

    def window(self, corners: NDArray[np.float64]) -> Window:
        """The part of the image outside of which it shows nothing of a box with these world corners (8, 3).

        The whole image, where some of the box lies beside or behind the camera, or none is in sight.
        """
        width, height = (int(v) for v in self._sensor.film().crop_size())
        size = width, height
        lower, upper = np.full(2, math.inf), np.full(2, -math.inf)
        for (o, ox, oy), (d, dx, dy) in self._affine(self._lens()):
            for corner in corners:
                depth = float((corner - o) @ self._forward)
                if not depth > 0:
                    return Window.whole(size)
                across = np.stack([ox - o + depth * (dx - d), oy - o + depth * (dy - d)], axis=1)
                place = np.linalg.lstsq(across, corner - o - depth * d, rcond=None)[0]
                lower, upper = np.minimum(lower, place), np.maximum(upper, place)
        if self._sensor.needs_aperture_sample():
            middle, half = 0.5 * (lower + upper), 0.5 * _BETWEEN * (upper - lower)
            lower, upper = middle - half, middle + half
        # A pixel more on each side for rounding.
        first = np.clip(np.floor(lower * size) - 1, 0, size).astype(int)
        last = np.clip(np.ceil(upper * size) + 1, 0, size).astype(int)
        if not (last > first).all():
            return Window.whole(size)
        return Window(int(first[0]), int(first[1]), int(last[0] - first[0]), int(last[1] - first[1]), size)

    def _lens(self) -> NDArray[np.float64]:
        """Random numbers (n, 2) of rays from the edge of the lens, or of a ray from the only point there is."""
        if not self._sensor.needs_aperture_sample():
            return np.array([[0.5, 0.5]])
        # The unit square's edge goes to the disc's.
        along = (np.arange(_ON_LENS) + 0.5) / (_ON_LENS // 4)
        side, place = along.astype(int), (along % 1)[:, None]
        ends = np.array([[0.0, 0.0], [1, 0], [1, 1], [0, 1], [0, 0]])
        edge: NDArray[np.float64] = ends[side] * (1 - place) + ends[side + 1] * place
        return edge

    def _affine(self, lens: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where rays begin, world, and where they go, as far as makes a depth of 1: both are linear in the place on the film.

        For random numbers (n, 2) of the lens, (n, 2, 3, 3): of begin and way, at the film's first corner and at the two next to it.
        """
        mi = mitsuba()
        film = np.tile([[0.0, 0.0], [1, 0], [0, 1]], (len(lens), 1)).astype(np.float32)
        aperture = np.repeat(lens, 3, axis=0).astype(np.float32)
        place, through = (mi.Point2f(*(lanes_of(mi.Float, values[:, c]) for c in range(2))) for values in (film, aperture))
        ray, _ = self._sensor.sample_ray(mi.Float(self._sensor.shutter_open()), mi.Float(0.5), place, through)
        # Parallel rays share one direction.
        o, d = (np.broadcast_to(np.array(v, np.float64).reshape(3, -1).T, (len(film), 3)) for v in (ray.o, ray.d))
        return np.stack([o, d / (d @ self._forward)[:, None]], axis=1).reshape(len(lens), 3, 2, 3).transpose(0, 2, 1, 3)

    def distance(self, points: Any) -> Any:
        """Distance of world points (Array3f) from the camera's place, or from its plane where rays are parallel."""
        types = self._types
        place, forward = (types.Array3f(*(dr.opaque(types.Float, float(v)) for v in vector)) for vector in (self._place, self._forward))
        return dr.dot(points - place, forward) if self._parallel else dr.norm(points - place)
