"""Reads a loaded Mitsuba scene: its clouds, their lights, the surfaces around it, and the camera; refuses by name what we cannot render."""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass, field
from typing import Any

from deepclouds.errors import InputError
from deepclouds.medium.albedo import AlbedoGrid
from deepclouds.volume import Volume
from deepclouds_runtime._mitsuba import mitsuba
from deepclouds_runtime.merging import merged
from deepclouds_runtime.scene_lights import LIGHT_NAMES, Sun, disc_notes, read_lights
from deepclouds_runtime.scene_medium import read_medium

_LOG = logging.getLogger(__name__)
_CAMERAS = ("PerspectiveCamera", "ThinLensCamera", "OrthographicCamera")
_UNLIMITED = 0xFFFFFFFF
# All channels of an image this large take 12 GB.
_MOST_PIXELS = 1 << 27


@dataclass(frozen=True)
class CloudScene:
    """What the light transport needs of a scene.

    Parameters
    ----------
    volume
        density and its place.
    scale
        extinction per unit of density, 1 / world length.
    albedo
        single-scattering albedo, one value a colour channel; the largest ones, where it varies in space.
    phase
        phase function (g1, g2, weight), see `deepclouds.medium.phase`.
    suns
        distant lights, points and discs.
    environment
        Mitsuba's `envmap`, `constant` or (without its sun) `sunsky` emitter that lights the scene, or None.
    surfaces
        Mitsuba scene of the real surfaces alone, without the containers of the medium; None when there are none.
    sensor
        the Mitsuba camera.
    hide_emitters
        whether the camera sees black in place of the environment.
    max_depth
        -1 for all orders of scattering, 2 for single scattering alone.
    notes
        what was approximated in reading, in sentences.
    backdrop
        the environment emitter that the camera sees, or None.
    varying
        the albedo, where it varies in space, or None.
    """

    volume: Volume
    scale: float
    albedo: tuple[float, ...]
    phase: tuple[float, float, float]
    suns: tuple[Sun, ...]
    environment: Any
    surfaces: Any
    sensor: Any
    hide_emitters: bool = False
    max_depth: int = -1
    notes: tuple[str, ...] = field(default=())
    backdrop: Any = None
    varying: AlbedoGrid | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image in pixels: those of the film's crop window."""
        width, height = self.sensor.film().crop_size()
        return int(width), int(height)


def read_scene(scene: Any, sensor: Any = 0, max_depth: int | None = None, hide_emitters: bool | None = None) -> CloudScene:
    """Read a Mitsuba scene that was loaded in one of our variants.

    Parameters
    ----------
    scene
        ``mitsuba.Scene``.
    sensor
        index of the camera, or the camera itself.
    max_depth, hide_emitters
        override those of the scene's own integrator.

    Raises
    ------
    InputError
        for everything outside of what we render: no cloud, several of different albedo or phase function or of varying albedo, chromatic
        extinction, phase functions other than `hg`, `isotropic` and a `blendphase` of two of them, emitters other than `directional`,
        `constant`, `envmap` and `sunsky`, cameras other than `perspective`, `thinlens` and `orthographic`, path lengths other than -1
        and 2, surfaces that let light through, media outside of the clouds, images without pixels.
    """
    notes: list[str] = []
    camera = _camera(scene, sensor, notes)
    containers, surfaces = _split_shapes(scene)
    if not containers:
        raise InputError("no shape has an interior medium; deepclouds renders clouds: shapes with a null BSDF and a medium inside")
    _check_camera_medium(camera, containers)
    media = [read_medium(container) for container in containers]
    medium = media[0] if len(media) == 1 else merged(media, notes)
    lights = read_lights(scene.emitters())
    notes.extend(disc_notes(lights.suns))
    integrator = scene.integrator()
    if max_depth is None:
        max_depth = _integrator_depth(integrator)
    if hide_emitters is None:
        hide_emitters = bool(getattr(integrator, "hide_emitters", False))
    return CloudScene(
        medium.volume,
        medium.scale,
        medium.albedo,
        medium.phase,
        lights.suns,
        lights.environment,
        surfaces_alone(surfaces),
        camera,
        hide_emitters,
        check_depth(max_depth),
        tuple(notes),
        lights.backdrop,
        medium.varying,
    )


def check_size(width: int, height: int) -> None:
    """Refuse, by InputError, an image without pixels and one that would not fit into memory."""
    if width < 1 or height < 1:
        raise InputError(f"an image of {width} x {height} pixels: it needs at least one pixel each way")
    if width * height > _MOST_PIXELS:
        raise InputError(f"an image of {width} x {height} pixels: at most {_MOST_PIXELS:,} fit; choose a smaller size")


def check_depth(max_depth: int) -> int:
    """Return -1 (all orders) or 2 (single scattering), the two path lengths we render; raises InputError for others."""
    depth = -1 if max_depth == _UNLIMITED else int(max_depth)
    if depth not in (-1, 2):
        raise InputError(f"max_depth = {depth}: deepclouds renders all orders of scattering (-1) or single scattering alone (2)")
    return depth


def _integrator_depth(integrator: Any) -> int:
    if integrator is None:
        return -1
    depth = getattr(integrator, "max_depth", None)
    if depth is None:
        match = re.search(r"max_depth = (\d+)", str(integrator))
        depth = int(match.group(1)) if match else -1
    return int(depth)


def _camera(scene: Any, sensor: Any, notes: list[str]) -> Any:
    if isinstance(sensor, int):
        sensors = scene.sensors()
        if not 0 <= sensor < len(sensors):
            raise InputError(f"sensor {sensor}: the scene has {len(sensors)} sensors, counted from 0")
        sensor = sensors[sensor]
    if sensor.class_name() not in _CAMERAS:
        raise InputError(f"sensor {sensor.class_name()}: deepclouds renders the sensors `perspective`, `thinlens` and `orthographic`")
    film = sensor.film()
    check_size(*(int(n) for n in film.crop_size()))
    if film.class_name() != "HDRFilm":
        raise InputError(f"film {film.class_name()}: deepclouds renders into `hdrfilm` only")
    if film.rfilter().class_name() != "BoxFilter":
        notes.append(f"the pixel filter {film.rfilter().class_name()} is replaced by a box")
        _LOG.info(notes[-1])
    return sensor


def _check_camera_medium(camera: Any, containers: list[Any]) -> None:
    medium = camera.get_medium()
    if medium is not None and all(medium is not container.interior_medium() for container in containers):
        raise InputError(f"sensor '{camera.id()}' stands in a medium other than the cloud; leave out the medium of the sensor")


def _split_shapes(scene: Any) -> tuple[list[Any], list[Any]]:
    """Containers (a medium inside, nothing to see outside) and surfaces; shapes that neither hold nor show anything are left out."""
    mi = mitsuba()
    containers, surfaces = [], []
    for shape in scene.shapes():
        name = f"shape '{shape.id()}' ({shape.class_name()})"
        bsdf = shape.bsdf()
        if shape.is_emitter():
            raise InputError(f"{name} is an area light; the lights we know are {LIGHT_NAMES}")
        if shape.exterior_medium() is not None:
            raise InputError(f"{name} has a medium outside; deepclouds renders one cloud in empty space: leave out its `exterior`")
        null = bsdf is None or bsdf.class_name() == "Null"
        if shape.interior_medium() is not None:
            if not null:
                raise InputError(
                    f"{name} has a medium inside and the BSDF {bsdf.class_name()}; the cloud's container needs the BSDF `null`"
                )
            containers.append(shape)
        elif null:
            continue
        else:
            flags = bsdf.flags()
            if mi.has_flag(flags, mi.BSDFFlags.Null) or mi.has_flag(flags, mi.BSDFFlags.Transmission):
                raise InputError(
                    f"{name} has the BSDF {bsdf.class_name()}, which lets light through; surfaces around the cloud must be opaque"
                )
            surfaces.append(shape)
    return containers, surfaces


def surfaces_alone(surfaces: list[Any]) -> Any:
    """Mitsuba scene of `surfaces`, or None without any: rays in it do not meet the medium's container."""
    if not surfaces:
        return None
    return mitsuba().load_dict({"type": "scene", **{f"surface{i}": shape for i, shape in enumerate(surfaces)}})
