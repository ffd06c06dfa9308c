"""Rationale: surfaces inside of a cloud (fog on the ground, a plane in a cloud) end its light; a node behind one lies in the dark.

Expected behaviour: what a black floor leaves of a cloud looks like a cloud that ends there; nodes behind surfaces do not darken what is
before them; images that walks correct are those of paths.
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from deepclouds_runtime._mitsuba import types_of
from deepclouds_runtime.frame_source import _BeforeSurfaces
from deepclouds_runtime.light_walks import LightWalks
from deepclouds_runtime.lights import Shade
from deepclouds_runtime.loading import load
from deepclouds_runtime.scene_lights import Sun
from deepclouds_runtime.transport import Cloud, Lights

from deepclouds.medium.field import Field
from deepclouds.volume import Volume, write_vol
from tests.system.smooth_network import Smooth

SIZE = 32
LOWER, UPPER = (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)
SUN = '<emitter type="directional"><vector name="direction" value="-0.4, -1, -0.3"/><rgb name="irradiance" value="3 3 3"/></emitter>'


def _floor(height: float, reflectance: float) -> str:
    return (
        f'<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="20"/><translate y="{height}"/>'
        f'</transform><bsdf type="diffuse"><rgb name="reflectance" value="{reflectance}"/></bsdf></shape>'
    )


def _surfaces(mi: ModuleType, xml: str) -> Any:
    return mi.load_string(f'<scene version="3.0.0">{xml}</scene>')


@pytest.fixture
def fog(tmp_path: Path, llvm_mitsuba: ModuleType) -> Path:
    """Fog that lies on a floor in a box of 2 units across, which reaches below it."""
    dense = np.broadcast_to(np.exp(-4 * np.linspace(0, 2, 16))[None, :, None], (16, 16, 16))
    write_vol(tmp_path / "fog.vol", Volume.from_box(dense.astype(np.float32), LOWER, UPPER))
    path = tmp_path / "scene.xml"
    path.write_text(f"""<scene version="3.0.0">
      <sensor type="perspective"><float name="fov" value="44"/>
        <transform name="to_world"><lookat origin="1.2, 2.2, 3.4" target="0, -0.4, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="{SIZE}"/><integer name="height" value="{SIZE}"/><rfilter type="box"/></film>
      </sensor>{SUN}{_floor(-0.9, 0.5)}
      <shape type="cube"><bsdf type="null"/><medium type="heterogeneous" name="interior">
        <float name="scale" value="12"/><rgb name="albedo" value="0.999"/><phase type="hg"><float name="g" value="0.6"/></phase>
        <volume type="gridvolume" name="sigma_t"><string name="filename" value="fog.vol"/>
          <transform name="to_world"><translate x="-0.5" y="-0.5" z="-0.5"/><scale value="2"/></transform></volume>
      </medium></shape></scene>""")
    return path


@pytest.mark.parametrize(("floor", "inside"), [(-1.0, True), (-1.5, False), (-0.4, True), (0.9, True), (1.1, False)])
def test_what_lies_inside(llvm_mitsuba: ModuleType, floor: float, inside: bool) -> None:
    bounds = np.array(LOWER), np.array(UPPER)
    assert Shade(types_of(llvm_mitsuba), _surfaces(llvm_mitsuba, _floor(floor, 0.5)), bounds).inside == inside
    assert not Shade(types_of(llvm_mitsuba), None, bounds).inside


@pytest.mark.parametrize(("albedo", "g"), [(1.0, 0.5), (0.98, -0.4)])
def test_a_cloud_on_a_black_floor_is_one_that_ends_there(llvm_mitsuba: ModuleType, albedo: float, g: float) -> None:
    types, height, count = types_of(llvm_mitsuba), -0.4, 1 << 16
    suns = (Sun((0.48, 0.8, 0.36), (2.0,)),)
    rng = np.random.default_rng(5)
    points = rng.uniform((-0.9, height + 0.02, -0.9), (0.9, height + 0.4, 0.9), (count, 3))
    along = np.broadcast_to((0.6, -0.8, 0.0), (count, 3))

    def mean(lower: float, shade: Shade, seed: int) -> tuple[float, float]:
        volume = Volume.from_box(np.ones((2, 2, 2)), (-1, lower, -1), UPPER)
        walks = LightWalks(Cloud(Field(types, volume, 3.0), (albedo,), (g, g, 1.0), None), Lights(suns, (), shade))
        j = walks(points, along, np.random.default_rng(seed))[:, 0]
        return float(j.mean()), float(j.std() / np.sqrt(count))

    surfaces = _surfaces(llvm_mitsuba, _floor(height, 0.0))
    cut, cut_error = mean(height, Shade(types, None), 1)
    found, error = mean(-1.0, Shade(types, surfaces, (np.array(LOWER), np.array(UPPER))), 2)
    through, _ = mean(-1.0, Shade(types, surfaces), 3)
    assert abs(found - cut) < 4 * np.hypot(error, cut_error)
    assert error < 0.01 * found
    # The test would see walks that go through the floor.
    assert abs(through - cut) > 8 * np.hypot(error, cut_error)


def test_nodes_behind_surfaces_are_in_the_light_before_them(fog: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def error() -> tuple[float, int]:
        found = load(fog, predictor=Smooth()).render(1, error=0.004).statistics.sources["suns"]
        return float(found["error"]), int(found["nodes"])

    good, few = error()
    monkeypatch.setattr(_BeforeSurfaces, "__call__", lambda self, points, near: points)
    bad, many = error()
    assert good < 0.6 * bad
    assert few < many


def test_nodes_are_moved_to_where_they_are_seen_from(llvm_mitsuba: ModuleType) -> None:
    types = types_of(llvm_mitsuba)
    place = _BeforeSurfaces(types, Shade(types, _surfaces(llvm_mitsuba, _floor(-0.5, 0.5))))
    near = np.array([[0.0, 0.5, 0.0], [0.0, 0.5, 0.0], [0.3, -0.9, 0.2], [0.1, 0.1, 0.1]])
    nodes = np.array([[0.2, -0.4, 0.1], [1.0, -1.5, 0.0], [0.3, -0.6, 0.2], [0.1, 0.1, 0.1]])
    moved = place(nodes, near)
    # One that is seen, one below the floor, one seen from below, one that is the point itself.
    assert moved[[0, 2, 3]] == pytest.approx(nodes[[0, 2, 3]], abs=1e-6)
    assert moved[1] == pytest.approx([0.5, -0.5, 0], abs=0.02)
    assert moved[1, 1] > -0.5
    assert place(nodes[:0], near[:0]).shape == (0, 3)


def test_fog_on_the_ground_is_that_of_paths(fog: Path) -> None:
    paths = load(fog, unbiased=True).render(512, 3)
    found = load(fog, predictor=Smooth()).render(64, 4, correct=True)
    assert found.rgb.sum() == pytest.approx(paths.rgb.sum(), rel=0.015)
    # Walks in the place of queries are not counted.
    assert found.counts.queries == sum(source["queries"] for source in found.statistics.sources.values())
    tiles = [image.rgb.reshape(8, 4, 8, 4, 3).mean(axis=(1, 3)) for image in (found, paths)]
    error = float(np.sqrt(np.mean((tiles[0] - tiles[1]) ** 2)) / tiles[1].mean())
    assert error < 0.03
