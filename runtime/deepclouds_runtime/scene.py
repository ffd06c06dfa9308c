"""Reads a loaded Mitsuba scene: one cloud, its lights, the surfaces around it, and the camera; refuses by name what we cannot render."""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepclouds.errors import InputError
from deepclouds.volume import Volume
from deepclouds_runtime._mitsuba import mitsuba
from deepclouds_runtime.placement import box_transform, cube_transform, locate
from deepclouds_runtime.sunsky import split

_LOG = logging.getLogger(__name__)
_LOBES = ("HGPhaseFunction", "IsotropicPhaseFunction")
_PHASE_NAMES = "`hg`, `isotropic` and a `blendphase` of two of them"
_CAMERAS = ("PerspectiveCamera", "ThinLensCamera", "OrthographicCamera")
_LIGHT_NAMES = "`directional`, `constant`, `envmap` and `sunsky`"
_ENVIRONMENTS = ("EnvironmentMapEmitter", "ConstantBackgroundEmitter")
_UNLIMITED = 0xFFFFFFFF
# A homogeneous ball becomes a grid of this many voxels a side, each filled by the share of it that lies inside.
_BALL_VOXELS = 96
# A homogeneous cube is as exact with one voxel, but the network has learned what edges look like on grids of many.
_BOX_VOXELS = 32
# All channels of an image this large take 12 GB.
_MOST_PIXELS = 1 << 27


@dataclass(frozen=True)
class Sun:
    """A distant light: unit vector `omega_sun` TOWARD it and its irradiance perpendicular to it, one value a colour channel."""

    omega_sun: tuple[float, float, float]
    irradiance: tuple[float, ...]


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
        single-scattering albedo, one value a colour channel.
    phase
        phase function (g1, g2, weight), see `deepclouds.medium.phase`.
    suns
        directional lights.
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
        for everything outside of what we render: more or less than one cloud, chromatic extinction, varying albedo, phase functions other
        than `hg`, `isotropic` and a `blendphase` of two of them, emitters other than `directional`, `constant`, `envmap` and `sunsky`,
        cameras other than `perspective`, `thinlens` and `orthographic`, path lengths other than -1 and 2, surfaces that let light through,
        media outside of the cloud, images without pixels.
    """
    notes: list[str] = []
    camera = _camera(scene, sensor, notes)
    containers, surfaces = _split_shapes(scene)
    if len(containers) != 1:
        found = "no shape has an interior medium" if not containers else f"{len(containers)} shapes have an interior medium"
        raise InputError(f"{found}; deepclouds renders scenes with exactly one cloud: a shape with a null BSDF and a medium inside")
    _check_camera_medium(camera, containers[0])
    volume, scale, albedo, phase = _read_medium(containers[0])
    lights = read_lights(scene)
    notes.extend(lights.notes)
    integrator = scene.integrator()
    if max_depth is None:
        max_depth = _integrator_depth(integrator)
    if hide_emitters is None:
        hide_emitters = bool(getattr(integrator, "hide_emitters", False))
    return CloudScene(
        volume,
        scale,
        albedo,
        phase,
        lights.suns,
        lights.environment,
        surfaces_alone(surfaces),
        camera,
        hide_emitters,
        check_depth(max_depth),
        tuple(notes),
        lights.backdrop,
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


def _check_camera_medium(camera: Any, container: Any) -> None:
    medium = camera.get_medium()
    if medium is not None and medium is not container.interior_medium():
        raise InputError(f"sensor '{camera.id()}' stands in a medium other than the cloud; leave out the medium of the sensor")


def _split_shapes(scene: Any) -> tuple[list[Any], list[Any]]:
    """Containers (a medium inside, nothing to see outside) and surfaces; shapes that neither hold nor show anything are left out."""
    mi = mitsuba()
    containers, surfaces = [], []
    for shape in scene.shapes():
        name = f"shape '{shape.id()}' ({shape.class_name()})"
        bsdf = shape.bsdf()
        if shape.is_emitter():
            raise InputError(f"{name} is an area light; the lights we know are {_LIGHT_NAMES}")
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


@dataclass(frozen=True)
class SceneLights:
    """The lights of a scene: suns, the environment without them, the emitter that the camera sees, and what was approximated."""

    suns: tuple[Sun, ...]
    environment: Any
    backdrop: Any
    notes: tuple[str, ...]


def read_lights(scene: Any) -> SceneLights:
    """All lights of a Mitsuba scene; raises InputError for lights of other kinds."""
    mi = mitsuba()
    suns: list[Sun] = []
    notes: list[str] = []
    environment = backdrop = None
    for emitter in scene.emitters():
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
            raise InputError(f"emitter '{emitter.id()}' ({kind}): the lights we know are {_LIGHT_NAMES}")
    return SceneLights(tuple(suns), environment, backdrop, tuple(notes))


def _read_medium(container: Any) -> tuple[Volume, float, tuple[float, ...], tuple[float, float, float]]:
    mi = mitsuba()
    medium = container.interior_medium()
    kind = medium.class_name()
    if kind not in ("HeterogeneousMedium", "HomogeneousMedium"):
        raise InputError(f"medium {kind}: deepclouds renders `heterogeneous` and `homogeneous` media")
    phase = _read_phase(medium.phase_function())
    parameters = mi.traverse(medium)
    scale = float(np.ravel(parameters["scale"])[0]) if "scale" in parameters else 1.0
    if "sigma_t.data" in parameters:
        data = np.array(parameters["sigma_t.data"])
        if data.ndim == 4 and data.shape[3] != 1:
            raise InputError(f"the medium's grid has {data.shape[3]} channels: chromatic extinction; use one channel")
        density = np.ascontiguousarray(data.reshape(data.shape[:3]), np.float32)
        try:
            Volume.from_box(density, np.zeros(3), np.ones(3))
        except InputError as error:
            raise InputError(f"the medium's grid: {error}") from error
        volume = locate(density, scale, _grid_boxes(container, medium), lambda p: _coefficients(medium, p)[1])
        _check_cover(container, volume)
    else:
        volume, scale = _homogeneous(container, medium)
    return volume, scale, _read_albedo(medium, parameters, volume), phase


def _read_phase(phase: Any) -> tuple[float, float, float]:
    """Lobes (g1, g2, weight of the first) of a Mitsuba phase function."""
    kind = phase.class_name()
    parameters = mitsuba().traverse(phase)
    if kind in _LOBES:
        return _lobe(parameters, "g"), 0.0, 1.0
    if kind != "BlendPhaseFunction":
        raise InputError(f"phase function {kind}: deepclouds renders {_PHASE_NAMES}")
    # Mitsuba tells what is nested in a blend in its description alone.
    for nested in re.findall(r"nested_phase\[\d\] = (\w+)", str(phase)):
        if nested not in _LOBES:
            raise InputError(f"phase function {nested} in a blendphase: deepclouds renders {_PHASE_NAMES}")
    if "weight.value.value" not in parameters:
        raise InputError("a blendphase whose weight varies in space: deepclouds renders one phase function everywhere; give a number")
    # Mitsuba's weight is that of the second phase function.
    second = float(np.ravel(parameters["weight.value.value"])[0])
    if not 0 <= second <= 1:
        raise InputError(f"a blendphase with the weight {second:g}: weights lie in 0 to 1")
    return _lobe(parameters, "phase_0.g"), _lobe(parameters, "phase_1.g"), 1 - second


def _lobe(parameters: Any, name: str) -> float:
    """Parameter g of a lobe; an isotropic one has none."""
    return float(np.ravel(parameters[name])[0]) if name in parameters else 0.0


def _coefficients(medium: Any, points: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Scattering coefficient (n, channels) and extinction (n,) of a Mitsuba medium at world points (n, 3)."""
    mi = mitsuba()
    interaction = dr.zeros(mi.MediumInteraction3f, len(points))
    interaction.p = mi.Point3f(np.ascontiguousarray(points.T, np.float32))
    interaction.medium = mi.MediumPtr(medium)
    sigma_s, _, sigma_t = medium.get_scattering_coefficients(interaction)
    n = len(points)
    scattering, extinction = (np.stack([np.broadcast_to(np.array(v[c]), n) for c in range(len(v))], axis=-1) for v in (sigma_s, sigma_t))
    if np.ptp(extinction, axis=-1).max() > 1e-5 * np.abs(extinction).max():
        raise InputError("the medium's extinction differs between colours; use a grey sigma_t and put the colour into the albedo")
    return scattering, extinction[:, 0]


def _container_cube(container: Any) -> NDArray[np.float64] | None:
    if container.class_name() != "Cube":
        return None
    mi = mitsuba()
    vertices = [np.array(mi.traverse(shape)["vertex_positions"]).reshape(-1, 3) for shape in (container, mi.load_dict({"type": "cube"}))]
    return cube_transform(*vertices)


def _grid_boxes(container: Any, medium: Any) -> list[NDArray[np.float64]]:
    """Candidate boxes of the grid: the medium's own bounds, then the container's."""
    mi, boxes = mitsuba(), []
    bounds = container.bbox()
    lower, upper = np.array(bounds.min, np.float64), np.array(bounds.max, np.float64)
    # The medium tells its world-aligned bounds only to rays: one along each axis, through the middle of the container.
    reach, middle = 4 * float((upper - lower).max()), 0.5 * (lower + upper)
    low, high = np.zeros(3), np.zeros(3)
    for axis in range(3):
        origin, direction = middle.copy(), np.zeros(3)
        direction[axis] = 1
        origin[axis] -= reach
        hit, near, far = medium.intersect_aabb(mi.Ray3f(mi.Point3f(*origin.tolist()), mi.Vector3f(*direction.tolist())))
        if not bool(dr.all(hit)):
            break
        low[axis], high[axis] = origin[axis] + float(near[0]), origin[axis] + float(far[0])
    else:
        snapped_low = np.where(np.abs(low - lower) < 1e-5 * reach, lower, low)
        snapped_high = np.where(np.abs(high - upper) < 1e-5 * reach, upper, high)
        boxes.append(box_transform(snapped_low, snapped_high))
    cube = _container_cube(container)
    if cube is not None:
        boxes.append(cube)
    return boxes


def _check_cover(container: Any, volume: Volume) -> None:
    """The container must not cut the cloud: all filled voxels lie inside."""
    filled = np.argwhere(volume.density > 0)[:, ::-1]
    if not len(filled):
        return
    lowest, highest = filled.min(axis=0), filled.max(axis=0) + 1
    cube = _container_cube(container)
    if cube is not None:
        # A parallelepiped holds the voxels when it holds the corners of the box around them.
        corners = np.where(np.array(list(np.ndindex(2, 2, 2))) == 1, highest, lowest) / np.array(volume.resolution)
    else:
        corners = np.concatenate([filled + offset for offset in np.ndindex(2, 2, 2)]) / np.array(volume.resolution)
    world = corners @ volume.to_world[:3, :3].T + volume.to_world[:3, 3]
    extent = float(np.ptp(world, axis=0).max())
    if cube is not None:
        unit = (world - cube[:3, 3]) @ np.linalg.inv(cube[:3, :3]).T
        outside = np.any((unit < -1e-4) | (unit > 1 + 1e-4), axis=1)
    elif container.class_name() == "Sphere":
        center, radius = _ball(container)
        outside = np.linalg.norm(world - center, axis=1) > radius + 1e-4 * extent
    else:
        raise InputError(f"the cloud's container is a {container.class_name()}; use a `cube` (or a `sphere`) around the grid")
    if outside.any():
        raise InputError(
            f"the container ({container.class_name()}) cuts the cloud: {100 * outside.mean():.2g} % of its filled voxels reach outside; "
            "use a cube of the grid's size"
        )


def _ball(sphere: Any) -> tuple[NDArray[np.float64], float]:
    bounds = sphere.bbox()
    lower, upper = np.array(bounds.min, np.float64), np.array(bounds.max, np.float64)
    return 0.5 * (lower + upper), 0.5 * float((upper - lower).max())


def _homogeneous(container: Any, medium: Any) -> tuple[Volume, float]:
    """Fill the container's inside with a constant: a few voxels for a cube, an antialiased ball for a sphere."""
    bounds = container.bbox()
    middle = 0.5 * (np.array(bounds.min, np.float64) + np.array(bounds.max, np.float64))
    sigma_t = float(_coefficients(medium, middle[None])[1][0])
    cube = _container_cube(container)
    if cube is not None:
        return Volume(np.ones((_BOX_VOXELS,) * 3, np.float32), cube), sigma_t
    if container.class_name() == "Sphere":
        center, radius = _ball(container)
        n = _BALL_VOXELS
        # Distance of each voxel's centre from the surface, in voxels: a linear ramp one voxel wide is the share inside, nearly.
        c = (np.arange(n) + 0.5) / n * 2 - 1
        z, y, x = np.meshgrid(c, c, c, indexing="ij")
        share = np.clip(0.5 + (1 - np.sqrt(x * x + y * y + z * z)) * n / 2, 0, 1)
        return Volume.from_box(share.astype(np.float32), center - radius, center + radius), sigma_t
    raise InputError(f"a homogeneous medium in a {container.class_name()}: deepclouds fills a `cube` or a `sphere`")


def _read_albedo(medium: Any, parameters: Any, volume: Volume) -> tuple[float, ...]:
    names = [name for name in parameters.keys() if name.startswith("albedo")]
    if any(name.endswith(".data") for name in names):
        raise InputError("the medium's albedo varies in space (a gridvolume); use one colour")
    channels = len(mitsuba().Spectrum())
    for name in names:
        value = np.ravel(np.array(parameters[name])).astype(np.float64)
        if value.size in (1, channels):
            return tuple(float(v) for v in np.broadcast_to(value, channels))
    raise InputError("the medium's albedo has no constant value; use <rgb name='albedo' .../> or a float")
