"""Plane-parallel slabs: reflected and transmitted flux with the network's J against the discrete-ordinate method (PythonicDISORT).

The network sees a box sixty thicknesses wide and is asked on the line through its centre. What leaves the slab is integrated without an
image: over directions by Gauss quadrature, along each of them by Gauss quadrature in the share that reaches the surface. Single scattering
and the unscattered beam, which no network predicts, are exact.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from deepclouds_runtime import predict
from deepclouds_runtime.scattering import Predicts
from numpy.typing import NDArray

from benchmarks.accuracy_figures import Row, bootstrap
from deepclouds.errors import InputError
from deepclouds.volume import Volume

Floats = NDArray[np.float64]
DEPTHS = (0.5, 2.0, 8.0, 32.0, 128.0)
ASYMMETRIES = (0.0, 0.6, 0.85)
ALBEDOS = (1.0, 0.99, 0.9)
# Cosines of the sun's zenith angle: 0 and 60 degrees.
HEIGHTS = (1.0, 0.5)
_HALF_WIDTH = 30.0
# Relative errors count for fluxes above this share of the sun's.
_LIT = 0.01
_COSINES, _AZIMUTHS, _ALONG = 16, 12, 16
_STREAMS = 48
# J / E: (optical depth below the top (n,), unit vectors w (n, 3)) -> (n,).
Source = Callable[[Floats, Floats], Floats]


@dataclass(frozen=True)
class Slab:
    """One case: optical depth, asymmetry, albedo, cosine of the sun's zenith angle; Z is up and the sun lies over the X axis."""

    tau: float
    g: float
    albedo: float
    height: float

    @property
    def omega_sun(self) -> Floats:
        """Unit vector TOWARD the sun."""
        return np.array([math.sqrt(1 - self.height**2), 0.0, self.height])

    @property
    def zenith(self) -> float:
        """The sun's zenith angle, degrees."""
        return math.degrees(math.acos(self.height))


@dataclass(frozen=True)
class SlabResult:
    """Reflected and transmitted flux over the irradiance perpendicular to the sun, as found and by the discrete-ordinate method."""

    slab: Slab
    found: tuple[float, float]
    exact: tuple[float, float]

    @property
    def line(self) -> str:
        """As text."""
        s, (up, down), (exact_up, exact_down) = self.slab, self.found, self.exact
        where = f"depth {s.tau:g}, g {s.g}, albedo {s.albedo}, sun at {s.zenith:.0f} degrees"
        return f"slabs    {where}: reflected {up:.4f} (exact {exact_up:.4f}), transmitted {down:.4f} ({exact_down:.4f})"

    @property
    def cells(self) -> str:
        """As a row of a table."""
        s, (up, down), (exact_up, exact_down) = self.slab, self.found, self.exact
        return f"| {s.tau:g} | {s.g} | {s.albedo} | {s.zenith:.0f}° | {up:.4f} | {exact_up:.4f} | {down:.4f} | {exact_down:.4f} |"


def cases() -> list[Slab]:
    """Thirty: every depth with every asymmetry and height of the sun; the albedos take turns, each ten times."""
    triples = [(t, g, h) for t in range(len(DEPTHS)) for g in range(len(ASYMMETRIES)) for h in range(len(HEIGHTS))]
    return [Slab(DEPTHS[t], ASYMMETRIES[g], ALBEDOS[(t + g + h) % len(ALBEDOS)], HEIGHTS[h]) for t, g, h in triples]


def measure_slab(slab: Slab, predictor: Predicts) -> SlabResult:
    """Both fluxes with the network's J."""
    volume = Volume.from_box(np.ones((3, 3, 3)), (-_HALF_WIDTH, -_HALF_WIDTH, 0), (_HALF_WIDTH, _HALF_WIDTH, 1))

    def source(depth: Floats, w: Floats) -> Floats:
        points = np.stack([0 * depth, 0 * depth, 1 - depth / slab.tau], axis=1)
        return predict(
            points, w, volume=volume, scale=slab.tau, g=slab.g, albedo=slab.albedo, omega_sun=slab.omega_sun, predictor=predictor
        )

    return SlabResult(slab, leaving_flux(slab, source), discrete_ordinates(slab))


def leaving_flux(slab: Slab, source: Source) -> tuple[float, float]:
    """Reflected and transmitted flux: J from `source`, single scattering and the beam exact."""
    # Under a sun overhead every azimuth sees the same.
    azimuths = 1 if slab.height == 1 else _AZIMUTHS
    cosine, cosine_weight = _gauss(_COSINES, 0, 1)
    azimuth, azimuth_weight = _gauss(azimuths, 0, math.pi)
    share, share_weight = _gauss(_ALONG, 0, 1)
    c, a, s = (v.ravel() for v in np.meshgrid(cosine, azimuth, share, indexing="ij"))
    weight = np.einsum("i,j,k->ijk", cosine_weight * cosine, azimuth_weight, share_weight).ravel()
    # Uniform steps in the share of the light that reaches the surface, 1 - exp(-t): t is the optical depth along the ray.
    hidden = -np.expm1(-slab.tau / c)
    below = np.minimum(-np.log1p(-s * hidden) * c, slab.tau)
    sine = np.sqrt(1 - c**2)
    across = np.stack([sine * np.cos(a), sine * np.sin(a)], axis=1)
    # Camera rays travel against the light: what leaves upward is seen looking down.
    looking_down, looking_up = (np.column_stack([across, sign * c]) for sign in (-1, 1))
    values = source(np.concatenate([below, slab.tau - below]), np.concatenate([looking_down, looking_up]))
    # Azimuths from 0 to pi stand for both halves.
    multiple = 2 * (values.reshape(2, -1) * weight * hidden).sum(axis=1)
    single = [_single(slab, sign) for sign in (1, -1)]
    beam = slab.height * math.exp(-slab.tau / slab.height)
    return float(multiple[0]) + single[0], float(multiple[1]) + single[1] + beam


def _single(slab: Slab, sign: int) -> float:
    """Flux that scattered once, leaving upward (sign 1) or downward, in closed form along each direction."""
    # Cosines crowd toward 0, where the integrand bends.
    u, weight = _gauss(64, 0, 1)
    c, weight = u**2, 2 * u * weight
    azimuth = (np.arange(4096) + 0.5) * (math.pi / 4096)
    toward = -sign * c * slab.height
    across = np.sqrt(1 - c**2) * math.sqrt(1 - slab.height**2)
    g = slab.g
    cosine = toward[:, None] + across[:, None] * np.cos(azimuth)
    phase = ((1 - g * g) / (4 * math.pi * (1 + g * g - 2 * g * cosine) ** 1.5)).mean(axis=1)
    h, tau = slab.height, slab.tau
    if sign > 0:
        light = h / (c + h) * -np.expm1(-tau * (1 / c + 1 / h))
    else:
        # exp(-tau / c) int_0^tau exp(t (1 / c - 1 / h)) dt / c, the factors together so that neither overflows.
        rate = 1 / c - 1 / h
        near = np.abs(rate * tau) < 1e-8
        light = np.where(near, tau * np.exp(-tau / h), (np.exp(-tau / h) - np.exp(-tau / c)) / np.where(near, 1, rate)) / c
    return float(slab.albedo * 2 * math.pi * (phase * light * c * weight).sum())


def _gauss(count: int, low: float, high: float) -> tuple[Floats, Floats]:
    x, w = np.polynomial.legendre.leggauss(count)
    return low + (high - low) * (x + 1) / 2, w * (high - low) / 2


def discrete_ordinates(slab: Slab) -> tuple[float, float]:
    """Reflected and transmitted flux by PythonicDISORT, delta-M scaled, 48 streams; raises InputError where it is not installed."""
    try:
        from PythonicDISORT import pydisort
    except ImportError as error:
        raise InputError("the slabs need the package 'PythonicDISORT': pip install PythonicDISORT") from error
    moments = slab.g ** np.arange(4 * _STREAMS)
    with warnings.catch_warnings():
        # It warns near albedo 1; five digits survive.
        warnings.filterwarnings("ignore", message=".*albedos are very close to 1")
        _, up, down = pydisort(
            slab.tau,
            min(slab.albedo, 1 - 1e-9),
            _STREAMS,
            moments[None],
            slab.height,
            1.0,
            0.0,
            NLeg=_STREAMS,
            only_flux=True,
            f_arr=moments[_STREAMS],
        )[:3]
    diffuse, direct = down(slab.tau)
    return float(up(0)), float(diffuse + direct)


def slab_rows(results: list[SlabResult]) -> list[Row]:
    """Errors of all cases, and by depth; intervals are over the cases."""

    def row(name: str, chosen: list[SlabResult]) -> Row:
        found, exact = (np.array([getattr(r, n) for r in chosen]) for n in ("found", "exact"))
        error = np.abs(found - exact)
        relative = np.where(exact > _LIT, error / np.maximum(exact, _LIT), 0)
        figures = {
            "largest absolute": bootstrap(error, lambda v: v.max(axis=(1, 2)), percent=False),
            "mean absolute": bootstrap(error, lambda v: v.mean(axis=(1, 2)), percent=False),
            "largest relative": bootstrap(relative, lambda v: v.max(axis=(1, 2))),
        }
        return Row("slabs", f"{name}, {len(chosen)} cases", figures)

    groups = [(f"depth {tau:g}", [r for r in results if r.slab.tau == tau]) for tau in DEPTHS]
    return [row("all", results), *(row(name, chosen) for name, chosen in groups if chosen)]
