"""A sun with a size: directions drawn from its disc for what it lights straight, and its radiance for who looks at it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np

from deepclouds.backend import lanes_of
from deepclouds_runtime._mitsuba import mitsuba
from deepclouds_runtime.lights import Shade, mitsuba_radiance
from deepclouds_runtime.scene_lights import Sun
from deepclouds_runtime.stratified import Stratified


class Disc:
    """The disc of a sun as a light source.

    Parameters
    ----------
    types
        Dr.Jit types.
    sun
        a sun with a `radius`.
    shade
        what stands between the disc and a point.

    Notes
    -----
    A disc of one radiance L brings ``E = pi sin(radius)^2 L``, measured perpendicular to its middle.
    """

    def __init__(self, types: ModuleType, sun: Sun, shade: Shade) -> None:
        self._types, self._shade = types, shade
        axis = np.array(sun.omega_sun, np.float64)
        first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
        first /= np.linalg.norm(first)
        self._axis, self._first, self._second = (
            types.Array3f(*(dr.opaque(types.Float, float(v)) for v in vector)) for vector in (axis, first, np.cross(axis, first))
        )
        # 1 less the cosine, which keeps the digits of a small disc.
        height = 2 * math.sin(0.5 * sun.radius) ** 2
        self._height = dr.opaque(types.Float, height)
        self._sine = dr.opaque(types.Float, math.sin(sun.radius))
        self._density = dr.opaque(types.Float, 1 / (2 * math.pi * height))
        self._radiance = [dr.opaque(types.Float, v / (math.pi * math.sin(sun.radius) ** 2)) for v in sun.irradiance]
        self._limb = [lanes_of(types.Float, ring) for ring in zip(*sun.limb, strict=True)]
        self._rings = len(sun.limb)

    def sample(self, u: Any, v: Any) -> tuple[Any, Any]:
        """Directions TOWARD the disc, even in solid angle, and their density per steradian, from numbers in [0, 1)."""
        drop = u * self._height
        sine, (s, c) = dr.safe_sqrt(drop * (2 - drop)), dr.sincos(2 * dr.pi * v)
        return dr.normalize((1 - drop) * self._axis + sine * (c * self._first + s * self._second)), self._density

    def density(self, direction: Any) -> Any:
        """Density per steradian with which `sample` draws these directions."""
        return dr.select(self.holds(direction), self._density, 0)

    def holds(self, direction: Any) -> Any:
        """Whether these directions meet the disc."""
        # The cosine of a small angle has lost half of its digits.
        return (dr.norm(dr.cross(direction, self._axis)) <= self._sine) & (dr.dot(direction, self._axis) > 0)

    def radiance(self, direction: Any) -> list[Any]:
        """Radiance from these directions, one array a colour channel."""
        inside = self.holds(direction)
        if not self._limb:
            return [dr.select(inside, value, 0) for value in self._radiance]
        away = dr.norm(dr.cross(direction, self._axis))
        drop = away * away / (1 + dr.safe_sqrt(1 - away * away))
        ring = dr.minimum(self._types.UInt32(drop / self._height * self._rings), self._rings - 1)
        return [
            dr.select(inside, value * dr.gather(self._types.Float, limb, ring), 0)
            for value, limb in zip(self._radiance, self._limb, strict=True)
        ]

    def arriving(self, points: Any, direction: Any, numbers: Stratified) -> list[Any]:
        """Radiance past the surfaces; see `deepclouds_runtime.lights.LightSource`."""
        seen = self._shade.visible(points, direction)
        return [dr.select(seen, value, 0) for value in self.radiance(direction)]


def discs(types: ModuleType, suns: Sequence[Sun], shade: Shade) -> list[Disc]:
    """The suns that have a size, as light sources."""
    return [Disc(types, sun, shade) for sun in suns if sun.radius > 0]


def background(types: ModuleType, backdrop: Any, suns: Sequence[Sun]) -> Callable[[Any], tuple[list[Any], Any]] | None:
    """What a camera sees behind everything.

    Parameters
    ----------
    types
        Dr.Jit types.
    backdrop
        Mitsuba's environment emitter, or None.
    suns
        of which those that are `shown` are seen.

    Returns
    -------
    Function of unit directions away from the eye: radiance, one array a colour channel, and whether there is something; None where there
    never is.
    """
    sky = None if backdrop is None else mitsuba_radiance(types, backdrop)
    seen = discs(types, [sun for sun in suns if sun.shown], Shade(types, None))
    if sky is None and not seen:
        return None

    def look(direction: Any) -> tuple[list[Any], Any]:
        colours = [types.Float(0) for _ in range(len(mitsuba().Spectrum()))] if sky is None else sky(direction)
        shown = types.Bool(sky is not None)
        for disc in seen:
            colours = [a + b for a, b in zip(colours, disc.radiance(direction), strict=True)]
            shown = shown | disc.holds(direction)
        return colours, shown

    return look


def looks_into(types: ModuleType, suns: Sequence[Sun], direction: Any) -> Any:
    """Whether unit directions meet the disc of a sun, shown by itself or with the backdrop; None where no sun has a size."""
    inside = None
    for disc in discs(types, suns, Shade(types, None)):
        inside = disc.holds(direction) if inside is None else inside | disc.holds(direction)
    return inside
