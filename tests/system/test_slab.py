"""Plane-parallel slabs against the discrete-ordinate method.

Rationale: PythonicDISORT solves the transfer equation without a random number and knows nothing of this code.
Expected behaviour: reflected and transmitted flux of a homogeneous slab under a sun at normal incidence, measured at the centre of a
box sixty thicknesses wide by the tracker as a full renderer, agree with it within 1 % and within four standard errors.
"""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from numpy.typing import NDArray

from deepclouds.backend import backend
from deepclouds.medium.field import Field
from deepclouds.medium.first_collision import first_collisions
from deepclouds.medium.multiple_scattering import trace_walks
from deepclouds.medium.optical_depth import optical_depth
from deepclouds.medium.phase import hg_numpy
from deepclouds.volume import Volume

Floats = NDArray[np.float64]
SUN = np.array([0.0, 0, 1])
# Optical depth, albedo, g, and the published reflected and transmitted flux.
ROWS = [
    (1.0, 1.0, 0.0, 0.34133, 0.65867),
    (8.0, 1.0, 0.0, 0.82181, 0.17819),
    (2.0, 1.0, 0.75, 0.16318, 0.83682),
    (8.0, 1.0, 0.85, 0.35843, 0.64157),
    (1.0, 0.99, 0.0, 0.33292, 0.65098),
]


def disort(tau: float, albedo: float, g: float) -> tuple[float, float]:
    """Reflected flux, and transmitted flux with the unscattered beam, both over the incident one."""
    pydisort = pytest.importorskip("PythonicDISORT").pydisort
    streams = 48
    coefficients = g ** np.arange(4 * streams)
    peak = coefficients[streams]
    with warnings.catch_warnings():
        # It warns near albedo 1; the published table shows that five digits survive.
        warnings.filterwarnings("ignore", message=".*albedos are very close to 1")
        _, up, down = pydisort(
            tau, min(albedo, 1 - 1e-9), streams, coefficients[None], 1.0, 1.0, 0.0, NLeg=streams, only_flux=True, f_arr=peak
        )[:3]
    diffuse, direct = down(tau)
    return float(up(0)), float(diffuse + direct)


def leaving_flux(tau: float, albedo: float, g: float, top: bool, rays: int, seed: int) -> tuple[float, float]:
    """Diffuse flux that leaves the slab through its centre, over the sun's irradiance, and its standard error.

    pi times the mean radiance along rays with cosine-distributed directions: every ray goes to its first collision, where the sun
    arrives attenuated (S1) and one walk estimates J.
    """
    field = Field(backend(), Volume.from_box(np.ones((3, 3, 3)), (-30, -30, 0), (30, 30, 1)), tau)
    streams = np.random.SeedSequence(seed).spawn(3)
    rng = np.random.default_rng(streams[0])
    cosine, azimuth = np.sqrt(1 - rng.random(rays)), rng.uniform(0, 2 * np.pi, rays)
    sine = np.sqrt(1 - cosine**2)
    side = -1.0 if top else 1.0
    w = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), side * cosine], axis=1).astype(np.float32)
    origin = np.tile(np.array([0, 0, 1.001 if top else -0.001], np.float32), (rays, 1))
    seeds = [int(s.generate_state(1)[0]) for s in streams[1:]]
    points, hit = first_collisions(field, origin, w, seed=seeds[0])
    points, w = points[hit], w[hit]

    t = field.types
    n = len(points)
    o = t.Array3f(*(t.Float(np.ascontiguousarray(points[:, c])) for c in range(3)))
    depth = optical_depth(field, o, t.Array3f(0, 0, 1), t.Float(0), t.Float(1e4), t.Float(0.5), t.Bool(np.ones(n, bool)))
    single = albedo * hg_numpy(w @ SUN, g) * np.exp(-np.array(depth, np.float64))
    suns = np.broadcast_to(SUN.astype(np.float32), (n, 1, 3))
    j = trace_walks(field, points, w, np.full(n, g, np.float32), suns, np.full((n, 1), albedo, np.float32), 1, seed=seeds[1])
    radiance = np.zeros(rays)
    radiance[hit] = single + albedo**2 / (4 * np.pi) * j[:, 0, 0, 0]
    return float(np.pi * radiance.mean()), float(np.pi * radiance.std() / np.sqrt(rays))


@pytest.mark.parametrize(("tau", "albedo", "g", "reflected", "transmitted"), ROWS)
def test_disort_reproduces_the_published_table(tau: float, albedo: float, g: float, reflected: float, transmitted: float) -> None:
    assert disort(tau, albedo, g) == pytest.approx((reflected, transmitted), abs=2e-5)


@pytest.mark.parametrize(("tau", "albedo", "g", "reflected", "transmitted"), ROWS)
def test_the_tracker_reproduces_the_table(tau: float, albedo: float, g: float, reflected: float, transmitted: float) -> None:
    rays = 1_500_000
    up, up_error = leaving_flux(tau, albedo, g, top=True, rays=rays, seed=1)
    down, down_error = leaving_flux(tau, albedo, g, top=False, rays=rays, seed=2)
    down += np.exp(-tau)
    for found, error, expected in ((up, up_error, reflected), (down, down_error, transmitted)):
        assert error < 0.0035 * expected
        assert abs(found - expected) < 4 * error, f"{found:.5f} +- {error:.5f}, expected {expected:.5f}"
        assert abs(found / expected - 1) < 0.01
    if albedo == 1:
        assert abs(up + down - 1) < 4 * np.hypot(up_error, down_error)


@pytest.mark.slow
@pytest.mark.parametrize(("tau", "albedo", "g"), [(0.2, 0.5, -0.3), (4.0, 0.9, 0.6), (16.0, 0.999, 0.85), (30.0, 1.0, 0.5)])
def test_the_tracker_against_disort_beyond_the_table(tau: float, albedo: float, g: float) -> None:
    expected = disort(tau, albedo, g)
    for top, value, beam in ((True, expected[0], 0.0), (False, expected[1], np.exp(-tau))):
        found, error = leaving_flux(tau, albedo, g, top, rays=2_000_000, seed=3)
        assert error < 0.005 * value
        assert abs(found + beam - value) < 4 * error, f"{found + beam:.5f} +- {error:.5f}, expected {value:.5f}"
