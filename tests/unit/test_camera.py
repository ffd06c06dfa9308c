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
