"""How much a cloud that stands still flickers while the camera goes round it.

    python -m benchmarks.flicker [--size 64] [--step 1] [--error 0.014] [--docs]

Three frames in a row, `I0, I1, I2`, at several places of the turn. What a linear change leaves, `D = I1 - (I0 + I2) / 2`, holds what really
changes faster than that, and flicker. Two converged renders A and B that share no seed with the image or with each other show the former:

    flicker = sqrt( max(0, mean( (D - D_A) (D - D_B) )) / 1.5 ) / mean( (A1 + B1) / 2 )

over all channels of the pixels where A1 + B1 exceeds 2 % of its 99.9th percentile. It is free of the converged renders' own noise.
Frames with independent noise of s flicker by s: 1.5 is what the weights 1, 1/2, 1/2 make of its variance; an error that stays where it
is, on the screen or on the cloud, does not flicker. `whole image` is the same of the image's mean.
"""

from __future__ import annotations

import argparse
import math
import operator
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from deepclouds_runtime._job import ERROR_OF_FRAMES
from deepclouds_runtime.demo import DATA
from deepclouds_runtime.loading import load
from deepclouds_runtime.turntable import Turntable
from deepclouds_runtime.volume_scene import framed_corners, pivot
from numpy.typing import NDArray

from benchmarks.make_scenes import heap
from benchmarks.page import write_results
from deepclouds.volume import Volume, write_vol

PAGE = Path(__file__).parents[1] / "docs" / "rendering.md"
Image = NDArray[np.float64]
# Frames of a turn at which a triple begins, as shares of it.
_PLACES = (0.05, 0.35, 0.7)
_DARK = 0.02
_CONVERGED_SPP = 32
_SEEDS = {"a": 500_000, "b": 900_000}


@dataclass(frozen=True)
class Case:
    """A cloud and its lights."""

    name: str
    cloud: str
    options: dict[str, Any]


CASES = (
    Case("cumulus, sun", "demo", {"sky": 0.0}),
    Case("cumulus, sun and sky", "demo", {}),
    Case("heap, sun, albedo 1, 0.98, 0.9", "heap", {"sky": 0.0, "albedo": (1, 0.98, 0.9), "optical_depth": 20.0, "sun": (30, 50)}),
)


@dataclass(frozen=True)
class Flicker:
    """Of a pixel, of the whole image, and what the converged renders change by themselves; shares of the mean."""

    pixel: float
    whole: float
    real: float


def change(frames: Sequence[Image]) -> Image:
    """What a linear change leaves of the middle one of three images."""
    return frames[1] - 0.5 * (frames[0] + frames[2])


def flicker(frames: Sequence[Sequence[Image]], a: Sequence[Sequence[Image]], b: Sequence[Sequence[Image]]) -> Flicker:
    """Flicker of triples of images (h, w, 3) against those of two converged renders; see the module."""
    pixel, whole, real = [], [], []
    for image, one, other in zip(frames, a, b, strict=True):
        both: Image = one[1] + other[1]
        lit = both > _DARK * float(np.quantile(both, 0.999))
        mean = 0.5 * float(both[lit].mean())
        over, under = (change(image) - change(one))[lit], (change(image) - change(other))[lit]
        pixel.append(float(np.mean(over * under)) / mean**2)
        whole.append(float(over.mean() * under.mean()) / mean**2)
        real.append(float(np.mean(change(one)[lit] * change(other)[lit])) / mean**2)
    return Flicker(*(math.sqrt(max(sum(v) / len(v), 0.0) / 1.5) for v in (pixel, whole, real)))


def _triples(render: Callable[[int], Image], step: float) -> list[list[Image]]:
    """Images of three frames from each of the places on; frames are counted from 1 and `step` degrees apart."""
    count = round(360 / step)
    return [[render(1 + round(place * count) + k) for k in range(3)] for place in _PLACES]


def measure(case: Case, size: int, step: float, error: float, folder: Path) -> dict[str, Flicker]:
    """Flicker of the fast mode, with the same and with other random numbers in each frame."""
    path = DATA
    if case.cloud == "heap":
        path = folder / "heap.vol"
        write_vol(path, Volume.from_box(heap().astype(np.float32), (-1, -1, -1), (1, 1, 1)))
    count = round(360 / step)

    def turning(mode: str) -> tuple[Any, Turntable]:
        renderer = load(path, size=(size, size), turn=count, mode=mode, **case.options)
        return renderer, Turntable(renderer.scene.sensor, count, pivot(framed_corners(renderer.scene.volume), "y"))

    def frames(made: tuple[Any, Turntable], spp: int | None, seed: Callable[[int], int]) -> list[list[Image]]:
        def render(frame: int) -> Image:
            made[1].turn(frame)
            return np.asarray(made[0].render(spp, seed(frame), error=error).rgb, np.float64)

        return _triples(render, step)

    reference = turning("reference")
    a, b = (frames(reference, _CONVERGED_SPP, partial(operator.add, first)) for first in _SEEDS.values())
    fast = turning("fast")
    return {
        "same random numbers": flicker(frames(fast, None, lambda frame: 1), a, b),
        "others in each frame": flicker(frames(fast, None, lambda frame: frame), a, b),
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print, with ``--docs`` into the page too."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--size", type=int, default=64, help="pixels a side (default %(default)s)")
    parser.add_argument("--step", type=float, default=1.0, help="degrees from frame to frame (default %(default)s)")
    parser.add_argument("--error", type=float, default=ERROR_OF_FRAMES, help="of the dial (default %(default)s)")
    parser.add_argument("--only", type=int, help="number of one case, from 0")
    parser.add_argument("--docs", action="store_true", help="write the results into docs/rendering.md")
    arguments = parser.parse_args(argv)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for case in CASES if arguments.only is None else CASES[arguments.only : arguments.only + 1]:
            started = time.process_time()
            for how, found in measure(case, arguments.size, arguments.step, arguments.error, Path(folder)).items():
                rows.append(f"| {case.name} | {how} | {100 * found.pixel:.2f} | {100 * found.whole:.2f} | {100 * found.real:.2f} |")
                print(rows[-1], flush=True)
            print(f"{case.name}: {time.process_time() - started:.0f} s of processor time", file=sys.stderr)
    if arguments.docs:
        head = "| cloud | from frame to frame | flicker of a pixel % | of the whole image % | real change % |\n|---|---|---|---|---|"
        write_results(PAGE, "flicker", head + "\n" + "\n".join(rows))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
