"""Rays of the three cameras, and the direction and distance in which they see points."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np
import pytest
from deepclouds_runtime._mitsuba import types_of
from deepclouds_runtime.camera import Camera
from deepclouds_runtime.stratified import Stratified
from numpy.typing import NDArray

LENS = 0.3
KINDS: dict[str, dict[str, Any]] = {
    "perspective": {"fov": 40.0},
    "orthographic": {},
    "thinlens": {"fov": 40.0, "aperture_radius": LENS, "focus_distance": 4.0},
}
WIDTH, HEIGHT = 7, 5
PLACE = np.array([1.0, 2.0, 5.0])


@pytest.fixture(autouse=True)
def mi(llvm_mitsuba: ModuleType) -> ModuleType:
    return llvm_mitsuba


def _camera(mi: Any, kind: str, **film: int) -> Camera:
    to_world = mi.ScalarTransform4f().look_at(origin=PLACE.tolist(), target=[0, 0, 0], up=[0, 1, 0])
    if kind == "orthographic":
        to_world = to_world @ mi.ScalarTransform4f().scale([1.5, 1.5, 1])
    frame = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, **film}
    return Camera(types_of(mi), mi.load_dict({"type": kind, "to_world": to_world, "film": frame, **KINDS[kind]}))


def _rays(mi: Any, camera: Camera, pixels: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    types = types_of(mi)
    n = len(pixels)
    # The number of the pixel is that of the random stream too: all get that of pixel 0.
    numbers = Stratified(types, types.UInt32(np.zeros(n, np.uint32)), dr.arange(types.UInt32, n), types.UInt32(n), types.UInt32(1))
    origin, direction, _ = camera.rays(types.UInt32(pixels.astype(np.uint32)), numbers)
    assert dr.width(direction.x) == dr.width(direction.y) == dr.width(direction.z) == n
    return np.array(origin, np.float64).T, np.array(direction, np.float64).T


@pytest.mark.parametrize("kind", KINDS)
def test_points_on_a_ray_are_seen_along_it(mi: Any, kind: str) -> None:
    camera = _camera(mi, kind)
    origin, direction = _rays(mi, camera, np.arange(WIDTH * HEIGHT))
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1, rtol=1e-6)
    reach = 8.0
    points = origin + reach * direction
    seen = camera.toward(points)
    # Through a lens the ray comes from a place beside its middle.
    slack = 1.2 * LENS / reach if kind == "thinlens" else 1e-5
    assert np.abs(seen - direction).max() < slack
    if kind == "thinlens":
        assert np.abs(seen - direction).max() > 0.2 * LENS / reach
    assert np.ptp(direction, axis=0).max() > 0.1 or kind == "orthographic"


@pytest.mark.parametrize("kind", KINDS)
def test_distances_start_at_the_camera(mi: Any, kind: str) -> None:
    points = np.random.default_rng(4).uniform(-1, 1, (20, 3))
    types = types_of(mi)
    device = types.Array3f(*(types.Float(points[:, c].astype(np.float32)) for c in range(3)))
    found = np.array(_camera(mi, kind).distance(device))
    away = points - PLACE
    axis = -PLACE / np.linalg.norm(PLACE)
    np.testing.assert_allclose(found, away @ axis if kind == "orthographic" else np.linalg.norm(away, axis=1), rtol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_a_crop_window_has_the_rays_of_its_pixels(mi: Any, kind: str) -> None:
    whole = _camera(mi, kind)
    crop = _camera(mi, kind, crop_width=3, crop_height=2, crop_offset_x=2, crop_offset_y=1)
    rows, columns = np.divmod(np.arange(6), 3)
    for a, b in zip(_rays(mi, crop, np.arange(6)), _rays(mi, whole, (rows + 1) * WIDTH + columns + 2), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-5)


BOX = np.array([(x, y, z) for x in (-0.4, 0.1) for y in (-0.2, 0.5) for z in (-0.3, 0.6)])
FINE = {"width": 140, "height": 100}


def _meets(
    origin: NDArray[np.float64], direction: NDArray[np.float64], lower: NDArray[np.float64], upper: NDArray[np.float64]
) -> NDArray[Any]:
    with np.errstate(divide="ignore"):
        ends = np.stack([(lower - origin) / direction, (upper - origin) / direction])
    met: NDArray[Any] = ends.min(axis=0).max(axis=1) < ends.max(axis=0).min(axis=1)
    return met


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "crop", [{}, {"crop_width": 70, "crop_height": 30, "crop_offset_x": 60, "crop_offset_y": 20}], ids=["whole", "crop"]
)
def test_what_shows_a_box_lies_in_its_window(mi: Any, kind: str, crop: dict[str, int]) -> None:
    camera = _camera(mi, kind, **FINE, **crop)
    window = camera.window(BOX)
    width, height = window.size
    assert (width, height) == (crop.get("crop_width", 140), crop.get("crop_height", 100))
    pixels = np.repeat(np.arange(width * height), 16)
    origin, direction = _rays(mi, camera, pixels)
    row, column = np.divmod(pixels[_meets(origin, direction, BOX[0], BOX[-1])], width)
    assert len(row) > 1000
    assert window.left <= column.min()
    assert column.max() < window.left + window.width
    assert window.top <= row.min()
    assert row.max() < window.top + window.height
    # And little more: a pixel and a part of one on each side, and where only the blur of the box's corner reaches.
    slack = 6 if kind == "thinlens" else 4
    assert window.width <= np.ptp(column) + 1 + slack
    assert window.height <= np.ptp(row) + 1 + slack
    index = np.arange(window.count)
    there = window.pixels(index)
    np.testing.assert_array_equal(there % width, window.left + index % window.width)
    np.testing.assert_array_equal(there // width, window.top + index // window.width)
    assert window.share == pytest.approx(window.count / (width * height))


@pytest.mark.parametrize("kind", KINDS)
def test_a_box_around_or_out_of_sight_has_the_whole_image(mi: Any, kind: str) -> None:
    camera = _camera(mi, kind, **FINE)
    away = PLACE / np.linalg.norm(PLACE)
    for corners in (BOX + PLACE, BOX + 2 * PLACE, 40 * BOX, BOX + 60 * np.cross(away, (0, 1, 0))):
        assert camera.window(corners).count == 140 * 100


@pytest.mark.parametrize("kind", KINDS)
def test_a_footprint_is_as_far_as_the_next_pixel_sees(mi: Any, kind: str) -> None:
    camera = _camera(mi, kind, **FINE)
    axis = -PLACE / np.linalg.norm(PLACE)
    depths = np.array([2.0, 5.0, 9.0])
    found = camera.footprint(PLACE + depths[:, None] * axis)
    expected = np.full(3, 2 * 1.5 / 140) if kind == "orthographic" else depths * 2 * np.tan(np.radians(20)) / 140
    np.testing.assert_allclose(found, expected, rtol=1e-3)
