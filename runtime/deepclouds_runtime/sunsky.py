"""Mitsuba's `sunsky` emitter taken apart: a sky without a sun, and the sun's disc as a distant light.

A table of directions that suits the sky misses a disc of half a degree, and a network is asked about suns; so the disc's irradiance becomes
that of a directional light from its middle. Shadows then have no penumbra.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepclouds_runtime._mitsuba import mitsuba

# Gauss points across the disc, whose limb may be darkened, and places around it, where the sky's colour changes.
_RINGS, _AROUND = 24, 16


@dataclass(frozen=True)
class SunSky:
    """The parts of a `sunsky` emitter.

    Attributes
    ----------
    sky
        Mitsuba emitter: the same sky without the sun.
    omega_sun
        unit vector TOWARD the middle of the disc.
    irradiance
        that the disc adds to the sky's, perpendicular to `omega_sun`, one value a colour channel.
    aperture
        the disc's angular diameter, degrees.
    """

    sky: Any
    omega_sun: tuple[float, float, float]
    irradiance: tuple[float, ...]
    aperture: float


def split(emitter: Any) -> SunSky:
    """Take a Mitsuba `sunsky` emitter apart."""
    mi = mitsuba()
    parameters = mi.traverse(emitter)
    toward = np.array(parameters["sun_direction"], np.float64).ravel()
    toward = toward / np.linalg.norm(toward)
    albedo = np.ravel(np.array(parameters["albedo.value"], np.float64)).tolist()
    sky = mi.load_dict(
        {
            "type": "sunsky",
            "turbidity": _number(parameters["turbidity"]),
            "sky_scale": _number(parameters["sky_scale"]),
            "sun_scale": 0.0,
            "albedo": {"type": "rgb", "value": albedo} if len(albedo) == 3 else albedo[0],
            "sun_direction": toward.tolist(),
            "to_world": mi.ScalarTransform4f(np.array(emitter.world_transform().matrix, np.float64).reshape(4, 4).tolist()),
        }
    )
    # Mitsuba tells the disc's size in its description alone.
    (aperture,) = (float(v) for v in re.findall(r"Sun aperture = ([\d.eE+-]+)", str(emitter)))
    directions, weights = _disc(toward, np.deg2rad(aperture / 2))
    shining = _number(parameters["sun_scale"]) > 0
    irradiance = shining * (weights @ (_radiance(emitter, directions) - _radiance(sky, directions)))
    x, y, z = (float(v) for v in toward)
    return SunSky(sky, (x, y, z), tuple(float(v) for v in np.maximum(irradiance, 0)), aperture)


def _number(value: Any) -> float:
    return float(np.ravel(np.array(value))[0])


def _disc(axis: NDArray[np.float64], radius: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Directions (n, 3) in the cone of `radius` (radians) around `axis`, and weights (n,): solid angle times the cosine to the axis."""
    nodes, gauss = np.polynomial.legendre.leggauss(_RINGS)
    # Even in the cosine is even in solid angle; 1 - cosine keeps the digits of a small disc.
    height = 2 * np.sin(radius / 2) ** 2
    drop = np.repeat(0.5 * height * (1 + nodes), _AROUND)
    azimuth = np.tile(2 * np.pi * (np.arange(_AROUND) + 0.5) / _AROUND, _RINGS)
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)
    sine = np.sqrt(drop * (2 - drop))
    directions = (1 - drop)[:, None] * axis + sine[:, None] * (np.cos(azimuth)[:, None] * first + np.sin(azimuth)[:, None] * second)
    weights = np.repeat(np.pi * height * gauss / _AROUND, _AROUND) * (1 - drop)
    return directions, weights


def _radiance(emitter: Any, directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Radiance (n, channels) that an environment sends from directions (n, 3) pointing away from the scene."""
    mi = mitsuba()
    interaction = dr.zeros(mi.SurfaceInteraction3f, len(directions))
    interaction.wi = mi.Vector3f(np.ascontiguousarray(-directions.T, np.float32))
    return np.array(emitter.eval(interaction), np.float64).reshape(-1, len(directions)).T
