"""The medium in a shape of a loaded Mitsuba scene, as a grid of densities; refuses by name what we cannot render."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepclouds.errors import InputError
from deepclouds.medium.albedo import AlbedoGrid
from deepclouds.volume import Volume
from deepclouds_runtime._mitsuba import mitsuba
from deepclouds_runtime.placement import box_transform, cube_transform, locate, locate_albedo

_LOBES = ("HGPhaseFunction", "IsotropicPhaseFunction")
_PHASE_NAMES = "`hg`, `isotropic` and a `blendphase` of two of them"
# A homogeneous ball becomes a grid of this many voxels a side, each filled by the share of it that lies inside.
_BALL_VOXELS = 96
# A homogeneous cube is as exact with one voxel, but the network has learned what edges look like on grids of many.
_BOX_VOXELS = 32


@dataclass(frozen=True)
class Medium:
    """A medium: density and its place, extinction per unit of density, albedo of each colour channel, phase function (g1, g2, weight).

    Where the albedo varies in space, `varying` is it, and `albedo` its largest values.
    """

    volume: Volume
    scale: float
    albedo: tuple[float, ...]
    phase: tuple[float, float, float]
    varying: AlbedoGrid | None = None


def read_medium(container: Any) -> Medium:
    """Medium inside a Mitsuba shape; raises InputError for media, phase functions, albedos and containers that we do not know."""
    mi = mitsuba()
    medium = container.interior_medium()
    kind = medium.class_name()
    if kind not in ("HeterogeneousMedium", "HomogeneousMedium"):
        raise InputError(f"medium {kind}: deepclouds renders `heterogeneous` and `homogeneous` media")
    phase = _read_phase(medium.phase_function())
    parameters = mi.traverse(medium)
    check_dark(parameters.keys())
    scale = float(np.ravel(parameters["scale"])[0]) if "scale" in parameters else 1.0
    _check_range("scale", [scale])
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
        if "sigma_t.value.value" in parameters:
            _check_range("sigma_t", np.ravel(np.array(parameters["sigma_t.value.value"])).tolist())
        volume, scale = _homogeneous(container, medium)
    if "albedo.data" in parameters:
        varying = _varying_albedo(container, medium, np.array(parameters["albedo.data"]), volume)
        return Medium(volume, scale, varying.largest, phase, varying)
    return Medium(volume, scale, _read_albedo(parameters), phase)


def _check_range(name: str, values: Sequence[float], most: float = math.inf) -> None:
    """Refuse, by InputError, values of a medium's parameter that are no numbers from 0 to `most`."""
    if not all(math.isfinite(value) and 0 <= value <= most for value in values):
        remedy = "a finite number that is not negative" if math.isinf(most) else f"values in 0 to {most:g}"
        raise InputError(f"the medium's {name} = {', '.join(f'{value:g}' for value in values)}: give {remedy}")


def check_dark(names: Iterable[str]) -> None:
    """Refuse, by InputError, a medium that gives off light, by the names of its parameters. Mitsuba 3.9 itself does not load one yet."""
    light = [name for name in names if name.startswith("emission")]
    if light:
        raise InputError(f"the medium gives off light ('{light[0]}'), which deepclouds does not render; leave its emission out")


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


def _varying_albedo(container: Any, medium: Any, data: NDArray[Any], volume: Volume) -> AlbedoGrid:
    """The albedo's grid, in the place where the medium itself has it."""
    channels = len(mitsuba().Spectrum())
    values = np.ascontiguousarray(data.reshape(*data.shape[:3], -1), np.float32)
    if values.shape[3] not in (1, channels):
        raise InputError(f"the albedo's grid has {values.shape[3]} channels: give 1 or {channels}")
    values = np.broadcast_to(values, (*values.shape[:3], channels))

    def albedo(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        scattering, extinction = _coefficients(medium, points)
        filled = extinction > 0
        return scattering / np.where(filled, extinction, 1)[:, None], filled

    return locate_albedo(values, [volume.to_world, *_grid_boxes(container, medium)], volume, albedo)


def _read_albedo(parameters: Any) -> tuple[float, ...]:
    names = [name for name in parameters.keys() if name.startswith("albedo")]
    channels = len(mitsuba().Spectrum())
    for name in names:
        value = np.ravel(np.array(parameters[name])).astype(np.float64)
        if value.size in (1, channels):
            _check_range("albedo", value.tolist(), 1)
            return tuple(float(v) for v in np.broadcast_to(value, channels))
    raise InputError("the medium's albedo has no constant value; use <rgb name='albedo' .../> or a float")
