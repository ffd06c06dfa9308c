"""The light-aligned stencil: against its NumPy twin, and the invariances that make it a descriptor."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from deepclouds.backend import backend
from deepclouds.descriptor import LEVELS, POINTS, Descriptor, offsets
from deepclouds.descriptor.reference import light_frame, stencils
from deepclouds.medium.field import Field
from deepclouds.volume import Volume
from deepclouds.volume.pyramid import filtered_levels, mean_extinction, volume_frame


def random_directions(rng: np.random.Generator, n: int) -> NDArray[np.float64]:
    v = rng.normal(size=(n, 3))
    unit: NDArray[np.float64] = v / np.linalg.norm(v, axis=1, keepdims=True)
    return unit


def rotation(rng: np.random.Generator) -> NDArray[np.float64]:
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    proper: NDArray[np.float64] = q * np.sign(np.linalg.det(q))
    return proper


def blob(rng: np.random.Generator, shape: tuple[int, int, int] = (11, 14, 17)) -> NDArray[np.float32]:
    z, y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in shape), indexing="ij")
    return (np.maximum(0, 1.0 - (x + 0.2) ** 2 - y**2 - z**2) * rng.random(shape)).astype(np.float32)


@pytest.fixture
def cloud() -> Volume:
    return Volume.from_box(blob(np.random.default_rng(11)), (-1.0, -0.4, -0.7), (1.2, 0.9, 0.8))


def queries(volume: Volume, n: int = 24, seed: int = 5) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    rng = np.random.default_rng(seed)
    lower, upper = volume.bounds
    return rng.uniform(lower - 0.2, upper + 0.2, (n, 3)), random_directions(rng, n), random_directions(rng, n)


def moved(volume: Volume, matrix: NDArray[np.float64], shift: NDArray[np.float64] | None = None) -> Volume:
    to_world = volume.to_world.copy()
    to_world[:3] = matrix @ to_world[:3]
    if shift is not None:
        to_world[:3, 3] += shift
    return Volume(volume.density, to_world)


def kernel(
    volume: Volume, scale: float, points: NDArray[np.float64], w: NDArray[np.float64], sun: NDArray[np.float64]
) -> NDArray[np.float32]:
    return Descriptor(Field(backend("llvm"), volume, scale)).stencils_numpy(points, w, sun)


@pytest.mark.parametrize("scale", [1.0, 20.0, 3000.0])
def test_kernel_agrees_with_its_numpy_twin(cloud: Volume, scale: float) -> None:
    """At the three scales none, some and most of the levels are finer than a voxel."""
    arguments = queries(cloud)
    fast, slow = kernel(cloud, scale, *arguments), stencils(cloud, scale, *arguments)
    assert fast.shape == (24, LEVELS, POINTS)
    assert np.abs(slow).max() > 0.01
    # A point within rounding of the hard cut at the box may fall on either side.
    assert np.mean(np.abs(fast - slow) > 2e-3) < 2e-4


def test_layout_is_x_fastest_and_z_toward_the_light() -> None:
    """A lone bright voxel up-light of the point shows at the offsets' own index, not at its mirror image."""
    grid = np.zeros((21, 21, 21), np.float32)
    grid[10, 10, 15] = 1.0
    volume = Volume.from_box(grid, (0, 0, 0), (21, 21, 21))
    sun, w = np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, 0.0, -1.0]])
    point = np.array([[10.5, 10.5, 10.5]])
    unit = 2.0  # level 0 has a spacing of one voxel
    value = Descriptor(Field(backend("llvm"), volume, 1.0), unit=unit).stencils_numpy(point, w, sun)[0, 0]
    hit = offsets()[int(np.argmax(value))]
    assert tuple(hit) == (0, 0, 5)
    side = np.array([[10.5, 10.5, 10.5]]) + np.array([[5.0, 0.0, 0.0]]) - 2 * light_frame(w[0], sun[0])[0]
    value = Descriptor(Field(backend("llvm"), volume, 1.0), unit=unit).stencils_numpy(side, w, sun)[0, 0]
    assert tuple(offsets()[int(np.argmax(value))]) == (2, 0, 0)


def test_the_other_side_is_the_mirror_image(cloud: Volume) -> None:
    descriptor = Descriptor(Field(backend("llvm"), cloud, 30.0))
    arguments = queries(cloud)
    side = np.where(np.arange(24) % 2, -1.0, 1.0)
    plain, turned = descriptor.stencils_numpy(*arguments), descriptor.stencils_numpy(*arguments, side=side)
    flipped = plain.reshape(24, LEVELS, 9, 5, 5)[..., ::-1].reshape(plain.shape)
    expected = np.where(side[:, None, None] < 0, flipped, plain)
    assert np.mean(np.abs(plain - flipped) > 1e-3) > 0.05
    # A point within rounding of the hard cut at the box may fall on either side.
    assert np.mean(np.abs(turned - expected) > 1e-3) < 5e-4


def test_frame_is_right_handed_and_perpendicular_to_the_view() -> None:
    rng = np.random.default_rng(3)
    for w, sun in zip(random_directions(rng, 20), random_directions(rng, 20), strict=True):
        frame = light_frame(w, sun)
        assert np.allclose(frame @ frame.T, np.eye(3), atol=1e-12)
        assert np.isclose(np.linalg.det(frame), 1)
        assert np.allclose(frame[2], sun)
        assert abs(frame[0] @ w) < 1e-12


def test_rotating_everything_leaves_the_stencil_unchanged(cloud: Volume) -> None:
    rng = np.random.default_rng(8)
    turn = rotation(rng)
    points, w, sun = queries(cloud)
    before = kernel(cloud, 30.0, points, w, sun)
    after = kernel(moved(cloud, turn), 30.0, points @ turn.T, w @ turn.T, sun @ turn.T)
    assert np.mean(np.abs(before - after) > 2e-3) < 5e-4
    unturned = kernel(moved(cloud, turn), 30.0, points @ turn.T, w @ turn.T, sun)
    assert np.mean(np.abs(before - unturned) > 2e-3) > 0.05


def test_moving_everything_leaves_the_stencil_unchanged(cloud: Volume) -> None:
    shift = np.array([3.0, -2.0, 5.0])
    points, w, sun = queries(cloud)
    before, after = kernel(cloud, 30.0, points, w, sun), kernel(moved(cloud, np.eye(3), shift), 30.0, points + shift, w, sun)
    assert np.mean(np.abs(before - after) > 2e-3) < 5e-4


@pytest.mark.parametrize("factor", [1000.0, 1e-3])
def test_lengths_times_a_factor_and_extinction_over_it_change_nothing(cloud: Volume, factor: float) -> None:
    points, w, sun = queries(cloud)
    before = kernel(cloud, 30.0, points, w, sun)
    after = kernel(moved(cloud, factor * np.eye(3)), 30.0 / factor, points * factor, w, sun)
    assert np.mean(np.abs(before - after) > 2e-3) < 5e-4


@pytest.mark.parametrize("voxels", [1, 3, 7])
def test_empty_padding_changes_nothing(voxels: int) -> None:
    """Compared for a cloud whose outermost samples are zero: elsewhere padding moves the hard cut itself."""
    grid = np.pad(blob(np.random.default_rng(2)), 1)
    lower, voxel = np.array([-1.0, -0.5, -0.7]), 0.1
    size = np.array(grid.shape[::-1])
    plain = Volume.from_box(grid, lower, lower + voxel * size)
    padded = Volume.from_box(np.pad(grid, voxels), lower - voxel * voxels, lower + voxel * (size + voxels))
    arguments = queries(plain)
    before, after = kernel(plain, 30.0, *arguments), kernel(padded, 30.0, *arguments)
    assert np.abs(before - after).max() < 5e-3 * max(1.0, float(before.max()))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_view_along_the_sun_is_finite_and_turns_with_the_azimuth(cloud: Volume, sign: float) -> None:
    points, _, sun = queries(cloud)
    descriptor = Descriptor(Field(backend("llvm"), cloud, 30.0))
    plain = descriptor.stencils_numpy(points, sign * sun, sun)
    turned = descriptor.stencils_numpy(points, sign * sun, sun, np.full(len(points), 0.5 * np.pi))
    assert np.isfinite(plain).all()
    assert np.isfinite(turned).all()
    # A quarter turn takes the x axis to the y axis: what was at (-y, x) is now at (x, y).
    a = plain.reshape(-1, LEVELS, 9, 5, 5)
    b = turned.reshape(-1, LEVELS, 9, 5, 5)
    assert np.mean(np.abs(np.rot90(a, axes=(3, 4)) - b) > 2e-3) < 5e-3
    assert np.mean(np.abs(a - b) > 2e-3) > 0.01


def test_points_on_and_outside_the_box(cloud: Volume) -> None:
    """Inside the box's faces the field counts, beyond them nothing does, on the finest level to the last digit."""
    lower, upper = cloud.bounds
    grid = np.ones((4, 4, 4), np.float32)
    solid = Volume.from_box(grid, lower, upper)
    corner_w, sun = np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, 1.0, 0.0]])
    descriptor = Descriptor(Field(backend("llvm"), solid, 1000.0))
    far = descriptor.stencils_numpy(upper[None] + 100.0, corner_w, sun)
    assert far[:, :6].max() == 0.0
    middle = 0.5 * (lower + upper)[None]
    inside = descriptor.stencils_numpy(middle, corner_w, sun)
    assert np.allclose(inside[0, 0], 1.0, atol=1e-5)
    face = middle.copy()
    face[0, 1] = upper[1]
    on_face = descriptor.stencils_numpy(face, corner_w, sun)[0, 0]
    z = offsets()[:, 2]
    assert np.allclose(on_face[z < 0], 1.0, atol=1e-5)
    assert np.all(on_face[z > 0] == 0.0)


def test_anisotropic_voxels_describe_the_same_cloud() -> None:
    """The same smooth field sampled on 2 : 1 : 1 voxels gives nearly the same coarse levels."""

    def smooth(shape: tuple[int, int, int]) -> Volume:
        z, y, x = np.meshgrid(*((np.arange(n) + 0.5) / n * 2 - 1 for n in shape), indexing="ij")
        return Volume.from_box(np.exp(-6 * (x**2 + y**2 + z**2)).astype(np.float32), (-1, -1, -1), (1, 1, 1))

    fine, coarse = smooth((48, 48, 48)), smooth((48, 24, 48))
    points, w, sun = queries(fine)
    unit = 1 / (20.0 * mean_extinction(fine))
    a, b = (Descriptor(Field(backend("llvm"), v, 20.0), unit=unit).stencils_numpy(points, w, sun) for v in (fine, coarse))
    assert np.abs(a[:, 2:] - b[:, 2:]).max() < 0.02 * a.max()


def test_an_empty_field_has_an_empty_stencil() -> None:
    volume = Volume.from_box(np.zeros((3, 3, 3), np.float32), (0, 0, 0), (1, 1, 1))
    assert not kernel(volume, 5.0, *queries(volume)).any()


def test_filtered_cells_hold_exact_averages_of_the_trilinear_field(cloud: Volume) -> None:
    frame = volume_frame(cloud)
    levels = filtered_levels(cloud, frame, [0.21, 0.42])
    ticks = (np.arange(40) + 0.5) / 40
    inside = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    for level in levels:
        for k, j, i in [(1, 1, 1), (0, 2, 1), (2, 1, 3)]:
            lower = frame.origin + frame.axes @ ((level.first + np.array([i, j, k])) * level.spacing)
            brute = cloud.sample(lower + inside * level.spacing @ frame.axes.T).mean()
            assert level.dense()[k, j, i] == pytest.approx(brute, abs=3e-3)
    total = [float(level.dense().sum(dtype=np.float64)) * level.spacing**3 for level in levels]
    assert total[0] == pytest.approx(total[1], rel=1e-5)


def test_mean_extinction_ignores_padding_and_outliers_scale(cloud: Volume) -> None:
    padded = Volume(np.pad(cloud.density, 5), cloud.to_world)
    assert mean_extinction(padded) == pytest.approx(mean_extinction(cloud), rel=1e-6)
    assert mean_extinction(Volume.from_box(np.full((2, 2, 2), 0.25, np.float32), (0, 0, 0), (1, 1, 1))) == pytest.approx(0.25)
