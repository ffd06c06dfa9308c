"""Rationale: orders of scattering that are sampled before the network is asked must change the noise of an image and not its mean.

Expected behaviour: where the network knows the truth (Monte Carlo walks in its place), images with 1, 2 and 3 exact orders are those of
Mitsuba's volpath within noise, in both modes, under a sun and under a sky; where it is wrong, its error shrinks with each order, and
so does what it does not see of surfaces inside of the cloud.
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from deepclouds_runtime.loading import load
from deepclouds_runtime.result import RenderResult
from deepclouds_runtime.scattering import NetworkScattering, WalkScattering
from numpy.typing import NDArray

from deepclouds.errors import InputError
from deepclouds.volume import Volume, write_vol

Array = NDArray[Any]
SIZE, TILES = 16, 4
SUN = '<emitter type="directional"><vector name="direction" value="-0.5, -1, -0.8"/><rgb name="irradiance" value="3 2 1"/></emitter>'
SKY = '<emitter type="constant"><rgb name="radiance" value="0.5 0.7 1"/></emitter>'
BLACK = (
    '<shape type="sphere"><point name="center" value="0.3, 0.1, 0.4"/><float name="radius" value="0.5"/>'
    '<bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf></shape>'
)
SCENES = {"sun": (SUN, ""), "sky": (SKY, ""), "black ball inside": (SUN, BLACK)}
SEEDS, SPP = 6, 96


class Unused:
    """Stands in for a network; asked by nobody."""

    def predict(self, stencil: Array, aux: Array) -> Array:
        """Return j (n,)."""
        raise AssertionError("every query is answered by walks")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("orders")
    c = (np.arange(12) + 0.5) / 6 - 1
    z, y, x = np.meshgrid(c, c, c, indexing="ij")
    ball = np.clip(4 * (0.9 - np.sqrt(x * x + y * y + z * z)), 0, 1) * (1.2 + x)
    write_vol(path / "ball.vol", Volume.from_box(ball.astype(np.float32), (-1, -1, -1), (1, 1, 1)))
    return path


def _file(folder: Path, name: str) -> Path:
    light, surfaces = SCENES[name]
    path = folder / f"{name.replace(' ', '_')}.xml"
    path.write_text(f"""<scene version="3.0.0">
      <integrator type="volpath"><integer name="max_depth" value="-1"/><integer name="rr_depth" value="1000000"/></integrator>
      <sensor type="perspective"><float name="fov" value="34"/>
        <transform name="to_world"><lookat origin="1.2, 1, 3.6" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="{SIZE}"/><integer name="height" value="{SIZE}"/><rfilter type="box"/></film>
      </sensor>
      {light}
      <shape type="cube"><bsdf type="null"/><medium type="heterogeneous" name="interior">
        <float name="scale" value="4"/><rgb name="albedo" value="1 0.9 0.6"/><phase type="hg"><float name="g" value="0.4"/></phase>
        <volume type="gridvolume" name="sigma_t"><string name="filename" value="ball.vol"/>
          <transform name="to_world"><translate x="-0.5" y="-0.5" z="-0.5"/><scale value="2"/></transform></volume>
      </medium></shape>{surfaces}</scene>""")
    return path


def rendered(
    path: Path, monkeypatch: pytest.MonkeyPatch, orders: int, spp: int | None, seed: int, factor: float = 1.0, **how: Any
) -> RenderResult:
    """An image in which the network knows the truth, from walks, times a factor."""
    error = {"error": how.pop("error")} if "error" in how else {}
    renderer = load(path, predictor=Unused(), exact_orders=orders, **how)
    # What is interpolated may not be noisy; what is sampled may.
    interpolated = orders == 1 and how.get("mode") != "reference"
    truth = WalkScattering(renderer._field, 512 if interpolated else 1, 1000 + seed)

    def asked(self: NetworkScattering, query: Any, **how: Any) -> Any:
        j = truth(query.points, query.w, query.omega_sun, query.phase, query.albedos, query.tau)
        return (j * factor).astype(np.float32), None, None

    monkeypatch.setattr(NetworkScattering, "_asked", asked)
    return renderer.render(spp, seed, **error)


def _tiles(image: Array) -> NDArray[np.float64]:
    result: NDArray[np.float64] = image.astype(np.float64).reshape(TILES, SIZE // TILES, TILES, SIZE // TILES, 3).mean(axis=(1, 3))
    return result


def _agree(ours: list[NDArray[np.float64]], theirs: NDArray[np.float64], slack: float) -> None:
    """Means of the image and of its tiles, over renders with different seeds."""
    mine = np.stack(ours)
    difference = mine.mean(axis=0) - theirs.mean(axis=0)
    variance = mine.var(axis=0, ddof=1) / len(mine) + theirs.var(axis=0, ddof=1) / len(theirs)
    level = theirs.mean(axis=(0, 1, 2))
    mean_error = np.sqrt(variance.mean(axis=(0, 1))) / TILES
    assert np.all(mean_error < 0.012 * level), "too noisy to say anything"
    assert np.all(np.abs(difference.mean(axis=(0, 1))) < 5 * mean_error + slack * level)
    # The variance of one tile has few numbers behind it.
    assert np.sqrt(np.mean(difference**2, axis=(0, 1)) / np.mean(variance, axis=(0, 1))).max() < 1.8 + slack / 0.01


def _volpath(path: Path, mi: ModuleType, count: int) -> NDArray[np.float64]:
    """Tiles of so many renders with different seeds; sets the variant that ours need."""
    mi.set_variant("scalar_rgb")
    scene = mi.load_file(str(path))
    images = [_tiles(np.array(mi.render(scene, spp=SPP, seed=100 + k))[..., :3]) for k in range(count)]
    mi.set_variant("llvm_ad_rgb")
    return np.stack(images)


@pytest.mark.parametrize("name", ["sun", "sky"])
def test_images_are_those_of_volpath(folder: Path, name: str, monkeypatch: pytest.MonkeyPatch, llvm_mitsuba: ModuleType) -> None:
    path = _file(folder, name)
    theirs = _volpath(path, llvm_mitsuba, SEEDS)
    ways = [(2, "fast"), (3, "fast"), (3, "reference")]
    ways += [(1, "fast")] if name == "sun" else []
    for orders, mode in ways:
        ours = [_tiles(rendered(path, monkeypatch, orders, SPP, k, mode=mode).rgb) for k in range(SEEDS)]
        # One order alone is interpolated.
        _agree(ours, theirs, 0.01 if orders == 1 else 0.002)


def test_surfaces_inside_of_the_cloud_stop_what_is_exact(folder: Path, monkeypatch: pytest.MonkeyPatch, llvm_mitsuba: ModuleType) -> None:
    path = _file(folder, "black ball inside")
    true = _volpath(path, llvm_mitsuba, 2).mean()
    # The network is asked as if there were no ball: too bright.
    errors = [rendered(path, monkeypatch, orders, SPP, 1).rgb.mean() / true - 1 for orders in (1, 2, 4)]
    assert errors[0] > 0.1
    assert errors[1] < 0.8 * errors[0]
    assert -0.03 < errors[2] < 0.6 * errors[1]


def test_what_a_network_errs_shrinks_with_each_order(folder: Path, monkeypatch: pytest.MonkeyPatch, llvm_mitsuba: ModuleType) -> None:
    path = _file(folder, "sun")
    true = rendered(path, monkeypatch, 3, 256, 1)
    errors = []
    for orders in (1, 2, 3, 5):
        wrong = rendered(path, monkeypatch, orders, 128, 2, factor=0.5)
        lit = true.rgb > 0.05 * true.rgb.max()
        errors.append(1 - wrong.rgb[lit].mean() / true.rgb[lit].mean())
    assert errors[0] > 0.1
    assert np.all(np.diff(errors) < -0.1 * errors[0] / np.array([1, 2, 4]))
    assert errors[-1] > 0


def test_the_dial_and_the_statistics_hold(folder: Path, monkeypatch: pytest.MonkeyPatch, llvm_mitsuba: ModuleType) -> None:
    path = _file(folder, "sun")
    a, b = (rendered(path, monkeypatch, 2, None, seed, error=0.1) for seed in (1, 2))
    lit = a.rgb + b.rgb > 0.02 * np.quantile(a.rgb + b.rgb, 0.999)
    noise = np.sqrt(np.mean((a.rgb - b.rgb)[lit] ** 2) / 2) / a.rgb[lit].mean()
    assert a.statistics.noise is not None
    assert a.statistics.noise <= 0.1
    assert 0.05 < noise < 0.14
    assert a.statistics.mode == "fast"
    assert a.statistics.sources == {}
    # Three albedos are three queries, of most of the samples that met the cloud.
    assert 0.5 * 3 * a.counts.cloud_samples < a.counts.queries <= 3 * a.counts.cloud_samples
    assert 4 < a.statistics.spp < 1024


@pytest.mark.parametrize("orders", [0, -1])
def test_orders_below_one_are_refused(folder: Path, llvm_mitsuba: ModuleType, orders: int) -> None:
    with pytest.raises(InputError, match=f"exact orders = {orders}: single scattering is always exact; give 1 or more"):
        load(_file(folder, "sun"), predictor=Unused(), exact_orders=orders)
