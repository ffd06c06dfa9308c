"""Rationale: a film is many frames, often rendered in parts by several machines, and no frame's own scale or box may show in it.

Expected behaviour: extinction, unit of length, filter and camera are the same in all frames, whichever are asked for; a turntable turns the
camera alone; frames that are there are left out, unless they were not finished; what is missing is said before anything is rendered.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from deepclouds_runtime import predictor
from deepclouds_runtime.key_frames import fixed_by, with_extinction
from deepclouds_runtime.loading import load
from deepclouds_runtime.octree import lattice_around
from deepclouds_runtime.renderer import Renderer
from deepclouds_runtime.turntable import Turntable, rotation
from deepclouds_runtime.volume_scene import VolumeOptions, framed_corners, options_from, pivot
from numpy.typing import NDArray

from deepclouds.cli import main
from deepclouds.errors import InputError
from deepclouds.exr import read_exr
from deepclouds.volume import Volume, read_vol, write_vdb, write_vol
from deepclouds.volume.pyramid import mean_extinction

EMPTY = Path(__file__).parents[1] / "unit" / "data" / "empty.vdb"
SIZE = ["--size", "16x12", "--spp", "2", "--unbiased", "--quiet"]


@pytest.fixture(autouse=True)
def mi(llvm_mitsuba: ModuleType) -> ModuleType:
    return llvm_mitsuba


def _ball(radius: float, padding: int = 0) -> Volume:
    """A ball, of density that grows with its radius, in voxels of 0.1; `padding` empty voxels on one side of each axis."""
    c = (np.arange(20) - 9.5) / 10
    z, y, x = np.meshgrid(c, c, c, indexing="ij")
    density = np.clip(5 * (radius - np.sqrt(x * x + y * y + 1.5 * z * z)), 0, 1) * radius * (1.2 + x)
    density = np.pad(density, [(padding, 0)] * 3).astype(np.float32)
    return Volume.from_box(density, [-1 - 0.1 * padding] * 3, [1, 1, 1])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for frame, radius in ((1, 0.3), (2, 0.5), (3, 0.8)):
        write_vol(tmp_path / f"puff_{frame:04d}.vol", _ball(radius))
    return tmp_path


def _settings(path: Path) -> dict[str, Any]:
    settings: dict[str, Any] = json.loads(str(read_exr(path).attributes["deepclouds"]))
    return settings


def test_a_sequence_keeps_scale_and_camera(folder: Path) -> None:
    assert main(["render", str(folder / "puff_####.vol"), "-o", str(folder / "all.exr"), *SIZE]) == 0
    images = [read_exr(folder / f"all.000{frame}.exr").channels for frame in (1, 2, 3)]
    settings = [_settings(folder / f"all.000{frame}.exr") for frame in (1, 2, 3)]
    assert [s["frame"] for s in settings] == [1, 2, 3]
    for name in ("extinction", "camera", "size"):
        assert settings[0][name] == settings[1][name] == settings[2][name], name
    # A puff that grows looks so.
    cover = [image["volume_opacity"].mean() for image in images]
    assert cover[0] < 0.7 * cover[1] < 0.7 * 0.7 * cover[2]
    # A part of the job gives the same images.
    assert main(["render", str(folder), "-o", str(folder / "part_##.exr"), "--frames", "2", *SIZE]) == 0
    np.testing.assert_array_equal(read_exr(folder / "part_02.exr").channels["R"], images[1]["R"])
    assert not (folder / "part_01.exr").exists()


def test_what_is_fixed_is_that_of_the_key_frames(folder: Path) -> None:
    files = [folder / f"puff_000{frame}.vol" for frame in (1, 2, 3)]
    volumes = [read_vol(file) for file in files]
    fixed = fixed_by(files, VolumeOptions(optical_depth=10.0))
    densest = max(float(v.density.sum(axis=2).max()) * 0.1 for v in volumes)
    assert fixed.extinction * densest == pytest.approx(10, rel=1e-5)
    squares, sums = (sum(float((v.density.astype(np.float64) ** n).sum()) for v in volumes) for n in (2, 1))
    assert 1 / fixed.unit == pytest.approx(fixed.extinction * squares / sums, rel=1e-5)
    # One frame alone is what it is without a sequence.
    alone = fixed_by(files[1:2], VolumeOptions(optical_depth=10.0))
    plain = load(files[1], unbiased=True, optical_depth=10.0, size=(8, 8))
    assert alone.extinction == plain.scene.scale
    assert alone.unit == pytest.approx(1 / (plain.scene.scale * mean_extinction(volumes[1])))
    within = load(files[1], unbiased=True, optical_depth=10.0, size=(8, 8), fixed=alone)
    np.testing.assert_array_equal(
        np.array(within.scene.sensor.world_transform().matrix), np.array(plain.scene.sensor.world_transform().matrix)
    )
    write_vol(folder / "puff_0001.vol", Volume.from_box(np.zeros((2, 2, 2), np.float32), (-1, -1, -1), (1, 1, 1)))
    assert fixed_by(files, VolumeOptions()).unit == pytest.approx(fixed_by(files[1:], VolumeOptions()).unit)
    with pytest.raises(InputError, match=r"puff_0001.vol: the frames that fix extinction and camera of the sequence are empty"):
        fixed_by(files[:1], VolumeOptions())
    assert with_extinction(VolumeOptions(optical_depth=10.0), fixed).optical_depth is None


def test_frames_without_a_voxel_do_not_count(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Nor do they stop the others: they show no cloud."""
    for frame, radius in ((1, None), (2, 0.5), (3, 0.8), (4, None), (5, None)):
        file = tmp_path / f"puff_{frame:04d}.vdb"
        if radius is None:
            file.write_bytes(EMPTY.read_bytes())
        else:
            write_vdb(file, _ball(radius))
    files = sorted(tmp_path.iterdir())
    some, whole = fixed_by(files, VolumeOptions()), fixed_by(files[1:3], VolumeOptions())
    assert (some.extinction, some.unit) == (whole.extinction, whole.unit)
    np.testing.assert_array_equal(some.corners, whole.corners)
    with pytest.raises(InputError, match=r"puff_0004.vdb, puff_0005.vdb: the frames that fix extinction .* are empty"):
        fixed_by(files[3:], VolumeOptions())
    arguments = ["render", str(tmp_path / "puff_%04d.vdb"), "-o", str(tmp_path / "f.exr"), "--frames", "1-4"]
    assert main([*arguments, *SIZE]) == 0
    cover = [read_exr(tmp_path / f"f.000{frame}.exr").channels["volume_opacity"].max() for frame in (1, 2, 3, 4)]
    assert cover[0] == cover[3] == 0
    assert min(cover[1:3]) > 0.9
    # Alone it is still refused.
    assert main(["render", str(files[0]), "-o", str(tmp_path / "alone.exr"), *SIZE]) == 2
    assert "is empty: it has no active voxel" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"optical_depth": 10.0, "extinction": 5.0}, "optical_depth and extinction are both given"),
        ({"optical_depth": -10.0}, "optical_depth = -10.0: give a finite number that is not negative"),
        ({"extinction": -1.0}, "extinction = -1.0: give a finite number that is not negative"),
    ],
)
def test_what_a_sequence_is_given_is_checked_as_for_one_file(folder: Path, options: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        fixed_by([folder / "puff_0001.vol"], VolumeOptions(**options))


def test_every_frame_asks_the_same_networks(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loaded: list[object] = []
    asked: list[tuple[object, bool]] = []

    class Released(Smooth):
        def __init__(self, model: object, threads: object) -> None:
            loaded.append(model)

    monkeypatch.setattr(predictor, "Predictor", Released)
    whole = Renderer.render

    def render(self: Renderer, *arguments: Any, correct: bool, **how: Any) -> Any:
        assert correct
        asked.append((self.predictor, self._quicker is not None))
        return whole(self, *arguments, **how)

    monkeypatch.setattr(Renderer, "render", render)
    files = [str(folder / "puff_####.vol"), "-o", str(folder / "f.exr")]
    assert main(["render", *files, "--size", "16x12", "--spp", "1", "--correct", "--quiet"]) == 0
    assert asked == [(asked[0][0], True)] * 3
    assert loaded == [None, predictor.RELEASED[-1]]


def test_a_small_puff_is_asked_about_as_the_cloud_that_it_becomes(tmp_path: Path) -> None:
    """Its box alone is too small for the model; a film that went over from paths to the network would flicker."""
    for number, (side, density) in enumerate([(0.02, 1.0), (1.0, 1.0), (2.0, 1.0)], 1):
        write_vol(tmp_path / f"c_{number}.vol", Volume.from_box(np.full((4, 4, 4), density, np.float32), (-side,) * 3, (side,) * 3))
    files = [tmp_path / f"c_{number}.vol" for number in (1, 2, 3)]
    options: dict[str, Any] = {"extinction": 10.0, "size": (16, 12)}
    alone = load(files[0], **options)
    assert alone.model_hash is None
    assert "not trained for a cloud of" in alone.notes[-1]
    fixed = fixed_by(files, options_from(options))
    for file in files:
        renderer = load(file, fixed=fixed, **options)
        assert renderer.model_hash is not None
        assert not renderer.traces(False)


class Smooth:
    """Stands in for a network, and moves with what the filter sees."""

    def predict(self, stencil: NDArray[np.float32], aux: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return j (n,)."""
        value: NDArray[np.float32] = ((0.3 + stencil.mean(axis=(1, 2))) * np.exp(-0.5 * aux[:, 5])).astype(np.float32)
        return value


def test_a_box_that_grows_around_a_cloud_changes_nothing(tmp_path: Path) -> None:
    """Nodes and filter stay where they are in the world, so that interpolation errs alike in every frame."""
    files = []
    for padding in (0, 3, 7):
        files.append(tmp_path / f"ball_{padding}.vol")
        write_vol(files[-1], _ball(0.8, padding))
    # Coarse nodes, which err by 4 % at a point: where they moved with the box, images would differ by 3 %.
    fixed = fixed_by(files, VolumeOptions())
    fixed = replace(fixed, unit=4 * fixed.unit)
    images = [
        load(f, predictor=Smooth(), size=(64, 48), sky=0.0, fixed=fixed).render(4, seed=1).channels["volume_indirect.R"] for f in files
    ]
    for image in images[1:]:
        assert np.sqrt(np.mean((image - images[0]) ** 2)) < 1e-2 * images[0].mean()


def test_a_lattice_with_an_anchor_stands_still() -> None:
    axes, anchor = np.eye(3), np.array([0.3, 0.1, -0.2])
    rng = np.random.default_rng(5)
    for _ in range(50):
        corner, lengths = rng.uniform(-3, 0, 3), rng.uniform(2, 8, 3)
        lattice = lattice_around(lengths, corner, axes, 0.7, anchor)
        assert lattice.spacing == 0.7
        cells = (lattice.origin - anchor) / 0.7
        np.testing.assert_allclose(cells, np.rint(cells), atol=1e-9)
        assert np.all(lattice.local(corner[None]) >= -1e-5)
        assert np.all(lattice.local((corner + lengths)[None]) <= lattice.size + 1e-5)
        assert np.all(lattice.local(corner[None]) < 1)
    # Limits move the edge by powers of two.
    assert lattice_around(np.array([100.0, 1, 1]), np.zeros(3), axes, 0.7, anchor).spacing == pytest.approx(2.8)
    assert lattice_around(np.array([1.0, 1, 1]), np.zeros(3), axes, 0.7, anchor).spacing == pytest.approx(0.35)


@pytest.mark.parametrize(("up", "first", "second"), [("y", (0, 0, 1), (1, 0, 0)), ("z", (1, 0, 0), (0, 1, 0))])
def test_a_turn_goes_the_way_azimuths_grow(up: str, first: tuple[int, ...], second: tuple[int, ...]) -> None:
    middle = np.array([1.0, 2.0, 3.0])
    matrix = rotation(middle, up, 90)
    np.testing.assert_allclose(matrix @ [*(middle + first), 1], [*(middle + second), 1], atol=1e-12)
    np.testing.assert_allclose(matrix @ [*middle, 1], [*middle, 1], atol=1e-12)


@pytest.mark.parametrize("up", ["y", "z"])
def test_frames_of_a_turn_are_the_views_of_their_azimuths(folder: Path, up: str) -> None:
    path = folder / "puff_0003.vol"
    turned = load(path, unbiased=True, size=(16, 12), view=(20, 10), up=up, turn=4)
    table = Turntable(turned.scene.sensor, 4, pivot(framed_corners(turned.scene.volume), up), up)
    for frame in (1, 2, 4):
        table.turn(frame)
        there = load(path, unbiased=True, size=(16, 12), view=(20 + 90 * (frame - 1), 10), up=up, turn=4)
        np.testing.assert_allclose(
            np.array(turned.scene.sensor.world_transform().matrix), np.array(there.scene.sensor.world_transform().matrix), atol=1e-5
        )
        np.testing.assert_allclose(turned.render(1, seed=1).alpha, there.render(1, seed=1).alpha, atol=2e-2)


def test_a_turntable_keeps_the_cloud_in_the_picture(folder: Path) -> None:
    arguments = ["render", str(folder / "puff_0003.vol"), "-o", str(folder / "turn_%02d.exr"), "--turntable", "5", "--png"]
    assert main([*arguments, "--size", "32x24", *SIZE[2:]]) == 0
    assert sorted(p.name for p in folder.glob("turn_*.exr")) == [f"turn_0{i}.exr" for i in range(1, 6)]
    assert len(list(folder.glob("turn_*.png"))) == 5
    images = [read_exr(folder / f"turn_0{i}.exr").channels for i in range(1, 6)]
    for image in images:
        opacity = image["volume_opacity"]
        assert opacity.max() > 0.9
        # What is thinner than a small share of the densest voxel is not framed (`volume_scene._FRAMED`), and may be met at an edge.
        assert max(opacity[0].max(), opacity[-1].max(), opacity[:, 0].max(), opacity[:, -1].max()) < 1e-4
    assert not np.allclose(images[0]["R"], images[1]["R"], rtol=0.1)


def test_a_scene_turns_around_its_cloud(folder: Path) -> None:
    (folder / "scene.xml").write_text(
        """<scene version="3.0.0">
      <sensor type="perspective"><float name="fov" value="40"/>
        <transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/><rfilter type="box"/></film></sensor>
      <emitter type="constant"/>
      <shape type="cube"><bsdf type="null"/><medium type="heterogeneous" name="interior"><float name="scale" value="5"/>
        <rgb name="albedo" value="0.5"/><volume type="gridvolume" name="sigma_t"><string name="filename" value="puff_0003.vol"/>
        <transform name="to_world"><translate x="-0.5" y="-0.5" z="-0.5"/><scale value="2"/></transform></volume></medium>
      </shape></scene>"""
    )
    arguments = [str(folder / "scene.xml"), "-o", str(folder / "o.exr"), "--turntable", "4", "--frames", "2-3", "--spp", "1", "--quiet"]
    assert main(["render", *arguments, "--unbiased"]) == 0
    places = [np.array(_settings(folder / f"o.000{frame}.exr")["camera"]["to_world"])[:3, 3] for frame in (2, 3)]
    middle = pivot(framed_corners(read_vol(folder / "puff_0003.vol")), "y")
    away = np.array([0, 0, 4]) - middle
    # A quarter and a half of a turn around the vertical through the cloud, from +Z by way of +X.
    np.testing.assert_allclose(places[0], middle + np.array([away[2], away[1], -away[0]]), atol=1e-4)
    np.testing.assert_allclose(places[1], middle + np.array([-away[0], away[1], -away[2]]), atol=1e-4)


def test_finished_frames_are_left_out(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["render", str(folder / "puff_%04d.vol"), "-o", str(folder / "f.exr"), *SIZE[:-1], "--skip-existing"]
    assert main([*arguments, "--frames", "1"]) == 0
    # What was interrupted, or cut short by a full disk, is rendered again.
    (folder / "f.0002.exr").write_bytes((folder / "f.0001.exr").read_bytes()[:200])
    stamp = (folder / "f.0001.exr").stat().st_mtime_ns
    capsys.readouterr()
    assert main(arguments) == 0
    printed = capsys.readouterr().out
    assert "f.0002.exr is not finished or cannot be read: it is rendered again" in printed
    assert "frame 2 (1 of 2)" in printed
    assert "frame 3 (2 of 2)" in printed
    assert (folder / "f.0001.exr").stat().st_mtime_ns == stamp
    assert main(arguments) == 0
    assert capsys.readouterr().out == "every frame is there already\n"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["{folder}/puff_%04d.vol", "--frames", "2-5"], "2 frames (4, 5) are missing; there are 1-3"),
        (["{folder}/puff_%04d.vol", "--frames", "3-2"], "holds no frame"),
        (["{folder}/puff_0001.vol", "--frames", "1"], "is one file, so --frames has no meaning; write %04d or ####"),
        (["{folder}/puff_%04d.vol", "--turntable", "4"], "goes round a cloud that stands still"),
        (["{folder}/puff_0001.vol", "--turntable", "4", "--frames", "1-5"], "frame 5 is none of the 4 of the turn"),
        (["{folder}/puff_0001.vol", "--turntable", "0"], "'0' is not a whole number above 0"),
        (["{folder}/puff_0001.vol", "--unit", "0"], "unit = 0: give a length in world units"),
        (["{folder}/puff_0001.vol", "--progressive", "soon"], "'soon' is not a number of seconds"),
        (["{folder}/smoke_%04d.vol"], "no such file, whatever the number of the frame"),
        (["{folder}/puff_0001.vol", "{folder}/nothing_0002.vol"], "nothing_0002.vol: no such file"),
    ],
)
def test_what_cannot_be_done_is_said_before_anything_is_rendered(
    folder: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], said: str
) -> None:
    before = sorted(folder.iterdir())
    try:
        code: object = main(["render", *(a.format(folder=folder) for a in arguments), "-o", str(folder / "o.exr"), *SIZE])
    except SystemExit as stop:
        code = stop.code
    assert code == 2
    assert said in capsys.readouterr().err
    assert sorted(folder.iterdir()) == before
