"""A scalar field known at a few points: an octree refined where linear interpolation would be seen to err.

Roots are cubes of one size on a lattice along the axes of the volume. A cell holds the values at its corners and is interpolated
trilinearly; a cell that is split asks for the corners of its eight children. Where a finer cell meets a coarser one the two
interpolations differ by about the error that was allowed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepclouds.backend import lanes_of

Array = NDArray[Any]
# Corners of the unit cube, x fastest.
CORNERS = np.array([(i & 1, (i >> 1) & 1, (i >> 2) & 1) for i in range(8)], np.int64)
# A lattice coordinate keeps 21 bits, three of them make a key of 63.
_BITS = 21
_MOST_CELLS_A_SIDE = 64
# Halving the spacing divides the error of linear interpolation of a smooth function by four; where a kink is nearer than the spacing,
# by two. What a finer level corrected is divided by this to estimate what is still wrong.
_GAIN = 3.0
# Error that is taken for that of root cells, of which nothing is known, over the mean value.
_UNMEASURED = 0.15
# Trials by which the errors of cells that count about as much are judged together.
_TRIALS_A_GROUP = 32
# Times that values at the nodes are drawn to what is wanted between them.
_SWEEPS = 4
# New corners of a cell that is split: neighbours share most of the 19 that all of its children have.
_NODES_A_SPLIT = 7


@dataclass(frozen=True)
class Lattice:
    """Cubes of one size along three axes.

    Attributes
    ----------
    origin
        (3,) world point of the lattice's corner (0, 0, 0).
    axes
        (3, 3), columns are unit vectors.
    spacing
        edge of a root cell, world units.
    size
        (3,) number of root cells along each axis.
    """

    origin: Array
    axes: Array
    spacing: float
    size: Array

    def local(self, points: Array) -> Array:
        """Coordinates of world points (n, 3) in root cells."""
        return (points - self.origin) @ self.axes / self.spacing

    def number(self, local: Array) -> Array:
        """Number of the root cell (n,) of each place (n, 3) in root cells."""
        result: Array = local.astype(np.int64) @ (1, int(self.size[0]), int(self.size[0] * self.size[1]))
        return result

    def world(self, local: Array) -> Array:
        """World points of coordinates (n, 3) in root cells."""
        return local * self.spacing @ self.axes.T + self.origin


@dataclass
class Statistics:
    """What building an octree took.

    Attributes
    ----------
    nodes
        points that were asked for.
    cells
        cells that were refined, level by level.
    error
        estimated error of the interpolation, root of the mean square over the image's samples, over their mean value.
    """

    nodes: int = 0
    cells: list[int] = field(default_factory=list)
    error: float = 0.0


def lattice_around(lengths: Array, corner: Array, axes: Array, spacing: float, anchor: Array | None = None) -> Lattice:
    """Lattice that covers a box with edges `lengths` along `axes` from `corner`, of cells of about `spacing`.

    There are at least two cells along the longest edge, and at most `_MOST_CELLS_A_SIDE`. With an `anchor`, a world point, cells have their
    corners at whole multiples of their edge from it, and the edge is `spacing` times a power of two: boxes that change a little from frame
    to frame then have their nodes in the same places.
    """
    longest = float(lengths.max())
    if anchor is not None:
        most = longest / (_MOST_CELLS_A_SIDE - 1)
        spacing *= 2.0 ** max(math.ceil(math.log2(most / spacing)), min(math.floor(math.log2(longest / 2 / spacing)), 0))
        local = axes.T @ (corner - anchor) / spacing
        first = np.floor(local + 1e-6)
        size = np.maximum(np.ceil(local + lengths / spacing - 1e-6) - first, 1).astype(np.int64)
        return Lattice(anchor + axes @ (first * spacing), axes, spacing, size)
    spacing = float(np.clip(spacing, longest / _MOST_CELLS_A_SIDE, longest / 2))
    size = np.maximum(np.ceil(lengths / spacing - 1e-6), 1).astype(np.int64)
    # The box stands in the middle of its cells.
    return Lattice(corner - axes @ (0.5 * (size * spacing - lengths)), axes, spacing, size)


def lattice_of(lengths: Array, corner: Array, axes: Array, spacing: float, anchor: Array | None, points: Array, most: int) -> Lattice:
    """`lattice_around`, of cells as much larger as it takes for `most` corners around points (n, 3), or of the largest there are."""
    lattice = lattice_around(lengths, corner, axes, spacing, anchor)
    while (corners := root_nodes(lattice, points, most)) > most:
        wider = lattice.spacing * (max((corners / most) ** (1 / 3), 1.1) if anchor is None else 2.0)
        larger = lattice_around(lengths, corner, axes, wider, anchor)
        if larger.spacing <= lattice.spacing * (1 + 1e-6):
            break
        lattice = larger
    return lattice


def root_nodes(lattice: Lattice, points: Array, enough: int) -> int:
    """Corners of the root cells that hold world points (n, 3); a bound on their number where that is at most `enough`."""
    bound = int(np.prod(lattice.size + 1))
    if bound <= enough:
        return bound
    cells = np.zeros(tuple(lattice.size), bool)
    cells[tuple(np.clip(lattice.local(points), 0, lattice.size - 1e-6).astype(np.int64).T)] = True
    corners = np.zeros(tuple(lattice.size + 1), bool)
    for x, y, z in CORNERS:
        corners[x : x + cells.shape[0], y : y + cells.shape[1], z : z + cells.shape[2]] |= cells
    return int(corners.sum())


class Octree:
    """Values at the corners of adaptive cells; see the module.

    Parameters
    ----------
    lattice
        the root cells.
    evaluate
        true values (n, k), float32, at world points (n, 3).
    points, weights
        world points (n, 3) where the field will be asked for, and how much each counts.
    tolerance
        error of the interpolation to aim at, over the mean value (root of the mean square over the points).
    budget
        no more points are asked for once there are so many.
    levels
        most levels of refinement.
    carried
        so many of the fields, the last ones, are known at the nodes that the others ask for: they refine nothing.
    affordable
        is asked before each level how many more points may be asked for, for another reason than the budget.
    place
        corners of cells, world points (n, 3), and for each one of `points` (n, 3) that lies near -> where the corner's value is asked for.
    tried
        world points (n, 3), drawn from `points` by weight, and the true values there (n, k): what a cell errs at those that it holds
        counts for its error. Corners alone tell nothing where all of a cell's lie outside of the cloud.

    Attributes
    ----------
    statistics
        what it took.
    """

    def __init__(
        self,
        lattice: Lattice,
        evaluate: Callable[[Array], Array],
        points: Array,
        weights: Array,
        tolerance: float,
        budget: int,
        levels: int,
        carried: int = 0,
        affordable: Callable[[], int] | None = None,
        place: Callable[[Array, Array], Array] | None = None,
        tried: tuple[Array, Array] | None = None,
    ) -> None:
        self.lattice = lattice
        self._place = place
        self.statistics = Statistics()
        self._evaluate = evaluate
        self._levels = min(levels, _BITS - 1 - int(lattice.size.max()).bit_length())
        self._keys = np.empty(0, np.int64)
        self._known: Array = np.empty((0, 0), np.float32)
        nx, ny, nz = (int(n) for n in lattice.size)
        local = np.clip(lattice.local(points), 0, lattice.size - 1e-6)
        cells, some, member = np.unique(lattice.number(local), return_index=True, return_inverse=True)
        # One of the points for each cell, that of its parent where it holds none.
        near = points[some]
        coordinates = np.stack([cells % nx, cells // nx % ny, cells // (nx * ny)], axis=1)
        values = self._corner_values(coordinates, 0, near)
        # Fields that decide what is refined.
        self.fields = values.shape[2] - carried
        leaves = [self._roots(coordinates, values)]
        leaves[0][cells] = values
        # Where each leaf lies, in root cells: its corner and its edge.
        z, y, x = np.unravel_index(np.arange(nx * ny * nz), (nz, ny, nx))
        corners, edges = [np.stack([x, y, z], axis=1).astype(np.float32)], [np.ones(nx * ny * nz, np.float32)]
        # An entry of the table is the number of a leaf, or less than 0: where the eight entries of the children begin.
        table, slots, count = np.arange(nx * ny * nz), cells, nx * ny * nz
        scale = self._scale(local, member, weights, values, coordinates, 0)
        trials = None if tried is None else _Trials(lattice, *tried, self.fields, cells)
        known_error = np.full(len(cells), _UNMEASURED * scale)
        settled = 0.0
        total = float(weights.sum())
        for level in range(self._levels + 1):
            share = np.bincount(member, weights, minlength=len(coordinates))
            if trials is not None:
                known_error = trials.error(known_error, share, values, coordinates, level)
            squared = share * known_error**2
            allowed = (tolerance * scale) ** 2 * total
            # Half of what is left of the error for this level, the rest for the finer ones.
            split = _worst(squared, 0.5 * max(allowed - settled, 0.0))
            left = 0 if level == self._levels else budget - len(self._keys)
            splits = (left if affordable is None else min(left, affordable())) // _NODES_A_SPLIT
            if splits < split.sum():
                split[np.argsort(squared)[: len(split) - max(splits, 0)]] = False
            settled += float(squared[~split].sum())
            if not split.any():
                break
            self.statistics.cells.append(int(split.sum()))
            # The points of the split cells move on to the children. All eight are asked for: few more nodes than those that hold points,
            # and the image meets places that no point has tried.
            parents, before, blocks = coordinates[split], values[split], int(split.sum())
            chosen, member = _children(local, member, split, parents, level)
            local, weights, points = local[chosen], weights[chosen], points[chosen]
            if trials is not None:
                trials.descend(split, parents, level)
            coordinates = (2 * parents[:, None] + CORNERS).reshape(-1, 3)
            near = np.repeat(near[split], 8, axis=0)
            near[member] = points
            continued = np.einsum("oci,pik->pock", _CHILD_WEIGHTS, before[..., : self.fields]).reshape(8 * blocks, 8, self.fields)
            values = self._corner_values(coordinates, level + 1, near)
            known_error = np.sqrt(np.square(values[..., : self.fields] - continued).max(axis=2).mean(axis=1) * (8 / 7)) / _GAIN
            # Every split cell gets a block of eight leaves, and of eight entries of the table that its own now points at.
            table[slots[split]] = -len(table) - 8 * np.arange(blocks)
            slots = len(table) + np.arange(8 * blocks)
            table = np.concatenate([table, count + np.arange(8 * blocks)])
            leaves.append(values)
            edge = 0.5 ** (level + 1)
            corners.append((coordinates * edge).astype(np.float32))
            edges.append(np.full(8 * blocks, edge, np.float32))
            count += 8 * blocks
        self.statistics.nodes = len(self._keys)
        self.statistics.error = float(np.sqrt(settled / max(total, 1e-30)) / max(scale, 1e-30))
        self._table = table.astype(np.int32)
        self._leaves = np.concatenate(leaves).astype(np.float32)
        self._corners, self._edges = np.concatenate(corners), np.concatenate(edges)

    def _scale(self, local: Array, member: Array, weights: Array, values: Array, coordinates: Array, level: int) -> float:
        """Mean value over the points, of the largest field."""
        fraction = local * 2.0**level - coordinates[member]
        mean = (
            np.einsum("pc,pck->pk", trilinear(fraction), values[member][..., : self.fields]).T @ weights / max(float(weights.sum()), 1e-30)
        )
        return float(mean.max(initial=0.0))

    def _corner_values(self, coordinates: Array, level: int, near: Array) -> Array:
        """Values (m, 8, k) at the corners of cells (m, 3) of a level, with a point (m, 3) in or near each; unknown ones are asked for."""
        corners = (coordinates[:, None] + CORNERS) << (self._levels - level)
        keys = keys_of(corners)
        unique: Array
        unique, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
        place = np.searchsorted(self._keys, unique)
        found = np.zeros(len(unique), bool)
        inside = place < len(self._keys)
        found[inside] = self._keys[place[inside]] == unique[inside]
        new = unique[~found]
        mask = (1 << _BITS) - 1
        fine = np.stack([new & mask, new >> _BITS & mask, new >> 2 * _BITS], axis=1)
        world = self.lattice.world(fine / 2.0**self._levels)
        values = self._evaluate(world if self._place is None else self._place(world, near[first[~found] // 8]))
        if self._known.shape[1] == 0:
            self._known = np.empty((0, values.shape[1]), np.float32)
        self._keys = np.concatenate([self._keys, new])
        order = np.argsort(self._keys, kind="stable")
        self._keys, self._known = self._keys[order], np.concatenate([self._known, values])[order]
        result: Array = self._known[np.searchsorted(self._keys, unique)][inverse.reshape(keys.shape)]
        return result

    def _roots(self, coordinates: Array, values: Array) -> Array:
        """Corner values of all root cells (m, 8, k); corners that nobody asked for take the mean of their neighbours."""
        nx, ny, nz = (int(n) + 1 for n in self.lattice.size)
        grid = np.zeros((nz, ny, nx, values.shape[2]), np.float32)
        filled = np.zeros((nz, ny, nx), bool)
        corners = (coordinates[:, None] + CORNERS).reshape(-1, 3)
        grid[corners[:, 2], corners[:, 1], corners[:, 0]] = values.reshape(len(corners), -1)
        filled[corners[:, 2], corners[:, 1], corners[:, 0]] = True
        while filled.any() and not filled.all():
            total, count = np.zeros_like(grid), np.zeros(filled.shape, np.float32)
            for axis in range(3):
                for here, there in ((slice(1, None), slice(None, -1)), (slice(None, -1), slice(1, None))):
                    to = tuple(here if a == axis else slice(None) for a in range(3))
                    come = tuple(there if a == axis else slice(None) for a in range(3))
                    total[to] += grid[come] * filled[come][..., None]
                    count[to] += filled[come]
            fill = ~filled & (count > 0)
            grid[fill] = total[fill] / count[fill][:, None]
            filled |= fill
        z, y, x = (a.ravel() for a in np.meshgrid(np.arange(nz - 1), np.arange(ny - 1), np.arange(nx - 1), indexing="ij"))
        all_corners = np.stack([x, y, z], axis=1)[:, None] + CORNERS
        result: Array = grid[all_corners[..., 2], all_corners[..., 1], all_corners[..., 0]]
        return result

    def upload(self, types: Any, carried: bool = False) -> DeviceOctree:
        """The same on the device, for lookups in kernels: the fields that were asked for, or those that were `carried` along."""
        leaves = self._leaves[..., self.fields :] if carried else self._leaves[..., : self.fields]
        return DeviceOctree(types, self.lattice, self._table, leaves)

    def changed(self, types: Any, change: Callable[[Array, Array], Array], points: Array, weights: Array) -> DeviceOctree:
        """The same on the device with other values, none below 0.

        A change may vary more quickly than the nodes are close: taken at the nodes alone it would be another one between them. So what is
        interpolated is fitted to the change at `points`, which the nodes have around them; nodes without any take the change itself.

        Parameters
        ----------
        types
            Dr.Jit types.
        change
            world points (n, 3) and the values (n, fields) there -> other values.
        points, weights
            world points (n, 3) where the values are asked for, and how much each counts.
        """
        leaves = self._leaves[..., : self.fields]
        local = (self._corners[:, None] + self._edges[:, None, None] * CORNERS).reshape(-1, 3)
        keys = keys_of(np.rint(local * 2.0**self._levels).astype(np.int64))
        _, first, node = np.unique(keys, return_index=True, return_inverse=True)
        node = node.reshape(leaves.shape[:2])
        values = change(self.lattice.world(local[first]), leaves.reshape(-1, self.fields)[first])
        leaf, tent = self._located(points)
        wanted = change(points, np.einsum("nc,nck->nk", tent, leaves[leaf]))
        around, share = node[leaf], tent * weights[:, None]
        below = np.bincount(around.ravel(), share.ravel(), len(first))
        near = below > 0
        for _ in range(_SWEEPS):
            left = wanted - np.einsum("nc,nck->nk", tent, values[around])
            for k in range(self.fields):
                step = np.bincount(around.ravel(), (share * left[:, k : k + 1]).ravel(), len(first))
                values[near, k] += step[near] / below[near]
            np.maximum(values, 0, out=values)
        return DeviceOctree(types, self.lattice, self._table, values.astype(np.float32)[node])

    def _located(self, points: Array) -> tuple[Array, Array]:
        """The leaf (n,) that holds each world point (n, 3), and the weights (n, 8) of its corners."""
        size = self.lattice.size
        local = self.lattice.local(points)
        root = np.clip(np.floor(local), 0, size - 1)
        place = np.clip(local - root, 0, 1)
        leaf: Array = self._table[self.lattice.number(root)].astype(np.int64)
        while len(inner := np.flatnonzero(leaf < 0)):
            octant = (place[inner] >= 0.5).astype(np.int64)
            place[inner] = 2 * place[inner] - octant
            leaf[inner] = self._table[octant @ (1, 2, 4) - leaf[inner]]
        return leaf, trilinear(place)


class _Trials:
    """Points at which the true values are known, on their way down an octree that is being built.

    Parameters
    ----------
    lattice
        the root cells.
    points, values
        world points (n, 3), and the true values there (n, k).
    fields
        how many of the values, the first ones, are compared.
    cells
        numbers of the root cells that hold anything, ascending.
    """

    def __init__(self, lattice: Lattice, points: Array, values: Array, fields: int, cells: Array) -> None:
        local = np.clip(lattice.local(points), 0, lattice.size - 1e-6)
        index = lattice.number(local)
        member = np.minimum(np.searchsorted(cells, index), len(cells) - 1)
        inside = cells[member] == index
        self._local, self._member, self._true = local[inside], member[inside], values[inside, :fields]

    def error(self, known: Array, share: Array, values: Array, coordinates: Array, level: int) -> Array:
        """Errors (m,) of cells of a level, where so much is `known` (m,) without trials.

        Parameters
        ----------
        known, share
            errors of the cells (m,), and what their points count together (m,).
        values, coordinates
            corner values (m, 8, k), and places (m, 3).
        level
            of refinement.
        """
        if not len(self._member):
            return known
        squared = known**2
        weights = trilinear(self._local * 2.0**level - coordinates[self._member])
        found = np.einsum("nc,nck->nk", weights, values[self._member][..., : self._true.shape[1]]) - self._true
        found = np.square(found).max(axis=1)
        # What is said of cells is too little where those that count about as much err by more: many small cells have no trial of their own.
        order = np.argsort(share[self._member], kind="stable")
        groups = np.array_split(order, max(len(order) // _TRIALS_A_GROUP, 1))
        low = np.array([share[self._member[group[0]]] for group in groups])
        excess = np.array([max(found[group].sum() / max(squared[self._member[group]].sum(), 1e-30), 1.0) for group in groups])
        squared = squared * excess[np.maximum(np.searchsorted(low, share, side="right") - 1, 0)]
        count = np.bincount(self._member, minlength=len(known))
        result: Array = np.sqrt((squared + np.bincount(self._member, found, len(known))) / (1 + count))
        return result

    def descend(self, split: Array, parents: Array, level: int) -> None:
        """Move on to the children of the cells that are `split`, `parents` (n, 3) of a level; what lies in others is left behind."""
        chosen, self._member = _children(self._local, self._member, split, parents, level)
        self._local, self._true = self._local[chosen], self._true[chosen]


class DeviceOctree:
    """Lookups of an `Octree` in Dr.Jit kernels."""

    def __init__(self, types: Any, lattice: Lattice, table: Array, leaves: Array) -> None:
        self.types, self.fields = types, leaves.shape[2]
        self._table = lanes_of(types.Int32, table)
        self._leaves = [lanes_of(types.Float, leaves[:, :, k].ravel()) for k in range(self.fields)]
        turn = lattice.axes.T / lattice.spacing
        self._turn = [[dr.opaque(types.Float, float(v)) for v in row] for row in turn]
        self._shift = [dr.opaque(types.Float, float(v)) for v in -turn @ lattice.origin]
        self._most = [dr.opaque(types.Float, float(n) - 1) for n in lattice.size]
        nx, ny, _ = (int(n) for n in lattice.size)
        self._row, self._plane = dr.opaque(types.Int32, nx), dr.opaque(types.Int32, nx * ny)

    def to_local(self, points: Any) -> Any:
        """World points to coordinates in root cells."""
        rows = zip(self._turn, self._shift, strict=True)
        return type(points)(*(dr.fma(points.x, r[0], dr.fma(points.y, r[1], dr.fma(points.z, r[2], s))) for r, s in rows))

    def direction_to_local(self, directions: Any) -> Any:
        """World vectors to root cells."""
        return type(directions)(*(directions.x * r[0] + directions.y * r[1] + directions.z * r[2] for r in self._turn))

    def lookup(self, local: Any, active: Any) -> list[Any]:
        """Interpolated values, one Float a field, at coordinates in root cells; 0 for inactive lanes."""
        types = self.types
        root = [dr.clip(dr.floor(v), 0, most) for v, most in zip(local, self._most, strict=True)]
        x, y, z = (dr.clip(v - r, 0, 1) for v, r in zip(local, root, strict=True))
        place = types.Int32(root[0]) + types.Int32(root[1]) * self._row + types.Int32(root[2]) * self._plane
        leaf, x, y, z = self._descend(dr.gather(types.Int32, self._table, place, active), x, y, z, active)
        values = []
        for leaves in self._leaves:
            c = dr.gather(types.ArrayXf, leaves, leaf, active, shape=(8, dr.width(leaf)))
            bottom = dr.lerp(dr.lerp(c[0], c[1], x), dr.lerp(c[2], c[3], x), y)
            top = dr.lerp(dr.lerp(c[4], c[5], x), dr.lerp(c[6], c[7], x), y)
            values.append(dr.lerp(bottom, top, z))
        return values

    @dr.syntax
    def _descend(self, entry: Any, x: Any, y: Any, z: Any, active: Any) -> tuple[Any, Any, Any, Any]:
        """From a root cell's entry to the leaf below it that holds the place (x, y, z) of the unit cube, and the place in the leaf."""
        types = self.types
        while entry < 0:
            right, up, far = x >= 0.5, y >= 0.5, z >= 0.5
            octant = dr.select(right, types.Int32(1), 0) + dr.select(up, types.Int32(2), 0) + dr.select(far, types.Int32(4), 0)
            x, y, z = 2 * x - dr.select(right, 1.0, 0.0), 2 * y - dr.select(up, 1.0, 0.0), 2 * z - dr.select(far, 1.0, 0.0)
            entry = dr.gather(types.Int32, self._table, octant - entry, active)
        return entry, x, y, z


def _worst(squared: Array, allowed: float) -> Array:
    """Which cells to split so that the errors of the others sum to no more than `allowed`."""
    order = np.argsort(squared)
    split = np.zeros(len(squared), bool)
    split[order[np.cumsum(squared[order]) > allowed]] = True
    return split


def _children(local: Array, member: Array, split: Array, parents: Array, level: int) -> tuple[Array, Array]:
    """Which places (n, 3) lie in cells that are `split`, and the numbers of the children that hold these.

    `member` (n,) are the numbers of their cells of a level, `parents` (m, 3) the places of those that are split, whose children follow in
    blocks of eight.
    """
    chosen = split[member]
    parent = (np.cumsum(split) - 1)[member[chosen]]
    child = (local[chosen] * 2.0 ** (level + 1)).astype(np.int64) - 2 * parents[parent]
    return chosen, 8 * parent + child @ (1, 2, 4)


def keys_of(coordinates: NDArray[np.int64]) -> NDArray[np.int64]:
    """One number for each place of a lattice, of its coordinates (..., 3)."""
    keys: NDArray[np.int64] = coordinates[..., 0] | coordinates[..., 1] << _BITS | coordinates[..., 2] << 2 * _BITS
    return keys


def trilinear(fraction: Array) -> Array:
    """Weights (n, 8) of the corners at places (n, 3) in the unit cube."""
    weights: Array = np.where(CORNERS == 1, fraction[:, None], 1 - fraction[:, None]).prod(axis=2)
    return weights


# Corner c of child o of a cell, as a mixture of the cell's own corners: (octant, corner, parent's corner).
_CHILD_WEIGHTS = np.stack([trilinear(0.5 * (CORNERS[o] + CORNERS)) for o in range(8)]).astype(np.float32)
