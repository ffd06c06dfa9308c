"""Rationale: walks under all lights tell how wrong a network is, make path-traced images, and stand in for the network under a sky.

Expected behaviour: the same J as walks that are connected to directions drawn from every light in turn, whatever is bright and whatever is
a sun; and an interpolation of it over the image that is as near as it says.
"""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np
import pytest
from deepclouds_runtime._mitsuba import types_of
from deepclouds_runtime.frame_source import Seen
from deepclouds_runtime.light_walks import BRIGHT, LightWalks, Paths
from deepclouds_runtime.lights import Environment, Shade
from deepclouds_runtime.scattering import NetworkScattering, Stopped
from deepclouds_runtime.scene_lights import Sun
from deepclouds_runtime.transport import Cloud, Lights
from deepclouds_runtime.walked_source import walked_source
from numpy.typing import NDArray
from scipy import ndimage

from deepclouds.backend import lanes_of, rows, vectors_of
from deepclouds.medium.field import Field
from deepclouds.medium.one_sun import trace_one_sun
from deepclouds.volume import Volume

Floats = NDArray[Any]
ALBEDO = (1.0, 0.8, 0.0)
PHASE = (0.7, 0.0, 1.0)
SPOTS = np.array([[0.6, 0.0, 0.8], [0.0, 0.8, -0.6]])


@pytest.fixture
def types(llvm_mitsuba: ModuleType) -> Any:
    return types_of(llvm_mitsuba)


def field(types: Any) -> Field:
    lumps = np.clip(ndimage.gaussian_filter(np.random.default_rng(51).normal(size=(10, 12, 11)), 1.5, mode="constant") * 10, 0, 2)
    return Field(types, Volume.from_box(lumps, (-1, -1, -1), (1, 1, 1)), 8.0)


def sky(types: Any, spots: float) -> Environment:
    """Brighter above than below, each channel in its own way, and two small spots, so many times as bright."""

    def radiance(d: Any) -> list[Any]:
        inside = types.Bool(False)
        for spot in SPOTS:
            inside |= d.x * float(spot[0]) + d.y * float(spot[1]) + d.z * float(spot[2]) > 0.99
        return [(c + 0.5 * d.z) * dr.select(inside, spots, 1.0) for c in (1.0, 0.8, 0.7)]

    theta, phi = (np.arange(64) + 0.5) / 64 * np.pi, (np.arange(128) + 0.5) / 128 * 2 * np.pi
    d = np.stack(
        np.broadcast_arrays(np.sin(theta)[:, None] * np.sin(phi), np.cos(theta)[:, None], -np.sin(theta)[:, None] * np.cos(phi)), axis=-1
    )
    values = radiance(types.Array3f(*(lanes_of(types.Float, d[..., c].ravel()) for c in range(3))))
    colours = np.stack([np.array(v) for v in values], axis=-1).reshape(64, 128, 3)
    return Environment(types, radiance, colours)


def suns(count: int) -> tuple[Sun, ...]:
    directions = ((0.0, 0.6, 0.8), (0.8, -0.6, 0.0))[:count]
    return tuple(Sun(d, (2.0, 1.5, 1.0 + k)) for k, d in enumerate(directions))


def points_of(count: int) -> tuple[Floats, Floats]:
    rng = np.random.default_rng(52)
    w = rng.normal(size=(count, 3))
    return rng.uniform(-1.2, 1.2, (count, 3)), w / np.linalg.norm(w, axis=1, keepdims=True)


def by_directions(cloud: Cloud, lights: Lights, points: Floats, w: Floats, seed: int) -> Floats:
    """J (n, channels) of one walk a point and light, each connected to one direction of it."""
    types, n, rng = cloud.field.types, len(points), np.random.default_rng(seed)
    total = np.zeros((n, 3))
    found: list[tuple[Floats, Floats]] = [(np.tile(sun.omega_sun, (n, 1)), np.tile(sun.irradiance, (n, 1))) for sun in lights.suns]
    for source, _ in lights.sources:
        omega, density = source.sample(*(lanes_of(types.Float, rng.random(n)) for _ in range(2)))
        assert isinstance(source, Environment)
        light = source.seen(vectors_of(types, points), omega)
        found.append((rows(omega), np.stack([np.array(v / density, np.float64) for v in light], axis=1)))
    white = np.broadcast_to(np.array([1.0, 0.8], np.float32), (n, 2))
    for k, (omega, irradiance) in enumerate(found):
        singles = (points.astype(np.float32), w.astype(np.float32), np.tile(np.array(PHASE, np.float32), (n, 1)), omega.astype(np.float32))
        j = trace_one_sun(cloud.field, *singles, white, 1, seed + k)[:, 0]
        for c, a in enumerate(ALBEDO[:2]):
            total[:, c] += a * a / (4 * np.pi) * irradiance[:, c] * j[:, c]
    return total


@pytest.mark.parametrize(("sun_count", "spots"), [(0, 1.0), (0, 60.0), (1, None), (2, 60.0)])
def test_j_is_that_of_walks_to_one_direction_of_each_light(types: Any, sun_count: int, spots: float | None) -> None:
    cloud = Cloud(field(types), ALBEDO, PHASE, None)
    sources = () if spots is None else ((sky(types, spots), 1),)
    lights = Lights(suns(sun_count), sources, Shade(types, None))
    n, each = 200, 2000
    points, w = (np.repeat(v, each, axis=0) for v in points_of(n))
    walks = LightWalks(cloud, lights)
    assert (len(walks._bright) == 1) == (spots == 60.0)
    found = walks(points, w, np.random.default_rng(53))
    expected = by_directions(cloud, lights, points, w, 54)
    assert not found[:, 2].any()
    a, b = (v[:, :2].reshape(n, each, 2) for v in (found, expected))
    error = np.sqrt(((a.var(axis=1) + b.var(axis=1)) / each).sum(axis=0)) / n
    mean = b.mean(axis=(0, 1))
    assert np.all(error < 0.015 * mean)
    assert np.all(np.abs(a.mean(axis=(0, 1)) - mean) < 3.5 * error)
    if spots == 1.0:
        assert np.all(a.var(axis=1).mean(axis=0) < 0.5 * b.var(axis=1).mean(axis=0))
    # The same for an image, where every call has its own random numbers.
    paths = Paths(cloud.field, ALBEDO, PHASE, None, 55)
    first, second = (paths(lights, vectors_of(types, points), vectors_of(types, w)) for _ in range(2))
    assert not np.array_equal(first, second)
    a = first[:, :2].reshape(n, each, 2)
    assert np.all(np.abs(a.mean(axis=(0, 1)) - mean) < 3.5 * np.sqrt((b.var(axis=1) + a.var(axis=1)).sum(axis=0) / each) / n)


def test_what_is_bright_is_cut_out_and_stands_for_its_light(types: Any) -> None:
    whole, even = sky(types, 60.0), sky(types, 1.0)
    assert even.bright_part(BRIGHT) is None
    part = whole.bright_part(BRIGHT)
    assert part is not None
    rng = np.random.default_rng(56)
    d = rng.normal(size=(4000, 3))
    d[:1000] = SPOTS[rng.integers(0, 2, 1000)] + 0.05 * d[:1000]
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    inside = np.array(part.holds(vectors_of(types, d)))
    far = (d @ SPOTS.T).max(axis=1)
    assert inside[far > 0.997].all()
    assert not inside[far < 0.97].any()
    beams = part.beams()
    # Each is sixteen degrees across.
    assert 2 <= len(beams) <= 6
    near = np.array([beam.omega for beam in beams]) @ SPOTS.T
    assert near.max(axis=1).min() > 0.985
    assert near.max(axis=0).min() > 0.99
    # Caps of 2 pi (1 - 0.99) steradians.
    expected = sum(60 * (1 + 0.5 * spot[2]) * 2 * np.pi * 0.01 for spot in SPOTS)
    assert sum(beam.irradiance[0] for beam in beams) == pytest.approx(expected, rel=0.1)
    assert part.irradiance == pytest.approx(sum(beam.irradiance[0] for beam in beams))
    # It draws from that part alone.
    omega, density = part.light.sample(*(lanes_of(types.Float, rng.random(1000)) for _ in range(2)))
    assert np.array(part.holds(omega)).mean() > 0.99
    assert np.array(density).min() > 1


class Along:
    """Sees every point in one direction."""

    def toward(self, points: Floats) -> Floats:
        """Unit vectors (n, 3)."""
        return np.broadcast_to([0.0, 0.0, -1.0], points.shape)


class Unused:
    """Stands in for a network; asked by nobody."""

    def predict(self, stencil: Floats, aux: Floats) -> Floats:
        """Refuse."""
        raise AssertionError


def test_collisions_are_counted(types: Any) -> None:
    """Against walks of a few lines in a homogeneous cube; what is absorbed is thinned out."""
    volume = Volume.from_box(np.ones((2, 2, 2), np.float32), (-1, -1, -1), (1, 1, 1))
    random, sigma, n = np.random.default_rng(61), 4.0, 40_000
    points = random.uniform(-1, 1, (n, 3))
    count = np.zeros(n)
    x, inside = points.copy(), np.ones(n, bool)
    while inside.any():
        w = random.normal(size=(n, 3))
        x += w / np.linalg.norm(w, axis=1, keepdims=True) * random.exponential(1 / sigma, (n, 1))
        inside &= (np.abs(x) < 1).all(axis=1)
        count += inside
    along = np.broadcast_to([0.0, 0.0, -1.0], (n, 3))
    found = {}
    for albedo in (1.0, 0.5):
        cloud = Cloud(Field(types, volume, sigma), (albedo,), (0.0, 0.0, 1.0), None)
        walks = LightWalks(cloud, Lights((), ((sky(types, 1.0), 1),), Shade(types, None)), smooth=True)
        found[albedo] = walks.collisions(points, along, np.random.default_rng(62))
    assert found[1.0] == pytest.approx(count.mean(), abs=5 * count.std() / n**0.5)
    assert found[0.5] == pytest.approx(np.minimum(count, 6.6).mean(), abs=5 * count.std() / n**0.5)


def test_a_sky_is_walked_at_nodes_and_interpolated(types: Any) -> None:
    cloud = Cloud(field(types), ALBEDO, PHASE, None)
    lights = Lights((), ((sky(types, 1.0), 1),), Shade(types, None))
    network = NetworkScattering(cloud.field, Unused())
    points = np.random.default_rng(57).uniform(-0.8, 0.8, (3000, 3))
    seen = Seen(points, np.ones(len(points)), np.arange(len(points)))
    walks = LightWalks(cloud, lights, smooth=True)
    source = walked_source(cloud, network, walks, Along(), seen, 2.0, 0.05, 1 << 19, 58)
    assert source is not None
    assert source.queries == 0
    assert source.statistics.nodes > 50
    some = points[:400]
    values = source.colours(source.octree.lookup(source.octree.to_local(vectors_of(types, some)), types.Bool(True)))
    j = np.stack([np.broadcast_to(np.array(v), len(some)) for v in values], axis=1)
    each = 600
    repeated = np.repeat(some, each, axis=0)
    true = walks(repeated, Along().toward(repeated), np.random.default_rng(59)).reshape(len(some), each, 3)
    mean = true.mean(axis=1)
    assert not j[:, 2].any()
    for c in range(2):
        # Its own error, and what the walks it is held against have.
        noise = np.sqrt(true[..., c].var(axis=1).mean() / each) / mean[:, c].mean()
        off = np.sqrt(np.mean(np.square(j[:, c] - mean[:, c]))) / mean[:, c].mean()
        assert off < np.hypot(1.3 * source.error, noise)
        assert off < 0.12
        assert j[:, c].mean() == pytest.approx(mean[:, c].mean(), rel=0.01)
    again = walked_source(cloud, network, walks, Along(), seen, 2.0, 0.05, 1 << 19, 58)
    assert again is not None
    assert again.statistics == source.statistics
    # Where the time is over before it began, the fewest nodes.
    late = walked_source(cloud, network, walks, Along(), seen, 0.2, 0.05, 1 << 19, 58, until=0.0)
    assert late is not None
    assert late.statistics.nodes <= 64
    assert late.statistics.cells == []
    network.stop = lambda: True
    with pytest.raises(Stopped):
        walked_source(cloud, network, walks, Along(), seen, 2.0, 0.05, 1 << 19, 58)
    black = walked_source(Cloud(cloud.field, (0.0, 0.0, 0.0), PHASE, None), network, walks, Along(), seen, 2.0, 0.05, 1 << 19, 58)
    assert black is None


def test_single_scattering_of_smooth_sources_is_in_their_walks(types: Any) -> None:
    """White, in even light, a cloud is invisible: with what was scattered once every walk finds as much as there is all around."""
    cloud = Cloud(field(types), (1.0,), PHASE, None)
    even = Environment(types, lambda d: [d.x * 0 + 1.5], np.full((16, 32, 1), 1.5))
    points, w = points_of(2000)
    both = Lights((), ((even, 1),), Shade(types, None), (even,))
    assert LightWalks(cloud, both, smooth=True)(points, w, np.random.default_rng(63)) == pytest.approx(1.5)
    # The same walks without: those that leave at once find nothing.
    once_more = LightWalks(cloud, replace(both, smooth=()), smooth=True)(points, w, np.random.default_rng(63))
    assert set(np.unique(np.round(once_more, 5))) == {0.0, 1.5}
    assert 0.2 < (once_more > 0).mean() < 0.95
