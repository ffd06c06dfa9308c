"""How far a prediction can be trusted: a distance from the training data, and the relative error to expect.

Ten levels of a stencil and a row of ``aux`` are summed up in a few numbers. Their distance from the training data, in units of the data's
own spread (Mahalanobis 1936), says how unusual a query is. Held-out labels say what error goes with a distance and with a prediction: dark
places are predicted worse, relatively, than bright ones.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, field_validator, model_validator

from deepclouds.model.contract import LEVELS, POINTS

Floats = NDArray[np.float64]
VERSION = "1"
# Errors are relative to j + FLOOR: where there is next to no light, what counts is that little is predicted.
FLOOR = 0.05
# A prediction that is off by more than this tells nothing, whatever the calibration says.
LARGEST = 1.5
SUMMARY = 2 * LEVELS + 7
# As the network's own compression (`deepclouds_training.network`): the fourth root of the optical depth across a spacing.
_ROOT_FLOOR = 0.05
# Points of a level on its axis toward the light, beyond the middle.
_AXIS = slice(3 * 25 + 12, POINTS, 25)


class Trust(BaseModel):
    """What a model's metadata hold about its training data and its errors.

    Attributes
    ----------
    version
        of these fields' meaning.
    mean, whitening
        of the summaries of the training data: ``(summary - mean) @ whitening`` has mean 0 and variance 1 in each component there.
    quantiles
        share of the training data -> largest distance among that share of it.
    coefficients
        (c0, c1, c2, c3): the logarithm of the expected squared relative error is ``c0 + c1 h + c2 q + c3 q^2`` with
        ``h = log(max(distance / median distance, 1))`` and ``q = log(j + 0.05)``.
    least
        no smaller relative error is expected.
    queries, labels
        how many queries of the training data and how many held-out labels these numbers stand on.
    labels_hash
        SHA-256 of the set of held-out labels.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    version: str = VERSION
    mean: tuple[float, ...]
    whitening: tuple[tuple[float, ...], ...]
    quantiles: dict[str, float]
    coefficients: tuple[float, float, float, float]
    least: float
    queries: int
    labels: int
    labels_hash: str

    @field_validator("mean", "coefficients")
    @classmethod
    def _finite(cls, values: tuple[float, ...]) -> tuple[float, ...]:
        if not np.all(np.isfinite(values)):
            raise ValueError("must be finite")
        return values

    @model_validator(mode="after")
    def _consistent(self) -> Trust:
        if len(self.mean) != SUMMARY or np.shape(self.whitening) != (SUMMARY, SUMMARY) or not np.all(np.isfinite(self.whitening)):
            raise ValueError(f"mean and whitening must be {SUMMARY} and {SUMMARY} x {SUMMARY} finite numbers")
        if not {"0.5", "0.99"} <= set(self.quantiles) or not min(self.quantiles.values()) > 0:
            raise ValueError("quantiles must name the positive distances of at least the shares 0.5 and 0.99")
        return self

    def distance(self, stencil: NDArray[np.float32], aux: NDArray[np.float32], coarse: NDArray[np.float32] | None = None) -> Floats:
        """Distance (n,) of stencils (n, 10, 225) with rows ``aux`` (n, 6) from the training data: root of the mean square, of order 1.

        Of levels that the stencils lack, the coarsest ones, `coarse` (n, levels, 2) has what `level_means` makes of them.
        """
        # Not a matrix product: the threads of a linear algebra library go on spinning for a while and take the tracer's processors.
        whitened = np.einsum("nk,kl->nl", summaries(stencil, aux, coarse) - np.array(self.mean), np.array(self.whitening))
        result: Floats = np.sqrt(np.mean(np.square(whitened), axis=1))
        return result

    def expected_error(self, distance: NDArray[Any], j: NDArray[Any]) -> Floats:
        """Expected error of predictions j (n,) at these distances: root of the mean square, in units of ``j + 0.05``."""
        logarithm = design(distance / self.quantiles["0.5"], j) @ np.array(self.coefficients)
        result: Floats = np.clip(np.exp(0.5 * logarithm), self.least, LARGEST)
        return result


def level_means(stencil: NDArray[np.float32]) -> NDArray[np.float32]:
    """Means (n, levels, 2) of each level of stencils (n, levels, 225) over its points, and over those of its axis toward the light."""
    return np.stack([stencil.mean(axis=2), stencil[:, :, _AXIS].mean(axis=2)], axis=2)


def summaries(stencil: NDArray[np.float32], aux: NDArray[np.float32], coarse: NDArray[np.float32] | None = None) -> Floats:
    """Summaries (n, 27) of queries.

    For each level, finest first: the mean over its points, and over those of its axis toward the light, both as the fourth root of the
    optical depth across a spacing; then cos gamma, a quarter of the logarithm of the phase function, g1, g2, lobe weight, the similarity
    parameter sqrt((1 - albedo) / (1 - albedo g)) (van de Hulst 1980), and a quarter of log(1 + tau).

    Parameters
    ----------
    stencil, aux
        the network's inputs, (n, 10, 225) and (n, 6), see docs/contract.md.
    coarse
        `level_means` of the coarsest levels, where the stencils lack them.
    """
    n = len(aux)
    means = level_means(stencil) if coarse is None else np.concatenate([level_means(stencil), coarse], axis=1)
    depth = np.maximum(means, 0) * np.exp2(np.arange(LEVELS, dtype=np.float32))[:, None]
    gamma, g1, g2, weight, albedo, log1p_tau = aux.astype(np.float64).T
    phase = weight * _henyey_greenstein(gamma, g1) + (1 - weight) * _henyey_greenstein(gamma, g2)
    similarity = np.sqrt((1 - albedo) / np.maximum(1 - albedo * (weight * g1 + (1 - weight) * g2), 1e-3))
    own = np.stack([np.cos(gamma), 0.25 * np.log(phase), g1, g2, weight, similarity, 0.25 * log1p_tau], axis=1)
    return np.concatenate([np.sqrt(np.sqrt(depth + _ROOT_FLOOR)).reshape(n, 2 * LEVELS), own], axis=1)


def design(distance: NDArray[Any], j: NDArray[Any]) -> Floats:
    """Columns (n, 4) that the logarithm of the expected squared error is linear in; `distance` over the training data's median."""
    q = np.log(np.asarray(j, np.float64) + FLOOR)
    # Nothing is made of being closer to the training data than half of them are: the error can only rise with the distance.
    return np.stack([np.ones_like(q), np.log(np.maximum(distance, 1)), q, q * q], axis=1)


def _henyey_greenstein(gamma: Floats, g: Floats) -> Floats:
    """``4 pi p``."""
    denominator = np.maximum(1 + g * g - 2 * g * np.cos(gamma), 1e-8)
    value: Floats = np.maximum(1 - g * g, 1e-8) / (denominator * np.sqrt(denominator))
    return value
