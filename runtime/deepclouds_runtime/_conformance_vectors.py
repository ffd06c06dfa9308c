"""Makes the conformance vectors: one small cloud, queries all around it, and their stencils by the readable twin of the kernel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from deepclouds.descriptor import FIRST_SPACING, LEVELS, offsets
from deepclouds.descriptor.reference import light_frame, stencils
from deepclouds.model import aux_inputs
from deepclouds.volume import Volume
from deepclouds.volume.pyramid import mean_extinction, volume_frame
from deepclouds_runtime.conformance import Medium, Vectors, digests

# Queries of each medium, and how many of each are stored in full.
_COUNTS = (400, 300, 300)
_FULL = (24, 20, 20)
# Of the finest spacing; single precision places a point of the stencil with a tenth of this or better.
_MARGIN = 1e-3
_TAU_STEPS = 2000


def make_vectors(seed: int = 20170611) -> Vectors:
    """The conformance vectors; `seed` draws the cloud's wisps and the queries."""
    cloud_stream, query_stream = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(2))
    volume = _cloud(cloud_stream)
    media = _media(volume)
    rows = [_queries(query_stream, volume, medium) for medium in media]
    queries = np.concatenate(rows).astype(np.float32)
    values = np.concatenate([_stencils(volume, m, queries[m.first : m.first + m.count]) for m in media]).astype(np.float32)
    full = np.concatenate([m.first + np.arange(n) * (m.count // n) for m, n in zip(media, _FULL, strict=True)]).astype(np.int32)
    return Vectors(
        volume=volume,
        media=media,
        queries=queries,
        aux=_aux(queries),
        digests=digests(values),
        full_rows=full,
        full=values[full],
    )


def all_stencils(vectors: Vectors) -> NDArray[np.float32]:
    """The stencils (n, 10, 225) of every query by the readable twin, most of which the vectors hold as digests alone."""
    parts = [_stencils(vectors.volume, m, vectors.queries[m.first : m.first + m.count]) for m in vectors.media]
    return np.concatenate(parts).astype(np.float32)


def _cloud(rng: np.random.Generator) -> Volume:
    """A lopsided cloud of 24 x 20 x 16 anisotropic voxels in a turned box, dense where two of its faces cut it."""
    z, y, x = np.meshgrid(*((np.arange(n) + 0.5) / n for n in (16, 20, 24)), indexing="ij")
    density = np.zeros(z.shape)
    for centre, radius, height in (
        ((0.35, 0.45, 0.30), 0.30, 1.0),
        ((0.70, 0.60, 0.45), 0.22, 0.8),
        ((0.55, 0.30, 0.75), 0.16, 0.6),
        ((0.02, 0.75, 0.10), 0.20, 0.5),
    ):
        distance = np.sqrt(sum((a - c) ** 2 for a, c in zip((x, y, z), centre, strict=True))) / radius
        density = np.maximum(density, height * np.clip(1.4 - distance, 0, 1))
    density *= 0.4 + 0.6 * rng.random(density.shape)
    density = (density / density.max()).astype(np.float16).astype(np.float32)
    # Turned by 0.7 rad around (1, 2, 3), by Rodrigues' formula.
    axis = np.array([1.0, 2.0, 3.0]) / np.sqrt(14.0)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turn = np.eye(3) + np.sin(0.7) * cross + (1 - np.cos(0.7)) * cross @ cross
    to_world = np.eye(4)
    to_world[:3, :3] = turn @ np.diag(np.array([24, 20, 16]) * (0.10, 0.08, 0.14))
    to_world[:3, 3] = (1.5, -2.0, 0.7)
    return Volume(density, to_world)


def _media(volume: Volume) -> tuple[Medium, ...]:
    """Three media of one volume: two levels finer than a voxel; none; and three, with the unit and origin of another frame."""
    mean, voxel = mean_extinction(volume), float(volume.voxel_size.min())
    dense, thin, denser = (float(f"{1 / (mean * k * voxel):.3g}") for k in (0.9, 5.0, 0.2))
    centre = volume_frame(volume).origin
    firsts = np.cumsum((0, *_COUNTS[:-1]))
    elsewhere = centre + np.array([0.31, -0.17, 0.23])
    return (
        Medium(dense, 1 / (dense * mean), tuple(centre), True, int(firsts[0]), _COUNTS[0]),
        Medium(thin, 1 / (thin * mean), tuple(centre), True, int(firsts[1]), _COUNTS[1]),
        Medium(denser, 0.3 * voxel, tuple(elsewhere), False, int(firsts[2]), _COUNTS[2]),
    )


def _queries(rng: np.random.Generator, volume: Volume, medium: Medium) -> NDArray[np.float64]:
    """Rows of `Vectors.queries` (count, 14): two points of three in the cloud, the others around it; half of the views along the sun."""
    n = medium.count
    accepted: list[NDArray[np.float64]] = []
    while len(accepted) < n:
        point = volume.to_world[:3, :3] @ rng.uniform(-0.12, 1.12, 3) + volume.to_world[:3, 3]
        if len(accepted) % 3 != 0 and volume.sample(point[None])[0] == 0:
            continue
        sun = _direction(rng)
        if rng.random() < 0.5:
            w = _direction(rng)
        else:
            # The angle is drawn by its logarithm, down to twice the sine below which any azimuth serves.
            angle = np.exp(rng.uniform(np.log(2e-3), np.log(0.3)))
            across = np.cross(sun, _direction(rng))
            w = np.cos(angle) * sun + np.sin(angle) * across / np.linalg.norm(across)
            w *= rng.choice((-1.0, 1.0))
        # What is stored in single precision is what the reference sees.
        point, w, sun = (v.astype(np.float32).astype(np.float64) for v in (point, w, sun))
        if not _clear_of_the_cut(volume, medium, point, w, sun):
            continue
        g1 = rng.uniform(-0.3, 0.92)
        g2, weight = (rng.uniform(-0.6, 0.6), rng.uniform(0.3, 1.0)) if rng.random() < 0.5 else (0.0, 1.0)
        albedo = 1.0 if rng.random() < 0.3 else rng.uniform(0, 1)
        accepted.append(np.array([*point, *w, *sun, g1, g2, weight, albedo, _tau(volume, medium.scale, point, sun)]))
    return np.array(accepted)


def _direction(rng: np.random.Generator) -> NDArray[np.float64]:
    v = rng.normal(size=3)
    unit: NDArray[np.float64] = v / np.linalg.norm(v)
    return unit


def _clear_of_the_cut(volume: Volume, medium: Medium, point: NDArray[np.float64], w: NDArray[np.float64], sun: NDArray[np.float64]) -> bool:
    """Whether no point of the levels that read the field itself lies so close to a face of the box that rounding decides its value."""
    axes, box = light_frame(w, sun), np.linalg.norm(volume.to_world[:3, :3], axis=0)
    inverse = np.linalg.inv(volume.to_world[:3, :3])
    for k in range(LEVELS):
        spacing = FIRST_SPACING * 2.0**k * medium.unit
        if spacing > volume.voxel_size.min():
            break
        unit = (point + spacing * offsets() @ axes - volume.to_world[:3, 3]) @ inverse.T
        if np.any(np.minimum(np.abs(unit), np.abs(unit - 1)) * box < _MARGIN * FIRST_SPACING * medium.unit):
            return False
    return True


def _tau(volume: Volume, scale: float, point: NDArray[np.float64], sun: NDArray[np.float64]) -> float:
    """Optical depth from the point toward the sun, by the midpoint rule with steps of a twentieth of a voxel or less."""
    lower, upper = volume.bounds
    reach = float(np.linalg.norm(upper - lower)) + float(np.linalg.norm(point - 0.5 * (lower + upper)))
    distance = (np.arange(_TAU_STEPS) + 0.5) / _TAU_STEPS * reach
    return scale * float(volume.sample(point + distance[:, None] * sun).sum()) * reach / _TAU_STEPS


def _stencils(volume: Volume, medium: Medium, queries: NDArray[np.float32]) -> NDArray[np.float64]:
    """Stencils (n, 10, 225) by the twin in double precision."""
    return stencils(volume, medium.scale, queries[:, 0:3], queries[:, 3:6], queries[:, 6:9], medium.unit, medium.origin)


def _aux(queries: NDArray[np.float32]) -> NDArray[np.float32]:
    """The input `aux` (n, 6) of the queries."""
    w, sun = queries[:, 3:6].astype(np.float64), queries[:, 6:9].astype(np.float64)
    gamma = np.arctan2(np.linalg.norm(np.cross(w, sun), axis=1), np.sum(w * sun, axis=1))
    return aux_inputs(gamma, *(queries[:, c] for c in range(9, 14)))
