"""Rationale: what smooths noise may smooth what is really there as well: textures, edges, and the light close to the cloud.

Expected behaviour: even light under noise loses most of it and none of its sum; textures stay to the last digit; surfaces of other
height or direction, and places close to the cloud, do not mix; what is not matt adds nothing.
"""

from __future__ import annotations

import numpy as np
import pytest
from deepclouds_runtime.thrown import ThrownLight
from numpy.typing import NDArray

from deepclouds.backend import backend

SIZE = 32, 20
PIXELS = SIZE[0] * SIZE[1]
Floats = NDArray[np.float64]


def _smoothed(
    light: Floats,
    share: Floats,
    place: Floats,
    normal: Floats,
    box: tuple[Floats, Floats] = (np.array([0.0, 50, 0]), np.array([1.0, 51, 1])),
    matt: NDArray[np.bool_] | None = None,
    samples: int = 1,
) -> Floats:
    film = ThrownLight(backend(), SIZE, box)
    _add(film, light, share, place, normal, matt, samples)
    return film.smoothed().astype(np.float64)


def _add(
    film: ThrownLight,
    light: Floats,
    share: Floats,
    place: Floats,
    normal: Floats,
    matt: NDArray[np.bool_] | None = None,
    samples: int = 1,
) -> None:
    types = backend()

    def floats(values: Floats) -> list[object]:
        return [types.Float(np.repeat(values[:, c], samples).astype(np.float32)) for c in range(values.shape[1])]

    counted = types.Bool(np.ones(PIXELS * samples, bool) if matt is None else np.repeat(matt, samples))
    pixels = np.arange(PIXELS, dtype=np.uint32)
    film.add(pixels, samples, floats(light), floats(share), types.Array3f(*floats(place)), types.Array3f(*floats(normal)), counted)


@pytest.fixture
def plane() -> tuple[Floats, Floats]:
    """Places and normals of a level floor, a unit of length a pixel in ten."""
    y, x = np.divmod(np.arange(PIXELS), SIZE[0])
    return np.stack([x / 10, 0 * x, y / 10], axis=1), np.tile([0.0, 1, 0], (PIXELS, 1))


def test_even_light_loses_its_noise_and_not_its_sum(plane: tuple[Floats, Floats]) -> None:
    random = np.random.default_rng(1)
    light = random.exponential(size=(PIXELS, 3))
    out = _smoothed(light, np.ones((PIXELS, 3)), *plane)
    assert out.std() < 0.25 * light.std()
    assert out.mean() == pytest.approx(light.mean(), rel=0.02)


@pytest.mark.parametrize("samples", [1, 3])
def test_textures_stay(plane: tuple[Floats, Floats], samples: int) -> None:
    share = np.random.default_rng(2).random((PIXELS, 3))
    share[::7] = 0
    light = share * [0.3, 2.0, 1.0]
    np.testing.assert_allclose(_smoothed(light, share, *plane, samples=samples), samples * light, rtol=2e-5, atol=1e-6)


@pytest.mark.parametrize("change", ["height", "direction"])
def test_other_surfaces_do_not_mix(plane: tuple[Floats, Floats], change: str) -> None:
    place, normal = plane
    right = np.arange(PIXELS) % SIZE[0] >= 16
    if change == "height":
        place = place + np.where(right, 0.5, 0)[:, None] * [0, 1, 0]
    else:
        normal = np.where(right[:, None], [1.0, 0, 0], normal)
    light = np.where(right, 3.0, 1.0)[:, None] * np.ones(3)
    np.testing.assert_allclose(_smoothed(light, np.ones((PIXELS, 3)), place, normal), light, rtol=1e-5)


def test_close_to_the_cloud_nothing_is_smoothed(plane: tuple[Floats, Floats]) -> None:
    light = np.random.default_rng(3).exponential(size=(PIXELS, 3))
    box = np.array([-1.0, -1, -1]), np.array([1.5, 1, 5])
    out = _smoothed(light, np.ones((PIXELS, 3)), *plane, box=box)
    inside = plane[0][:, 0] <= 1.5
    np.testing.assert_allclose(out[inside], light[inside], rtol=1e-5)
    assert np.abs(out - light)[plane[0][:, 0] > 2.5].max() > 0.5


def test_what_is_not_matt_adds_nothing(plane: tuple[Floats, Floats]) -> None:
    matt = np.arange(PIXELS) % 3 > 0
    light = np.where(matt, 1.0, 100.0)[:, None] * np.ones(3)
    out = _smoothed(light, np.ones((PIXELS, 3)), *plane, matt=matt)
    np.testing.assert_allclose(out[matt], 1, rtol=1e-5)
    assert not out[~matt].any()
    assert not _smoothed(light, np.ones((PIXELS, 3)), *plane, matt=np.zeros(PIXELS, bool)).any()


def test_more_samples_are_smoothed_too(plane: tuple[Floats, Floats]) -> None:
    """What was asked for before they came is what there was."""
    film, share = ThrownLight(backend(), SIZE, (np.array([0.0, 50, 0]), np.array([1.0, 51, 1]))), np.ones((PIXELS, 3))
    _add(film, share, share, *plane)
    first = film.smoothed()
    assert film.smoothed() is first
    kept = first.copy()
    _add(film, 2 * share, share, *plane)
    np.testing.assert_array_equal(first, kept)
    np.testing.assert_allclose(film.smoothed(), 3, rtol=1e-5)
