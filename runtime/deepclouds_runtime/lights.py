"""Environments as light sources: directions drawn in proportion to what arrives from them, weighted exactly."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from types import ModuleType
from typing import Any, Protocol

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepclouds.backend import lanes_of, vectors_of
from deepclouds_runtime._mitsuba import channels, mitsuba, plain
from deepclouds_runtime.stratified import Stratified

# Cells of the table never drawn would bias the image where the table misses a light between its samples.
_UNIFORM_SHARE = 0.02
_MAX_WIDTH = 2048
# Rows and columns for a sky that is a formula: it is smooth.
_SKY = (64, 128)
# A uniform environment is a grid too, for the directions that stand for it.
_UNIFORM_ROWS = 16
# How much the size of a part of the sky counts beside its light when it is split: with 0 one dark half could stay whole.
_PART_SIZE = 0.5
# Most directions that stand for what is bright of an environment, and how close, in degrees, they are one.
_MOST_BRIGHT, _TOGETHER = 24, 15.0
_LUMINANCE = (0.2126, 0.7152, 0.0722)
# Surfaces that are closer to a box than this share of its diagonal are taken to lie inside of it.
_CLOSE = 0.01


class LightSource(Protocol):
    """Light from many directions, one of which is drawn at a time."""

    def sample(self, u: Any, v: Any) -> tuple[Any, Any]:
        """Directions TOWARD the light and their densities per steradian, from numbers in [0, 1)."""
        ...

    def density(self, direction: Any) -> Any:
        """Density per steradian with which `sample` draws these directions."""
        ...

    def beams(self, count: int) -> list[Beam]:
        """About `count` directions that stand for all of the light, each for about the same share of it."""
        ...

    def arriving_beam(self, points: Any, beam: Beam, numbers: Stratified) -> list[Any]:
        """Irradiance, perpendicular to its direction, that a beam brings to `points`; one array a colour channel."""
        ...

    def arriving(self, points: Any, direction: Any, numbers: Stratified) -> list[Any]:
        """Radiance that arrives at `points` from `direction` where there is no cloud; one array a colour channel."""
        ...

    def reach(self, points: Any, direction: Any) -> Any:
        """Distance (Float) to where this light comes from, infinite beyond the cloud: so much of the cloud it goes through."""
        ...


@dataclass(frozen=True)
class Beam:
    """Light from a part of the sphere, seen as coming from one direction.

    Attributes
    ----------
    omega
        unit vector TOWARD it.
    solid_angle
        of the part, as far as it is not black, steradians.
    irradiance
        perpendicular to `omega`, one value a colour channel.
    """

    omega: tuple[float, float, float]
    solid_angle: float
    irradiance: tuple[float, ...]


class Shade:
    """What the opaque surfaces of a scene keep away.

    Parameters
    ----------
    types
        Dr.Jit types.
    surfaces
        Mitsuba scene of the surfaces alone, or None.
    bounds
        lower and upper corner (3,) of the cloud's box, world.

    Attributes
    ----------
    inside
        whether a surface may lie inside of that box, or touch it.
    """

    def __init__(self, types: ModuleType, surfaces: Any, bounds: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None) -> None:
        self.types, self.surfaces = types, surfaces
        self.inside = surfaces is not None and bounds is not None and any(_meets(shape.bbox(), *bounds) for shape in surfaces.shapes())

    def visible(self, points: Any, directions: Any) -> Any:
        """Whether no surface stands between the points and what lies in these directions."""
        if self.surfaces is None:
            return self.types.Bool(True)
        mi = mitsuba()
        return ~plain(self.types, self.surfaces.ray_test(mi.Ray3f(mi.Point3f(points), mi.Vector3f(directions))))

    def reach(self, points: Any, directions: Any, active: Any = True) -> Any:
        """Distance (Float) from the points to the first surface in these directions, infinite where there is none."""
        if self.surfaces is None:
            return self.types.Float(math.inf)
        mi = mitsuba()
        hit = self.surfaces.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(points), mi.Vector3f(directions)), active=mi.Mask(active))
        return dr.select(plain(self.types, hit.is_valid()), plain(self.types, hit.t), math.inf)


def _meets(box: Any, lower: NDArray[np.float64], upper: NDArray[np.float64]) -> bool:
    """Whether a Mitsuba bounding box reaches into the box between two corners, or next to it."""
    margin = _CLOSE * float(np.linalg.norm(upper - lower))
    return bool(np.all(np.array(box.min, np.float64) < upper + margin) and np.all(np.array(box.max, np.float64) > lower - margin))


class Environment:
    """Radiance from all around, with a table of directions to draw from.

    The table only guides: a drawn direction is weighted by its true radiance over its density, so that the table's resolution changes
    the noise and never the mean.

    Parameters
    ----------
    types
        Dr.Jit types.
    radiance
        callable: unit vectors pointing AWAY from the scene -> list of one float array a colour channel.
    colours
        (rows, columns, channels) mean radiance of the cells of a latitude-longitude grid: row 0 at the pole +Y of the table's frame, column
        position u at the direction (sin(2 pi u), ., -cos(2 pi u)). Their luminance is the importance of the cells.
    frame
        3 x 3 rotation from the table's frame to the world.
    shade
        what stands between the environment and a point.
    uniform
        share of the directions drawn uniformly: it bounds the weight of a light that the table does not know of.
    """

    def __init__(
        self,
        types: ModuleType,
        radiance: Callable[[Any], list[Any]],
        colours: NDArray[np.floating[Any]],
        frame: NDArray[np.floating[Any]] | None = None,
        shade: Shade | None = None,
        uniform: float = _UNIFORM_SHARE,
    ) -> None:
        self.types = types
        self._shade = shade or Shade(types, None)
        self.radiance = radiance
        self._frame = np.eye(3) if frame is None else np.asarray(frame, np.float64)
        self._colours = np.maximum(np.asarray(colours, np.float64), 0)
        power = luminance(self._colours)
        rows, columns = power.shape
        edges = np.cos(np.linspace(0, np.pi, rows + 1))
        weight = np.asarray(power, np.float64) * (edges[:-1] - edges[1:])[:, None]
        total = weight.sum()
        solid = np.broadcast_to((edges[:-1] - edges[1:])[:, None], weight.shape)
        evenly = solid / solid.sum()
        weight = (1 - uniform) * weight / total + uniform * evenly if total > 0 else evenly
        # Cumulative sums a row and a column keep their digits where one sum over all cells would not.
        by_row = _cumulative(weight.sum(axis=1)[None])[0]
        by_column = _cumulative(weight)
        self._row_sums = lanes_of(types.Float, by_row.ravel())
        self._column_sums = lanes_of(types.Float, by_column.ravel())
        self._edges = lanes_of(types.Float, edges)
        self._shape = rows, columns
        self._bright_parts: dict[float, BrightPart | None] = {}

    def arriving(self, points: Any, direction: Any, numbers: Stratified) -> list[Any]:
        """Radiance past the surfaces; see `LightSource`."""
        return self.seen(points, direction)

    def reach(self, points: Any, direction: Any) -> Any:
        """It lies beyond the cloud; see `LightSource`."""
        return self.types.Float(math.inf)

    def seen(self, points: Any, direction: Any) -> list[Any]:
        """The same: it takes no random numbers."""
        seen = self._shade.visible(points, direction)
        return [dr.select(seen, value, 0) for value in self.radiance(direction)]

    def sample(self, u: Any, v: Any) -> tuple[Any, Any]:
        """Directions toward the environment, and their densities per steradian, from numbers `u`, `v` in [0, 1)."""
        t = self.types
        n_rows, n_columns = self._shape
        row, low, high = self._find(self._row_sums, t.UInt32(0), n_rows, u)
        offset = row * (n_columns + 1)
        column, left, right = self._find(self._column_sums, offset, n_columns, v)
        probability = (high - low) * (right - left)
        upper, lower = dr.gather(t.Float, self._edges, row), dr.gather(t.Float, self._edges, row + 1)
        up = dr.fma((u - low) / (high - low), lower - upper, upper)
        across = (t.Float(column) + dr.clip((v - left) / (right - left), 0, 1)) / n_columns
        density = probability * n_columns / (2 * dr.pi * (upper - lower))
        sine, (s, c) = dr.safe_sqrt(1 - up * up), dr.sincos(2 * dr.pi * across)
        return self._to_world(sine * s, up, -sine * c), density

    def density(self, direction: Any) -> Any:
        """Density per steradian with which `sample` draws these directions."""
        t = self.types
        row, column = self._cell(direction)
        offset = row * (self._shape[1] + 1) + column
        probability = (dr.gather(t.Float, self._row_sums, row + 1) - dr.gather(t.Float, self._row_sums, row)) * (
            dr.gather(t.Float, self._column_sums, offset + 1) - dr.gather(t.Float, self._column_sums, offset)
        )
        upper, lower = dr.gather(t.Float, self._edges, row), dr.gather(t.Float, self._edges, row + 1)
        return probability * self._shape[1] / (2 * dr.pi * (upper - lower))

    def beams(self, count: int) -> list[Beam]:
        """Split the grid into `count` parts of equal luminance, each seen as coming from its middle (Debevec 2005, median cut).

        Parts that are darker than the rest by far are left out, and a part of one cell is not split.
        """
        rows, columns = self._shape
        edges = np.cos(np.linspace(0, np.pi, rows + 1))
        solid = np.broadcast_to((edges[:-1] - edges[1:])[:, None] * (2 * np.pi / columns), (rows, columns))
        energy = self._colours * solid[..., None]
        weight = luminance(energy)
        parts = median_cut(weight, solid, count)
        directions = directions_of_cells(rows, columns, (0.5, 0.5)) @ self._frame.T
        beams = []
        for top, bottom, left, right in parts:
            part = slice(top, bottom), slice(left, right)
            if weight[part].sum() <= 0:
                continue
            middle = np.tensordot(weight[part], directions[part], axes=2)
            length = float(np.linalg.norm(middle))
            if length == 0:
                continue
            x, y, z = (float(v) for v in middle / length)
            # What is black is no part of it: of a floor up to the horizon, say, a rectangle has the sky above it as well.
            lit = float(solid[part][weight[part] > 0].sum())
            beams.append(Beam((x, y, z), lit, tuple(float(v) for v in energy[part].sum(axis=(0, 1)))))
        return beams

    def arriving_beam(self, points: Any, beam: Beam, numbers: Stratified) -> list[Any]:
        """Irradiance of a beam past the surfaces; see `LightSource`."""
        seen = self._shade.visible(points, self.types.Array3f(*(dr.opaque(self.types.Float, v) for v in beam.omega)))
        return [dr.select(seen, dr.opaque(self.types.Float, v), 0) for v in beam.irradiance]

    def bright_part(self, times: float) -> BrightPart | None:
        """The directions that are so many times brighter than the mean of all around, or None where there are none."""
        if times not in self._bright_parts:
            self._bright_parts[times] = self._part(times)
        return self._bright_parts[times]

    @cached_property
    def mean(self) -> float:
        """Mean luminance of all directions."""
        rows, columns = self._shape
        edges = np.cos(np.linspace(0, np.pi, rows + 1))
        power = luminance(self._colours) * (edges[:-1] - edges[1:])[:, None]
        # The sphere's solid angle is that of two for the edges' cosines.
        return float(power.sum() / (2 * columns))

    def _part(self, times: float) -> BrightPart | None:
        rows, columns = self._shape
        edges = np.cos(np.linspace(0, np.pi, rows + 1))
        bright = luminance(self._colours) > times * self.mean
        if not bright.any():
            return None
        colours = np.where(bright[..., None], self._colours, 0)
        alone = Environment(self.types, self.radiance, colours, self._frame, self._shade, uniform=0.0)
        irradiance = (self._colours * bright[..., None] * (edges[:-1] - edges[1:])[:, None, None]).sum(axis=(0, 1)) * (2 * np.pi / columns)
        return BrightPart(alone, lanes_of(self.types.Float, bright.ravel()), float(irradiance.max()))

    def lookup(self, table: Any, direction: Any) -> Any:
        """Values of `table`, one float a cell of the grid, row by row, in the cells that these directions fall into."""
        row, column = self._cell(direction)
        return dr.gather(self.types.Float, table, row * self._shape[1] + column)

    def _cell(self, direction: Any) -> tuple[Any, Any]:
        t = self.types
        n_rows, n_columns = self._shape
        m = self._frame
        x, y, z = (direction.x * float(m[0, i]) + direction.y * float(m[1, i]) + direction.z * float(m[2, i]) for i in range(3))
        theta = dr.acos(dr.clip(y, -1, 1))
        u = dr.atan2(x, -z) * (0.5 / dr.pi)
        u = u - dr.floor(u)
        return dr.minimum(t.UInt32(theta * (n_rows / dr.pi)), n_rows - 1), dr.minimum(t.UInt32(u * n_columns), n_columns - 1)

    def _find(self, sums: Any, offset: Any, count: int, u: Any) -> tuple[Any, Any, Any]:
        """Index of the interval of a cumulative sum that holds `u`, and the interval's ends."""
        t = self.types
        search: Any = dr.binary_search  # it has no type hints
        index = search(0, count, lambda i: dr.gather(t.Float, sums, offset + i + 1) <= u)
        index = dr.minimum(index, count - 1)
        return index, dr.gather(t.Float, sums, offset + index), dr.gather(t.Float, sums, offset + index + 1)

    def _to_world(self, x: Any, y: Any, z: Any) -> Any:
        m = self._frame
        return dr.normalize(self.types.Array3f(*(x * float(r[0]) + y * float(r[1]) + z * float(r[2]) for r in m)))


@dataclass(frozen=True)
class BrightPart:
    """A part of an environment, given by cells of its grid.

    Attributes
    ----------
    light
        that part alone, as a source of directions; it is black elsewhere, but `arriving` does not know that.
    irradiance
        of all of it, perpendicular to each direction, of the strongest colour channel.
    """

    light: Environment
    _inside: Any
    irradiance: float

    def holds(self, direction: Any) -> Any:
        """Whether directions belong to it."""
        return self.light.lookup(self._inside, direction) > 0.5

    def beams(self) -> list[Beam]:
        """Directions that stand for all of it: one for what lies within some degrees."""
        merged: list[list[Beam]] = []
        for beam in sorted(self.light.beams(_MOST_BRIGHT), key=lambda b: -max(b.irradiance)):
            near = [part for part in merged if np.dot(part[0].omega, beam.omega) > math.cos(math.radians(_TOGETHER))]
            if near:
                near[0].append(beam)
            else:
                merged.append([beam])
        beams = []
        for part in merged:
            middle = np.sum([np.array(beam.omega) * max(beam.irradiance) for beam in part], axis=0)
            x, y, z = (float(v) for v in middle / np.linalg.norm(middle))
            irradiance = np.sum([beam.irradiance for beam in part], axis=0)
            beams.append(Beam((x, y, z), sum(beam.solid_angle for beam in part), tuple(float(v) for v in irradiance)))
        return beams


def _cumulative(weight: NDArray[np.float64]) -> NDArray[np.float32]:
    """Cumulative sums (rows, columns + 1) from 0 to exactly 1; a row without any weight becomes uniform."""
    rows, columns = weight.shape
    total = weight.sum(axis=1, keepdims=True)
    share = np.where(total > 0, weight / np.where(total > 0, total, 1), 1 / columns)
    sums = np.concatenate([np.zeros((rows, 1)), np.cumsum(share, axis=1)], axis=1)
    sums[:, -1] = 1
    return sums.astype(np.float32)


def mitsuba_radiance(types: ModuleType, emitter: Any) -> Callable[[Any], list[Any]]:
    """What a Mitsuba environment emitter sends from given directions: a callable as `Environment` needs it."""
    mi = mitsuba()

    def radiance(direction: Any) -> list[Any]:
        interaction = dr.zeros(mi.SurfaceInteraction3f, dr.width(direction))
        interaction.wi = mi.Vector3f(-direction)
        return channels(types, emitter.eval(interaction))

    return radiance


def environment(types: ModuleType, emitter: Any, shade: Shade) -> Environment:
    """The `envmap`, `constant` or (sunless) `sunsky` emitter of a Mitsuba scene as a light source."""
    mi = mitsuba()
    radiance = mitsuba_radiance(types, emitter)
    frame = np.array(emitter.world_transform().matrix, np.float64).reshape(4, 4)[:3, :3]
    frame = frame / np.linalg.norm(frame, axis=0)
    parameters = mi.traverse(emitter)
    if "data" not in parameters and "turbidity" not in parameters:
        return Environment(types, radiance, _table(types, radiance, frame, _UNIFORM_ROWS, 2 * _UNIFORM_ROWS, 1), frame, shade)
    map_rows, map_columns = np.array(parameters["data"]).shape[:2] if "data" in parameters else _SKY
    columns = int(min(_MAX_WIDTH, max(64, map_columns)))
    rows = max(columns // 2, 32)
    colours = _table(types, radiance, frame, rows, columns, max(2, -(-2 * map_rows // rows)))
    return Environment(types, radiance, colours, frame, shade)


def directions_of_cells(rows: int, columns: int, part: tuple[float, float]) -> NDArray[np.float64]:
    """Unit vectors (rows, columns, 3) at the place `part` (0..1, 0..1) of every cell, in the table's frame."""
    theta = (np.arange(rows) + part[0])[:, None] / rows * np.pi
    phi = (np.arange(columns) + part[1])[None, :] / columns * 2 * np.pi
    return np.stack(np.broadcast_arrays(np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)), axis=-1)


def luminance(colours: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Luminance of colours (..., channels)."""
    weights = _LUMINANCE if colours.shape[-1] == 3 else (1.0,)
    result: NDArray[np.float64] = np.asarray(colours, np.float64) @ np.array(weights)
    return result


def on_host(values: list[Any], count: int) -> NDArray[np.float64]:
    """Colours (count, channels) given as one device array a channel; negative values count as 0."""
    # Together, or each channel would trace its own rays again.
    dr.eval(values)
    return np.stack([np.maximum(np.broadcast_to(np.array(value), count), 0) for value in values], axis=-1).astype(np.float64)


def median_cut(weight: NDArray[np.float64], solid: NDArray[np.float64], count: int) -> list[tuple[int, int, int, int]]:
    """Split a latitude-longitude grid into rectangles (top, bottom, left, right) of about equal weight and none too large.

    Parameters
    ----------
    weight
        (rows, columns) of the cells, not negative.
    solid
        (rows, columns) their solid angles.
    count
        rectangles wanted.
    """
    rows, columns = weight.shape
    total, sphere = float(weight.sum()), float(solid.sum())
    if total <= 0:
        return []
    # A dim part is split when it is large, so that what comes from its middle stands for all of it.
    size = weight / total + _PART_SIZE * solid / sphere
    sums = np.zeros((rows + 1, columns + 1))
    sums[1:, 1:] = size.cumsum(axis=0).cumsum(axis=1)

    def measure(part: tuple[int, int, int, int]) -> float:
        top, bottom, left, right = part
        return float(sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left])

    heap = [(-measure(whole), whole) for whole in [(0, rows, 0, columns)]]
    done: list[tuple[int, int, int, int]] = []
    while heap and len(heap) + len(done) < count:
        _, (top, bottom, left, right) = heapq.heappop(heap)
        high = bottom - top
        middle = np.sin(np.pi * (top + bottom) / (2 * rows))
        wide = (right - left) * (2 * rows / columns) * middle
        part = size[top:bottom, left:right]
        if high == 1 and right - left == 1:
            done.append((top, bottom, left, right))
            continue
        if right - left == 1 or (high > 1 and high >= wide):
            cut = top + _halves(part.sum(axis=1))
            halves = [(top, cut, left, right), (cut, bottom, left, right)]
        else:
            cut = left + _halves(part.sum(axis=0))
            halves = [(top, bottom, left, cut), (top, bottom, cut, right)]
        for half in halves:
            heapq.heappush(heap, (-measure(half), half))
    return done + [part for _, part in heap]


def _halves(line: NDArray[np.float64]) -> int:
    """Where to cut a line of weights so that both parts are about equal, neither empty."""
    sums = np.cumsum(line)
    return int(np.clip(np.searchsorted(sums, 0.5 * sums[-1]) + 1, 1, len(line) - 1))


def _table(
    types: ModuleType, radiance: Callable[[Any], list[Any]], frame: NDArray[np.float64], rows: int, columns: int, parts: int
) -> NDArray[np.float64]:
    """Mean radiance (rows, columns, channels) of every cell, from `parts` x `parts` directions in each."""
    total: Any = 0
    for part in np.ndindex(parts, parts):
        local = directions_of_cells(rows, columns, ((part[0] + 0.5) / parts, (part[1] + 0.5) / parts))
        world = local.reshape(-1, 3) @ frame.T
        values = radiance(vectors_of(types, world))
        total = total + on_host(values, len(world)).reshape(rows, columns, -1)
    result: NDArray[np.float64] = total / parts**2
    return result
