"""Every flag of `deepclouds render CLOUD.vdb`: a good value shows in the image, a bad one ends in code 2 and says what to do.

Rationale: a flag that is parsed and then forgotten is found by nobody who looks at one picture; a bad value that is clipped in silence
is found too late. Expected behaviour: as said, for each flag that the parser knows.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

import deepclouds_runtime
import numpy as np
import pytest
from deepclouds_runtime import _job
from deepclouds_runtime._command import _parser
from deepclouds_runtime.renderer import Renderer
from numpy.typing import NDArray

from deepclouds.cli import main
from deepclouds.errors import InputError
from deepclouds.exr import read_exr, write_exr
from deepclouds.volume import Volume, write_vol

CLOUD = Path(deepclouds_runtime.__file__).parent / "data" / "demo.vdb"
# Values that change the image.
CHANGING = {
    "--spp": ["3"],
    "--seed": ["7"],
    "--max-depth": ["2"],
    "--hide-emitters": [],
    "--env-directions": ["5"],
    "--optical-depth": ["20"],
    "--extinction": ["3"],
    "--albedo": ["0.9,0.8,0.7"],
    "--g": ["-0.3"],
    "--phase": ["0.8,-0.2,0.7"],
    "--sun": ["-40,20"],
    "--irradiance": ["1,2,3"],
    "--sun-diameter": ["30"],
    "--env": ["{folder}/sky.exr"],
    "--sky": ["0.3,0.2,0.1"],
    "--up": ["z"],
    "--view": ["-30,-20"],
    "--size": ["20x12"],
}
# Values that do not: they choose how, name what is chosen anyway, or concern surfaces and files that this cloud does not have.
KEEPING = {
    "--threads": ["2"],
    "--variant": ["llvm_ad_rgb"],
    "--quiet": [],
    "--grid": ["density"],
    "--clamp": [],
    "--ignore-emission": [],
    "--no-interreflection": [],
    "--png": ["{folder}/other.png"],
    "--exposure": ["1"],
    "--progressive": ["0"],
    "--unit": ["0.01"],
    "--skip-existing": [],
}
# Not for every volume, or a choice of the network, which has tests of its own.
ELSEWHERE = {
    "--output",
    "--sensor",
    "--model",
    "--help",
    "-D",
    "--mode",
    "--exact-orders",
    "--unbiased",
    "--error",
    "--albedo-grid",
    "--extrapolate",
    "--frames",
    "--turntable",
    "--audit",
    "--no-correct",
    "--time",
}


@pytest.fixture(autouse=True)
def mi(llvm_mitsuba: ModuleType) -> ModuleType:
    return llvm_mitsuba


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_exr(tmp_path / "sky.exr", {c: np.linspace(0, 1, 32, dtype=np.float32).reshape(4, 8) for c in "RGB"})
    (tmp_path / "text.exr").write_text("no image")
    write_vol(tmp_path / "empty.vol", Volume.from_box(np.zeros((2, 2, 2), np.float32), (0, 0, 0), (1, 1, 1)))
    return tmp_path


def _render(folder: Path, arguments: Sequence[str]) -> NDArray[np.float32]:
    out = folder / "image.exr"
    fixed = ["render", str(CLOUD), "-o", str(out), "--unbiased", "--size", "16x12", "--spp", "1"]
    assert main([*fixed, *(a.format(folder=folder) for a in arguments)]) == 0
    channels = read_exr(out).channels
    return np.stack([channels[c] for c in "RGBA"], axis=-1)


def test_every_flag_is_tried() -> None:
    flags = {option.option_strings[-1] for option in _parser("deepclouds render")._actions if option.option_strings}
    assert flags <= set(CHANGING) | set(KEEPING) | ELSEWHERE
    assert set(CHANGING) | set(KEEPING) <= flags


def test_good_values_show(folder: Path) -> None:
    plain = _render(folder, [])
    assert np.array_equal(plain, _render(folder, []))
    for flag, values in CHANGING.items():
        image = _render(folder, [flag, *values])
        assert image.shape != plain.shape or not np.allclose(image, plain, rtol=1e-4), flag
    for flag, values in KEEPING.items():
        np.testing.assert_allclose(_render(folder, [flag, *values]), plain, rtol=1e-5, err_msg=flag)
    assert (folder / "other.png").is_file()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--spp", "0"], "--spp: '0' is not a whole number above 0"),
        (["--spp", "1.5"], "--spp: '1.5' is not a whole number above 0"),
        (["--seed", "-1"], "--seed: '-1' is not a whole number"),
        (["--seed", "4294967296"], "--seed: '4294967296' is not a whole number below 4294967296"),
        (["--max-depth", "3"], "max_depth = 3: deepclouds renders all orders of scattering (-1) or single scattering alone (2)"),
        (["--max-depth", "deep"], "--max-depth: invalid int value: 'deep'"),
        (["--env-directions", "0"], "--env-directions: '0' is not a whole number above 0"),
        (["--optical-depth", "inf"], "optical_depth = inf: give a finite number"),
        (["--optical-depth", "1e20"], "optical_depth = 1e+20: give at most"),
        (["--extinction", "-1"], "extinction = -1.0: give a finite number that is not negative"),
        (["--albedo", "white"], "--albedo: 'white' is not 1 or 3 numbers"),
        (["--albedo", "nan"], "albedo = (nan,): give one or three finite numbers"),
        (["--albedo", "1,1,2"], "albedo = (1.0, 1.0, 2.0): values lie in 0 to 1"),
        (["--g", "-1"], "g = -1.0: give a value between -1 and 1"),
        (["--g", "nan"], "g = nan: give a value between -1 and 1"),
        (["--phase", "1,0,0.5"], "phase = (1.0, 0.0, 0.5): give g1 and g2 between -1 and 1"),
        (["--phase", "0.5,0"], "--phase: '0.5,0' is not 3 numbers"),
        (["--sun", "nan,0"], "sun = (nan, 0.0): give azimuth and elevation in degrees"),
        (["--sun", "1,2,3"], "--sun: '1,2,3' is not 2 numbers"),
        (["--irradiance", "inf"], "irradiance = (inf,): give one or three finite numbers"),
        (["--sun-diameter", "120"], "sun_diameter = 120.0: give an angle of 0 to 90 degrees"),
        (["--sky", "-1"], "sky = (-1.0,): give one or three finite numbers that are not negative"),
        (["--sky", "1e30"], "sky = (1e+30,): give values of at most 1e+15"),
        (["--env", "{folder}"], "no such environment map"),
        (["--env", "{folder}/text.exr"], "text.exr: not an environment map that Mitsuba reads; give a latitude-longitude .exr or .hdr"),
        (["--up", "x"], "--up: invalid choice: 'x' (choose from"),
        (["--view", "0,95"], "view = (0.0, 95.0): the elevation lies between -90 and 90 degrees"),
        (["--size", "0x4"], "--size: '0x4' is not WIDTHxHEIGHT"),
        (["--size", "-3x4"], "--size: '-3x4' is not WIDTHxHEIGHT"),
        (["--grid", "flames"], "no grid called 'flames'. Grids: density"),
        (["--sensor", "1"], "the option 'sensor' belongs to a scene"),
        (["-Dx=1"], "-Dx has no meaning for a volume"),
        (["--variant", "scalar_rgb"], "variant 'scalar_rgb': there are llvm_ad_rgb, llvm_ad_mono, cuda_ad_rgb, cuda_ad_mono"),
        (["--exact-orders", "0"], "--exact-orders: '0' is not a whole number above 0"),
        (["--exact-orders", "-2"], "--exact-orders: '-2' is not a whole number above 0"),
        (["--exact-orders", "2", "--unbiased"], "exact orders = 2: an unbiased render has all orders exact"),
        (["--unbiased", "--mode", "reference"], "mode = 'reference': an unbiased render asks no network"),
        (["--unbiased", "--model", "first"], "model = 'first': an unbiased render asks no network"),
        (["--unbiased", "--correct"], "an unbiased render asks no network that could be audited or corrected"),
        (["--exact-orders", "2", "--audit"], "exact orders = 2: the network is audited and corrected with 1 only"),
        (["--threads", "0"], "--threads: '0' is not a whole number above 0"),
        (["--exposure", "inf", "--png"], "exposure = inf: give stops between"),
        (["--png", "{folder}/x.jpg"], "x.jpg: the name must end in .png"),
        (["--png", "{folder}/nowhere/x.png"], "the folder {folder}/nowhere does not exist; create it first"),
        (["--output", "{folder}/x.png"], "x.png: the name must end in .exr"),
        (["--model", "{folder}"], "no such model file"),
        (["--mode", "reference", "--error", "0.1"], "--error 0.1: the reference mode takes the samples of --spp"),
    ],
)
def test_bad_values_end_in_code_2(folder: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], said: str) -> None:
    before = sorted(folder.iterdir())
    try:
        code: object = main(["render", str(CLOUD), "-o", str(folder / "image.exr"), *(a.format(folder=folder) for a in arguments)])
    except SystemExit as stop:
        code = stop.code
    assert code == 2
    printed = capsys.readouterr()
    assert said.format(folder=folder) in printed.err
    assert "Traceback" not in printed.err
    assert sorted(folder.iterdir()) == before


def test_an_empty_volume_has_no_optical_depth(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["render", str(folder / "empty.vol"), "-o", str(folder / "image.exr"), "--optical-depth", "5"]) == 2
    assert "empty.vol: the volume is empty, so no extinction gives it an optical depth of 5" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "taken", "locked", "said"),
    [
        ([], "image.exr", False, "image.exr is a folder; name a file"),
        (["--png"], "image.png", False, "image.png is a folder; name a file"),
        (["--turntable", "3"], "image.0002.exr", False, "image.0002.exr is a folder; name a file"),
        (["--turntable", "3", "--png"], "image.0003.png", False, "image.0003.png is a folder; name a file"),
        ([], None, True, "choose another folder or change its permissions"),
    ],
)
def test_files_that_cannot_be_written_are_refused_before_any_work(
    flags: list[str],
    taken: str | None,
    locked: bool,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def run(*arguments: object) -> int:
        raise AssertionError("nothing is rendered")

    monkeypatch.setattr(_job, "run", run)
    if taken is not None:
        (tmp_path / taken).mkdir()
    if locked:
        monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert main(["render", str(CLOUD), "-o", str(tmp_path / "image.exr"), *flags]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("suffix", [".exr", ".png"])
def test_a_full_disk_ends_in_code_2(suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / f".image.{os.getpid()}.tmp{suffix}").symlink_to("/dev/full")
    flags = ["--unbiased", "--size", "16x12", "--spp", "1", "--png", "--quiet"]
    assert main(["render", str(CLOUD), "-o", str(tmp_path / "image.exr"), *flags]) == 2
    assert f"image{suffix}: cannot be written (" in capsys.readouterr().err
    # The image is whole where the preview alone failed.
    assert sorted(p.name for p in tmp_path.iterdir()) == ([] if suffix == ".exr" else ["image.exr"])


@pytest.mark.parametrize(
    ("flags", "error"),
    [
        (["--turntable", "2"], _job.ERROR_OF_FRAMES),
        (["--turntable", "2", "--error", "0.1", "--time", "3"], 0.1),
        (["--turntable", "2", "--time", "3"], None),
        (["--turntable", "2", "--spp", "3"], None),
        ([], None),
    ],
)
def test_time_or_paths_alone_have_no_error_to_aim_at(
    flags: list[str], error: float | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Expected behaviour: frames among others aim at less noise, but all of the time is used, and all of the samples."""
    asked: list[object] = []

    def render(self: Renderer, *arguments: object, error: float | None = None, **how: object) -> None:
        asked.append(error)
        raise InputError("enough")

    monkeypatch.setattr(Renderer, "render", render)
    assert main(["render", str(CLOUD), "-o", str(tmp_path / "x.exr"), "--unbiased", "--size", "16x12", "--quiet", *flags]) == 2
    assert asked == [error]


@pytest.mark.parametrize(
    ("flags", "model"),
    [
        ([], None),
        (["--time", "1"], "fast"),
        (["--time", "3"], None),
        (["--time", "1", "--model", "accurate"], "accurate"),
        (["--time", "1", "--error", "0.01"], None),
        (["--time", "1", "--no-correct"], None),
        (["--time", "1", "--unbiased"], None),
    ],
)
def test_a_short_time_alone_picks_the_quick_model(
    flags: list[str], model: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Expected behaviour: only where walks correct what a short time allows, and nobody named a model."""
    loaded: list[object] = []

    def run(made: object, arguments: object, load: dict[str, object], record: object, say: object) -> int:
        loaded.append(load["model"])
        return 0

    monkeypatch.setattr(_job, "run", run)
    assert main(["render", str(CLOUD), "-o", str(tmp_path / "x.exr"), *flags]) == 0
    assert loaded == [model]
