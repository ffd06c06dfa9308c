"""Rationale: a second grid of a .vdb file can be the albedo; it has to lie where the file has it, in its own colours.

Expected behaviour: single scattering of an opaque cloud shows the albedo at its surface, channel by channel; with all orders a darker side
stays darker; what does not fit is refused with exit code 2.
"""

from __future__ import annotations

import json
import logging
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from deepclouds_runtime._mitsuba import mitsuba
from deepclouds_runtime.loading import load
from deepclouds_runtime.renderer import _say_nothing_to_audit
from numpy.typing import NDArray

from deepclouds.cli import main
from deepclouds.exr import read_exr
from deepclouds.volume import Volume, write_vol

# Density in 16 x 12 x 8 voxels of 1/8; albedo (0.2 + 0.3 x, 0.3 + 0.2 y, 0.5) on voxels of 1/4, and its red part as `grey`.
PAINTED = Path(__file__).parents[1] / "unit" / "data" / "painted.vdb"


@pytest.fixture(autouse=True)
def mi(llvm_mitsuba: ModuleType) -> ModuleType:
    return llvm_mitsuba


def rendered(folder: Path, *flags: str) -> NDArray[np.float64]:
    fixed = ["--size", "32x24", "--sky", "0", "--sun", "20,15", "--view", "0,0", "--optical-depth", "400", "--g", "0", "--quiet"]
    assert main(["render", str(PAINTED), "-o", str(folder / "image.exr"), *fixed, *flags]) == 0
    return read_exr(folder / "image.exr").rgb().astype(np.float64)


def test_single_scattering_shows_the_albedo_in_its_place(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flags = ["--max-depth", "2", "--spp", "16"]
    white, colour, grey = (rendered(tmp_path, *flags, *more) for more in ([], ["--albedo-grid", "Cd"], ["--albedo-grid", "grey"]))
    rows, columns = np.nonzero(white.min(axis=2) > 0.5 * white.max())
    ratio = (colour / np.maximum(white, 1e-9))[rows, columns]
    np.testing.assert_allclose(ratio[:, 2], 0.5, rtol=1e-3)
    # From +Z, x grows to the right and y upward: what is seen of the front face spans nearly all of both.
    for channel, place, low, high in ((0, columns, 0.2, 0.8), (1, -rows, 0.3, 0.6)):
        values = [ratio[place == k, channel].mean() for k in np.unique(place)]
        assert len(values) > 8
        assert np.all(np.diff(values) > 0)
        np.testing.assert_allclose([values[0], values[-1]], [low, high], atol=0.06)
    of_red = colour[..., :1] / np.maximum(white[..., :1], 1e-9)
    np.testing.assert_allclose(grey, of_red * white, rtol=1e-3, atol=1e-6)


def test_all_orders_and_the_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image = rendered(tmp_path, "--spp", "16", "--albedo-grid", "Cd")
    lit = image[..., 1] > 0.2 * image[..., 1].max()
    left, right = (image[:, half][lit[:, half]][:, 0].mean() for half in (slice(0, 16), slice(16, None)))
    assert right > 1.5 * left
    out = tmp_path / "image.exr"
    assert main(["render", str(PAINTED), "-o", str(out), "--size", "8x6", "--spp", "1", "--albedo-grid", "Cd", "--max-depth", "2"]) == 0
    assert "of the file 'density' and 'Cd' alone are rendered, without its grid 'grey'" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "flags", "said"),
    [
        ("painted", ["--albedo-grid", "paint"], "no grid called 'paint'"),
        ("painted", ["--albedo-grid", "Cd", "--albedo", "0.9"], "the albedo is given too"),
        ("several", ["--albedo-grid", "label", "--grid", "heat"], "'label' holds int32 values, not float or vec3s"),
        ("several", ["--albedo-grid", "wind", "--grid", "heat"], "'wind': the albedo's grid holds 2 values outside of 0 to 1"),
        ("plain", ["--albedo-grid", "Cd"], "has one grid, its density"),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, flags: list[str], said: str) -> None:
    write_vol(tmp_path / "plain.vol", Volume.from_box(np.ones((2, 2, 2), np.float32), (0, 0, 0), (1, 1, 1)))
    file = tmp_path / "plain.vol" if name == "plain" else PAINTED.with_name(f"{name}.vdb")
    assert main(["render", str(file), "-o", str(tmp_path / "image.exr"), *flags]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "image.exr").exists()


def test_a_corrected_image_asks_the_network_and_is_that_of_paths(tmp_path: Path) -> None:
    """A ball, dark on one side in red and on the other in blue: walks take out what a mean albedo around each point gets wrong."""
    c = (np.arange(24) + 0.5) / 12 - 1
    z, y, x = np.meshgrid(c, c, c, indexing="ij")
    ball = np.clip(4 * (0.9 - np.sqrt(x * x + y * y + z * z)), 0, 1).astype(np.float32)
    write_vol(tmp_path / "ball.vol", Volume.from_box(ball, (-1, -1, -1), (1, 1, 1)))
    side = 1 / (1 + np.exp(-8 * x))
    colours = np.stack([0.7 + 0.3 * side, np.full_like(x, 0.95), 1 - 0.3 * side], axis=-1)
    mitsuba().VolumeGrid(colours.astype(np.float32)).write(str(tmp_path / "albedo.vol"))
    place = '<transform name="to_world"><translate x="-0.5" y="-0.5" z="-0.5"/><scale value="2"/></transform>'
    scene = tmp_path / "scene.xml"
    scene.write_text(f"""<scene version="3.0.0">
      <sensor type="perspective"><float name="fov" value="34"/>
        <transform name="to_world"><lookat origin="0.6, 1, 3.8" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="24"/><integer name="height" value="24"/><rfilter type="box"/></film>
      </sensor>
      <emitter type="directional"><vector name="direction" value="-0.3, -1, -0.8"/><rgb name="irradiance" value="3 3 3"/></emitter>
      <emitter type="constant"><rgb name="radiance" value="0.1 0.2 0.3"/></emitter>
      <shape type="cube"><bsdf type="null"/><medium type="heterogeneous" name="interior">
        <float name="scale" value="12"/><phase type="hg"><float name="g" value="0.6"/></phase>
        <volume type="gridvolume" name="albedo"><boolean name="raw" value="true"/>{place}
          <string name="filename" value="albedo.vol"/></volume>
        <volume type="gridvolume" name="sigma_t"><string name="filename" value="ball.vol"/>{place}</volume>
      </medium></shape></scene>""")
    renderer = load(scene)
    halves = [renderer.render(2000, seed=s) for s in (1, 2)]
    image, alone = (renderer.render(error=0.01, seed=3, correct=correct, audit=not correct) for correct in (True, False))
    assert [r.statistics.mode for r in (*halves, image, alone)] == ["path-traced"] * 2 + ["fast", "path-traced"]
    assert image.statistics.audit["corrected"]
    assert image.counts.queries > 0
    a, b = (np.stack([half.channels[f"volume_indirect.{c}"] for c in "RGB"], axis=-1).astype(np.float64) for half in halves)
    ours = np.stack([image.channels[f"volume_indirect.{c}"] for c in "RGB"], axis=-1).astype(np.float64)
    mean = 0.5 * (a + b)
    # Red is dark where blue is bright: no one colour would do.
    lit = mean[..., 1] > 0.3 * mean[..., 1].max()
    ratio = (mean[..., 0] / np.maximum(mean[..., 2], 1e-9))[lit]
    assert np.quantile(ratio, 0.9) > 2 * np.quantile(ratio, 0.1)
    error = np.sqrt(max(float(np.mean((ours - a) * (ours - b))), 0.0)) / mean.mean()
    noise = np.sqrt(float(np.mean(np.square(a - b))) / 2) / mean.mean()
    assert noise < 0.15
    assert error < 0.03
    np.testing.assert_allclose(ours.mean(axis=(0, 1)), mean.mean(axis=(0, 1)), rtol=0.015)


def test_images_that_are_path_traced_name_no_network(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    _say_nothing_to_audit.cache_clear()
    fixed = ["render", str(PAINTED), "-o", str(tmp_path / "image.exr"), "--albedo-grid", "Cd", "--size", "8x6", "--spp", "1"]
    headers = []
    for flags, name in (([], "image"), (["--audit"], "image"), (["--turntable", "2", "--frames", "2"], "image.0002")):
        caplog.clear()
        assert main([*fixed, *flags]) == 0
        said = capsys.readouterr().out
        assert ("--audit" in said, "none was asked" in said) == (False, flags == ["--audit"])
        nothing = "nothing to audit: multiple scattering is path-traced, and no network is asked"
        assert (nothing in caplog.messages) == (flags == ["--audit"])
        attributes = read_exr(tmp_path / f"{name}.exr").attributes
        headers.append(json.loads(str(attributes["deepclouds"])))
        assert ("modelHash" in attributes, "model_hash" in headers[-1], "unit" in headers[-1]) == (flags == [],) * 3
    assert [h["statistics"]["mode"] for h in headers] == ["fast", "path-traced", "path-traced"]
    assert [h["statistics"]["error"]["network"]["by"] for h in headers] == ["walks", "none", "none"]
