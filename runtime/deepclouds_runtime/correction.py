"""What walks say about the predicted multiple scattering, made into a smooth correction of it.

The correction is a field d over space: J becomes J + (J + b) d, where b is a small share of the mean of J, so that places which the network
takes for black can be lifted too. d is a sum of piecewise trilinear fields on lattices from coarse to fine. Each lattice takes what the
coarser ones left, shrunken by how much of it is noise: two independent halves of the walks agree on what is real, and the mean of their
product is its variance (Wiener's filter). A level at which they do not agree is left out: the error of a network may have no coarse part
but a finer one. With more walks everything is taken in, down to the finest lattice.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
# Share of the mean of J that is added to J where the correction is taken in proportion to it.
FLOOR = 0.02
# Cells along the longest edge: 1, 2, 4, ...; before them one number for all.
_LEVELS = 6
# Walks are gathered in so many cells along the longest edge first.
_FINE = 64
# Agreement of the halves, in standard deviations of what chance would give, below which it does not count.
_CHANCE = 1.0


@dataclass(frozen=True)
class Walks:
    """Walks from points of the cloud, and what was predicted there.

    Attributes
    ----------
    points
        (n, 3) world points.
    weights
        (n,) what a walk counts in the image.
    predicted, walked
        (n,) J, mean of the colour channels.
    half
        (n,) 0 or 1: which of two independent halves a walk belongs to.
    """

    points: Array
    weights: Array
    predicted: Array
    walked: Array
    half: Array

    def of(self, chosen: Array, half: Array) -> Walks:
        """Some of the walks, in other halves."""
        return Walks(self.points[chosen], self.weights[chosen], self.predicted[chosen], self.walked[chosen], half[chosen])


class Correction:
    """The field d; see the module.

    Parameters
    ----------
    walks
        what it is fitted to.

    Attributes
    ----------
    levels
        how many lattices it is made of, the single number counted.
    """

    def __init__(self, walks: Walks) -> None:
        lower, upper = walks.points.min(axis=0), walks.points.max(axis=0)
        self._lower, self._edges = lower, np.maximum(upper - lower, 1e-9 * max(float((upper - lower).max()), 1e-30))
        self._parts: list[tuple[Array | None, Array]] = []
        longest = float(self._edges.max())
        place = self._local(walks.points)
        fine = np.maximum((_FINE * self._edges / longest).astype(np.int64), 1)
        cell = np.ravel_multi_index(tuple(np.minimum((place * fine).astype(np.int64), fine - 1).T), tuple(fine))
        cells, member = np.unique(cell, return_inverse=True)

        def gathered(values: Array) -> Array:
            return np.bincount(member, values, len(cells))

        mean = float(np.average(walks.predicted, weights=walks.weights)) if walks.weights.sum() > 0 else 0.0
        if not mean > 0:
            return
        scale = walks.weights * (walks.predicted + FLOOR * mean)
        residual = walks.weights * (walks.walked - walks.predicted)
        halves = [walks.half == h for h in (0, 1)]
        of_residual, of_scale = ([gathered(np.where(h, v, 0)) for h in halves] for v in (residual, scale))
        # Variance of a cell's summed residual, from the walks themselves.
        variance = gathered(np.square(residual))
        total = gathered(scale)
        centre = np.stack([gathered(scale * place[:, a]) / np.maximum(total, 1e-300) for a in range(3)], axis=1)
        known = np.zeros(len(cells))
        for level in range(-1, _LEVELS):
            size = None if level < 0 else np.maximum(np.ceil(2.0**level * self._edges / longest), 1).astype(np.int64)
            index, tent, count = _tents(centre, size)

            def at_nodes(values: Array, index: Array = index, tent: Array = tent, count: int = count) -> Array:
                return np.bincount(index.ravel(), (tent * values[:, None]).ravel(), count)

            left = [at_nodes(r - s * known) for r, s in zip(of_residual, of_scale, strict=True)]
            below = [at_nodes(s) for s in of_scale]
            spread = np.bincount(index.ravel(), (tent**2 * variance[:, None]).ravel(), count)
            both = np.minimum(*below) > 1e-12 * float(total.sum())
            if not both.any():
                break
            first, second = (np.where(both, r / np.where(both, s, 1), 0) for r, s in zip(left, below, strict=True))
            mean_value = np.where(both, sum(left) / np.where(both, sum(below), 1), 0)
            # Few walks underestimate their own variance: every node gets part of what is usual.
            sums = np.where(both, sum(below), 1)
            usual = float(variance.sum() / total.sum()) / sums
            noise = np.where(both, np.maximum(spread / np.square(sums), 0.5 * usual), 0)
            weight = np.where(both, np.sqrt(below[0] * below[1]), 0)
            # Chance alone makes this product vary by about twice the noise of a mean of both halves.
            chance = float(np.sqrt(np.sum(np.square(2 * weight * noise))) / weight.sum())
            real = float((weight * first * second).sum() / weight.sum()) - _CHANCE * chance
            if not real > 0:
                continue
            values = mean_value * real / (real + noise + 1e-300)
            self._parts.append((size, values))
            known = known + (tent * values[index]).sum(axis=1)

    @property
    def levels(self) -> int:
        """How many lattices it is made of."""
        return len(self._parts)

    def __call__(self, points: Array) -> Array:
        """The field d (n,) at world points (n, 3); beyond the walks it goes on as at the nearest place that they know."""
        place = self._local(points)
        result = np.zeros(len(points))
        for size, values in self._parts:
            index, tent, _ = _tents(place, size)
            result += (tent * values[index]).sum(axis=1)
        # J stays positive.
        held: Array = np.maximum(result, -1)
        return held

    def _local(self, points: Array) -> Array:
        place: Array = np.clip((points - self._lower) / self._edges, 0, 1)
        return place


def _tents(place: Array, size: Array | None) -> tuple[Array, Array, int]:
    """Nodes (n, 8) of a lattice of `size` cells around places (n, 3) in the unit cube, their weights, and how many nodes there are."""
    if size is None:
        return np.zeros((len(place), 1), np.int64), np.ones((len(place), 1)), 1
    scaled = place * size
    corner = np.minimum(scaled.astype(np.int64), size - 1)
    fraction = scaled - corner
    index, weights = np.zeros((len(place), 1), np.int64), np.ones((len(place), 1))
    for axis in range(3):
        below = index * (size[axis] + 1) + corner[:, axis : axis + 1]
        t = fraction[:, axis : axis + 1]
        index, weights = np.concatenate([below, below + 1], axis=1), np.concatenate([weights * (1 - t), weights * t], axis=1)
    return index, weights, int(np.prod(size + 1))
