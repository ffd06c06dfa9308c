"""Simple shapes: homogeneous or graded solids, hard or soft, for everything a scene may hold that is not a cloud."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deepclouds_training.clouds._noise import Array, smoothstep
from deepclouds_training.clouds._parameters import CloudParameters, Streams, choice, number
from deepclouds_training.clouds._raster import Field, Grid

SHAPES = (
    "full_box",
    "gradient_box",
    "sphere",
    "ellipsoid",
    "box",
    "slab",
    "cylinder",
    "torus",
    "two",
    "bright_voxel",
    "sheet",
    "voxel",
)


@dataclass(frozen=True, kw_only=True)
class ShapesParameters(CloudParameters):
    """Parameters of a simple shape."""

    shape: str = choice(SHAPES, "which one")
    height: float = number(0.03, 1.0, "second side over the longest one (ellipsoid, boxes, cylinder, ring of the torus)", log=True)
    depth: float = number(0.03, 1.0, "third side over the longest one (ellipsoid, boxes)", log=True)
    softness: float = number(0.0, 0.8, "width of the soft edge over half of the thinnest side", usual=0.0, usual_share=0.5)
    tilt: float = number(0.0, 90.0, "degrees of rotation about a random axis (not of boxes that fill the grid)", usual=0.0, usual_share=0.4)
    haze: float = number(0.01, 0.3, "density of the haze, or of the thin end of the gradient", log=True)
    voxels: int = number(1, 4, "thickness of the sheet in voxels, and how many single voxels there are", integer=True)
    curve: float = number(0.0, 1.0, "how far the sheet bends over its width", usual=0.0, usual_share=0.5)
    gap: float = number(0.5, 6.0, "distance between the middles of two bodies over the sum of their radii", log=True)


def _rotation(axis: Array, degrees: float) -> Array:
    """Rotation matrix about a unit axis (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.radians(degrees)
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross, np.float32)


def _solid(shape: str, p: tuple[Array, Array, Array], height: float, depth: float) -> Array:
    """Signed distance to a solid centred on the origin, negative inside; exact but for the ellipsoid, where it is first order."""
    x, y, z = p
    if shape == "sphere":
        return np.asarray(np.sqrt(x * x + y * y + z * z) - 1, np.float32)
    if shape == "ellipsoid":
        h, d = np.float32(height), np.float32(depth)
        k = np.sqrt(x**2 + (y / h) ** 2 + (z / d) ** 2)
        slope = np.sqrt(x**2 + (y / h**2) ** 2 + (z / d**2) ** 2)
        return np.asarray(k * (k - 1) / np.maximum(slope, np.float32(1e-6)), np.float32)
    if shape == "cylinder":
        a, b = np.sqrt(x * x + z * z) - np.float32(height), np.abs(y) - 1
        return _corner(a, b)
    if shape == "torus":
        ring = np.float32(0.15 + 0.25 * height)
        return np.asarray(np.hypot(np.hypot(x, z) - (1 - ring), y) - ring, np.float32)
    half = (1.0, 0.05 + 0.1 * height, 0.7 + 0.3 * depth) if shape == "slab" else (1.0, height, depth)
    a, b, c = (np.abs(v) - np.float32(s) for v, s in zip((x, y, z), half, strict=True))
    outside = np.sqrt(np.maximum(a, 0) ** 2 + np.maximum(b, 0) ** 2 + np.maximum(c, 0) ** 2)
    return np.asarray(outside + np.minimum(np.maximum(np.maximum(a, b), c), 0), np.float32)


def _corner(a: Array, b: Array) -> Array:
    return np.asarray(np.hypot(np.maximum(a, 0), np.maximum(b, 0)) + np.minimum(np.maximum(a, b), 0), np.float32)


def _thinnest(shape: str, height: float, depth: float) -> float:
    """Half of the thinnest side."""
    return {
        "sphere": 1.0,
        "ellipsoid": min(1.0, height, depth),
        "box": min(1.0, height, depth),
        "slab": 0.05 + 0.1 * height,
        "cylinder": min(1.0, height),
        "torus": 0.15 + 0.25 * height,
    }[shape]


def _half_sides(shape: str, height: float, depth: float) -> Array:
    """Half sides of the shape's own box."""
    return np.array(
        {
            "sphere": (1.0, 1.0, 1.0),
            "ellipsoid": (1.0, height, depth),
            "box": (1.0, height, depth),
            "slab": (1.0, 0.05 + 0.1 * height, 0.7 + 0.3 * depth),
            "cylinder": (height, 1.0, height),
            "torus": (1.0, 0.15 + 0.25 * height, 1.0),
        }[shape],
        np.float32,
    )


def build(parameters: ShapesParameters, streams: Streams) -> Field:
    """Density of a simple shape over space; its longest half side is 1."""
    rng = streams("placement")
    height, depth, haze = parameters.height, parameters.depth, parameters.haze
    fills = (True, True, True)
    if parameters.shape == "full_box":
        return Field((-1, -height, -depth), (1, height, depth), lambda grid: np.ones(grid.shape, np.float32), cut=fills)
    if parameters.shape == "gradient_box":
        direction = rng.standard_normal(3)
        direction /= np.abs(direction * (1, height, depth)).sum()

        def ramp(grid: Grid) -> Array:
            x, y, z = grid.open()
            s = np.float32(0.5) + np.float32(0.5) * sum(np.float32(d) * v for d, v in zip(direction, (x, y, z), strict=True))
            return np.asarray(np.float32(haze) + np.float32(1 - haze) * s, np.float32)

        return Field((-1, -height, -depth), (1, height, depth), ramp, cut=fills)
    if parameters.shape == "bright_voxel":
        place = rng.uniform(0.2, 0.8, 3)

        def speck(grid: Grid) -> Array:
            values = np.full(grid.shape, haze, np.float32)
            nz, ny, nx = grid.shape
            values[int(place[2] * nz), int(place[1] * ny), int(place[0] * nx)] = 1
            return values

        return Field((-1, -height, -depth), (1, height, depth), speck, cut=fills)
    if parameters.shape == "voxel":
        places = rng.random((parameters.voxels, 3))

        def lonely(grid: Grid) -> Array:
            values = np.zeros(grid.shape, np.float32)
            nz, ny, nx = grid.shape
            for px, py, pz in places:
                values[int(pz * nz), int(py * ny), int(px * nx)] = 1
            return values

        return Field((-1, -height, -depth), (1, height, depth), lonely, cut=fills, fewest=1)

    axis = rng.standard_normal(3)
    turn = _rotation(axis / np.linalg.norm(axis), parameters.tilt)
    if parameters.shape == "sheet":
        return _sheet(parameters, turn)
    if parameters.shape == "two":
        kinds = [("sphere", "ellipsoid", "box", "cylinder", "torus")[i] for i in rng.integers(5, size=2)]
        sizes = np.array([1.0, rng.uniform(0.3, 1.0)])
        away = rng.standard_normal(3)
        away *= parameters.gap * sizes.sum() / np.linalg.norm(away)
        levels = np.array([1.0, rng.uniform(0.2, 1.0)])
        centres = np.array([-away / 2, away / 2])
    else:
        kinds, sizes, levels, centres = [parameters.shape], np.ones(1), np.ones(1), np.zeros((1, 3))
    reaches = [np.abs(turn.T) @ _half_sides(k, height, depth) * s for k, s in zip(kinds, sizes, strict=True)]

    def solids(grid: Grid) -> Array:
        x, y, z = grid.open()
        out = np.zeros(grid.shape, np.float32)
        # A hard edge still blends over one voxel, so that the body's volume does not depend on where the samples fall.
        blend = float(np.mean(grid.spacing))
        for kind, size, level, centre in zip(kinds, sizes, levels, centres, strict=True):
            local = [v - np.float32(c) for v, c in zip((x, y, z), centre, strict=True)]
            px, py, pz = (sum(turn[i, a] * local[a] for a in range(3)) / np.float32(size) for i in range(3))
            inward = -_solid(kind, (px, py, pz), height, depth) * np.float32(size)
            width = parameters.softness * _thinnest(kind, height, depth) * size
            body = np.clip(inward / np.float32(blend) + np.float32(0.5), 0, 1) if width <= blend else smoothstep(0.0, width, inward)
            np.maximum(out, np.float32(level) * body, out=out)
        return out

    lower = np.min([c - r for c, r in zip(centres, reaches, strict=True)], axis=0)
    upper = np.max([c + r for c, r in zip(centres, reaches, strict=True)], axis=0)
    return Field(tuple(lower - 0.02), tuple(upper + 0.02), solids)


def _sheet(parameters: ShapesParameters, turn: Array) -> Field:
    """A square sheet, a few voxels thick whatever the resolution: flat or bent like a piece of pipe, upright or turned."""
    bend = np.float32(parameters.curve)

    def thin(grid: Grid) -> Array:
        x, y, z = grid.open()
        # The middle of an upright sheet falls on samples (or between them, for an even number), so that it is exactly that thick.
        k = len(grid.y) // 2
        centre = np.float32(grid.y[k]) if parameters.voxels % 2 else np.float32(0.5) * (grid.y[k - 1] + grid.y[k])
        px, py, pz = (turn[i, 0] * x + turn[i, 1] * (y - centre) + turn[i, 2] * z for i in range(3))
        off = np.abs(py - bend * (px**2 - np.float32(0.5))) / np.sqrt(1 + (2 * bend * px) ** 2)
        # The spacing across the sheet is that along its normal.
        across = np.float32(np.linalg.norm(grid.spacing * turn[1]))
        body = np.clip(np.float32(0.5 * parameters.voxels + 0.5) - off / across, 0, 1)
        return np.asarray(body * ((np.abs(px) <= 1) & (np.abs(pz) <= 1)), np.float32)

    # Four voxels of the coarsest grid are two thirds as thick as the sheet is wide.
    half = np.array([1.0, 0.5 * parameters.curve + 0.8, 1.0])
    reach = np.abs(turn.T) @ half
    return Field(tuple(-reach), tuple(reach), thin, averaged=False)
