"""Cameras, crop windows, lights and media of many kinds against Mitsuba's ``volpath``.

Rationale: single scattering is exact in both programs, so every way to describe a scene must give volpath's image; what a camera, a crop
window, a light or a phase function does wrong shows in single scattering already, and costs little there.
Expected behaviour: the means of all channels and of their tiles agree within their standard errors, which are one per cent at most; a
difference put there on purpose is found.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from deepclouds_runtime.renderer import Renderer
from deepclouds_runtime.scene import read_scene
from numpy.typing import NDArray

from deepclouds.volume import Volume, write_vol

# Five standard errors of 16 seeds (Student's t) fail once in 6,000 for a true null, seven in 200,000.
SEEDS, TILE = 16, 4
SUN = '<emitter type="directional"><vector name="direction" value="-0.5, -1, -0.8"/><rgb name="irradiance" value="3 2 1"/></emitter>'
OTHER = '<emitter type="directional"><vector name="direction" value="0.9, 0.2, -0.3"/><rgb name="irradiance" value="0.4 1 2"/></emitter>'
CONSTANT = '<emitter type="constant"><rgb name="radiance" value="0.5 0.7 1"/></emitter>'
LOOK = '<transform name="to_world">{0}<lookat origin="1.2, 1.0, 4.2" target="0, -0.1, 0" up="0, 1, 0"/></transform>'
PERSPECTIVE = '<sensor type="perspective"><float name="fov" value="42"/>' + LOOK.format("") + "{film}</sensor>"
ORTHOGRAPHIC = '<sensor type="orthographic">' + LOOK.format('<scale x="1.3" y="1.3" z="1"/>') + "{film}</sensor>"
THINLENS = (
    '<sensor type="thinlens"><float name="fov" value="42"/><float name="aperture_radius" value="0.5"/>'
    '<float name="focus_distance" value="3"/>' + LOOK.format("") + "{film}</sensor>"
)
FILM = (
    '<film type="hdrfilm"><integer name="width" value="{0}"/><integer name="height" value="{1}"/>{2}<rfilter type="box"/>'
    '<string name="pixel_format" value="rgba"/></film>'
)
CROP = (
    '<integer name="crop_width" value="12"/><integer name="crop_height" value="8"/>'
    '<integer name="crop_offset_x" value="9"/><integer name="crop_offset_y" value="5"/>'
)
SUNSKY = (
    '<emitter type="sunsky"><vector name="sun_direction" value="0.5, 1, 0.8"/><float name="turbidity" value="4"/>'
    '<rgb name="albedo" value="0.2 0.3 0.1"/><float name="sun_scale" value="{0}"/><float name="sky_scale" value="2"/>'
    '<transform name="to_world"><rotate x="1" angle="-90"/></transform></emitter>'
)
HG = '<phase type="hg"><float name="g" value="0.4"/></phase>'
BLEND = '<phase type="blendphase"><float name="weight" value="0.35"/>{0}{1}</phase>'
TWO_LOBES = BLEND.format(
    '<phase type="hg"><float name="g" value="0.6"/></phase>', '<phase type="hg"><float name="g" value="-0.4"/></phase>'
)
SQUARE = FILM.format(16, 16, "")


@dataclass(frozen=True)
class Scene:
    """What is rendered, with how many samples; how noisy the difference of the means may be, and how far it may go beyond noise."""

    light: str = SUN
    camera: str = PERSPECTIVE
    film: str = SQUARE
    phase: str = HG
    surfaces: str = ""
    max_depth: int = 2
    spp: int = 128
    noise: float = 0.01
    slack: float = 0.002
    scale: float = 4.0
    clouds: tuple[str, ...] = ("",)


FLOOR = (
    '<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="5"/><translate y="-1.3"/></transform>'
    '<bsdf type="diffuse"/></shape>'
)
BASE = Scene()
CLOUDS = (
    '<scale value="0.8"/>',
    '<rotate y="1" angle="40"/><scale value="0.5"/><translate x="-0.1" y="1.45" z="0.2"/>',
    '<scale x="0.5" y="0.8" z="0.6"/><translate x="-1.5" y="-0.2" z="0.3"/>',
)
SCENES = {
    "orthographic": replace(BASE, camera=ORTHOGRAPHIC, light=SUN + CONSTANT),
    "orthographic, all orders": replace(BASE, camera=ORTHOGRAPHIC, max_depth=-1, spp=256),
    "thin lens, all orders": replace(BASE, camera=THINLENS, max_depth=-1, spp=256),
    "thin lens": replace(BASE, camera=THINLENS),
    "thin lens, floor": replace(BASE, camera=THINLENS, surfaces=FLOOR),
    "crop": replace(BASE, film=FILM.format(24, 16, CROP)),
    "orthographic, crop, portrait": replace(BASE, camera=ORTHOGRAPHIC, film=FILM.format(22, 30, CROP)),
    "three suns and a sky": replace(BASE, light=SUN + OTHER + OTHER.replace("0.9, 0.2", "0.1, 2") + CONSTANT),
    "sun and sky": replace(BASE, light=SUNSKY.format(1)),
    "sun and sky, floor": replace(BASE, light=SUNSKY.format(0.2), surfaces=FLOOR),
    "sky without its sun": replace(BASE, light=SUNSKY.format(0)),
    "three clouds": replace(BASE, clouds=CLOUDS, slack=0.005),
    "three clouds, all orders": replace(BASE, clouds=CLOUDS, max_depth=-1, slack=0.005, spp=256),
    "two lobes, sun": replace(BASE, phase=TWO_LOBES),
    "two lobes, sky": replace(BASE, phase=TWO_LOBES, light=CONSTANT),
    "two lobes, all orders": replace(BASE, phase=TWO_LOBES, light=SUN, max_depth=-1, spp=256, noise=0.01, scale=3.0),
}


def _xml(scene: Scene) -> str:
    return f"""<scene version="3.0.0">
      <integrator type="volpath">
        <integer name="max_depth" value="{scene.max_depth}"/><integer name="rr_depth" value="1000000"/>
      </integrator>
      {scene.camera.format(film=scene.film)}{scene.light}{scene.surfaces}
      {"".join(_cloud(scene, turn) for turn in scene.clouds)}</scene>"""


def _cloud(scene: Scene, turn: str) -> str:
    return f"""<shape type="cube"><bsdf type="null"/><transform name="to_world">{turn}</transform>
        <medium type="heterogeneous" name="interior">
          <float name="scale" value="{scene.scale}"/><rgb name="albedo" value="1 0.8 0.5"/>{scene.phase}
          <volume type="gridvolume" name="sigma_t"><string name="filename" value="density.vol"/>
            <transform name="to_world"><translate x="-0.5" y="-0.5" z="-0.5"/><scale value="2"/>{turn}</transform></volume>
        </medium>
      </shape>"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A grid without any symmetry, which the scenes refer to."""
    path = tmp_path_factory.mktemp("scenes")
    z, y, x = np.meshgrid(*((np.arange(n) + 0.5) / n * 2 - 1 for n in (9, 10, 12)), indexing="ij")
    density = np.clip(1.1 - np.sqrt((x - 0.2) ** 2 + (1.3 * y) ** 2 + (z + 0.1) ** 2), 0, 1) * (1.2 + x + 0.5 * z)
    write_vol(path / "density.vol", Volume.from_box(np.maximum(density, 0).astype(np.float32), (-1, -1, -1), (1, 1, 1)))
    return path


@pytest.fixture(scope="module")
def mi() -> Iterator[ModuleType]:
    import mitsuba

    before = mitsuba.variant()
    yield mitsuba
    if before is not None:
        mitsuba.set_variant(before)


def _images(mi: ModuleType, file: Path, scene: Scene) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Renders (SEEDS, h, w, rgba) of volpath and of ours."""
    mi.set_variant("scalar_rgb")
    loaded = mi.load_file(str(file))
    theirs = np.stack([np.array(mi.render(loaded, spp=scene.spp, seed=1000 + k), np.float64) for k in range(SEEDS)])
    mi.set_variant("llvm_ad_rgb")
    renderer = Renderer(read_scene(mi.load_file(str(file))), unbiased=True)
    results = [renderer.render(scene.spp // 2, seed=k) for k in range(SEEDS)]
    ours = np.stack([np.concatenate([r.rgb, r.alpha[..., None]], axis=-1, dtype=np.float64) for r in results])
    return theirs, ours


def _tiles(renders: NDArray[np.float64]) -> NDArray[np.float64]:
    n, height, width, channels = renders.shape
    tiles: NDArray[np.float64] = renders.reshape(n, height // TILE, TILE, width // TILE, TILE, channels).mean(axis=(2, 4))
    return tiles


def _check(ours: NDArray[np.float64], theirs: NDArray[np.float64], noise: float, slack: float) -> str:
    """Compare the means of images and of tiles, channel by channel; returns what was found, in words."""
    assert theirs.shape == ours.shape
    scale = theirs.mean(axis=(0, 1, 2))
    means = [renders.mean(axis=(1, 2)) for renders in (ours, theirs)]
    difference = means[0].mean(axis=0) - means[1].mean(axis=0)
    error = np.sqrt(sum(m.var(axis=0, ddof=1) for m in means) / SEEDS)
    found = f"differs by {np.round(100 * difference / scale, 2)} %, standard error {np.round(100 * error / scale, 2)} %"
    assert np.all(np.abs(difference) < 5 * error + slack * scale), found
    assert np.all(error < noise * scale), f"too noisy to say anything: {found}"
    tiles = [_tiles(renders) for renders in (ours, theirs)]
    difference = tiles[0].mean(axis=0) - tiles[1].mean(axis=0)
    error = np.sqrt(sum(m.var(axis=0, ddof=1) for m in tiles) / SEEDS)
    assert np.all(np.abs(difference) < 7 * error + slack * np.maximum(scale, tiles[1].mean(axis=0))), found
    return found


@pytest.mark.parametrize("name", SCENES)
def test_scenes_agree_with_volpath(mi: ModuleType, folder: Path, name: str) -> None:
    scene = SCENES[name]
    file = folder / f"{name.replace(' ', '_').replace(',', '')}.xml"
    file.write_text(_xml(scene))
    theirs, ours = _images(mi, file, scene)
    print(f"\n{name}: {_check(ours, theirs, scene.noise, scene.slack)}")


def test_the_plugin_fills_the_crop_window(mi: ModuleType, folder: Path) -> None:
    file = folder / "plugin_crop.xml"
    file.write_text(_xml(SCENES["crop"]))
    mi.set_variant("llvm_ad_rgb")
    scene = mi.load_file(str(file))
    plugin = mi.load_dict({"type": "deepclouds", "max_depth": 2})
    image = np.array(mi.render(scene, integrator=plugin, spp=4, seed=3))
    ours = Renderer(read_scene(scene, max_depth=2)).render(4, seed=3)
    assert image.shape == (8, 12, 4)
    np.testing.assert_allclose(image[..., :3], ours.rgb, rtol=1e-4, atol=1e-6)
    assert np.array(scene.sensors()[0].film().bitmap()).shape == (8, 12, 4)


def test_the_comparison_has_power(mi: ModuleType, folder: Path) -> None:
    """Another crop window, a lens twice as wide, and exchanged lobes are each found."""
    for name, wrong in (
        ("crop", replace(SCENES["crop"], film=SCENES["crop"].film.replace('offset_x" value="9"', 'offset_x" value="8"'))),
        ("thin lens", replace(SCENES["thin lens"], camera=THINLENS.replace('"0.5"', '"1"'))),
        ("two lobes, sun", replace(BASE, phase=TWO_LOBES.replace("0.35", "0.65"))),
    ):
        file, other = folder / "right.xml", folder / "wrong.xml"
        file.write_text(_xml(SCENES[name]))
        other.write_text(_xml(wrong))
        theirs, _ = _images(mi, other, wrong)
        _, ours = _images(mi, file, SCENES[name])
        with pytest.raises(AssertionError, match="differs by"):
            _check(ours, theirs, 0.05, SCENES[name].slack)
