"""Names, shapes, order and units of the network's inputs and output: what every model and every caller agree on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

CONTRACT_VERSION = "1"
INPUT_STENCIL = "stencil"
INPUT_AUX = "aux"
OUTPUT = "j"
LEVELS = 10
POINTS = 225


@dataclass(frozen=True)
class AuxInput:
    """One column of the input ``aux``.

    Attributes
    ----------
    name
        the column's name; its place in `AUX` is its place in the row.
    unit
        the unit of the values.
    lower, upper
        the values that make sense physically; `aux_inputs` refuses others.
    meaning
        one sentence for the documentation.
    """

    name: str
    unit: str
    lower: float
    upper: float
    meaning: str


AUX: tuple[AuxInput, ...] = (
    AuxInput("gamma", "rad", 0.0, float(np.pi), "angle between w and omega_sun; 0 looks into the sun"),
    AuxInput("g1", "1", -1.0, 1.0, "Henyey-Greenstein parameter of lobe 1"),
    AuxInput("g2", "1", -1.0, 1.0, "Henyey-Greenstein parameter of lobe 2; 0 for a single lobe"),
    AuxInput("lobe_weight", "1", 0.0, 1.0, "weight of lobe 1; 1 for a single lobe"),
    AuxInput("albedo", "1", 0.0, 1.0, "single-scattering albedo"),
    AuxInput("log1p_tau", "1", 0.0, float("inf"), "log(1 + optical depth from the point toward the sun)"),
)


def aux_inputs(
    gamma: ArrayLike, g1: ArrayLike, g2: ArrayLike, lobe_weight: ArrayLike, albedo: ArrayLike, tau: ArrayLike
) -> NDArray[np.float32]:
    """Rows of the input ``aux``, in the contract's order.

    Parameters
    ----------
    gamma
        angle between w and omega_sun, radians, in [0, pi]; 0 looks into the sun.
    g1, g2
        Henyey-Greenstein parameters of the two lobes, in (-1, 1).
    lobe_weight
        weight of lobe 1, in [0, 1]; 1 for a single lobe, whose g2 is then 0.
    albedo
        single-scattering albedo, in [0, 1].
    tau
        optical depth from the point toward the sun, not negative; the row holds log(1 + tau).

    Returns
    -------
    float32 array (n, 6): the arguments broadcast against each other; scalars alone give one row.

    Raises
    ------
    ValueError
        for values outside of these ranges, NaN included.
    """
    tau = np.asarray(tau, np.float64)
    if not np.all((tau >= 0) & np.isfinite(tau)):
        raise ValueError("tau must be finite and not negative")
    columns = np.broadcast_arrays(*(np.atleast_1d(np.asarray(v, np.float64)) for v in (gamma, g1, g2, lobe_weight, albedo, np.log1p(tau))))
    if columns[0].ndim != 1:
        raise ValueError(f"the columns of aux have one axis, got shape {columns[0].shape}")
    for column, spec in zip(columns, AUX, strict=True):
        # A float32 arc cosine of -1 lies a little above pi.
        slack = 1e-6 * max(1.0, abs(spec.lower))
        inside = (column >= spec.lower - slack) & (column <= spec.upper + slack)
        if not np.all(inside):
            worst = column[~inside][0]
            raise ValueError(f"{spec.name} = {worst} is outside of [{spec.lower:g}, {spec.upper:g}] ({spec.meaning})")
    return np.stack(columns, axis=1).astype(np.float32)


def multiple_scattering(j: ArrayLike, albedo: ArrayLike, irradiance: ArrayLike = 1.0) -> NDArray[np.float64]:
    """The source term J = albedo^2 E j / (4 pi) of a network output `j`.

    Parameters
    ----------
    j
        network output, dimensionless.
    albedo
        single-scattering albedo, in [0, 1].
    irradiance
        the sun's irradiance E perpendicular to its direction.

    Returns
    -------
    J in the unit of `irradiance` per steradian, broadcast over the arguments.
    """
    albedo = np.asarray(albedo, np.float64)
    value: NDArray[np.float64] = albedo**2 * np.asarray(irradiance, np.float64) * np.asarray(j, np.float64) / (4 * np.pi)
    return value
