"""Rationale: an albedo that varies is looked up in every walk, so that the kernel must be the readable twin, to the last corner.

Expected behaviour: the same values on host and device inside and outside of the grid, in a box of its own; walks with a constant grid are
those with a constant; values that are no albedos are refused.
"""

from __future__ import annotations

import numpy as np
import pytest

from deepclouds.backend import backend
from deepclouds.errors import InputError
from deepclouds.medium.albedo import AlbedoField, AlbedoGrid
from deepclouds.medium.field import Field
from deepclouds.medium.one_sun import trace_to_escape
from deepclouds.volume import Volume


def _transform(seed: int) -> np.ndarray:
    to_world = np.eye(4)
    to_world[:3, :3] = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0] @ np.diag([1.2, 1.0, 0.9])
    to_world[:3, 3] = (1.0, -2.0, 0.5)
    return to_world


def _field() -> Field:
    return Field(backend(), Volume(np.random.default_rng(1).random((4, 6, 5)).astype(np.float32), _transform(2)), 4.0)


@pytest.mark.parametrize("shape", [(3, 4, 5, 3), (1, 7, 2, 1)])
def test_device_and_host_agree(shape: tuple[int, int, int, int]) -> None:
    field = _field()
    grid = AlbedoGrid(np.random.default_rng(3).random(shape).astype(np.float32), _transform(4))
    m = field.volume.to_world
    points = np.random.default_rng(5).uniform(-0.5, 1.5, (500, 3)) @ m[:3, :3].T + m[:3, 3]
    types = field.types
    found = AlbedoField(field, grid)(types.Array3f(*(types.Float(points[:, c].astype(np.float32)) for c in range(3))))
    expected = grid.sample(points)
    assert len(found) == shape[3]
    # A steep grid turns the last digit of a position into a visible difference.
    np.testing.assert_allclose(np.stack([np.array(v) for v in found], axis=1), expected, atol=2e-5)
    # Beyond the outermost centres it goes on as there.
    far = m[:3, 3] + 50 * m[:3, 0]
    assert np.all((grid.sample([far]) >= 0) & (grid.sample([far]) <= 1))


def test_walks_in_a_constant_grid_are_walks_with_a_constant() -> None:
    field = _field()
    random = np.random.default_rng(6)
    n, albedos = 40, np.array([0.4, 1.0], np.float32)
    m = field.volume.to_world
    points = (random.uniform(-0.2, 1.2, (n, 3)) @ m[:3, :3].T + m[:3, 3]).astype(np.float32)
    w, sun = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in random.normal(size=(2, n, 3)).astype(np.float32))
    phase = np.broadcast_to(np.array([0.6, 0, 1], np.float32), (n, 3))
    x, w, phase, sun = (np.repeat(v, 16, axis=0) for v in (points, w, phase, sun))
    constant, left = trace_to_escape(field, x, w, phase, sun, np.broadcast_to(albedos, (16 * n, 2)), 7)
    grid = AlbedoGrid(np.broadcast_to(albedos, (2, 3, 2, 2)), m)
    varying, escapes = trace_to_escape(field, x, w, phase, sun, np.zeros((n, 1), np.float32), 7, varying=AlbedoField(field, grid))
    # With a constant one more albedo is taken out.
    np.testing.assert_allclose(varying, constant * albedos, rtol=1e-5)
    assert varying.max() > 0
    for a, b in zip(escapes.weight, left.weight, strict=True):
        np.testing.assert_allclose(np.array(a), np.array(b), rtol=1e-5)
    assert np.array(left.weight[1]).max() > 0


@pytest.mark.parametrize("value", [-0.1, 1.1, np.nan])
def test_what_is_no_albedo_is_refused(value: float) -> None:
    values = np.full((2, 2, 2, 3), 0.5, np.float32)
    values[0, 1, 0, 2] = value
    with pytest.raises(InputError, match="1 values outside of 0 to 1"):
        AlbedoGrid(values, np.eye(4))
