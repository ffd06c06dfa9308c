"""Suns with a size.

Rationale: the disc of a sun is what gives shadows their penumbra; a disc drawn too wide, too narrow or with the wrong weight shows in
single scattering and on surfaces already, where Mitsuba's volpath is exact. Expected behaviour: images under a `sunsky` of a wide disc,
and under a disc of our own against a far area light of the same size, agree with volpath within noise; a disc of another size does not.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np
import pytest
from deepclouds_runtime._mitsuba import types_of
from deepclouds_runtime.disc import Disc
from deepclouds_runtime.lights import Shade
from deepclouds_runtime.loading import load
from deepclouds_runtime.renderer import Renderer
from deepclouds_runtime.scene import CloudScene, read_scene
from deepclouds_runtime.scene_lights import Sun
from deepclouds_runtime.sunsky import split
from deepclouds_runtime.volume_scene import VolumeOptions, cloud_description, volume_scene
from numpy.typing import NDArray

from benchmarks import sun_disc
from deepclouds.errors import InputError
from deepclouds.volume import Volume

SEEDS, SIZE, TILE = 12, 16, 4
# Low behind the cloud, whose shadow falls toward the camera.
TOWARD = np.array([-0.5, 0.8, -0.8]) / np.linalg.norm([-0.5, 0.8, -0.8])
POINT = '<emitter type="directional"><vector name="direction" value="0.5, -0.8, 0.8"/><rgb name="irradiance" value="3 2 1"/></emitter>'
SUNSKY = (
    '<emitter type="sunsky"><vector name="sun_direction" value="-0.5, 0.8, -0.8"/><float name="turbidity" value="4"/>'
    '<float name="sun_aperture" value="{0}"/><float name="sun_scale" value="3"/><float name="sky_scale" value="0.3"/>'
    '<transform name="to_world"><rotate x="1" angle="-90"/></transform></emitter>'
)
FLOOR = (
    '<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="5"/><translate y="-1.3"/></transform>'
    '<bsdf type="{0}"/></shape>'
)


@pytest.fixture(autouse=True)
def mi(llvm_mitsuba: ModuleType) -> Iterator[ModuleType]:
    yield llvm_mitsuba
    llvm_mitsuba.set_variant("llvm_ad_rgb")


def _density() -> NDArray[np.float32]:
    """A blob with sharp edges, so that its shadow has a penumbra of the disc's making."""
    z, y, x = np.meshgrid(*((np.arange(n) + 0.5) / n * 2 - 1 for n in (14, 12, 16)), indexing="ij")
    return (((x - 0.2) ** 2 + (1.3 * y) ** 2 + (z + 0.1) ** 2 < 0.6) * (1.2 + x)).astype(np.float32)


def _scene(mi: Any, light: str, floor: str) -> Any:
    mi.VolumeGrid(_density()[..., None]).write("density.vol")
    text = f"""<scene version="3.0.0">
      <integrator type="volpath"><integer name="max_depth" value="2"/><integer name="rr_depth" value="1000000"/></integrator>
      <sensor type="perspective"><float name="fov" value="42"/>
        <transform name="to_world"><lookat origin="1.2, 1.0, 4.2" target="0, -0.4, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="{SIZE}"/><integer name="height" value="{SIZE}"/><rfilter type="box"/></film>
      </sensor>{light}{floor}
      <shape type="cube"><bsdf type="null"/><medium type="heterogeneous" name="interior">
        <float name="scale" value="4"/><rgb name="albedo" value="1 0.8 0.5"/><phase type="hg"><float name="g" value="0.4"/></phase>
        <volume type="gridvolume" name="sigma_t"><string name="filename" value="density.vol"/>
          <transform name="to_world"><translate x="-0.5" y="-0.5" z="-0.5"/><scale value="2"/></transform></volume>
      </medium></shape></scene>"""
    file = Path("scene.xml")
    file.write_text(text)
    return mi.load_file(str(file))


def _ours(scene: CloudScene, spp: int = 48) -> NDArray[np.float64]:
    renderer = Renderer(scene)
    return np.stack([renderer.render(spp, seed=k).rgb for k in range(SEEDS)]).astype(np.float64)


def _theirs(mi: Any, scene: Any, spp: int = 96) -> NDArray[np.float64]:
    return np.stack([np.array(mi.render(scene, spp=spp, seed=1000 + k), np.float64)[..., :3] for k in range(SEEDS)])


def _far(ours: NDArray[np.float64], theirs: NDArray[np.float64]) -> tuple[float, float]:
    """Largest difference of a tile in standard errors, beside two thousandths of the mean, and the error of the mean image over it."""
    scale = theirs.mean(axis=(0, 1, 2))

    def tiles(renders: NDArray[np.float64]) -> NDArray[np.float64]:
        n = renders.shape[0]
        parts: NDArray[np.float64] = renders.reshape(n, SIZE // TILE, TILE, SIZE // TILE, TILE, 3).mean(axis=(2, 4))
        return parts

    mine, other = tiles(ours), tiles(theirs)
    error = np.sqrt((mine.var(axis=0, ddof=1) + other.var(axis=0, ddof=1)) / SEEDS)
    difference = np.abs(mine.mean(axis=0) - other.mean(axis=0))
    allowed = error + 4e-4 * np.maximum(scale, other.mean(axis=0))
    whole = np.sqrt(sum(r.mean(axis=(1, 2)).var(axis=0, ddof=1) for r in (ours, theirs)) / SEEDS) / scale
    return float((difference / allowed).max()), float(whole.max())


# Five standard errors of 12 seeds and 48 tiles fail once in some 60 for a true null with Student's t; seven in a thousand.
LIMIT = 7.0


def _area(aperture: float) -> str:
    """A far area light of this size in the sun's place."""
    x, y, z = 1e4 * TOWARD
    radius = math.radians(aperture / 2)
    colour = " ".join(str(v / (math.pi * math.sin(radius) ** 2)) for v in (3, 2, 1))
    return (
        f'<shape type="disk"><transform name="to_world"><scale value="{1e4 * math.tan(radius)}"/>'
        f'<lookat origin="{x}, {y}, {z}" target="0, 0, 0" up="0, 1, 0"/></transform>'
        f'<emitter type="area"><rgb name="radiance" value="{colour}"/></emitter></shape>'
    )


@pytest.mark.parametrize(("aperture", "bsdf"), [(25.0, "diffuse"), (25.0, "roughconductor"), (40.0, "conductor")])
def test_discs_agree_with_volpath(mi: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, aperture: float, bsdf: str) -> None:
    """On a floor, in the cloud, and in the mirror of the floor."""
    monkeypatch.chdir(tmp_path)
    floor = FLOOR.format(bsdf)
    mi.set_variant("scalar_rgb")
    theirs = _theirs(mi, _scene(mi, _area(aperture), floor))
    mi.set_variant("llvm_ad_rgb")
    point = read_scene(_scene(mi, POINT, floor))
    ours = _ours(replace(point, suns=tuple(replace(sun, radius=math.radians(aperture / 2)) for sun in point.suns)))
    far, noise = _far(ours, theirs)
    print(f"\n{aperture} degrees, {bsdf}: {far:.2f} standard errors, {100 * noise:.2f} % noise")
    assert far < LIMIT
    assert noise < 0.02
    # A point in the place of the disc is found: the comparison has power.
    assert _far(_ours(point), theirs)[0] > 2 * LIMIT


def test_sunskies_agree_with_volpath(mi: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    floor, light = FLOOR.format("diffuse"), SUNSKY.format(5)
    mi.set_variant("scalar_rgb")
    theirs = _theirs(mi, _scene(mi, light, floor))
    mi.set_variant("llvm_ad_rgb")
    read = read_scene(_scene(mi, light, floor))
    assert read.suns[0].radius == pytest.approx(math.radians(2.5), rel=1e-4)
    far, noise = _far(_ours(read), theirs)
    print(f"\nsunsky: {far:.2f} standard errors, {100 * noise:.2f} % noise")
    assert far < LIMIT
    assert noise < 0.02


def test_a_volume_under_a_disc_agrees_with_volpath(mi: Any) -> None:
    """The camera looks into the sun: its disc, drawn and dimmed by the cloud, is in the picture."""
    volume = Volume.from_box(_density(), (-1, -1, -1), (1, 1, 1))
    options = VolumeOptions(
        optical_depth=4, g=0.7, albedo=(1.0, 0.8, 0.5), sun=(170.0, 12.0), sun_diameter=12.0, size=(SIZE, SIZE), max_depth=2, up="y"
    )
    ours = _ours(volume_scene(volume, options, "blob"))
    mi.set_variant("scalar_rgb")
    theirs = _theirs(mi, mi.load_dict(cloud_description(volume, options, "blob")))
    far, noise = _far(ours, theirs)
    print(f"\nvolume: {far:.2f} standard errors, {100 * noise:.2f} % noise")
    assert far < LIMIT
    assert noise < 0.02
    mi.set_variant("llvm_ad_rgb")
    assert not volume_scene(volume, replace(options, sun_diameter=5.0), "blob").notes
    assert "disc of 12 degrees is wide" in volume_scene(volume, options, "blob").notes[0]
    disc = 12 / (math.pi * math.sin(math.radians(6)) ** 2)
    assert theirs.mean(axis=0).max() > 0.9 * disc
    hidden = Renderer(volume_scene(volume, replace(options, hide_emitters=True), "blob")).render(4)
    assert hidden.channels["background.R"].max() == 0


def test_a_disc_in_the_picture_does_not_hide_noise(mi: Any) -> None:
    """Rationale: it is a thousand times as bright as the cloud, so noise over the mean of all pixels would be nothing at once.
    Expected: about as many samples as for the same picture without the disc."""
    volume = Volume.from_box(_density(), (-1, -1, -1), (1, 1, 1))
    options = VolumeOptions(optical_depth=4, sky=(0.0,), sun=(170.0, 12.0), sun_diameter=12.0, size=(32, 32), max_depth=2)
    shown, hidden = (
        Renderer(volume_scene(volume, replace(options, hide_emitters=hide), "blob")).render(error=0.02) for hide in (False, True)
    )
    assert shown.rgb.max() > 10 * hidden.rgb.max()
    assert hidden.statistics.mean_spp > 8
    assert shown.statistics.mean_spp > 0.6 * hidden.statistics.mean_spp
    assert shown.statistics.noise is not None
    assert 0.002 < shown.statistics.noise < 0.02


def test_a_bright_spot_of_a_map_does_not_hide_noise(mi: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a disc does not."""
    monkeypatch.chdir(tmp_path)
    noise = []
    for spot in (0.2, 2000.0):
        sky = np.full((64, 128, 3), 0.2, np.float32)
        sky[41:44, 116:120] = spot
        mi.Bitmap(sky).write("map.exr")
        renderer = Renderer(
            read_scene(_scene(mi, POINT + '<emitter type="envmap"><string name="filename" value="map.exr"/></emitter>', ""))
        )
        images = [renderer.render(error=0.02, seed=seed) for seed in (1, 2)]
        assert (images[0].channels["background.R"].max() > 500) == (spot > 500)
        first, second = (image.channels["volume_direct.R"].astype(np.float64) for image in images)
        noise.append(np.sqrt(np.mean(np.square(first - second)) / 2) / np.mean(first))
    assert noise[1] < 1.5 * noise[0]


@pytest.mark.parametrize("mode", ["fast", "reference"])
def test_no_disc_is_seen_through_what_is_opaque(mi: Any, mode: str) -> None:
    """What optical depths leave out beyond their limit would be seen: a sun is a hundred thousand times as bright as a cloud."""
    volume = Volume.from_box(np.ones((8, 8, 8), np.float32), (-1, -1, -1), (1, 1, 1))
    sun = VolumeOptions(sky=(0.0,), sun=(180.0, 0.0), sun_diameter=0.53)
    options = replace(sun, optical_depth=300, albedo=(0.0,), view=(0.0, 0.0), size=(65, 65), max_depth=2, up="y")
    image = Renderer(volume_scene(volume, options, "block"), mode=mode).render(4).rgb
    middle = slice(22, 43), slice(22, 43)
    assert image[middle].max() == 0
    thin = Renderer(volume_scene(volume, replace(options, optical_depth=5), "block"), mode=mode).render(4).rgb
    assert thin[middle].max() > 1


def test_the_cloud_throws_no_light_to_the_horizon(mi: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From ten thousand radii away the cosine of the cloud's cone is 1 in single precision."""
    monkeypatch.chdir(tmp_path)
    _scene(mi, POINT, FLOOR.format("diffuse").replace('"5"', '"200000"'))
    file = Path("scene.xml")
    file.write_text(
        file.read_text()
        .replace('"42"/>', '"0.02"/><float name="far_clip" value="1e6"/>')
        .replace('target="0, -0.4, 0"', 'target="-10000, -0.15, 4.2"')
        .replace('"max_depth" value="2"', '"max_depth" value="-1"')
    )
    surface = Renderer(read_scene(mi.load_file(str(file))), unbiased=True).render(64).channels["surface.R"]
    lit = 0.5 / math.pi * 3 * 0.8 / math.sqrt(0.25 + 2 * 0.64)
    assert np.median(surface) == pytest.approx(lit, rel=1e-3)
    assert surface.max() < 1.001 * lit


@pytest.mark.parametrize("limb", [(), ((1.5,), (1.1,), (0.4,))])
@pytest.mark.parametrize("diameter", [0.53, 60.0])
def test_a_disc_brings_its_irradiance(mi: Any, diameter: float, limb: tuple[tuple[float, ...], ...]) -> None:
    """Radiance times cosine, over the disc, is the irradiance; directions lie where they should."""
    types = types_of(mi)
    radius = math.radians(diameter / 2)
    x, y, z = (float(v) for v in TOWARD)
    n = 1 << 16
    u, v = (types.Float(((np.arange(n) + 0.5) * step % 1).astype(np.float32)) for step in (0.7548776662466927, 0.5698402909980532))
    disc = Disc(types, Sun((x, y, z), (3.0,), radius, limb), Shade(types, None))
    omega, density = disc.sample(u, v)
    direction = np.array(omega, np.float64)
    cosine = TOWARD @ direction
    brought = np.array(disc.radiance(omega)[0], np.float64) * cosine / float(density[0])
    expected = 3.0
    if limb:
        # Given rings of equal solid angle, each with the mean of its cosines.
        middle = 1 - (1 - math.cos(radius)) * (np.arange(3) + 0.5) / 3
        expected *= float(np.ravel(limb) @ middle / middle.sum())
    assert brought.mean() == pytest.approx(expected, rel=2e-3)
    angle = np.arcsin(np.minimum(np.linalg.norm(np.cross(direction.T, TOWARD), axis=1), 1))
    assert angle.max() == pytest.approx(radius, rel=1e-3)
    # Even in solid angle: half of the directions lie in half of it.
    assert np.median(angle) == pytest.approx(math.acos(0.5 * (1 + math.cos(radius))), rel=5e-3)
    assert np.linalg.norm(direction.mean(axis=1) / np.linalg.norm(direction.mean(axis=1)) - TOWARD) < 5e-3 * math.sin(radius)
    assert np.all(np.array(disc.density(types.Array3f(-TOWARD.astype(np.float32)))) == 0)
    assert dr.all(disc.density(types.Array3f(TOWARD.astype(np.float32))) == density)


def test_a_dark_limb_is_read(mi: Any) -> None:
    parts = split(mi.load_dict({"type": "sunsky", "sun_direction": [0.5, 1, 0.8], "complex_sun": True}))
    limb = np.array(parts.limb)
    assert limb.shape == (32, 3)
    assert np.all(np.diff(limb, axis=0) < 1e-4)
    assert np.all(limb[0] > 1.1)
    assert np.all(limb[-1] < 0.7)
    assert not split(mi.load_dict({"type": "sunsky", "sun_direction": [0.5, 1, 0.8]})).limb


def test_a_diameter_needs_a_sun() -> None:
    with pytest.raises(InputError, match="sun_diameter = 3: with an environment map there is no sun unless sun says where"):
        load(Path(__file__).parents[1] / "unit" / "data" / "tiles.vdb", env="sky.exr", sun_diameter=3)


def test_the_table_of_what_a_middle_leaves_out_is_written(mi: Any, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Expected: a row for each sun and diameter, numbers alone in it, between the marks of the page; too few rays are refused."""
    page = tmp_path / "rendering.md"
    page.write_text((root / "docs" / "rendering.md").read_text())
    monkeypatch.setattr(sun_disc, "PAGE", page)
    monkeypatch.setattr(sun_disc, "DIAMETERS", (5.0,))
    assert sun_disc.main(["--rays", "400", "--walks", "2", "--docs"]) == 0
    rows = [line for line in page.read_text().splitlines() if line.startswith(tuple(f"| {name} |" for name in sun_disc.SUNS))]
    assert len(rows) == len(sun_disc.SUNS)
    assert all(" 5 |" in row and "nan" not in row for row in rows)
    with pytest.raises(InputError, match="--rays 16: "):
        sun_disc.main(["--rays", "16"])
