"""Rationale: in thin clouds little light is scattered more than once, and what is scattered once has a bright halo around the sun.

Expected behaviour: what multiple scattering adds decides how well it is predicted, down to not at all; the halo on surfaces is found with
little noise. Images stay those of paths.
"""

from __future__ import annotations

import logging
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from deepclouds_runtime import pilot, surfaces
from deepclouds_runtime.loading import load
from deepclouds_runtime.result import RenderResult

from deepclouds.volume import Volume, write_vol
from tests.system.smooth_network import Smooth

SIZE = 32


@pytest.fixture
def ball(tmp_path: Path, llvm_mitsuba: ModuleType) -> Path:
    """A ball of 2 units across above a white floor, of extinction 1 at density 1."""
    c = (np.arange(16) + 0.5) / 8 - 1
    z, y, x = np.meshgrid(c, c, c, indexing="ij")
    write_vol(tmp_path / "ball.vol", Volume.from_box((np.sqrt(x * x + y * y + z * z) < 0.9).astype(np.float32), (-1, -1, -1), (1, 1, 1)))
    path = tmp_path / "scene.xml"
    path.write_text(f"""<scene version="3.0.0"><default name="scale" value="0.5"/><default name="floor" value="0.8"/>
      <sensor type="perspective"><float name="fov" value="34"/>
        <transform name="to_world"><lookat origin="1.2, 3, 3.6" target="0, -0.3, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="{SIZE}"/><integer name="height" value="{SIZE}"/><rfilter type="box"/></film>
      </sensor>
      <emitter type="directional"><vector name="direction" value="-0.2, -1, -0.3"/><rgb name="irradiance" value="3 3 3"/></emitter>
      <shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="9"/><translate y="-1.3"/></transform>
        <bsdf type="diffuse"><rgb name="reflectance" value="$floor"/></bsdf></shape>
      <shape type="cube"><bsdf type="null"/><medium type="heterogeneous" name="interior">
        <float name="scale" value="$scale"/><rgb name="albedo" value="0.99"/><phase type="hg"><float name="g" value="0.85"/></phase>
        <volume type="gridvolume" name="sigma_t"><string name="filename" value="ball.vol"/>
          <transform name="to_world"><translate x="-0.5" y="-0.5" z="-0.5"/><scale value="2"/></transform></volume>
      </medium></shape></scene>""")
    return path


def _nodes(image: RenderResult) -> int:
    return int(image.statistics.sources["suns"]["nodes"])


def test_errors_may_be_larger_where_little_is_scattered_twice(ball: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = load(ball, unbiased=True).render(512, 3)
    found = load(ball, predictor=Smooth()).render(64, correct=True)
    fine = load(ball, predictor=Smooth()).render(64, correct=True, error=0.005)
    monkeypatch.setattr(pilot, "_THIN", 0.0)
    careful = load(ball, predictor=Smooth()).render(64, correct=True, error=0.005)
    assert _nodes(fine) < 0.5 * _nodes(careful)
    assert found.rgb.sum() == pytest.approx(paths.rgb.sum(), rel=0.005)
    tiles = [image.rgb.reshape(8, 4, 8, 4, 3).mean(axis=(1, 3)) for image in (found, paths)]
    assert float(np.sqrt(np.mean((tiles[0] - tiles[1]) ** 2)) / tiles[1].mean()) < 0.01
    # Counted are rays of the image alone, not those that look for what the cloud throws on the floor.
    assert all(count >= 0 for count in found.statistics.skipped.values())


def test_single_scattering_alone_is_rendered_where_that_is_enough(ball: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        found = load(ball, predictor=Smooth(), defines={"scale": "0.02"}).render(64, correct=True)
    assert "single scattering alone" in caplog.text
    assert found.statistics.sources.keys().isdisjoint({"suns", "light from all around"})
    assert found.statistics.audit == {}
    assert found.statistics.error["network"] == {"by": "none"}
    assert found.channels["volume_indirect.G"].sum() == 0
    assert found.channels["volume_direct.G"].sum() > 0
    paths = load(ball, unbiased=True, defines={"scale": "0.02"}).render(256, 3)
    assert found.rgb.sum() == pytest.approx(paths.rgb.sum(), rel=0.002)
    # Without the floor the same cloud is all that there is to see.
    caplog.clear()
    alone = load(ball, predictor=Smooth(), defines={"scale": "0.02", "floor": "0"}).render(4, correct=True, error=0.005)
    assert "single scattering alone" not in caplog.text
    assert alone.channels["volume_indirect.G"].sum() > 0


def test_the_halo_around_the_sun_is_found_on_surfaces(ball: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def thrown(seed: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
        cast, none = (load(ball, unbiased=True, interreflection=on).render(64, seed).channels["surface.G"] for on in (True, False))
        return cast - none

    found = [thrown(seed) for seed in (1, 2)]
    monkeypatch.setattr(surfaces, "_MOST_HALO", 0.0)
    without = [thrown(seed) for seed in (1, 2)]
    noise, before = (float(np.std(a - b)) / np.sqrt(2) for a, b in (found, without))
    assert noise < 0.5 * before
    deviation = np.hypot(noise, before) * SIZE / np.sqrt(2)
    assert abs(sum(a.sum() for a in found) - sum(b.sum() for b in without)) / 2 < 4 * deviation
