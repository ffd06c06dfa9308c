"""A cloud in bricks is the same cloud: values, bounds, marches, walks and stencils against the dense grid."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from deepclouds.backend import backend, vectors_of
from deepclouds.descriptor import Descriptor
from deepclouds.errors import InputError
from deepclouds.medium.field import Field
from deepclouds.medium.first_collision import first_collisions
from deepclouds.medium.optical_depth import optical_depth
from deepclouds.memory import field_bytes
from deepclouds.volume import Bricks, SparseVolume, Volume, pyramid
from deepclouds.volume import sparse as sparse_module
from deepclouds.volume.pyramid import filtered_levels, mean_extinction, volume_frame

types = backend("llvm")
# Grids whose edges are multiples of the brick's, one more and one less, a single sample, a single brick.
SHAPES = [(40, 33, 47), (16, 8, 24), (1, 30, 17), (9, 1, 1), (5, 6, 7)]


def lumps(shape: tuple[int, int, int], seed: int = 0) -> Volume:
    """A few blobs at random places, some at the faces, in a turned box of uneven voxels."""
    rng = np.random.default_rng(seed)
    density = np.zeros(shape, np.float32)
    for _ in range(6):
        at = [int(rng.integers(0, n)) for n in shape]
        part = tuple(slice(a, min(a + 6, n)) for a, n in zip(at, shape, strict=True))
        density[part] = rng.random(density[part].shape)
    to_world = np.eye(4)
    to_world[:3, :3] = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]]) * (np.array(shape[::-1]) * (0.1, 0.13, 0.1))
    to_world[:3, 3] = (0.3, -1, 2)
    return Volume(density, to_world)


def in_bricks(volume: Volume) -> SparseVolume:
    return SparseVolume(Bricks.from_dense(volume.density), volume.to_world)


def points_in(volume: Volume, n: int, seed: int) -> NDArray[np.float64]:
    """Points in the box and around it."""
    unit = np.random.default_rng(seed).uniform(-0.1, 1.1, (n, 3))
    result: NDArray[np.float64] = unit @ volume.to_world[:3, :3].T + volume.to_world[:3, 3]
    return result


@pytest.mark.parametrize("shape", SHAPES)
def test_bricks_hold_the_grid(shape: tuple[int, int, int]) -> None:
    volume = lumps(shape)
    sparse = in_bricks(volume)
    np.testing.assert_array_equal(sparse.density, volume.density)
    assert sparse.resolution == volume.resolution
    np.testing.assert_array_equal(sparse.voxel_size, volume.voxel_size)
    assert np.count_nonzero(sparse.stored) == np.count_nonzero(volume.density)
    axes: list[int | tuple[int, int]] = [0, 1, 2, (1, 2), (0, 1)]
    for axis in axes:
        np.testing.assert_allclose(sparse.sums(axis), volume.sums(axis), rtol=1e-12)
    for above in (0.0, 0.5):
        for found, expected in zip(sparse.row_ends(above), volume.row_ends(above), strict=True):
            np.testing.assert_array_equal(found, expected)
    assert mean_extinction(sparse) == pytest.approx(mean_extinction(volume), rel=1e-12)
    np.testing.assert_allclose(volume_frame(sparse).origin, volume_frame(volume).origin, rtol=1e-12)
    points = points_in(volume, 500, 1)
    np.testing.assert_array_equal(sparse.sample(points), volume.sample(points))


@pytest.mark.parametrize("before", [False, True])
def test_window_maxima_see_what_touches_a_brick(before: bool) -> None:
    density = lumps((33, 20, 17), 3).density
    padded = np.pad(density, [(1, 1 + -n % 8) for n in density.shape])
    found = Bricks.from_dense(density).window_maxima(before)
    for k, j, i in np.ndindex(*found.shape):
        begin = 0 if before else 1
        part = padded[8 * k + begin : 8 * k + 10, 8 * j + begin : 8 * j + 10, 8 * i + begin : 8 * i + 10]
        assert found[k, j, i] == part.max()


@pytest.mark.parametrize("shape", SHAPES)
def test_lookups_are_those_of_the_dense_grid(shape: tuple[int, int, int]) -> None:
    """To the bit: inside, at the faces, where the outermost samples continue to the box, and outside."""
    volume = lumps(shape)
    points = points_in(volume, 20_000, 2)
    on_faces = points_in(volume, 2000, 3)
    local = np.clip((on_faces - volume.to_world[:3, 3]) @ np.linalg.inv(volume.to_world[:3, :3]).T, 0.001, 0.999)
    points = np.concatenate([points, local @ volume.to_world[:3, :3].T + volume.to_world[:3, 3]])
    dense, sparse = (np.array(Field(types, v, 2.7).sigma_t(vectors_of(types, points))) for v in (volume, in_bricks(volume)))
    assert np.count_nonzero(dense) > 100
    np.testing.assert_array_equal(sparse, dense)


def test_bricks_on_each_backend(any_backend: Any) -> None:
    volume = lumps((40, 33, 47))
    points = np.ascontiguousarray(points_in(volume, 20_000, 12).T, np.float32)
    dense, sparse = (np.array(Field(any_backend, v, 2.7).sigma_t(any_backend.Array3f(points))) for v in (volume, in_bricks(volume)))
    assert np.count_nonzero(dense) > 100
    np.testing.assert_array_equal(sparse, dense)


def test_majorants_bound_the_field_and_marches_agree() -> None:
    volume = lumps((40, 33, 47))
    dense, sparse = Field(types, volume, 5.0), Field(types, in_bricks(volume), 5.0)
    assert sparse.majorant == dense.majorant
    points, rng = points_in(volume, 20_000, 4), np.random.default_rng(5)
    unit = vectors_of(types, (points - volume.to_world[:3, 3]) @ np.linalg.inv(volume.to_world[:3, :3]).T)
    directions = rng.normal(size=(20_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    along = sparse.direction_to_unit(vectors_of(types, directions))
    inside = sparse.holds_unit(unit)
    _, _, mean_path = sparse.majorants.step(unit, along, types.Float(0), types.Float(0.5), inside)
    assert np.all(np.array(sparse.sigma_t_unit(unit, inside)) * np.array(mean_path) <= 1 + 1e-6)
    assert sparse.majorants.any_empty
    arguments = (vectors_of(types, points), vectors_of(types, directions), types.Float(0), types.Float(1e4), types.Bool(True))
    a, b = (np.array(optical_depth(f, *arguments)) for f in (dense, sparse))
    assert a.max() > 1
    np.testing.assert_array_equal(b, a)


def test_walks_agree() -> None:
    """With one majorant for the box both draw the same numbers: the same collisions; with those of bricks the same share collides."""
    volume, n = lumps((40, 33, 47)), 60_000
    rng = np.random.default_rng(6)
    inside = points_in(volume, n, 7)
    w = rng.normal(size=(n, 3))
    w /= np.linalg.norm(w, axis=1, keepdims=True)
    o, d = (inside - 10 * w).astype(np.float32), w.astype(np.float32)
    (points, hit), (points_in_bricks, hit_in_bricks) = (
        first_collisions(Field(types, v, 5.0, brick=None), o, d, seed=8) for v in (volume, in_bricks(volume))
    )
    np.testing.assert_array_equal(hit_in_bricks, hit)
    np.testing.assert_array_equal(points_in_bricks, points)
    _, with_bricks = first_collisions(Field(types, in_bricks(volume), 5.0), o, d, seed=9)
    share = hit.mean()
    assert 0.02 < share < 0.9
    assert abs(with_bricks.mean() - share) < 4 * np.sqrt(2 * share * (1 - share) / n)


@pytest.mark.parametrize("spacing", [0.11, 0.17, 0.4, 1.3, 9.0])
def test_filtered_levels_are_those_of_the_dense_grid(spacing: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cell by cell but for rounding, with the levels in bricks and with dense ones, from cells of a voxel to cells of the whole box."""
    volume = lumps((40, 33, 47))
    frame, spacings = volume_frame(volume), [spacing * 2.0**k for k in range(5)]
    expected = filtered_levels(volume, frame, spacings)
    for most, kind in ((0, Bricks), (1 << 24, np.ndarray)):
        monkeypatch.setattr(pyramid, "_MOST_DENSE_CELLS", most)
        for twin, level in zip(expected, filtered_levels(in_bricks(volume), frame, spacings), strict=True):
            assert isinstance(level.values, kind)
            assert level.spacing == twin.spacing
            cells, all_cells = level.dense(), twin.dense()
            # Levels in bricks begin earlier and end later, with zeros.
            before = twin.first - level.first
            assert before.min() >= 0
            inner = tuple(slice(b, b + n) for b, n in zip(before[::-1], all_cells.shape, strict=True))
            np.testing.assert_allclose(cells[inner], all_cells, atol=1e-6 * all_cells.max())
            assert cells.sum(dtype=np.float64) == pytest.approx(cells[inner].sum(dtype=np.float64), rel=1e-12)


@pytest.mark.parametrize("size", [3.0, 60.0])
def test_stencils_agree(size: float, monkeypatch: pytest.MonkeyPatch) -> None:
    volume, n = lumps((40, 33, 47)), 300
    scale = size / (4.7 * mean_extinction(volume))
    rng = np.random.default_rng(10)
    w, sun = rng.normal(size=(2, n, 3))
    w, sun = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (w, sun))
    points = points_in(volume, n, 11)
    expected = Descriptor(Field(types, volume, scale)).stencils_numpy(points, w, sun)
    for most in (0, 1 << 24):
        monkeypatch.setattr(pyramid, "_MOST_DENSE_CELLS", most)
        found = Descriptor(Field(types, in_bricks(volume), scale)).stencils_numpy(points, w, sun)
        # Cells in bricks are counted from elsewhere, which rounds the places in them differently.
        np.testing.assert_allclose(found, expected, atol=1e-4 * expected.max())
        assert np.abs(found - expected).mean() < 1e-5 * expected.mean()


def test_what_needs_the_whole_grid_says_when_it_does_not_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    sparse = in_bricks(lumps((16, 8, 24)))
    monkeypatch.setattr(sparse_module, "MAX_VOXELS", 16 * 8 * 24 - 1)
    with pytest.raises(InputError, match="24 x 8 x 16 voxels is needed whole"):
        _ = sparse.density


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0])
def test_bricks_are_checked_as_grids_are(bad: float) -> None:
    bricks = Bricks.from_dense(lumps((16, 8, 24)).density)
    values = bricks.values.copy()
    values[0, 1, 2, 3] = bad
    with pytest.raises(InputError, match="holds 1"):
        SparseVolume(Bricks(bricks.shape, bricks.places, values), np.eye(4))


def test_the_memory_that_is_told_is_what_a_field_takes() -> None:
    volume = lumps((150, 133, 147))
    dense, sparse = Field(types, volume), Field(types, in_bricks(volume))
    assert dense.nbytes == pytest.approx(field_bytes(volume.density.size), rel=0.05)
    kept = len(in_bricks(volume).bricks.places)
    # With so few bricks their surface counts for more than in a large cloud.
    assert 0.7 < sparse.nbytes / field_bytes(volume.density.size, kept) < 1.5
    assert sparse.nbytes < 0.1 * dense.nbytes


def test_bricks_that_hold_nothing() -> None:
    empty = SparseVolume(Bricks((20, 30, 40), np.zeros((0, 3), np.int32), np.zeros((0, 8, 8, 8), np.float32)), np.eye(4))
    field = Field(types, empty, 3.0)
    assert field.majorant == 0
    points = np.random.default_rng(13).uniform(-0.2, 1.2, (100, 3))
    assert not np.array(field.sigma_t(vectors_of(types, points))).any()
    assert mean_extinction(empty) == 0
    assert len(empty.row_ends(0.0)[0]) == 0
    w = np.broadcast_to([0.0, 0.6, 0.8], points.shape)
    assert not Descriptor(field).stencils_numpy(points, w, w[:, ::-1]).any()
