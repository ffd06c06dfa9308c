"""The tracker in clouds of the generator: white furnace, reciprocity, and labels against Mitsuba's ``volpath``.

Rationale: what holds in a cube could fail where bricks are empty, density varies a hundredfold and a point lies in a fringe or in the
void, and those are the points a network learns from.
Expected behaviour: at albedo 1 energy is kept to 0.5 % at every kind of point; a cloud scatters as much from s to v as from v to s;
volpath's labels differ by nothing that Welch's test can find, while a bias of 3 % is found.
"""

from __future__ import annotations

from functools import cache
from types import ModuleType

import numpy as np
import pytest
from deepclouds_training.clouds import make_cloud, scale_for_optical_depth
from deepclouds_training.mitsuba_tracer import draw_directions, trace_walks_mitsuba
from numpy.typing import NDArray

from benchmarks.label_volpath import VolpathLabels
from deepclouds.backend import backend
from deepclouds.medium.field import Field
from deepclouds.medium.multiple_scattering import trace_walks
from deepclouds.medium.phase import as_lobes
from deepclouds.metrics import welch
from tests.system.full_renderer import Floats, Singles, radiance, unattenuated

ALPHA = 1e-3
# Family, seed and optical depth of the densest column.
CLOUDS = {"dense cumulus": ("cumulus", 31, 25.0), "sparse field": ("cumulus_field", 32, 12.0), "smoke plume": ("plume", 33, 6.0)}
TWO_LOBES = (0.5, -0.2, 0.7)


@cache
def cloud(name: str) -> Field:
    family, seed, depth = CLOUDS[name]
    volume = make_cloud(family, seed, 48)
    return Field(backend(), volume, scale_for_optical_depth(volume, depth))


def unit_vectors(count: int, seed: int) -> Singles:
    d = np.random.default_rng(seed).normal(size=(count, 3))
    unit: Singles = (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)
    return unit


def points_of_a_kind(field: Field, kind: str, count: int, seed: int) -> Singles:
    """Cell centres drawn from the densest fifth, from the faintest fifth of the cells that are not empty, or from the empty ones."""
    density = field.volume.density.astype(np.float64)
    some = density[density > 0]
    chosen = {
        "deep": density >= np.quantile(some, 0.8),
        "fringe": (density > 0) & (density <= np.quantile(some, 0.2)),
        "void": density == 0,
    }[kind]
    cells = np.argwhere(chosen)
    assert len(cells) > 20
    cells = cells[np.random.default_rng(seed).integers(0, len(cells), count)]
    unit = (cells[:, ::-1] + 0.5) / np.array(field.volume.resolution)
    m = field.volume.to_world
    points: Singles = (unit @ m[:3, :3].T + m[:3, 3]).astype(np.float32)
    return points


def even_directions(count: int) -> Floats:
    """Directions spread evenly over the sphere."""
    z = 1 - (2 * np.arange(count) + 1) / count
    spiral = np.pi * (1 + np.sqrt(5)) * np.arange(count)
    return np.stack([np.sqrt(1 - z**2) * np.cos(spiral), np.sqrt(1 - z**2) * np.sin(spiral), z], axis=1)


def turned(directions: Floats, count: int, seed: int) -> Singles:
    """`count` randomly rotated copies of the directions, (count, k, 3)."""
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(count, 3, 3)))
    # With the signs of the diagonal the rotations (and mirrors) are uniform.
    q = q * np.sign(np.einsum("nii->ni", r))[:, None, :]
    result: Singles = np.einsum("kc,ncd->nkd", directions, q).astype(np.float32)
    return result


@pytest.mark.parametrize("kind", ["deep", "fringe", "void"])
@pytest.mark.parametrize("g", [0.0, 0.85])
@pytest.mark.parametrize("name", ["dense cumulus", "sparse field"])
def test_white_furnace_at_every_kind_of_point(name: str, g: float, kind: str) -> None:
    """At albedo 1 the mean over all suns of 4 pi p T + j is exactly 1: light from everywhere cannot tell that there is a cloud."""
    field, n, suns, walks = cloud(name), 9000 if g == 0 else 40_000, 8, 24
    points, w = points_of_a_kind(field, kind, n, 1), unit_vectors(n, 2)
    phase = np.full(n, g, np.float32)
    j = trace_walks(field, points, w, phase, turned(even_directions(suns), n, 3), np.ones((n, 1), np.float32), walks, seed=4)
    # The mean of 4 pi p T over suns is that of T over suns drawn from p around w.
    draws = 40
    toward = draw_directions(np.random.default_rng(5), w, g, draws).reshape(-1, 3)
    single = unattenuated(field, np.repeat(points, draws, axis=0), toward).reshape(n, draws)
    total = j.mean(axis=(1, 2, 3), dtype=np.float64) + single.mean(axis=1)
    mean, error = total.mean(), total.std() / np.sqrt(n)
    assert j.mean() > 0.02
    assert error < 0.0022
    assert abs(mean - 1) < 4 * error, f"{mean:.4f} +- {error:.4f}"
    assert abs(mean - 1) < 0.005


@pytest.mark.parametrize(("name", "phase"), [("dense cumulus", 0.5), ("smoke plume", TWO_LOBES)])
def test_a_cloud_scatters_as_much_from_s_to_v_as_from_v_to_s(name: str, phase: float | tuple[float, float, float]) -> None:
    """Radiant intensity over irradiance, summed over the whole cloud, is the same with sun and view exchanged, whatever its form."""
    field, rays = cloud(name), 400_000
    lower, upper = field.volume.bounds
    middle, radius = (lower + upper) / 2, float(np.linalg.norm(upper - lower)) / 2
    first, second = (v.astype(np.float64) for v in unit_vectors(2, 6))
    intensities, errors = [], []
    for seed, (view, sun) in enumerate(((first, second), (second, first))):
        rng = np.random.default_rng([7, seed])
        # Parallel rays over the disc that the bounding sphere covers.
        a = np.cross(view, np.eye(3)[np.argmin(np.abs(view))])
        a /= np.linalg.norm(a)
        r, turn = radius * np.sqrt(rng.random((rays, 1))), rng.uniform(0, 2 * np.pi, (rays, 1))
        origin = middle + 1.001 * radius * view + r * (np.cos(turn) * a + np.sin(turn) * np.cross(view, a))
        seen = radiance(
            field, origin.astype(np.float32), np.tile((-view).astype(np.float32), (rays, 1)), phase, [sun], (1.0, 0.9), 8 + seed
        )
        intensities.append(seen[:, 0].mean(axis=0))
        errors.append(seen[:, 0].std(axis=0) / np.sqrt(rays))
    difference, error = intensities[0] - intensities[1], np.hypot(*errors)
    assert np.all(error < 0.015 * intensities[0])
    assert np.all(np.abs(difference) < 4 * error), difference / error


def label_maps(name: str, walks: int, batches: int) -> tuple[Floats, Floats]:
    """Labels of the tracker and of volpath as stacks (batches, 8, 8, 2 albedos): 64 points sorted along an axis, seen as an image."""
    field = cloud(name)
    rng = np.random.default_rng(9)
    points = np.concatenate([points_of_a_kind(field, kind, c, 10) for kind, c in (("deep", 24), ("fringe", 24), ("void", 16))])
    points = points[np.lexsort((points[:, 1], points[:, 0]))]
    w = rng.normal(size=(64, 3))
    w = (w / np.linalg.norm(w, axis=1, keepdims=True)).astype(np.float32)
    suns = np.broadcast_to(unit_vectors(1, 11), (64, 1, 3))
    albedos = np.broadcast_to(np.array([1.0, 0.95], np.float32), (64, 2))
    phase = np.repeat(as_lobes(np.array([TWO_LOBES])), 64, axis=0)
    first = trace_walks(field, points, w, phase, suns, albedos, 4 * walks, seed=12)
    second = trace_walks_mitsuba(field.volume, field.scale, points, w, phase, suns, albedos, walks, seed=13)
    maps = [v.astype(np.float64).reshape(8, 8, batches, -1, 2).mean(axis=3).transpose(2, 0, 1, 3) for v in (first, second)]
    return maps[0], maps[1]


@pytest.mark.slow
@pytest.mark.parametrize("name", CLOUDS)
def test_labels_against_volpath(scalar_mitsuba: ModuleType, name: str) -> None:
    """Image, tiles and points agree; a bias of 3 % either way would be noticed (5 % in the dense cloud), and a tile a fifth too bright."""
    first, second = label_maps(name, walks=768 if name == "dense cumulus" else 3072, batches=32)
    assert first.mean() > 0.02
    report = welch(first, second, tile=4)
    assert report.agrees(ALPHA), report
    for column in range(2):
        report = welch(first[..., column], second[..., column], tile=4)
        assert report.agrees(ALPHA), (column, report)
    bias = 0.05 if name == "dense cumulus" else 0.03
    for factor in (1 - bias, 1 + bias):
        report = welch(factor * first, second, tile=4)
        assert not report.agrees(ALPHA), (factor, report)
    tile = first.copy()
    tile[:, :4, 4:] *= 1.2
    assert not welch(tile, second, tile=4).agrees(ALPHA)


def test_the_comparison_keeps_its_promise_on_labels() -> None:
    """On labels of the tracker alone, as skewed as any: true nulls are rejected as rarely as asked for, a bias of 3 % mostly found."""
    field, sets, batches, walks = cloud("smoke plume"), 60, 16, 64
    points, w = points_of_a_kind(field, "deep", 16, 14), unit_vectors(16, 15)
    suns, one = np.broadcast_to(unit_vectors(1, 16), (16, 1, 3)), np.ones((16, 1), np.float32)
    j = trace_walks(field, points, w, np.full(16, 0.3, np.float32), suns, one, 2 * sets * batches * walks, seed=17)[:, :, 0, 0]
    maps = j.astype(np.float64).reshape(4, 4, 2, sets, batches, walks).mean(axis=5).transpose(2, 3, 4, 0, 1)
    reports = [welch(a, b, tile=2) for a, b in zip(*maps, strict=True)]
    for level in ("p_image", "p_tiles", "p_pixels"):
        p: NDArray[np.float64] = np.array([getattr(r, level) for r in reports])
        # Of 60 uniform values 6 lie below 0.1; 14 or more are as rare as one in a thousand.
        assert (p < 0.1).sum() < 14, (level, p)
        assert 0.3 < p.mean() < 0.7, (level, p.mean())
    # Two of sixty at a rate of one in a thousand are rarer than one in five hundred.
    assert sum(not r.agrees(ALPHA) for r in reports) < 2
    # All sets together see a bias of 3 %.
    first, second = (m.reshape(sets * batches, 4, 4) for m in maps)
    assert welch(first, second, tile=2).agrees(ALPHA)
    for factor in (0.97, 1.03):
        assert not welch(factor * first, second, tile=2).agrees(ALPHA)


@pytest.mark.parametrize("g", [0.0, 0.85])
def test_the_benchmark_of_volpath_measures_labels(scalar_mitsuba: ModuleType, g: float) -> None:
    """The meters of the benchmark estimate what the tracker does: directions, sun, albedo and units are right."""
    field, walks = cloud("smoke plume"), 8000
    points, w, sun = points_of_a_kind(field, "deep", 4, 18), unit_vectors(4, 19), unit_vectors(1, 20)
    for albedo in (1.0, 0.8):
        meters = VolpathLabels(field.volume, field.scale, g, albedo, points, w, walks, np.random.default_rng(21))
        second, seconds = meters.trace(sun[0].astype(np.float64), seed=22)
        columns, suns = np.full((4, 1), albedo, np.float32), np.broadcast_to(sun, (4, 1, 3))
        first = trace_walks(field, points, w, np.full(4, g, np.float32), suns, columns, 8 * walks, seed=23)[:, :, 0, 0].astype(np.float64)
        difference = first.mean(axis=1) - second.mean(axis=1)
        variance = first.var(axis=1) / (8 * walks) + second.var(axis=1) / walks
        assert seconds > 0
        assert meters.load_seconds > 0
        assert np.sqrt(variance.sum()) < 0.05 * first.mean(axis=1).sum()
        assert np.all(np.abs(difference) < 4 * np.sqrt(variance))
    outside = points + 10
    with pytest.raises(ValueError, match="outside"):
        VolpathLabels(field.volume, field.scale, g, 1.0, outside, w, 1, np.random.default_rng(24))
