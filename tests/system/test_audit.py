"""Rationale: walks must tell how wrong a network is, and correct it: much where it is wrong, and not at all where it is right.

Expected behaviour: with stand-ins for the network that are wrong by known factors, the audit finds the error within its interval, the
correction brings the image nearer to one by walks, images stay positive, and one seed makes one image.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from deepclouds_runtime import correction, frame
from deepclouds_runtime.audit import FEWEST
from deepclouds_runtime.audit_walks import Batch, Drawn, Looked, Walks
from deepclouds_runtime.correction import GROUPS, Correction, Sums
from deepclouds_runtime.frame_source import Seen
from deepclouds_runtime.loading import load
from deepclouds_runtime.output import save
from deepclouds_runtime.render import main
from deepclouds_runtime.result import RenderResult
from deepclouds_runtime.scattering import NetworkScattering, WalkScattering
from numpy.typing import NDArray

from deepclouds.errors import InputError
from deepclouds.exr import read_attributes
from deepclouds.volume import Volume, write_vol
from tests.system.smooth_network import Smooth

Array = NDArray[Any]
SIZE = 24


class Unused:
    """Stands in for a network; asked by nobody."""

    def predict(self, stencil: Array, aux: Array) -> Array:
        """Return j (n,)."""
        return np.ones(len(stencil), np.float32)


def factor_of(kind: str, x: Array) -> Array:
    """By what a stand-in multiplies the truth at world points (n, 3)."""
    if kind == "constant":
        return np.full(len(x), 1.3)
    if kind == "smooth":
        return 1 + 0.4 * x[:, 1]
    if kind == "sharp":
        return np.where(x[:, 1] > 0, 1.4, 0.7)
    return np.ones(len(x))


@pytest.fixture
def scene(tmp_path: Path, llvm_mitsuba: ModuleType) -> Path:
    c = (np.arange(16) + 0.5) / 8 - 1
    z, y, x = np.meshgrid(c, c, c, indexing="ij")
    ball = np.clip(4 * (0.9 - np.sqrt(x * x + y * y + z * z)), 0, 1).astype(np.float32)
    write_vol(tmp_path / "ball.vol", Volume.from_box(ball, (-1, -1, -1), (1, 1, 1)))
    path = tmp_path / "scene.xml"
    path.write_text(f"""<scene version="3.0.0">
      <sensor type="perspective"><float name="fov" value="34"/>
        <transform name="to_world"><lookat origin="1.2, 1, 3.6" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="{SIZE}"/><integer name="height" value="{SIZE}"/><rfilter type="box"/></film>
      </sensor>
      <emitter type="directional"><vector name="direction" value="-0.5, -1, -0.8"/><rgb name="irradiance" value="3 3 3"/></emitter>
      <shape type="cube"><bsdf type="null"/><medium type="heterogeneous" name="interior">
        <float name="scale" value="6"/><rgb name="albedo" value="1 1 1"/><phase type="hg"><float name="g" value="0.5"/></phase>
        <volume type="gridvolume" name="sigma_t"><string name="filename" value="ball.vol"/>
          <transform name="to_world"><translate x="-0.5" y="-0.5" z="-0.5"/><scale value="2"/></transform></volume>
      </medium></shape></scene>""")
    return path


def rendered(scene: Path, monkeypatch: pytest.MonkeyPatch, kind: str, seed: int = 0, spp: int | None = 16, **how: Any) -> RenderResult:
    """An image in which the network knows the truth, from many walks, times a factor."""
    renderer = load(scene, predictor=Unused())
    # Noise at the nodes is an error too, which the one that is right may not have.
    truth = WalkScattering(renderer._field, 2048 if kind == "exact" else 256, 99)

    def asked(self: NetworkScattering, query: Any, **how: Any) -> Any:
        j = truth(query.points, query.w, query.omega_sun, query.phase, query.albedos, query.tau)
        return (j * factor_of(kind, np.array(query.points).T)[:, None]).astype(np.float32), None, None

    monkeypatch.setattr(NetworkScattering, "_asked", asked)
    return renderer.render(spp, seed, **{"error": 0.04, **how})


def _averages(image: RenderResult) -> NDArray[np.float64]:
    result: NDArray[np.float64] = image.rgb.astype(np.float64).reshape(8, 3, 8, 3, 3).mean(axis=(1, 3))
    return result


def _error(found: RenderResult, true: RenderResult) -> float:
    return float(np.sqrt(np.mean((_averages(found) - _averages(true)) ** 2)) / true.rgb.mean())


@pytest.mark.parametrize("kind", ["constant", "smooth", "sharp"])
def test_a_wrong_network_is_found_out_and_corrected(scene: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    true = rendered(scene, monkeypatch, "exact")
    wrong = rendered(scene, monkeypatch, kind, audit=True)
    right = rendered(scene, monkeypatch, kind, correct=True)
    assert not wrong.statistics.audit["corrected"]
    assert right.statistics.audit["corrected"]
    assert _error(right, true) < (0.25 if kind == "constant" else 0.5) * _error(wrong, true)
    low, high = wrong.statistics.audit["network"]["error_interval"]
    assert 0.02 < low < high
    assert right.statistics.audit["remaining"]["error"] < 0.5 * wrong.statistics.audit["network"]["error"]
    if kind == "constant":
        low, high = wrong.statistics.audit["network"]["energy_interval"]
        assert low - 0.02 < 0.3 < high + 0.02
    assert right.rgb.min() >= 0
    assert np.isfinite(right.rgb).all()


FLOOR = (
    '<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="3"/><translate y="-1.1"/></transform>'
    '<bsdf type="diffuse"><rgb name="reflectance" value="0.9"/></bsdf></shape></scene>'
)


@pytest.fixture
def floor(scene: Path) -> Path:
    """The same cloud over a white floor."""
    path = scene.with_name("floor.xml")
    path.write_text(scene.read_text().replace("</scene>", FLOOR).replace('origin="1.2, 1, 3.6"', 'origin="1.2, 3, 3.6"'))
    return path


def _on_floor(image: RenderResult) -> Array:
    """Light of the floor's open part, by quarters of the image, (quarters,)."""
    surface = image.channels["surface.G"].astype(np.float64) * (image.channels["volume_opacity"] < 0.01)
    quarters: Array = surface.reshape(2, SIZE // 2, 2, SIZE // 2).mean(axis=(1, 3)).ravel()
    return quarters


def test_light_on_surfaces_is_that_of_paths(floor: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Paths have the light that the floor sends to the cloud, and it back to the floor, by themselves."""
    paths = load(floor, unbiased=True).render(1024, 3)
    # Sixteen samples a pixel know a quarter of the floor, with the edge of the shadow in it, to a percent.
    many, wrong = (rendered(floor, monkeypatch, kind, spp=256) for kind in ("none", "constant"))
    np.testing.assert_allclose(_on_floor(many), _on_floor(paths), rtol=0.02)
    # Where walks correct the image, no network is asked about light on surfaces.
    for kind in ("none", "constant"):
        walked = rendered(floor, monkeypatch, kind, correct=True, spp=256)
        np.testing.assert_allclose(_on_floor(walked), _on_floor(paths), rtol=0.02)
        assert "light on surfaces" not in walked.statistics.sources
    assert "light on surfaces" in wrong.statistics.sources
    # A third more of what is thrown is two percent of the light on the floor, most of which is the sun's.
    assert _on_floor(wrong).sum() > 1.01 * _on_floor(many).sum()


def test_the_dial_throws_as_much_light_as_a_given_number_of_samples(floor: Path) -> None:
    """It does not know how many samples it will take: no number may be spread over all of them."""

    def thrown(spp: int | None) -> float:
        """The cloud's light on the floor."""
        images = [load(floor, predictor=Smooth(), interreflection=cast).render(spp, 2, error=0.02) for cast in (True, False)]
        return float(_on_floor(images[0]).sum() - _on_floor(images[1]).sum())

    assert thrown(None) == pytest.approx(thrown(64), rel=0.15)


def _from_afar(scene: Path, size: int) -> Path:
    """The same scene, a tenth as large in an image of so many pixels."""
    path = scene.with_name(f"far{size}.xml")
    text = scene.read_text().replace(f'value="{SIZE}"', f'value="{size}"').replace('origin="1.2, 1, 3.6"', 'origin="12, 10, 36"')
    path.write_text(text)
    return path


def _watched(monkeypatch: pytest.MonkeyPatch) -> list[Batch]:
    """All batches of walks from now on."""
    seen: list[Batch] = []
    begin = Walks.begin

    def watched(self: Walks, drawn: Drawn) -> Callable[[], Batch]:
        finish = begin(self, drawn)

        def finished() -> Batch:
            seen.append(finish())
            return seen[-1]

        return finished

    monkeypatch.setattr(Walks, "begin", watched)
    return seen


def test_groups_of_walks_share_no_point(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Halves that began at the same points would agree on what is wrong there alone."""
    seen = _watched(monkeypatch)
    rendered(scene, monkeypatch, "smooth", audit=True)
    for batch in seen:
        number = np.bincount(batch.groups, minlength=GROUPS)
        assert np.all(number == number[0])
        points = [{tuple(p) for p in batch.points[batch.groups == group]} for group in range(GROUPS)]
        assert len(set().union(*points)) == sum(map(len, points))
        # Each group alone knows the image's light: its walks as drawn, and what they find.
        for values, tolerance in ((batch.predicted, 0.02), (batch.walked, 0.1)):
            means = [float((batch.weights[:, None] * values)[batch.groups == group].mean()) for group in range(GROUPS)]
            assert means == pytest.approx([float(np.mean(means))] * GROUPS, rel=tolerance)


def test_groups_of_walks_see_all_columns() -> None:
    """Rays are spread evenly over the rows: every fourth of them would meet the same columns in every row where a row has 32 rays."""
    random = np.random.default_rng(3)
    rays = 1 << 15
    rows, columns = rays // 32, np.arange(rays) % 32
    nothing = np.zeros((rays, 3))
    seen = Seen(np.stack([columns, *np.zeros((2, rays))], axis=1), np.full(rays, 1 / rows), np.arange(rays))
    looked = Looked(seen, nothing, np.arange(rays), np.ones((rays, 1)), random)
    drawn = Walks.drawn(looked, rays)
    for group in range(GROUPS):
        number = np.bincount(drawn.points[drawn.groups == group, 0].astype(int), minlength=32)
        assert number.min() > 0.7 * number.mean()
        assert number.max() < 1.3 * number.mean()


def test_a_cloud_far_away_is_corrected_as_well(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seven pixels of a thousand show it: rays through all of them would start every walk at the same few points."""
    far = _from_afar(scene, 240)
    starts = _watched(monkeypatch)
    true, wrong, right = (
        rendered(far, monkeypatch, kind, **how) for kind, how in (("exact", {}), ("smooth", {}), ("smooth", {"correct": True}))
    )
    shown = true.rgb.sum(axis=2) > 0
    assert 50 < shown.sum() < 500
    points = np.concatenate([batch.points for batch in starts])
    assert len(np.unique(points, axis=0)) > len(points) // 64

    def error(image: RenderResult) -> float:
        return float(np.sqrt(np.mean((image.rgb - true.rgb)[shown] ** 2)) / true.rgb[shown].mean())

    # What is left is the noise of single pixels.
    assert error(right) < 0.6 * error(wrong)
    assert abs(right.rgb.sum() / true.rgb.sum() - 1) < 0.01
    found = right.statistics.audit
    low, high = found["remaining"]["energy_interval"]
    assert low < 0 < high
    assert high - low < 0.03


def test_an_error_that_is_reached_ends_the_walks_before_the_time(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = rendered(scene, monkeypatch, "smooth", spp=None, correct=True, error=0.05, time_limit=60)
    assert found.statistics.audit["corrected"]
    assert found.statistics.audit["walks"] <= 3 * FEWEST


def test_nodes_are_no_finer_than_pixels(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    far = _from_afar(scene, 2 * SIZE)
    found = rendered(far, monkeypatch, "none", error=0.005)
    shown = int((found.rgb.sum(axis=2) > 0).sum())
    assert found.statistics.sources["suns"]["nodes"] < 20 * shown
    monkeypatch.setattr(frame, "_FINEST", 1e-9)
    finer = rendered(far, monkeypatch, "none", error=0.005)
    assert finer.statistics.sources["suns"]["nodes"] > 4 * found.statistics.sources["suns"]["nodes"]
    assert found.rgb.sum() == pytest.approx(finer.rgb.sum(), rel=0.01)


def test_a_network_that_is_right_stays_as_it_is(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With nodes so close that interpolation is right as well: what it errs is corrected too."""
    true = rendered(scene, monkeypatch, "exact", error=0.01)
    for seed in (0, 1):
        found = rendered(scene, monkeypatch, "exact", seed, correct=True, error=0.01)
        alone = rendered(scene, monkeypatch, "exact", seed, error=0.01)
        assert _error(found, alone) < 0.02
        assert abs(found.statistics.audit["network"]["energy"]) < 0.02
    assert true.statistics.audit == {}


def test_little_is_corrected_without_harm(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a right network and distant nodes the error is small, and few walks tell what it is; images are held against paths.

    With as many nodes the correction takes part of what the interpolation errs; with fewer, as corrected images have, it makes up for them.
    """
    a, b = (_averages(load(scene, unbiased=True).render(2048, seed)) for seed in (7, 8))

    def squared(correct: bool) -> float:
        """Without the noise of the paths, which is independent in both."""
        found = [_averages(rendered(scene, monkeypatch, "exact", seed, correct=correct)) for seed in range(4)]
        return float(np.mean([(image - a) * (image - b) for image in found]) / (a.mean() * b.mean()))

    alone, corrected = squared(False), squared(True)
    assert corrected < 0.03**2
    monkeypatch.setattr(frame, "_CORRECTED", 1.0)
    assert squared(True) < 0.75 * alone


def test_no_time_is_no_audit(scene: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    """The least that makes an image is done all the same."""
    caplog.set_level(logging.INFO)
    found = rendered(scene, monkeypatch, "constant", spp=None, correct=True, time_limit=1e-6)
    assert found.statistics.audit == {}
    assert found.statistics.spp == 1
    assert 0 < found.statistics.sources["suns"]["nodes"] <= 64
    assert np.isfinite(found.rgb).all()
    assert found.rgb.mean() > 0
    assert any("no time was left" in record.getMessage() for record in caplog.records)


def test_a_seed_makes_one_image(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second, other = (rendered(scene, monkeypatch, "smooth", seed, correct=True) for seed in (5, 5, 6))
    np.testing.assert_allclose(first.rgb, second.rgb, rtol=1e-4, atol=1e-6)
    assert first.statistics.audit["walks"] == second.statistics.audit["walks"]
    assert np.abs(first.rgb - other.rgb).max() > 1e-4


def test_the_report_and_the_header_say_what_was_found(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from deepclouds_runtime._report import report

    result = rendered(scene, monkeypatch, "constant", correct=True)
    save(result, tmp_path / "image.exr")
    assert '"remaining"' in str(read_attributes(tmp_path / "image.exr")["deepclouds"])
    report(result, print)
    text = capsys.readouterr().out
    assert "error of the network, measured" in text
    assert "error once corrected, measured" in text


@pytest.mark.parametrize(
    "flags", [["--time", "0"], ["--time", "-3"], ["--mode", "reference", "--audit"], ["--mode", "reference", "--correct"]]
)
def test_bad_values_are_refused(scene: Path, tmp_path: Path, flags: list[str]) -> None:
    with pytest.raises(InputError, match=r"time|mode"):
        main([str(scene), "-o", str(tmp_path / "image.exr"), "--quiet", *flags])


def _smooth(points: Array, bias: float) -> Array:
    result: Array = 0.5 * bias * (1 + np.sin(6 * points[:, 0]) * np.cos(5 * points[:, 1]))
    return result


def _noisy(n: int, seed: int, bias: float) -> Sums:
    """Walks that deviate as walks do, by more than their mean and to one side, where J is 1 and should be 1 + `_smooth`."""
    rng = np.random.default_rng(seed)
    sums = Sums(np.zeros(3), np.array([1.0, 0.6, 0.8]), np.array([0.02, 0.02]))
    for group in range(GROUPS):
        points = rng.random((n // GROUPS, 3)) * (1, 0.6, 0.8)
        true = 1 + _smooth(points, bias)
        walked = true * np.where(rng.random(len(points)) < 0.2, rng.exponential(5.0, len(points)), 0)
        # The second channel is right.
        right = np.where(rng.random(len(points)) < 0.2, rng.exponential(5.0, len(points)), 0)
        sums.add(points, np.ones(len(points)), np.ones((len(points), 2)), np.stack([walked, right], axis=1), group)
    return sums


def _left(sums: Sums, bias: float) -> tuple[float, float]:
    """What a correction leaves of the first channel's error, root of the mean square, and what it does to the channel that is right."""
    x = np.random.default_rng(9).random((5000, 3)) * (1, 0.6, 0.8)
    found = Correction(sums)(x) * 1.02
    return float(np.sqrt(np.mean((found[:, 0] - _smooth(x, bias)) ** 2))), float(np.sqrt(np.mean(found[:, 1] ** 2)))


def test_noise_alone_is_shrunken_to_nearly_nothing() -> None:
    """As it is, the noise of the finest lattice would be above 10, and that of the mean of all walks is 0.01."""
    harm = [_left(_noisy(100_000, seed, 0.0), 0.0) for seed in range(20)]
    assert np.mean(harm) < 0.01
    assert np.max(harm) < 0.04


def test_more_walks_leave_less() -> None:
    left, harm = zip(*(_left(_noisy(n, 3, 0.8), 0.8) for n in (4_000, 400_000, 4_000_000)), strict=True)
    assert left[0] < 0.35
    assert left[1] < 0.5 * left[0]
    assert left[2] < 0.6 * left[1]
    assert left[2] < 0.05
    assert max(harm[1:]) < 0.02


def test_a_place_where_the_network_fails_is_believed_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """Expected behaviour: where a hundredth of the cloud has a third of its light, less is left than by one variance for all."""
    rng = np.random.default_rng(5)
    middle = np.array([0.3, 0.3, 0.4])

    def truth(points: Array) -> Array:
        near = np.linalg.norm(points - middle, axis=1) < 0.12
        result: Array = 1 + 0.05 * np.sin(6 * points[:, 0]) + 2.0 * near
        return result

    sums = Sums(np.zeros(3), np.array([1.0, 0.6, 0.8]), np.array([0.02]))
    for group in range(GROUPS):
        points = rng.random((200_000, 3)) * (1, 0.6, 0.8)
        walked = truth(points) * np.where(rng.random(len(points)) < 0.2, rng.exponential(5.0, len(points)), 0)
        sums.add(points, np.ones(len(points)), np.ones((len(points), 1)), walked[:, None], group)
    inside = middle + 0.04 * rng.normal(size=(500, 3))
    left = []
    for block in (correction._BLOCK, 10_000):
        monkeypatch.setattr(correction, "_BLOCK", block)
        left.append(float(np.abs(truth(inside) - 1 - Correction(sums)(inside)[:, 0] * 1.02).mean()))
    assert left[0] < 0.8 * left[1], left


def test_rare_large_walks_do_not_darken() -> None:
    """A node that believed its walks by their own spread would take back what the largest of them bring."""
    means = []
    for seed in range(8):
        x = np.random.default_rng(9).random((5000, 3)) * (1, 0.6, 0.8)
        means.append(float(Correction(_noisy(400_000, seed, 0.8))(x)[:, 0].mean() * 1.02 - _smooth(x, 0.8).mean()))
    assert abs(np.mean(means)) < 4 * np.std(means) / np.sqrt(len(means)) + 0.002
    assert np.std(means) < 0.01


def test_halves_that_are_left_out_say_nothing() -> None:
    sums, other = _noisy(20_000, 3, 0.8), _noisy(20_000, 3, 0.8)
    other.residual[2:] = 1e6
    x = np.random.default_rng(9).random((100, 3))
    halves = ((0,), (1,))
    np.testing.assert_allclose(Correction(sums, halves)(x), Correction(other, halves)(x))


def test_no_walks_correct_nothing() -> None:
    nothing = Correction(Sums(np.zeros(3), np.zeros(3), np.ones(1)))
    assert nothing.levels == 0
    assert not nothing(np.random.default_rng(1).random((10, 3))).any()


@pytest.mark.parametrize(
    ("correct", "model", "collisions", "expected"),
    [
        (True, None, 1000.0, {"light from all around": ""}),
        (True, None, 0.0, {"light from all around": "fast"}),
        (False, None, 1000.0, {"light from all around": "accurate", "light on surfaces": "accurate"}),
        (True, "fast", 0.0, {"light from all around": "fast"}),
    ],
)
def test_light_from_all_around_is_walked_or_asked_of_the_quick_model(
    scene: Path, monkeypatch: pytest.MonkeyPatch, correct: bool, model: str | None, collisions: float, expected: dict[str, str]
) -> None:
    """Expected behaviour: where walks correct it and are not too long; suns are asked of the model that was chosen."""
    for name in ("_BEAMS", "_BEAMS_THROWN", "_BEAMS_BACK"):
        monkeypatch.setattr(frame, name, 1)
    floor = (
        '<emitter type="constant"/><shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="3"/>'
        '<translate y="-1.5"/></transform><bsdf type="diffuse"/></shape></scene>'
    )
    scene.write_text(scene.read_text().replace("</scene>", floor))
    monkeypatch.setattr(frame, "_BRIGHT", 2.0)
    monkeypatch.setattr(frame, "_MOST_COLLISIONS", collisions)
    found = load(scene, model=model).render(1, seed=3, correct=correct).statistics.sources
    assert {name: source["model"] for name, source in found.items()} == {"suns": model or "accurate", **expected}
    assert all((source["queries"] == 0) == (source["model"] == "") for source in found.values())
