"""Times labels from Mitsuba's ``volpath``, one sun, phase function and albedo at a time: the loop is that of the generator's tracer.

Drawing the directions, loading the sensors and turning the sun are not charged to volpath.
"""

from __future__ import annotations

import time

from deepclouds_training.mitsuba_tracer import Doubles, Singles, VolpathScene, draw_directions, holds
from numpy.random import Generator

from deepclouds.volume import Volume

VARIANTS = ("scalar_rgb", "llvm_ad_mono")


class VolpathLabels:
    """Paths from points of one volume, one meter a path, under suns that may change.

    Parameters
    ----------
    volume, scale
        density, and extinction per unit of density, 1 / world length.
    g, albedo
        phase function and single-scattering albedo of all points.
    points, w
        (n, 3) world points strictly inside of the box, and unit vectors, the camera ray's travel.
    walks
        paths a point; directions are drawn from `rng`.

    Attributes
    ----------
    load_seconds
        process time of drawing directions and loading scene and sensors.

    Raises
    ------
    ValueError
        for a point outside of the box, whose paths might miss the cloud and cost nothing.
    """

    def __init__(
        self, volume: Volume, scale: float, g: float, albedo: float, points: Singles, w: Singles, walks: int, rng: Generator
    ) -> None:
        if not holds(volume, points).all():
            raise ValueError("a point lies outside of the box: its paths might miss the cloud")
        started = time.process_time()
        self._albedo, self._shape = albedo, (len(points), walks)
        self._scene = VolpathScene(volume, scale, g)
        self._meters = self._scene.meters(points, draw_directions(rng, w, g, walks), inside=True)
        self.load_seconds = time.process_time() - started

    def trace(self, omega_sun: Doubles, seed: int) -> tuple[Doubles, float]:
        """Samples of ``4 pi J / (albedo^2 E)``, (n, walks), and the process time of the render alone.

        The meters' directions are the same in every call; `seed` decides everything beyond them.
        """
        self._scene.light(omega_sun, self._albedo)
        started = time.process_time()
        values = self._scene.labels(self._meters, seed)
        seconds = time.process_time() - started
        return values.reshape(self._shape), seconds
