"""J at albedos between two others, without a query: its logarithm lies between theirs, at about the same place all over a cloud.

J is a sum of powers of the albedo, one for each number of scatterings, so that log J rises smoothly with it. Where between the least and
the greatest albedo's it lies depends on how often light is scattered in the medium at hand: some queries of all albedos tell.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]
# Largest deviation of what is made of two albedos from what was asked, rms, with which none but the two are asked for.
_WRONG = 0.1
# Queries of all albedos that tell.
TOLD = 512


class BetweenAlbedos:
    """Which of some albedos are asked for, and what the others have then.

    Parameters
    ----------
    albedos
        ascending.

    Attributes
    ----------
    albedos, asked
        all of them, and those that are asked for: the first and the last, if `learn` was told that this is enough.
    learned
        whether nothing is left to be learned.
    """

    def __init__(self, albedos: Sequence[float]) -> None:
        self.albedos, self.asked = list(albedos), list(albedos)
        self.learned = len(albedos) < 3
        self._place = np.zeros(0)

    def learn(self, j: Array) -> None:
        """Of j (n, albedos), of all albedos at n points."""
        self.learned = True
        log, weight = np.log(np.maximum(j, 1e-30).astype(np.float64)), j.mean(axis=1, dtype=np.float64)
        if not weight.sum() > 0:
            return
        length, rise = log[:, -1] - log[:, 0], log - log[:, :1]
        place = (weight * length) @ rise / max(float((weight * length) @ length), 1e-30)
        wrong = np.average(np.square(np.expm1(np.outer(length, place) - rise)), axis=0, weights=weight)
        if wrong.max() < _WRONG**2:
            self._place, self.asked = place.astype(np.float32), [self.albedos[0], self.albedos[-1]]

    def filled(self, j: Array, errors: Array) -> tuple[Array, Array]:
        """Values and errors (n, albedos) of all, of the values j and the errors of those that were asked for."""
        if not len(self._place):
            return j, errors
        low, high = np.maximum(j[:, :1], 1e-30), np.maximum(j[:, 1:], 1e-30)
        return low * (high / low) ** self._place, errors[:, :1] + (errors[:, 1:] - errors[:, :1]) * self._place
