"""What is read out of a Mitsuba scene, and what is refused by name."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np
import pytest
from deepclouds_runtime.loading import load as load_renderer
from deepclouds_runtime.placement import box_transform, cube_transform, locate, orientations
from deepclouds_runtime.scene import CloudScene, check_depth, read_scene
from deepclouds_runtime.sunsky import split

from deepclouds.errors import InputError
from deepclouds.medium.phase import two_lobe_numpy

FILM = '<film type="hdrfilm"><integer name="width" value="6"/><integer name="height" value="4"/>{film}</film>'
CAMERA = f'<sensor type="perspective">{FILM}</sensor>'
BOX = '<rfilter type="box"/>'
SUN = '<emitter type="directional"><vector name="direction" value="0, -2, 0"/><rgb name="irradiance" value="3 2 1"/></emitter>'
HG = '<phase type="hg"><float name="g" value="0.3"/></phase>'
ALBEDO = '<rgb name="albedo" value="0.9 0.8 0.7"/>'
GRID = (
    '<volume type="gridvolume" name="sigma_t"><string name="filename" value="density.vol"/>{extra}'
    '<transform name="to_world">{turn}</transform></volume>'
)
PLACE = '<translate x="-0.5" y="-0.5" z="-0.5"/><scale value="2"/>'
MEDIUM = '<medium type="heterogeneous" name="interior"><float name="scale" value="5"/>{grid}{albedo}{phase}</medium>'
CLOUD = '<shape type="{shape}"><transform name="to_world">{turn}</transform>{bsdf}{medium}</shape>'
NULL = '<bsdf type="null"/>'


@pytest.fixture(autouse=True)
def mi(llvm_mitsuba: ModuleType) -> ModuleType:
    return llvm_mitsuba


@pytest.fixture
def folder(tmp_path: Path, mi: Any) -> Path:
    density = np.random.default_rng(3).random((5, 6, 7)).astype(np.float32)
    mi.VolumeGrid(density[..., None]).write(str(tmp_path / "density.vol"))
    mi.VolumeGrid(np.random.default_rng(4).random((5, 6, 7, 3)).astype(np.float32)).write(str(tmp_path / "colours.vol"))
    mi.VolumeGrid(np.full((2, 2, 2, 3), 1.5, np.float32)).write(str(tmp_path / "bright.vol"))
    return tmp_path


def cloud(
    turn: str = "",
    grid_turn: str | None = None,
    extra: str = "",
    shape: str = "cube",
    bsdf: str = NULL,
    albedo: str = ALBEDO,
    phase: str = HG,
) -> str:
    """A container with a heterogeneous medium, the grid in its box unless `grid_turn` places it elsewhere."""
    grid = GRID.format(turn=PLACE + (turn if grid_turn is None else grid_turn), extra=extra)
    return CLOUD.format(shape=shape, turn=turn, bsdf=bsdf, medium=MEDIUM.format(grid=grid, albedo=albedo, phase=phase))


def tint(turn: str = "", file: str = "colours.vol") -> str:
    """An albedo on a grid of its own."""
    return GRID.format(turn=PLACE + turn, extra="").replace("sigma_t", "albedo").replace("density.vol", file)


def load(mi: Any, folder: Path, content: str, camera: str = CAMERA.format(film=BOX)) -> Any:
    """Load a scene from text."""
    file = folder / "scene.xml"
    file.write_text(f'<scene version="3.0.0">{camera}{content}</scene>')
    return mi.load_file(str(file))


TURNS = {
    "plain": "",
    "scaled": '<scale x="0.7" y="2" z="1.1"/><translate x="3" y="-2" z="1"/>',
    "upright": '<rotate x="1" angle="-90"/>',
    "quarter turn": '<rotate y="1" angle="90"/><scale x="1.5" y="1" z="1"/>',
    "mirrored": '<scale x="-1" y="1" z="1"/>',
    "rotated": '<rotate x="0.6" y="0" z="-0.8" angle="37"/><scale value="1.3"/><translate x="0.5" y="0" z="0"/>',
    "large": '<scale value="4000"/>',
    "small": '<scale value="0.0004"/>',
}


@pytest.mark.parametrize("name", TURNS)
def test_the_grid_lies_where_mitsuba_has_it(mi: Any, folder: Path, name: str) -> None:
    scene = load(mi, folder, cloud(TURNS[name]) + SUN)
    read = read_scene(scene)
    unit = np.random.default_rng(9).random((100, 3))
    points = unit @ read.volume.to_world[:3, :3].T + read.volume.to_world[:3, 3]
    interaction = mi.MediumInteraction3f()
    theirs = []
    medium = scene.shapes()[0].interior_medium()
    for p in points:
        interaction.p = mi.Point3f(*p.tolist())
        theirs.append(float(medium.get_scattering_coefficients(interaction)[2][0][0]))
    error = np.abs(read.scale * read.volume.sample(points) - theirs)
    assert np.quantile(error, 0.95) < 0.01
    assert read.scale == 5
    np.testing.assert_allclose(read.albedo, (0.9, 0.8, 0.7), rtol=1e-6)
    assert read.phase == pytest.approx((0.3, 0, 1))


def test_lights_camera_and_integrator(mi: Any, folder: Path) -> None:
    integrator = '<integrator type="volpath"><integer name="max_depth" value="2"/><boolean name="hide_emitters" value="true"/></integrator>'
    constant = '<emitter type="constant"/>'
    floor = '<shape type="rectangle"><bsdf type="diffuse"/></shape>'
    read = read_scene(load(mi, folder, integrator + cloud() + SUN + SUN + constant + floor))
    assert read.max_depth == 2
    assert read.hide_emitters
    assert len(read.suns) == 2
    np.testing.assert_allclose(read.suns[0].omega_sun, (0, 1, 0), atol=1e-6)
    np.testing.assert_allclose(read.suns[0].irradiance, (3, 2, 1))
    assert read.environment is not None
    assert read.backdrop is read.environment
    assert len(read.surfaces.shapes()) == 1
    assert read.size == (6, 4)
    assert read_scene(load(mi, folder, cloud())).surfaces is None
    assert not read_scene(load(mi, folder, integrator + cloud()), hide_emitters=False).hide_emitters


@pytest.mark.parametrize(
    "options",
    [
        {"sun_direction": [0.3, 0.2, 0.9], "turbidity": 3.0},
        {"sun_direction": [0.3, 0.2, 0.9], "sun_aperture": 4.0, "complex_sun": True, "sun_scale": 20.0},
        {"hour": 9.0, "latitude": 47.0, "month": 5, "upright": True, "sky_scale": 0.5},
    ],
)
def test_a_sunsky_becomes_a_sky_and_a_sun(mi: Any, options: dict[str, Any]) -> None:
    """The sun's irradiance is that of the emitter's own samples of the disc; beside the disc the sky is the emitter's own."""
    options = dict(options)
    if options.pop("upright", False):
        options["to_world"] = mi.ScalarTransform4f().rotate([1, 0, 0], -90)
    emitter = mi.load_dict({"type": "sunsky", "albedo": {"type": "rgb", "value": [0.2, 0.4, 0.1]}, **options})
    parts = split(emitter)
    assert parts.aperture == pytest.approx(options.get("sun_aperture", 0.5358))
    random = np.random.default_rng(5)
    sample, weight = emitter.sample_direction(dr.zeros(mi.Interaction3f, 100_000), mi.Point2f(random.random((2, 100_000))))
    directions, weights = np.array(sample.d).T, np.array(weight).T
    cosine = directions @ parts.omega_sun
    disc = cosine > np.cos(np.deg2rad(parts.aperture / 2))
    sky = np.array(_eval(mi, parts.sky, directions))
    share = (weights - sky / np.array(sample.pdf)[:, None]) * (cosine * disc)[:, None]
    np.testing.assert_allclose(parts.irradiance, share.mean(axis=0), rtol=0.02)
    assert disc.mean() > 0.1
    away = cosine < np.cos(np.deg2rad(parts.aperture / 2 + 0.1))
    np.testing.assert_allclose(sky[away], np.array(_eval(mi, emitter, directions))[away], rtol=1e-4, atol=1e-6)


def _eval(mi: Any, emitter: Any, directions: Any) -> Any:
    interaction = dr.zeros(mi.SurfaceInteraction3f, len(directions))
    interaction.wi = mi.Vector3f(np.ascontiguousarray(-directions.T, np.float32))
    return np.array(emitter.eval(interaction)).T


def test_a_scene_under_a_sunsky(mi: Any, folder: Path) -> None:
    light = '<emitter type="sunsky"><vector name="sun_direction" value="0.3, 0.2, 0.9"/><float name="sun_scale" value="{0}"/></emitter>'
    scene = load(mi, folder, cloud() + light.format(1))
    read = read_scene(scene)
    assert len(read.suns) == 1
    np.testing.assert_allclose(read.suns[0].omega_sun, np.array([0.3, 0.2, 0.9]) / np.linalg.norm([0.3, 0.2, 0.9]), atol=1e-6)
    assert read.backdrop is not read.environment
    assert read.suns[0].radius == pytest.approx(np.deg2rad(0.5358 / 2), rel=1e-3)
    assert not read.suns[0].shown
    without = read_scene(load(mi, folder, cloud() + light.format(0)))
    assert not without.suns


def test_homogeneous_media(mi: Any, folder: Path) -> None:
    medium = (
        f'<medium type="homogeneous" name="interior"><float name="sigma_t" value="2"/><float name="scale" value="3"/>{ALBEDO}{HG}</medium>'
    )
    turn = TURNS["rotated"]
    read = read_scene(load(mi, folder, CLOUD.format(shape="cube", turn=turn, bsdf=NULL, medium=medium)))
    assert read.volume.density.min() == read.volume.density.max() == 1
    assert read.scale == pytest.approx(6)
    center = read.volume.to_world @ (0.5, 0.5, 0.5, 1)
    np.testing.assert_allclose(center[:3], (0.5, 0, 0), atol=1e-6)
    ball = read_scene(load(mi, folder, CLOUD.format(shape="sphere", turn='<translate x="2" y="0" z="0"/>', bsdf=NULL, medium=medium)))
    volume = ball.volume.density.sum() * np.prod(ball.volume.voxel_size)
    assert volume == pytest.approx(4 / 3 * np.pi, rel=2e-3)
    assert ball.volume.sample(np.array([[2, 0, 0], [2.95, 0, 0], [2.9, 0.6, 0]])).tolist() == [1, 1, 0]


def test_several_clouds_share_a_grid(mi: Any, folder: Path) -> None:
    """As much extinction as the media hold together, each where Mitsuba has it."""
    turns = ["", '<rotate y="1" angle="40"/><scale value="0.7"/><translate x="3.2" y="1.4" z="0.3"/>', '<translate x="0" y="2" z="0"/>']
    scene = load(mi, folder, "".join(cloud(turn) for turn in turns))
    read = read_scene(scene)
    assert "3 clouds" in read.notes[0]
    single = [read_scene(load(mi, folder, cloud(turn))) for turn in turns]

    def content(part: CloudScene) -> float:
        box = abs(float(np.linalg.det(part.volume.to_world[:3, :3])))
        return part.scale * float(part.volume.density.mean(dtype=np.float64)) * box

    assert content(read) == pytest.approx(sum(content(part) for part in single), rel=0.01)
    points = np.random.default_rng(2).uniform(-1, 4, (4000, 3))
    found = read.scale * read.volume.sample(points)
    truth = np.sum([part.scale * part.volume.sample(points) for part in single], axis=0)
    # Noise of one value a voxel is the hardest to resample.
    assert np.corrcoef(found, truth)[0, 1] > 0.95


def test_boxes_that_touch_or_only_seem_to_overlap_are_apart(mi: Any, folder: Path) -> None:
    edgewise = '<rotate y="1" angle="45"/><translate x="2.2" y="0" z="2.2"/>'
    for turn in ('<translate x="2" y="0" z="0"/>', edgewise):
        assert "2 clouds" in read_scene(load(mi, folder, cloud() + cloud(turn))).notes[0]


def test_other_pixel_filters_are_noted(mi: Any, folder: Path) -> None:
    read = read_scene(load(mi, folder, cloud(), CAMERA.format(film='<rfilter type="gaussian"/>')))
    assert any("GaussianFilter" in note for note in read.notes)
    assert not read_scene(load(mi, folder, cloud())).notes


AWAY = '<translate x="5" y="0" z="0"/>'
BLEND = '<phase type="blendphase"><float name="weight" value="0.25"/>{0}{1}</phase>'
LOBE = '<phase type="hg"><float name="g" value="{0}"/></phase>'
ISOTROPIC = '<phase type="isotropic"/>'
WEIGHTS = '<volume type="gridvolume" name="weight"><string name="filename" value="density.vol"/></volume>'


@pytest.mark.parametrize(
    ("phase", "lobes"),
    [
        (LOBE.format(0.3), (0.3, 0, 1)),
        (ISOTROPIC, (0, 0, 1)),
        (BLEND.format(LOBE.format(0.8), LOBE.format(-0.3)), (0.8, -0.3, 0.75)),
        (BLEND.format(ISOTROPIC, LOBE.format(0.6)), (0, 0.6, 0.75)),
        (BLEND.format(LOBE.format(0.6), ISOTROPIC), (0.6, 0, 0.75)),
    ],
)
def test_phase_functions_are_those_of_mitsuba(mi: Any, folder: Path, phase: str, lobes: tuple[float, float, float]) -> None:
    scene = load(mi, folder, cloud(phase=phase))
    read = read_scene(scene)
    assert read.phase == pytest.approx(lobes)
    theirs = scene.shapes()[0].interior_medium().phase_function()
    interaction = mi.MediumInteraction3f()
    interaction.wi = mi.Vector3f(0, 0, -1)
    interaction.sh_frame = mi.Frame3f(interaction.wi)
    cosines = np.linspace(-0.99, 0.99, 12)
    outgoing = mi.Vector3f(np.sqrt(1 - cosines**2), np.zeros(12), cosines)
    value = np.array(theirs.eval_pdf(mi.PhaseFunctionContext(None), interaction, outgoing)[1])
    np.testing.assert_allclose(two_lobe_numpy(cosines, *read.phase), np.broadcast_to(value, 12), rtol=2e-4)


REFUSED = {
    "no cloud": (SUN, "no shape has an interior medium"),
    "two kinds of cloud": (cloud() + cloud(AWAY, phase=ISOTROPIC), "2 clouds with different phase"),
    "two colours of cloud": (cloud() + cloud(AWAY, albedo=ALBEDO.replace("0.7", "0.6")), "2 clouds with different albedo"),
    "clouds in each other": (cloud() + cloud('<rotate x="0.6" y="0" z="0.8" angle="30"/><translate x="2.1" y="0" z="0"/>'), "overlap"),
    "clouds too far apart": (cloud() + cloud('<translate x="3000" y="2000" z="400"/>'), "fits into memory; render one cloud"),
    "glass around the medium": (cloud(bsdf='<bsdf type="dielectric"/>'), "needs the BSDF `null`"),
    "glass beside the cloud": (cloud() + '<shape type="sphere"><bsdf type="dielectric"/></shape>', "lets light through"),
    "mask": (cloud() + '<shape type="sphere"><bsdf type="mask"><bsdf type="diffuse"/></bsdf></shape>', "lets light through"),
    "area light": (cloud() + '<shape type="sphere"><emitter type="area"/></shape>', "area light"),
    "point light": (cloud() + '<emitter type="point"/>', "PointLight"),
    "spot": (cloud() + '<emitter type="spot"/>', "SpotLight"),
    "rayleigh": (cloud(phase='<phase type="rayleigh"/>'), "phase function Rayleigh"),
    "tabphase": (cloud(phase='<phase type="tabphase"><string name="values" value="0.5, 1, 1.5"/></phase>'), "phase function Tab"),
    "blend with rayleigh": (cloud(phase=BLEND.format(LOBE.format(0.8), '<phase type="rayleigh"/>')), "Rayleigh"),
    "three lobes": (
        cloud(phase=BLEND.format(LOBE.format(0.8), BLEND.format(ISOTROPIC, LOBE.format(0.1)))),
        "BlendPhase in a blendphase",
    ),
    "blend that varies": (
        cloud(phase=BLEND.replace('<float name="weight" value="0.25"/>', WEIGHTS).format(LOBE.format(0.8), LOBE.format(0.1))),
        "weight varies",
    ),
    "blend beyond one": (cloud(phase=BLEND.replace("0.25", "1.25").format(LOBE.format(0.8), LOBE.format(0.1))), "the weight 1.25"),
    "grid of colours": (cloud().replace("density.vol", "colours.vol"), "chromatic extinction"),
    "medium outside a surface": (
        cloud() + '<shape type="sphere"><bsdf type="diffuse"/><medium type="homogeneous" name="exterior"/></shape>',
        "has a medium outside",
    ),
    "medium outside a null surface": (
        cloud() + '<shape type="sphere"><bsdf type="null"/><medium type="homogeneous" name="exterior"/></shape>',
        "has a medium outside",
    ),
    "two clouds of varying albedo": (cloud(albedo=tint()) + cloud(AWAY, albedo=tint(AWAY)), "an albedo that varies in space"),
    "albedo elsewhere": (cloud(albedo=tint('<translate x="0.3"/>')), "cannot place the grid of the albedo"),
    "albedo above one": (cloud(albedo=tint(file="bright.vol")), "values outside of 0 to 1"),
    "nearest": (cloud(extra='<string name="filter_type" value="nearest"/>'), "filter_type"),
    "container too small": (cloud('<scale value="0.6"/>', grid_turn=""), "cuts the cloud"),
    "sphere too small": (cloud(shape="sphere", grid_turn=""), "cuts the cloud"),
    "cylinder": (cloud(shape="cylinder", grid_turn=""), "Cylinder"),
    "chromatic homogeneous": (
        CLOUD.format(
            shape="cube",
            turn="",
            bsdf=NULL,
            medium=f'<medium type="homogeneous" name="interior"><rgb name="sigma_t" value="0.1 0.2 0.3"/>{HG}</medium>',
        ),
        "differs between colours",
    ),
    "depth": ('<integrator type="volpath"><integer name="max_depth" value="6"/></integrator>' + cloud(), "max_depth = 6"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refusals_name_what_they_refuse(mi: Any, folder: Path, name: str) -> None:
    content, said = REFUSED[name]
    scene = load(mi, folder, content)
    with pytest.raises(InputError) as caught:
        read_scene(scene)
    assert said in str(caught.value)


@pytest.mark.parametrize("file", ["colours.vol", "density.vol"])
def test_an_albedo_that_varies_is_read_where_the_medium_has_it(mi: Any, folder: Path, file: str) -> None:
    turn = '<rotate y="1" angle="90"/><scale x="1.3" y="0.8" z="0.9"/><translate x="0.2"/>'
    scene = load(mi, folder, cloud(turn, albedo=tint(turn, file)))
    read = read_scene(scene)
    assert read.varying is not None
    assert read.albedo == read.varying.largest
    medium = scene.shapes()[0].interior_medium()
    matrix = read.volume.to_world
    points = np.random.default_rng(8).uniform(0.01, 0.99, (200, 3)) @ matrix[:3, :3].T + matrix[:3, 3]
    interaction = dr.zeros(mi.MediumInteraction3f, len(points))
    interaction.p = mi.Point3f(points.T.astype(np.float32))
    interaction.medium = mi.MediumPtr(medium)
    sigma_s, _, sigma_t = medium.get_scattering_coefficients(interaction)
    np.testing.assert_allclose(read.varying.sample(points), (np.array(sigma_s) / np.array(sigma_t)).T, atol=2e-4)


def test_without_extinction_any_place_of_the_albedo_will_do(mi: Any, folder: Path) -> None:
    read = read_scene(load(mi, folder, cloud(albedo=tint()).replace('name="scale" value="5"', 'name="scale" value="0"')))
    assert read.scale == 0
    assert read.varying is not None


@pytest.mark.parametrize("kind", ["perspective", "orthographic", "thinlens"])
def test_cameras_and_crop_windows(mi: Any, folder: Path, kind: str) -> None:
    crop = '<integer name="crop_width" value="2"/><integer name="crop_height" value="3"/><integer name="crop_offset_x" value="1"/>'
    camera = CAMERA.format(film=BOX + crop).replace('"perspective">', f'"{kind}">')
    if kind == "thinlens":
        camera = camera.replace('"thinlens">', '"thinlens"><float name="aperture_radius" value="0.1"/>')
    assert read_scene(load(mi, folder, cloud(), camera)).size == (2, 3)


ONE_PIXEL = '<film type="hdrfilm"><integer name="width" value="1"/><integer name="height" value="1"/></film>'


@pytest.mark.parametrize(
    ("camera", "said"),
    [
        (f'<sensor type="radiancemeter">{ONE_PIXEL}</sensor>', "RadianceMeter"),
        (f'<sensor type="distant">{ONE_PIXEL}</sensor>', "Distant"),
        (CAMERA.format(film=BOX).replace('"perspective">', '"perspective"><medium type="homogeneous"/>'), "stands in a medium"),
    ],
)
def test_cameras_that_are_refused(mi: Any, folder: Path, camera: str, said: str) -> None:
    scene = load(mi, folder, cloud(), camera)
    with pytest.raises(InputError, match=said):
        read_scene(scene)


HOMOGENEOUS = '<medium type="homogeneous" name="interior"><float name="scale" value="{scale}"/>{values}</medium>'


@pytest.mark.parametrize(
    ("medium", "said"),
    [
        (
            MEDIUM.format(grid=GRID.format(turn=PLACE, extra=""), albedo=ALBEDO, phase=HG).replace('"5"', '"-5"'),
            "scale = -5: give a finite",
        ),
        (
            HOMOGENEOUS.format(scale=-2, values='<float name="sigma_t" value="-3"/>'),
            "scale = -2: give a finite number that is not negative",
        ),
        (HOMOGENEOUS.format(scale=1, values='<float name="sigma_t" value="-3"/>'), "sigma_t = -3: give a finite number"),
        (HOMOGENEOUS.format(scale=1, values='<float name="sigma_t" value="nan"/>'), "sigma_t = nan: give a finite number"),
        (HOMOGENEOUS.format(scale=1, values='<float name="albedo" value="1.5"/>'), "albedo = 1.5: give values in 0 to 1"),
        (HOMOGENEOUS.format(scale=1, values='<float name="albedo" value="-0.5"/>'), "albedo = -0.5: give values in 0 to 1"),
    ],
)
def test_what_is_out_of_range_is_refused_with_its_file(mi: Any, folder: Path, medium: str, said: str) -> None:
    shape = CLOUD.format(shape="cube", turn="", bsdf=NULL, medium=medium)
    load(mi, folder, shape + SUN)
    with pytest.raises(InputError, match=rf"scene\.xml: the medium's {said}"):
        load_renderer(folder / "scene.xml", unbiased=True)


def test_path_lengths() -> None:
    assert check_depth(-1) == -1
    assert check_depth(0xFFFFFFFF) == -1
    assert check_depth(2) == 2
    for depth in (0, 1, 3, 64):
        with pytest.raises(InputError, match=f"max_depth = {depth}"):
            check_depth(depth)


def test_all_orientations_are_different() -> None:
    matrices = {m.round(6).tobytes() for m in orientations(box_transform(np.zeros(3), np.array([1.0, 2.0, 3.0])))}
    assert len(matrices) == 48


def test_a_wrong_box_is_not_accepted() -> None:
    density = np.random.default_rng(1).random((4, 5, 6)).astype(np.float32)
    right = box_transform(np.zeros(3), np.array([2.0, 2.0, 2.0]))
    wrong = box_transform(np.zeros(3), np.array([2.0, 2.0, 2.3]))

    def sigma_t(points: Any) -> Any:
        from deepclouds.volume import Volume

        return 3.0 * Volume(density, right).sample(points)

    found = locate(density, 3.0, [wrong, right], sigma_t)
    np.testing.assert_allclose(found.to_world, right)
    with pytest.raises(InputError, match="cannot place the grid"):
        locate(density, 3.0, [wrong], sigma_t)


def test_a_sheared_cube_is_recovered_and_a_bent_one_is_not() -> None:
    canonical = np.array(list(np.ndindex(2, 2, 2)), np.float64) * 2 - 1
    matrix = np.array([[1, 0.3, 0, 1], [0, 2, 0.1, 2], [0.2, 0, 1, 3]])
    positions = canonical @ matrix[:, :3].T + matrix[:, 3]
    found = cube_transform(positions, canonical)
    assert found is not None
    np.testing.assert_allclose(found @ (1, 1, 1, 1), [*(matrix @ (1, 1, 1, 1)), 1], atol=1e-12)
    positions[3] += 0.5
    assert cube_transform(positions, canonical) is None
