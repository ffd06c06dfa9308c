"""Measures how wrong the predicted multiple scattering of a frame is, and corrects it, with walks from what the image shows.

Walks are noisy and unbiased. In two independent halves of them the noise is independent too: the product of what both find in a region of
the image is, on the mean, the square of the prediction's error there.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from deepclouds_runtime.audit_walks import AT_ONCE, Batch, Looked, Rays, Walks
from deepclouds_runtime.camera import Window
from deepclouds_runtime.correction import FLOOR, Correction, Sums
from deepclouds_runtime.frame_source import FrameSource
from deepclouds_runtime.octree import Array
from deepclouds_runtime.transport import Cloud, Lights

# Regions along the longer side of what shows the cloud.
_REGIONS = 20
# Regions darker than this share of the brightest ones do not count.
_DARK = 0.02
# Points at which a correction is looked at to judge it, at least where there are so many walks.
_LOOKED_AT = 1 << 14
# Walks of a round, after which somebody is asked whether to go on. The first is judged, which costs as much as tracing some hundred
# thousand; the next judgement follows when all that may be spent are there.
ROUND = 1 << 18
# Walks by default: so many a pixel of the image, or of what shows the cloud if these are fewer, within these limits.
WALKS_A_PIXEL, WALKS_A_SIGHT, FEWEST, MOST = 4, 32, 1 << 18, 1 << 22
# Where a correction leaves more than was asked for, walks go on to so many times their number at most.
_FURTHER = 3
# Judging, correcting and applying it take so many times as long as one correction; and how much of the time that is left a round may take.
_CORRECTIONS, _PART = 10, 0.5
# An error is reached where its square is below what was asked for by so many standard deviations: by one, an audit in five ends by chance.
_SURE = 2.0
# Least and most of the time left before an audit, but for one sample a pixel, that it may take. What walks leave, squared, falls with the
# root of their time, noise with its power 3/2: the sum is least where noise has about a third of the time.
_SHARE = (0.65, 0.9)
# Standard deviations of an interval of 95 %.
_INTERVAL = 1.96
# Channels whose ratio at the points differs by less than this are corrected as one.
_GREY = 1e-3


@dataclass(frozen=True)
class RegionError:
    """Error of the predicted multiple scattering over regions of the image and colour channels, over its mean.

    Attributes
    ----------
    energy, energy_deviation
        of the whole image, positive where the prediction is too bright, and the standard deviation of this estimate.
    squared, squared_deviation
        mean of the squared error of the regions, without the noise of the walks; below 0 where chance has it so.
    """

    energy: float
    energy_deviation: float
    squared: float
    squared_deviation: float

    def summary(self) -> dict[str, Any]:
        """For a report: root of the mean square and energy, each with its 95 % interval."""
        reach = _INTERVAL * self.squared_deviation
        root = [math.sqrt(max(v, 0.0)) for v in (self.squared, self.squared - reach, self.squared + reach)]
        ends = [self.energy - _INTERVAL * self.energy_deviation, self.energy + _INTERVAL * self.energy_deviation]
        return {
            "error": round(root[0], 5),
            "error_interval": [round(v, 5) for v in root[1:]],
            "energy": round(self.energy, 5),
            "energy_interval": [round(v, 5) for v in ends],
        }


class Audit:
    """Walks of one frame, gathered as they come: in cells, to correct, and in regions of the image, to judge.

    Parameters
    ----------
    cloud, lights, sources, rays, window, met, seed
        see `deepclouds_runtime.audit_walks.Walks`; `sources` is what is audited.

    Attributes
    ----------
    count, under_way
        walks so far, and how many of them nobody has waited for.
    """

    def __init__(
        self, cloud: Cloud, lights: Lights, sources: Sequence[FrameSource], rays: Rays, window: Window, met: float, seed: int
    ) -> None:
        self._walks = Walks(cloud, lights, sources, rays, window, met, seed)
        self._sources, self._window = sources, window
        self._sums: Sums | None = None
        self._looked_at: list[tuple[Array, Array, Array, Array]] = []
        self._side = max(1, math.ceil(max(window.width, window.height) / _REGIONS))
        self._area = np.bincount(self._region(window.pixels(np.arange(window.count)))) * (window.share / window.count)
        # What was seen for the next walks to begin at, what waits for those on their way, and what these found that is not added up yet.
        self._ahead: Looked | None = None
        self._under_way: Callable[[], Batch] | None = None
        self._kept: list[Batch] = []
        self.count, self.under_way = 0, 0

    def _region(self, pixels: Array) -> Array:
        window, width = self._window, self._window.size[0]
        row, column = pixels // width - window.top, pixels % width - window.left
        region: Array = row // self._side * -(-window.width // self._side) + column // self._side
        return region

    def extend(self, walks: int, ahead: bool = True) -> None:
        """Trace `walks` more walks, a fourth of them for each group; the first two groups are one half, the others the other.

        The last of them are still on their way when it returns: what was found before is added up meanwhile. With `ahead` it has looked
        for where the next ones will begin before these were set off.
        """
        while walks > 0:
            number = min(walks, AT_ONCE)
            walks -= number
            looked, self._ahead = self._ahead or self._walks.look(number), None
            if looked is None:
                return
            drawn = self._walks.drawn(looked, number)
            # The device does one thing after the other: results are fetched, and the next points looked for, before it begins with these.
            done = self._under_way() if self._under_way else None
            if ahead or walks > 0:
                self._ahead = self._walks.look(number)
            self._under_way = self._walks.begin(drawn)
            self.under_way = len(drawn.points)
            self.count += self.under_way
            if done is not None:
                self._keep(done)

    def settle(self) -> None:
        """Wait for the walks that are on their way."""
        if self._under_way is not None:
            self._keep(self._under_way())
            self._under_way, self.under_way = None, 0
        self._add_kept()

    def _keep(self, batch: Batch) -> None:
        """Put aside what is added up later: each time costs as much as some ten thousand walks."""
        self._kept.append(batch)
        if sum(len(kept.points) for kept in self._kept) >= ROUND:
            self._add_kept()

    def _add_kept(self) -> None:
        if self._kept:
            self._add(Batch.joined(self._kept))
            self._kept.clear()

    def _add(self, batch: Batch) -> None:
        predicted, walked = batch.predicted, batch.walked
        if self._sums is None:
            level = predicted.mean(axis=1, keepdims=True)
            ratio = predicted / np.maximum(level, 1e-30)
            # Where all channels are one up to a factor, so is what corrects them.
            self._grey = bool(np.all(np.ptp(ratio, axis=0) < _GREY * np.maximum(ratio.max(axis=0), 1e-30)))
            mean = np.average(predicted, weights=batch.weights, axis=0)
            floor = FLOOR * np.maximum(mean.mean(keepdims=True) if self._grey else mean, 1e-30)
            self._sums = Sums(batch.points.min(axis=0), batch.points.max(axis=0), floor)
            shape = len(floor), 2, len(self._area)
            self._residual, self._truth, self._number = np.zeros(shape), np.zeros(shape), np.zeros(2)
            self._moments = np.zeros(2)
        if self._grey:
            predicted, walked = predicted.mean(axis=1, keepdims=True), walked.mean(axis=1, keepdims=True)
        weights = batch.weights
        self._sums.add(batch.points, weights, predicted, walked, batch.groups)
        region, half = self._region(batch.pixels), batch.groups // 2
        place, halves = half * len(self._area) + region, (2, len(self._area))
        for c in range(len(self._sums.floor)):
            self._residual[c] += np.bincount(place, weights * (predicted[:, c] - walked[:, c]), 2 * len(self._area)).reshape(halves)
            self._truth[c] += np.bincount(place, weights * walked[:, c], 2 * len(self._area)).reshape(halves)
        self._number += np.bincount(half, minlength=2)
        together = weights * (predicted - walked).sum(axis=1)
        self._moments += together.sum(), np.square(together).sum()
        if sum(len(points) for points, *_ in self._looked_at) < _LOOKED_AT:
            few = slice(0, None, max(1, len(weights) // _LOOKED_AT))
            self._looked_at.append((batch.points[few], weights[few], predicted[few], region[few]))

    @property
    def filled(self) -> int:
        """Cells that walks have begun in: with their number grows what it takes to judge."""
        return 0 if self._sums is None else int(np.count_nonzero(self._sums.count))

    def before(self) -> RegionError:
        """Error of what is audited."""
        self.settle()
        return self._judged(None)

    def correction(self) -> Correction:
        """The correction that all walks ask for."""
        self.settle()
        assert self._sums is not None
        return Correction(self._sums)

    def remaining(self) -> RegionError:
        """Error that a correction leaves: each half is corrected with what the other half says. That of all walks leaves less."""
        self.settle()
        assert self._sums is not None
        return self._judged([self._step(Correction(self._sums, halves)) for halves in (((2,), (3,)), ((0,), (1,)))])

    def _step(self, correction: Correction) -> Array:
        """By how much a correction changes the image's multiple scattering (channels, regions)."""
        assert self._sums is not None
        points, weights, predicted, region = (np.concatenate(parts) for parts in zip(*self._looked_at, strict=True))
        change = np.maximum(predicted + (predicted + self._sums.floor) * correction(points), 0) - predicted
        return np.stack([np.bincount(region, weights * of_channel, len(self._area)) for of_channel in change.T]) / len(weights)

    def corrected(self, correction: Correction) -> list[FrameSource]:
        """The sources with a correction in the values at their nodes."""
        assert self._sums is not None
        if not correction.levels:
            return list(self._sources)
        points, weights, *_ = (np.concatenate(parts) for parts in zip(*self._looked_at, strict=True))
        floor = self._sums.floor / len(self._sources)
        return [source.corrected(correction, floor, points, weights) for source in self._sources]

    def _judged(self, steps: list[Array] | None) -> RegionError:
        """Error of what is audited; or with a change (channels, regions) for each half that does not depend on that half's walks."""
        truth = self._truth.sum(axis=1) / self.count
        if not truth.sum() > 0:
            return RegionError(0.0, 0.0, 0.0, 0.0)
        level = truth / self._area
        lit = level > _DARK * np.quantile(level, 0.999)
        errors = self._residual.swapaxes(0, 1) / np.maximum(self._number, 1)[:, None, None]
        product = errors[0] * errors[1]
        residual = float(self._moments[0]) / self.count
        if steps is not None:
            # Of (e + c)^2 the first part is known as the product of the halves, the others are linear in the noise of one half alone.
            for error, step in zip(errors, steps, strict=True):
                product = product + 0.5 * (2 * error * step + np.square(step))
                residual += 0.5 * float(step.sum())
        # Channels of a region err together.
        of_region = np.where(lit, product / self._area, 0).sum(axis=0)
        # Over the mean of the lit part, as the error of an image is.
        norm = float(truth[lit].sum()) ** 2 / float((lit * self._area).sum())
        mean = float(truth.sum())
        variance = max(float(self._moments[1]) / self.count - (float(self._moments[0]) / self.count) ** 2, 0.0)
        return RegionError(
            residual / mean,
            math.sqrt(variance / self.count) / mean,
            float(of_region.sum()) / norm,
            float(np.sqrt(np.square(of_region).sum())) / norm,
        )


@dataclass(frozen=True)
class Outcome:
    """Sources to render with, and what the audit found, for a report."""

    sources: list[FrameSource]
    found: dict[str, Any]


def audited(
    audit: Audit,
    sources: Sequence[FrameSource],
    correct: bool,
    error: float,
    most: int,
    left: Callable[[], float],
    at_once: int = ROUND,
) -> Outcome:
    """Audit sources and, where it helps, correct them.

    Parameters
    ----------
    audit, sources
        walks of the frame, and what they audit.
    correct
        whether to correct.
    error
        the error to stop at; 0 goes on until the time is over.
    most
        most walks; in order to correct as many more as bring what is left to `error`, up to three times their number and `MOST`.
    left
        is asked between rounds how many seconds are left for walks, judging and correcting; nothing where somebody interrupts.
    at_once
        walks of a first round, and of others where there is no time for more.

    Returns
    -------
    The sources, and what was found; nothing where the camera sees no cloud.
    """
    clock = time.perf_counter()
    audit.extend(min(at_once, most), most > at_once)
    if not audit.count:
        return Outcome(list(sources), {})

    def judged() -> tuple[RegionError, RegionError]:
        before = audit.before()
        return before, audit.remaining() if correct else before

    audit.settle()
    pace = (time.perf_counter() - clock) / audit.count
    if error > 0:
        limit = most
        while True:
            clock = time.perf_counter()
            before, reached = judged()
            if max(reached.squared, 0.0) + _SURE * reached.squared_deviation <= error**2:
                break
            # To judge once more and to apply a correction take about three times as long as to judge.
            ending = 3 * (time.perf_counter() - clock)
            if left() < ending:
                break
            if correct and 1.1 * audit.count > limit:
                # What is left, squared, falls with about the root of the number of walks.
                enough = audit.count * ((max(reached.squared, 0.0) + reached.squared_deviation) / error**2) ** 2
                limit = int(min(enough, _FURTHER * most, max(MOST, most)))
            # A last round that adds little tells nothing new.
            if 1.1 * audit.count > limit:
                break
            pace = _walk(audit, limit, left, ending / audit.filled, pace, at_once)
            # What judging takes is to be known without the walks that it would wait for.
            audit.settle()
    else:
        # Nobody asks for the error before the end: a part of the work tells how long the whole will take.
        clock = time.perf_counter()
        if correct:
            audit.correction()
        else:
            audit.before()
        ending = (_CORRECTIONS if correct else 1) * (time.perf_counter() - clock)
        _walk(audit, most, left, ending / audit.filled, pace, at_once)
        before, reached = judged()
    found: dict[str, Any] = {"walks": audit.count, "network": before.summary(), "corrected": False}
    if correct:
        correction = audit.correction()
        # What the halves do not find to help is not done.
        if correction.levels and reached.squared < before.squared:
            found |= {"corrected": True, "levels": correction.levels, "remaining": reached.summary()}
            return Outcome(audit.corrected(correction), found)
    return Outcome(list(sources), found)


def _walk(audit: Audit, limit: int, left: Callable[[], float], ending: float, pace: float, least: int) -> float:
    """Trace walks, `limit` in all, in rounds while there is time; returns the seconds that a walk takes.

    What comes after takes `ending` seconds for each cell that is filled. A walk took `pace` seconds; rounds have `least` walks, and where
    there is time for more, half of those.
    """
    clock, before = time.perf_counter(), 0
    while audit.count < limit:
        seconds = left() - ending * audit.filled - pace * audit.under_way
        # Of rounds that cannot be smaller the last one ends no further beyond the time than it would have ended before it.
        if not seconds > 0.5 * least * pace:
            break
        walks = int(min(max(_PART * seconds / pace, least), ROUND, limit - audit.count))
        audit.extend(walks, audit.count + walks < limit and pace * walks < seconds)
        now = time.perf_counter()
        # Each round waits for the one before.
        if before:
            pace = (now - clock) / before
        clock, before = now, walks
    return pace


def time_for_walks(left: float, one: float, every: float) -> float:
    """Seconds that walks may take of those that are `left`.

    Parameters
    ----------
    left
        seconds until the image is to be done.
    one, every
        seconds that one sample of each pixel will take, and all samples that are wanted.

    Returns
    -------
    What is left by all samples, within limits; and what would be too short for another sample.
    """
    least, most = (share * (left - one) for share in _SHARE)
    seconds = min(max(left - every, least), most)
    samples = (left - seconds) // one
    return max(seconds, min(left - samples * one, most))
