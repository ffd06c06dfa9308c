"""Local majorants bound the field, blocks make progress and cover rays, and tracking with them equals tracking with one majorant."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from deepclouds.backend import backend
from deepclouds.medium.field import Field
from deepclouds.medium.first_collision import first_collisions
from deepclouds.medium.majorants import Majorants, packed
from deepclouds.volume import Volume

Floats = NDArray[np.float64]


def patches(shape: tuple[int, int, int], seed: int, filled: float = 0.3) -> Volume:
    """A grid of separate lumps between voids, in a turned and mirrored box with voxels of three edges."""
    rng = np.random.default_rng(seed)
    noise = ndimage.gaussian_filter(rng.normal(size=shape), 1.5, mode="wrap") if max(shape) > 2 else rng.random(shape)
    density = np.clip(noise - np.quantile(noise, 1 - filled), 0, None) if max(shape) > 2 else noise
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn[:, 0] *= -np.sign(np.linalg.det(turn))
    to_world = np.eye(4)
    to_world[:3, :3] = turn @ np.diag([1.3, 1.0, 0.8])
    to_world[:3, 3] = (3.0, -2.0, 0.5)
    return Volume((density / density.max()).astype(np.float32), to_world)


def device(field: Field, values: Floats) -> object:
    t = field.types
    return t.Array3f(*(t.Float(np.ascontiguousarray(values[:, c], np.float32)) for c in range(3)))


SHAPES = [(20, 27, 33), (7, 5, 90), (1, 9, 30), (1, 1, 1), (2, 2, 2), (40, 3, 3)]


@pytest.mark.parametrize("brick", [1, 3, 4, 9, None])
@pytest.mark.parametrize("shape", SHAPES)
def test_blocks_bound_the_field_along_every_step(shape: tuple[int, int, int], brick: int | None) -> None:
    """From points all over the box in all directions: up to where a step can lead, no extinction exceeds the step's majorant."""
    volume = patches(shape, seed=1)
    field = Field(backend(), volume, 5.0, brick=brick)
    rng, n = np.random.default_rng(2), 3000
    origin = rng.random((n, 3))
    # Points on the borders of bricks and of the box.
    origin[: n // 3] = np.round(origin[: n // 3] * 8) / 8
    along = rng.normal(size=(n, 3))
    along[: n // 6] = np.eye(3)[np.arange(n // 6) % 3] * rng.choice([-1.0, 1.0], (n // 6, 1))
    t = field.types
    # u close to 1 makes the step as long as the block allows.
    distance, _, mean_path = field.majorants.step(
        device(field, origin), device(field, along), t.Float(np.zeros(n)), t.Float(1 - 2.0**-24), t.Bool(np.ones(n, bool))
    )
    majorant = 1 / np.array(mean_path, np.float64)
    assert np.all(np.array(distance) > 0)
    for share in rng.random(24):
        at = origin + share * np.array(distance, np.float64)[:, None] * along
        world = at @ volume.to_world[:3, :3].T + volume.to_world[:3, 3]
        assert np.all(5.0 * volume.sample(world) <= majorant * (1 + 1e-5) + 1e-7)


def test_bounds_are_tight_and_blocks_are_what_they_say() -> None:
    """Bounds by brute force: the largest sample that a brick's points read, and the largest bound of the bricks in a block."""
    volume = patches((21, 26, 33), seed=3)
    m = Majorants(backend(), volume.density, volume.voxel_size)
    assert m.bricks.min() == 4
    nx, ny, nz = m.bricks
    padded = np.pad(volume.density, 1, mode="edge")
    for k, j, i in np.ndindex(*m.bound.shape):
        expected = padded[k * nz : (k + 1) * nz + 2, j * ny : (j + 1) * ny + 2, i * nx : (i + 1) * nx + 2].max()
        assert m.bound[k, j, i] == expected
        for radius, bound in ((m.radius[k, j, i], m.block_bound[k, j, i]), (m.empty_radius[k, j, i], 0)):
            if radius >= 0:
                low = [max(0, c - radius) for c in (k, j, i)]
                block = m.bound[tuple(slice(a, c + radius + 1) for a, c in zip(low, (k, j, i), strict=True))]
                assert block.max() == bound
    assert (m.empty_radius >= 0).sum() == (m.bound == 0).sum() > 0


def test_a_homogeneous_medium_is_one_block() -> None:
    m = Majorants(backend(), np.full((30, 40, 50), 2.0, np.float32), np.full(3, 0.1))
    np.testing.assert_array_equal(m.block_bound, 2.0)
    assert m.radius.min() >= 13 - 1
    thin = Majorants(backend(), np.random.default_rng(4).random((30, 40, 50)).astype(np.float32) * 1e-4, np.full(3, 0.1))
    assert thin.radius.min() >= 13 - 1
    thick = Majorants(backend(), patches((30, 40, 50), 5).density * 1000, np.full(3, 0.1))
    assert (thick.radius == 0).mean() > 0.3


def test_first_collisions_do_not_depend_on_the_bricks() -> None:
    """The share of rays that collide, and where, is that of one global majorant; so it is in a box seen from far away."""
    volume, n = patches((24, 30, 36), seed=6), 200_000
    rng = np.random.default_rng(7)
    target = (rng.random((n, 3)) @ volume.to_world[:3, :3].T + volume.to_world[:3, 3]).astype(np.float32)
    d = rng.normal(size=(n, 3))
    d = (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)
    o = target - rng.choice([0.0, 3.0, 300.0], (n, 1)).astype(np.float32) * d
    results = []
    for brick, seed in ((None, 8), (4, 9), (2, 10)):
        points, hit = first_collisions(Field(backend(), volume, 6.0, brick=brick), o, d, seed=seed)
        unit = (points.astype(np.float64) - volume.to_world[:3, 3]) @ np.linalg.inv(volume.to_world[:3, :3]).T
        results.append(np.column_stack([hit, *(np.where(hit[:, None], unit, 0) ** p for p in (1, 2))]))
        assert unit[hit].min() > -1e-3
        assert unit[hit].max() < 1 + 1e-3
    for other in results[1:]:
        # The same rays: their differences are what independent draws leave.
        difference = other - results[0]
        z = difference.mean(axis=0) / (difference.std(axis=0) / np.sqrt(n))
        assert np.abs(z).max() < 4


def test_an_entry_holds_a_bound_from_above_and_a_radius_that_is_not_too_large() -> None:
    bound, radius = np.geomspace(1e-6, 1e9, 300).astype(np.float32), np.arange(300) * 20
    entry = packed(bound, radius)
    mean_path = (entry & np.uint32(0xFFFFF000)).view(np.float32).astype(np.float64)
    product = mean_path * bound.astype(np.float64)
    assert product.max() <= 1 + 1e-7
    assert product.min() > 1 - 1 / 2000
    np.testing.assert_array_equal(entry & 0xFFF, np.minimum(radius, 4095))
    assert (packed(np.zeros(1, np.float32), np.ones(1, int)) & np.uint32(0xFFFFF000)).view(np.float32) > 1e29
