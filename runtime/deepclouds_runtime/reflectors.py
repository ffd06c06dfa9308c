"""What the surfaces around and inside of a cloud send back to it, as a light."""

from __future__ import annotations

import math
from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepclouds.backend import lanes_of, vectors_of
from deepclouds_runtime._mitsuba import mitsuba, plain
from deepclouds_runtime.lights import Beam, Environment, directions_of_cells, on_host
from deepclouds_runtime.stratified import Stratified
from deepclouds_runtime.surfaces import reflected, reflected_from_cloud, reflected_from_surfaces
from deepclouds_runtime.transport import Cloud, Counts, Lights

_PROBE_ROWS = 32
# Rays into each cell of the table, of paths, which are noisier, and of predictions.
_PROBE_PATHS, _PROBE_PARTS = 64, 4
# Of surfaces inside of the cloud: cells along each edge of its box, which they reach beyond by a share of it; rays that look for surfaces,
# of how many points they start from some; and the samples in a cell that count as much as what is known without them.
_CELLS, _BEYOND, _RAYS, _TRIED, _PRIOR = 32, 0.05, 1 << 16, 4, 4.0
# A sample beside the middle sees lit surfaces where the middle sees the cloud's own shadow: many directions ignore the table.
_PROBE_UNIFORM = 0.5
# Which of a ray's unrelated numbers draw the next one, to another surface.
_ONWARD = 11


def _outward(types: Any, interaction: Any, direction: Any) -> Any:
    """Normals (Array3f) of surfaces that rays hit in unit vectors `direction`, on the side that is hit."""
    normal = plain(types, interaction.n)
    return dr.select(dr.dot(normal, direction) > 0, -normal, normal)


class _Inside:
    """Light of the cloud that surfaces inside of its box send back, by place: means in cells, for each of six ways to face.

    Parameters
    ----------
    cloud, lights, on_cloud, seed, counts
        as for `Reflectors`.
    """

    def __init__(self, cloud: Cloud, lights: Lights, on_cloud: Lights, seed: int, counts: Counts) -> None:
        types, field = cloud.field.types, cloud.field
        self._types, self._field = types, field
        random = np.random.default_rng([seed, 0x1D5E])
        # From points of the medium in all directions, as light travels in it.
        unit = random.random((_TRIED * _RAYS, 3))
        m = field.volume.to_world
        points = unit @ m[:3, :3].T + m[:3, 3]
        total = np.cumsum(np.array(field.sigma_t(vectors_of(types, points)), np.float64))
        drawn = np.searchsorted(total, (np.arange(_RAYS) + random.random()) / _RAYS * total[-1])
        ways = random.normal(size=(_RAYS, 3))
        origin = vectors_of(types, points[np.minimum(drawn, len(points) - 1)])
        direction = vectors_of(types, ways / np.linalg.norm(ways, axis=1, keepdims=True))
        mi = mitsuba()
        interaction = lights.shade.surfaces.ray_intersect(mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction)))
        dr.eval(interaction)
        lane, one = dr.arange(types.UInt32, _RAYS), dr.opaque(types.UInt32, 1)
        numbers = Stratified(types, lane, dr.zeros(types.UInt32, _RAYS), one, dr.opaque(types.UInt32, seed)).unrelated()
        place = plain(types, interaction.p)
        held = plain(types, interaction.is_valid()) & field.holds_unit(self._unit(place))
        weight = dr.select(held, types.Float(1), 0)
        sent = on_host(reflected_from_cloud(cloud, on_cloud, interaction, weight, numbers, counts), _RAYS)
        inside, cell = np.array(held), np.array(self._cell(place, _outward(types, interaction, direction)))
        cells = 6 * _CELLS**3
        count = np.bincount(cell[inside], minlength=cells)
        self._rest = lanes_of(types.Float, _PRIOR / (count + _PRIOR))
        self._found = [lanes_of(types.Float, np.bincount(cell[inside], channel[inside], cells) / (count + _PRIOR)) for channel in sent.T]

    def better(self, known: list[Any], place: Any, normal: Any) -> list[Any]:
        """The light of each colour channel sent from world points (Array3f) that face `normal`; it is `known` where none was found."""
        inside = self._field.holds_unit(self._unit(place))
        cell = self._cell(place, normal)
        rest = dr.select(inside, dr.gather(self._types.Float, self._rest, cell, inside), 1)
        return [dr.fma(rest, k, dr.gather(self._types.Float, f, cell, inside)) for k, f in zip(known, self._found, strict=True)]

    def _unit(self, place: Any) -> Any:
        """World points in the unit cube of the cells."""
        return (self._field.to_unit(place) + _BEYOND) * (1 / (1 + 2 * _BEYOND))

    def _cell(self, place: Any, normal: Any) -> Any:
        types = self._types
        unit = self._unit(place)
        x, y, z = (types.UInt32(dr.clip(v * _CELLS, 0, _CELLS - 1)) for v in (unit.x, unit.y, unit.z))
        size = [dr.abs(v) for v in (normal.x, normal.y, normal.z)]
        first, second = (size[0] >= size[1]) & (size[0] >= size[2]), size[1] >= size[2]
        along = dr.select(first, normal.x, dr.select(second, normal.y, normal.z))
        side = dr.select(first, types.UInt32(0), dr.select(second, types.UInt32(2), types.UInt32(4))) + dr.select(
            along < 0, types.UInt32(1), types.UInt32(0)
        )
        return side + 6 * (x + _CELLS * (y + _CELLS * z))


class Reflectors:
    """The surfaces around a cloud as a light source: what they reflect reaches the cloud's samples.

    Directions are drawn from a table of what the surfaces look like from the middle of the cloud's box. The radiance of the lights that
    they reflect is that of the surface seen from the sample; the cloud's own light that they send back is looked up: in cells of the box
    where the surface lies inside of it, or else in the table, where the middle sees the same place.

    Parameters
    ----------
    cloud, lights
        what dims the light on its way to the surfaces, and the lights.
    on_cloud
        what lights the cloud, whose own light the surfaces send back.
    seed
        32 bits, of the table's random numbers.
    counts
        is updated.
    before
        what the surfaces send each other, where that is known: they send it on.
    """

    def __init__(self, cloud: Cloud, lights: Lights, on_cloud: Lights, seed: int, counts: Counts, before: Reflectors | None = None) -> None:
        self._cloud, self._lights, self._types, self._before = cloud, lights, cloud.field.types, before
        lower, upper = cloud.field.volume.bounds
        self._middle = self._types.Array3f(*(dr.opaque(self._types.Float, float(v)) for v in 0.5 * (lower + upper)))
        self._near = _Inside(cloud, lights, on_cloud, seed, counts) if lights.shade.inside else None
        colours, thrown = self._probe(on_cloud, seed, counts)
        self._table = Environment(self._types, self._nothing, colours, uniform=_PROBE_UNIFORM)
        self._thrown = [lanes_of(self._types.Float, thrown[:, c]) for c in range(thrown.shape[1])]
        self.sample, self.density, self.beams = self._table.sample, self._table.density, self._table.beams

    def arriving(self, points: Any, direction: Any, numbers: Stratified) -> list[Any]:
        """Radiance of the surface seen from `points`, 0 where there is none; see `LightSource`."""
        interaction = self._seen(points, direction)
        shown = plain(self._types, interaction.is_valid())
        direct = reflected(self._cloud, self._lights, interaction, numbers.unrelated())
        if self._before is not None:
            onward = reflected_from_surfaces(self._cloud, self._lights, self._before, interaction, numbers.unrelated(_ONWARD))
            direct = [a + b for a, b in zip(direct, onward, strict=True)]
        # What the middle sees where the point's ray ends; it may be something before that.
        place = plain(self._types, interaction.p)
        there = place - self._middle
        there = dr.select(shown, there / dr.maximum(dr.norm(there), 1e-20), direction)
        thrown = [self._table.lookup(table, there) for table in self._thrown]
        if self._near is not None:
            thrown = self._near.better(thrown, place, _outward(self._types, interaction, direction))
        return [d + dr.select(shown, t, 0) for d, t in zip(direct, thrown, strict=True)]

    def reach(self, points: Any, direction: Any) -> Any:
        """Distance to the surface seen from `points`, where that may lie inside of the cloud; see `LightSource`."""
        shade = self._lights.shade
        return shade.reach(points, direction) if shade.inside else self._types.Float(math.inf)

    def arriving_beam(self, points: Any, beam: Beam, numbers: Stratified) -> list[Any]:
        """Irradiance of a beam: the surface that `points` see in its direction stands for all of its part; see `LightSource`."""
        omega = self._types.Array3f(*(dr.opaque(self._types.Float, v) for v in beam.omega))
        direction = dr.zeros(self._types.Array3f, dr.width(points)) + omega
        solid_angle = dr.opaque(self._types.Float, beam.solid_angle)
        return [value * solid_angle for value in self.arriving(points, direction, numbers)]

    def _seen(self, points: Any, direction: Any) -> Any:
        mi = mitsuba()
        return self._lights.shade.surfaces.ray_intersect(mi.Ray3f(mi.Point3f(points), mi.Vector3f(direction)))

    def _nothing(self, direction: Any) -> list[Any]:
        return [dr.zeros(self._types.Float, dr.width(direction)) for _ in self._cloud.albedo]

    def _probe(self, on_cloud: Lights, seed: int, counts: Counts) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Colour (rows, columns, channels) of the surfaces around the box's middle; the cloud's light they send (cells, channels)."""
        types: ModuleType = self._types
        rows, columns = _PROBE_ROWS, 2 * _PROBE_ROWS
        cells, parts = rows * columns, _PROBE_PARTS if self._cloud.paths is None else _PROBE_PATHS
        n = cells * parts
        places = np.random.default_rng(seed).random((parts, 2))
        local = np.concatenate([directions_of_cells(rows, columns, (float(u), float(v))).reshape(-1, 3) for u, v in places])
        lane, one = dr.arange(types.UInt32, n), dr.opaque(types.UInt32, cells)
        part = lane // one
        numbers = Stratified(types, lane - part * one, part, dr.opaque(types.UInt32, parts), dr.opaque(types.UInt32, seed)).unrelated()
        interaction = self._seen(dr.zeros(types.Array3f, n) + self._middle, vectors_of(types, local))
        dr.eval(interaction)
        direct = reflected(self._cloud, self._lights, interaction, numbers)
        sent = on_host(reflected_from_cloud(self._cloud, on_cloud, interaction, dr.full(types.Float, 1, n), numbers, counts), n)
        thrown = sent.reshape(parts, cells, -1).mean(axis=0)
        colours = on_host(direct, n).reshape(parts, cells, -1).mean(axis=0) + thrown
        return colours.reshape(rows, columns, -1), thrown
