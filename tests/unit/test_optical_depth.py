"""Optical depths against quadrature of the field's readable twin cell by cell, their inverse, and delta tracking against Beer-Lambert."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from deepclouds.backend import backend
from deepclouds.medium.field import Field
from deepclouds.medium.first_collision import first_collisions
from deepclouds.medium.optical_depth import TAU_OPAQUE, distance_at, optical_depth
from deepclouds.volume import Volume

Floats = NDArray[np.float64]
FAR = 1e4


def volume(seed: int = 0) -> Volume:
    return Volume.from_box(np.random.default_rng(seed).random((6, 9, 5)) ** 2, (-1, -2, 0.5), (1.5, 1, 2))


def rays(count: int, seed: int) -> tuple[Floats, Floats]:
    """Rays through the box of `volume`, a third of them from the inside."""
    rng = np.random.default_rng(seed)
    through = rng.uniform((-1, -2, 0.5), (1.5, 1, 2), (count, 3))
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    back = np.where(np.arange(count) % 3 == 0, 0.0, 6.0)[:, None]
    return through - back * directions, directions


def device(values: ArrayLike) -> Any:
    t = backend()
    array = np.asarray(values, np.float32)
    return t.Float(array) if array.ndim < 2 else t.Array3f(*(t.Float(np.ascontiguousarray(array[:, c])) for c in range(3)))


def march(field: Field, o: Floats, d: Floats, start: ArrayLike = 0.0, end: ArrayLike = FAR) -> Floats:
    active = backend().Bool(np.ones(len(o), bool))
    return np.array(optical_depth(field, device(o), device(d), device(start), device(end), active), np.float64)


def cell_by_cell(v: Volume, o: Floats, d: Floats, start: float = 0.0, end: float = FAR) -> tuple[Floats, Floats]:
    """Distances at which one ray crosses planes of samples or faces of the box, and the integrals of the density up to them.

    Between two of them the twin's density is a cubic, which four of Gauss's points in double precision integrate exactly.
    """
    inverse = np.linalg.inv(v.to_world)
    base, along = inverse[:3, :3] @ o + inverse[:3, 3], inverse[:3, :3] @ d
    crossed = [start, end]
    for a in range(3):
        n = v.resolution[a]
        if along[a] != 0:
            crossed += list((np.concatenate([[0, 1], (np.arange(n) + 0.5) / n]) - base[a]) / along[a])
    edges = np.unique(np.clip(crossed, start, end))
    nodes, weights = np.polynomial.legendre.leggauss(4)
    middle, half = (edges[1:] + edges[:-1]) / 2, (edges[1:] - edges[:-1]) / 2
    places = (middle[:, None] + half[:, None] * nodes).ravel()
    density = v.sample(o + places[:, None] * d).reshape(-1, 4)
    return edges, np.concatenate([[0], np.cumsum((density * weights).sum(axis=1) * half)])


def exact(v: Volume, o: Floats, d: Floats, start: ArrayLike = 0.0, end: ArrayLike = FAR) -> Floats:
    limits = (np.broadcast_to(value, len(o)) for value in (start, end))
    return np.array([cell_by_cell(v, *ray)[1][-1] for ray in zip(o, d, *limits, strict=True)])


def quadrature(v: Volume, scale: float, o: Floats, d: Floats, reach: float = 14.0, steps: int = 14000) -> tuple[Floats, Floats]:
    """Distances (steps + 1) and optical depths up to them (n, steps + 1), by the midpoint rule."""
    edges = np.linspace(0, reach, steps + 1)
    middle = (edges[1:] + edges[:-1]) / 2
    density = np.stack([v.sample(a + middle[:, None] * b) for a, b in zip(o, d, strict=True)])
    tau = np.concatenate([np.zeros((len(o), 1)), np.cumsum(density, axis=1) * scale * edges[1]], axis=1)
    return edges, tau


def test_the_oracle_against_fine_quadrature() -> None:
    v, (o, d) = volume(), rays(60, 1)
    _, tau = quadrature(v, 1.0, o, d)
    # Half a step of 1e-3 at each face of the box, where the density is at most 1.
    np.testing.assert_allclose(exact(v, o, d), tau[:, -1], atol=1.1e-3)


@pytest.mark.parametrize("shape", [(6, 9, 5), (1, 7, 4), (5, 1, 1), (1, 1, 1), (2, 40, 3)])
@pytest.mark.parametrize("scale", [1e-3, 3.0])
def test_exact_but_for_rounding(shape: tuple[int, int, int], scale: float) -> None:
    v, (o, d) = Volume.from_box(np.random.default_rng(0).random(shape) ** 2, (-1, -2, 0.5), (1.5, 1, 2)), rays(300, 1)
    np.testing.assert_allclose(march(Field(backend(), v, scale), o, d), scale * exact(v, o, d), rtol=2e-5, atol=scale * 3e-6)


def test_along_axes_on_planes_of_samples_and_from_far_away() -> None:
    """Rays in a plane of samples, along its edges and through its corners, and from a thousand boxes away."""
    v = volume()
    lower, upper = v.bounds
    size, middle = (upper - lower) / v.resolution, (lower + upper) / 2
    origins, directions = [], []
    for axis in np.vstack([np.eye(3), -np.eye(3)]):
        for sample in (lower + 2.5 * size, lower + 0.5 * size, middle, lower + (2, 1.5, 2.5) * size):
            origins.append(np.where(axis != 0, middle - 5 * axis, sample))
            directions.append(axis)
    through = np.array([[1, 1, 0], [1, -1, 1], [0, 1, 1], [-1, 1, 1]]) * size
    for direction in through / np.linalg.norm(through, axis=1, keepdims=True):
        origins.append(lower + 2.5 * size - 4 * direction)
        directions.append(direction)
    o, d = np.array(origins), np.array(directions)
    field = Field(backend(), v, 3.0)
    np.testing.assert_allclose(march(field, o, d), 3 * exact(v, o, d), rtol=3e-5, atol=1e-5)
    far = o - 1000 * d
    # There a float32 knows distances to 1e-4.
    np.testing.assert_allclose(march(field, far, d), 3 * exact(v, o, d), atol=2e-3)


def test_exact_in_a_homogeneous_box() -> None:
    field = Field(backend(), Volume.from_box(np.full((3, 4, 5), 2.0), (-1, -2, 0.5), (1.5, 1, 2)), 0.7)
    o, d = rays(2000, 3)
    with np.errstate(divide="ignore"):
        t0, t1 = ((np.array(face) - o) / d for face in ((-1, -2, 0.5), (1.5, 1, 2)))
    chord = np.maximum(np.minimum(t0, t1).max(axis=1), 0), np.maximum(t0, t1).min(axis=1)
    np.testing.assert_allclose(march(field, o, d), 1.4 * (chord[1] - chord[0]), rtol=2e-4, atol=2e-5)


def test_segments_are_clipped_and_add_up() -> None:
    v, (o, d) = volume(), rays(500, 5)
    field = Field(backend(), v, 3.0)
    cut = np.random.default_rng(6).uniform(0, 8, 500)
    whole, first, second = march(field, o, d), march(field, o, d, end=cut), march(field, o, d, start=cut)
    np.testing.assert_allclose(first + second, whole, rtol=2e-5, atol=1e-5)
    np.testing.assert_allclose(first, 3 * exact(v, o, d, end=cut), rtol=2e-5, atol=1e-5)
    np.testing.assert_array_equal(march(field, o, d, start=cut, end=cut), 0)


def test_misses_and_inactive_lanes_are_zero() -> None:
    t, field = backend(), Field(backend(), volume(), 3.0)
    o, d = np.array([[5.0, 0, 1], [0.2, 0, 1]]), np.array([[0.0, 1, 0], [0, 1, 0]])
    tau = optical_depth(field, device(o), device(d), t.Float(0), t.Float(FAR), t.Bool([True, True]))
    assert np.array(tau)[0] == 0
    assert np.array(tau)[1] > 0
    tau = optical_depth(field, device(o), device(d), t.Float(0), t.Float(FAR), t.Bool([True, False]))
    np.testing.assert_array_equal(np.array(tau), 0)


def test_an_opaque_segment_says_so() -> None:
    v, (o, d) = volume(), rays(300, 7)
    thin, thick = march(Field(backend(), v, 1.0), o, d), march(Field(backend(), v, 60.0), o, d)
    opaque = 60 * thin > TAU_OPAQUE + 5
    assert opaque.sum() > 50
    assert thick[opaque].min() >= TAU_OPAQUE
    clear = 60 * thin < TAU_OPAQUE - 1e-3
    np.testing.assert_allclose(thick[clear], 60 * thin[clear], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("scale", [1e-3, 3.0, 300.0])
def test_distance_at_inverts_the_depth(scale: float) -> None:
    v, n = volume(), 400
    field, (o, d) = Field(backend(), v, scale), rays(n, 8)
    t, part = backend(), np.random.default_rng(9).uniform(0.001, 0.999, n)
    whole = scale * exact(v, o, d)
    where = distance_at(field, device(o), device(d), t.Float(0), t.Float(FAR), device(part * whole), t.Bool(np.ones(n, bool)))
    reached = scale * exact(v, o, d, end=np.array(where, np.float64))
    np.testing.assert_allclose(reached[whole > 0] / whole[whole > 0], part[whole > 0], atol=2e-5)


def test_distance_at_ends_where_the_segment_does() -> None:
    t = backend()
    field = Field(t, Volume.from_box(np.ones((4, 4, 4)), (0, 0, 0), (2, 2, 2)), 1.5)
    n = 64
    o, d = np.tile([-1.0, 0.9, 1.1], (n, 1)), np.tile([1.0, 0, 0], (n, 1))
    target = np.linspace(0.01, 2.99, n)
    arguments = (device(o), device(d), t.Float(0), t.Float(FAR))
    where = distance_at(field, *arguments, device(target), t.Bool(np.ones(n, bool)))
    np.testing.assert_allclose(np.array(where), 1 + target / 1.5, rtol=1e-5)
    beyond = distance_at(field, *arguments, device(target + 3), t.Bool(np.ones(n, bool)))
    np.testing.assert_allclose(np.array(beyond), 3, rtol=1e-6)


def test_leaving_out_empty_bricks_changes_nothing() -> None:
    """Against a field of one brick, which is never empty: the same depths and distances but for rounding."""
    density = np.zeros((30, 41, 26), np.float32)
    rng = np.random.default_rng(13)
    for _ in range(20):
        at = [int(rng.integers(0, n - 4)) for n in density.shape]
        density[tuple(slice(a, a + 4) for a in at)] = rng.random((4, 4, 4))
    v, n = Volume.from_box(density, (-1, -2, 0.5), (1.5, 1, 2)), 20_000
    o, d = rays(n, 14)
    start, end = rng.choice([0.0, 2.0, 6.0], n), rng.choice([5.0, 7.0, FAR], n)
    plain, skipping = Field(backend(), v, 8.0, brick=None), Field(backend(), v, 8.0)
    assert not plain.majorants.any_empty
    assert (skipping.majorants.empty_radius >= 1).mean() > 0.2
    depths = [march(f, o, d, start=start, end=end) for f in (plain, skipping)]
    assert np.count_nonzero(depths[0]) > 2000
    np.testing.assert_allclose(depths[1], depths[0], rtol=1e-5, atol=1e-5)
    target = rng.choice([0.3, 0.999, 2.0], n) * depths[0] + 1e-3
    arguments = device(o), device(d), device(start), device(end), device(target), backend().Bool(np.ones(n, bool))
    first, second = (np.array(distance_at(f, *arguments)) for f in (plain, skipping))
    np.testing.assert_allclose(second, first, rtol=1e-4)


def test_beer_lambert() -> None:
    """Delta tracking leaves exp(-tau) of the rays, and places collisions so that 1 - exp(-tau(x)) is uniform."""
    v, n = volume(), 40_000
    field = Field(backend(), v, 1.2)
    (o, d), pulls = rays(6, 11), []
    edges, tau = quadrature(v, 1.2, o, d)
    for i in range(6):
        many = np.repeat(o[i : i + 1], n, axis=0).astype(np.float32), np.repeat(d[i : i + 1], n, axis=0).astype(np.float32)
        points, hit = first_collisions(field, *many, seed=i)
        p = np.exp(-tau[i, -1])
        pulls.append(((~hit).mean() - p) / np.sqrt(p * (1 - p) / n))
        np.testing.assert_array_equal(points[~hit], many[0][~hit])
        distance = (points[hit] - o[i]) @ d[i]
        np.testing.assert_allclose(np.cross(points[hit] - o[i], d[i]), 0, atol=1e-5)
        uniform = (1 - np.exp(-np.interp(distance, edges, tau[i]))) / (1 - p)
        assert stats.kstest(uniform, "uniform").pvalue > 1e-3
    assert np.abs(pulls).max() < 4
    assert stats.chi2.sf(np.sum(np.square(pulls)), 6) > 1e-3


def test_first_collisions_are_reproducible_and_skip_empty_space() -> None:
    field, (o, d) = Field(backend(), volume(), 2.0), rays(500, 12)
    single = o.astype(np.float32), d.astype(np.float32)
    first, again, other = (first_collisions(field, *single, seed=s)[0] for s in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    away = np.array([[0.0, 0, 50]], np.float32), np.array([[0.0, 0, 1]], np.float32)
    assert not first_collisions(field, *away, seed=1)[1].any()
    assert not first_collisions(Field(backend(), volume(), 0.0), *single, seed=1)[1].any()
