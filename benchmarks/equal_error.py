"""How long a method needs to reach a given error: the arithmetic behind every speed-up that the benchmark prints."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise


@dataclass(frozen=True)
class Timing:
    """Seconds of one render and the rRMSE it reached."""

    seconds: float
    error: float


@dataclass(frozen=True)
class Bounded:
    """A number that is known (``""``), at most (``"<="``) or at least (``">="``) `value`."""

    value: float
    bound: str = ""

    def over(self, seconds: float) -> Bounded:
        """Divide by a known positive number; a bound stays the bound it was."""
        return Bounded(self.value / seconds, self.bound)

    def __str__(self) -> str:
        return f"{self.bound + ' ' if self.bound else ''}{self.value:.3g}"


def unbiased_seconds(timings: Sequence[Timing], error: float) -> Bounded:
    """Time of an unbiased path tracer to an error: measured time times (measured error / error)^2.

    Of several timings the one with the most samples counts: its error is known best, and its fixed costs weigh least.
    """
    if not timings or error <= 0:
        raise ValueError("needs at least one timing and an error above 0")
    longest = max(timings, key=lambda t: t.seconds)
    return Bounded(longest.seconds * (longest.error / error) ** 2)


def interpolated_seconds(timings: Sequence[Timing], error: float) -> Bounded:
    """Time of a biased method to an error: linear between its points in log(error), log(seconds), a bound beyond them.

    A point that takes longer than another without being better is left out: nobody would choose it. No extrapolation: a denoiser's
    error need not fall for ever, so beyond the longest run its time is only known to be more, before the shortest to be less.
    """
    if not timings or error <= 0:
        raise ValueError("needs at least one timing and an error above 0")
    useful: list[Timing] = []
    for timing in sorted(timings, key=lambda t: (t.seconds, t.error)):
        if timing.error > 0 and (not useful or timing.error < useful[-1].error):
            useful.append(timing)
        elif timing.error <= 0:
            raise ValueError("an error of 0 cannot be interpolated in the logarithm")
    if error > useful[0].error:
        return Bounded(useful[0].seconds, "<=")
    if error < useful[-1].error:
        return Bounded(useful[-1].seconds, ">=")
    for worse, better in pairwise(useful):
        if better.error <= error <= worse.error:
            along = (math.log(worse.error) - math.log(error)) / (math.log(worse.error) - math.log(better.error))
            return Bounded(math.exp(math.log(worse.seconds) + along * (math.log(better.seconds) - math.log(worse.seconds))))
    return Bounded(useful[0].seconds)
