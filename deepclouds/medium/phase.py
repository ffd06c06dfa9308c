"""Phase functions of one and of two Henyey-Greenstein lobes: value and sampling, for Dr.Jit arrays and NumPy alike.

Convention: ``cos_theta`` is the cosine between the directions of travel before and after the scattering, so ``g > 0`` is bright
looking into the sun; every phase function integrates to 1 over the sphere (Henyey and Greenstein 1941; two lobes: Kattawar 1975).
As an array a phase function is a row (g1, g2, weight), ``weight * HG(g1) + (1 - weight) * HG(g2)``; a single lobe is (g, 0, 1).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

INV_4PI = 0.07957747154594767


def hg(cos_theta: Any, g: Any) -> Any:
    """Phase function value, 1/sr, of Dr.Jit arrays `cos_theta` and `g` (-1 < g < 1)."""
    import drjit as dr

    # (1 - |g|)^2 + 2 |g| (1 -+ cos) keeps its digits where 1 + g^2 - 2 g cos cancels.
    a = dr.abs(g)
    denominator = dr.square(1 - a) + 2 * a * (1 - dr.select(g < 0, -cos_theta, cos_theta))
    return INV_4PI * (1 - a) * (1 + a) * dr.rcp(denominator * dr.sqrt(denominator))


def hg_numpy(cos_theta: ArrayLike, g: ArrayLike) -> NDArray[np.float64]:
    """The readable twin of `hg` in float64."""
    cos_theta, g = np.asarray(cos_theta, np.float64), np.asarray(g, np.float64)
    value: NDArray[np.float64] = INV_4PI * (1 - g**2) / (1 + g**2 - 2 * g * cos_theta) ** 1.5
    return value


def inverse_hg(cos_theta: Any, g: Any) -> Any:
    """The inverse of `hg`, sr, which costs no division where `g` is the same for all."""
    import drjit as dr

    a = dr.abs(g)
    denominator = dr.fma(2 * a, 1 - dr.select(g < 0, -1.0, 1.0) * cos_theta, dr.square(1 - a))
    return 4 * np.pi / ((1 - a) * (1 + a)) * (denominator * dr.sqrt(denominator))


def sample_hg(u: Any, g: Any) -> tuple[Any, Any]:
    """One minus the cosine of the scattering angle, by inversion of the cumulative HG density from `u` in [0, 1), and `inverse_hg` there.

    With ``q = 1 - g + 2 g u`` the textbook's cosine ``(1 + g^2 - ((1 - g^2) / q)^2) / (2 g)`` is
    ``1 - (1 - g)^2 (1 - u) (1 + g + q) / q^2``, which needs no other form near g = 0.
    """
    import drjit as dr

    q = dr.fma(2 * g, u, 1 - g)
    inverse = dr.rcp(q)
    square = inverse * inverse
    beside = dr.square(1 - g) * (1 - u) * ((1 + g) + q) * square
    return beside, 4 * np.pi * dr.square((1 - g) * (1 + g)) * (square * inverse)


def sample_hg_cosine(u: Any, g: Any) -> Any:
    """Cosine of the scattering angle by inversion of the cumulative HG density, from `u` in [0, 1)."""
    import drjit as dr

    return dr.maximum(1 - sample_hg(u, g)[0], -1)


def two_lobe(cos_theta: Any, g1: Any, g2: Any, weight: Any) -> Any:
    """Phase function value, 1/sr, of ``weight * HG(g1) + (1 - weight) * HG(g2)``; all Dr.Jit arrays, 0 <= weight <= 1."""
    return weight * hg(cos_theta, g1) + (1 - weight) * hg(cos_theta, g2)


def two_lobe_numpy(cos_theta: ArrayLike, g1: ArrayLike, g2: ArrayLike, weight: ArrayLike) -> NDArray[np.float64]:
    """The readable twin of `two_lobe` in float64."""
    weight = np.asarray(weight, np.float64)
    value: NDArray[np.float64] = weight * hg_numpy(cos_theta, g1) + (1 - weight) * hg_numpy(cos_theta, g2)
    return value


def sample_two_lobe(u: Any, g1: Any, g2: Any, weight: Any) -> Any:
    """One minus the cosine of an angle of `two_lobe`, from `u` in [0, 1): u chooses the lobe and, stretched, the angle in it."""
    import drjit as dr

    first = u < weight
    # The guard keeps the lobe that is never chosen from a division by zero.
    share = dr.maximum(dr.select(first, weight, 1 - weight), 1e-12)
    stretched = dr.minimum(dr.select(first, u, u - weight) / share, 1)
    return sample_hg(stretched, dr.select(first, g1, g2))[0]


def sample_two_lobe_cosine(u: Any, g1: Any, g2: Any, weight: Any) -> Any:
    """Cosine of the scattering angle of `two_lobe`, from `u` in [0, 1); see `sample_two_lobe`."""
    import drjit as dr

    return dr.maximum(1 - sample_two_lobe(u, g1, g2, weight), -1)


def distinct(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    """The rows; of one row that is seen many times (`np.broadcast_to`) that one, which tells all."""
    return rows[:1] if len(rows) and rows.strides[0] == 0 else rows


def as_lobes(phase: ArrayLike) -> NDArray[np.float32]:
    """Phase functions as rows (g1, g2, weight), float32 (n, 3), from (n, 3) rows or from (n,) single lobes g.

    Raises
    ------
    ValueError
        for another shape, a |g| of 1 or more, or a weight outside of [0, 1].
    """
    rows = np.asarray(phase, np.float32)
    if rows.ndim == 1:
        rows = np.stack([rows, np.zeros_like(rows), np.ones_like(rows)], axis=1)
    if rows.ndim != 2 or rows.shape[1] != 3:
        raise ValueError(f"a phase function is g or (g1, g2, weight), got an array of shape {np.shape(phase)}")
    own = distinct(rows)
    if not (np.all(np.abs(own[:, :2]) < 1) and np.all((own[:, 2] >= 0) & (own[:, 2] <= 1))):
        raise ValueError("a phase function needs -1 < g1, g2 < 1 and a weight from 0 to 1")
    return rows


def ordered_lobes(phase: tuple[float, float, float]) -> tuple[float, float, float]:
    """The same phase function with the heavier lobe first, and (g, 0, 1) where it has one lobe: the form in which a network reads it."""
    g1, g2, weight = phase
    if weight == 1 or g1 == g2:
        return g1, 0.0, 1.0
    if weight == 0:
        return g2, 0.0, 1.0
    if (weight, g1) < (1 - weight, g2):
        return g2, g1, 1 - weight
    return g1, g2, weight


def rotate_to(direction: Any, cosine: Any, azimuth: Any) -> Any:
    """Unit vectors at `cosine` and `azimuth` (radians) around the unit vectors `direction`."""
    import drjit as dr

    sin_a, cos_a = dr.sincos(azimuth)
    return turned(direction, cosine, dr.safe_sqrt(1 - cosine * cosine), cos_a, sin_a)


def turned(direction: Any, cosine: Any, sine: Any, cos_a: Any, sin_a: Any) -> Any:
    """`rotate_to` for those who know sines and cosines (Duff et al. 2017, JCGT 6(1))."""
    import drjit as dr

    x, y, z = direction
    sign = dr.select(z < 0, -1.0, 1.0)
    a = -dr.rcp(sign + z)
    b = x * y * a
    u, v = sine * cos_a, sine * sin_a
    rotated = type(direction)(
        u * (1 + sign * x * x * a) + v * b + cosine * x,
        u * sign * b + v * (sign + y * y * a) + cosine * y,
        u * (-sign * x) + v * (-y) + cosine * z,
    )
    # What is nearly of unit length already needs one step of Newton's, not a root.
    return rotated * dr.fma(dr.squared_norm(rotated), -0.5, 1.5)
