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
from deepclouds_runtime.lights import Beam, LightSource, Shade, on_host
from deepclouds_runtime.march import depths
from deepclouds_runtime.octree import DeviceOctree, Octree, Statistics, lattice_around, root_nodes
from deepclouds_runtime.scattering import Albedos, NetworkScattering
from deepclouds_runtime.scene_lights import Sun
from deepclouds_runtime.stratified import Stratified
from deepclouds_runtime.transport import Cloud, opacity_of, taker

Array = NDArray[Any]
_LEVELS = 7
# Points at which the interpolation is measured.
_CHECKS, _LEAST_CHECKS = 512, 64
# Queries that are prepared together.
_AT_ONCE = 16384
_DEEP = 1e6
# Places around a point that tell what an albedo is there on the mean, and how far away they lie, in units of length.
_AROUND, _REACH = 32, 2.0
# Of a budget of queries, what the corners of the coarsest cells may take.
_OVERDRAWN = 4
# Nodes behind a surface stand this share of the way to it.
_BEFORE = 0.99
# Corners that the coarsest cells have at least, however short the time, and points that there is always time for.
_LEAST_CORNERS, _UNLIMITED = 64, 1 << 62


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
    lights
        directions that light comes from.
    model
        name of the network that was asked; empty for one without a file.
    doubt
        two more fields, where the network knows its errors: the sum of `octree`'s, and the error to expect of it.
    built
        the octree on the host.
    """

    octree: DeviceOctree
    mix: Array
    statistics: Statistics
    error: float
    queries: int
    lights: int
    model: str = ""
    doubt: DeviceOctree | None = None
    built: Octree | None = None
    level: float = 1.0

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

    def of(beam: Beam) -> Arriving:
        def at(points: Any) -> list[Any]:
            n = dr.width(points)
            lanes = dr.arange(types.UInt32, n)
            one = dr.opaque(types.UInt32, 1)
            numbers = Stratified(types, lanes, dr.zeros(types.UInt32, n), one, dr.opaque(types.UInt32, seed & 0xFFFFFFFF))
            return source.arriving_beam(points, beam, numbers.unrelated())

        return Arriving(beam.omega, beam.irradiance, at, plain)

    return [of(beam) for beam in beams if max(beam.irradiance) > 0]


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
    predicted = _Predicted(cloud, network, lights, albedos, eyes, combine)
    nodes = max(1, budget // (len(lights) * len(albedos) * len(eyes)))
    checks = max(_LEAST_CHECKS, _CHECKS // (len(lights) * len(eyes)))
    how = cloud.field, network, predicted, seen, root, tolerance, nodes, checks, len(lights), every, until
    return interpolated(*how, finest=finest, shade=shade)


class Evaluates(Protocol):
    """What an octree interpolates.

    Attributes
    ----------
    mix, queries, model
        see `FrameSource`.
    carried
        so many of the fields are not J but the sum of the others and the error to expect of it.
    """

    mix: Array
    queries: int
    model: str
    carried: int

    def __call__(self, points: Array) -> Array:
        """Fields (n, l), float32, at world points (n, 3)."""
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
    """
    volume = field.volume
    edges = volume.to_world[:3, :3]
    lengths = np.linalg.norm(edges, axis=0)
    # The error is measured where the octree was not built for: its points lie in the finest cells, the image lies in others too.
    held_out, built_for = _split(seen, min(checks, len(seen.points) // 2))
    paced = _Paced(evaluate, until)
    # The pace is that of the last call: the first one may have kernels to compile.
    parts = [paced(part) for part in np.array_split(held_out.points, 1 if math.isinf(until) else 2) if len(part)]
    true = np.concatenate(parts) if parts else np.empty((0, 0))
    spacing, most = root * network.descriptor.unit, min(overdrawn * nodes, max(paced.affordable(), _LEAST_CORNERS))
    # Splits between the coarsest cells and the finest that anybody can tell apart; where these are the larger ones, all are as large.
    levels = _LEVELS if finest == 0 else math.floor(math.log2(spacing / finest) + 1)
    spacing, levels = spacing * 2.0 ** max(-levels, 0), min(max(levels, 0), _LEVELS)
    while True:
        lattice = lattice_around(lengths, volume.to_world[:3, 3], edges / lengths, spacing, network.anchor)
        corners = root_nodes(lattice, seen.points, most)
        if corners <= most or lattice.size.max() <= 2:
            break
        spacing = max(spacing, lattice.spacing) * (max((corners / most) ** (1 / 3), 1.1) if network.anchor is None else 2.0)
    place = _BeforeSurfaces(field.types, shade) if shade is not None and shade.surfaces is not None else None
    how = tolerance, nodes, levels, evaluate.carried, paced.affordable, place
    octree = Octree(lattice, paced, built_for.points, built_for.weights, *how)
    device = octree.upload(field.types)
    factor, error, means = _audit(device, true, held_out, every)
    level = float(means @ evaluate.mix.mean(axis=0)) if len(means) == evaluate.mix.shape[1] else 1.0
    doubt = octree.upload(field.types, carried=True) if evaluate.carried else None
    return FrameSource(
        device, evaluate.mix * factor, octree.statistics, error, evaluate.queries, lights, evaluate.model, doubt, octree, level
    )


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


class _Predicted:
    """What the octree interpolates: the network's j summed over lights, one field for each different albedo or for each colour channel."""

    def __init__(
        self,
        cloud: Cloud,
        network: NetworkScattering,
        lights: Sequence[Arriving],
        albedos: tuple[float, ...],
        eyes: Sequence[Sees],
        combine: Callable[[Array], Array],
    ) -> None:
        self._cloud, self._network, self._lights, self._albedos, self._eyes, self._combine = cloud, network, lights, albedos, eyes, combine
        self.queries = 0
        path = getattr(network.predictor, "path", None)
        self.model = "" if path is None else path.stem
        # What one eye sees is looked at itself; of several, only mixtures are.
        self.carried = 2 if network.knows_errors and len(eyes) == 1 else 0
        square = np.array(cloud.albedo) ** 2 / (4 * math.pi)
        tint = _tint(lights) if cloud.varying is None else None
        self._brightest = -1
        # Which of the albedos each field belongs to.
        self._of_field = [albedos.index(a) if a > 0 else -1 for a in cloud.albedo]
        if cloud.varying is not None:
            # Its albedos are part of each field.
            self.mix, self._of_field = np.eye(len(cloud.albedo)) / (4 * math.pi), list(range(len(cloud.albedo)))
        elif tint is None:
            self.mix = np.diag(square)
        else:
            self._brightest = int(np.argmax(tint))
            self.mix = np.zeros((len(cloud.albedo), len(albedos)))
            for c, k in enumerate(self._of_field):
                if k >= 0:
                    self.mix[c, k] = square[c] * tint[c] / tint[self._brightest]
            self._of_field = list(range(len(albedos)))

    def __call__(self, points: Array) -> Array:
        """Fields (n, l) at world points (n, 3); the last `carried` of them are the sum of the others and the error to expect of it."""
        n = len(points)
        total = np.zeros((len(self._eyes), n, self.mix.shape[1]), np.float32)
        error = np.zeros(n, np.float32)
        pairs = [(e, light) for e in range(len(self._eyes)) for light in self._lights]
        at_once = max(1, _AT_ONCE // max(n, 1))
        for first in range(0, len(pairs), at_once):
            self._add(points, pairs[first : first + at_once], total, error)
        combined = self._combine(total)
        return np.concatenate([combined, combined.sum(axis=1, keepdims=True), error[:, None]], axis=1) if self.carried else combined

    def _add(self, points: Array, pairs: Sequence[tuple[int, Arriving]], total: Array, error: Array) -> None:
        types, field, n = self._cloud.field.types, self._cloud.field, len(points)
        x = vectors_of(types, np.tile(points, (len(pairs), 1)))
        d = vectors_of(types, np.concatenate([self._eyes[e].toward(points) for e, _ in pairs]))
        omega = vectors_of(types, np.repeat([light.omega for _, light in pairs], n, axis=0))
        tau = optical_depth(field, x, omega, types.Float(0), types.Float(math.inf), types.Bool(True), _DEEP)
        dr.eval(tau)
        albedos, columns, square = self._at(points, len(pairs))
        query = x, d, omega, self._cloud.phase, albedos, tau
        j, errors = self._network.with_errors(*query) if self.carried else (self._network(*query), None)
        self.queries += j.size
        errors = np.zeros_like(j) if errors is None else errors
        j, errors = (v[:, columns].reshape(len(pairs), n, -1) * square for v in (j, errors))
        x = vectors_of(types, points)
        for (e, light), values, expected in zip(pairs, j, errors, strict=True):
            arriving = light.at(x)
            dr.eval(arriving)
            for f, k in enumerate(self._of_field):
                if k >= 0:
                    irradiance = np.array(arriving[f if self._brightest < 0 else self._brightest])
                    total[e, :, f] += irradiance * values[:, k]
                    # Errors of several lights add up: what makes a network err under one sun does so under the next.
                    error += irradiance * expected[:, k]

    def _at(self, points: Array, times: int) -> tuple[Albedos, list[int], Array]:
        """The albedos to ask for at points that are repeated, which of them each field has, and what its values are multiplied by.

        A network knows one albedo a query. Where it varies, that is its mean over the medium around the point: walks correct the rest.
        """
        varying, field = self._cloud.varying, self._cloud.field
        if varying is None:
            return self._albedos, list(range(len(self._albedos))), np.ones(1)
        types, n = field.types, len(points)
        own = on_host(self._cloud.albedo_at(vectors_of(types, points)), n)
        around = np.random.default_rng(_AROUND).normal(size=(_AROUND, 3)) * (_REACH * self._network.descriptor.unit)
        places = vectors_of(types, (points[:, None] + around).reshape(-1, 3))
        sigma = np.array(field.sigma_t(places), np.float64).reshape(n, _AROUND, 1)
        # Where nothing is near, as if there were.
        sigma += 1e-3 * max(field.majorant, 1e-30)
        mean = (on_host(varying(places), n * _AROUND).reshape(n, _AROUND, -1) * sigma).sum(axis=1) / sigma.sum(axis=1)
        columns: list[int] = []
        albedos: list[Array] = []
        for c in range(mean.shape[1]):
            same = [k for k in range(c) if np.array_equal(mean[:, k], mean[:, c])]
            columns.append(columns[same[0]] if same else len(albedos))
            if not same:
                albedos.append(np.clip(np.tile(mean[:, c], times), 0, 1))
        return albedos, columns, own * mean


def _tint(lights: Sequence[Arriving]) -> Array | None:
    """Colour that all lights share, or None where their colours differ."""
    if not all(light.plain for light in lights):
        return None
    irradiance = np.array([light.irradiance for light in lights], np.float64)
    tint = irradiance[0] / irradiance[0].max()
    return tint if np.allclose(irradiance, irradiance.max(axis=1, keepdims=True) * tint, rtol=1e-5) else None


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
