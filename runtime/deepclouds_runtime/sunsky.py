"""Mitsuba's `sunsky` emitter taken apart: a sky without a sun, and the sun's disc as a distant light.

A table of directions that suits the sky misses a disc of half a degree, and a network is asked about suns; so the disc becomes a sun of its
size and irradiance.
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
# Rings of equal solid angle that tell how dark the limb is, and the difference from an even disc that counts.
_LIMB_RINGS, _EVEN = 32, 1e-3


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
    limb
        how dark the disc's limb is, see `deepclouds_runtime.scene_lights.Sun`; nothing where the disc is even.
    """

    sky: Any
    omega_sun: tuple[float, float, float]
    irradiance: tuple[float, ...]
    aperture: float
    limb: tuple[tuple[float, ...], ...]


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
    radius = np.deg2rad(aperture / 2)
    directions, weights = _gauss(toward, radius)
    shining = _number(parameters["sun_scale"]) > 0
    irradiance = shining * (weights @ (_radiance(emitter, directions) - _radiance(sky, directions)))
    x, y, z = (float(v) for v in toward)
    limb = _limb(emitter, sky, toward, radius) if max(irradiance) > 0 else ()
    return SunSky(sky, (x, y, z), tuple(float(v) for v in np.maximum(irradiance, 0)), aperture, limb)


def _number(value: Any) -> float:
    return float(np.ravel(np.array(value))[0])


def _gauss(axis: NDArray[np.float64], radius: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Directions (n, 3) in the cone of `radius` (radians) around `axis`, and weights (n,): solid angle times the cosine to the axis."""
    nodes, gauss = np.polynomial.legendre.leggauss(_RINGS)
    directions, drop = _rings(axis, radius, 0.5 * (1 + nodes))
    return directions, np.repeat(2 * np.pi * np.sin(radius / 2) ** 2 * gauss / _AROUND, _AROUND) * (1 - drop)


def _limb(emitter: Any, sky: Any, axis: NDArray[np.float64], radius: float) -> tuple[tuple[float, ...], ...]:
    """Radiance (rings, channels) of the disc over its mean; nothing where it is even."""
    directions, drop = _rings(axis, radius, (np.arange(_LIMB_RINGS) + 0.5) / _LIMB_RINGS)
    light = np.maximum(_radiance(emitter, directions) - _radiance(sky, directions), 0)
    mean = np.average(light, axis=0, weights=1 - drop)
    rings = light.reshape(_LIMB_RINGS, _AROUND, -1).mean(axis=1) / np.where(mean > 0, mean, 1)
    if np.abs(rings - 1)[:, mean > 0].max() < _EVEN:
        return ()
    return tuple(tuple(float(v) for v in ring) for ring in rings)


def _rings(axis: NDArray[np.float64], radius: float, places: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Directions (n, 3) around `axis` in rings at `places`, shares of the cone's solid angle, and 1 less their cosine to the axis."""
    # Even in the cosine is even in solid angle; 1 - cosine keeps the digits of a small disc.
    drop = np.repeat(2 * np.sin(radius / 2) ** 2 * places, _AROUND)
    azimuth = np.tile(2 * np.pi * (np.arange(_AROUND) + 0.5) / _AROUND, len(places))
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)
    sine = np.sqrt(drop * (2 - drop))
    directions = (1 - drop)[:, None] * axis + sine[:, None] * (np.cos(azimuth)[:, None] * first + np.sin(azimuth)[:, None] * second)
    return directions, drop


def _radiance(emitter: Any, directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Radiance (n, channels) that an environment sends from directions (n, 3) pointing away from the scene."""
    mi = mitsuba()
    interaction = dr.zeros(mi.SurfaceInteraction3f, len(directions))
    interaction.wi = mi.Vector3f(np.ascontiguousarray(-directions.T, np.float32))
    return np.array(emitter.eval(interaction), np.float64).reshape(-1, len(directions)).T
