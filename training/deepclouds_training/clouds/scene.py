"""A volume as a scene that Mitsuba 3 loads, with its OpenVDB and `.vol` files beside it."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path

import numpy as np

from deepclouds.errors import InputError
from deepclouds.replacing import replacing
from deepclouds.volume import Volume

_SCENE = """<scene version="3.0.0">
  <default name="integrator" value="volpath"/>
  <default name="spp" value="64"/>
  <default name="size" value="256"/>
  <integrator type="$integrator">
    <integer name="max_depth" value="-1"/>
    <integer name="rr_depth" value="1000000"/>
  </integrator>
  <sensor type="perspective">
    <float name="fov" value="{fov}"/>
    <transform name="to_world"><lookat origin="{origin}" target="{target}" up="{up}"/></transform>
    <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
    <film type="hdrfilm">
      <integer name="width" value="$size"/>
      <integer name="height" value="$size"/>
      <string name="component_format" value="float32"/>
      <rfilter type="box"/>
    </film>
  </sensor>
  <emitter type="directional">
    <vector name="direction" value="{direction}"/>
    <rgb name="irradiance" value="{irradiance}"/>
  </emitter>
  <shape type="cube">
    <transform name="to_world"><matrix value="{cube}"/></transform>
    <bsdf type="null"/>
    <medium type="heterogeneous" name="interior">
      <rgb name="albedo" value="{albedo}"/>
      <float name="scale" value="{scale}"/>
      <volume type="gridvolume" name="sigma_t">
        <string name="filename" value="density.vol"/>
        <transform name="to_world"><matrix value="{grid}"/></transform>
      </volume>
      <phase type="hg"><float name="g" value="{g}"/></phase>
    </medium>
  </shape>
</scene>
"""


def scale_for_optical_depth(volume: Volume, optical_depth: float) -> float:
    """Extinction at density 1, per world unit, that gives the densest column along the grid's y axis this optical depth.

    For a box it is the optical depth from top to bottom.
    """
    if not (np.isfinite(optical_depth) and optical_depth > 0):
        raise InputError(f"optical depth = {optical_depth} makes no cloud; it takes a positive number")
    column = float(volume.density.sum(axis=1, dtype=np.float64).max()) * float(volume.voxel_size[1])
    if column == 0:
        raise InputError("the volume is empty: no extinction gives it an optical depth")
    return optical_depth / column


def write_mitsuba_scene(
    folder: str | PathLike[str],
    volume: Volume,
    *,
    scale: float = 40.0,
    albedo: float | Sequence[float] = 1.0,
    g: float = 0.85,
    omega_sun: Sequence[float] = (0.4, 0.7, 1.0),
    irradiance: float | Sequence[float] = 3.0,
    camera_origin: Sequence[float] | None = None,
    camera_target: Sequence[float] | None = None,
    fov: float = 32.0,
) -> Path:
    """Write `density.vdb`, `density.vol` and `scene.xml` into a folder, which is made where missing.

    The scene takes the parameters ``integrator``, ``spp`` and ``size`` (``mitsuba -Dspp=256 scene.xml``) and reads `density.vol`.

    Parameters
    ----------
    folder
        where the three files go; files of these names are replaced.
    volume
        the density.
    scale
        extinction at density 1, per world unit.
    albedo
        single-scattering albedo, one value or three (red, green, blue), 0 to 1.
    g
        mean cosine of the Henyey-Greenstein phase function, above -1 and below 1.
    omega_sun
        direction TOWARD the sun (x, y, z), any length but 0.
    irradiance
        of the sun, perpendicular to it: one value or three, not negative.
    camera_origin, camera_target
        eye and point looked at (x, y, z; world units). Without a target it is the middle of the box; without an origin the camera
        stands in front, on the side of +Z, where the box's bounding sphere fills the picture.
    fov
        horizontal field of view, in degrees, 1 to 170.

    Returns
    -------
    pathlib.Path
        the scene file.

    Raises
    ------
    InputError
        for a value outside its range, or a folder that cannot be made.
    """
    if not (np.isfinite(scale) and scale > 0):
        raise InputError(f"scale = {scale} makes no cloud; it takes a positive number")
    if not -1 < g < 1:
        raise InputError(f"g = {g} is no mean cosine of a phase function; it takes a number between -1 and 1")
    if not 1 <= fov <= 170:
        raise InputError(f"fov = {fov} is outside 1 to 170 degrees")
    sun = _three("omega_sun", omega_sun, -np.inf, np.inf)
    if np.linalg.norm(sun) == 0:
        raise InputError("omega_sun is the zero vector; it points toward the sun")
    lower, upper = volume.bounds
    target = (lower + upper) / 2 if camera_target is None else _three("camera_target", camera_target, -np.inf, np.inf)
    if camera_origin is None:
        away = np.linalg.norm(upper - lower) / 2 / np.sin(np.radians(fov) / 2)
        origin = target + away * np.array((-0.21, 0.05, 0.976))
    else:
        origin = _three("camera_origin", camera_origin, -np.inf, np.inf)
    gaze = target - origin
    if np.linalg.norm(gaze) == 0:
        raise InputError("camera_origin and camera_target are the same point")
    # Looking straight up or down, the world's Y cannot be the picture's up.
    steep = abs(gaze[1]) > 0.999 * np.linalg.norm(gaze)
    # Mitsuba's cube spans -1 to 1, a volume's box 0 to 1.
    to_unit = np.diag((0.5, 0.5, 0.5, 1.0))
    to_unit[:3, 3] = 0.5
    text = _SCENE.format(
        fov=float(fov),
        origin=_join(origin, ", "),
        target=_join(target, ", "),
        up="0, 0, -1" if steep else "0, 1, 0",
        direction=_join(-sun / np.linalg.norm(sun), ", "),
        irradiance=_join(_three("irradiance", irradiance, 0, np.inf)),
        cube=_join((volume.to_world @ to_unit).ravel()),
        albedo=_join(_three("albedo", albedo, 0, 1)),
        scale=repr(float(scale)),
        grid=_join(volume.to_world.ravel()),
        g=float(g),
    )
    place = Path(folder)
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{place} cannot be made a folder: {error.strerror}; choose another") from error
    # The OpenVDB side loads a native module, so it is imported only here.
    from deepclouds.volume.vdb import write_vdb
    from deepclouds.volume.vol import write_vol

    write_vdb(place / "density.vdb", volume, name="density")
    write_vol(place / "density.vol", volume)
    scene = place / "scene.xml"
    with replacing(scene) as temporary:
        temporary.write_text(text)
    return scene


def _three(name: str, value: float | Sequence[float], low: float, high: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    values = np.asarray(value, np.float64)
    if values.shape not in ((), (3,)) or not np.all(np.isfinite(values)):
        raise InputError(f"{name} = {value} is neither one nor three finite numbers")
    if np.any(values < low) or np.any(values > high):
        raise InputError(f"{name} = {value} is outside {low:g} to {high:g}")
    return np.array(np.broadcast_to(values, (3,)))


def _join(values: np.ndarray[tuple[int], np.dtype[np.float64]], separator: str = " ") -> str:
    return separator.join(repr(float(v)) for v in values)
