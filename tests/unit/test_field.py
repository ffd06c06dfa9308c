"""The device lookup against its readable twin, and the box intersection against brute force."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from deepclouds.backend import backend
from deepclouds.medium.field import Field
from deepclouds.volume import SparseVolume, Volume
from deepclouds.volume.bricks import Bricks

Floats = NDArray[np.float64]


def rotation(seed: int) -> Floats:
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return np.asarray(q * np.linalg.det(q))


def box(shape: tuple[int, int, int], seed: int = 0, rotated: bool = False) -> Volume:
    """A random grid in a box that is neither cubic nor at the origin; `rotated` also mirrors it."""
    rng = np.random.default_rng(seed)
    to_world = np.eye(4)
    to_world[:3, :3] = rotation(seed) @ np.diag([2.0, -3.0, 1.25]) if rotated else np.diag([2.0, 3.0, 1.25])
    to_world[:3, 3] = (-0.7, 10.0, 4.0)
    return Volume(rng.random(shape).astype(np.float32), to_world)


def to_world(volume: Volume, unit: Floats) -> Floats:
    return np.asarray(unit @ volume.to_world[:3, :3].T + volume.to_world[:3, 3])


def lookup(field: Field, points: Floats) -> Floats:
    t = field.types
    return np.array(field.sigma_t(t.Array3f(*(t.Float(np.ascontiguousarray(points[:, c], np.float32)) for c in range(3)))), np.float64)


@pytest.mark.parametrize("shape", [(7, 5, 9), (1, 5, 9), (7, 1, 9), (7, 5, 1), (1, 1, 1), (2, 2, 2)])
@pytest.mark.parametrize("rotated", [False, True])
def test_lookup_equals_its_twin(shape: tuple[int, int, int], rotated: bool) -> None:
    volume = box(shape, seed=3, rotated=rotated)
    unit = np.random.default_rng(1).uniform(-0.3, 1.3, (20000, 3))
    # In float32 a point this close to a face may fall on its other side.
    unit = unit[np.all(np.minimum(np.abs(unit), np.abs(unit - 1)) > 1e-4, axis=1)]
    points = to_world(volume, unit)
    found, expected = lookup(Field(backend(), volume, 2.5), points), 2.5 * volume.sample(points)
    assert np.count_nonzero(expected) > 2000
    np.testing.assert_array_equal(found[expected == 0], 0)
    np.testing.assert_allclose(found, expected, atol=2e-4)


def test_a_sample_sits_at_its_cell_centre() -> None:
    volume = box((4, 3, 5), seed=5)
    k, j, i = np.meshgrid(*(np.arange(n) for n in volume.density.shape), indexing="ij")
    unit = np.stack([(a.ravel() + 0.5) / n for a, n in zip((i, j, k), volume.resolution, strict=True)], axis=1)
    np.testing.assert_allclose(lookup(Field(backend(), volume), to_world(volume, unit)), volume.density.ravel(), atol=2e-5)


@pytest.mark.parametrize("shape", [(7, 5, 9), (1, 5, 9), (40, 3, 20)])
@pytest.mark.parametrize("sparse", [False, True])
def test_drawn_samples_are_interpolated_on_the_mean(shape: tuple[int, int, int], sparse: bool) -> None:
    full = box(shape, seed=8)
    volume = Volume(np.where(full.density < 0.5, np.float32(0), full.density), full.to_world)
    field = Field(backend(), SparseVolume(Bricks.from_dense(volume.density), volume.to_world) if sparse else volume, 2.5)
    t, rng, many = field.types, np.random.default_rng(2), 4096
    unit = np.repeat(rng.uniform(0, 1, (60, 3)), many, axis=0).astype(np.float32)
    at = t.Array3f(*(t.Float(np.ascontiguousarray(unit[:, c])) for c in range(3)))
    numbers = [t.Float(rng.random(len(unit), np.float32)) for _ in range(3)]
    drawn = np.array(field.drawn_unit(at, numbers), np.float64).reshape(60, many)
    expected = np.array(field.sigma_t_unit(at), np.float64).reshape(60, many)[:, 0]
    assert np.isin(drawn, (2.5 * volume.density.astype(np.float64)).astype(np.float32)).all()
    error = drawn.std(axis=1) / np.sqrt(many)
    assert np.all(np.abs(drawn.mean(axis=1) - expected) < 4.5 * error + 1e-5)
    assert np.count_nonzero(error > 0) > 30
    assert not np.array(field.drawn_unit(at, numbers, t.Bool(False))).any()


def test_faces_belong_to_the_box_and_the_cut_is_hard() -> None:
    field = Field(backend(), Volume.from_box(np.full((2, 2, 2), 3.0), (-1, -1, -1), (1, 1, 1)))
    centres = np.eye(3).repeat(2, axis=0) * np.tile([1.0, -1.0], 3)[:, None]
    np.testing.assert_allclose(lookup(field, centres), 3.0, rtol=1e-6)
    np.testing.assert_array_equal(lookup(field, centres * (1 + 1e-5)), 0.0)
    np.testing.assert_allclose(lookup(field, np.array([[1.0, 1, 1], [-1, -1, -1], [1, -1, 1]])), 3.0, rtol=1e-6)


def test_inactive_lanes_read_zero() -> None:
    t = backend()
    field = Field(t, Volume.from_box(np.ones((2, 2, 2)), (0, 0, 0), (1, 1, 1)))
    found = field.sigma_t(t.Array3f(t.Float([0.5, 0.5]), 0.5, 0.5), t.Bool([True, False]))
    np.testing.assert_array_equal(np.array(found), [1, 0])


def test_majorant_bounds_every_lookup() -> None:
    volume = box((6, 7, 8), seed=9)
    field = Field(backend(), volume, 4.0)
    points = to_world(volume, np.random.default_rng(2).random((50000, 3)))
    assert lookup(field, points).max() <= field.majorant * (1 + 1e-6)
    assert field.majorant == pytest.approx(4.0 * float(volume.density.max()))


@pytest.mark.parametrize("scale", [-1.0, np.nan, np.inf])
def test_bad_scale_is_refused(scale: float) -> None:
    with pytest.raises(ValueError, match="scale"):
        Field(backend(), box((2, 2, 2)), scale)


@pytest.mark.parametrize("rotated", [False, True])
def test_intersect_against_brute_force(rotated: bool) -> None:
    volume = box((3, 3, 3), seed=7, rotated=rotated)
    field = Field(backend(), volume)
    rng = np.random.default_rng(8)
    origins = to_world(volume, rng.uniform(-0.8, 1.8, (600, 3)))
    directions = rng.normal(size=(600, 3))
    # Rays along the axes of the box and of the world: one of both is parallel to faces.
    directions[:60] = np.tile(volume.to_world[:3, :3].T, (20, 1)) * rng.choice([-1.0, 1.0], (60, 1))
    directions[60:120] = np.tile(np.eye(3), (20, 1))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)

    t = field.types
    device = [t.Array3f(*(t.Float(np.ascontiguousarray(a[:, c], np.float32)) for c in range(3))) for a in (origins, directions)]
    enter, leave = (np.array(a, np.float64) for a in field.intersect(*device))

    reach, steps = 12.0, 6001
    along = np.linspace(0, reach, steps)
    inverse = np.linalg.inv(volume.to_world[:3, :3])
    base, slope = (origins - volume.to_world[:3, 3]) @ inverse.T, directions @ inverse.T
    inside = np.all(np.abs(base[:, None] + along[None, :, None] * slope[:, None] - 0.5) <= 0.5, axis=2)
    spacing = along[1]
    hit = inside.any(axis=1)
    assert 50 < hit.sum() < 550
    np.testing.assert_allclose(enter[hit], along[inside.argmax(axis=1)][hit], atol=1.01 * spacing)
    np.testing.assert_allclose(leave[hit], along[steps - 1 - inside[:, ::-1].argmax(axis=1)][hit], atol=1.01 * spacing)
    # A chord shorter than the spacing escapes brute force.
    assert np.all((leave - enter)[~hit] < spacing)
    started_inside = inside[:, 0]
    assert started_inside.sum() > 20
    np.testing.assert_array_equal(enter[started_inside], 0)
