"""Rounds of camera samples, until there are as many as asked for or the noise is as small as asked for."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

from deepclouds_runtime.frame import Frame
from deepclouds_runtime.result import Image, RenderResult

_LOG = logging.getLogger(__name__)
# Samples a pixel of which path tracing foretells how many it will take.
_FORETELL = 16
SoFar = Callable[[float], RenderResult]


@dataclass(frozen=True)
class Watch:
    """What is told and asked between rounds, see `deepclouds_runtime.renderer.Renderer.render`."""

    progress: Callable[[float], None] | None = None
    partial: Callable[[RenderResult], None] | None = None
    interrupted: Callable[[], bool] | None = None
    estimate: Callable[[float], None] | None = None

    @property
    def stops(self) -> bool:
        """Whether to stop."""
        return self.interrupted is not None and self.interrupted()


def fixed_rounds(
    frame: Frame,
    most: int,
    error: float,
    watch: Watch,
    so_far: SoFar,
    target: float | None = None,
    end: float = math.inf,
) -> tuple[float, bool]:
    """Take `most` samples of every pixel; returns the noise, as far as it is known, and whether somebody stopped it.

    In rounds that double their number where somebody watches, else all at once: the samples are the same. With a `target` for the noise, or
    an `end` of the time, in seconds of `time.perf_counter`, it takes fewer where that is reached first: rounds are cut so that they should
    end in time, and one sample there is in any case.
    """
    noise, growth, ending = math.inf, 2.0, 0.0
    may_end = target is not None or not math.isinf(end)
    if watch.partial is None and watch.interrupted is None and not may_end:
        frame.round(0, most, most, watch.progress)
        return noise, False
    # The first of a known number of samples lie at the near end of what is spread over all of them: what may be cut is open-ended.
    known, progress = (0, None) if may_end else (most, watch.progress)
    started = time.perf_counter()
    frame.round(0, 1, known, progress)
    pace = max(time.perf_counter() - started, 1e-6)
    while frame.samples < most and (target is None or not noise <= target):
        if watch.stops:
            return noise, True
        done = frame.samples
        before, ending = _image(frame, ending)
        more = _in_time(min(math.ceil(done * (growth - 1)), most - done), end - ending, pace)
        if more < 1:
            break
        if watch.partial is not None:
            watch.partial(so_far(noise))
        clock = time.perf_counter()
        if frame.round(done, more, known, progress, watch.interrupted):
            return noise, True
        pace = max(time.perf_counter() - clock, 1e-6) / more
        noise, wanted = frame.settle(before, done, error, rest=False)
        if target is not None:
            growth = wanted
        if watch.estimate is not None:
            watch.estimate(noise)
        if may_end and watch.progress is not None:
            of_error = 0.0 if target is None else (target / max(noise, 1e-9)) ** 2
            watch.progress(min(max(frame.samples / most, of_error, (time.perf_counter() - started) / (end - started)), 1.0))
    return noise, False


def _image(frame: Frame, ending: float) -> tuple[Image, float]:
    """The image so far, and the seconds it took to make, or before: what follows each round, and the last one."""
    clock = time.perf_counter()
    image = frame.film.beauty()
    return image, max(ending, time.perf_counter() - clock)


def _in_time(more: int, end: float, pace: float) -> int:
    """So many of `more` samples as should be done before the `end`, at `pace` seconds each."""
    if math.isinf(end):
        return more
    left = end - time.perf_counter()
    return min(more, int(left / pace)) if left > 0 else 0


def rounds_for_error(
    frame: Frame, most: int, target: float | None, error: float, end: float, rest: bool, watch: Watch, so_far: SoFar
) -> tuple[float, bool]:
    """Take samples until the noise is small enough; returns it, and whether somebody stopped it.

    Parameters
    ----------
    frame, most
        what takes them, and the most samples a pixel.
    target
        noise to stop at, over the mean; None goes on until `end`.
    error
        noise by which pixels are judged.
    end
        of the time, in seconds of `time.perf_counter`; no round begins that should end later.
    rest
        whether blocks of pixels may rest.
    watch, so_far
        who is told, and the image so far from its noise.
    """
    started, noise, growth, ending = time.perf_counter(), math.inf, 2.0, 0.0
    frame.round(0, 1, 0, None)
    pace = max(time.perf_counter() - started, 1e-6)
    while frame.samples < most and (target is None or not noise <= target):
        if watch.stops:
            return noise, True
        done = frame.samples
        before, ending = _image(frame, ending)
        more = _in_time(min(math.ceil(done * (growth - 1)), most - done), end - ending, pace)
        if more < 1:
            break
        if watch.partial is not None:
            watch.partial(so_far(noise))
        clock = time.perf_counter()
        if frame.round(done, more, 0, None, watch.interrupted):
            return noise, True
        pace = max(time.perf_counter() - clock, 1e-6) / more
        noise, growth = frame.settle(before, done, error, rest)
        if not rest and done < _FORETELL <= frame.samples and noise > error:
            _say_ahead(frame.samples, noise, error, end, most, pace)
        if watch.estimate is not None:
            watch.estimate(noise)
        if watch.progress is not None:
            # Of the time where that alone decides.
            share = (time.perf_counter() - started) / (end - started) if target is None else (error / max(noise, 1e-9)) ** 2
            watch.progress(min(share, 1.0))
    return noise, False


@cache
def say_ignored(error: float | None, asked: int) -> None:
    """Say that a scene's own number of samples is ignored, once for all frames of a sequence; without an error the time decides."""
    what = "until the time is over" if error is None else f"for an error of {error:g}"
    _LOG.info("samples a pixel are chosen %s; the scene's own %d are ignored (spp forces a number)", what, asked)


def _say_ahead(samples: int, noise: float, error: float, end: float, most: int, pace: float) -> None:
    """Say what a path-traced image will take."""
    whole = min(samples * (noise / error) ** 2, most)
    seconds = (whole - samples) * pace
    left = end - time.perf_counter()
    text = f"path tracing: noise of a pixel is about {noise:.2g} after {samples} samples; {error:g} takes about {whole:,.0f}"
    _LOG.info("%s, %.0f s more%s", text, seconds, "" if seconds <= left else f", but there are only {max(left, 0.0):.0f} s left")
