"""Rationale: a picture must say where its network cannot be trusted, and must not ask it about what it never saw.

Expected behaviour: errors that a stand-in for the network claims to know come out as a confidence of each pixel, whatever the lights and
colours, and change no image; a medium outside of the training is path-traced, and the notes say so.
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from deepclouds_runtime.confidence import DOUBTFUL, confidence, doubtful, relative_errors, warning
from deepclouds_runtime.frame_source import Seen
from deepclouds_runtime.loading import load
from deepclouds_runtime.octree import Octree, lattice_around
from deepclouds_runtime.result import RenderResult
from numpy.typing import NDArray

from deepclouds.backend import backend
from deepclouds.cli import main
from deepclouds.exr import read_exr
from deepclouds.volume import Volume, read_vol, write_vol
from deepclouds.volume.pyramid import optical_size

Image = NDArray[np.float32]
SUN: dict[str, Any] = {"sun": (60.0, 30.0), "sky": 0.0, "size": (32, 24)}


@pytest.fixture(autouse=True)
def mi(llvm_mitsuba: ModuleType) -> ModuleType:
    return llvm_mitsuba


@pytest.fixture(scope="module")
def cloud(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("confidence") / "ball.vol"
    c = (np.arange(16) + 0.5) / 8 - 1
    z, y, x = np.meshgrid(c, c, c, indexing="ij")
    write_vol(path, Volume.from_box(np.clip(1.2 - 1.5 * np.sqrt(x * x + y * y + z * z), 0, 1), (-1, -1, -1), (1, 1, 1)))
    return path


class Doubting:
    """Stands in for a network that knows its errors: a share of j, `shaded` where the depth toward the light exceeds 1, else `lit`."""

    def __init__(self, lit: float, shaded: float, trusts: bool = True, unknown: tuple[str, ...] = ()) -> None:
        self._shares, self._unknown = (lit, shaded), list(unknown)
        self.metadata = SimpleNamespace(trust="any" if trusts else None, initialisers_sha256="e" * 64)
        self.asked: list[tuple[Any, ...]] = []

    def predict(self, stencil: Image, aux: Image) -> Image:
        value: Image = ((0.2 + stencil[:, 2:].mean(axis=(1, 2))) * np.exp(-0.3 * aux[:, 5]) * (0.5 + aux[:, 4])).astype(np.float32)
        return value

    def errors(self, stencil: Image, aux: Image, j: Image) -> Image:
        value: Image = (j * np.where(aux[:, 5] > np.log(2), self._shares[1], self._shares[0])).astype(np.float32)
        return value

    def outside(self, phase: tuple[float, float, float], albedos: tuple[float, ...], size: float) -> list[str]:
        self.asked.append((phase, albedos, size))
        return self._unknown


def rendered(cloud: Path, predictor: Doubting, **options: Any) -> RenderResult:
    return load(cloud, predictor=predictor, **{**SUN, **options}).render(2, seed=3)


@pytest.mark.parametrize(
    "options",
    [{}, {"albedo": (1.0, 0.9, 0.5)}, {"irradiance": (3.0, 2.0, 0.5)}, {"sky": (0.1, 0.2, 0.4)}, {"size": (301, 260)}],
    ids=["a sun", "colour", "a coloured sun", "a sky", "more pixels than rays look for"],
)
def test_a_known_share_comes_out_in_every_pixel(cloud: Path, options: dict[str, Any]) -> None:
    found = rendered(cloud, Doubting(0.2, 0.2), **options).channels
    indirect, total = (np.sum([found[prefix + c] for c in "RGB"], axis=0) for prefix in ("volume_indirect.", ""))
    expected = 1 - np.where(total > 0, 0.2 * indirect / np.maximum(total, 1e-20), 0)
    assert (indirect > 0).mean() > 0.2
    # Thin rims that no pilot ray met are taken from beside them, or have nothing to go by.
    close = np.isclose(found["confidence"], expected, atol=2e-3)
    assert close[found["volume_opacity"] > 0.02].all()


def test_shade_is_trusted_less_where_the_network_says_so(cloud: Path) -> None:
    found = rendered(cloud, Doubting(0.1, 0.6)).channels
    seen = found["volume_opacity"] > 0.5
    share = (1 - found["confidence"]) * found["G"] / np.maximum(found["volume_indirect.G"], 1e-20)
    assert share[seen].min() < 0.2
    assert share[seen].max() > 0.45
    # Where single scattering is weak the sun is hidden.
    dark = found["volume_direct.G"] < np.quantile(found["volume_direct.G"][seen], 0.3)
    assert share[seen & dark].mean() > share[seen & ~dark].mean() + 0.1


def test_knowing_its_errors_changes_no_image(cloud: Path) -> None:
    knowing, other = rendered(cloud, Doubting(0.1, 0.9)), rendered(cloud, Doubting(0.1, 0.9, trusts=False))
    np.testing.assert_allclose(knowing.rgb, other.rgb, rtol=1e-5, atol=1e-7)
    assert knowing.counts == other.counts
    assert "confidence" not in other.channels
    assert other.statistics.network == {}


def test_doubtful_light_is_said(cloud: Path, tmp_path: Path) -> None:
    bad, good = rendered(cloud, Doubting(0.9, 0.9)), rendered(cloud, Doubting(0.05, 0.05))
    (said,) = bad.notes
    assert "look at the channel 'confidence'" in said
    assert bad.statistics.network["doubtful"] > 0.5 > 0.1 > good.statistics.network["error"] > 0.01
    assert good.notes == ()
    assert warning({"doubtful": 0.05}) is None


def test_figures_of_an_image_are_shares_of_its_clouds_light() -> None:
    light = np.array([[4.0, 0.0, 0.0]], np.float32)
    channels = {f"volume_indirect.{c}": light for c in "RGB"} | {f"volume_direct.{c}": np.ones((1, 3), np.float32) for c in "RGB"}
    channels |= {c: np.array([[5.0, 1.0, 10.0]], np.float32) for c in "RGB"}
    trusted = confidence(np.array([[0.5, 0.7, 0.0]], np.float32), channels)
    np.testing.assert_allclose(trusted, [[0.6, 1.0, 1.0]], rtol=1e-6)
    assert 1 - DOUBTFUL > 0.6
    assert doubtful(trusted, channels) == pytest.approx({"error": 2 / 7, "doubtful": 5 / 7}, rel=1e-5)


def test_nothing_is_claimed_where_the_network_is_not_interpolated(cloud: Path) -> None:
    for options in ({"mode": "reference"}, {"max_depth": 2}, {"unbiased": True}, {"optical_depth": 0.0}):
        assert "confidence" not in rendered(cloud, Doubting(0.3, 0.3), **options).channels, options
    empty = Seen(np.empty((0, 3)), np.empty(0), np.empty(0, np.int64))
    assert relative_errors([], empty, np.arange(2), np.arange(2), (2, 2)) is None


def test_fields_that_are_carried_along_refine_nothing() -> None:
    rng = np.random.default_rng(4)
    points = rng.uniform(0, 1, (2000, 3))
    lattice = lattice_around(np.ones(3), np.zeros(3), np.eye(3), 0.25)

    def smooth(p: NDArray[np.float64]) -> Image:
        return (1 + p[:, :1]).astype(np.float32)

    def with_noise(p: NDArray[np.float64]) -> Image:
        return np.concatenate([smooth(p), 1 + 2 * p[:, 1:2], 100 * np.sin(91 * p[:, 2:])], axis=1).astype(np.float32)

    alone = Octree(lattice, smooth, points, np.ones(2000), 1e-3, 10**6, 4)
    both = Octree(lattice, with_noise, points, np.ones(2000), 1e-3, 10**6, 4, carried=2)
    assert both.statistics == alone.statistics
    assert both.fields == 1
    types = backend()
    place = types.Array3f(*(types.Float(v) for v in points[:50].T.astype(np.float32)))
    for carried, expected in ((False, 1 + points[:50, 0]), (True, 1 + 2 * points[:50, 1])):
        octree = both.upload(types, carried)
        assert octree.fields == (2 if carried else 1)
        found = octree.lookup(octree.to_local(place), types.Bool(True))
        np.testing.assert_allclose(np.array(found[0]), expected, rtol=1e-4)


def test_media_outside_of_the_training_are_path_traced(cloud: Path) -> None:
    unknown = Doubting(0.1, 0.1, unknown=("g1 = 0.97 (trained on 0 to 0.9)",))
    found, walked = rendered(cloud, unknown, g=0.97), rendered(cloud, Doubting(0.1, 0.1), g=0.97, unbiased=True)
    np.testing.assert_array_equal(found.rgb, walked.rgb)
    assert found.statistics.mode == "path-traced"
    (said,) = found.notes
    assert said.startswith("the model was not trained for g1 = 0.97 (trained on 0 to 0.9): multiple scattering is path-traced")
    assert load(cloud, predictor=unknown, **SUN).model_hash is None
    # What it is asked about is the medium and the size of the cloud.
    ((phase, albedo, size), *_) = unknown.asked
    scene = load(cloud, predictor=unknown, **SUN, g=0.97).scene
    assert (phase, albedo) == ((0.97, 0.0, 1.0), (1.0, 1.0, 1.0))
    assert size == pytest.approx(optical_size(read_vol(cloud), scene.scale), rel=1e-5)


def test_media_outside_of_the_training_are_walked_at_nodes_where_walks_correct(cloud: Path) -> None:
    options = {**SUN, "g": -0.5, "sky": (0.2, 0.3, 0.4), "albedo": (1.0, 0.9, 0.5)}
    unknown = Doubting(0.1, 0.1, unknown=("g1 = -0.5 (trained on 0 to 0.9)",))
    found = load(cloud, predictor=unknown, **options).render(64, seed=3, correct=True)
    paths = load(cloud, unbiased=True, **options).render(512, seed=4)
    assert found.statistics.mode == "fast"
    assert {name: source["queries"] for name, source in found.statistics.sources.items()} == {"all lights": 0}
    assert found.statistics.error["network"] == {"by": "none"}
    assert found.counts.queries == 0
    assert "confidence" not in found.channels
    tiles = [image.rgb.astype(np.float64).reshape(6, 4, 8, 4, 3).mean(axis=(1, 3)) for image in (found, paths)]
    assert np.sqrt(np.mean((tiles[0] - tiles[1]) ** 2)) < 0.03 * tiles[1].mean()
    np.testing.assert_allclose(found.rgb.sum(axis=(0, 1)), paths.rgb.sum(axis=(0, 1)), rtol=0.01)
    # A first look asks nothing either.
    first: list[RenderResult] = []
    load(cloud, predictor=unknown, **options).render(8, seed=3, correct=True, partial=first.append)
    assert first[0].counts.queries == 0


def test_extrapolating_takes_a_word(cloud: Path) -> None:
    found = rendered(cloud, Doubting(0.1, 0.1, unknown=("something",)), extrapolate=True)
    assert found.statistics.mode == "fast"
    assert found.notes == ("the model was not trained for something: multiple scattering is extrapolated",)
    assert load(cloud, predictor=Doubting(0.1, 0.1, unknown=("something",)), extrapolate=True, **SUN).model_hash == "e" * 64


def test_the_command_writes_the_channel_and_traces_what_is_unknown(cloud: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "image.exr"
    fixed = ["render", str(cloud), "-o", str(out), "--size", "24x18", "--spp", "1"]
    assert main(fixed) == 0
    assert "error of the network, expected" in capsys.readouterr().out
    trusted = read_exr(out).channels["confidence"]
    assert 0 < trusted.min() < 0.99
    assert trusted.max() == 1
    assert main([*fixed, "--g", "0.99"]) == 0
    assert "note: the model was not trained for g1 = 0.99" in capsys.readouterr().out
    assert "confidence" not in read_exr(out).channels
    assert main([*fixed, "--g", "0.99", "--extrapolate"]) == 0
    assert "multiple scattering is extrapolated" in capsys.readouterr().out
    assert "confidence" in read_exr(out).channels
