"""Cauliflower bodies: balls that bud smaller balls, and the distance to their union."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from deepclouds_training.clouds._noise import Array
from deepclouds_training.clouds._raster import Grid

Balls = NDArray[np.float64]


def bud(
    rng: np.random.Generator, balls: Balls, generations: int, children: int, ratio: float, upward: float = 0.4, floor: float = -np.inf
) -> Balls:
    """Let every ball (x, y, z, radius) bud `children` smaller ones on its surface, for several generations; returns all of them.

    Parameters
    ----------
    ratio
        a child's radius over its parent's, before a jitter of 25 %.
    upward
        how much buds prefer the upper side: added to the vertical part of the unit direction.
    floor
        height below which no bud's centre may lie.
    """
    every, parents = [balls], balls
    for _ in range(generations):
        direction = rng.standard_normal((len(parents), children, 3))
        direction /= np.linalg.norm(direction, axis=2, keepdims=True)
        direction[:, :, 1] += upward
        direction /= np.linalg.norm(direction, axis=2, keepdims=True)
        radius = parents[:, None, 3] * ratio * rng.uniform(0.75, 1.25, (len(parents), children))
        centre = parents[:, None, :3] + direction * (parents[:, None, None, 3] * 0.92)
        buds = np.concatenate([centre, radius[:, :, None]], axis=2).reshape(-1, 4)
        parents = buds[buds[:, 1] > floor]
        every.append(parents)
    return np.concatenate(every)


def distance(grid: Grid, balls: Balls, band: float) -> Array:
    """Signed distance (nz, ny, nx) to the union of balls, negative inside, clipped to `band` outside.

    Inside it is the depth below the surface of the ball that reaches deepest, which is all a density profile needs.
    """
    out = np.full(grid.shape, band, np.float32)
    axes = (grid.x, grid.y, grid.z)
    for x, y, z, radius in balls:
        reach = radius + band
        spans = [slice(*np.searchsorted(a, (c - reach, c + reach))) for a, c in zip(axes, (x, y, z), strict=True)]
        if any(s.start == s.stop for s in spans):
            continue
        dx, dy, dz = (((a[s] - np.float32(c)) ** 2) for a, s, c in zip(axes, spans, (x, y, z), strict=True))
        d = np.sqrt(dz[:, None, None] + dy[None, :, None] + dx[None, None, :]) - np.float32(radius)
        view = out[spans[2], spans[1], spans[0]]
        np.minimum(view, d, out=view)
    return out


def extent(balls: Balls, margin: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners of the box around the balls, `margin` wider on every side."""
    reach = balls[:, 3:] + margin
    return (balls[:, :3] - reach).min(axis=0), (balls[:, :3] + reach).max(axis=0)
