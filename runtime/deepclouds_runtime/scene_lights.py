"""The lights of a loaded Mitsuba scene: suns and the environment; refuses by name those we do not know."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from deepclouds.errors import InputError
from deepclouds_runtime._mitsuba import mitsuba
from deepclouds_runtime.sunsky import split

LIGHT_NAMES = "`directional`, `constant`, `envmap` and `sunsky`"
_ENVIRONMENTS = ("EnvironmentMapEmitter", "ConstantBackgroundEmitter")


@dataclass(frozen=True)
class Sun:
    """A distant light: unit vector `omega_sun` TOWARD it and its irradiance perpendicular to it, one value a colour channel."""

    omega_sun: tuple[float, float, float]
    irradiance: tuple[float, ...]


@dataclass(frozen=True)
class SceneLights:
    """The lights of a scene: suns, the environment without them, the emitter that the camera sees, and what was approximated."""

    suns: tuple[Sun, ...]
    environment: Any
    backdrop: Any
    notes: tuple[str, ...]


def read_lights(emitters: Iterable[Any]) -> SceneLights:
    """Tell the Mitsuba emitters of a scene apart; raises InputError for lights of other kinds."""
    mi = mitsuba()
    suns: list[Sun] = []
    notes: list[str] = []
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
                suns.append(Sun(parts.omega_sun, parts.irradiance))
                notes.append(f"the sunsky's disc of {parts.aperture:.3g} degrees lights from its middle: shadows have no penumbra")
        elif kind in _ENVIRONMENTS:
            environment = backdrop = emitter
        else:
            raise InputError(f"emitter '{emitter.id()}' ({kind}): the lights we know are {LIGHT_NAMES}")
    return SceneLights(tuple(suns), environment, backdrop, tuple(notes))
