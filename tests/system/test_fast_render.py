"""Rationale: the fast mode interpolates what the reference mode asks of the network, so that both must give one image.

Expected behaviour: with a smooth stand-in for the network, means of the image, and of its tiles, differ by no more than the interpolation
may err by, in dense and thin clouds, at hard edges, from inside, under skies, in colour and beside surfaces; samples cost no queries.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from deepclouds_runtime import frame
from deepclouds_runtime.loading import load
from deepclouds_runtime.result import RenderResult
from numpy.typing import NDArray

from deepclouds.errors import InputError
from deepclouds.exr import write_exr
from deepclouds.volume import Volume, write_vol

SIZE = 32
SUN = '<emitter type="directional"><vector name="direction" value="-0.5, -1, -0.8"/><rgb name="irradiance" value="3 3 3"/></emitter>'
RED = '<emitter type="directional"><vector name="direction" value="0.7, -0.2, -0.1"/><rgb name="irradiance" value="2 0.5 0.1"/></emitter>'
UNIFORM = '<emitter type="constant"><rgb name="radiance" value="0.5 0.7 1"/></emitter>'
MAP = '<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>'
FLOOR = (
    '<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="5"/><translate y="-1.3"/></transform>'
    '<bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf></shape>'
)


class Smooth:
    """Stands in for a network: bright in the middle of a cloud, dark behind it, moved by every input."""

    def predict(self, stencil: NDArray[np.float32], aux: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return j (n,)."""
        near = stencil[:, 2:].mean(axis=(1, 2))
        value: NDArray[np.float32] = ((0.3 + near) * np.exp(-0.5 * aux[:, 5]) * (0.5 + aux[:, 4]) * (1 + 0.3 * np.cos(aux[:, 0]))).astype(
            np.float32
        )
        return value


@dataclass(frozen=True)
class Scene:
    """What is rendered, and how far the modes may differ, over the mean: in the image's mean, and in 8 x 8 tiles (mean square)."""

    light: str
    scale: float = 12.0
    density: str = "ball"
    albedo: str = "1 1 1"
    g: float = 0.5
    surfaces: str = ""
    origin: str = "1.2, 1.0, 4.2"
    target: str = "0, -0.1, 0"
    mean: float = 0.015
    tiles: float = 0.03
    spp: int = 32


SCENES = {
    "dense": Scene(SUN, scale=60.0),
    "haze": Scene(SUN, scale=0.3),
    "hard edges": Scene(SUN, scale=8.0, density="box"),
    "camera inside": Scene(SUN, origin="0.1, 0.2, 0.1", target="1, 0.3, 0.4"),
    "colour and two suns": Scene(SUN + RED, albedo="1 0.9 0.5"),
    "uniform sky": Scene(UNIFORM, tiles=0.04),
    "map with a sun in it": Scene(MAP, albedo="0.99 0.9 0.8", mean=0.025, tiles=0.05, spp=64),
    "floor": Scene(SUN, surfaces=FLOOR, mean=0.02, tiles=0.04, spp=64),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("fast")
    c = (np.arange(16) + 0.5) / 8 - 1
    z, y, x = np.meshgrid(c, c, c, indexing="ij")
    bumps = 0.15 * np.sin(7 * x) * np.sin(6 * y + 1) * np.sin(8 * z)
    ball = np.clip(3 * (0.8 + bumps - np.sqrt(x * x + y * y + z * z)), 0, 1).astype(np.float32)
    write_vol(path / "ball.vol", Volume.from_box(ball, (-1, -1, -1), (1, 1, 1)))
    write_vol(path / "box.vol", Volume.from_box(np.ones((8, 8, 8), np.float32), (-1, -1, -1), (1, 1, 1)))
    sky = np.random.default_rng(3).random((16, 32, 3)).astype(np.float32)
    sky[3, 20] = 60
    write_exr(path / "sky.exr", {name: np.ascontiguousarray(sky[..., i]) for i, name in enumerate("RGB")})
    return path


@pytest.fixture(autouse=True)
def mi(llvm_mitsuba: ModuleType) -> ModuleType:
    return llvm_mitsuba


def _file(folder: Path, name: str) -> Path:
    scene = SCENES[name]
    path = folder / f"{name}.xml"
    path.write_text(f"""<scene version="3.0.0">
      <sensor type="perspective">
        <float name="fov" value="36"/>
        <transform name="to_world"><lookat origin="{scene.origin}" target="{scene.target}" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="{SIZE}"/><integer name="height" value="{SIZE}"/><rfilter type="box"/></film>
      </sensor>
      {scene.light}
      <shape type="cube"><bsdf type="null"/>
        <medium type="heterogeneous" name="interior">
          <float name="scale" value="{scene.scale}"/><rgb name="albedo" value="{scene.albedo}"/>
          <phase type="hg"><float name="g" value="{scene.g}"/></phase>
          <volume type="gridvolume" name="sigma_t"><string name="filename" value="{scene.density}.vol"/>
            <transform name="to_world"><translate x="-0.5" y="-0.5" z="-0.5"/><scale value="2"/></transform></volume>
        </medium></shape>{scene.surfaces}
    </scene>""")
    return path


def _tiles(image: NDArray[Any]) -> NDArray[np.float64]:
    result: NDArray[np.float64] = image.astype(np.float64).reshape(4, SIZE // 4, 4, SIZE // 4, 3).mean(axis=(1, 3))
    return result


@pytest.mark.parametrize("name", SCENES)
def test_fast_and_reference_mode_agree(folder: Path, name: str) -> None:
    scene, path = SCENES[name], _file(folder, name)
    reference = load(path, predictor=Smooth(), mode="reference")
    fast = load(path, predictor=Smooth())
    truth = [_tiles(reference.render(scene.spp, seed=s).rgb) for s in (1, 2)]
    found = [_tiles(fast.render(scene.spp // 4, seed=s).rgb) for s in (3, 4, 5, 6)]
    level = np.mean(truth)
    difference = np.mean(found, axis=0) - np.mean(truth, axis=0)
    # Half of the difference of two equal halves has the noise of their mean.
    noise = 0.5 * np.array([truth[0] - truth[1], np.mean(found[:2], axis=0) - np.mean(found[2:], axis=0)])
    of_mean = np.sqrt(sum(np.mean(n) ** 2 for n in noise)) / level
    of_tiles = np.sqrt(np.mean(noise**2) * 2) / level
    # The noise must leave the test its power.
    assert of_mean < 0.5 * scene.mean
    assert of_tiles < scene.tiles
    assert abs(difference.mean()) / level < scene.mean + 2 * of_mean
    assert np.sqrt(max(np.mean(difference**2) / level**2 - of_tiles**2, 0)) < scene.tiles


def test_the_interpolation_errs_by_no_more_than_its_measured_error(folder: Path) -> None:
    result = load(_file(folder, "dense"), predictor=Smooth()).render(1)
    source = result.statistics.sources["suns"]
    assert 0 < source["error"] < 0.1
    assert source["nodes"] > 100
    assert result.counts.queries == source["queries"] >= source["nodes"]


def test_samples_cost_no_queries(folder: Path) -> None:
    renderer = load(_file(folder, "dense"), predictor=Smooth())
    few, many = renderer.render(1), renderer.render(64)
    assert few.counts.queries == many.counts.queries
    assert many.counts.cloud_samples > 60 * few.counts.cloud_samples


@pytest.mark.parametrize("budget", [10, 100])
def test_the_coarsest_cells_keep_to_the_budget(folder: Path, monkeypatch: pytest.MonkeyPatch, budget: int) -> None:
    """Expected behaviour: their corners take no more than four times of it, and the image's mean stays."""
    renderer = load(_file(folder, "dense"), predictor=Smooth())
    free = renderer.render(4, seed=5)
    monkeypatch.setattr(frame, "_BUDGET", budget)
    bounded = renderer.render(4, seed=5)
    before, after = (result.statistics.sources["suns"] for result in (free, bounded))
    assert before["nodes"] > 800
    assert after["nodes"] <= 4 * budget + 8
    assert np.mean(bounded.rgb) == pytest.approx(np.mean(free.rgb), rel=0.1)


def test_the_dial_sets_the_noise(folder: Path) -> None:
    renderer = load(_file(folder, "map with a sun in it"), predictor=Smooth())
    images = {error: [renderer.render(seed=s, error=error) for s in (1, 2)] for error in (0.1, 0.015)}
    for error, (a, b) in images.items():
        lit = a.rgb + b.rgb > 0.02 * np.quantile(a.rgb + b.rgb, 0.999)
        noise = np.sqrt(np.mean((a.rgb - b.rgb)[lit] ** 2) / 2) / a.rgb[lit].mean()
        # An estimate from two halves of one image, of noise that has rare large values.
        assert noise < 1.5 * error
        assert a.statistics.noise is not None
        assert a.statistics.noise <= error
    assert images[0.015][0].statistics.spp > images[0.1][0].statistics.spp


def test_a_seed_gives_one_fast_image(folder: Path) -> None:
    path = _file(folder, "map with a sun in it")

    def once(seed: int) -> RenderResult:
        return load(path, predictor=Smooth()).render(2, seed=seed)

    first, again, other = once(1), once(1), once(2)
    np.testing.assert_allclose(first.rgb, again.rgb, rtol=1e-4, atol=1e-6)
    assert not np.allclose(first.rgb, other.rgb, rtol=1e-4, atol=1e-6)


def test_modes_and_errors_that_make_no_sense_are_refused(folder: Path) -> None:
    path = _file(folder, "haze")
    with pytest.raises(InputError, match="mode = 'slow'"):
        load(path, predictor=Smooth(), mode="slow")
    for error in (0.0, -1.0, 1e-200, float("nan")):
        with pytest.raises(InputError, match="error ="):
            load(path, predictor=Smooth()).render(error=error)


@pytest.mark.parametrize(
    "options",
    [{"optical_depth": 0.0}, {"sun": (0, 30), "irradiance": 0.0, "sky": 0.0}, {"size": (1, 1)}, {"max_depth": 2}, {"albedo": 0.0}],
    ids=["no cloud", "no light", "one pixel", "single scattering", "black cloud"],
)
def test_the_dial_ends_where_there_is_little_to_see(folder: Path, options: dict[str, Any]) -> None:
    result = load(folder / "ball.vol", predictor=Smooth(), **{"size": (9, 7), **options}).render(error=0.05)
    assert np.all(np.isfinite(result.rgb))
    assert result.rgb.min() >= 0
    assert 2 <= result.statistics.spp < 1024
