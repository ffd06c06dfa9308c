"""Labels from Mitsuba's ``volpath`` inside Mitsuba's own C++ loop, for a fair measure of what a label costs there.

J at a point is albedo times the mean radiance along directions w' drawn from the phase function around w. No sensor of Mitsuba draws
those, so every path gets a ``radiancemeter`` of its own whose direction is drawn beforehand, and a ``batch`` of them is rendered with one
sample a pixel: no Python between the paths, no ray that misses, every path starts in the medium, and the samples are independent and
unbiased. Drawing the directions, loading the sensors and turning the sun are not charged to volpath.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from deepclouds_training.mitsuba_tracer import scene_dict
from numpy.random import Generator
from numpy.typing import NDArray

from deepclouds.medium.phase import as_lobes
from deepclouds.volume import Volume

Singles = NDArray[np.float32]
Doubles = NDArray[np.float64]
VARIANTS = ("scalar_rgb", "llvm_ad_mono")
# A pixel's position in a wider film loses the digits that tell one meter from the next.
WIDEST = 1 << 15


def draw_directions(rng: Generator, w: Singles, g: float, walks: int) -> Doubles:
    """Directions (n, walks, 3) drawn from the Henyey-Greenstein function of `g` around w (n, 3), in float64."""
    as_lobes(np.array([g]))
    n = len(w)
    u = rng.random((n, walks))
    cosine = 1 - 2 * u if g == 0 else (1 + g**2 - ((1 - g**2) / (1 - g + 2 * g * u)) ** 2) / (2 * g)
    azimuth = rng.uniform(0, 2 * np.pi, (n, walks))
    travel = w.astype(np.float64)
    a = np.cross(travel, np.eye(3)[np.argmin(np.abs(travel), axis=1)])
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b = np.cross(travel, a)
    across = np.cos(azimuth)[..., None] * a[:, None] + np.sin(azimuth)[..., None] * b[:, None]
    directions: Doubles = cosine[..., None] * travel[:, None] + np.sqrt(np.maximum(1 - cosine**2, 0))[..., None] * across
    return directions


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
    """

    def __init__(
        self, volume: Volume, scale: float, g: float, albedo: float, points: Singles, w: Singles, walks: int, rng: Generator
    ) -> None:
        import mitsuba as mi

        inverse = np.linalg.inv(volume.to_world)
        unit = points.astype(np.float64) @ inverse[:3, :3].T + inverse[:3, 3]
        if not np.all((unit > 0) & (unit < 1)):
            raise ValueError("a point lies outside of the box: its paths would start in the wrong medium")
        started = time.process_time()
        self._albedo = albedo
        self._shape = (len(points), walks)
        self._scene = mi.load_dict(scene_dict(volume, scale, g, [0.0, 0.0, 1.0], albedo))
        medium = self._scene.shapes()[0].interior_medium()
        directions = draw_directions(rng, w, g, walks).reshape(-1, 3).tolist()
        origins = np.repeat(points.astype(np.float64), walks, axis=0).tolist()
        film = {"type": "hdrfilm", "pixel_format": "luminance", "component_format": "float32", "rfilter": {"type": "box"}}
        pixel = mi.load_dict({**film, "width": 1, "height": 1})
        self._sensors = []
        for start in range(0, len(origins), WIDEST):
            end = min(start + WIDEST, len(origins))
            batch: dict[str, Any] = {"type": "batch", "medium": medium, "sampler": {"type": "independent"}}
            batch["film"] = {**film, "width": end - start, "height": 1}
            for i in range(start, end):
                batch[f"meter_{i}"] = {"type": "radiancemeter", "origin": origins[i], "direction": directions[i], "film": pixel}
            self._sensors.append(mi.load_dict(batch))
        self.load_seconds = time.process_time() - started

    def trace(self, omega_sun: Doubles, seed: int) -> tuple[Doubles, float]:
        """Samples of ``4 pi J / (albedo^2 E)``, (n, walks), and the process time of the render alone.

        The meters' directions are the same in every call; `seed` decides everything beyond them.
        """
        import mitsuba as mi

        parameters = mi.traverse(self._scene)
        up = np.eye(3)[np.argmin(np.abs(omega_sun))]
        # A directional light shines along +Z of its frame.
        parameters["sun.to_world"] = mi.ScalarTransform4f().look_at(
            origin=[0, 0, 0], target=[-float(v) for v in omega_sun], up=[float(v) for v in up]
        )
        parameters.update()
        values, seconds = [], 0.0
        for number, sensor in enumerate(self._sensors):
            started = time.process_time()
            image = mi.render(self._scene, sensor=sensor, spp=1, seed=(seed + 7919 * number) % 2**32)
            values.append(np.array(image, np.float64).ravel())
            seconds += time.process_time() - started
        return (4 * np.pi / self._albedo) * np.concatenate(values).reshape(self._shape), seconds
