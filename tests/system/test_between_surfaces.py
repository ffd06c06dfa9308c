"""Rationale: surfaces light each other: the side of a ball that looks down sees the floor, a corner sees both of its walls.

Expected behaviour: that light is there, as Mitsuba's `volpath` has it with three bounces, also past a cloud that dims it.
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from deepclouds_runtime.loading import load
from numpy.typing import NDArray

from tests.system.smooth_network import Smooth

SIZE = 24
SUN = '<emitter type="directional"><vector name="direction" value="-0.5, -1, -0.4"/><rgb name="irradiance" value="3 2 1"/></emitter>'
SKY = '<emitter type="constant"><rgb name="radiance" value="0.5 0.7 1"/></emitter>'
# Tiles of 6 x 6 pixels: their means and the noise that is left.
Tiles = NDArray[np.float64]


def _scene(folder: Path, light: str, extinction: float = 1e-6, middle: str = 'x="0" y="900" z="0"') -> Path:
    """A ball over a floor beside a wall, and a black box of even medium: far away, since Mitsuba's skies shine past walls behind one."""
    path = folder / "scene.xml"
    grey = '<bsdf type="twosided"><bsdf type="diffuse"><rgb name="reflectance" value="0.7 0.6 0.5"/></bsdf></bsdf>'
    path.write_text(f"""<scene version="3.0.0"><default name="integrator" value="volpath"/><default name="depth" value="-1"/>
      <integrator type="$integrator"><integer name="max_depth" value="$depth"/><integer name="rr_depth" value="100"/></integrator>
      <sensor type="perspective"><float name="fov" value="40"/>
        <transform name="to_world"><lookat origin="2, 1, 4" target="0, -0.6, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="{SIZE}"/><integer name="height" value="{SIZE}"/><rfilter type="box"/></film>
      </sensor>{light}
      <shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="4"/><translate y="-1"/></transform>
        {grey}</shape>
      <shape type="rectangle"><transform name="to_world"><scale value="4"/><translate z="-1.5"/></transform>{grey}</shape>
      <shape type="sphere"><point name="center" x="0" y="-0.3" z="-0.2"/><float name="radius" value="0.6"/>{grey}</shape>
      <shape type="cube"><transform name="to_world"><scale value="0.3"/><translate {middle}/></transform>
        <bsdf type="null"/><medium type="homogeneous" name="interior"><float name="scale" value="{extinction}"/>
        <rgb name="albedo" value="0"/></medium></shape></scene>""")
    return path


def _tiles(image: Any) -> Tiles:
    tiles: Tiles = np.array(image, np.float64)[..., :3].reshape(4, 6, 4, 6, 3).mean(axis=(1, 3))
    return tiles


def _true(mi: ModuleType, path: Path, samples: int) -> Tiles:
    """Paths that end at the third surface, or collision."""
    return _tiles(mi.render(mi.load_file(str(path), depth=4), spp=samples, seed=1))


@pytest.mark.parametrize("light", [SUN, SKY])
def test_three_bounces_are_those_of_mitsuba(tmp_path: Path, llvm_mitsuba: ModuleType, light: str) -> None:
    path = _scene(tmp_path, light)
    true = _true(llvm_mitsuba, path, 1024)
    np.testing.assert_allclose(_tiles(load(path, predictor=Smooth()).render(256, 2).rgb), true, rtol=0.02)
    # Without, a corner and the ball's lower side are too dark by a fifth and more.
    alone = _tiles(load(path, predictor=Smooth(), interreflection=False).render(64, 2).rgb)
    assert (alone < 0.8 * true).any()


def test_a_cloud_dims_it(tmp_path: Path, llvm_mitsuba: ModuleType) -> None:
    """A black cloud: what is behind it is dimmed, on the way to a surface as on the way from there."""
    path = _scene(tmp_path, SUN, 2.0, 'x="-0.3" y="-0.6" z="1"')
    true = _true(llvm_mitsuba, path, 4096)
    np.testing.assert_allclose(_tiles(load(path, predictor=Smooth()).render(256, 4).rgb), true, rtol=0.03)
