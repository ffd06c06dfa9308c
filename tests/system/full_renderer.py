"""The tracker as a full renderer of one ray at a time, for tests that hold radiance against exact results."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepclouds.medium.field import Field
from deepclouds.medium.first_collision import first_collisions
from deepclouds.medium.multiple_scattering import trace_walks
from deepclouds.medium.optical_depth import optical_depth
from deepclouds.medium.phase import as_lobes, two_lobe_numpy

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]


def unattenuated(field: Field, points: ArrayLike, directions: ArrayLike) -> Floats:
    """Transmittance from points (n, 3) along unit vectors (n, 3) to infinity, (n,)."""
    t = field.types
    o, d = (t.Array3f(*(t.Float(np.ascontiguousarray(np.asarray(v)[:, c], np.float32)) for c in range(3))) for v in (points, directions))
    active = t.Bool(np.ones(len(np.asarray(points)), bool))
    return np.exp(-np.array(optical_depth(field, o, d, t.Float(0), t.Float(1e4), active), np.float64))


def radiance(field: Field, origins: Singles, w: Singles, phase: ArrayLike, suns: ArrayLike, albedos: ArrayLike, seed: int) -> Floats:
    """Unbiased scattered radiance over the suns' irradiance along rays (n, 3), for each sun and albedo: (n, k, m).

    Every ray goes to its first collision, where the sun arrives attenuated (S1) and one walk estimates J.

    Parameters
    ----------
    phase
        g, or the lobes (g1, g2, weight).
    suns, albedos
        (k, 3) unit vectors TOWARD the suns, and (m,) albedos.
    """
    suns, albedos = np.asarray(suns, np.float32), np.asarray(albedos, np.float32)
    row = as_lobes(np.array([phase]))[0]
    seeds = [int(s.generate_state(1)[0]) for s in np.random.SeedSequence(seed).spawn(2)]
    points, hit = first_collisions(field, origins, w, seed=seeds[0])
    points, w = points[hit], w[hit]
    n, k, m = len(points), len(suns), len(albedos)
    j = trace_walks(
        field,
        points,
        w,
        np.repeat(row[None], n, axis=0),
        np.broadcast_to(suns, (n, k, 3)),
        np.broadcast_to(albedos, (n, m)),
        1,
        seed=seeds[1],
    )
    result = np.zeros((len(hit), k, m))
    white = albedos.astype(np.float64)
    for i, sun in enumerate(suns):
        single = two_lobe_numpy(w.astype(np.float64) @ sun.astype(np.float64), *row) * unattenuated(field, points, np.tile(sun, (n, 1)))
        result[hit, i] = white * single[:, None] + white**2 / (4 * np.pi) * j[:, 0, i]
    return result
