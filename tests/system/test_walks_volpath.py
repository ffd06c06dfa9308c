"""The tracker against Mitsuba's ``volpath``, which others wrote: labels at points, and whole images.

Rationale: two independent programs that agree on a lumpy anisotropic cloud at several albedos and phase functions share no bug of
sign, frame, half voxel or weight. The comparison looks at three levels, since each sees what the others miss.
Expected behaviour: Welch's test finds no difference in the mean, in tiles or in single values, with errors small enough to notice a
difference of a few per cent; a difference put there on purpose is found.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
import pytest
from deepclouds_training.mitsuba_tracer import VolpathScene, draw_directions, scene_dict, trace_walks_mitsuba
from numpy.typing import NDArray
from scipy import ndimage

from deepclouds.backend import backend
from deepclouds.errors import InputError
from deepclouds.medium.field import Field
from deepclouds.medium.first_collision import first_collisions
from deepclouds.medium.multiple_scattering import trace_walks
from deepclouds.medium.optical_depth import optical_depth
from deepclouds.medium.phase import as_lobes, hg_numpy
from deepclouds.metrics import bright_mask, welch
from deepclouds.volume import Volume

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
# A single lobe g, or the lobes (g1, g2, weight).
Phase = float | tuple[float, float, float]
# Every comparison of this file rejects a true null with at most this probability; the seeds are fixed, so it does so never or always.
ALPHA = 1e-3


@pytest.fixture(autouse=True)
def mi(scalar_mitsuba: ModuleType) -> ModuleType:
    """Mitsuba under the variant of the generator's labels; images ask for one that takes many camera rays at once."""
    return scalar_mitsuba


def cloud() -> tuple[Volume, float]:
    """Lumps stretched along one axis, in a turned and mirrored box with voxels of three edges."""
    rng = np.random.default_rng(60)
    noise = ndimage.gaussian_filter(rng.normal(size=(28, 32, 36)), (1.2, 2.0, 3.5), mode="constant")
    z, y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in noise.shape), indexing="ij")
    density = np.clip(1 - x**2 - y**2 - z**2 + 1.2 * noise / noise.std(), 0, None)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn[:, 0] *= -np.sign(np.linalg.det(turn))
    to_world = np.eye(4)
    to_world[:3, :3] = turn @ np.diag([1.4, 1.0, 0.7])
    to_world[:3, 3] = -turn @ np.array([0.7, 0.5, 0.35])
    volume = Volume(density, to_world)
    return volume, 5.0 / float(volume.density.mean())


def cube() -> tuple[Volume, float]:
    return Volume.from_box(np.ones((1, 1, 1)), (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)), 6.0


VOLUMES = {"cloud": cloud, "cube": cube}


def unit_vectors(count: int, seed: int) -> Singles:
    d = np.random.default_rng(seed).normal(size=(count, 3))
    unit: Singles = (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)
    return unit


def device(values: NDArray[Any]) -> Any:
    t = backend()
    return t.Array3f(*(t.Float(np.ascontiguousarray(values[:, c], np.float32)) for c in range(3)))


def label_maps(name: str, phase: Phase, walks: int, batches: int) -> tuple[Floats, Floats]:
    """Labels of the tracker and of volpath as stacks (batches, 8, 8, suns * albedos): 64 points, sorted along an axis, seen as an image."""
    volume, scale = VOLUMES[name]()
    unit = np.random.default_rng(61).uniform(-0.1, 1.1, (64, 3))
    unit = unit[np.lexsort((unit[:, 1], unit[:, 0]))]
    points = (unit @ volume.to_world[:3, :3].T + volume.to_world[:3, 3]).astype(np.float32)
    w = unit_vectors(64, 62)
    suns = np.broadcast_to(unit_vectors(2, 63), (64, 2, 3))
    albedos = np.broadcast_to(np.array([1.0, 0.9], np.float32), (64, 2))
    lobes = np.repeat(as_lobes(np.array([phase])), 64, axis=0)
    first = trace_walks(Field(backend(), volume, scale), points, w, lobes, suns, albedos, walks, seed=64)
    second = trace_walks_mitsuba(volume, scale, points, w, lobes, suns, albedos, walks, seed=65)
    maps = [v.astype(np.float64).reshape(8, 8, batches, -1, 4).mean(axis=3).transpose(2, 0, 1, 3) for v in (first, second)]
    return maps[0], maps[1]


def relative_error(first: Floats, second: Floats) -> float:
    """Standard error of the difference of the two means, over the mean."""
    spread = sum(float(np.mean(s, axis=tuple(range(1, s.ndim))).var(ddof=1)) / len(s) for s in (first, second))
    return float(np.sqrt(spread) / second.mean())


@pytest.mark.parametrize("phase", [0.6, 0.85, (0.8, -0.4, 0.75)])
@pytest.mark.parametrize("name", ["cloud", "cube"])
def test_labels_at_points(name: str, phase: Phase) -> None:
    first, second = label_maps(name, phase, walks=2560, batches=32)
    assert relative_error(first, second) < 0.025
    assert first.mean() > 0.1
    report = welch(first, second, tile=4)
    assert report.agrees(ALPHA), report
    # One sun and one albedo at a time: opposite biases would cancel in the mean.
    for column in range(4):
        report = welch(first[..., column], second[..., column], tile=4)
        assert report.agrees(ALPHA), (column, report)


def test_the_comparison_of_labels_has_power() -> None:
    """A bias of a tenth, a tile a third too bright and a doubled point are each found."""
    first, second = label_maps("cube", 0.6, walks=2048, batches=32)
    assert not welch(first * 1.1, second, tile=4).agrees(ALPHA)
    tile = first.copy()
    tile[:, :4, 4:] *= 4 / 3
    assert not welch(tile, second, tile=4).agrees(ALPHA)
    point = first.copy()
    brightest = np.unravel_index(np.argmax(second.mean(axis=0)), second.shape[1:])
    point[:, brightest[0], brightest[1], brightest[2]] *= 2
    assert not welch(point, second, tile=4).agrees(ALPHA)


def test_one_walk_at_a_time_has_the_moments_of_the_other() -> None:
    """At albedo 1 and without roulette both programs play the same game, so that even their noise agrees."""
    volume, scale = cube()
    points, w = np.zeros((1, 3), np.float32), unit_vectors(1, 66)
    suns, one = unit_vectors(1, 67)[None], np.ones((1, 1), np.float32)
    single = np.zeros(1, np.float32)
    first = trace_walks(Field(backend(), volume, scale), points, w, single, suns, one, 400_000, seed=68, connect=1e9).ravel()
    second = trace_walks_mitsuba(volume, scale, points, w, single, suns, one, 400_000, seed=69).ravel()
    assert first.mean() == pytest.approx(second.mean(), rel=0.02)
    assert first.std() == pytest.approx(second.std(), rel=0.1)


def camera(mi: Any, size: int) -> Any:
    """A perspective sensor that sees the whole of either volume, with some sky around it."""
    return mi.load_dict(
        {
            "type": "perspective",
            "fov": 34.0,
            "to_world": mi.ScalarTransform4f().look_at(origin=[2.0, -1.9, 1.1], target=[0, 0, 0], up=[0, 0, 1]),
            "film": {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "luminance", "rfilter": {"type": "box"}},
        }
    )


def camera_rays(mi: Any, sensor: Any, size: int, spp: int, seed: int) -> tuple[Singles, Singles]:
    """Origins and directions of `spp` rays for each pixel of the sensor, pixel by pixel: (size * size * spp, 3)."""
    rng = np.random.default_rng(seed)
    row, column = np.divmod(np.repeat(np.arange(size * size), spp), size)
    place = (np.stack([column, row]) + rng.random((2, row.size))) / size
    ray, _ = sensor.sample_ray(0.0, 0.0, mi.Point2f(place.astype(np.float32)), mi.Point2f(0.5, 0.5))
    shape = (3, row.size)
    return np.broadcast_to(np.array(ray.o), shape).T.astype(np.float32), np.broadcast_to(np.array(ray.d), shape).T.astype(np.float32)


def tracker_image(field: Field, rays: tuple[Singles, Singles], g: float, albedo: float, sun: Singles, seed: int) -> Floats:
    """Radiance along the rays: at the first collision the sun's light attenuated (S1) and one walk for J."""
    streams = [int(s.generate_state(1)[0]) for s in np.random.SeedSequence(seed).spawn(2)]
    points, hit = first_collisions(field, *rays, seed=streams[0])
    points, w = points[hit], rays[1][hit]
    t, n = field.types, len(points)
    toward = t.Array3f(*(float(v) for v in sun))
    depth = optical_depth(field, device(points), toward, t.Float(0), t.Float(1e4), t.Bool(np.ones(n, bool)))
    single = albedo * hg_numpy(w.astype(np.float64) @ sun.astype(np.float64), g) * np.exp(-np.array(depth, np.float64))
    suns = np.broadcast_to(sun, (n, 1, 3))
    j = trace_walks(field, points, w, np.full(n, g, np.float32), suns, np.full((n, 1), albedo, np.float32), 1, seed=streams[1])
    radiance = np.zeros(len(hit))
    radiance[hit] = single + albedo**2 * j[:, 0, 0, 0] / (4 * np.pi)
    return radiance


def images(mi: Any, name: str, g: float, albedo: float, sun: Singles, seeds: int, spp: int, size: int = 24) -> tuple[Floats, Floats]:
    """`seeds` images of the tracker and of volpath, (seeds, size, size) each."""
    volume, scale = VOLUMES[name]()
    mi.set_variant("llvm_ad_mono")
    field, sensor = Field(backend(), volume, scale), camera(mi, size)
    scene = mi.load_dict(scene_dict(volume, scale, g, sun, albedo))
    first, second = [], []
    for seed in range(seeds):
        rays = camera_rays(mi, sensor, size, spp, 1000 + seed)
        first.append(tracker_image(field, rays, g, albedo, sun, 2000 + seed).reshape(size, size, spp).mean(axis=2))
        second.append(np.array(mi.render(scene, sensor=sensor, spp=spp, seed=3000 + seed), np.float64).reshape(size, size))
    return np.stack(first), np.stack(second)


SIDE = np.array([0.48, 0.6, 0.64], np.float32)
BEHIND = np.array([-0.8, 0.52, 0.3], np.float32)


def smallest_p(first: Floats, second: Floats) -> float:
    """Smallest of the p-values of the mean, of the tiles, and of the pixels of some brightness.

    Where a sliver of an opaque edge is seen, the tracker's transmittance toward the sun is tiny and certain, and volpath's is one in
    a million times: a few hundred samples of such a pixel are all zero and hold no estimate of their own variance.
    """
    whole = welch(first, second, tile=6)
    bright = bright_mask(first.mean(axis=0), second.mean(axis=0))[..., 0]
    return min(whole.p_image, whole.p_tiles, welch(first * bright, second * bright, tile=6).p_pixels)


def check_image(mi: Any, name: str, g: float, albedo: float, sun: Singles, seeds: int, spp: int) -> None:
    sun = sun / np.linalg.norm(sun)
    first, second = images(mi, name, g, albedo, sun, seeds, spp)
    assert relative_error(first, second) < 0.03
    assert (second.mean(axis=0) > 0).mean() > 0.2
    assert smallest_p(first, second) > ALPHA / 3
    assert smallest_p(first * 1.15, second) < ALPHA / 3


@pytest.mark.parametrize(("name", "g", "albedo", "sun"), [("cloud", 0.85, 1.0, SIDE), ("cube", 0.6, 0.9, BEHIND)])
def test_images(mi: Any, name: str, g: float, albedo: float, sun: Singles) -> None:
    check_image(mi, name, g, albedo, sun, seeds=24, spp=48)


@pytest.mark.slow
@pytest.mark.parametrize("g", [0.0, 0.85])
@pytest.mark.parametrize("albedo", [0.9, 1.0])
@pytest.mark.parametrize("name", ["cloud", "cube"])
def test_images_of_more_media(mi: Any, name: str, g: float, albedo: float) -> None:
    check_image(mi, name, g, albedo, BEHIND if g == 0 else SIDE, seeds=24, spp=192)


def test_labels_are_refused_where_they_cannot_be_formed(mi: Any) -> None:
    volume, scale = cube()
    points, w = np.zeros((1, 3), np.float32), unit_vectors(1, 70)
    suns, one, single = unit_vectors(1, 71)[None], np.ones((1, 1), np.float32), np.zeros(1, np.float32)
    for albedo in (0.0, 1.5, np.nan):
        with pytest.raises(InputError, match="albedo"):
            trace_walks_mitsuba(volume, scale, points, w, single, suns, one * albedo, 4, seed=1)
    with pytest.raises(InputError, match="-1 < g1"):
        trace_walks_mitsuba(volume, scale, points, w, single + 1, suns, one, 4, seed=1)
    empty = trace_walks_mitsuba(volume, 0.0, points, w, single, suns, one, 4, seed=1)
    np.testing.assert_array_equal(empty, np.zeros((1, 4, 1, 1)))
    mi.set_variant("scalar_spectral")
    with pytest.raises(InputError, match="set_variant"):
        trace_walks_mitsuba(volume, scale, points, w, single, suns, one, 4, seed=1)


def test_meters_stand_at_their_points(mi: Any) -> None:
    """Rays leave the very point, not a little beyond it, where a label in a dense cloud belongs to somewhere else."""
    volume, scale = cloud()
    points, w = np.array([[0.1, -0.2, 0.05], [0.3, 0.1, 0.0]], np.float32), unit_vectors(2, 79)
    directions = draw_directions(np.random.default_rng(80), w, 0.5, 3)
    (sensor,) = VolpathScene(volume, scale, 0.5).meters(points, directions, inside=True)
    for i, (point, direction) in enumerate(zip(np.repeat(points, 3, axis=0), directions.reshape(-1, 3), strict=True)):
        ray, _ = sensor.sample_ray(0.0, 0.0, mi.Point2f((i + 0.5) / 6, 0.5), mi.Point2f(0.5, 0.5))
        np.testing.assert_allclose(np.array(ray.o), point, atol=1e-6)
        np.testing.assert_allclose(np.array(ray.d), direction, atol=1e-6)


def test_albedos_enter_both_alike() -> None:
    """From the first order alone to the white medium, the label keeps its meaning: no power of the albedo too many or too few."""
    volume, scale = cube()
    n, walks = 16, 20_000
    points, w = np.zeros((n, 3), np.float32), unit_vectors(n, 75)
    suns = np.broadcast_to(unit_vectors(1, 76), (n, 1, 3))
    albedos = np.broadcast_to(np.array([0.01, 0.3, 0.7, 1.0], np.float32), (n, 4))
    single = np.full(n, 0.3, np.float32)
    first = trace_walks(Field(backend(), volume, scale), points, w, single, suns, albedos, walks, seed=77).astype(np.float64)
    second = trace_walks_mitsuba(volume, scale, points, w, single, suns, albedos, walks, seed=78).astype(np.float64)
    mean = [v.mean(axis=(0, 1, 2)) for v in (first, second)]
    error = np.sqrt(sum(v.var(axis=(0, 1, 2)) / (n * walks) for v in (first, second)))
    assert np.all(error < 0.02 * mean[1])
    assert np.abs((mean[0] - mean[1]) / error).max() < 4
    assert mean[1][3] > 2 * mean[1][0]


def test_variants_agree(mi: Any) -> None:
    """Grey stays grey: the scalar colour variant gives what the monochromatic one on all lanes gives."""
    volume, scale = cube()
    points, w = np.zeros((8, 3), np.float32), unit_vectors(8, 72)
    suns, albedo = np.broadcast_to(unit_vectors(1, 73), (8, 1, 3)), np.full((8, 1), 0.95, np.float32)
    single = np.full(8, 0.3, np.float32)
    means = []
    for variant in ("scalar_rgb", "llvm_ad_mono"):
        mi.set_variant(variant)
        j = trace_walks_mitsuba(volume, scale, points, w, single, suns, albedo, 4096, seed=74).astype(np.float64)
        means.append((j.mean(), j.std() / np.sqrt(j.size)))
    assert abs(means[0][0] - means[1][0]) < 4 * np.hypot(means[0][1], means[1][1])
