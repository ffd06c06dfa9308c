"""Rationale: a light from all around is asked for as a few directions; what stands for a part of it must not count what is dark there.

Expected behaviour: the parts of a sky have its light and, together, the solid angle of what is not black, however few they are; each has
random numbers of its own; and lights of two colours are never one colour, however dim.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from deepclouds_runtime import stratified
from deepclouds_runtime.frame_source import Arriving, of_beams
from deepclouds_runtime.lights import Beam, Environment
from deepclouds_runtime.predicted import _tint
from deepclouds_runtime.stratified import Stratified

from deepclouds.backend import backend


@pytest.mark.parametrize("count", [2, 5, 48])
def test_parts_of_a_half_black_sky_cover_the_other_half(count: int) -> None:
    colours = np.zeros((16, 32, 3))
    colours[8:] = [1.0, 2.0, 0.5]
    sky = Environment(backend(), lambda direction: [], colours)
    beams = sky.beams(count)
    assert 0 < len(beams) <= count
    assert sum(beam.solid_angle for beam in beams) == pytest.approx(2 * np.pi)
    np.testing.assert_allclose(np.sum([beam.irradiance for beam in beams], axis=0), 2 * np.pi * colours[8, 0])
    for beam in beams:
        # Even light: that of each part is its radiance times its solid angle.
        np.testing.assert_allclose(beam.irradiance, beam.solid_angle * colours[8, 0])


def test_beams_share_no_random_numbers() -> None:
    types = backend()

    def arriving_beam(points: Any, beam: Beam, numbers: Stratified) -> list[Any]:
        return [numbers.number(stratified.LIGHT_U)]

    source: Any = SimpleNamespace(arriving_beam=arriving_beam)
    beams = [Beam((0.0, 0.0, 1.0), 1.0, (1.0,)) for _ in range(4)]
    points = types.Array3f(*np.zeros((3, 512), np.float32))
    drawn = np.stack([np.array(light.at(points)[0]) for light in of_beams(types, source, beams, True, 7)])
    np.testing.assert_allclose(drawn.mean(axis=1), 0.5, atol=0.08)
    assert np.abs(np.corrcoef(drawn) - np.eye(4)).max() < 0.25


@pytest.mark.parametrize("power", [1.0, 1e-9, 1e-30])
def test_two_colours_are_not_one(power: float) -> None:
    red, blue, dim = (Arriving((0, 0, 1), tuple(power * v for v in c), lambda x: [], True) for c in ((1, 0, 0), (0, 0, 1), (0.5, 0, 0)))
    assert _tint([red, blue]) is None
    tint = _tint([red, dim])
    assert tint is not None
    np.testing.assert_allclose(tint, [1, 0, 0])
