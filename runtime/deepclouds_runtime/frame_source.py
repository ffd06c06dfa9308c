"""Multiple scattering of one frame: predicted at the nodes of an octree, interpolated everywhere else.

From one camera every point is seen from one direction, so under lights at infinity J is a function of the place alone for that frame, and
smooth on the scale of a mean free path.
"""

from __future__ import annotations

import math
import operator
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepclouds.backend import rows, vectors_of
from deepclouds.medium.field import Field
from deepclouds.medium.optical_depth import optical_depth
from deepclouds_runtime.lights import Beam, LightSource, Shade
from deepclouds_runtime.march import depths
from deepclouds_runtime.octree import DeviceOctree, Lattice, Octree, Statistics, lattice_of, root_nodes
from deepclouds_runtime.predicted import Predicted
from deepclouds_runtime.scattering import NetworkScattering
from deepclouds_runtime.scene_lights import Sun
from deepclouds_runtime.stratified import Stratified
from deepclouds_runtime.transport import Cloud, opacity_of, taker

Array = NDArray[Any]
_LEVELS = 7
# Points at which the interpolation is measured.
_CHECKS, _LEAST_CHECKS = 512, 64
# Of a budget of queries, what the corners of the coarsest cells may take.
_OVERDRAWN = 4
# Nodes behind a surface stand this share of the way to it.
_BEFORE = 0.99
# Corners that the coarsest cells have at least, however short the time, and points that there is always time for.
_LEAST_CORNERS, _UNLIMITED = 64, 1 << 62
# From the seed of one beam's random numbers to the next one's.
_STREAM = 0x9E3779B1


@dataclass(frozen=True)
class FrameSource:
    """J of a frame on the device.

    Attributes
    ----------
    octree
        fields of j times irradiance, summed over lights.
    mix
        (channels, fields): J of a colour channel is this mixture of the fields.
    statistics
        what it took.
    error
        of the interpolation at a point that the camera sees, measured: root of the mean square over the mean.
    level
        this mean, over all channels.
    queries
        asked of the network.
    shared
        how many of them took what the network makes of coarse levels from corners around.
    lights
        directions that light comes from.
    model
        name of the network that was asked; empty for one without a file.
    doubt
        two more fields, where the network knows its errors: the sum of `octree`'s, and the error to expect of it.
    built
        the octree on the host.
    spared
        queries of albedos that lie between two others, which were not made.
    """

    octree: DeviceOctree
    mix: Array
    statistics: Statistics
    error: float
    queries: int
    shared: int
    lights: int
    model: str = ""
    doubt: DeviceOctree | None = None
    built: Octree | None = None
    level: float = 1.0
    spared: int = 0

    def corrected(self, correction: Callable[[Array], Array], floor: Array, points: Array, weights: Array) -> FrameSource:
        """J + (J + floor) d in the place of J, with d = correction(world points), as well as the nodes can have it; nowhere below 0.

        Parameters
        ----------
        correction
            d (n, channels), or (n, 1) for all channels.
        floor
            the same of each channel, (channels,) or (1,).
        points, weights
            world points (n, 3) that the camera sees, and how much each counts.
        """
        built = self.built
        if built is None:
            return self
        # Each channel is one field times a factor: a field takes the mean of what its channels ask for.
        channels = len(self.mix)
        share = self.mix / np.maximum(self.mix.sum(axis=0), 1e-30)
        of_field = (share / np.maximum(self.mix, 1e-30)).T @ np.broadcast_to(floor, channels)

        def change(points: Array, values: Array) -> Array:
            d = correction(points)
            asked = np.broadcast_to(d, (len(points), channels)) @ share
            changed: Array = np.maximum(values + (values + of_field) * asked, 0)
            return changed

        return replace(self, octree=built.changed(self.octree.types, change, points, weights))

    def summary(self) -> dict[str, Any]:
        """What it took, for a report."""
        made = self.statistics
        return {
            "model": self.model,
            "lights": self.lights,
            "nodes": made.nodes,
            "queries": self.queries,
            "shared": self.shared,
            "refined": made.cells,
            "error": round(self.error, 4),
        }

    def colours(self, values: list[Any]) -> list[Any]:
        """Colour channels of sums over the fields."""
        types = self.octree.types
        result = []
        for row in self.mix:
            terms = [value * dr.opaque(types.Float, float(m)) for value, m in zip(values, row, strict=True) if m != 0]
            result.append(sum(terms[1:], terms[0]) if terms else dr.zeros(types.Float, dr.width(values[0])))
        return result


class Sees(Protocol):
    """An eye: the camera, or anything else that sees every point in one direction."""

    def toward(self, points: Array) -> Array:
        """Unit vectors (n, 3), away from the eye, in which it sees world points (n, 3)."""
        ...


@dataclass(frozen=True)
class Seen:
    """Samples of what the camera sees of the cloud: world points (n, 3), their shares of the image (n,), the numbers of their rays (n,)."""

    points: Array
    weights: Array
    rays: Array


def seen_by(field: Field, origin: Any, direction: Any, end: Any, shift: Any, count: int) -> Seen:
    """Collisions along rays, `count` a ray, one in each equal share of what the cloud hides."""
    types = field.types
    tau = optical_depth(field, origin, direction, types.Float(0), end, types.Bool(True))
    hidden = opacity_of(tau)
    dr.eval(hidden, origin, direction, end)
    lanes: Any = dr.compress(hidden > 0)
    n = len(lanes)
    if n == 0:
        return Seen(np.empty((0, 3)), np.empty(0), np.empty(0, np.int64))
    origin, direction, end, hidden, shift = map(taker(types, lanes), (origin, direction, end, hidden, shift))
    distance = depths(field, origin, direction, end, hidden, shift, count, types.Bool(True))
    lane = dr.arange(types.UInt32, n * count) // dr.opaque(types.UInt32, count)
    take = taker(types, lane)
    points = dr.fma(take(direction), distance, take(origin))
    weights = np.repeat(np.array(hidden, np.float64) / count, count)
    return Seen(rows(points).astype(np.float64), weights, np.repeat(np.array(lanes, np.int64), count))


@dataclass(frozen=True)
class Arriving:
    """One direction that light comes from.

    Attributes
    ----------
    omega
        unit vector TOWARD it.
    irradiance
        perpendicular to it where nothing is in the way, one value a colour channel.
    at
        callable: points (Array3f) -> the irradiance that arrives there but for the cloud, one Float a channel.
    plain
        whether `at` is `irradiance` times one number, the same for all channels.
    """

    omega: tuple[float, float, float]
    irradiance: tuple[float, ...]
    at: Callable[[Any], list[Any]]
    plain: bool


def from_suns(types: Any, suns: Sequence[Sun], shade: Shade) -> list[Arriving]:
    """Distant suns past the surfaces."""

    def of(sun: Sun) -> Arriving:
        def at(points: Any) -> list[Any]:
            seen = shade.visible(points, types.Array3f(*(dr.opaque(types.Float, v) for v in sun.omega_sun)))
            return [dr.select(seen, dr.opaque(types.Float, e), 0) for e in sun.irradiance]

        return Arriving(sun.omega_sun, sun.irradiance, at, True)

    return [of(sun) for sun in suns if max(sun.irradiance) > 0]


def from_source(types: Any, source: LightSource, count: int, plain: bool, seed: int) -> list[Arriving]:
    """A light from all around as `count` directions, chosen once for the frame."""
    return of_beams(types, source, source.beams(count), plain, seed)


def of_beams(types: Any, source: LightSource, beams: Sequence[Beam], plain: bool, seed: int) -> list[Arriving]:
    """Some of the beams of a light from all around."""

    def of(beam: Beam, number: int) -> Arriving:
        # Beams that share random numbers would err together.
        own = (seed + number * _STREAM) & 0xFFFFFFFF

        def at(points: Any) -> list[Any]:
            n = dr.width(points)
            lanes = dr.arange(types.UInt32, n)
            one = dr.opaque(types.UInt32, 1)
            numbers = Stratified(types, lanes, dr.zeros(types.UInt32, n), one, dr.opaque(types.UInt32, own))
            return source.arriving_beam(points, beam, numbers.unrelated())

        return Arriving(beam.omega, beam.irradiance, at, plain)

    return [of(beam, number) for number, beam in enumerate(beams) if max(beam.irradiance) > 0]


def from_beams(types: Any, source: LightSource, count: int) -> list[Arriving]:
    """A light from all around as `count` directions, each as bright at every point as the source's table has its part."""

    def of(beam: Beam) -> Arriving:
        def at(points: Any) -> list[Any]:
            return [dr.full(types.Float, value, dr.width(points)) for value in beam.irradiance]

        return Arriving(beam.omega, beam.irradiance, at, len(set(beam.irradiance)) == 1)

    return [of(beam) for beam in source.beams(count) if max(beam.irradiance) > 0]


def frame_source(
    cloud: Cloud,
    lights: Sequence[Arriving],
    eyes: Sequence[Sees],
    seen: Seen,
    root: float,
    tolerance: float,
    budget: int,
    combine: Callable[[Array], Array] = operator.itemgetter(0),
    every: int = 1,
    until: float = math.inf,
    finest: float = 0.0,
    shade: Shade | None = None,
) -> FrameSource | None:
    """J of a frame; None where it is 0 everywhere.

    Parameters
    ----------
    cloud
        the medium; its `scattering` is the network.
    lights
        where light comes from.
    eyes
        tell in which direction each point is seen: the camera alone, as a rule.
    seen
        what the camera sees.
    root
        edge of the coarsest cells in units of length (mean free paths).
    tolerance, budget
        see `Octree`; `budget` counts queries. The corners of the coarsest cells may take four times as many: where they would take more,
        these cells are larger.
    combine
        makes the fields (n, l) that are interpolated of the values (eyes, n, k).
    every
        of so many fields the first is a value of J; the others may have any sign.
    until
        about when to be done, in seconds of `time.perf_counter`: there are no more nodes than should be ready by then.
    finest
        edge, world, below which cells are not split: what an eye can tell apart.
    shade
        of surfaces; where they may lie inside of the cloud, nodes behind them take J from before them.
    """
    network = cloud.scattering
    albedos = tuple(sorted({a for a in cloud.albedo if a > 0}))
    if not albedos or not lights or not len(seen.points) or not isinstance(network, NetworkScattering) or network.descriptor.empty:
        return None
    predicted = Predicted(cloud, network, lights, albedos, eyes, combine)
    nodes = max(1, budget // (len(lights) * len(albedos) * len(eyes)))
    checks = max(_LEAST_CHECKS, _CHECKS // (len(lights) * len(eyes)))
    how = cloud.field, network, predicted, seen, root, tolerance, nodes, checks, len(lights), every, until
    return interpolated(*how, finest=finest, shade=shade, trials=checks)


class Evaluates(Protocol):
    """What an octree interpolates.

    Attributes
    ----------
    mix, queries, shared, spared, model
        see `FrameSource`.
    carried
        so many of the fields are not J but the sum of the others and the error to expect of it.
    """

    mix: Array
    queries: int
    shared: int
    spared: int
    model: str
    carried: int

    def __call__(self, points: Array) -> Array:
        """Fields (n, l), float32, at world points (n, 3)."""
        ...

    def on_lattice(self, lattice: Lattice, levels: int) -> None:
        """Is told the coarsest cells before their corners are asked for, all at once, and how often they may be split."""
        ...


def interpolated(
    field: Field,
    network: NetworkScattering,
    evaluate: Evaluates,
    seen: Seen,
    root: float,
    tolerance: float,
    nodes: int,
    checks: int,
    lights: int,
    every: int = 1,
    until: float = math.inf,
    overdrawn: int = _OVERDRAWN,
    finest: float = 0.0,
    shade: Shade | None = None,
    trials: int = 0,
) -> FrameSource:
    """What `evaluate` says at the nodes of an octree, interpolated.

    Parameters
    ----------
    field, seen, root, tolerance, every, until, finest, shade
        as for `frame_source`.
    network
        has the unit of length, and what nodes are aligned to.
    nodes
        most of them; the corners of the coarsest cells may be `overdrawn` times as many.
    checks
        points at which the interpolation is measured.
    lights
        how many there are, for a report.
    trials
        points at which the octree sees what it errs while it is built, see `Octree`; for what has no noise.
    """
    volume = field.volume
    edges = volume.to_world[:3, :3]
    lengths = np.linalg.norm(edges, axis=0)
    # Splits between the coarsest cells and the finest that anybody can tell apart; where these are the larger ones, all are as large.
    spacing = root * network.descriptor.unit
    levels = _LEVELS if finest == 0 else math.floor(math.log2(spacing / finest) + 1)
    spacing, levels = spacing * 2.0 ** max(-levels, 0), min(max(levels, 0), _LEVELS)
    # The error is measured where the octree was not built for: its points lie in the finest cells, the image lies in others too.
    held_out, built_for = _split(seen, min(checks, len(seen.points) // 2))
    tried, built_for = _split(built_for, min(trials, len(built_for.points) // 2) if levels else 0)
    asked = np.concatenate([held_out.points, tried.points])
    paced = _Paced(evaluate, until)
    # The pace is that of the last call: the first one may have kernels to compile.
    parts = [paced(part) for part in np.array_split(asked, 1 if math.isinf(until) else 2) if len(part)]
    true = np.concatenate(parts) if parts else np.empty((0, 0))
    most = min(overdrawn * nodes, max(paced.affordable(), _LEAST_CORNERS))
    lattice = lattice_of(lengths, volume.to_world[:3, 3], edges / lengths, spacing, network.anchor, seen.points, most)
    # Nothing is split where the corners take all there is.
    evaluate.on_lattice(lattice, levels if root_nodes(lattice, seen.points, 0) < nodes else 0)
    place = _BeforeSurfaces(field.types, shade) if shade is not None and shade.surfaces is not None else None
    known = len(held_out.points)
    how = tolerance, nodes, levels, evaluate.carried, paced.affordable, place, (tried.points, true[known:]) if len(tried.points) else None
    octree = Octree(lattice, paced, built_for.points, built_for.weights, *how)
    device = octree.upload(field.types)
    factor, error, means = _audit(device, true[:known], held_out, every)
    level = float(means @ evaluate.mix.mean(axis=0)) if len(means) == evaluate.mix.shape[1] else 1.0
    doubt = octree.upload(field.types, carried=True) if evaluate.carried else None
    counts = evaluate.queries, evaluate.shared, lights, evaluate.model
    return FrameSource(device, evaluate.mix * factor, octree.statistics, error, *counts, doubt, octree, level, evaluate.spared)


def part_of_time(until: float, share: float) -> float:
    """The end of a share of the time from now until then, in seconds of `time.perf_counter`."""
    now = time.perf_counter()
    return now + share * (until - now)


class _BeforeSurfaces:
    """Moves nodes to where they are seen from.

    A node behind a surface, or inside of it, is interpolated with others before it, but it is in the dark, or in other light.
    """

    def __init__(self, types: Any, shade: Shade) -> None:
        self._types, self._shade = types, shade

    def __call__(self, points: Array, near: Array) -> Array:
        """World points (n, 3); those that a surface hides from what is seen near them (n, 3) are moved toward that, to before it."""
        if not len(points):
            return points
        way = points - near
        length = np.maximum(np.linalg.norm(way, axis=1), 1e-30)
        reach = self._shade.reach(vectors_of(self._types, near), vectors_of(self._types, way / length[:, None]))
        free = np.broadcast_to(np.array(reach, np.float64), len(points)) * _BEFORE
        moved: Array = near + way * np.minimum(free / length, 1)[:, None]
        return moved


class _Paced:
    """What an octree interpolates, and how many more points it may be asked for until a time."""

    def __init__(self, evaluate: Evaluates, until: float) -> None:
        self._evaluate, self._until, self._pace = evaluate, until, 0.0

    def __call__(self, points: Array) -> Array:
        clock = time.perf_counter()
        values = self._evaluate(points)
        if len(points):
            self._pace = (time.perf_counter() - clock) / len(points)
        return values

    def affordable(self) -> int:
        """By the pace of the last call."""
        left = self._until - time.perf_counter()
        return _UNLIMITED if math.isinf(left) else int(max(left, 0.0) / max(self._pace, 1e-9))


def _split(seen: Seen, count: int) -> tuple[Seen, Seen]:
    """`count` of the points, one in each equal share of the image's light and all of one weight, and the points that are not among them."""
    total = np.cumsum(seen.weights)
    places = (np.arange(count) + 0.5) / max(count, 1) * total[-1]
    chosen = np.minimum(np.searchsorted(total, places), len(total) - 1)
    rest = np.ones(len(total), bool)
    rest[chosen] = False
    return Seen(seen.points[chosen], np.ones(count), seen.rays[chosen]), Seen(seen.points[rest], seen.weights[rest], seen.rays[rest])


def _audit(octree: DeviceOctree, values_there: Array, checks: Seen, every: int) -> tuple[float, float, Array]:
    """Compare interpolated with true values (n, fields and more) at n points that the camera sees.

    A cloud is bright where it is dense, and nodes lie anywhere: interpolation is a little too dark. Returns the factor that makes up for it
    on the mean, the error that remains at a point, root of the mean square over the mean, and the true mean of every field.
    """
    if not len(checks.points):
        return 1.0, 0.0, np.empty(0)
    true = values_there[:, : octree.fields].astype(np.float64)[:, ::every]
    values = octree.lookup(octree.to_local(vectors_of(octree.types, checks.points)), octree.types.Bool(True))
    dr.eval(values)
    interpolated = np.stack([np.array(v, np.float64) for v in values[::every]], axis=1)
    if not (true.sum() > 0 and interpolated.sum() > 0):
        return 1.0, 0.0, true.mean(axis=0)
    factor = float(true.sum() / interpolated.sum())
    error = float(np.sqrt(np.mean(np.square(factor * interpolated - true))) / true.mean())
    return factor, error, true.mean(axis=0)
