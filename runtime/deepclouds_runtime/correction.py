"""What walks say about the predicted multiple scattering, made into a smooth correction of it.

The correction is a field d over space: J becomes J + (J + b) d, where b is a small share of the mean of J, so that places which the network
takes for black can be lifted too. d is a sum of piecewise trilinear fields on nested lattices from coarse to fine. Each lattice takes what
the coarser ones left, shrunken by how much of it is noise: two independent halves of the walks agree on what is real, and the mean of
their product is its variance (Wiener's filter), in every neighbourhood its own as far as that is known. A level at which they do not agree
is left out: a network's error may have no coarse part but a finer one. With more walks everything is taken in, down to the finest lattice.

The noise of a node is that of its walks in number, at the variance of the walks in a wide neighbourhood. Its own walks may not tell it: the
rare ones that find much light would be believed less for it, and the sum would be too dark. What is left of that is kept out of the image's
sum by finer levels that have none: only the single number changes it.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from deepclouds_runtime.octree import Array

# Share of the mean of J that is added to J where the correction is taken in proportion to it.
FLOOR = 0.02
# Cells along the longest edge: 1, 2, 4, ... 64; before them one number for all. Walks are gathered in the finest of them.
_LEVELS = 7
_FINE = 1 << (_LEVELS - 1)
# Level whose cells share what is known of the walks' variance.
_POOLED = 2
# Nodes along the edge of a block, of which 3 x 3 x 3 know how much the network errs there.
_BLOCK = 3
# Agreement of the halves, in standard deviations of what chance would give, that does not count.
CHANCE = 0.5
# Lattices with fewer walks a node, and all finer ones, are left out: they would cost the most and be believed the least.
_SPARSE = 32
# A lattice looks at cells so many times halved from its own, or at the finest.
_WITHIN = 1
# Independent groups of walks.
GROUPS = 4


class Sums:
    """Walks gathered in cells, group by group.

    Parameters
    ----------
    lower, upper
        (3,) corners of the box that they start from, world; what lies outside counts in the nearest cell.
    floor
        (channels,) what is added to J where a correction is in proportion to it.
    """

    def __init__(self, lower: Array, upper: Array, floor: Array) -> None:
        self.lower, self.floor = np.asarray(lower, np.float64), np.asarray(floor, np.float64)
        self.longest = max(float((upper - lower).max()), 1e-30)
        self.edges = np.clip((upper - lower) / self.longest, 1e-6, 1)
        self._size = cells_along(self.edges, _LEVELS - 1)
        cells, channels = int(np.prod(self._size)), len(self.floor)
        self.count = np.zeros(cells)
        self._place = np.zeros((3, cells))
        # Of residuals J_walk - J, of J + floor, both by group, and of squared residuals.
        self.residual = np.zeros((GROUPS, channels, cells))
        self.scale = np.zeros((GROUPS, channels, cells))
        self.square = np.zeros((channels, cells))
        self._lattices: _Lattices | None = None

    def local(self, points: Array) -> Array:
        """World points (n, 3) in longest edges from the box's corner, inside of the box."""
        return np.clip((points - self.lower) / self.longest, 0, self.edges)

    def add(self, points: Array, weights: Array, predicted: Array, walked: Array, groups: NDArray[np.int64] | int) -> None:
        """Add walks: world points (n, 3), what each counts in the image (n,), J (n, channels) as predicted and as walked, groups (n,)."""
        self._lattices = None
        local = self.local(points)
        cell = np.ravel_multi_index(tuple(np.minimum((local * _FINE).astype(np.int64), self._size - 1).T), tuple(self._size))
        n = len(self.count)
        self.count += np.bincount(cell, minlength=n)
        for axis in range(3):
            self._place[axis] += np.bincount(cell, local[:, axis], n)
        place, every = groups * n + cell, (GROUPS, n)
        for c, floor in enumerate(self.floor):
            residual = weights * (walked[:, c] - predicted[:, c])
            self.residual[:, c] += np.bincount(place, residual, GROUPS * n).reshape(every)
            self.scale[:, c] += np.bincount(place, weights * (predicted[:, c] + floor), GROUPS * n).reshape(every)
            self.square[c] += np.bincount(cell, np.square(residual), n)

    def lattices(self) -> _Lattices:
        """Where walks began, as lattices look at it; the same for all corrections until walks are added."""
        if self._lattices is None:
            self._lattices = _Lattices(self.count, self._place, self._size, self.edges)
        return self._lattices

    def of_halves(self, halves: tuple[tuple[int, ...], tuple[int, ...]]) -> tuple[Array, Array, Array]:
        """What two halves of the groups have in the finest cells that hold walks.

        Residuals and scales (2, channels, m), and the variance (channels, m) of a cell's residual, which is that of as many walks of a
        wide neighbourhood.
        """
        lattices = self.lattices()
        filled = lattices.filled

        def of_each(values: Array) -> Array:
            return np.stack([np.sum([values[group][:, filled] for group in half], axis=0) for half in halves])

        share = sum(map(len, halves)) / GROUPS
        return of_each(self.residual), of_each(self.scale), lattices.pooled(self.square[:, filled] * share)


class _Lattice:
    """The nodes of one lattice around the cells that it looks at.

    Attributes
    ----------
    level, size, count
        of the lattice: its number, its cells along each axis, how many nodes it has.
    coarser
        how often these cells were halved.
    index, tent
        nodes (m, 8) around each of them, and their weights.
    """

    def __init__(self, level: int, size: NDArray[np.int64], coarser: int, places: Array) -> None:
        self.level, self.size, self.coarser = level, size, coarser
        self.index, self.tent, self.count = _tents(places, size, level)
        self._squared = np.square(self.tent)

    def gathered(self, values: Array) -> Array:
        """Sums (nodes,) of what cells hold (m,)."""
        return _at_nodes(values, self.index, self.tent, self.count)

    def variance(self, values: Array) -> Array:
        """Variances (nodes,) of these sums, of the cells' variances (m,)."""
        return _at_nodes(values, self.index, self._squared, self.count)

    def between(self, values: Array) -> Array:
        """Values (nodes, channels) interpolated at the cells' places, (m, channels)."""
        result: Array = np.einsum("mk,mkc->mc", self.tent, values[self.index])
        return result


class _Lattices:
    """The cells that hold walks, fine to coarse, and the lattices that they are enough for, coarse to fine."""

    def __init__(self, count: Array, place: Array, size: NDArray[np.int64], edges: Array) -> None:
        self.filled = np.flatnonzero(count)
        self._count, places = count[self.filled], place[:, self.filled]
        numbers = np.stack(np.unravel_index(self.filled, tuple(size)), axis=1)
        counts, total = [self._count], float(self._count.sum())
        centres = [(places / self._count).T]
        # How to add up cells to those of twice the edge: an order of theirs, and where each of the larger ones begins in it.
        self._steps: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []
        while len(counts) < _LEVELS:
            numbers = numbers // 2
            key = np.ravel_multi_index(tuple(numbers.T), tuple(numbers.max(axis=0) + 1))
            order = np.argsort(key, kind="stable")
            first = np.flatnonzero(np.diff(key[order], prepend=-1))
            self._steps.append((order, first))
            counts.append(np.add.reduceat(counts[-1][order], first))
            places = np.add.reduceat(places[:, order], first, axis=1)
            centres.append((places / counts[-1]).T)
            numbers = numbers[order[first]]
        self._pooling = _Lattice(_POOLED, cells_along(edges, _POOLED), 0, centres[0])
        self.levels: list[_Lattice] = []
        for level in range(-1, _LEVELS):
            coarser = max(_LEVELS - 1 - _WITHIN - level, 0)
            lattice = _Lattice(level, cells_along(edges, level), coarser, centres[coarser])
            if total < _SPARSE * np.count_nonzero(lattice.gathered(np.ones(len(counts[coarser])))):
                break
            self.levels.append(lattice)

    def pooled(self, square: Array) -> Array:
        """Variances (channels, m) of the finest cells' sums: of as many walks of a wide neighbourhood, by the squares of their own."""
        below = np.maximum(self._pooling.gathered(self._count), 1e-300)
        around = np.stack([self._pooling.gathered(of_channel) / below for of_channel in square], axis=1)
        return self._count * self._pooling.between(around).T

    def halved(self, values: Array, times: int) -> Array:
        """What cells (..., m) hold that were halved so often, of twice the edge."""
        order, first = self._steps[times]
        result: Array = np.add.reduceat(values[..., order], first, axis=-1)
        return result


class Correction:
    """The field d; see the module.

    Parameters
    ----------
    sums
        the walks.
    halves
        the groups of walks that make each of the two independent halves; the others are not looked at.

    Attributes
    ----------
    levels
        how many lattices it is made of, the single number counted.
    """

    def __init__(self, sums: Sums, halves: tuple[tuple[int, ...], tuple[int, ...]] = ((0, 1), (2, 3))) -> None:
        self._sums = sums
        channels = len(sums.floor)
        self._field, self._level, self.levels = np.zeros((1, 1, 1, channels)), -1, 0
        if not sums.count.any():
            return
        lattices = sums.lattices()
        sizes: list[tuple[Array, ...]] = [sums.of_halves(halves)]
        for times in range(lattices.levels[0].coarser if lattices.levels else 0):
            sizes.append(tuple(lattices.halved(values, times) for values in sizes[-1]))
        field = self._field
        for lattice in lattices.levels:
            residual, scale, variance = sizes[lattice.coarser]
            field = _refined(field, lattice.size, lattice.level)
            known = lattice.between(field.reshape(lattice.count, channels)).T
            values = np.zeros((lattice.count, channels))
            for c in range(channels):
                left = [lattice.gathered(r[c] - s[c] * known[c]) for r, s in zip(residual, scale, strict=True)]
                below = [lattice.gathered(s[c]) for s in scale]
                values[:, c] = _shrunken(left, below, lattice.variance(variance[c]), lattice.size)
            if not values.any():
                continue
            if lattice.level >= 0:
                # What the image is brighter or darker as a whole, the single number knows best: a finer level only moves light about.
                moved, total = lattice.between(values).T, scale.sum(axis=0)
                values -= (moved * total).sum(axis=1) / np.maximum(total.sum(axis=1), 1e-300)
            field = field + values.reshape(field.shape)
            self._field, self._level = field, lattice.level
            self.levels += 1

    def __call__(self, points: Array) -> Array:
        """The field d (n, channels) at world points (n, 3); beyond the walks it goes on as at the nearest place that they know."""
        index, tent, count = _tents(self._sums.local(points), cells_along(self._sums.edges, self._level), self._level)
        found: Array = np.einsum("nk,nkc->nc", tent, self._field.reshape(count, -1)[index])
        # J stays positive.
        return np.maximum(found, -1)


def _shrunken(left: list[Array], below: list[Array], variance: Array, size: Array) -> Array:
    """What two halves leave at the nodes of a lattice of `size` cells, over what is below it, shrunken by the part of it that is noise."""
    total = below[0] + below[1]
    nodes = np.flatnonzero(np.minimum(*below) > 1e-9 * float(total.max(initial=0.0)))
    result = np.zeros(len(total))
    if not len(nodes):
        return result
    first, second = (r[nodes] / s[nodes] for r, s in zip(left, below, strict=True))
    weight, sure = np.sqrt(below[0][nodes] * below[1][nodes]), total[nodes]
    product, noise = weight * first * second, variance[nodes] / np.square(sure)
    # The product of two halves varies by chance by about twice the noise of their mean.
    chance = np.square(2 * weight * noise)
    real = float((product.sum() - CHANCE * np.sqrt(chance.sum())) / weight.sum())
    if not real > 0:
        return result
    # A network errs more in some places than in others: there more is believed, as far as the neighbourhood knows its own variance.
    below_near, product_near, chance_near = _around(nodes, size, (weight, product, chance))
    known = real**2 / (real**2 + chance_near / np.square(below_near))
    here = np.maximum(real + known * (product_near / below_near - real), 0)
    result[nodes] = (left[0][nodes] + left[1][nodes]) / sure * (here / (here + noise + 1e-300))
    return result


def _around(nodes: Array, size: Array, values: Sequence[Array]) -> list[Array]:
    """Sums (m,) of values (m,) at some `nodes` of a lattice of `size` cells, over the nodes' neighbourhoods: 3 x 3 x 3 blocks of nodes."""
    block = tuple(place // _BLOCK for place in np.unravel_index(nodes, tuple(size + 1)))
    blocks = tuple(size // _BLOCK + 1)
    index = np.ravel_multi_index(block, blocks)
    grid = np.stack([np.bincount(index, value, int(np.prod(blocks))) for value in values]).reshape(len(values), *blocks)
    for axis in range(1, 4):
        after, before = ((slice(None),) * axis + (part,) for part in (slice(1, None), slice(None, -1)))
        total = grid.copy()
        total[after] += grid[before]
        total[before] += grid[after]
        grid = total
    return list(grid.reshape(len(values), -1)[:, index])


def cells_along(edges: Array, level: int) -> NDArray[np.int64]:
    """Cells of a lattice along each axis of a box whose `edges` are given over the longest; level -1 is a single number."""
    return np.zeros(3, np.int64) if level < 0 else np.maximum(np.ceil(edges * 2.0**level - 1e-9), 1).astype(np.int64)


def _refined(field: Array, size: Array, level: int) -> Array:
    """Values (x, y, z, channels) at the nodes of a lattice, as those of the lattice twice as coarse interpolate them."""
    if level < 0:
        return field
    if level == 0:
        return np.broadcast_to(field, (*(size + 1), field.shape[3])).copy()
    for axis in range(3):
        values = np.moveaxis(field, axis, 0)
        fine = np.empty((2 * len(values) - 1, *values.shape[1:]))
        fine[::2] = values
        fine[1::2] = 0.5 * (values[1:] + values[:-1])
        field = np.moveaxis(fine[: size[axis] + 1], 0, axis)
    return field


def _at_nodes(values: Array, index: Array, weights: Array, count: int) -> Array:
    result: Array = np.bincount(index.ravel(), (weights * values[:, None]).ravel(), count)
    return result


def _tents(local: Array, size: Array, level: int) -> tuple[Array, Array, int]:
    """Nodes (n, 8) of a lattice around places (n, 3) in longest edges, their weights, and how many nodes there are."""
    if level < 0:
        return np.zeros((len(local), 1), np.int64), np.ones((len(local), 1)), 1
    scaled = local * 2.0**level
    corner = np.minimum(scaled.astype(np.int64), size - 1)
    fraction = np.minimum(scaled - corner, 1)
    stride = np.array([(size[1] + 1) * (size[2] + 1), size[2] + 1, 1])
    base = corner @ stride
    index, weights = np.empty((len(local), 8), np.int64), np.empty((len(local), 8))
    for k, steps in enumerate(itertools.product((0, 1), repeat=3)):
        index[:, k] = base + int(np.dot(steps, stride))
        x, y, z = (fraction[:, a] if step else 1 - fraction[:, a] for a, step in enumerate(steps))
        weights[:, k] = x * y * z
    return index, weights, int(np.prod(size + 1))
