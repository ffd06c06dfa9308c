"""Rationale: with Monte Carlo walks in the network's place the renderer has no bias of its own, so Mitsuba's volpath is its oracle.

Expected behaviour: means of the image and of 16 tiles agree with volpath within their standard errors, and the standard errors are
small enough for the agreement to say something; under a sun, a uniform sky, a turned environment map, above a floor, inside the cloud, with
an albedo that varies.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from deepclouds_runtime.renderer import Renderer
from deepclouds_runtime.scene import read_scene
from numpy.typing import NDArray

from deepclouds.exr import write_exr
from deepclouds.volume import Volume, write_vol

SIZE, TILES, SEEDS = 24, 4, 8
SUN = '<emitter type="directional"><vector name="direction" value="-0.5, -1, -0.8"/><rgb name="irradiance" value="3 2 1"/></emitter>'
CONSTANT = '<emitter type="constant"><rgb name="radiance" value="0.5 0.7 1"/></emitter>'
MAP = (
    '<emitter type="envmap"><string name="filename" value="sky.exr"/>'
    '<transform name="to_world"><rotate x="1" angle="30"/><rotate z="1" angle="-50"/></transform></emitter>'
)
FLOOR = (
    '<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="5"/><translate y="-1.3"/></transform>'
    '<bsdf type="diffuse"><rgb name="reflectance" value="{0}"/></bsdf></shape>'
)
# Through the cloud, most of which lies above it.
CUT = FLOOR.replace("-1.3", "-0.25")
BALL = (
    '<shape type="sphere"><point name="center" value="0.9, 0.2, 1.2"/><float name="radius" value="0.4"/>'
    '<bsdf type="twosided"><bsdf type="plastic"/></bsdf></shape>'
)
BLACK_BALL = (
    '<shape type="sphere"><point name="center" value="0.1, 0, 0.2"/><float name="radius" value="0.35"/>'
    '<bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf></shape>'
)
# Across the sun's way, so that half of the cloud is in its shade.
WALL = (
    '<shape type="rectangle"><transform name="to_world"><scale value="1.5"/><translate x="1.5"/>'
    '<lookat origin="0.8, 1.6, 1.28" target="0, 0, 0" up="0, 0, 1"/></transform>'
    '<bsdf type="twosided"><bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf></bsdf></shape>'
)


@dataclass(frozen=True)
class Scene:
    """What is rendered, and how far volpath and we may differ beyond noise (the reflections we leave out)."""

    light: str
    surfaces: str = ""
    g: float = 0.4
    albedo: str = "1 0.8 0.5"
    max_depth: int = -1
    hide: bool = False
    origin: str = "1.2, 1.0, 4.2"
    target: str = "0, -0.1, 0"
    spp: int = 192
    slack: float = 0.0
    density: str = "ball"
    inside: bool = False
    varying: bool = False


SCENES = {
    "sun": Scene(SUN),
    "sun, forward": Scene(SUN, g=0.65, spp=512),
    "sun, backward": Scene(SUN, g=-0.5),
    "constant": Scene(CONSTANT),
    "map": Scene(MAP),
    "map, hidden": Scene(MAP, hide=True),
    "camera inside": Scene(SUN + CONSTANT, origin="0.1, 0.2, 0.1", target="1, 0.3, 0.4", inside=True),
    "single, sun": Scene(SUN, max_depth=2),
    "single, map": Scene(MAP, max_depth=2, g=0.7),
    "single, floor and ball": Scene(SUN + CONSTANT, FLOOR.format(0.5) + BALL, max_depth=2),
    "single, floor under a map": Scene(MAP, FLOOR.format(0.5) + BALL, max_depth=2),
    "homogeneous": Scene(SUN, density="homogeneous"),
    "varying albedo": Scene(SUN, varying=True),
    "varying albedo under a map": Scene(MAP, varying=True, g=-0.3),
    "varying albedo, single": Scene(SUN + CONSTANT, varying=True, max_depth=2),
    "varying albedo over a floor": Scene(SUN, FLOOR.format(0.5), varying=True, slack=0.005),
    "varying albedo half in the shade": Scene(SUN, WALL, varying=True, spp=512),
    "dark floor": Scene(SUN, FLOOR.format(0.0)),
    "floor": Scene(SUN, FLOOR.format(0.5), slack=0.005),
    "floor under a map": Scene(MAP, FLOOR.format(0.5), slack=0.005),
    "half in the shade": Scene(SUN, WALL, spp=384),
    "dark floor through the cloud": Scene(SUN + CONSTANT, CUT.format(0.0)),
    "floor through the cloud": Scene(SUN, CUT.format(0.5), slack=0.005),
    "single, floor through the cloud": Scene(SUN, CUT.format(0.5), max_depth=2),
    "dark ball inside under a map": Scene(MAP, BLACK_BALL, g=0.65, spp=384),
    "varying albedo and a dark ball inside": Scene(SUN, BLACK_BALL, varying=True),
}


def _xml(scene: Scene) -> str:
    sigma_t = (
        '<string name="filename" value="density.vol"/><transform name="to_world"><translate x="-0.5" y="-0.5" z="-0.5"/><scale value="2"/>'
    )
    turn = '<rotate y="1" angle="90"/><scale x="1.1" y="0.8" z="0.9"/>'
    medium = (
        f'<medium type="heterogeneous" id="cloud"><float name="scale" value="4"/><volume type="gridvolume" name="sigma_t">{sigma_t}{turn}'
        "</transform></volume>"
        if scene.density == "ball"
        else '<medium type="homogeneous" id="cloud"><float name="sigma_t" value="1.5"/>'
    )
    if scene.varying:
        medium += f'<volume type="gridvolume" name="albedo">{sigma_t.replace("density", "albedo")}{turn}</transform></volume>'
    else:
        medium += f'<rgb name="albedo" value="{scene.albedo}"/>'
    medium += f'<phase type="hg"><float name="g" value="{scene.g}"/></phase></medium>'
    # volpath believes a camera to stand in the medium when it is told so; we look where it stands.
    inside = '<ref id="cloud"/>' if scene.inside else ""
    return f"""<scene version="3.0.0">
      {medium}
      <integrator type="volpath">
        <integer name="max_depth" value="{scene.max_depth}"/><integer name="rr_depth" value="1000000"/>
        <boolean name="hide_emitters" value="{str(scene.hide).lower()}"/>
      </integrator>
      <sensor type="perspective">{inside}
        <float name="fov" value="42"/>
        <transform name="to_world"><lookat origin="{scene.origin}" target="{scene.target}" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="{SIZE}"/><integer name="height" value="{SIZE}"/><rfilter type="box"/>
          <string name="pixel_format" value="rgba"/></film>
      </sensor>
      {scene.light}
      <shape type="cube">
        <transform name="to_world">{turn}</transform>
        <bsdf type="null"/><ref name="interior" id="cloud"/>
      </shape>{scene.surfaces}
    </scene>"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, mi: ModuleType) -> Path:
    """Grid and sky that the scenes refer to."""
    path = tmp_path_factory.mktemp("volpath")
    mi.set_variant("scalar_rgb")
    z, y, x = np.meshgrid(*((np.arange(n) + 0.5) / n * 2 - 1 for n in (9, 10, 12)), indexing="ij")
    # Nothing about it is symmetric: a flipped or turned grid shows.
    density = np.clip(1.1 - np.sqrt((x - 0.2) ** 2 + (1.3 * y) ** 2 + (z + 0.1) ** 2), 0, 1) * (1.2 + x + 0.5 * z)
    write_vol(path / "density.vol", Volume.from_box(np.maximum(density, 0).astype(np.float32), (-1, -1, -1), (1, 1, 1)))
    # Finer than the density along one axis, coarser along another, and different in every colour.
    z, y, x = np.meshgrid(*((np.arange(n) + 0.5) / n * 2 - 1 for n in (5, 16, 3)), indexing="ij")
    albedo = np.stack([0.75 + 0.25 * x, 0.6 + 0.4 * np.sin(5 * y), np.where(z > 0.1, 1, 0.2)], axis=-1).astype(np.float32)
    mi.VolumeGrid(albedo).write(str(path / "albedo.vol"))
    sky = np.random.default_rng(1).random((16, 32, 3)).astype(np.float32)
    sky[3:5, 20:22] = (30, 25, 20)
    write_exr(path / "sky.exr", {c: sky[..., i] for i, c in enumerate("RGB")})
    return path


@pytest.fixture(scope="module")
def mi() -> Iterator[ModuleType]:
    import mitsuba

    before = mitsuba.variant()
    yield mitsuba
    if before is not None:
        mitsuba.set_variant(before)


def _tiles(image: NDArray[np.float32]) -> NDArray[np.float64]:
    side = SIZE // TILES
    tiles: NDArray[np.float64] = image.astype(np.float64).reshape(TILES, side, TILES, side, -1).mean(axis=(1, 3))
    return tiles


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_walks_agree_with_volpath(mi: ModuleType, folder: Path, name: str) -> None:
    scene = SCENES[name]
    file = folder / f"{name.replace(' ', '_').replace(',', '')}.xml"
    file.write_text(_xml(scene))
    mi.set_variant("scalar_rgb")
    loaded = mi.load_file(str(file))
    theirs = np.stack([_tiles(np.array(mi.render(loaded, spp=scene.spp, seed=1000 + k))) for k in range(SEEDS)])
    mi.set_variant("llvm_ad_rgb")
    renderer = Renderer(read_scene(mi.load_file(str(file))), unbiased=True)
    results = [renderer.render(scene.spp // 2, seed=k) for k in range(SEEDS)]
    ours = np.stack([_tiles(np.concatenate([r.rgb, r.alpha[..., None]], axis=-1)) for r in results])

    difference = ours.mean(axis=0) - theirs.mean(axis=0)
    variance = ours.var(axis=0, ddof=1) / SEEDS + theirs.var(axis=0, ddof=1) / SEEDS
    scale = theirs.mean(axis=(0, 1, 2))
    mean_difference = difference.mean(axis=(0, 1))
    mean_error = np.sqrt(variance.mean(axis=(0, 1)) / TILES**2)
    relative = mean_difference / np.maximum(scale, 1e-9)
    percent = np.round(100 * np.stack([relative, mean_error / scale]), 2)
    print(f"\n{name}: mean {np.round(scale, 4)}, difference {percent[0]} %, its error {percent[1]} %")
    # Four channels of the image and 64 tiles: 5 and 6.5 standard errors of 8 seeds each (Student's t) fail once in thousands of runs.
    assert np.all(np.abs(mean_difference) < 5 * mean_error + (scene.slack + 0.002) * scale)
    assert np.all(np.abs(difference) < 6.5 * np.sqrt(variance) + 0.01 * scale + scene.slack * theirs.mean(axis=0))
    assert np.all(mean_error < 0.012 * scale), "too noisy to say anything"


@pytest.mark.parametrize("g", [0.0, 0.7])
def test_white_furnace(mi: ModuleType, folder: Path, g: float) -> None:
    """Albedo 1 in uniform radiance 1 is invisible: 1 everywhere, floor or none."""
    file = folder / "furnace.xml"
    file.write_text(_xml(Scene('<emitter type="constant"><float name="radiance" value="1"/></emitter>', g=g, albedo="1 1 1")))
    mi.set_variant("llvm_ad_rgb")
    renderer = Renderer(read_scene(mi.load_file(str(file))), unbiased=True)
    tiles = np.stack([_tiles(renderer.render(64, seed=k).rgb)[..., 0] for k in range(SEEDS)])
    error = tiles.std(axis=0, ddof=1) / np.sqrt(SEEDS)
    assert np.all(np.abs(tiles.mean(axis=0) - 1) < 6.5 * error + 2e-3)
    assert abs(tiles.mean() - 1) < 5e-3
    assert error.max() < 0.02
