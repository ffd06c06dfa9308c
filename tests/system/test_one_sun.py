"""Walks under one sun against those that serve several.

Rationale: two ways of drawing one direction are easily counted twice, or not at all, at the first point, at the last vertex, or outside of
the box. Expected behaviour: the same means for every order, phase function, albedo and place, and less noise under a forward peak.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from deepclouds.backend import backend
from deepclouds.medium.field import Field
from deepclouds.medium.multiple_scattering import trace_walks
from deepclouds.medium.one_sun import trace_one_sun, trace_to_escape
from deepclouds.medium.phase import as_lobes
from deepclouds.volume import Volume

Singles = NDArray[np.float32]
Phase = float | tuple[float, float, float]
ALBEDOS = (0.0, 0.7, 1.0)


def _field(tau: float = 4.0) -> Field:
    """Lumps in a sheared and turned box; `tau` across the box, at its mean extinction."""
    lumps = np.clip(ndimage.gaussian_filter(np.random.default_rng(31).normal(size=(12, 16, 14)), 2.0, mode="constant") * 14, 0, 2)
    to_world = np.eye(4)
    to_world[:3, :3] = np.linalg.qr(np.random.default_rng(32).normal(size=(3, 3)))[0] @ np.diag([1.2, 1.0, 0.9])
    to_world[:3, 3] = (1.0, -2.0, 0.5)
    volume = Volume(lumps, to_world)
    return Field(backend(), volume, tau / float(volume.density.mean()))


def _sphere(count: int, seed: int) -> Singles:
    d = np.random.default_rng(seed).normal(size=(count, 3))
    unit: Singles = (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)
    return unit


def _points(field: Field, count: int, margin: float) -> Singles:
    m = field.volume.to_world
    unit = np.random.default_rng(33).uniform(-margin, 1 + margin, (count, 3))
    points: Singles = (unit @ m[:3, :3].T + m[:3, 3]).astype(np.float32)
    return points


def _both(field: Field, points: Singles, phase: Phase, walks: int, connect: float = 1.0) -> tuple[Singles, Singles]:
    """J (n, walks, albedos) of both kinds of walks, each with a seed of its own."""
    n = len(points)
    w, suns = _sphere(n, 34), _sphere(n, 35)
    lobes = np.repeat(as_lobes(np.array([phase])), n, axis=0)
    albedos = np.broadcast_to(np.array(ALBEDOS, np.float32), (n, len(ALBEDOS)))
    several = trace_walks(field, points, w, lobes, suns[:, None], albedos, walks, 36)[:, :, 0]
    return several, trace_one_sun(field, points, w, lobes, suns, albedos, walks, 37, connect=connect)


@pytest.mark.parametrize("phase", [-0.4, 0.0, 0.85, (0.9, -0.4, 0.75)])
@pytest.mark.parametrize("margin", [0.0, 0.4], ids=["inside", "around the box"])
def test_both_have_the_same_mean(phase: Phase, margin: float) -> None:
    """Albedo 0 shows the first order alone, where the first point has a branch or, outside of the box, none."""
    field = _field()
    several, one = (j.astype(np.float64) for j in _both(field, _points(field, 400, margin), phase, 4000))
    # Of the points' means, the difference of the two walks' is all noise.
    difference = one.mean(axis=1) - several.mean(axis=1)
    variance = one.var(axis=1) / one.shape[1] + several.var(axis=1) / several.shape[1]

    def deviations(chosen: slice) -> NDArray[np.float64]:
        z: NDArray[np.float64] = np.abs(difference[chosen].sum(axis=0)) / np.sqrt(variance[chosen].sum(axis=0))
        return z

    assert deviations(slice(None)).max() < 3.5
    # A bias of four per cent would be noticed.
    assert np.all(np.sqrt(variance.sum(axis=0)) < 0.02 * several.mean(axis=1).sum(axis=0))
    # And one that has another sign elsewhere, in many points together: single ones know too little of their own variance under a peak.
    assert max(deviations(slice(first, None, 8)).max() for first in range(8)) < 4.5


def test_roulette_keeps_the_mean() -> None:
    field = _field()
    points = _points(field, 300, 0.2)
    found = [_both(field, points, 0.85, 2000, connect=c)[1].astype(np.float64) for c in (0.1, 1.0, 20.0)]
    mean = [j.mean(axis=(0, 1)) for j in found]
    error = [np.sqrt((j.var(axis=1) / j.shape[1]).sum(axis=0)) / j.shape[0] for j in found]
    for a in (0, 2):
        assert np.all(np.abs(mean[a] - mean[1]) < 3.5 * np.hypot(error[a], error[1]))
        assert np.all(error[a] < 0.02 * mean[a])


def test_a_forward_peak_is_less_noisy() -> None:
    field = _field()
    several, one = _both(field, _points(field, 200, 0.0), 0.85, 2000)
    assert np.all(one.var(axis=1).mean(axis=0) < 0.6 * several.var(axis=1).mean(axis=0))


def test_lanes_change_nothing_and_seeds_do() -> None:
    field = _field()
    points, w, suns = _points(field, 50, 0.2), _sphere(50, 34), _sphere(50, 35)
    g, white = np.full(50, 0.6, np.float32), np.ones((50, 1), np.float32)

    def traced(seed: int, lanes: int) -> Singles:
        return trace_one_sun(field, points, w, g, suns, white, 20, seed, lanes=lanes)

    assert np.array_equal(traced(1, 64), traced(1, 1024))
    assert not np.array_equal(traced(1, 64), traced(2, 64))


def test_nothing_comes_out_of_nothing() -> None:
    empty = Field(backend(), Volume.from_box(np.zeros((2, 2, 2)), (0, 0, 0), (1, 1, 1)), 1.0)
    points = np.full((3, 3), 0.5, np.float32)
    g, white = np.zeros(3, np.float32), np.ones((3, 2), np.float32)
    found = trace_one_sun(empty, points, _sphere(3, 1), g, _sphere(3, 2), white, 5, 0)
    assert found.shape == (3, 5, 2)
    assert not found.any()
    assert trace_one_sun(_field(), points[:0], _sphere(3, 1)[:0], g[:0], _sphere(3, 2)[:0], white[:0], 5, 0).shape == (0, 5, 2)
    with pytest.raises(ValueError, match="2\\^31"):
        trace_one_sun(_field(), points, _sphere(3, 1), g, _sphere(3, 2), white, 1 << 30, 0)


@pytest.mark.parametrize("phase", [0.0, 0.85])
@pytest.mark.parametrize("margin", [0.0, 0.4], ids=["inside", "around the box"])
def test_walks_that_leave_see_light_from_all_around(phase: Phase, margin: float) -> None:
    """Radiance 1 + d . a in the direction d: what escapes see is what suns in every direction bring."""
    field, n, each = _field(), 300, 1500
    points, w = np.repeat(_points(field, n, margin), each, axis=0), np.repeat(_sphere(n, 34), each, axis=0)
    lobes = np.broadcast_to(as_lobes(np.array([phase])), (len(points), 3))
    albedos = np.broadcast_to(np.array(ALBEDOS, np.float32), (len(points), len(ALBEDOS)))
    towards = np.array([0.6, -0.5, 0.4])
    for suns in (None, np.broadcast_to(_sphere(1, 38), points.shape)):
        _, escapes = trace_to_escape(field, points, w, lobes, suns, albedos, 44)
        direction = np.stack([np.array(v) for v in escapes.direction], axis=1).astype(np.float64)
        weight = np.stack([np.array(v) for v in escapes.weight], axis=1).astype(np.float64)
        assert np.all(weight[:, 0] == 0)
        np.testing.assert_allclose(np.linalg.norm(direction[weight[:, 2] > 0], axis=1), 1, atol=1e-4)
        seen = (1 + direction @ towards)[:, None] * weight
        around = _sphere(len(points), 45)
        j = trace_one_sun(field, points, w, lobes, around, albedos, 1, 46)[:, 0].astype(np.float64)
        by_suns = (1 + around.astype(np.float64) @ towards)[:, None] * j * np.array(ALBEDOS)
        a, b = (v.reshape(n, each, -1) for v in (seen, by_suns))
        error = np.sqrt(((a.var(axis=1) + b.var(axis=1)) / each).sum(axis=0)) / n
        difference = np.abs(a.mean(axis=(0, 1)) - b.mean(axis=(0, 1)))
        assert np.all(difference <= 3.5 * error)
        assert np.all(error[1:] < 0.02 * b.mean(axis=(0, 1))[1:])
        assert np.all(a.var(axis=1).mean(axis=0)[1:] < 0.7 * b.var(axis=1).mean(axis=0)[1:])
    # White light through a white cloud: all that collides again.
    position = np.stack([np.array(v) for v in escapes.position], axis=1)
    assert position.min() >= 0
    assert position.max() <= 1
