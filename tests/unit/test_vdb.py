"""OpenVDB files: against files that OpenVDB wrote without us (data/make_fixtures.cpp), there and back, and what is refused."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from deepclouds.errors import InputError
from deepclouds.volume import Bricks, SparseVolume, Volume, _openvdb, list_grids, read_vdb, read_vol, write_vdb
from deepclouds.volume.vdb import read_vdb_values

DATA = Path(__file__).parent / "data"


def world(volume: Volume, indices: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """World positions of the centres of the samples (i, j, k)."""
    unit = (indices + 0.5) / np.array(volume.resolution)
    return np.asarray(unit @ volume.to_world[:3, :3].T + volume.to_world[:3, 3])


def test_active_tiles_are_read_and_counted() -> None:
    """Rationale: a reader that knows only leaves loses the inside of every cloud."""
    (grid,) = list_grids(DATA / "tiles.vdb")
    assert (grid.name, grid.value_type, grid.grid_class) == ("density", "float", "fog volume")
    assert grid.active_voxels == 24 * 16 * 40 + 1
    assert grid.index_box == ((-3, 0, 0), (23, 15, 50))
    assert grid.voxel_size == (0.5, 0.5, 0.5)
    volume = read_vdb(DATA / "tiles.vdb")
    expected = np.zeros((51, 16, 27), np.float32)
    expected[:40, :, 3:] = 3.0
    expected[50, 5, 0] = 0.25
    np.testing.assert_array_equal(volume.density, expected)
    # Voxel centres are integers times the voxel size, the box reaches half a voxel further.
    lower, upper = volume.bounds
    np.testing.assert_allclose(lower, (-1.75, -0.25, -0.25))
    np.testing.assert_allclose(upper, (11.75, 7.75, 25.25))


def test_rotated_non_uniform_half_grid_keeps_its_place() -> None:
    """Expected: the value that make_fixtures.cpp stores at index (i, j, k) is found at the world position of that index."""
    (grid,) = list_grids(DATA / "rotated.vdb")
    assert grid.half
    np.testing.assert_allclose(grid.voxel_size, (0.5, 1.0, 2.0))
    assert grid.index_to_world is not None
    c, s = np.cos(0.5), np.sin(0.5)
    expected = [[0.5 * c, -s, 0, 10], [0.5 * s, c, 0, 20], [0, 0, 2, 30], [0, 0, 0, 1]]
    np.testing.assert_allclose(grid.index_to_world, expected, atol=1e-12)
    volume = read_vdb(DATA / "rotated.vdb")
    for i, j, k in np.ndindex(3, 2, 4):
        stored = 1.0 + i + 10.0 * j + 100.0 * k
        centre = grid.index_to_world[:3, :3] @ (i + 5, j - 2, k + 1) + grid.index_to_world[:3, 3]
        assert volume.sample(centre[None])[0] == pytest.approx(stored, rel=1e-6)


def test_a_grid_is_chosen_by_name() -> None:
    several = DATA / "several.vdb"
    names = [g.unique_name for g in list_grids(several)]
    assert names == ["flames", "heat", "twin[0]", "twin[1]", "shared", "wind", "label"]
    assert [g.value_type for g in list_grids(several)] == ["float"] * 5 + ["vec3s", "int32"]
    assert read_vdb(several, "heat").density.item() == 2.0
    assert read_vdb(several, "twin[1]").density.item() == 4.0
    with pytest.raises(InputError, match=r"name the grid to read.*flames.*wind"):
        read_vdb(several)
    with pytest.raises(InputError, match="2 grids are called 'twin'"):
        read_vdb(several, "twin")
    with pytest.raises(InputError, match=r"no grid called 'smoke'.*flames"):
        read_vdb(several, "smoke")
    with pytest.raises(InputError, match="'wind' holds vec3s"):
        read_vdb(several, "wind")


@pytest.mark.parametrize(("name", "channels"), [("Cd", 3), ("grey", 1)])
def test_values_of_any_meaning_keep_their_place(name: str, channels: int) -> None:
    values, to_world = read_vdb_values(DATA / "painted.vdb", name)
    assert values.shape == (7, 9, 11, channels)
    z, y, x = np.indices(values.shape[:3]) + 0.5
    unit = np.stack([x / 11, y / 9, z / 7], axis=-1)
    world = unit @ to_world[:3, :3].T + to_world[:3, 3]
    expected = np.stack([0.2 + 0.3 * world[..., 0], 0.3 + 0.2 * world[..., 1], np.full(x.shape, 0.5)], axis=-1)
    np.testing.assert_allclose(values, expected[..., :channels], atol=1e-6)


def test_values_of_other_types_are_refused() -> None:
    with pytest.raises(InputError, match="'label' holds int32 values, not float or vec3s"):
        read_vdb_values(DATA / "several.vdb", "label")
    with pytest.raises(InputError, match="no grid called 'smoke'"):
        read_vdb_values(DATA / "several.vdb", "smoke")


def test_a_grid_that_shares_its_voxels_has_its_own_place() -> None:
    flames, shared = read_vdb(DATA / "several.vdb", "flames"), read_vdb(DATA / "several.vdb", "shared")
    assert flames.density.item() == shared.density.item() == 1.0
    np.testing.assert_allclose(flames.bounds[0], (0.5, 1.5, 2.5))
    np.testing.assert_allclose(shared.bounds[0], (1.0, 3.0, 5.0))


def test_an_unknown_grid_type_does_not_hide_the_others() -> None:
    odd, density = list_grids(DATA / "unknown_type.vdb")
    assert (odd.name, odd.value_type, odd.index_to_world) == ("odd", "Tree_float_5_4_2", None)
    assert density.active_voxels == 1
    assert read_vdb(DATA / "unknown_type.vdb").density.item() == 7.0
    with pytest.raises(InputError, match="Tree_float_5_4_2"):
        read_vdb(DATA / "unknown_type.vdb", "odd")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("frustum.vdb", "NonlinearFrustumMap.*not affine"),
        ("level_set.vdb", "level set"),
        ("background.vdb", "background value 0.5"),
        ("empty.vdb", "no active voxel"),
    ],
)
def test_refuses_what_is_no_fog_volume(name: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as error:
        read_vdb(DATA / name)
    assert name in str(error.value)
    assert len(list_grids(DATA / name)) == 1


def test_refuses_folders_missing_and_foreign_files(tmp_path: Path) -> None:
    for read in (read_vdb, list_grids):
        with pytest.raises(InputError, match="folder"):
            read(tmp_path)
        with pytest.raises(InputError, match="no such file"):
            read(tmp_path / "none.vdb")
        (tmp_path / "text.vdb").write_text("this is not a volume, though it is long enough to have a header of some kind")
        with pytest.raises(InputError, match="not a readable OpenVDB file"):
            read(tmp_path / "text.vdb")


@pytest.mark.parametrize("name", ["tiles.vdb", "several.vdb"])
def test_every_truncation_is_noticed(tmp_path: Path, name: str) -> None:
    """Rationale: OpenVDB itself reads zeros beyond the end of a file."""
    whole = (DATA / name).read_bytes()
    file = tmp_path / name
    for length in np.linspace(0, len(whole) - 1, 40).astype(int):
        file.write_bytes(whole[:length])
        with pytest.raises(InputError, match=str(file)):
            list_grids(file)


def test_flipped_bytes_never_end_the_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Expected: either the damage is noticed, or only values have changed and a volume comes out."""
    monkeypatch.setattr("deepclouds.volume.vdb.MAX_VOXELS", 10**7)
    write_vdb(tmp_path / "a.vdb", Volume.from_box(np.random.default_rng(5).uniform(1, 2, (9, 10, 11)), (0, 0, 0), (1, 1, 1)))
    whole = (tmp_path / "a.vdb").read_bytes()
    rng = np.random.default_rng(6)
    noticed = 0
    # Behind the metadata: a damaged length of a text costs seconds and memory before the end of the file is met.
    start = whole.index(b"is_saved_as_half_float")
    for position in rng.integers(start, min(len(whole), start + 2000), 60):
        damaged = bytearray(whole)
        damaged[position] ^= int(rng.integers(1, 256))
        (tmp_path / "b.vdb").write_bytes(damaged)
        try:
            read_vdb(tmp_path / "b.vdb", clamp=True)
        except InputError:
            noticed += 1
    assert noticed > 0


def test_a_changed_voxel_count_is_noticed(tmp_path: Path) -> None:
    """Rationale: the writer's own count is the only witness of voxels lost on the way."""
    content = (DATA / "tiles.vdb").read_bytes()
    count = (15361).to_bytes(8, "little")
    assert content.count(count) == 1
    (tmp_path / "a.vdb").write_bytes(content.replace(count, (15360).to_bytes(8, "little")))
    with pytest.raises(InputError, match="should have 15360 active voxels and has 15361"):
        read_vdb(tmp_path / "a.vdb")


@pytest.mark.parametrize("prune", [True, False])
def test_written_grids_come_back_cropped_to_what_is_not_zero(tmp_path: Path, prune: bool) -> None:
    density = np.zeros((40, 30, 20), np.float32)
    density[5:33, 4:26, 1:18] = 1.5
    density[7, 8, 9] = 0.125
    volume = Volume.from_box(density, (0, 0, 0), (20, 30, 40))
    write_vdb(tmp_path / "a.vdb", volume, prune=prune)
    again = read_vdb(tmp_path / "a.vdb")
    np.testing.assert_array_equal(again.density, density[5:33, 4:26, 1:18])
    np.testing.assert_allclose(np.concatenate(again.bounds), (1, 4, 5, 18, 26, 33), atol=1e-12)
    (grid,) = list_grids(tmp_path / "a.vdb")
    assert grid.active_voxels == np.count_nonzero(density) == grid.metadata["file_voxel_count"]


def test_pruning_makes_tiles_and_smaller_files(tmp_path: Path) -> None:
    volume = Volume.from_box(np.ones((64, 64, 64)), (0, 0, 0), (1, 1, 1))
    sizes = {}
    for prune in (True, False):
        write_vdb(tmp_path / "a.vdb", volume, prune=prune)
        sizes[prune] = (tmp_path / "a.vdb").stat().st_size
        np.testing.assert_array_equal(read_vdb(tmp_path / "a.vdb").density, volume.density)
    assert sizes[True] < sizes[False] / 2


def test_sheared_transform_name_metadata_and_half(tmp_path: Path) -> None:
    density = np.random.default_rng(8).uniform(0.5, 3, (4, 5, 6)).astype(np.float32)
    to_world = np.array([[2, 0.3, 0, 1], [0.1, 3, 0.2, -5], [0, 0.4, 1, 7], [0, 0, 0, 1]], np.float64)
    metadata: dict[str, str | int | float | bool] = {"author": "Zoë", "steps": 12, "scale": 0.5, "moist": True}
    write_vdb(tmp_path / "a.vdb", Volume(density, to_world), name="fog", half=True, metadata=metadata)
    (grid,) = list_grids(tmp_path / "a.vdb")
    assert grid.name == "fog"
    assert grid.half
    assert {key: grid.metadata[key] for key in metadata} == metadata
    again = read_vdb(tmp_path / "a.vdb", "fog")
    np.testing.assert_allclose(again.to_world, to_world, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(again.density, density.astype(np.float16).astype(np.float32))
    assert [p.name for p in tmp_path.iterdir()] == ["a.vdb"]


def test_refuses_to_write_what_cannot_be_kept(tmp_path: Path) -> None:
    large = Volume.from_box(np.full((1, 1, 1), 7e4), (0, 0, 0), (1, 1, 1))
    with pytest.raises(InputError, match="16 bits"):
        write_vdb(tmp_path / "a.vdb", large, half=True)
    with pytest.raises(InputError, match="metadata class"):
        write_vdb(tmp_path / "a.vdb", large, metadata={"class": "level set"})
    with pytest.raises(InputError, match="does not exist"):
        write_vdb(tmp_path / "none" / "a.vdb", large)
    assert not list(tmp_path.iterdir())


def test_negative_values_and_nan_are_counted_or_clamped(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"2 negative values and 1 NaN among 5 voxels; .*--clamp"):
        read_vdb(DATA / "no_density.vdb")
    np.testing.assert_array_equal(read_vdb(DATA / "no_density.vdb", clamp=True).density.ravel(), [2, 0, 0, 0, 1])
    infinite = np.array([[[2.0, np.inf]]], np.float32)
    _openvdb.write_dense(str(tmp_path / "b.vdb"), infinite, np.eye(4), "density", False, True, {})
    with pytest.raises(InputError, match="1 infinite"):
        read_vdb(tmp_path / "b.vdb", clamp=True)


def test_two_far_flung_voxels_do_not_fill_the_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("deepclouds.volume.vdb.MAX_VOXELS", 1000)
    shutil.copy(DATA / "tiles.vdb", tmp_path / "a.vdb")
    with pytest.raises(InputError, match="27 x 16 x 51 voxels, more than the 1000"):
        read_vdb(tmp_path / "a.vdb")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["smoke", "wdas_sixteenth"])
def test_public_volumes_agree_with_their_vol_twins(public_scenes: Path, name: str) -> None:
    """Expected: the .vol file holds the .vdb file's positive part with one empty voxel around it, in the unit cube."""
    vdb = read_vdb(public_scenes / "volumes" / f"{name}.vdb", clamp=True).density
    vol = read_vol(public_scenes / "volumes" / f"{name}.vol").density
    box = [slice(int(hit.min()), int(hit.max()) + 1) for hit in np.nonzero(vol)]
    positive = [slice(int(hit.min()), int(hit.max()) + 1) for hit in np.nonzero(vdb)]
    np.testing.assert_array_equal(vol[tuple(box)], vdb[tuple(positive)])


def test_bricks_hold_tiles(tmp_path: Path) -> None:
    """A solid block, which pruning turns into tiles, in a box that begins in the middle of a leaf."""
    density = np.zeros((70, 70, 70), np.float32)
    density[20:50, 16:61, 8:40] = 3
    density[3, 5, 7] = density[66, 62, 61] = 1
    write_vdb(tmp_path / "a.vdb", Volume.from_box(density, (0, 0, 0), (1, 1, 1)))
    dense, sparse = (read_vdb(tmp_path / "a.vdb", dense_voxels=most) for most in (70**3, 0))
    assert isinstance(sparse, SparseVolume)
    np.testing.assert_array_equal(dense.density, density[3:67, 5:63, 7:62])
    np.testing.assert_array_equal(sparse.density, dense.density)
    np.testing.assert_array_equal(sparse.to_world, dense.to_world)


def scattered() -> Volume:
    density = np.zeros((90, 61, 77), np.float32)
    rng = np.random.default_rng(9)
    for _ in range(5):
        z, y, x = (int(rng.integers(3, n - 9)) for n in density.shape)
        density[z : z + 7, y : y + 6, x : x + 8] = rng.random((7, 6, 8))
    return Volume.from_box(density, (-1, 2, 3), (4, 5, 9))


@pytest.mark.parametrize("half", [False, True])
def test_bricks_survive_a_file(half: bool, tmp_path: Path) -> None:
    """Written from bricks and from a dense grid: files that read as the same grid, in bricks whose corner is the box's."""
    volume = scattered()
    sparse = SparseVolume(Bricks.from_dense(volume.density), volume.to_world)
    write_vdb(tmp_path / "a.vdb", volume, half=half)
    write_vdb(tmp_path / "b.vdb", sparse, half=half)
    dense = read_vdb(tmp_path / "a.vdb")
    for name in ("a", "b"):
        again = read_vdb(tmp_path / f"{name}.vdb", dense_voxels=1000)
        assert isinstance(again, SparseVolume)
        assert again.bricks.values.any(axis=(1, 2, 3)).all()
        np.testing.assert_array_equal(again.density, dense.density)
        np.testing.assert_allclose(again.to_world, dense.to_world, rtol=1e-12)
        assert list_grids(tmp_path / f"{name}.vdb")[0].bricks == len(again.bricks.places)


def test_a_grid_that_is_mostly_filled_stays_dense(tmp_path: Path) -> None:
    density = np.random.default_rng(1).random((20, 20, 20)).astype(np.float32)
    write_vdb(tmp_path / "a.vdb", Volume.from_box(density, (0, 0, 0), (1, 1, 1)))
    assert type(read_vdb(tmp_path / "a.vdb", dense_voxels=0)) is Volume


def test_a_box_that_no_dense_grid_could_fill(tmp_path: Path) -> None:
    """Two voxels 3000 apart along each axis: two bricks; whoever needs the whole grid is told that it does not fit."""
    values = np.zeros((2, 8, 8, 8), np.float32)
    values[:, 0, 0, 0] = 2, 3
    ends = np.array([[0, 0, 0], [374, 375, 376]], np.int32)
    bricks = Bricks((3001, 3001, 3009), ends, values)
    write_vdb(tmp_path / "a.vdb", SparseVolume(bricks, np.diag([3009.0, 3001, 3001, 1])))
    again = read_vdb(tmp_path / "a.vdb")
    assert isinstance(again, SparseVolume)
    assert again.resolution == (3009, 3001, 2993)
    np.testing.assert_array_equal(again.bricks.places, ends)
    points = np.array([[0.5, 0.5, 0.5], [3008.5, 3000.5, 2992.5], [9, 9, 9]])
    np.testing.assert_array_equal(again.sample(points), [2, 3, 0])
    with pytest.raises(InputError, match="3009 x 3001 x 2993 voxels is needed whole"):
        _ = again.density


@pytest.mark.parametrize(("value", "match"), [(np.nan, "1 NaN"), (-1.0, "1 negative"), (np.inf, "1 infinite")])
def test_bad_values_in_bricks_are_found(value: float, match: str, tmp_path: Path) -> None:
    values = np.zeros((2, 8, 8, 8), np.float32)
    values[:, 0, 0, 0] = 2, value
    volume = SparseVolume(Bricks((80, 80, 80), np.array([[0, 0, 0], [9, 9, 9]], np.int32), np.ones_like(values)), np.eye(4))
    # What no volume may hold is put into the file behind its back.
    object.__setattr__(volume, "bricks", Bricks((80, 80, 80), volume.bricks.places, values))
    write_vdb(tmp_path / "a.vdb", volume)
    with pytest.raises(InputError, match=match):
        read_vdb(tmp_path / "a.vdb", dense_voxels=0)
    if not np.isinf(value):
        np.testing.assert_array_equal(read_vdb(tmp_path / "a.vdb", clamp=True, dense_voxels=0).stored.sum(), 2)
