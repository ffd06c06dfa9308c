"""Labels from walks: how many walks a point needs, and their mean in two independent halves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Walks are traced in groups, half of each for either half of the label.
GROUP = 8
# Results of one call of the tracer: 64 MiB.
_RESULTS = 2**24
# A label below this share of its cloud's mean label needs no smaller error than one there.
FLOOR = 0.1

# Traces so many walks for each of the points of the given numbers: (rows,), walks, seed -> float32 (rows, walks, k, m).
Tracer = Callable[[NDArray[np.int64], int, int], NDArray[np.float32]]


@dataclass(frozen=True)
class Estimate:
    """Labels of n points: both halves (n, k, m, 2), standard error of their mean (n, k, m), and walks (n,)."""

    half: NDArray[np.float64]
    error: NDArray[np.float64]
    walks: NDArray[np.int64]

    @property
    def label(self) -> NDArray[np.float64]:
        """Mean of the halves, (n, k, m)."""
        mean: NDArray[np.float64] = self.half.mean(axis=-1)
        return mean


def estimate(trace: Tracer, walks: NDArray[np.int64], labels_per_point: tuple[int, int], seed: int) -> Estimate:
    """Trace ``walks[i]`` walks, a multiple of 8, for point i.

    The result is a function of the arguments alone: portions and their seeds depend on nothing else.
    """
    n = len(walks)
    k, m = labels_per_point
    rows = np.repeat(np.arange(n), walks // GROUP)
    sums, squares = np.zeros((n, 2, k, m)), np.zeros((n, k, m))
    portion = max(1, _RESULTS // (GROUP * k * m))
    seeds = np.random.SeedSequence(seed).generate_state(len(rows) // portion + 1, np.uint64)
    for number, start in enumerate(range(0, len(rows), portion)):
        mine = rows[start : start + portion]
        values = trace(mine, GROUP, int(seeds[number] >> np.uint64(1)))
        if not (np.isfinite(values).all() and (values >= 0).all()):
            raise FloatingPointError("the tracer returned NaN, Inf or negative labels")
        # The rows are sorted, so every point is one run of them.
        points, first = np.unique(mine, return_index=True)
        group = values.reshape(len(mine), 2, GROUP // 2, k, m)
        sums[points] += np.add.reduceat(group.sum(axis=2, dtype=np.float64), first, axis=0)
        squares[points] += np.add.reduceat(np.square(values, dtype=np.float64).sum(axis=1), first, axis=0)
    count = walks[:, None, None]
    mean = sums.sum(axis=1) / count
    variance = np.maximum(squares / count - mean**2, 0) * count / (count - 1)
    return Estimate(np.moveaxis(sums, 1, -1) / (0.5 * count[..., None]), np.sqrt(variance / count), walks)


def needed_walks(pilot: Estimate, target: float, every: bool, least: int, most: int) -> NDArray[np.int64]:
    """Walks a point needs so that its labels' standard error is `target` times the label, or times a tenth of the mean label.

    A pilot of few walks knows a point's variance badly, and tends to find none where light is rare, so its finding is averaged
    with the mean over the points, which counts as a group of walks. The pilot decides numbers only: a label that included it would be
    biased, since points where it was lucky would be stopped early.
    """
    variance = pilot.error**2 * pilot.walks[:, None, None]
    allowed = (target * np.maximum(pilot.label, FLOOR * pilot.label.mean())) ** 2
    if not allowed.any():
        return np.full(len(pilot.walks), least)
    need = (variance / allowed).max(axis=(1, 2)) if every else variance.sum(axis=(1, 2)) / allowed.sum(axis=(1, 2))
    # Where the pilot saw no light at all it knows nothing.
    seen = variance.any(axis=(1, 2))
    typical = float(need[seen].mean()) if seen.any() else 0.0
    need = np.where(seen, (pilot.walks * need + GROUP * typical) / (pilot.walks + GROUP), typical)
    walks: NDArray[np.int64] = np.clip(GROUP * np.ceil(need / GROUP), least, most).astype(np.int64)
    return walks
