"""What a network made of coarse levels at the corners of cells, for the points in them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from deepclouds_runtime.octree import CORNERS, Array, Lattice, keys_of, trilinear
from deepclouds_runtime.scattering import Coarse

# Points so close to a corner, in edges of a cell, are that corner.
_SAME = 1e-6
# Most bytes that are kept.
_MOST_BYTES = 1 << 28


class Corners:
    """Corners of a lattice of which several views and lights know something, pair by pair.

    Parameters
    ----------
    lattice
        the cells.
    pairs
        how many views and lights there are.
    """

    def __init__(self, lattice: Lattice, pairs: int) -> None:
        self._lattice, self._pairs = lattice, pairs
        self._keys = np.empty(0, np.int64)
        self._known: list[Coarse] = []

    def among(self, points: Array) -> NDArray[np.bool_]:
        """Which world points (n, 3) are corners, unless some corners are known already: those that come first are all there are."""
        if self._known:
            return np.zeros(len(points), bool)
        local = self._lattice.local(points)
        result: NDArray[np.bool_] = np.all(np.abs(local - np.round(local)) < _SAME, axis=1)
        return result

    def keep(self, points: Array, known: Sequence[Coarse]) -> None:
        """Keep what the network made at corners (n, 3), for each pair; nothing where that is too much."""
        if self._pairs * (known[0].latent.nbytes + known[0].means.nbytes) > _MOST_BYTES:
            return
        keys = keys_of(np.round(self._lattice.local(points)).astype(np.int64))
        order = np.argsort(keys)
        self._keys = keys[order]
        self._known = [of_pair.take(order) for of_pair in known]

    def around(self, points: Array) -> tuple[NDArray[np.bool_], NDArray[np.int64], Array]:
        """Which world points (n, 3) lie in cells whose corners are known; the corners (n, 8) and their weights."""
        n, size = len(points), self._lattice.size
        if not self._known:
            return np.zeros(n, bool), np.zeros((n, 8), np.int64), np.zeros((n, 8))
        local = np.clip(self._lattice.local(points), 0, size)
        cell = np.minimum(local.astype(np.int64), size - 1)
        weights = trilinear(local - cell)
        keys = keys_of(cell[:, None] + CORNERS)
        place = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
        # On a face of a cell the corners that do not lie on it count for nothing.
        known = np.all((self._keys[place] == keys) | (weights < _SAME), axis=1)
        return known, place, weights

    def between(self, pair: int, corners: NDArray[np.int64], weights: Array) -> Coarse:
        """What the network would make of the coarse levels at points, interpolated; corners and weights (n, 8) as of `around`."""
        known, share = self._known[pair], weights.astype(np.float32)

        def mixed(values: NDArray[np.float32]) -> NDArray[np.float32]:
            each = share.reshape(*share.shape, *(1,) * (values.ndim - 1))
            total: NDArray[np.float32] = each[:, 0] * values[corners[:, 0]]
            for c in range(1, 8):
                total += each[:, c] * values[corners[:, c]]
            return total

        return Coarse(mixed(known.latent), mixed(known.means), mixed(known.depth))
