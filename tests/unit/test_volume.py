"""The density field: what it accepts, where its samples lie, and that every file format and Mitsuba agree on that."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from numpy.typing import NDArray

from deepclouds.errors import InputError
from deepclouds.volume import Volume, read_volume, write_vdb, write_vol


def lopsided(rotated: bool = False) -> Volume:
    """A volume that no mirroring, swap of axes or shift maps to itself; no sample is 0, so that nothing is cropped."""
    density = np.random.default_rng(7).uniform(0.1, 2.0, (3, 4, 5)).astype(np.float32)
    volume = Volume.from_box(density, (-1.0, 2.0, 0.5), (1.5, 4.4, 5.0))
    if not rotated:
        return volume
    c, s = np.cos(0.6), np.sin(0.6)
    turn = np.array([[c, -s, 0, 1], [s, c, 0, -2], [0, 0, 1, 3], [0, 0, 0, 1]])
    tilt = np.array([[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1]])
    return Volume(density, turn @ tilt @ volume.to_world)


def points_around(volume: Volume, count: int, seed: int) -> NDArray[np.float64]:
    """World points in and a little outside the box, none within 1e-3 of the unit cube's faces, where rounding decides."""
    unit = np.random.default_rng(seed).uniform(-0.2, 1.2, (count, 3))
    unit = unit[np.all(np.minimum(np.abs(unit), np.abs(unit - 1)) > 1e-3, axis=1)]
    return unit @ volume.to_world[:3, :3].T + volume.to_world[:3, 3]


@pytest.mark.parametrize(
    ("density", "message"),
    [
        (np.zeros((2, 2)), "three axes"),
        (np.zeros((0, 2, 2)), "at least one sample"),
        (np.full((1, 1, 1), np.nan), "1 NaN"),
        (np.full((1, 2, 1), -1.0), "2 negative"),
    ],
)
def test_refuses_what_is_no_density(density: NDArray[np.float64], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Volume.from_box(density, (0, 0, 0), (1, 1, 1))


@pytest.mark.parametrize("matrix", [np.zeros((4, 4)), np.diag([1.0, 1, 0, 1]), np.diag([1.0, 1, 1, 2]), np.full((4, 4), np.inf), np.eye(3)])
def test_refuses_what_is_no_transform(matrix: NDArray[np.float64]) -> None:
    with pytest.raises(InputError, match="to_world"):
        Volume(np.ones((1, 1, 1), np.float32), matrix)


def test_samples_lie_at_cell_centres_of_the_box() -> None:
    volume = lopsided()
    assert volume.resolution == (5, 4, 3)
    np.testing.assert_allclose(volume.voxel_size, (0.5, 0.6, 1.5))
    for k, j, i in np.ndindex(3, 4, 5):
        centre = np.array([-1.0, 2.0, 0.5]) + (np.array([i, j, k]) + 0.5) * (0.5, 0.6, 1.5)
        assert volume.sample(centre[None])[0] == pytest.approx(volume.density[k, j, i], rel=1e-6)


def test_constant_in_the_outer_half_voxel_and_zero_outside() -> None:
    volume = lopsided()
    y, z = 2.0 + 0.5 * 0.6, 0.5 + 0.5 * 1.5
    inside, edge, outside = volume.sample([[-0.75, y, z], [-0.999, y, z], [-1.001, y, z]])
    assert inside == edge == pytest.approx(volume.density[0, 0, 0])
    assert outside == 0


def test_linear_fields_are_reproduced_between_the_centres() -> None:
    k, j, i = np.meshgrid(np.arange(6), np.arange(5), np.arange(4), indexing="ij")
    volume = Volume.from_box(1 + 0.5 * i + 0.25 * j + 2 * k, (0, 0, 0), (4, 5, 6))
    p = np.random.default_rng(3).uniform(0.5, (3.5, 4.5, 5.5), (50, 3))
    np.testing.assert_allclose(volume.sample(p), 1 + 0.5 * (p[:, 0] - 0.5) + 0.25 * (p[:, 1] - 0.5) + 2 * (p[:, 2] - 0.5), rtol=1e-6)


def test_bounds_of_a_rotated_volume_enclose_it_tightly() -> None:
    volume = lopsided(rotated=True)
    lower, upper = volume.bounds
    corners = np.array(list(np.ndindex(2, 2, 2))) @ volume.to_world[:3, :3].T + volume.to_world[:3, 3]
    np.testing.assert_allclose(lower, corners.min(axis=0))
    np.testing.assert_allclose(upper, corners.max(axis=0))


@pytest.mark.parametrize("suffix", [".vdb", ".vol"])
def test_a_file_gives_back_the_same_field_at_the_same_place(tmp_path: Path, suffix: str) -> None:
    volume = lopsided()
    file = tmp_path / f"field{suffix}"
    (write_vdb if suffix == ".vdb" else write_vol)(file, volume)
    again = read_volume(file)
    np.testing.assert_array_equal(again.density, volume.density)
    np.testing.assert_allclose(again.to_world, volume.to_world, atol=1e-6)
    p = points_around(volume, 400, seed=1)
    np.testing.assert_allclose(again.sample(p), volume.sample(p), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("way", ["array", ".vdb", ".vol"])
def test_mitsuba_sees_the_same_field(tmp_path: Path, scalar_mitsuba: ModuleType, way: str) -> None:
    """Rationale: half a voxel of shift looks plausible in every picture.

    Expected: Mitsuba's gridvolume, given our array and transform (also after a trip through a .vdb), or our .vol file in its own
    box, has inside the box the value of Volume.sample at every point.
    """
    mi = scalar_mitsuba
    volume = lopsided(rotated=way != ".vol")
    plugin: dict[str, object] = {"type": "gridvolume", "filter_type": "trilinear", "wrap_mode": "clamp", "raw": True}
    if way == ".vol":
        write_vol(tmp_path / "field.vol", volume)
        plugin |= {"filename": str(tmp_path / "field.vol"), "use_grid_bbox": True}
    else:
        read = volume
        if way == ".vdb":
            write_vdb(tmp_path / "field.vdb", volume)
            read = read_volume(tmp_path / "field.vdb")
        plugin |= {"grid": mi.VolumeGrid(read.density[..., None].copy()), "to_world": mi.ScalarTransform4f(read.to_world)}
    grid = mi.load_dict(plugin)
    points = points_around(volume, 300, seed=2)
    ours = volume.sample(points)
    inside = ours > 0
    assert inside.sum() > 50
    assert (~inside).sum() > 50
    theirs = []
    for p in points[inside]:
        interaction = mi.Interaction3f()
        interaction.p = mi.Point3f(*p)
        theirs.append(grid.eval_1(interaction))
    np.testing.assert_allclose(theirs, ours[inside], rtol=2e-5)


def test_read_volume_refuses_other_suffixes_and_names_in_vol_files(tmp_path: Path) -> None:
    write_vol(tmp_path / "a.vol", lopsided())
    with pytest.raises(InputError, match=r"\.vdb and \.vol"):
        read_volume(tmp_path / "a.nvdb")
    with pytest.raises(InputError, match="without a name"):
        read_volume(tmp_path / "a.vol", grid="density")
