"""Phase functions: normalisation, sampling by chi-square (and the power of that test), and the rotation around a direction."""

from __future__ import annotations

import drjit as dr
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import integrate, stats

from deepclouds.backend import backend
from deepclouds.medium.phase import (
    as_lobes,
    hg,
    hg_numpy,
    inverse_hg,
    ordered_lobes,
    rotate_to,
    sample_hg,
    sample_hg_cosine,
    sample_two_lobe_cosine,
    two_lobe,
    two_lobe_numpy,
)

Floats = NDArray[np.float64]
ASYMMETRIES = [-0.99, -0.85, -0.3, 0.0, 0.002, 0.2, 0.6, 0.85, 0.95, 0.99]


def cosines(g: float, count: int, seed: int) -> Floats:
    t = backend()
    u = np.random.default_rng(seed).random(count, dtype=np.float32)
    return np.array(sample_hg_cosine(t.Float(u), t.Float(g)), np.float64)


def chi_square(samples: Floats, g1: float, g2: float = 0.0, weight: float = 1.0, bins: int = 48) -> float:
    """p-value of "the cosines follow these lobes"; bins of equal probability, by quadrature of the density alone."""
    # Nodes crowd where the density peaks, at both ends: 1 - |cos| runs over seven decades.
    gap = np.concatenate([[0.0], np.geomspace(1e-7, 1, 20001)])
    c = np.concatenate([gap - 1, 1 - gap[-2::-1]])
    density = 2 * np.pi * two_lobe_numpy(c, g1, g2, weight)
    cumulative = np.concatenate([[0.0], np.cumsum(np.diff(c) * (density[1:] + density[:-1]) / 2)])
    assert cumulative[-1] == pytest.approx(1, abs=1e-5)
    edges = np.interp(np.arange(1, bins) / bins, cumulative / cumulative[-1], c)
    observed = np.bincount(np.searchsorted(edges, samples), minlength=bins)
    return float(stats.chisquare(observed).pvalue)


@pytest.mark.parametrize("g", ASYMMETRIES)
def test_value_equals_its_twin_and_integrates_to_one(g: float) -> None:
    single = float(np.float32(g))
    total, _ = integrate.quad(lambda c: 2 * np.pi * float(hg_numpy(c, single)), -1, 1, points=[np.sign(g) * 0.999], limit=200)
    assert total == pytest.approx(1, abs=1e-7)
    mean, _ = integrate.quad(lambda c: 2 * np.pi * c * float(hg_numpy(c, single)), -1, 1, points=[np.sign(g) * 0.999], limit=200)
    assert mean == pytest.approx(single, abs=1e-7)

    t = backend()
    c = np.concatenate([np.linspace(-1, 1, 2001), 1 - np.geomspace(1e-7, 1, 200), np.geomspace(1e-7, 1, 200) - 1]).astype(np.float32)
    found = np.array(hg(t.Float(c), t.Float(single)), np.float64)
    np.testing.assert_allclose(found, hg_numpy(c, single), rtol=3e-5)


@pytest.mark.parametrize("g", ASYMMETRIES)
def test_a_sampled_cosine_is_that_of_the_textbook_and_comes_with_its_inverse_density(g: float) -> None:
    t, single = backend(), float(np.float32(g))
    u = np.concatenate([np.linspace(0, 1, 4096, endpoint=False), np.geomspace(1e-7, 1e-2, 50)]).astype(np.float32)
    beside, inverse = (np.array(v, np.float64) for v in sample_hg(t.Float(u), t.Float(single)))
    ratio = (1 - single**2) / (1 - single + 2 * single * u.astype(np.float64))
    textbook = 2 * u.astype(np.float64) - 1 if g == 0 else (1 + single**2 - ratio**2) / (2 * single)
    # 1 - g is known to float32's last digit, which counts where a lobe is narrow.
    np.testing.assert_allclose(1 - beside, textbook, atol=2e-5)
    np.testing.assert_allclose(inverse * hg_numpy(textbook, single), 1, rtol=1e-4)
    found = np.array(inverse_hg(t.Float(textbook.astype(np.float32)), t.Float(single)), np.float64)
    np.testing.assert_allclose(found * hg_numpy(textbook.astype(np.float32), single), 1, rtol=3e-5)


def test_positive_g_is_bright_looking_into_the_sun() -> None:
    forward, backward = hg_numpy(1, 0.8), hg_numpy(-1, 0.8)
    assert forward == pytest.approx((1 - 0.64) / (4 * np.pi * 0.2**3))
    assert backward == pytest.approx((1 - 0.64) / (4 * np.pi * 1.8**3))


@pytest.mark.parametrize("g", ASYMMETRIES)
def test_sampled_cosines_follow_the_density(g: float) -> None:
    samples = cosines(g, 400_000, seed=11)
    assert samples.min() >= -1
    assert samples.max() <= 1
    assert chi_square(samples, float(np.float32(g))) > 1e-3
    deviation = samples.std() / np.sqrt(len(samples))
    assert samples.mean() == pytest.approx(g, abs=4 * deviation)


@pytest.mark.parametrize(("g", "wrong"), [(0.0, 0.02), (0.6, 0.61), (0.85, 0.855), (-0.3, -0.32), (0.99, 0.9905)])
def test_the_chi_square_has_power(g: float, wrong: float) -> None:
    assert chi_square(cosines(wrong, 400_000, seed=12), g) < 1e-6


def test_the_chi_square_keeps_its_level() -> None:
    p = [chi_square(cosines(0.7, 20_000, seed=100 + i), 0.7) for i in range(100)]
    assert stats.kstest(p, "uniform").pvalue > 1e-3


def test_nearly_isotropic_lobes_stay_within_a_thousandth() -> None:
    for g in (-9e-4, 1e-5, 9e-4):
        samples = cosines(g, 1_000_000, seed=13)
        assert abs(samples.mean() - g) < 1e-3 + 4 * samples.std() / 1000


# The second is nearly that of cloud droplets: a forward peak and a weak backward lobe.
LOBES = [(0.85, -0.5, 0.8), (0.95, -0.3, 0.97), (0.99, -0.99, 0.5), (0.0, 0.9, 0.25), (0.6, 0.7, 0.0), (-0.4, 0.2, 1.0)]


def lobe_cosines(lobes: tuple[float, float, float], count: int, seed: int) -> Floats:
    t = backend()
    u = np.random.default_rng(seed).random(count, dtype=np.float32)
    return np.array(sample_two_lobe_cosine(t.Float(u), *(t.Float(v) for v in lobes)), np.float64)


@pytest.mark.parametrize("lobes", LOBES)
def test_two_lobes_equal_their_twin_integrate_to_one_and_have_their_mean(lobes: tuple[float, float, float]) -> None:
    g1, g2, weight = (float(np.float32(v)) for v in lobes)
    for power, expected in ((0, 1.0), (1, weight * g1 + (1 - weight) * g2), (2, None)):
        moment, _ = integrate.quad(
            lambda c, n=power: 2 * np.pi * c**n * float(two_lobe_numpy(c, g1, g2, weight)), -1, 1, points=[-0.999, 0.999], limit=400
        )
        # The second Legendre moment of HG is g^2.
        second = (1 + 2 * (weight * g1**2 + (1 - weight) * g2**2)) / 3
        assert moment == pytest.approx(second if expected is None else expected, abs=1e-7)
    t = backend()
    c = np.concatenate([np.linspace(-1, 1, 2001), 1 - np.geomspace(1e-7, 1, 200), np.geomspace(1e-7, 1, 200) - 1]).astype(np.float32)
    found = np.array(two_lobe(t.Float(c), t.Float(g1), t.Float(g2), t.Float(weight)), np.float64)
    np.testing.assert_allclose(found, two_lobe_numpy(c, g1, g2, weight), rtol=3e-5)


@pytest.mark.parametrize("lobes", LOBES)
def test_sampled_cosines_of_two_lobes_follow_the_density(lobes: tuple[float, float, float]) -> None:
    samples = lobe_cosines(lobes, 400_000, seed=16)
    g1, g2, weight = (float(np.float32(v)) for v in lobes)
    assert samples.min() >= -1
    assert samples.max() <= 1
    assert chi_square(samples, g1, g2, weight) > 1e-3
    for power, expected in ((1, weight * g1 + (1 - weight) * g2), (2, (1 + 2 * (weight * g1**2 + (1 - weight) * g2**2)) / 3)):
        moment = samples**power
        assert moment.mean() == pytest.approx(expected, abs=4 * moment.std() / np.sqrt(len(moment)))


@pytest.mark.parametrize("wrong", [(0.855, -0.5, 0.8), (0.85, -0.52, 0.8), (0.85, -0.5, 0.81), (0.85, 0.5, 0.8)])
def test_the_chi_square_sees_each_parameter_of_two_lobes(wrong: tuple[float, float, float]) -> None:
    assert chi_square(lobe_cosines(wrong, 400_000, seed=17), 0.85, -0.5, 0.8) < 1e-6


def test_phase_functions_become_rows_of_lobes() -> None:
    np.testing.assert_array_equal(as_lobes(np.array([0.5, -0.2])), np.array([[0.5, 0, 1], [-0.2, 0, 1]], np.float32))
    rows = np.array([[0.9, -0.3, 0.7]], np.float32)
    np.testing.assert_array_equal(as_lobes(rows), rows)
    for bad in (np.ones((2, 2)), np.array([1.0]), np.array([[0.5, -1.0, 0.5]]), np.array([[0.5, 0, 1.1]]), np.array([np.nan])):
        with pytest.raises(ValueError, match="phase function"):
            as_lobes(bad)


def directions(count: int) -> NDArray[np.float32]:
    d = np.random.default_rng(14).normal(size=(count, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    d[:6] = np.concatenate([np.eye(3), -np.eye(3)])
    d[6], d[7] = (0, 1e-4, -1), (1e-4, 0, 1)
    unit: NDArray[np.float32] = (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)
    return unit


def rotate(d: NDArray[np.float32], cosine: Floats, azimuth: Floats) -> Floats:
    t = backend()
    turned = rotate_to(t.Array3f(*(t.Float(np.ascontiguousarray(d[:, c])) for c in range(3))), t.Float(cosine), t.Float(azimuth))
    return np.array(turned, np.float64).T


def test_rotate_to_keeps_the_angle_in_a_right_handed_frame() -> None:
    n = 4000
    d, rng = directions(n), np.random.default_rng(15)
    cosine, azimuth = rng.uniform(-1, 1, n), rng.uniform(0, 2 * np.pi, n)
    turned = rotate(d, cosine, azimuth)
    np.testing.assert_allclose(np.linalg.norm(turned, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(np.sum(turned * d, axis=1), cosine, atol=2e-6)

    x, y = rotate(d, np.zeros(n), np.zeros(n)), rotate(d, np.zeros(n), np.full(n, np.pi / 2))
    np.testing.assert_allclose(np.cross(x, y), d, atol=3e-6)
    sine = np.sqrt(1 - cosine**2)[:, None]
    expected = sine * (np.cos(azimuth)[:, None] * x + np.sin(azimuth)[:, None] * y) + cosine[:, None] * d
    np.testing.assert_allclose(turned, expected, atol=5e-6)


def test_rotate_to_at_the_ends_of_the_range() -> None:
    d = directions(50)
    np.testing.assert_allclose(rotate(d, np.ones(50), np.full(50, 1.0)), d, atol=1e-6)
    np.testing.assert_allclose(rotate(d, -np.ones(50), np.full(50, 1.0)), -d, atol=1e-6)
    assert not dr.any(dr.isnan(backend().Float(rotate(d, np.full(50, np.nextafter(1, 2)), np.zeros(50)).ravel())))


def test_ordered_lobes_are_the_same_phase_function_in_one_form() -> None:
    cosine = np.linspace(-1, 1, 33)
    for phase in (
        (0.8, -0.3, 0.7),
        (-0.3, 0.8, 0.3),
        (0.5, -0.2, 0.5),
        (-0.2, 0.5, 0.5),
        (0.6, 0.1, 1.0),
        (0.1, 0.6, 0.0),
        (0.4, 0.4, 0.2),
    ):
        ordered = ordered_lobes(phase)
        np.testing.assert_allclose(two_lobe_numpy(cosine, *ordered), two_lobe_numpy(cosine, *phase), rtol=1e-12)
        assert ordered[2] >= 0.5
    assert ordered_lobes((-0.3, 0.8, 0.3)) == (0.8, -0.3, 0.7)
    assert ordered_lobes((-0.2, 0.5, 0.5)) == ordered_lobes((0.5, -0.2, 0.5)) == (0.5, -0.2, 0.5)
    assert ordered_lobes((0.1, 0.6, 0.0)) == (0.6, 0.0, 1.0)
