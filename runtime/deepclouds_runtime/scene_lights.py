"""The lights of a loaded Mitsuba scene: suns and the environment; refuses by name those we do not know."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from deepclouds.errors import InputError
from deepclouds_runtime._mitsuba import mitsuba
from deepclouds_runtime.sunsky import split

LIGHT_NAMES = "`directional`, `constant`, `envmap` and `sunsky`"
# Radians from which the middle of a disc stands for the whole less well than a network predicts: docs/rendering.md has measurements.
_WIDE = math.radians(2.51)
_ENVIRONMENTS = ("EnvironmentMapEmitter", "ConstantBackgroundEmitter")


@dataclass(frozen=True)
class Sun:
    """A distant light.

    Parameters
    ----------
    omega_sun
        unit vector TOWARD it, of a disc toward the middle.
    irradiance
        perpendicular to `omega_sun`, one value a colour channel.
    radius
        of its disc as an angle, radians; 0 for a point.
    limb
        radiance of a disc over its mean, a row for each of its rings of equal solid angle from the middle out, a value a colour channel; a
        disc without rows is even.
    shown
        whether the camera sees its disc beside the backdrop.
    """

    omega_sun: tuple[float, float, float]
    irradiance: tuple[float, ...]
    radius: float = 0.0
    limb: tuple[tuple[float, ...], ...] = ()
    shown: bool = False


def disc_notes(suns: Iterable[Sun]) -> tuple[str, ...]:
    """What is approximated for suns whose discs are wide, in sentences."""
    return tuple(
        f"the sun's disc of {math.degrees(2 * sun.radius):.3g} degrees is wide: in the fast mode multiple scattering sees its middle alone"
        for sun in suns
        if sun.radius > _WIDE
    )


@dataclass(frozen=True)
class SceneLights:
    """The lights of a scene: suns, the environment without them, and the emitter that the camera sees."""

    suns: tuple[Sun, ...]
    environment: Any
    backdrop: Any


def read_lights(emitters: Iterable[Any]) -> SceneLights:
    """Tell the Mitsuba emitters of a scene apart; raises InputError for lights of other kinds."""
    mi = mitsuba()
    suns: list[Sun] = []
    environment = backdrop = None
    for emitter in emitters:
        kind = emitter.class_name()
        if kind == "DirectionalEmitter":
            sample, irradiance = emitter.sample_direction(dr.zeros(mi.Interaction3f), mi.Point2f(0.5))
            x, y, z = (float(sample.d[c][0]) for c in range(3))
            suns.append(Sun((x, y, z), tuple(float(irradiance[c][0]) for c in range(len(irradiance)))))
        elif kind == "SunskyEmitter":
            parts = split(emitter)
            environment, backdrop = parts.sky, emitter
            if max(parts.irradiance) > 0:
                suns.append(Sun(parts.omega_sun, parts.irradiance, math.radians(parts.aperture / 2), parts.limb))
        elif kind in _ENVIRONMENTS:
            environment = backdrop = emitter
        else:
            raise InputError(f"emitter '{emitter.id()}' ({kind}): the lights we know are {LIGHT_NAMES}")
    return SceneLights(tuple(suns), environment, backdrop)
