"""Where and along which directions labels are taken: the sampling density of the data set.

A camera sees first collisions of its rays, so these are the backbone: first collisions of random lines through the cloud's bounding
sphere. A fast renderer interpolates J between nodes of a sparse lattice around them, so many points stand up to two units of length
beside a first collision, along the same line of sight: in front of it, behind it, and in the void. The rest lies deeper along
the line, anywhere inside, and anywhere in and around the box. Suns are uniform over the sphere, but for one a point that looks along the
line of sight or back along it: phase peaks and the antisolar point are small solid angles that uniform suns would leave nearly empty.
"""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from deepclouds.descriptor import default_unit
from deepclouds.medium.field import Field
from deepclouds.medium.first_collision import first_collisions
from deepclouds_training.shards import ANYWHERE, BESIDE, FIRST_COLLISION, INSIDE, SECOND_COLLISION

# Lines traced at the most for the collisions of one kind in one cloud.
_MOST_LINES = 2**21
# Nodes of a renderer's lattice lie within about so many units of length of a first collision, and within so large a part of the cloud.
_BESIDE_UNITS = 2.0
_BESIDE_SHARE = 0.25


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
    rng: Generator, field: Field, n: int, second: float, beside: float, inside: float, anywhere: float
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]:
    """Draw `n` points x and directions w: first collisions, but for the given shares.

    `second` are second collisions along the same line; `beside` are first collisions moved by up to two units of length (at most a
    fourth of the longest side) in a random direction; `inside` are in proportion to extinction; `anywhere` are uniform in the box and
    5 % around it. The last two see in uniform directions.

    Returns points (n, 3), directions (n, 3) and kinds (n,), in random order. In a cloud so thin that a bounded number of lines does not
    collide often enough, the missing collisions are drawn in proportion to extinction, which is their distribution in the thin limit.
    """
    counts = {SECOND_COLLISION: second, BESIDE: beside, INSIDE: inside, ANYWHERE: anywhere}
    numbers = {kind: round(share * n) for kind, share in counts.items()}
    # Rounding up every share may ask for more points than there are.
    while sum(numbers.values()) > n:
        numbers[max(numbers, key=lambda kind: numbers[kind])] -= 1
    numbers[FIRST_COLLISION] = n - sum(numbers.values())
    lower, upper = field.volume.bounds
    found = {kind: _collisions(rng, field, numbers[kind], kind == SECOND_COLLISION) for kind in (FIRST_COLLISION, SECOND_COLLISION, BESIDE)}
    points, w = found[BESIDE]
    reach = min(_BESIDE_UNITS * default_unit(field), _BESIDE_SHARE * float(np.max(upper - lower)))
    length = (reach * rng.random((len(points), 1))).astype(np.float32)
    found[BESIDE] = points + length * uniform_directions(rng, len(points)), w
    found[INSIDE] = _in_extinction(rng, field, numbers[INSIDE]), uniform_directions(rng, numbers[INSIDE])
    margin = 0.05 * (upper - lower)
    loose = rng.uniform(lower - margin, upper + margin, (numbers[ANYWHERE], 3)).astype(np.float32)
    found[ANYWHERE] = loose, uniform_directions(rng, len(loose))
    order = rng.permutation(n)
    kinds = np.repeat(np.array(list(found), np.uint8), [len(p) for p, _ in found.values()])
    return np.concatenate([p for p, _ in found.values()])[order], np.concatenate([d for _, d in found.values()])[order], kinds[order]


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


def sample_phase(rng: Generator, n: int) -> NDArray[np.float32]:
    """Phase functions as rows (g1, g2, weight), (n, 3).

    35 % have two lobes: g1 in 0.3..0.95, g2 in -0.5..0.5, weight of the first in 0.5..0.98. The others have one: of them 12 % are
    isotropic, 53 % uniform in 0..0.9, 25 % in 0.8..0.95, 10 % in -0.3..0.
    """
    lobes = np.stack([rng.uniform(0.3, 0.95, n), rng.uniform(-0.5, 0.5, n), rng.uniform(0.5, 0.98, n)], axis=1)
    kind = rng.random(n)
    g = np.select(
        [kind < 0.12, kind < 0.65, kind < 0.9],
        [np.zeros(n), rng.uniform(0.0, 0.9, n), rng.uniform(0.8, 0.95, n)],
        rng.uniform(-0.3, 0.0, n),
    )
    single = rng.random(n) >= 0.35
    lobes[single] = np.stack([g, np.zeros(n), np.ones(n)], axis=1)[single]
    return lobes.astype(np.float32)


def sample_albedo(rng: Generator, n: int) -> NDArray[np.float32]:
    """Two albedos a point, (n, 2): 1, which most clouds nearly reach, and ``1 - u^2 / 2``, or in 5 % of the points uniform in 0..0.5."""
    albedo = np.ones((n, 2))
    albedo[:, 1] = np.where(rng.random(n) < 0.05, rng.uniform(0, 0.5, n), 1 - 0.5 * rng.random(n) ** 2)
    return albedo.astype(np.float32)
