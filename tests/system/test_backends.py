"""The kernels of the medium on every backend: the processor's and, where there is one, a GPU's.

Rationale: one source serves both, but compilers, rounding and atomic operations differ.
Expected behaviour: lookups equal the readable twin, marches equal quadrature, and labels and collisions have the means that the
processor finds with other seeds. Without a GPU its half is skipped, with the reason.
"""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage, stats

from deepclouds.backend import backend
from deepclouds.medium.field import Field
from deepclouds.medium.first_collision import first_collisions
from deepclouds.medium.multiple_scattering import trace_walks
from deepclouds.medium.optical_depth import optical_depth
from deepclouds.volume import Volume

Singles = NDArray[np.float32]


@pytest.fixture(scope="module")
def volume() -> Volume:
    """Separate lumps in a turned box that is mostly empty."""
    rng = np.random.default_rng(80)
    noise = ndimage.gaussian_filter(rng.normal(size=(24, 30, 36)), 2.0, mode="wrap")
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    to_world = np.eye(4)
    to_world[:3, :3] = turn @ np.diag([1.3, 1.0, 0.8])
    density = np.clip(noise - np.quantile(noise, 0.7), 0, None)
    return Volume((density / density.max()).astype(np.float32), to_world)


def inside(volume: Volume, count: int, seed: int) -> Singles:
    unit = np.random.default_rng(seed).random((count, 3))
    points: Singles = (unit @ volume.to_world[:3, :3].T + volume.to_world[:3, 3]).astype(np.float32)
    return points


def sphere(count: int, seed: int) -> Singles:
    d = np.random.default_rng(seed).normal(size=(count, 3))
    unit: Singles = (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)
    return unit


def test_lookups_and_marches(any_backend: ModuleType, volume: Volume) -> None:
    t, field = any_backend, Field(any_backend, volume, 12.0)
    points, w = inside(volume, 4000, 81), sphere(4000, 82)
    o, d = (t.Array3f(*(t.Float(np.ascontiguousarray(a[:, c])) for c in range(3))) for a in (points, w))
    np.testing.assert_allclose(np.array(field.sigma_t(o)), 12 * volume.sample(points.astype(np.float64)), atol=1e-3)
    tau = optical_depth(field, o, d, t.Float(0), t.Float(np.inf), t.Bool(True))
    distance = (np.arange(1600) + 0.5) * 1.25e-3
    along = points[:400, None].astype(np.float64) + distance[:, None] * w[:400, None]
    quadrature = 12 * volume.sample(along.reshape(-1, 3)).reshape(400, -1).sum(axis=1) * 1.25e-3
    np.testing.assert_allclose(np.array(tau)[:400], quadrature, atol=0.02 * quadrature.max())


def test_collisions(any_backend: ModuleType, volume: Volume) -> None:
    n = 100_000
    points, w = inside(volume, n, 83), sphere(n, 84)
    field = Field(any_backend, volume, 12.0)
    found, hit = first_collisions(field, points, w, seed=85)
    again, _ = first_collisions(field, points, w, seed=85)
    np.testing.assert_array_equal(found, again)
    expected, hit_expected = first_collisions(Field(backend("llvm"), volume, 12.0), points, w, seed=86)
    columns = [np.column_stack([h, p]).astype(np.float64) for h, p in ((hit, found), (hit_expected, expected))]
    difference = columns[0] - columns[1]
    assert np.all(np.abs(difference.mean(axis=0)) < 4 * difference.std(axis=0) / np.sqrt(n))


def test_labels(any_backend: ModuleType, volume: Volume) -> None:
    n, walks = 60, 12_000
    points, w, suns = inside(volume, n, 87), sphere(n, 88), np.broadcast_to(sphere(2, 89), (n, 2, 3))
    lobes = np.broadcast_to(np.array([0.8, -0.4, 0.8], np.float32), (n, 3))
    albedos = np.broadcast_to(np.array([1.0, 0.9], np.float32), (n, 2))
    field = Field(any_backend, volume, 12.0)
    first = trace_walks(field, points, w, lobes, suns, albedos, walks, seed=92, connect=0.25)
    again = trace_walks(field, points[:9], w[:9], lobes[:9], suns[:9], albedos[:9], walks, seed=92, connect=0.25)
    np.testing.assert_array_equal(again, first[:9])
    second = trace_walks(Field(backend("llvm"), volume, 12.0), points, w, lobes, suns, albedos, walks, seed=93, connect=0.25)
    for k in range(2):
        sets = [v[:, :, k, 1].astype(np.float64) for v in (first, second)]
        difference = sets[0].mean(axis=1) - sets[1].mean(axis=1)
        variance = sum(v.var(axis=1) / walks for v in sets)
        assert np.sqrt(np.sum(variance)) < 0.025 * sets[1].mean(axis=1).sum()
        assert abs(difference.sum()) < 4 * np.sqrt(np.sum(variance))
        assert np.abs(difference / np.sqrt(variance)).max() < stats.norm.isf(1e-3 / 2 / n)
