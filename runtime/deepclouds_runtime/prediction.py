"""J at given points of a cloud, without a render around it."""

from __future__ import annotations

import logging
import math
from functools import lru_cache
from os import PathLike, fspath
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from deepclouds.volume import Volume
    from deepclouds_runtime.predictor import Predictor
    from deepclouds_runtime.scattering import Predicts

_LOG = logging.getLogger(__name__)


def predict(
    points: ArrayLike,
    directions: ArrayLike,
    *,
    volume: Volume,
    scale: float,
    g: float,
    albedo: float,
    omega_sun: ArrayLike,
    model: str | PathLike[str] | None = None,
    predictor: Predicts | None = None,
    backend: str = "llvm",
    g2: float = 0.0,
    lobe_weight: float = 1.0,
) -> NDArray[np.float64]:
    """Source term of multiple scattering over the sun's irradiance, J / E.

    Parameters
    ----------
    points
        (n, 3) world points.
    directions
        (n, 3) unit vectors w, the camera rays' travel.
    volume
        density and its place.
    scale
        extinction per unit of density, 1 / world length.
    g
        Henyey-Greenstein parameter.
    albedo
        single-scattering albedo.
    omega_sun
        (3,) unit vector TOWARD the sun, or (n, 3).
    model
        path of the network; None takes the one that comes with the package.
    predictor
        any object with ``predict``, in place of `model`.
    backend
        ``"llvm"`` or ``"cuda"``.
    g2, lobe_weight
        parameter of a second lobe, and the weight of the first: the phase function is ``lobe_weight HG(g) + (1 - lobe_weight) HG(g2)``.

    Returns
    -------
    float64 array (n,): J / E, 1 / steradian. The radiance that a path of length dt adds is ``sigma_t J dt``.

    Notes
    -----
    What the model was not trained on is extrapolated, and logged as a warning.

    Raises
    ------
    InputError
        when the model cannot be loaded or the volume is malformed.
    ValueError
        when shapes do not fit.
    """
    from deepclouds.backend import backend as types_named
    from deepclouds.backend import vectors_of
    from deepclouds.medium.field import Field
    from deepclouds.medium.optical_depth import optical_depth
    from deepclouds.model import multiple_scattering
    from deepclouds.volume.pyramid import optical_size
    from deepclouds_runtime.scattering import NetworkScattering

    x, w = np.asarray(points, np.float32), np.asarray(directions, np.float32)
    if x.ndim != 2 or x.shape[1] != 3 or w.shape != x.shape:
        raise ValueError(f"points and directions need one shape (n, 3), got {x.shape} and {w.shape}")
    suns = np.broadcast_to(np.asarray(omega_sun, np.float32), x.shape)
    if len(x) == 0 or albedo == 0:
        return np.zeros(len(x))
    types = types_named(backend)

    field = Field(types, volume, scale)
    p, d, s = vectors_of(types, x), vectors_of(types, w), vectors_of(types, suns)
    tau = optical_depth(field, p, s, types.Float(0), types.Float(math.inf), types.Bool(True), float("inf"))
    if predictor is None:
        name = None if model is None else fspath(model)
        predictor = _warned(name, (g, g2, lobe_weight), albedo, optical_size(volume, scale))
    j = NetworkScattering(field, predictor)(p, d, s, (g, g2, lobe_weight), (albedo,), tau)
    return multiple_scattering(j[:, 0], albedo)


@lru_cache(maxsize=2)
def _warned(model: str | None, phase: tuple[float, float, float], albedo: float, size: float) -> Predictor:
    """The model; says once of a medium that it was not trained for it."""
    from deepclouds_runtime.predictor import kept

    predictor = kept(model)
    if unknown := predictor.outside(phase, (albedo,), size):
        _LOG.warning("the model %s was not trained for %s: J is extrapolated", predictor.path.stem, ", ".join(unknown))
    return predictor
