"""A camera that goes round a cloud that stands still."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepclouds_runtime._mitsuba import mitsuba


class Turntable:
    """Frames of one full turn of a camera around a vertical axis; sun, sky and cloud stay where they are.

    Frame 1 is the camera as it stands, each next one stands 360 / `count` degrees further, in the sense in which azimuths grow: from +Z to
    +X where +Y is up, from +X to +Y where +Z is. The last frame is one step before the first: played in a loop, none is there twice.

    Parameters
    ----------
    sensor
        Mitsuba's camera; it is moved.
    count
        frames of the turn.
    pivot
        (3,) world point on the axis.
    up
        ``"y"`` or ``"z"``, the axis' direction.
    """

    def __init__(self, sensor: Any, count: int, pivot: NDArray[np.float64], up: str = "y") -> None:
        self._sensor, self._count, self._pivot, self._up = sensor, count, np.asarray(pivot, np.float64), up
        self._start = np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4)

    def turn(self, frame: int) -> None:
        """Move the camera to its place in `frame`, counted from 1."""
        mi = mitsuba()
        turned = rotation(self._pivot, self._up, 360.0 * (frame - 1) / self._count) @ self._start
        parameters = mi.traverse(self._sensor)
        parameters["to_world"] = mi.Transform4f(turned.tolist())
        parameters.update()


def rotation(pivot: NDArray[np.float64], up: str, degrees: float) -> NDArray[np.float64]:
    """Matrix (4, 4) that turns the world about a vertical axis through `pivot`, from +Z to +X (`up` is y) or from +X to +Y (z)."""
    cosine, sine = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    first, second = (2, 0) if up == "y" else (0, 1)
    matrix = np.eye(4)
    matrix[first, first] = matrix[second, second] = cosine
    matrix[second, first], matrix[first, second] = sine, -sine
    matrix[:3, 3] = pivot - matrix[:3, :3] @ pivot
    return matrix
