"""Write a large, mostly empty .vdb: cumuli of noise scattered over a box, made block by block.

    python -m benchmarks.large_cloud OUT.vdb [--size 2000,1400,2500] [--filled 0.02] [--seed 0]

Z is up. No array of the whole box is ever made: a cloud is evaluated in blocks of 64^3 voxels, and only bricks of 8^3 that hold something
are kept. The default takes two minutes and 3 GB.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deepclouds.volume import Bricks, SparseVolume, write_vdb
from deepclouds.volume.bricks import BRICK_VOXELS, EDGE, into_bricks

Array = NDArray[np.float32]
_BLOCK = 64
# Period of the noise, in its own cells, and its octaves with the share of each.
_PERIOD, _OCTAVES = 32, ((1.0, 0.55), (2.3, 0.3), (5.1, 0.15), (11.7, 0.08))
# What is noise of a cloud's surface, over its radius; voxels below this density are cut off, as simulations do.
_ROUGH, _LEAST = 0.9, 0.02


def _noise(texture: Array, axes: list[NDArray[np.float64]]) -> Array:
    """Sum of octaves of trilinear value noise about 0 on the grid of three axes, in cells of the first octave."""
    total = np.zeros([len(a) for a in axes], np.float32)
    for frequency, share in _OCTAVES:
        values = texture
        # Contract one axis after the other: each moves to the end when done.
        for axis in axes:
            at = axis * frequency
            low = np.floor(at).astype(np.int64)
            span = np.arange(low[0], low[-1] + 2)
            weight = np.zeros((len(span), len(at)), np.float32)
            fraction = at - low
            weight[low - low[0], np.arange(len(at))] = 1 - fraction
            weight[low - low[0] + 1, np.arange(len(at))] = fraction
            values = np.tensordot(values.take(span % _PERIOD, axis=0), weight, axes=(0, 0))
        total += np.float32(share) * values
    return total


def scattered_cumuli(size: tuple[int, int, int], filled: float, seed: int) -> Bricks:
    """Cumuli with flat bases at random places of a box of `size` (x, y, z) voxels until the share `filled` of it holds something."""
    rng = np.random.default_rng(seed)
    texture = rng.uniform(-1, 1, (_PERIOD,) * 3).astype(np.float32)
    kept: dict[tuple[int, int, int], Array] = {}
    goal, voxels, largest = filled * np.prod(size, dtype=np.float64), 0, 0.09 * min(size)
    while voxels < goal:
        radius = largest * rng.uniform(0.3, 1.0)
        centre = np.array([rng.uniform(radius, n - radius) for n in size])
        half = radius * np.array([1.0, 1.0, 1.3])
        low = np.maximum((centre - 1.3 * half) // EDGE * EDGE, 0).astype(int)
        high = np.minimum(centre + 1.3 * half, size).astype(int)
        low[2] = max(low[2], int(centre[2] - 0.35 * half[2]) // EDGE * EDGE)
        for begin in np.ndindex(*(-(-(h - b) // _BLOCK) for b, h in zip(low, high, strict=True))):
            first = low + np.array(begin) * _BLOCK
            axes = [np.arange(f, f + _BLOCK, dtype=np.float64) for f in first]
            x, y, z = ((axis - c) / h for axis, c, h in zip(axes, centre, half, strict=True))
            distance = np.sqrt(z[:, None, None] ** 2 + y[:, None] ** 2 + x**2).astype(np.float32)
            if distance.min() > 1 + _ROUGH:
                continue
            noise = _noise(texture, [axis / (0.35 * radius) for axis in axes[::-1]])
            density = np.clip(1.6 * (1 - distance + _ROUGH * noise), 0, 1)
            density[axes[2] < centre[2] - 0.35 * half[2]] = 0
            inside = np.ix_(*(axis < n for axis, n in zip(axes[::-1], size[::-1], strict=True)))
            mask = np.zeros(density.shape, bool)
            mask[inside] = True
            density[~mask | (density < _LEAST)] = 0
            split = into_bricks(density)
            for place in np.argwhere(split.any(axis=(3, 4, 5))):
                k, j, i = (int(n) for n in place + first[::-1] // EDGE)
                new = split[tuple(place)].astype(np.float32)
                if (k, j, i) in kept:
                    voxels -= int(np.count_nonzero(kept[k, j, i]))
                    new = np.maximum(new, kept[k, j, i])
                kept[k, j, i] = new
                voxels += int(np.count_nonzero(new))
    # Two specks at opposite corners make the box of what is active the whole one.
    for corner in (np.zeros(3, int), np.array(size[::-1]) - 1):
        k, j, i = (int(n) for n in corner // EDGE)
        kept.setdefault((k, j, i), np.zeros((EDGE,) * 3, np.float32))[tuple(corner % EDGE)] = _LEAST
    values = np.empty((len(kept), EDGE, EDGE, EDGE), np.float32)
    places = np.array(list(kept), np.int32)
    for number in range(len(places)):
        # Taken out as it is copied, or all would be held twice.
        values[number] = kept.pop(next(iter(kept)))
    return Bricks((size[2], size[1], size[0]), places, values)


def main() -> None:
    """Write the file and say what it holds."""
    parser = argparse.ArgumentParser(description="Write a .vdb of cumuli scattered over a large box.")
    parser.add_argument("out", type=Path)
    parser.add_argument("--size", default="2000,1400,2500", help="voxels along x, y and z")
    parser.add_argument("--filled", type=float, default=0.02, help="share of the voxels that hold something")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    nx, ny, nz = (int(n) for n in arguments.size.split(","))
    bricks = scattered_cumuli((nx, ny, nz), arguments.filled, arguments.seed)
    # The longest edge is one unit of the world.
    write_vdb(arguments.out, SparseVolume(bricks, np.diag([nx, ny, nz, max(nx, ny, nz)]) / max(nx, ny, nz)), half=True)
    active = int(np.count_nonzero(bricks.values))
    print(
        f"{arguments.out}: {nx} x {ny} x {nz}, {active} voxels ({100 * active / (nx * ny * nz):.2f} %) in {len(bricks.places)} bricks, "
        f"{100 * active / (len(bricks.places) * BRICK_VOXELS):.0f} % of theirs"
    )


if __name__ == "__main__":
    main()
