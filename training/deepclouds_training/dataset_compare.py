"""Two independent sets of labels at the same points: whether they are labels of the same thing.

The ratio of the mean labels sees a small common bias; the share of single labels that are several standard errors apart sees errors that
are not what they are called, and biases of either sign that cancel in the mean.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deepclouds.errors import InputError
from deepclouds.metrics import student_p
from deepclouds_training.dataset_info import relative_errors
from deepclouds_training.shards import Dataset, Shard

_SAME = ("point", "w", "phase", "omega_sun", "albedo")


@dataclass(frozen=True)
class Difference:
    """What two label sets of one cloud, or of several, differ by.

    Attributes
    ----------
    points, labels
        compared points, and compared labels: those that at least one of the sets has a standard error for.
    ratio, error
        mean label of the first set over that of the second, and its standard error.
    dof
        degrees of freedom behind `error`.
    beyond
        share of the labels that are more than 2 and more than 3 standard errors of their difference apart; noise alone gives 4.6 and
        0.3 % of them where labels have many walks.
    noise
        mean relative standard errors of the two sets, as `deepclouds dataset info` counts them.
    """

    points: int
    labels: int
    ratio: float
    error: float
    dof: int
    beyond: tuple[float, float]
    noise: tuple[float, float]

    @property
    def p(self) -> float:
        """Two-sided p-value of a ratio of 1."""
        if self.error == 0:
            return 1.0 if self.ratio == 1 else 0.0
        return float(student_p(abs(self.ratio - 1) / self.error, self.dof))


def difference(first: Shard, second: Shard) -> Difference:
    """Compare two independent label sets of one cloud.

    The walks of a point serve all its labels, so points are what is independent: the error of the ratio comes from the spread of the
    points' sums about it, whatever the correlation within a point.

    Raises
    ------
    InputError
        when the points, what is asked about them, or the clouds differ; for fewer than two points; where the second set is black.
    """
    for name in _SAME:
        if not np.array_equal(getattr(first, name), getattr(second, name)):
            raise InputError(f"the two sets differ in `{name}`: only labels of the same points can be compared")
    if not np.array_equal(first.volume.density, second.volume.density) or first.scale != second.scale:
        raise InputError("the two sets have different clouds: only labels of the same points can be compared")
    n = len(first.point)
    labels = [shard.label.astype(np.float64) for shard in (first, second)]
    if n < 2 or labels[1].sum() == 0:
        raise InputError(f"{n} points with a mean label of {labels[1].mean():g} in the second set: there is nothing to compare")
    a, b = (v.sum(axis=(1, 2)) for v in labels)
    ratio = float(a.sum() / b.sum())
    error = float(np.sqrt(n / (n - 1) * ((a - ratio * b) ** 2).sum()) / b.sum())
    spread = np.hypot(*(shard.error.astype(np.float64) for shard in (first, second)))
    known = spread > 0
    apart = np.abs(labels[0] - labels[1])[known] / spread[known]
    beyond = [float((apart > limit).mean()) if known.any() else 0.0 for limit in (2, 3)]
    noise = [float(relative_errors(shard).mean()) for shard in (first, second)]
    return Difference(n, int(known.sum()), ratio, error, n - 1, (beyond[0], beyond[1]), (noise[0], noise[1]))


def together(parts: list[Difference]) -> Difference:
    """All clouds: ratios weighted by their inverse variances, shares and noise by the numbers of labels."""
    weight = np.array([1 / max(d.error, 1e-12) ** 2 for d in parts])
    count: NDArray[np.float64] = np.array([d.labels for d in parts], np.float64)
    count /= max(count.sum(), 1)
    return Difference(
        points=sum(d.points for d in parts),
        labels=sum(d.labels for d in parts),
        ratio=float(sum(w * d.ratio for w, d in zip(weight, parts, strict=True)) / weight.sum()),
        error=float(1 / np.sqrt(weight.sum())),
        dof=sum(d.dof for d in parts),
        beyond=(float(count @ [d.beyond[0] for d in parts]), float(count @ [d.beyond[1] for d in parts])),
        noise=(float(count @ [d.noise[0] for d in parts]), float(count @ [d.noise[1] for d in parts])),
    )


def print_comparison(first: Dataset, second: Dataset) -> None:
    """Print a line for every cloud that both data sets hold, and one for all; InputError when there is none."""
    others = {entry.index: entry for entry in second.shards}
    pairs = [(entry, others[entry.index]) for entry in first.shards if entry.index in others]
    if not pairs:
        raise InputError(f"{first.folder} and {second.folder} hold no cloud in common; name two data sets of one configuration")
    print(f"{first.folder} ({first.manifest.get('tracer')}) over {second.folder} ({second.manifest.get('tracer')}), {len(pairs)} clouds")
    print(f"  {'cloud':22s}{'points':>8s}{'labels':>8s}{'noise, 1st':>12s}{'2nd':>8s}{'ratio':>17s}{'p':>7s}{'> 2 s.e.':>10s}{'> 3':>8s}")
    parts = []
    for mine, other in pairs:
        try:
            parts.append(difference(first.load(mine), second.load(other)))
        except InputError as error:
            raise InputError(f"{Path(mine.file).stem}: {error}") from error
        print(_line(f"{mine.index} {mine.family}", parts[-1]))
    print(_line("all", together(parts)))


def _line(name: str, d: Difference) -> str:
    return (
        f"  {name:22s}{d.points:8d}{d.labels:8d}{d.noise[0]:12.1%}{d.noise[1]:8.1%}{d.ratio:9.4f} +- {d.error:.4f}{d.p:7.3f}"
        f"{d.beyond[0]:10.1%}{d.beyond[1]:8.1%}"
    )
