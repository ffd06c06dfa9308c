"""Rationale: a light from all around is asked for as a few directions; what stands for a part of it must not count what is dark there.

Expected behaviour: the parts of a sky have its light and, together, the solid angle of what is not black, however few they are.
"""

from __future__ import annotations

import numpy as np
import pytest
from deepclouds_runtime.lights import Environment

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
