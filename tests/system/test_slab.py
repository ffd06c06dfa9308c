"""Plane-parallel slabs: against the discrete-ordinate method, order by order against integral equations, and reciprocity.

Rationale: PythonicDISORT solves the transfer equation without a random number and knows nothing of this code; for isotropic scattering
every order is an integral over exponential integrals; and light may be followed either way.
Expected behaviour: reflected and transmitted flux of a homogeneous slab, measured at the centre of a box sixty thicknesses wide by the
tracker as a full renderer, agree within four standard errors, for one lobe and for two, at two heights of the sun; so do single orders
inside the slab, and what is seen when sun and view change places.
"""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import special

from deepclouds.backend import backend
from deepclouds.medium.field import Field
from deepclouds.medium.multiple_scattering import trace_walks
from deepclouds.volume import Volume
from tests.system.full_renderer import radiance

Floats = NDArray[np.float64]
Phase = float | tuple[float, float, float]
# Optical depth, albedo, g, and the published reflected and transmitted flux.
ROWS = [
    (1.0, 1.0, 0.0, 0.34133, 0.65867),
    (8.0, 1.0, 0.0, 0.82181, 0.17819),
    (2.0, 1.0, 0.75, 0.16318, 0.83682),
    (8.0, 1.0, 0.85, 0.35843, 0.64157),
    (1.0, 0.99, 0.0, 0.33292, 0.65098),
]
TWO_LOBES = (0.85, -0.3, 0.9)
ALBEDOS = (1.0, 0.99, 0.9)
# Cosines of the sun's zenith angle: overhead and 60 degrees.
HEIGHTS = (1.0, 0.5)


def slab(tau: float) -> Field:
    """A homogeneous box, 60 x 60 x 1, of optical depth `tau` from top to bottom; its centre sees no side."""
    return Field(backend(), Volume.from_box(np.ones((3, 3, 3)), (-30, -30, 0), (30, 30, 1)), tau)


def sun_at(height: float, azimuth: float = 0.0) -> Floats:
    """Unit vector at this cosine of the zenith angle."""
    sine = np.sqrt(1 - height**2)
    return np.array([sine * np.cos(azimuth), sine * np.sin(azimuth), height])


def disort(tau: float, albedo: float, phase: Phase, height: float = 1.0) -> tuple[float, float]:
    """Reflected flux, and transmitted flux with the unscattered beam, both over the irradiance perpendicular to the sun."""
    pydisort = pytest.importorskip("PythonicDISORT").pydisort
    streams = 48
    g1, g2, weight = (phase, 0.0, 1.0) if isinstance(phase, float) else phase
    order = np.arange(4 * streams)
    coefficients = weight * g1**order + (1 - weight) * g2**order
    peak = coefficients[streams]
    with warnings.catch_warnings():
        # It warns near albedo 1; the published table shows that five digits survive.
        warnings.filterwarnings("ignore", message=".*albedos are very close to 1")
        _, up, down = pydisort(
            tau, min(albedo, 1 - 1e-9), streams, coefficients[None], height, 1.0, 0.0, NLeg=streams, only_flux=True, f_arr=peak
        )[:3]
    diffuse, direct = down(tau)
    return float(up(0)), float(diffuse + direct)


def leaving_flux(
    tau: float, albedos: tuple[float, ...], phase: Phase, heights: tuple[float, ...], top: bool, rays: int, seed: int
) -> tuple[Floats, Floats]:
    """Diffuse flux that leaves the slab through its centre over each sun's irradiance, and its standard error: (suns, albedos) each.

    It is pi times the mean radiance along rays with cosine-distributed directions.
    """
    rng = np.random.default_rng(seed)
    # Strata in the cosine take away some noise; the strata's own variance makes the error below an upper bound.
    cosine, azimuth = np.sqrt((np.arange(rays) + rng.random(rays)) / rays), rng.uniform(0, 2 * np.pi, rays)
    cosine = np.maximum(cosine, 1e-4)
    sine = np.sqrt(1 - cosine**2)
    side = -1.0 if top else 1.0
    w = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), side * cosine], axis=1).astype(np.float32)
    origin = np.tile(np.array([0, 0, 1.001 if top else -0.001], np.float32), (rays, 1))
    seen = radiance(slab(tau), origin, w, phase, [sun_at(h) for h in heights], albedos, seed)
    return np.pi * seen.mean(axis=0), np.pi * seen.std(axis=0) / np.sqrt(rays)


@pytest.mark.parametrize(("tau", "albedo", "g", "reflected", "transmitted"), ROWS)
def test_disort_reproduces_the_published_table(tau: float, albedo: float, g: float, reflected: float, transmitted: float) -> None:
    assert disort(tau, albedo, g) == pytest.approx((reflected, transmitted), abs=2e-5)


@pytest.mark.parametrize(("tau", "albedo", "g", "reflected", "transmitted"), ROWS)
def test_the_tracker_reproduces_the_table(tau: float, albedo: float, g: float, reflected: float, transmitted: float) -> None:
    rays = 1_500_000
    (up, up_error), (down, down_error) = (
        (float(v[0, 0]) for v in leaving_flux(tau, (albedo,), g, (1.0,), top, rays, seed)) for top, seed in ((True, 1), (False, 2))
    )
    down += np.exp(-tau)
    for found, error, expected in ((up, up_error, reflected), (down, down_error, transmitted)):
        assert error < 0.0035 * expected
        assert abs(found - expected) < 4 * error, f"{found:.5f} +- {error:.5f}, expected {expected:.5f}"
        assert abs(found / expected - 1) < 0.01
    if albedo == 1:
        assert abs(up + down - 1) < 4 * np.hypot(up_error, down_error)


def check_against_disort(tau: float, phase: Phase, albedos: tuple[float, ...], rays: int, seed: int, precision: float) -> None:
    """Both fluxes at both heights of the sun within four standard errors, which are below `precision` of the flux or 0.0005."""
    for top in (True, False):
        found, error = leaving_flux(tau, albedos, phase, HEIGHTS, top, rays, seed + top)
        for k, height in enumerate(HEIGHTS):
            beam = 0.0 if top else height * np.exp(-tau / height)
            for m, albedo in enumerate(albedos):
                expected = disort(tau, albedo, phase, height)[0 if top else 1]
                case = (
                    f"top {top}, cosine {height}, albedo {albedo}: {found[k, m] + beam:.5f} +- {error[k, m]:.5f}, expected {expected:.5f}"
                )
                assert error[k, m] < max(precision * expected, 5e-4), case
                assert abs(found[k, m] + beam - expected) < 4 * error[k, m] + 2e-5, case


@pytest.mark.slow
@pytest.mark.parametrize("g", [0.0, 0.5, 0.85])
@pytest.mark.parametrize("tau", [0.5, 2.0, 8.0, 32.0])
def test_the_tracker_against_disort(tau: float, g: float) -> None:
    check_against_disort(tau, g, ALBEDOS, rays=800_000 if g > 0.8 else 300_000, seed=10, precision=0.012)


@pytest.mark.parametrize("tau", [0.5, 8.0])
def test_two_lobes_against_disort(tau: float) -> None:
    check_against_disort(tau, TWO_LOBES, ALBEDOS, rays=400_000, seed=20, precision=0.012)


@pytest.mark.slow
@pytest.mark.parametrize(("tau", "albedo", "g"), [(0.2, 0.5, -0.3), (30.0, 1.0, 0.5)])
def test_the_tracker_against_disort_beyond_the_table(tau: float, albedo: float, g: float) -> None:
    check_against_disort(tau, g, (albedo,), rays=800_000, seed=30, precision=0.008)


def isotropic_orders(tau: float, height: float, cells: int) -> tuple[Floats, Floats, Floats]:
    """Depths of the cells' middles, the sun's attenuation there, and the operator Lambda that takes one order's source to the next.

    ``(Lambda S)(t) = 1/2 int E1(|t - t'|) S(t') dt'`` (Chandrasekhar 1960, chapter 1): the kernel is integrated exactly over each cell,
    where E2 is minus the integral of E1.
    """
    edges = np.linspace(0, tau, cells + 1)
    middle = 0.5 * (edges[1:] + edges[:-1])
    distance = edges[None] - middle[:, None]
    # Antiderivative of E1(|s|): odd, zero at zero.
    primitive = np.sign(distance) * (1 - special.expn(2, np.abs(distance)))
    operator: Floats = 0.5 * np.diff(primitive, axis=1)
    edge_light = np.exp(-edges / height)
    sunlight: Floats = height * -np.diff(edge_light) / np.diff(edges)
    return middle, sunlight, operator


def test_the_orders_integral_equation_reproduces_the_published_table() -> None:
    """Flux out of the top from the integral equation: half of E2 times the source, at albedo 1 and g 0."""
    for tau, albedo, g, reflected, _ in ROWS:
        if g == 0:
            middle, light, operator = isotropic_orders(tau, 1.0, 1600)
            source = albedo * np.linalg.solve(np.eye(len(middle)) - albedo * operator, light)
            up = 0.5 * float(np.sum(special.expn(2, middle) * source)) * tau / len(middle)
            assert up == pytest.approx(reflected, abs=5e-5)


@pytest.mark.parametrize("height", HEIGHTS)
def test_orders_one_by_one(height: float) -> None:
    """Inside an isotropic slab the first order, the second, and the sum of all at several albedos are those of the integral equation.

    The label's first order has albedo 0. The second is the slope there, from the same walks at a tiny albedo.
    """
    tau, tiny, walks = 4.0, 1e-2, 500_000
    albedos = (0.0, tiny, 0.5, 0.95, 1.0)
    middle, light, operator = isotropic_orders(tau, height, 1000)
    exact = [np.linalg.solve(np.eye(len(middle)) - a * operator, operator @ light) for a in albedos]
    depth = np.array([0.05, 0.6, 2.0, 3.9])
    points = np.stack([0 * depth, 0 * depth, 1 - depth / tau], axis=1).astype(np.float32)
    suns = np.broadcast_to(sun_at(height).astype(np.float32), (4, 1, 3))
    w = np.array([[1, 0, 0], [0, 0.6, 0.8], [0, 0, -1], [0, 0, 1]], np.float32)
    columns = np.broadcast_to(np.array(albedos, np.float32), (4, len(albedos)))
    j = trace_walks(slab(tau), points, w, np.zeros(4, np.float32), suns, columns, walks, seed=40)[:, :, 0].astype(np.float64)

    def check(values: Floats, expected: Floats, precision: float) -> None:
        mean, error = values.mean(axis=1), values.std(axis=1) / np.sqrt(walks)
        # The deepest point is dark: the sun is seen once in hundreds of walks.
        assert np.all(error < 4 * precision * expected)
        assert np.median(error / expected) < precision
        assert np.all(np.abs(mean - expected) < 4 * error + 2e-4 * expected), ((mean - expected) / error, error / expected)

    for m in range(len(albedos)):
        check(j[..., m], np.interp(depth, middle, exact[m]), 0.008)
    # The same finite difference on both sides: no error of linearisation.
    check((j[..., 1] - j[..., 0]) / tiny, np.interp(depth, middle, (exact[1] - exact[0]) / tiny), 0.015)
    second = operator @ operator @ light
    slope = np.interp(depth, middle, (exact[1] - exact[0]) / tiny)
    np.testing.assert_allclose(slope, np.interp(depth, middle, second), rtol=0.02)


@pytest.mark.parametrize("phase", [0.6, TWO_LOBES])
def test_sun_and_view_change_places(phase: Phase) -> None:
    """Reciprocity of the reflection: radiance toward v under a sun at s, over the cosine of s, is the same with s and v exchanged."""
    field, rays = slab(5.0), 400_000
    first, second = sun_at(0.9), sun_at(0.35, azimuth=2.2)
    seen = []
    for seed, (view, sun) in enumerate(((first, second), (second, first))):
        # A ray travels against the direction toward the viewer.
        w = np.tile((-view).astype(np.float32), (rays, 1))
        origin = np.tile((np.array([0, 0, 1]) + 0.01 * view).astype(np.float32), (rays, 1))
        values = radiance(field, origin, w, phase, [sun], ALBEDOS, 50 + seed)[:, 0] / sun[2]
        seen.append((values.mean(axis=0), values.std(axis=0) / np.sqrt(rays)))
    difference, error = seen[0][0] - seen[1][0], np.hypot(seen[0][1], seen[1][1])
    assert np.all(error < 0.012 * seen[0][0])
    assert np.all(np.abs(difference) < 4 * error), difference / error
    # Without the cosines the two differ by far more than the error: the test could fail.
    assert np.all(np.abs(seen[0][0] * second[2] - seen[1][0] * first[2]) > 20 * error)
