"""The render command, the Python function and the integrator plugin, with walks or a stand-in in the network's place."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import deepclouds_runtime
import numpy as np
import pytest
from deepclouds_runtime.between_albedos import TOLD
from deepclouds_runtime.loading import load
from deepclouds_runtime.render import main
from deepclouds_runtime.result import COLOURS, LAYERS, RenderResult
from numpy.typing import NDArray

from deepclouds.errors import InputError
from deepclouds.exr import read_exr, write_exr
from deepclouds.volume import Volume, write_vol

SCENE = """<scene version="3.0.0">
  <default name="integrator" value="volpath"/><default name="size" value="12"/>
  <integrator type="$integrator"><integer name="max_depth" value="-1"/><integer name="rr_depth" value="1000000"/></integrator>
  <sensor type="perspective">
    <float name="fov" value="42"/><transform name="to_world"><lookat origin="1, 1.2, 4.2" target="0, -0.1, 0" up="0, 1, 0"/></transform>
    <sampler type="independent"><integer name="sample_count" value="4"/></sampler>
    <film type="hdrfilm"><integer name="width" value="$size"/><integer name="height" value="$size"/><rfilter type="box"/></film>
  </sensor>
  <emitter type="directional"><vector name="direction" value="-0.5, -1, -0.8"/><rgb name="irradiance" value="3 2 1"/></emitter>
  <emitter type="constant"><rgb name="radiance" value="0.2 0.3 0.5"/></emitter>
  <shape type="cube"><bsdf type="null"/>
    <medium type="heterogeneous" name="interior">
      <float name="scale" value="4"/><rgb name="albedo" value="1 0.9 0.5"/><phase type="hg"><float name="g" value="0.4"/></phase>
      <volume type="gridvolume" name="sigma_t"><string name="filename" value="density.vol"/>
        <transform name="to_world"><translate x="-0.5" y="-0.5" z="-0.5"/><scale value="2"/></transform></volume>
    </medium></shape>
  <shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="4"/><translate y="-1.2"/></transform>
    <bsdf type="diffuse"/></shape>
</scene>"""


class Constant:
    """A network that always says the same, and keeps what it was asked."""

    def __init__(self, value: float = 0.7) -> None:
        self.value = value
        self.stencils: list[NDArray[np.float32]] = []
        self.aux: list[NDArray[np.float32]] = []

    def predict(self, stencil: NDArray[np.float32], aux: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return j (n,)."""
        self.stencils.append(stencil.copy())
        self.aux.append(aux.copy())
        return np.full(len(aux), self.value, np.float32)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("render")
    z, y, x = np.meshgrid(*((np.arange(n) + 0.5) / n * 2 - 1 for n in (8, 9, 10)), indexing="ij")
    density = np.clip(1.2 - np.sqrt(x * x + y * y + z * z), 0, 1).astype(np.float32)
    write_vol(path / "density.vol", Volume.from_box(density, (-1, -1, -1), (1, 1, 1)))
    (path / "scene.xml").write_text(SCENE)
    return path


@pytest.fixture(autouse=True)
def mi(llvm_mitsuba: ModuleType) -> ModuleType:
    return llvm_mitsuba


def _layers_add_up(channels: dict[str, Any]) -> None:
    for colour in COLOURS:
        parts = sum(channels[f"{layer}.{colour}"].astype(np.float64) for layer in LAYERS)
        np.testing.assert_allclose(channels[colour], parts, rtol=1e-5, atol=1e-7)


def test_the_command_writes_every_channel_and_its_settings(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "image.exr"
    arguments = [str(folder / "scene.xml"), "-o", str(out), "--spp", "2", "--seed", "5", "-Dsize=10", "--unbiased", "--png"]
    assert main(arguments) == 0
    image = read_exr(out)
    layers = {f"{layer}.{c}" for layer in LAYERS for c in COLOURS}
    assert set(image.channels) == layers | set("RGBA") | {"volume_opacity", "volume_Z"}
    assert image.channels["R"].shape == (10, 10)
    _layers_add_up(image.channels)
    for layer in LAYERS:
        assert image.channels[f"{layer}.R"].max() > 0, layer
    settings = json.loads(str(image.attributes["deepclouds"]))
    assert settings["spp"] == 2
    assert settings["seed"] == 5
    assert settings["defines"] == {"size": "10"}
    # Enough to make it again.
    assert "--seed 5" in settings["command"]
    assert settings["version"]
    assert settings["mitsuba_variant"] == "llvm_ad_rgb"
    assert len(settings["suns"][0]["omega_sun"]) == 3
    assert np.shape(settings["camera"]["to_world"]) == (4, 4)
    assert out.with_suffix(".png").is_file()
    printed = capsys.readouterr().out
    assert "walks" in printed
    assert "time:" in printed


def test_the_distance_channel_is_that_of_the_cloud(folder: Path) -> None:
    result = load(folder / "scene.xml", predictor=Constant()).render(16)
    hidden = result.channels["volume_opacity"] > 0.5
    distance = result.channels["volume_Z"]
    # The ball has radius 1.2 at most; the camera is 4.46 from its middle.
    assert np.all((distance[hidden] > 3) & (distance[hidden] < 5))
    assert distance[result.channels["volume_opacity"] == 0].max(initial=0) == 0


def test_a_volume_needs_nothing_but_its_name(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "cloud.exr"
    arguments = [
        str(folder / "density.vol"),
        "-o",
        str(out),
        "--unbiased",
        "--spp",
        "1",
        "--size",
        "20x10",
        "--view",
        "-30,20",
        "--quiet",
    ]
    assert main(arguments) == 0
    assert capsys.readouterr().out == ""
    image = read_exr(out)
    opacity = image.channels["volume_opacity"]
    assert opacity.shape == (10, 20)
    # The camera is framed on the cloud: it fills much of the height and leaves the corners empty.
    assert opacity[:, 8:12].max(axis=1).min() >= 0
    assert opacity[5, 10] > 0.9
    assert opacity[[0, 0, -1, -1], [0, -1, 0, -1]].max() == 0
    assert image.channels["B"][0, 0] == pytest.approx(0.34, rel=1e-5)


@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("azimuth", [0, 90, 200])
def test_sun_and_view_angles_agree(folder: Path, up: str, azimuth: float) -> None:
    """A sun behind the camera lights what the camera sees: brightest when azimuth and elevation are the same."""
    images = {}
    for name, sun in (("front", azimuth), ("back", azimuth + 180)):
        options: dict[str, Any] = {"sun": (sun, 10), "view": (azimuth, 10), "up": up, "sky": 0.0, "g": 0.0, "size": (8, 8), "max_depth": 2}
        images[name] = load(folder / "density.vol", **options).render(8).rgb.mean()
    assert images["front"] > 5 * images["back"]


@pytest.mark.parametrize("up", ["y", "z"])
def test_an_environment_map_stands_upright(folder: Path, tmp_path: Path, up: str) -> None:
    sky = np.zeros((64, 128), np.float32)
    sky[:32] = 1  # the upper half shines
    write_exr(tmp_path / "sky.exr", dict.fromkeys("RGB", sky))
    result = load(
        folder / "density.vol", env=str(tmp_path / "sky.exr"), up=up, view=(20, 0), size=(9, 9), optical_depth=0.0, max_depth=2
    ).render(4)
    assert result.rgb[:3].min() == pytest.approx(1, abs=1e-5)
    assert result.rgb[6:].max() == pytest.approx(0, abs=1e-5)


def test_optical_depth_sets_the_densest_line_along_the_longest_axis() -> None:
    from deepclouds_runtime.volume_scene import VolumeOptions, extinction

    density = np.zeros((4, 3, 6), np.float32)
    density[2, 1] = 0.5
    density[:, 0, 0] = 8.0  # the densest line along z does not count: x is the longest axis
    volume = Volume.from_box(density, (0, 0, 0), (12, 3, 4))
    assert extinction(volume, VolumeOptions(optical_depth=20.0), "") * 8.0 * 2.0 == pytest.approx(20)
    assert extinction(volume, VolumeOptions(extinction=0.25), "") == 0.25


def test_equal_albedos_are_asked_for_once_and_of_three_two(folder: Path) -> None:
    network = Constant()
    renderer = load(folder / "scene.xml", predictor=network, interreflection=False, environment_directions=1)
    result = renderer.render(4, seed=1)
    rows = np.concatenate(network.aux)
    assert set(np.unique(rows[:, 4]).round(6)) == {0.5, np.float32(0.9).round(6), 1.0}
    assert result.counts.queries == len(rows)
    assert np.all(rows[:, 1] == np.float32(0.4))
    assert np.all(rows[:, 2:4] == (0, 1))
    grey = Constant()
    (folder / "grey.xml").write_text(SCENE.replace("1 0.9 0.5", "0.9 0.9 0.9"))
    counts = load(folder / "grey.xml", predictor=grey, interreflection=False, environment_directions=1).render(4, seed=1).counts
    # Some queries of all three tell where the one in the middle lies.
    told = 3 * TOLD * len(result.statistics.sources)
    assert result.counts.queries == 2 * counts.queries + told
    assert result.statistics.skipped["albedos between two others"] == counts.queries


def test_two_lobes_reach_the_network(folder: Path) -> None:
    network = Constant()
    load(folder / "density.vol", predictor=network, phase=(0.8, -0.3, 0.7), size=(8, 8)).render(1)
    assert np.all(np.concatenate(network.aux)[:, 1:4] == np.array((0.8, -0.3, 0.7), np.float32))


def test_a_constant_network_gives_the_known_radiance(folder: Path) -> None:
    """With j constant, J = albedo^2 E j / (4 pi) everywhere, and the indirect layer is opacity times it."""
    options: dict[str, Any] = {"sun": (30, 30), "irradiance": (3, 2, 1), "sky": 0.0, "albedo": (1, 0.9, 0.5), "size": (12, 12)}
    result = load(folder / "density.vol", predictor=Constant(0.7), **options).render(64, seed=2)
    opacity = result.channels["volume_opacity"]
    for colour, irradiance, albedo in zip(COLOURS, (3, 2, 1), (1, 0.9, 0.5), strict=True):
        expected = opacity * albedo**2 * irradiance * 0.7 / (4 * np.pi)
        np.testing.assert_allclose(result.channels[f"volume_indirect.{colour}"][opacity > 0.3], expected[opacity > 0.3], rtol=0.02)


def _close(a: RenderResult, b: RenderResult) -> bool:
    return all(np.allclose(a.channels[name], b.channels[name], rtol=1e-4, atol=1e-6) for name in a.channels)


def test_a_seed_gives_one_image(folder: Path) -> None:
    renderer = load(folder / "scene.xml", predictor=Constant())
    first, again, other = (renderer.render(3, seed=s) for s in (4, 4, 5))
    assert _close(first, again)
    assert not _close(first, other)
    fresh = load(folder / "scene.xml", predictor=Constant()).render(3, seed=4)
    assert _close(first, fresh)
    assert first.seconds["total"] > 0


def test_passes_do_not_show(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from deepclouds_runtime import frame

    whole = load(folder / "scene.xml", predictor=Constant()).render(4, seed=1)
    monkeypatch.setattr(frame, "_PASS", 4 * 31)
    shares: list[float] = []
    parts = load(folder / "scene.xml", predictor=Constant()).render(4, seed=1, progress=shares.append)
    assert _close(whole, parts)
    assert len(shares) == -(-144 // 31)
    assert shares[-1] == 1


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["missing.xml"], "missing.xml"),
        (["scene.xml", "-Dfoo=1"], "foo"),
        (["scene.xml", "-Dsize=wide"], "wide"),
        (["scene.xml", "-Dsize"], "NAME=VALUE"),
        (["scene.xml", "--g", "0.5"], "belongs to a volume"),
        (["scene.xml", "--clamp"], "belong to a volume"),
        (["scene.xml", "--sensor", "3"], "sensor 3"),
        (["scene.xml", "--max-depth", "5"], "max_depth = 5"),
        (["broken.xml"], "broken.xml"),
        (["text.txt"], "not '.txt'"),
        (["density.vol", "--g", "1"], "between -1 and 1"),
        (["density.vol", "--g", "0.5", "--phase", "0.5,0,1"], "leave one out"),
        (["density.vol", "--phase", "0.9,-1,0.5"], "phase = (0.9, -1.0, 0.5)"),
        (["density.vol", "--phase", "0.9,0.1,1.5"], "weight of the first in 0 to 1"),
        (["density.vol", "--phase", "nan,0.1,0.5"], "phase = (nan"),
        (["density.vol", "--albedo", "1.5"], "0 to 1"),
        (["density.vol", "--optical-depth", "-3"], "not negative"),
        (["density.vol", "--optical-depth", "nan"], "finite"),
        (["density.vol", "--optical-depth", "3", "--extinction", "2"], "leave one out"),
        (["density.vol", "--env", "missing.exr"], "no such environment map"),
        (["density.vol", "--grid", "x"], "one grid"),
        (["density.vol", "-Dx=1"], "no meaning for a volume"),
        (["density.vol", "--model", "missing.onnx"], "missing.onnx"),
        (["scene.xml", "-Dsize=0"], "0 x 0 pixels"),
        (["density.vol", "--size", "1000000x1000000"], "smaller size"),
        (["density.vol", "--spp", "1000000000", "--max-depth", "2"], "spp = 1000000000"),
        (["density.vol", "--threads", "99999999999"], "threads = 99999999999"),
        (["density.vol", "--exposure", "nan"], "exposure = nan"),
        (["density.vol", "--exposure", "1e9", "--png"], "exposure = 1e+09"),
        (["density.vol", "--extinction", "1e38"], "extinction = 1e+38"),
        (["density.vol", "--optical-depth", "1e38"], "optical_depth = 1e+38"),
        (["density.vol", "--irradiance", "1e38"], "at most"),
        (["density.vol", "--irradiance", "-3,1,1"], "(-3.0, 1.0, 1.0)"),
        (["density.vol", "--sun", "0,100"], "between -90 and 90"),
        (["density.vol", "--env", "text.txt", "--sky", "1"], "env and sky"),
        (["density.vol", "--env", "text.txt", "--irradiance", "1"], "there is no sun"),
    ],
)
def test_bad_input_is_named(folder: Path, tmp_path: Path, arguments: list[str], said: str) -> None:
    (folder / "broken.xml").write_text('<scene version="3.0.0"><sensor type="persp')
    (folder / "text.txt").write_text("no scene")
    with pytest.raises(InputError) as caught:
        main([str(folder / arguments[0]), *arguments[1:], "-o", str(tmp_path / "image.exr")])
    assert said in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_a_file_that_is_no_environment_map_is_named(folder: Path) -> None:
    (folder / "text.txt").write_text("no map")
    with pytest.raises(InputError, match=r"text\.txt: not an environment map"):
        load(folder / "density.vol", env=str(folder / "text.txt"), max_depth=2)


@pytest.mark.parametrize("view", [(0, 5), (40, 60), (200, -90)])
def test_the_camera_frames_the_cloud_tightly(tmp_path: Path, view: tuple[float, float]) -> None:
    density = np.zeros((20, 24, 30), np.float32)
    density[3:9, 4:9, 2:25] = 1  # off the middle of the grid
    density[9:17, 4:20, 2:6] = 0.5
    density[19, 23, 29] = 1e-4  # haze far away
    write_vol(tmp_path / "ell.vol", Volume.from_box(density, (0, 0, 0), (30, 24, 20)))
    result = load(tmp_path / "ell.vol", view=view, size=(40, 30), optical_depth=2000.0, max_depth=2).render(4)
    shown = result.channels["volume_opacity"] > 0.5
    assert shown[1:-1, 1:-1].sum() == shown.sum()
    rows, columns = np.flatnonzero(shown.any(axis=1)), np.flatnonzero(shown.any(axis=0))
    assert max(np.ptp(rows) / 30, np.ptp(columns) / 40) > 0.7


@pytest.mark.parametrize("out", ["nowhere/image.exr", "image.png"])
def test_a_bad_output_is_refused_before_the_work(folder: Path, tmp_path: Path, out: str) -> None:
    with pytest.raises(InputError, match=r"does not exist|must end in"):
        main([str(folder / "scene.xml"), "-o", str(tmp_path / out)])


@pytest.mark.parametrize(
    "text", [["--sun", "1"], ["--size", "20"], ["--spp", "0"], ["--seed", "-1"], ["--albedo", "1,2"], ["--phase", "0.5,0"]]
)
def test_malformed_numbers_end_in_code_2(folder: Path, tmp_path: Path, text: list[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main([str(folder / "density.vol"), "-o", str(tmp_path / "a.exr"), *text])
    assert caught.value.code == 2


def test_the_plugin_renders_like_the_function(folder: Path, mi: Any) -> None:
    scene = mi.load_file(str(folder / "scene.xml"))
    plugin = mi.load_dict({"type": "deepclouds", "unbiased": True, "rr_depth": 1000000})
    image = np.array(mi.render(scene, integrator=plugin, spp=4, seed=3))
    ours = deepclouds_runtime.render(scene, spp=4, seed=3, unbiased=True)
    assert image.shape == (12, 12, 3)
    np.testing.assert_allclose(image, ours.rgb, rtol=1e-4, atol=1e-6)
    assert np.array(scene.sensors()[0].film().bitmap()).shape == (12, 12, 3)
    assert np.array(plugin.render(scene, spp=1, develop=False)).size == 0
    named = mi.load_file(str(folder / "scene.xml"), integrator="deepclouds")
    assert "DeepCloudsIntegrator" in str(named.integrator())


def test_the_plugin_says_what_it_refuses(folder: Path, mi: Any) -> None:
    (folder / "point.xml").write_text(SCENE.replace('type="constant"><rgb name="radiance" value="0.2 0.3 0.5"/>', 'type="point">'))
    scene = mi.load_file(str(folder / "point.xml"))
    plugin = mi.load_dict({"type": "deepclouds", "max_depth": 2})
    with pytest.raises(InputError, match="PointLight"):
        plugin.render(scene, spp=1)
    # mi.render wraps every plugin's errors into its own.
    with pytest.raises(RuntimeError) as caught:
        mi.render(scene, integrator=plugin, spp=1)
    assert "PointLight" in str(caught.value.__cause__)


def test_interreflection_adds_light_to_surfaces_and_cloud(folder: Path) -> None:
    with_it, without = (load(folder / "scene.xml", predictor=Constant(), interreflection=i).render(16, seed=1) for i in (True, False))
    for layer in ("surface.R", "volume_direct.R", "volume_indirect.R"):
        assert with_it.channels[layer].mean() > 1.02 * without.channels[layer].mean(), layer


def test_the_plugin_keeps_the_films_pixel_format(folder: Path, mi: Any) -> None:
    for pixel_format, channels in (("rgba", 4), ("luminance", 1)):
        text = SCENE.replace('<rfilter type="box"/>', f'<string name="pixel_format" value="{pixel_format}"/><rfilter type="box"/>')
        (folder / f"{pixel_format}.xml").write_text(text)
        scene = mi.load_file(str(folder / f"{pixel_format}.xml"))
        assert mi.load_dict({"type": "deepclouds", "max_depth": 2}).render(scene, spp=1).shape == (12, 12, channels)


def test_mono_and_colour_agree_where_all_is_grey(folder: Path, mi: Any) -> None:
    grey = SCENE.replace("1 0.9 0.5", "0.8 0.8 0.8").replace("3 2 1", "2 2 2").replace("0.2 0.3 0.5", "0.3 0.3 0.3")
    grey = grey.replace('<rfilter type="box"/>', '<string name="pixel_format" value="luminance"/><rfilter type="box"/>')
    (folder / "mono.xml").write_text(grey)
    images = {}
    for variant in ("llvm_ad_rgb", "llvm_ad_mono"):
        mi.set_variant(variant)
        images[variant] = load(folder / "mono.xml", predictor=Constant()).render(4, seed=1)
    assert images["llvm_ad_mono"].rgb.shape == (12, 12, 3)
    assert _close(images["llvm_ad_rgb"], images["llvm_ad_mono"])


def test_other_path_lengths_and_variants_are_refused(folder: Path, mi: Any) -> None:
    with pytest.raises(RuntimeError, match="max_depth = 7"):
        mi.load_dict({"type": "deepclouds", "max_depth": 7})
    mi.set_variant("scalar_rgb")
    with pytest.raises(RuntimeError, match="does not run in Mitsuba's variant 'scalar_rgb'"):
        mi.load_dict({"type": "deepclouds"})
    with pytest.raises(InputError, match="scalar_rgb"):
        load(folder / "scene.xml", unbiased=True)


ORDERS = {
    "runtime first": "import deepclouds_runtime; import mitsuba as mi; mi.set_variant('llvm_ad_rgb')",
    "mitsuba first": "import mitsuba as mi; import deepclouds_runtime; mi.set_variant('llvm_ad_rgb')",
    "variant first": "import mitsuba as mi; mi.set_variant('llvm_ad_rgb'); import deepclouds_runtime",
    "another variant": "import mitsuba as mi; mi.set_variant('scalar_rgb'); import deepclouds_runtime; mi.set_variant('llvm_ad_mono')",
}


@pytest.mark.parametrize("order", ORDERS)
def test_the_plugin_is_registered_in_any_order(root: Path, order: str) -> None:
    code = f"{ORDERS[order]}; print(mi.load_dict({{'type': 'deepclouds', 'max_depth': 2}}).max_depth)"
    run = _python(root, "-c", code)
    assert run.returncode == 0, run.stderr
    assert run.stdout.strip() == "2"


def test_help_loads_no_renderer(root: Path) -> None:
    code = (
        "import sys\nfrom deepclouds_runtime.render import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "print([m for m in ('mitsuba', 'drjit', 'torch', 'onnxruntime') if m in sys.modules])"
    )
    run = _python(root, "-c", code)
    assert run.returncode == 0, run.stderr
    assert run.stdout.strip().endswith("[]")


def _python(root: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    import os

    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(str(root / part) for part in (".", "training", "runtime"))}
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, env=environment, check=False, timeout=120)


def test_the_demonstration(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from deepclouds_runtime.demo import main as demo

    assert demo(["--out", str(tmp_path / "out"), "--size", "24", "--spp", "1", "--unbiased"]) == 0
    assert read_exr(tmp_path / "out" / "demo.exr").channels["volume_opacity"].max() > 0.9
    assert (tmp_path / "out" / "demo.png").is_file()
    assert "demo.png" in capsys.readouterr().out


def test_predictions_at_points_follow_the_contract() -> None:
    volume = Volume.from_box(np.ones((2, 2, 2), np.float32), (0, 0, 0), (2, 2, 2))
    network = Constant(0.5)
    points = np.array([[1, 1, 1], [1, 1, 2], [1, 1, 0.5]])
    w = np.array([[0, 0, 1], [0, 0, -1], [1, 0, 0]])
    source = deepclouds_runtime.predict(points, w, volume=volume, scale=3.0, g=0.3, albedo=0.5, omega_sun=(0, 0, 1), predictor=network)
    np.testing.assert_allclose(source, 0.25 * 0.5 / (4 * np.pi))
    aux = np.concatenate(network.aux)
    np.testing.assert_allclose(aux[:, 0], [0, np.pi, np.pi / 2], atol=1e-6)
    np.testing.assert_allclose(aux[:, 5], np.log1p([3.0, 0.0, 4.5]), rtol=1e-5)
    assert deepclouds_runtime.predict(points, w, volume=volume, scale=3.0, g=0.3, albedo=0.0, omega_sun=(0, 0, 1)).max() == 0
    with pytest.raises(ValueError, match="shape"):
        deepclouds_runtime.predict(points, w[:2], volume=volume, scale=3.0, g=0.3, albedo=0.5, omega_sun=(0, 0, 1), predictor=network)
