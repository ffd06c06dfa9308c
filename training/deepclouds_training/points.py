"""Where and along which directions labels are taken: the sampling density of the data set.

A camera sees first collisions, so most points are first collisions of random lines through the cloud's bounding sphere; some lie
deeper along the same line, where a dense front is nearly opaque, and some anywhere in and around the box, where interpolation nodes and
thin fringes lie. Suns are uniform over the sphere, but for one a point that looks along the line of sight or back along it: phase peaks and
the antisolar point are small solid angles that uniform suns would leave nearly empty.
"""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from deepclouds.medium.field import Field
from deepclouds.medium.first_collision import first_collisions
from deepclouds_training.shards import ANYWHERE, FIRST_COLLISION, SECOND_COLLISION

# Lines traced at the most for the collisions of one kind in one cloud.
_MOST_LINES = 2**21


def uniform_directions(rng: Generator, *shape: int) -> NDArray[np.float32]:
    """Unit vectors uniform over the sphere, (*shape, 3)."""
    v = rng.normal(size=(*shape, 3))
    unit: NDArray[np.float32] = (v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-30)).astype(np.float32)
    return unit


def around(rng: Generator, directions: NDArray[np.float32], angle: NDArray[np.float64]) -> NDArray[np.float32]:
    """Unit vectors at `angle` (n,) radians from `directions` (n, 3), at a uniform azimuth."""
    side = np.cross(directions, uniform_directions(rng, len(directions)))
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-30)
    turned = np.cos(angle)[:, None] * directions + np.sin(angle)[:, None] * side
    unit: NDArray[np.float32] = (turned / np.linalg.norm(turned, axis=1, keepdims=True)).astype(np.float32)
    return unit


def random_lines(rng: Generator, field: Field, n: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Origins and directions of isotropic uniform lines through the bounding sphere of the box, (n, 3) each."""
    lower, upper = field.volume.bounds
    radius = 0.5 * float(np.linalg.norm(upper - lower))
    w = uniform_directions(rng, n)
    offset = around(rng, w, np.full(n, 0.5 * np.pi)) * (radius * np.sqrt(rng.random((n, 1))))
    return ((lower + upper) / 2 + offset - 1.001 * radius * w).astype(np.float32), w


def sample_points(
    rng: Generator, field: Field, n: int, deeper: float, anywhere: float
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]:
    """Draw `n` points x and directions w; the shares `deeper` and `anywhere` are of the other two kinds.

    Returns points (n, 3), directions (n, 3) and kinds (n,), in random order. In a cloud so thin that a bounded number of lines does not
    collide often enough, the missing collisions are drawn in proportion to extinction, which is their distribution in the thin limit.
    """
    second = round(deeper * n)
    loose = round(anywhere * n)
    found = []
    for kind, wanted in ((FIRST_COLLISION, n - second - loose), (SECOND_COLLISION, second)):
        points, w = _collisions(rng, field, wanted, kind == SECOND_COLLISION)
        found.append((points, w, np.full(wanted, kind, np.uint8)))
    lower, upper = field.volume.bounds
    margin = 0.05 * (upper - lower)
    anywhere_points = rng.uniform(lower - margin, upper + margin, (loose, 3)).astype(np.float32)
    found.append((anywhere_points, uniform_directions(rng, loose), np.full(loose, ANYWHERE, np.uint8)))
    order = rng.permutation(n)
    points, w, kinds = (np.concatenate(parts)[order] for parts in zip(*found, strict=True))
    return points, w, kinds


def _collisions(rng: Generator, field: Field, wanted: int, second: bool) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    parts_points, parts_w = [np.zeros((0, 3), np.float32)], [np.zeros((0, 3), np.float32)]
    missing, lines, hits = wanted, 0, 0
    while missing > 0 and lines < _MOST_LINES:
        rate = max(hits / lines, 1e-3) if lines else 0.25
        batch = min(int(1.1 * missing / rate) + 256, _MOST_LINES // 4)
        origins, w = random_lines(rng, field, batch)
        points, hit = first_collisions(field, origins, w, int(rng.integers(2**63)))
        points, w = points[hit], w[hit]
        if second:
            points, hit = first_collisions(field, points, w, int(rng.integers(2**63)))
            points, w = points[hit], w[hit]
        lines, hits = lines + batch, hits + len(points)
        parts_points.append(points[:missing])
        parts_w.append(w[:missing])
        missing -= len(points[:missing])
    parts_points.append(_in_extinction(rng, field, missing))
    parts_w.append(uniform_directions(rng, missing))
    return np.concatenate(parts_points), np.concatenate(parts_w)


def _in_extinction(rng: Generator, field: Field, n: int) -> NDArray[np.float32]:
    """Points drawn voxel by voxel in proportion to extinction, uniform inside the voxel, (n, 3)."""
    density = field.volume.density
    cumulative = np.cumsum(density, dtype=np.float64)
    index = np.minimum(np.searchsorted(cumulative, rng.random(n) * cumulative[-1], side="right"), density.size - 1)
    z, y, x = np.unravel_index(index, density.shape)
    unit = (np.stack([x, y, z], axis=1) + rng.random((n, 3))) / np.array(field.volume.resolution)
    to_world = field.volume.to_world
    points: NDArray[np.float32] = (unit @ to_world[:3, :3].T + to_world[:3, 3]).astype(np.float32)
    return points


def sample_suns(rng: Generator, w: NDArray[np.float32], suns: int) -> NDArray[np.float32]:
    """Directions TOWARD `suns` suns a point, (n, suns, 3): the last one near +-w (angle pi u^2, 60 % forward), the rest uniform."""
    result = uniform_directions(rng, len(w), suns)
    if suns > 1:
        sign = np.where(rng.random(len(w)) < 0.6, 1.0, -1.0)[:, None]
        result[:, -1] = around(rng, (sign * w).astype(np.float32), np.pi * rng.random(len(w)) ** 2)
    return result


def sample_g(rng: Generator, n: int) -> NDArray[np.float32]:
    """Henyey-Greenstein parameters: 15 % isotropic, 65 % uniform in 0..0.9, 12 % in 0.8..0.93, 8 % in -0.3..0."""
    kind = rng.random(n)
    g = rng.uniform(0.0, 0.9, n)
    g = np.where(kind < 0.35, rng.uniform(-0.3, 0.0, n), g)
    g = np.where(kind < 0.27, rng.uniform(0.8, 0.93, n), g)
    return np.where(kind < 0.15, 0.0, g).astype(np.float32)
