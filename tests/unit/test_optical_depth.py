"""Marches against fine quadrature of the field's readable twin, their inverse, and delta tracking against Beer-Lambert."""

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


def march(field: Field, o: Floats, d: Floats, start: ArrayLike = 0.0, end: ArrayLike = FAR, jitter: ArrayLike = 0.5) -> Floats:
    active = backend().Bool(np.ones(len(o), bool))
    return np.array(optical_depth(field, device(o), device(d), device(start), device(end), device(jitter), active), np.float64)


def quadrature(v: Volume, scale: float, o: Floats, d: Floats, reach: float = 14.0, steps: int = 14000) -> tuple[Floats, Floats]:
    """Distances (steps + 1) and optical depths up to them (n, steps + 1), by the midpoint rule."""
    edges = np.linspace(0, reach, steps + 1)
    middle = (edges[1:] + edges[:-1]) / 2
    density = np.stack([v.sample(a + middle[:, None] * b) for a, b in zip(o, d, strict=True)])
    tau = np.concatenate([np.zeros((len(o), 1)), np.cumsum(density, axis=1) * scale * edges[1]], axis=1)
    return edges, tau


def test_against_fine_quadrature() -> None:
    v, (o, d) = volume(), rays(60, 1)
    _, tau = quadrature(v, 3.0, o, d)
    np.testing.assert_allclose(march(Field(backend(), v, 3.0), o, d), tau[:, -1], atol=0.02 * tau[:, -1].max())


def test_jitter_is_unbiased() -> None:
    v, (o, d) = volume(), rays(60, 2)
    field = Field(backend(), v, 3.0)
    _, tau = quadrature(v, 3.0, o, d)
    jitter = (np.arange(400) + 0.5) / 400
    every = march(field, np.repeat(o, 400, axis=0), np.repeat(d, 400, axis=0), jitter=np.tile(jitter, 60)).reshape(60, 400)
    assert every.std(axis=1).max() > 1e-2
    # What is left is the twin's own error at the box's faces, half a step of 1e-3 at an extinction of at most 3.
    np.testing.assert_allclose(every.mean(axis=1), tau[:, -1], atol=3e-3)


def test_exact_in_a_homogeneous_box() -> None:
    field = Field(backend(), Volume.from_box(np.full((3, 4, 5), 2.0), (-1, -2, 0.5), (1.5, 1, 2)), 0.7)
    o, d = rays(2000, 3)
    with np.errstate(divide="ignore"):
        t0, t1 = ((np.array(face) - o) / d for face in ((-1, -2, 0.5), (1.5, 1, 2)))
    chord = np.maximum(np.minimum(t0, t1).max(axis=1), 0), np.maximum(t0, t1).min(axis=1)
    jitter = np.random.default_rng(4).random(2000)
    np.testing.assert_allclose(march(field, o, d, jitter=jitter), 1.4 * (chord[1] - chord[0]), rtol=2e-4, atol=2e-5)


def test_segments_are_clipped_and_add_up() -> None:
    v, (o, d) = volume(), rays(500, 5)
    field = Field(backend(), v, 3.0)
    cut = np.random.default_rng(6).uniform(0, 8, 500)
    whole, first, second = march(field, o, d), march(field, o, d, end=cut), march(field, o, d, start=cut)
    np.testing.assert_allclose(first + second, whole, atol=0.03 * whole.max())
    assert (first + second - whole).mean() == pytest.approx(0, abs=2e-3 * whole.mean())
    np.testing.assert_array_equal(march(field, o, d, start=cut, end=cut), 0)


def test_misses_and_inactive_lanes_are_zero() -> None:
    t, field = backend(), Field(backend(), volume(), 3.0)
    o, d = np.array([[5.0, 0, 1], [0.2, 0, 1]]), np.array([[0.0, 1, 0], [0, 1, 0]])
    tau = optical_depth(field, device(o), device(d), t.Float(0), t.Float(FAR), t.Float(0.5), t.Bool([True, True]))
    assert np.array(tau)[0] == 0
    assert np.array(tau)[1] > 0
    tau = optical_depth(field, device(o), device(d), t.Float(0), t.Float(FAR), t.Float(0.5), t.Bool([True, False]))
    np.testing.assert_array_equal(np.array(tau), 0)


def test_an_opaque_segment_says_so() -> None:
    v, (o, d) = volume(), rays(300, 7)
    thin, thick = march(Field(backend(), v, 1.0), o, d), march(Field(backend(), v, 60.0), o, d)
    opaque = 60 * thin > TAU_OPAQUE + 5
    assert opaque.sum() > 50
    assert thick[opaque].min() >= TAU_OPAQUE
    clear = 60 * thin < TAU_OPAQUE - 1e-3
    np.testing.assert_allclose(thick[clear], 60 * thin[clear], rtol=1e-4, atol=1e-5)


def test_distance_at_inverts_the_depth() -> None:
    v, (o, d) = volume(), rays(80, 8)
    field = Field(backend(), v, 3.0)
    edges, tau = quadrature(v, 3.0, o, d)
    target = np.random.default_rng(9).uniform(0.02, 0.98, 80) * tau[:, -1]
    t = backend()
    where, density = distance_at(
        field, device(o), device(d), t.Float(0), t.Float(FAR), t.Float(0.5), device(target), t.Bool(np.ones(80, bool))
    )
    found = np.array(where, np.float64)
    reached = np.array([np.interp(x, edges, row) for x, row in zip(found, tau, strict=True)])
    np.testing.assert_allclose(reached, target, atol=0.02 * tau[:, -1].max())
    # The extinction returned is that of the step in which the target lies.
    exact = 3 * v.sample(o + found[:, None] * d)
    assert np.corrcoef(np.array(density), exact)[0, 1] > 0.95


def test_distance_at_is_exact_in_a_homogeneous_box_and_ends_beyond_the_target() -> None:
    t = backend()
    field = Field(t, Volume.from_box(np.ones((4, 4, 4)), (0, 0, 0), (2, 2, 2)), 1.5)
    n = 64
    o, d = np.tile([-1.0, 0.9, 1.1], (n, 1)), np.tile([1.0, 0, 0], (n, 1))
    target, jitter = np.linspace(0.01, 2.99, n), np.random.default_rng(10).random(n)
    arguments = (device(o), device(d), t.Float(0), t.Float(FAR), device(jitter))
    where, density = distance_at(field, *arguments, device(target), t.Bool(np.ones(n, bool)))
    np.testing.assert_allclose(np.array(where), 1 + target / 1.5, rtol=1e-5)
    np.testing.assert_allclose(np.array(density), 1.5, rtol=1e-6)
    beyond, _ = distance_at(field, *arguments, device(target + 3), t.Bool(np.ones(n, bool)))
    np.testing.assert_allclose(np.array(beyond), 3, rtol=1e-6)


def test_leaving_out_empty_bricks_changes_nothing() -> None:
    """Against the plain march, whose one brick is never empty: the same depths to the bit, the same distances but for rounding."""
    density = np.zeros((30, 41, 26), np.float32)
    rng = np.random.default_rng(13)
    for _ in range(20):
        at = [int(rng.integers(0, n - 4)) for n in density.shape]
        density[tuple(slice(a, a + 4) for a in at)] = rng.random((4, 4, 4))
    v, n = Volume.from_box(density, (-1, -2, 0.5), (1.5, 1, 2)), 20_000
    o, d = rays(n, 14)
    jitter, start, end = rng.random(n), rng.choice([0.0, 2.0, 6.0], n), rng.choice([5.0, 7.0, FAR], n)
    plain, skipping = Field(backend(), v, 8.0, brick=None), Field(backend(), v, 8.0)
    assert not plain.majorants.any_empty
    assert (skipping.majorants.empty_radius >= 1).mean() > 0.2
    depths = [march(f, o, d, start=start, end=end, jitter=jitter) for f in (plain, skipping)]
    assert np.count_nonzero(depths[0]) > 2000
    np.testing.assert_array_equal(depths[1], depths[0])
    target = rng.choice([0.0, 0.3, 0.999, 2.0], n) * depths[0] + rng.choice([0.0, 1e-3], n)
    arguments = device(o), device(d), device(start), device(end), device(jitter), device(target), backend().Bool(np.ones(n, bool))
    (first, density_first), (second, density_second) = (distance_at(f, *arguments) for f in (plain, skipping))
    np.testing.assert_allclose(np.array(second), np.array(first), rtol=1e-6)
    np.testing.assert_array_equal(np.array(density_second), np.array(density_first))


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
