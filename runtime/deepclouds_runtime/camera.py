"""The camera of a scene: rays through the pixels of its crop window, and the direction in which it sees a point."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepclouds_runtime import stratified
from deepclouds_runtime._mitsuba import mitsuba, plain
from deepclouds_runtime.stratified import Stratified


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

    def distance(self, points: Any) -> Any:
        """Distance of world points (Array3f) from the camera's place, or from its plane where rays are parallel."""
        types = self._types
        place, forward = (types.Array3f(*(dr.opaque(types.Float, float(v)) for v in vector)) for vector in (self._place, self._forward))
        return dr.dot(points - place, forward) if self._parallel else dr.norm(points - place)
