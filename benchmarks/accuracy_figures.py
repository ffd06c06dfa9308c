"""A measured figure with its 95 % interval, and the bootstrap that gives the interval."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
RESAMPLES = 2000


@dataclass(frozen=True)
class Figure:
    """A value and the ends of its 95 % interval; shares are printed in per cent, `signed` ones with their sign."""

    value: float
    low: float
    high: float
    percent: bool = True
    signed: bool = False

    @property
    def text(self) -> str:
        """Value and interval, which what is known exactly has none of."""
        if self.low == self.value == self.high:
            return self.bare
        return f"{self.bare} [{self._number(self.low)}, {self._number(self.high)}]"

    @property
    def bare(self) -> str:
        """The value alone, with its unit."""
        return f"{self._number(self.value)} %" if self.percent else self._number(self.value)

    def _number(self, value: float) -> str:
        sign = "+" if self.signed else ""
        return f"{100 * value:{sign}.2f}" if self.percent else f"{value:{sign}.4f}"


@dataclass(frozen=True)
class Row:
    """All figures of one case, by name."""

    part: str
    case: str
    figures: dict[str, Figure]

    @property
    def line(self) -> str:
        """As text."""
        return f"{self.part:8} {self.case:26} " + "   ".join(f"{name} {figure.text}" for name, figure in self.figures.items())


def bootstrap(
    values: Floats, statistic: Callable[[Floats], Floats], percent: bool = True, signed: bool = False, resamples: int = RESAMPLES
) -> Figure:
    """A statistic of n independent cases with its percentile bootstrap interval.

    Parameters
    ----------
    values
        (n, ...) one entry a case; cases are drawn with replacement.
    statistic
        maps (resamples, n, ...) to (resamples,).
    """
    # The interval of a figure does not change from run to run unless the figure does.
    picks = np.random.default_rng(0).integers(0, len(values), (resamples, len(values)))
    low, high = np.quantile(statistic(values[picks]), [0.025, 0.975])
    return Figure(float(statistic(values[None])[0]), float(low), float(high), percent, signed)


def noise_free(prediction: Floats, half_a: Floats, half_b: Floats) -> dict[str, Figure]:
    """``rRMSE``, sqrt(mean((p - A)(p - B))) / mean(y), and ``energy``, mean(p) / mean(y) - 1, of n predictions p, all (n,).

    The noises of A and B are independent, so the product's expectation is the squared error of p alone; y is their mean.
    """
    cases = np.stack([(prediction - half_a) * (prediction - half_b), prediction, 0.5 * (half_a + half_b)], axis=1)

    def rrmse(v: Floats) -> Floats:
        mean = v.mean(axis=1)
        return np.asarray(np.sqrt(np.maximum(mean[:, 0], 0)) / mean[:, 2])

    def energy(v: Floats) -> Floats:
        mean = v.mean(axis=1)
        return np.asarray(mean[:, 1] / mean[:, 2] - 1)

    return {"rRMSE": bootstrap(cases, rrmse), "energy": bootstrap(cases, energy, signed=True)}
