"""Walks against closed forms and identities: one order of scattering, white furnace, invariances of the estimator.

Rationale: every label that trains a network comes from `trace_walks`, so whatever is wrong there is learnt.
Expected behaviour: means agree with the exact value within four standard errors, and those errors are small enough to notice one
per cent or less; what ought to be equal bit for bit is.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage, stats

from deepclouds.backend import backend
from deepclouds.medium.field import Field
from deepclouds.medium.multiple_scattering import trace_walks
from deepclouds.medium.one_sun import trace_one_sun
from deepclouds.medium.optical_depth import optical_depth
from deepclouds.medium.phase import as_lobes, sample_two_lobe_cosine, two_lobe_numpy
from deepclouds.volume import Volume

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
# A single lobe g, or the lobes (g1, g2, weight).
Phase = float | tuple[float, float, float]
TWO_LOBES = (0.9, -0.4, 0.75)


def rotation(seed: int) -> Floats:
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return np.asarray(q * np.linalg.det(q))


def sphere(count: int, seed: int) -> Singles:
    d = np.random.default_rng(seed).normal(size=(count, 3))
    unit: Singles = (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)
    return unit


def cloud(tau: float = 8.0) -> Field:
    """Lumps in a rotated box with voxels of three different edges; `tau` across the box, at its mean extinction."""
    rng = np.random.default_rng(20)
    lumps = np.clip(ndimage.gaussian_filter(rng.normal(size=(14, 20, 24)), 2.0, mode="constant") * 14, 0, 2)
    to_world = np.eye(4)
    to_world[:3, :3] = rotation(21) @ np.diag([1.3, 1.0, 0.8])
    to_world[:3, 3] = (3.0, -2.0, 0.5)
    volume = Volume(lumps, to_world)
    return Field(backend(), volume, tau / float(volume.density.mean()))


def cube(tau: float = 4.0) -> Field:
    return Field(backend(), Volume.from_box(np.ones((1, 1, 1)), (0, 0, 0), (1, 1, 1)), tau)


def inside(field: Field, count: int, seed: int, margin: float = 0.0) -> Singles:
    unit = np.random.default_rng(seed).uniform(-margin, 1 + margin, (count, 3))
    m = field.volume.to_world
    points: Singles = (unit @ m[:3, :3].T + m[:3, 3]).astype(np.float32)
    return points


def lobes(phase: Phase, count: int = 1) -> Singles:
    """The phase function in `count` rows, (count, 3)."""
    return np.repeat(as_lobes(np.array([phase])), count, axis=0)


def trace(
    field: Field,
    points: Singles,
    w: Singles,
    phase: Phase,
    suns: Singles,
    albedos: list[float],
    walks: int,
    seed: int,
    lanes: int = 4096,
    connect: float = 1.0,
) -> Singles:
    """`trace_walks` with one phase function and one list of albedos; suns (n, k, 3) or (k, 3)."""
    n = len(points)
    suns = np.broadcast_to(suns, (n, *suns.shape[-2:]))
    columns = np.broadcast_to(np.array(albedos, np.float32), (n, len(albedos)))
    return trace_walks(field, points, w, lobes(phase, n), suns, columns, walks, seed, lanes=lanes, connect=connect)


def exit_distance(o: Floats, d: Floats) -> tuple[Floats, Floats]:
    """Where rays enter and leave the unit cube."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t0, t1 = -o / d, (1 - o) / d
    return np.maximum(np.minimum(t0, t1).max(axis=-1), 0), np.maximum(t0, t1).min(axis=-1)


def first_order(sigma: float, x: Floats, w: Floats, sun: Floats, phase: Phase) -> float:
    """4 pi J / (albedo^2 E) of the first order alone in a homogeneous unit cube, by quadrature over w' and the distance along it."""
    nodes, weights = np.polynomial.legendre.leggauss(48)
    # Directions drawn evenly from the phase function around w by its inverse distribution: only smooth factors are integrated.
    u = (np.arange(160) + 0.5) / 160
    parameters = [float(v) for v in lobes(phase)[0]]
    cosine = np.array(sample_two_lobe_cosine(backend().Float(u), *parameters), np.float64)
    azimuth = 2 * np.pi * (np.arange(160) + 0.5) / 160
    a = np.cross(w, np.eye(3)[np.argmin(np.abs(w))])
    a /= np.linalg.norm(a)
    b = np.cross(w, a)
    sine = np.sqrt(1 - cosine**2)[:, None, None]
    d = cosine[:, None, None] * w + sine * (np.cos(azimuth)[None, :, None] * a + np.sin(azimuth)[None, :, None] * b)
    d = d.reshape(-1, 3)
    enter, leave = exit_distance(x, d)
    met = leave > enter
    d, enter, length = d[met], enter[met], (leave - enter)[met]
    t = enter[:, None] + length[:, None] * (nodes + 1) / 2
    at = x + t[..., None] * d[:, None]
    _, toward = exit_distance(at, np.broadcast_to(sun, at.shape))
    along = np.sum(np.exp(-sigma * (t - enter[:, None] + toward)) * weights, axis=1) * length / 2 * sigma
    return float(np.sum(4 * np.pi * two_lobe_numpy(d @ sun, *parameters) * along)) / met.size


@pytest.mark.parametrize("phase", [-0.4, 0.0, 0.85, TWO_LOBES])
def test_first_order_in_a_homogeneous_cube(phase: Phase) -> None:
    """At albedo 0 the label is the first order alone; the points lie inside, at a face and outside of the cube."""
    x = np.array([[0.5, 0.5, 0.5], [0.1, 0.9, 0.3], [0.999, 0.4, 0.6], [-0.6, 0.5, 0.4]])
    w = np.array([sphere(1, 3)[0], [0, 0, -1], sphere(1, 4)[0], [1, 0.1, 0.05]], np.float64)
    w /= np.linalg.norm(w, axis=1, keepdims=True)
    suns = sphere(2, 5)
    walks = 1_000_000
    j = trace(cube(3.0), x.astype(np.float32), w.astype(np.float32), phase, suns, [0.0], walks, seed=6)[..., 0].astype(np.float64)
    mean, error = j.mean(axis=1), j.std(axis=1) / np.sqrt(walks)
    expected = np.array([[first_order(3.0, x[i], w[i], s, phase) for s in suns.astype(np.float64)] for i in range(4)])
    assert np.all(error / expected < 0.03)
    assert np.median(error / expected) < 0.015
    assert np.abs((mean - expected) / error).max() < 4


@pytest.mark.parametrize("phase", [0.0, 0.85, TWO_LOBES])
@pytest.mark.parametrize("make", [cube, cloud])
def test_white_furnace(make: type, phase: Phase) -> None:
    """At albedo 1 the mean over all suns of 4 pi p T + j is exactly 1, at every point and in every direction."""
    field: Field = make()
    n, k, walks = 48, 8, 220
    points, w = inside(field, n, 7, margin=0.15), sphere(n, 8)
    # k suns a point, spread evenly over the sphere and turned at random for each point; every walk serves them all.
    z = 1 - (2 * np.arange(k) + 1) / k
    spiral = np.pi * (1 + np.sqrt(5)) * np.arange(k)
    even = np.stack([np.sqrt(1 - z**2) * np.cos(spiral), np.sqrt(1 - z**2) * np.sin(spiral), z], axis=1)
    repeats = 40
    rows = np.repeat(np.arange(n), repeats)
    suns = np.stack([even @ rotation(1000 + i).T for i in range(n * repeats)]).astype(np.float32)
    j = trace(field, points[rows], w[rows], phase, suns, [1.0], walks, seed=9)
    multiple = j.mean(axis=(1, 2, 3)).reshape(n, repeats).astype(np.float64)

    # The mean of 4 pi p T over suns is that of T over suns drawn from p around w.
    t, draws = field.types, 4000
    rng = np.random.default_rng(10)
    parameters = [t.Float(float(v)) for v in lobes(phase)[0]]
    cosine = np.array(sample_two_lobe_cosine(t.Float(rng.random(n * draws)), *parameters), np.float64)
    azimuth = rng.uniform(0, 2 * np.pi, n * draws)
    w64 = w.astype(np.float64)
    a = np.cross(w64, np.eye(3)[np.argmin(np.abs(w64), axis=1)])
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    frame = np.repeat(np.stack([a, np.cross(w64, a), w64], axis=1), draws, axis=0)
    sine = np.sqrt(1 - cosine**2)
    toward = np.einsum("nc,ncd->nd", np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], axis=1), frame)
    start = np.repeat(points, draws, axis=0)
    o, d = (t.Array3f(*(t.Float(np.ascontiguousarray(v[:, c], np.float32)) for c in range(3))) for v in (start, toward))
    tau = optical_depth(field, o, d, t.Float(0), t.Float(1e4), t.Bool(np.ones(n * draws, bool)))
    single = np.exp(-np.array(tau, np.float64)).reshape(n, draws)

    point_mean = multiple.mean(axis=1) + single.mean(axis=1)
    point_error = np.sqrt(multiple.var(axis=1, ddof=1) / repeats + single.var(axis=1, ddof=1) / draws)
    mean, error = point_mean.mean(), np.sqrt(np.sum(point_error**2)) / n
    assert multiple.mean() > 0.3
    assert error < 0.005
    assert abs(mean - 1) < 4 * error, f"{mean:.4f} +- {error:.4f}"
    assert np.abs((point_mean - 1) / point_error).max() < 6.5


def test_albedos_share_a_walk() -> None:
    """The label grows with the albedo for every walk, and a column does not depend on which others are traced with it."""
    field = cloud()
    points, w, suns = inside(field, 100, 11), sphere(100, 12), sphere(3, 13)
    albedos = [0.0, 0.5, 0.9, 0.99, 1.0]
    j = trace(field, points, w, 0.7, suns, albedos, 64, seed=14)
    assert np.all(np.diff(j, axis=-1) >= -1e-5 * j[..., 1:])
    means = j.mean(axis=(0, 1, 2))
    assert np.all(np.diff(means) > 0.01 * means[-1])
    assert means[-1] > 3 * means[0]
    for m in (0, 2, 4):
        alone = trace(field, points, w, 0.7, suns, [albedos[m]], 64, seed=14)
        np.testing.assert_allclose(alone[..., 0], j[..., m], rtol=1e-4, atol=1e-5)


def test_orders_are_weighted_by_powers_of_the_albedo() -> None:
    """As a polynomial in the albedo a walk's label has the coefficients of its orders: all of them not negative, the first at albedo 0."""
    field = cube(1.0)
    points, w = inside(field, 64, 15), sphere(64, 16)
    grid = np.cos(np.pi * (np.arange(12) + 0.5) / 12) / 2 + 0.5
    j = trace(field, points, w, 0.0, sphere(1, 17), [0.0, *(float(v) for v in grid)], 512, seed=18)[:, :, 0].astype(np.float64)
    # Few walks in a thin cube collide more than twelve times, and those that do carry little weight in a mean.
    fit = np.polynomial.Polynomial.fit(grid, j[..., 1:].mean(axis=(0, 1)), 7, domain=(0, 1), window=(0, 1))
    orders = np.asarray(fit.coef, np.float64)
    assert orders[0] == pytest.approx(j[..., 0].mean(), rel=0.01)
    assert np.all(orders[:3] > 0)
    # Successive orders of isotropic scattering in a small cube fall by a nearly constant factor, below one.
    assert 0.15 < orders[1] / orders[0] < 0.6


def test_roulette_of_the_connections_keeps_the_mean() -> None:
    """Connecting always, as a rule and rarely give one mean, for each point and over all; rarer is noisier."""
    field = cloud()
    points, w, suns = inside(field, 60, 19), sphere(60, 20), sphere(2, 21)
    walks, noise = 3000, []
    sets = []
    for seed, connect in ((22, 1e9), (23, 1.0), (24, 0.2)):
        j = trace(field, points, w, 0.8, suns, [1.0], walks, seed=seed, connect=connect)[..., 0].astype(np.float64)
        sets.append((j.mean(axis=1), j.var(axis=1) / walks))
        noise.append(j.var(axis=1).mean())
    assert noise[2] > noise[0]
    for first, second in ((0, 1), (0, 2), (1, 2)):
        difference, variance = sets[first][0] - sets[second][0], sets[first][1] + sets[second][1]
        assert np.sqrt(variance.sum()) / sets[0][0].sum() < 0.02
        assert abs(difference.sum()) < 4 * np.sqrt(variance.sum())
        z = difference / np.sqrt(variance)
        assert np.abs(z).max() < stats.norm.isf(1e-3 / 2 / z.size)


@pytest.mark.parametrize("one_sun", [False, True])
def test_roulette_of_faint_walks_keeps_the_mean(one_sun: bool) -> None:
    """Under albedos of which a walk soon has little left, each point and over all; the least faint albedo decides."""
    field = cloud()
    points, w, suns = inside(field, 60, 66), sphere(60, 67), sphere(1, 68)
    albedos, walks = np.broadcast_to(np.array([0.5, 0.8], np.float32), (60, 2)), 20_000
    sets, same = [], 0.0
    for roulette, seed in ((False, 69), (True, 70)):
        own = np.broadcast_to(suns, (60, 1, 3))
        if one_sun:
            j = trace_one_sun(field, points, w, lobes(0.6, 60), own[:, 0], albedos, walks, seed, roulette=roulette)
        else:
            j = trace_walks(field, points, w, lobes(0.6, 60), own, albedos, walks, seed, roulette=roulette)[:, :, 0]
        sets.append((j.astype(np.float64).mean(axis=1), j.astype(np.float64).var(axis=1) / walks))
        same = np.count_nonzero(j) - same
    assert same < 0
    difference, variance = sets[0][0] - sets[1][0], sets[0][1] + sets[1][1]
    assert np.sqrt(variance.sum()) < 0.02 * sets[0][0].sum()
    assert abs(difference.sum()) < 4 * np.sqrt(variance.sum())
    assert np.abs(difference / np.sqrt(variance)).max() < stats.norm.isf(1e-3 / 2 / difference.size)


def test_lobes_of_one_kind_are_one_lobe() -> None:
    """A second lobe that is never chosen changes nothing; the lobes' order changes no mean; one lobe cut in two is that lobe."""
    field = cloud()
    points, w, suns, walks = inside(field, 60, 52), sphere(60, 53), sphere(1, 54), 8000
    single = trace(field, points, w, 0.7, suns, [1.0], walks, seed=55)
    # One other row with two lobes makes the walks evaluate both lobes everywhere.
    mixed = np.concatenate([lobes(0.7, 60), lobes(TWO_LOBES)])
    more = np.concatenate([points, points[:1]]), np.concatenate([w, w[:1]])
    both = trace_walks(field, more[0], more[1], mixed, np.broadcast_to(suns, (61, 1, 3)), np.ones((61, 1), np.float32), walks, seed=55)
    np.testing.assert_allclose(both[:60], single, rtol=1e-5)
    for first, second in (((0.7, 0.7, 0.3), 0.7), ((0.9, -0.4, 0.75), (-0.4, 0.9, 0.25))):
        sets = [trace(field, points, w, p, suns, [1.0], walks, seed=s)[..., 0].astype(np.float64) for p, s in ((first, 56), (second, 57))]
        difference = sets[0].mean(axis=1) - sets[1].mean(axis=1)
        variance = sum(v.var(axis=1) / walks for v in sets)
        assert np.sqrt(np.sum(variance)) < 0.02 * sets[1].mean(axis=1).sum()
        assert abs(difference.sum()) < 4 * np.sqrt(np.sum(variance))
        assert np.abs(difference / np.sqrt(variance)).max() < stats.norm.isf(1e-3 / 2 / difference.size)


def patches(brick: int | None) -> Field:
    """Separate dense lumps in a turned box that is mostly empty: many bricks of different majorants."""
    noise = ndimage.gaussian_filter(np.random.default_rng(58).normal(size=(24, 30, 36)), 2.0, mode="wrap")
    to_world = np.eye(4)
    to_world[:3, :3] = rotation(59) @ np.diag([1.3, 1.0, 0.8])
    volume = Volume(np.clip(noise - np.quantile(noise, 0.7), 0, None), to_world)
    return Field(backend(), volume, 6.0 / float(volume.density.mean()), brick=brick)


@pytest.mark.parametrize("phase", [0.0, TWO_LOBES])
def test_local_majorants_change_no_mean(phase: Phase) -> None:
    """Labels with bricks of two sizes against the readable twin, one majorant for the whole box: each point, and over all."""
    walks, sets = 12_000, []
    for brick, seed in ((None, 60), (4, 61), (2, 62)):
        field = patches(brick)
        points, w, suns = inside(field, 60, 63, margin=0.1), sphere(60, 64), sphere(1, 65)
        j = trace(field, points, w, phase, suns, [1.0], walks, seed=seed)[..., 0].astype(np.float64)
        sets.append((j.mean(axis=1), j.var(axis=1) / walks))
    for mean, variance in sets[1:]:
        difference, both = mean - sets[0][0], variance + sets[0][1]
        assert np.sqrt(both.sum()) / mean.sum() < 0.02
        assert abs(difference.sum()) < 4 * np.sqrt(both.sum())
        assert np.abs(difference / np.sqrt(both)).max() < stats.norm.isf(1e-3 / 2 / difference.size)


def test_lanes_change_nothing() -> None:
    field = cloud()
    points, w, suns = inside(field, 40, 25, margin=0.2), sphere(40, 26), sphere(4, 27)
    first = trace(field, points, w, 0.6, suns, [1.0, 0.5], 33, seed=28)
    assert (first > 0).mean() > 0.05
    for lanes in (1, 37, 512, 100_000):
        other = trace(field, points, w, 0.6, suns, [1.0, 0.5], 33, seed=28, lanes=lanes)
        # Threads differ in whether they flush subnormal numbers, such as 0.5 to the power 130.
        np.testing.assert_array_equal(np.where(other > 1e-30, other, 0), np.where(first > 1e-30, first, 0))


def test_a_seed_is_a_result_and_another_seed_another() -> None:
    field = cloud()
    points, w, suns = inside(field, 40, 29), sphere(40, 30), sphere(1, 31)
    first = trace(field, points, w, 0.6, suns, [1.0], 50, seed=32)
    np.testing.assert_array_equal(trace(field, points, w, 0.6, suns, [1.0], 50, seed=32), first)
    other = trace(field, points, w, 0.6, suns, [1.0], 50, seed=33)
    assert (other != first)[(other != 0) | (first != 0)].mean() > 0.95
    # A walk's stream depends on its number alone, so fewer points give the beginning of the same list.
    np.testing.assert_array_equal(trace(field, points[:17], w[:17], 0.6, suns, [1.0], 50, seed=32), first[:17])


def test_walks_and_seeds_are_independent() -> None:
    """The spread of means between seeds, and between neighbouring walks, is what independent walks give."""
    field = cloud()
    points = np.repeat(inside(field, 1, 34), 512, axis=0)
    w, suns, walks = np.repeat(sphere(1, 35), 512, axis=0), sphere(1, 36), 64
    within, means = [], []
    for seed in range(8):
        j = trace(field, points, w, 0.3, suns, [1.0], walks, seed=seed)[:, :, 0, 0].astype(np.float64)
        within.append(j.var())
        means.append(j.mean(axis=1))
    spread = np.var(np.concatenate(means)) * walks / np.mean(within)
    # 4096 means: their variance is known to some 2.5 %, a little worse for the skewness of the walks.
    assert spread == pytest.approx(1, abs=0.12)
    for lag in (1, 2, 64):
        neighbours = np.corrcoef(j.ravel()[:-lag], j.ravel()[lag:])[0, 1]
        assert abs(neighbours) < 5 / np.sqrt(j.size)
    seeds = np.corrcoef(np.stack(means))
    assert np.abs(seeds[np.triu_indices(8, 1)]).max() < 5 / np.sqrt(512)


@pytest.mark.parametrize("mirrored", [False, True])
def test_turning_or_mirroring_everything_changes_nothing(mirrored: bool) -> None:
    field = cloud()
    turn = rotation(37) @ (np.diag([1.0, -1, 1]) if mirrored else np.eye(3))
    moved = np.array(field.volume.to_world)
    moved[:3] = turn @ moved[:3]
    turned = Field(backend(), Volume(field.volume.density, moved), field.scale)
    points, w, suns = inside(field, 60, 38), sphere(60, 39), sphere(3, 40)
    walks = 1500
    first = trace(field, points, w, 0.7, suns, [1.0], walks, seed=41)[..., 0].astype(np.float64)
    singles = [(v @ turn.T).astype(np.float32) for v in (points, w, suns)]
    second = trace(turned, singles[0], singles[1], 0.7, singles[2], [1.0], walks, seed=42)[..., 0].astype(np.float64)
    difference, variance = first.mean(axis=1) - second.mean(axis=1), (first.var(axis=1) + second.var(axis=1)) / walks
    assert np.sqrt(variance.sum()) / first.mean(axis=1).sum() < 0.02
    assert abs(difference.sum()) < 4 * np.sqrt(variance.sum())
    z = difference / np.sqrt(variance)
    assert np.abs(z).max() < stats.norm.isf(1e-3 / 2 / z.size)


def test_points_outside_and_empty_space() -> None:
    field = cube(5.0)
    points = np.array([[0.5, 0.5, 3], [0.5, 0.5, 3], [50, 0.5, 0.5]], np.float32)
    w = np.array([[0, 0, 1], [0, 0, -1], [-1, 0, 0]], np.float32)
    suns = np.array([[0, 0, 1], [1, 0, 0]], np.float32)
    j = trace(field, points, w, 0.97, suns, [1.0], 4000, seed=43)
    means = j.mean(axis=1)[..., 0]
    # Looking away, all but the far wings of a narrow lobe miss the cube.
    assert np.all(means[0] < 0.05 * means[1])
    assert np.all(means[1:].sum(axis=1) > 0)
    empty = Field(backend(), Volume.from_box(np.zeros((3, 3, 3)), (0, 0, 0), (1, 1, 1)), 5.0)
    np.testing.assert_array_equal(trace(empty, points, w, 0.5, suns, [1.0], 10, seed=44), np.zeros((3, 10, 2, 1)))
    assert trace(field, points, w, 0.5, suns, [1.0], 0, seed=45).shape == (3, 0, 2, 1)
    assert trace(field, points[:0], w[:0], 0.5, np.zeros((0, 2, 3), np.float32), [1.0], 5, seed=45).shape == (0, 5, 2, 1)


def test_padding_the_box_with_nothing_changes_nothing() -> None:
    """Empty voxels around the grid leave the medium as it was, if the outermost samples already are empty."""
    density = np.pad(np.random.default_rng(46).random((6, 6, 6)).astype(np.float32), 1)
    tight = Field(backend(), Volume.from_box(density, (0, 0, 0), (8, 8, 8)), 0.5)
    padded = Field(backend(), Volume.from_box(np.pad(density, 3), (-3, -3, -3), (11, 11, 11)), 0.5)
    points, w, suns = inside(tight, 60, 47), sphere(60, 48), sphere(2, 49)
    results = [trace(f, points, w, 0.5, suns, [1.0], 1500, seed=s)[..., 0].astype(np.float64) for f, s in ((tight, 50), (padded, 51))]
    difference = results[0].mean(axis=1) - results[1].mean(axis=1)
    variance = sum(r.var(axis=1) / 1500 for r in results)
    assert abs(difference.sum()) < 4 * np.sqrt(np.sum(variance))
