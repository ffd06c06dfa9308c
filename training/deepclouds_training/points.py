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

_TRIES = 200


def uniform_directions(rng: Generator, *shape: int) -> NDArray[np.float32]:
    """Unit vectors uniform over the sphere, (*shape, 3)."""
    v = rng.normal(size=(*shape, 3))
    return (v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-30)).astype(np.float32)


def around(rng: Generator, directions: NDArray[np.float32], angle: NDArray[np.float64]) -> NDArray[np.float32]:
    """Unit vectors at `angle` (n,) radians from `directions` (n, 3), at a uniform azimuth."""
    side = np.cross(directions, uniform_directions(rng, len(directions)))
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-30)
    turned = np.cos(angle)[:, None] * directions + np.sin(angle)[:, None] * side
    return (turned / np.linalg.norm(turned, axis=1, keepdims=True)).astype(np.float32)


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

    Returns points (n, 3), directions (n, 3) and kinds (n,), in random order. A cloud too thin to be hit within a bounded number of
    lines gets its missing collisions drawn anywhere in its box.
    """
    second = int(round(deeper * n))
    loose = int(round(anywhere * n))
    first = n - second - loose
    found_points: list[NDArray[np.float32]] = []
    found_w: list[NDArray[np.float32]] = []
    kinds: list[NDArray[np.uint8]] = []
    for kind, wanted in ((FIRST_COLLISION, first), (SECOND_COLLISION, second)):
        missing = wanted
        for _ in range(_TRIES):
            if missing <= 0:
                break
            origins, w = random_lines(rng, field, 4 * missing + 1024)
            points, hit = first_collisions(field, origins, w, int(rng.integers(2**63)))
            points, w = points[hit], w[hit]
            if kind == SECOND_COLLISION:
                points, hit = first_collisions(field, points, w, int(rng.integers(2**63)))
                points, w = points[hit], w[hit]
            found_points.append(points[:missing])
            found_w.append(w[:missing])
            kinds.append(np.full(len(points[:missing]), kind, np.uint8))
            missing -= len(points[:missing])
        loose += max(missing, 0)
    lower, upper = field.volume.bounds
    margin = 0.05 * (upper - lower)
    found_points.append(rng.uniform(lower - margin, upper + margin, (loose, 3)).astype(np.float32))
    found_w.append(uniform_directions(rng, loose))
    kinds.append(np.full(loose, ANYWHERE, np.uint8))
    order = rng.permutation(n)
    return np.concatenate(found_points)[order], np.concatenate(found_w)[order], np.concatenate(kinds)[order]


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
