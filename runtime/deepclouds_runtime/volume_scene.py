"""A scene around a volume from a file: camera framed on the cloud, a sun, a sky."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepclouds.errors import InputError
from deepclouds.volume import Volume
from deepclouds_runtime._mitsuba import mitsuba
from deepclouds_runtime.scene import CloudScene, check_depth, check_size
from deepclouds_runtime.scene_lights import disc_notes, read_lights

_FOV = 30.0
_MARGIN = 1.15
# Light and extinction beyond it come near float32's limit when they are multiplied.
_LARGEST = 1e15
_DEFAULT_OPTICAL_DEPTH = 60.0
_DEFAULT_G = 0.85
_DEFAULT_SUN = (100.0, 35.0)
# Wider, a sun is a sky.
_WIDEST_SUN = 90.0
# Distance of the disc that stands for it in Mitsuba, over the size of the cloud.
_FAR_DISC = 1e4
# What the camera sees begins and ends at so many distances of the cloud from it. Mitsuba puts both into kernels as constants: distances are
# rounded down to powers of `_ALIKE`, so that most views share their kernels.
_NEAR_CLIP, _FAR_CLIP, _ALIKE = 1e-4, 1e5, 16.0
# Thinner voxels do not push the camera away: a haze around a cloud is no part of the picture's subject.
_FRAMED = 0.01


@dataclass(frozen=True)
class VolumeOptions:
    """How a bare volume is lit and seen; angles in degrees.

    Parameters
    ----------
    optical_depth
        of the densest line along the longest axis of the grid's box; 60 when `extinction` is not given either.
    extinction
        extinction at density 1, 1 / world length; excludes `optical_depth`.
    albedo
        single-scattering albedo: one value, or one for R, G and B.
    g
        Henyey-Greenstein parameter; 0.85 when `phase` is not given either.
    phase
        two Henyey-Greenstein lobes and the weight of the first, ``weight HG(g1) + (1 - weight) HG(g2)``; excludes `g`.
    sun
        azimuth and elevation of the sun. With ``up = "y"`` azimuth 0 is +Z and grows toward +X; with ``up = "z"`` it is +X and grows
        toward +Y. By default (100, 35), or no sun when `env` is given.
    irradiance
        of the sun, perpendicular to it: one value or three.
    sun_diameter
        of the sun's disc as an angle; 0 for a sun without a size, 0.53 for the real one. The camera sees the disc.
    env
        an environment map (latitude-longitude, .exr or .hdr) that lights the cloud and stands behind it.
    sky
        radiance of a uniform sky, one value or three, without `env`.
    up
        the axis that points up, ``"y"`` or ``"z"``.
    view
        azimuth and elevation of the camera as seen from the cloud, measured like those of the sun.
    size
        width and height of the image in pixels.
    spp
        samples a pixel when a render does not say.
    hide_emitters
        black behind the cloud in place of the sky.
    max_depth
        -1 for all orders of scattering, 2 for single scattering alone.
    """

    optical_depth: float | None = None
    extinction: float | None = None
    albedo: tuple[float, ...] = (1.0,)
    g: float | None = None
    phase: tuple[float, float, float] | None = None
    sun: tuple[float, float] | None = None
    irradiance: tuple[float, ...] = (12.0,)
    sun_diameter: float = 0.0
    env: str | None = None
    sky: tuple[float, ...] = (0.09, 0.17, 0.34)
    up: str = "y"
    view: tuple[float, float] = (0.0, 5.0)
    size: tuple[int, int] = (640, 480)
    spp: int = 12
    hide_emitters: bool = False
    max_depth: int = -1


NAMES = tuple(f.name for f in fields(VolumeOptions))


def volume_scene(
    volume: Volume, options: VolumeOptions, source: str, corners: NDArray[np.float64] | None = None, turn: int = 1
) -> CloudScene:
    """Light `volume` and put a camera before it.

    Parameters
    ----------
    volume
        the density.
    options
        see `VolumeOptions`.
    source
        the file, for messages.
    corners
        (n, 3) world points that the camera frames, in place of the volume's own.
    turn
        views around the cloud, one full turn, that the camera's distance suits; with more than one it looks at `pivot`.

    Raises
    ------
    InputError
        for values outside of their range, a missing environment map, and an optical depth asked of an empty volume.
    """
    check(options)
    mi = mitsuba()
    scale = extinction(volume, options, source)
    try:
        # One by one: a scene around them would ask a GPU for its ray tracer.
        parts = {name: mi.load_dict(part) for name, part in description(volume, options, corners, turn).items() if name != "type"}
    except RuntimeError as error:
        if "envmap" in str(error):
            raise InputError(f"{options.env}: not an environment map that Mitsuba reads; give a latitude-longitude .exr or .hdr") from error
        raise InputError(f"{source}: Mitsuba cannot build the scene around it ({error})") from error
    camera = parts.pop("camera")
    lights = read_lights(parts.values())
    channels = len(mi.Spectrum())
    albedo = _three(options.albedo) if channels == 3 else (float(np.dot(_three(options.albedo), (0.2126, 0.7152, 0.0722))),)
    radius = math.radians(options.sun_diameter / 2)
    suns = tuple(dataclasses.replace(sun, radius=radius, shown=radius > 0) for sun in lights.suns)
    return CloudScene(
        volume,
        scale,
        albedo,
        lobes(options),
        suns,
        lights.environment,
        None,
        camera,
        options.hide_emitters,
        check_depth(options.max_depth),
        disc_notes(suns),
        backdrop=lights.backdrop,
    )


def description(volume: Volume, options: VolumeOptions, corners: NDArray[np.float64] | None = None, turn: int = 1) -> dict[str, Any]:
    """Camera and lights as a dictionary for ``mitsuba.load_dict``, in any variant; raises InputError for a missing environment map."""
    import mitsuba as mi

    scene: dict[str, Any] = {"type": "scene", "camera": _camera(framed_corners(volume) if corners is None else corners, options, turn)}
    sun = options.sun if options.sun is not None or options.env is not None else _DEFAULT_SUN
    if sun is not None and max(options.irradiance) > 0:
        scene["sun"] = {
            "type": "directional",
            "direction": (-_direction(sun, options.up)).tolist(),
            "irradiance": {"type": "rgb", "value": list(_three(options.irradiance))},
        }
    if options.env is not None:
        if not Path(options.env).is_file():
            raise InputError(f"{options.env}: no such environment map")
        # Mitsuba's maps have +Y up; a change of axes, x to y to z to x, stands them upright where +Z is up.
        axes = np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]], np.float64) if options.up == "z" else np.eye(4)
        stand = mi.ScalarTransform4f(axes.tolist())
        scene["sky"] = {"type": "envmap", "filename": options.env, "to_world": stand}
    elif max(options.sky) > 0:
        scene["sky"] = {"type": "constant", "radiance": {"type": "rgb", "value": list(_three(options.sky))}}
    return scene


def cloud_description(volume: Volume, options: VolumeOptions, source: str) -> dict[str, Any]:
    """The whole scene, cloud included, for Mitsuba's own integrators: what `volume_scene` renders, as a dictionary."""
    import mitsuba as mi

    unit = mi.ScalarTransform4f(volume.to_world.tolist())
    to_cube = mi.ScalarTransform4f().translate(0.5) @ mi.ScalarTransform4f().scale(0.5)
    medium = {
        "type": "heterogeneous",
        "albedo": {"type": "rgb", "value": list(_three(options.albedo))},
        "scale": extinction(volume, options, source),
        "sigma_t": {"type": "gridvolume", "grid": mi.VolumeGrid(np.ascontiguousarray(volume.density[..., None])), "to_world": unit},
        "phase": _phase_description(lobes(options)),
    }
    container = {"type": "cube", "to_world": unit @ to_cube, "bsdf": {"type": "null"}, "interior": medium}
    scene = description(volume, options)
    if options.sun_diameter > 0 and "sun" in scene:
        scene["sun"] = _far_disc(volume, options)
    return {
        **scene,
        "cloud": container,
        "integrator": {
            "type": "volpath",
            "max_depth": options.max_depth,
            "rr_depth": 1_000_000,
            "hide_emitters": options.hide_emitters,
        },
    }


def _far_disc(volume: Volume, options: VolumeOptions) -> dict[str, Any]:
    """The disc of the sun as an area light so far away that it lies in one direction: Mitsuba has no disc at infinity."""
    import mitsuba as mi

    sun = _DEFAULT_SUN if options.sun is None else options.sun
    corners = framed_corners(volume)
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    distance = _FAR_DISC * float(np.ptp(corners, axis=0).max())
    radius = math.radians(options.sun_diameter / 2)
    toward = _direction(sun, options.up)
    radiance = [value / (math.pi * math.sin(radius) ** 2) for value in _three(options.irradiance)]
    look = mi.ScalarTransform4f().look_at(
        origin=(middle + distance * toward).tolist(),
        target=middle.tolist(),
        up=_axes(options.up)[int(abs(toward @ _axes(options.up)[2]) < 0.9) * 2].tolist(),
    )
    return {
        "type": "disk",
        "to_world": look @ mi.ScalarTransform4f().scale(distance * math.tan(radius)),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance}},
    }


def lobes(options: VolumeOptions) -> tuple[float, float, float]:
    """Phase function (g1, g2, weight) that the options ask for."""
    if options.phase is not None:
        return options.phase
    return (_DEFAULT_G if options.g is None else options.g), 0.0, 1.0


def _phase_description(phase: tuple[float, float, float]) -> dict[str, Any]:
    first, second = ({"type": "hg", "g": g} for g in phase[:2])
    # Mitsuba's weight is that of the second phase function.
    return first if phase[2] == 1 else {"type": "blendphase", "weight": 1 - phase[2], "first": first, "second": second}


def _three(values: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(float(v) for v in (values * 3 if len(values) == 1 else values))


def check(options: VolumeOptions) -> None:
    """Refuse, by InputError, what is out of range or contradicts itself."""

    def refuse(name: str, remedy: str) -> None:
        raise InputError(f"{name} = {getattr(options, name)}: {remedy}")

    for name in ("albedo", "irradiance", "sky"):
        values = getattr(options, name)
        if len(values) not in (1, 3) or not np.all(np.isfinite(values)) or min(values) < 0:
            refuse(name, "give one or three finite numbers that are not negative")
        if max(values) > _LARGEST:
            refuse(name, f"give values of at most {_LARGEST:g}; larger ones overflow in the image")
    if max(options.albedo) > 1:
        refuse("albedo", "values lie in 0 to 1")
    if options.g is not None and options.phase is not None:
        raise InputError("g and phase are both given: each is the phase function; leave one out")
    if options.g is not None and not -1 < options.g < 1:
        refuse("g", "give a value between -1 and 1, both excluded")
    if options.phase is not None and not (
        len(options.phase) == 3 and -1 < options.phase[0] < 1 and -1 < options.phase[1] < 1 and 0 <= options.phase[2] <= 1
    ):
        refuse("phase", "give g1 and g2 between -1 and 1, both excluded, and a weight of the first in 0 to 1")
    if options.up not in ("y", "z"):
        refuse("up", "choose 'y' or 'z'")
    if not 0 <= options.sun_diameter <= _WIDEST_SUN:
        refuse("sun_diameter", f"give an angle of 0 to {_WIDEST_SUN:g} degrees; the real sun has 0.53")
    for name in ("optical_depth", "extinction"):
        value = getattr(options, name)
        if value is not None and not (np.isfinite(value) and value >= 0):
            refuse(name, "give a finite number that is not negative")
    if options.optical_depth is not None and options.optical_depth > _LARGEST:
        refuse("optical_depth", f"give at most {_LARGEST:g}")
    if options.optical_depth is not None and options.extinction is not None:
        raise InputError("optical_depth and extinction are both given: each sets the density's scale; leave one out")
    if len(options.size) != 2 or min(options.size) < 1:
        refuse("size", "give width and height of at least one pixel")
    check_size(*options.size)
    for name in ("sun", "view"):
        value = getattr(options, name)
        if value is not None and (len(value) != 2 or not np.all(np.isfinite(value))):
            refuse(name, "give azimuth and elevation in degrees")
        if value is not None and abs(value[1]) > 90:
            refuse(name, "the elevation lies between -90 and 90 degrees; turn the azimuth by 180 to look from the other side")


def extinction(volume: Volume, options: VolumeOptions, source: str) -> float:
    """Extinction at density 1, 1 / world length, that the options ask for."""
    if options.extinction is not None:
        thickest = options.extinction * float(volume.stored.max(initial=0))
        if thickest > _LARGEST:
            raise InputError(f"extinction = {options.extinction:g}: the densest voxel gets {thickest:g}; it may have {_LARGEST:g} at most")
        return options.extinction
    depth = _DEFAULT_OPTICAL_DEPTH if options.optical_depth is None else options.optical_depth
    edges = volume.voxel_size
    axis = int(np.argmax(edges * volume.resolution))
    line = float(volume.sums(2 - axis).max() * edges[axis])
    if line == 0:
        if options.optical_depth is None:
            return 0.0
        raise InputError(f"{source}: the volume is empty, so no extinction gives it an optical depth of {depth:g}")
    return depth / line


def _axes(up: str) -> NDArray[np.float64]:
    """Rows: the directions of azimuth 0, of azimuth 90 degrees, and up."""
    return np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]] if up == "y" else [[1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float64)


def _direction(angles: tuple[float, float], up: str) -> NDArray[np.float64]:
    """Unit vector toward azimuth and elevation, degrees."""
    azimuth, elevation = np.deg2rad(angles)
    components = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    vector: NDArray[np.float64] = components @ _axes(up)
    return vector


def pivot(corners: NDArray[np.float64], up: str) -> NDArray[np.float64]:
    """World point (3,) that a camera looks at that goes round what fills `corners` (n, 3): the middle of the box along the axes."""
    axes = _axes(up)
    along = corners @ axes.T
    middle: NDArray[np.float64] = 0.5 * (along.min(axis=0) + along.max(axis=0)) @ axes
    return middle


def _basis(view: tuple[float, float], up: str) -> NDArray[np.float64]:
    """Rows: to the right, upward in the picture, and away from the camera."""
    toward = _direction(view, up)
    vertical = _axes(up)[2]
    if abs(vertical @ toward) > 0.9999:
        vertical = _axes(up)[0]
    right = np.cross(-toward, vertical)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(right, -toward), -toward])


def _distance(relative: NDArray[np.float64], basis: NDArray[np.float64], size: tuple[int, int]) -> float:
    """Distance from which all places (n, 3), relative to what the camera looks at, are in the picture."""
    width, height = size
    tangent = np.tan(np.deg2rad(_FOV / 2))
    # Mitsuba's fov spans the larger side with fov_axis = larger.
    tan_x, tan_y = tangent * width / max(width, height), tangent * height / max(width, height)
    x, y, z = basis @ relative.T
    return float((_MARGIN * np.maximum(np.abs(x) / tan_x, np.abs(y) / tan_y) - z).max())


def _camera(corners: NDArray[np.float64], options: VolumeOptions, turn: int) -> dict[str, Any]:
    """Perspective camera as near as the world points `corners` (n, 3) allow, in each of `turn` views around them."""
    import mitsuba as mi

    azimuth, elevation = options.view
    basis = _basis(options.view, options.up)
    if turn > 1:
        middle = pivot(corners, options.up)
        views = [_basis((azimuth + 360 * k / turn, elevation), options.up) for k in range(turn)]
    else:
        # In the middle of what the picture shows, which is seldom that of the box.
        along = corners @ basis.T
        middle = 0.5 * (along.min(axis=0) + along.max(axis=0)) @ basis
        views = [basis]
    distance = max(_distance(corners - middle, view, options.size) for view in views)
    rounded = _ALIKE ** math.floor(math.log(distance, _ALIKE))
    width, height = options.size
    film = {
        "type": "hdrfilm",
        "width": int(width),
        "height": int(height),
        "rfilter": {"type": "box"},
        "component_format": "float32",
    }
    return {
        "type": "perspective",
        "fov": _FOV,
        "fov_axis": "larger",
        "near_clip": _NEAR_CLIP * rounded,
        "far_clip": _FAR_CLIP * _ALIKE * rounded,
        "to_world": mi.ScalarTransform4f().look_at(
            origin=(middle - basis[2] * distance).tolist(), target=middle.tolist(), up=basis[1].tolist()
        ),
        "film": film,
        "sampler": {"type": "independent", "sample_count": int(options.spp)},
    }


def framed_corners(volume: Volume) -> NDArray[np.float64]:
    """World corners (n, 3) of the voxels at the ends of each row along x that holds something; of the box when all are empty."""
    rows, first, last = volume.row_ends(_FRAMED * volume.stored.max(initial=0))
    if len(rows):
        ends = np.concatenate([np.column_stack([x, rows[:, 1], rows[:, 0]]) for x in (first, last + 1)]).astype(np.float64)
        grid = np.concatenate([ends + np.array([0, dy, dz]) for dy, dz in np.ndindex(2, 2)])
    else:
        grid = np.array(list(np.ndindex(2, 2, 2))) * np.array(volume.resolution, np.float64)
    unit = grid / np.array(volume.resolution)
    corners: NDArray[np.float64] = unit @ volume.to_world[:3, :3].T + volume.to_world[:3, 3]
    return corners


def options_from(given: dict[str, Any]) -> VolumeOptions:
    """Build options from keyword arguments, accepting single numbers where tuples stand.

    Raises
    ------
    InputError
        for an unknown name, and for names that exclude each other.
    """
    unknown = sorted(set(given) - set(NAMES))
    if unknown == ["sensor"]:
        raise InputError("the option 'sensor' belongs to a scene; a volume has one camera, which `view` places")
    if unknown:
        raise InputError(f"unknown option '{unknown[0]}' for a volume; there are: {', '.join(NAMES)}")
    if "env" in given:
        if "sky" in given:
            raise InputError("env and sky are both given: the map is the sky; leave one out")
        for name in ("irradiance", "sun_diameter"):
            if name in given and "sun" not in given:
                raise InputError(f"{name} = {given[name]}: with an environment map there is no sun unless sun says where; add it")
    values = dict(given)
    for name in ("albedo", "irradiance", "sky"):
        if name in values:
            values[name] = tuple(np.atleast_1d(np.asarray(values[name], np.float64)).tolist())
    return dataclasses.replace(VolumeOptions(), **values)
