"""Which grids of a .vdb file count as light of the cloud's own.

Rationale: a fire rendered as smoke alone looks right and is wrong; a weather model's temperature must not stop a render.
Expected behaviour: as listed, for names, for values, and for files that OpenVDB wrote (data/make_fixtures.cpp).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepclouds.errors import InputError
from deepclouds.volume.emission import emissive_grids, glows, may_glow

DATA = Path(__file__).parent / "data"


@pytest.mark.parametrize(
    "name",
    [
        "temperature",
        "Temperature",
        "potentialTemperature",
        "temp",
        "heat",
        "flame",
        "Flames",
        "FlameColour",
        "fire",
        "burn",
        "emission_scale",
    ],
)
def test_names_that_may_tell_of_light(name: str) -> None:
    assert may_glow(name)


@pytest.mark.parametrize("name", ["density", "velocity", "wheat", "template", "misfiring", "smoke", "", "Cd"])
def test_names_that_do_not(name: str) -> None:
    assert not may_glow(name)


RAMP = np.linspace(0, 1, 8, dtype=np.float32)


@pytest.mark.parametrize(
    ("name", "values", "background", "light"),
    [
        ("flame", RAMP, 0.0, True),
        ("flame", np.ones(8, np.float32), 0.0, True),
        ("flame", 0 * RAMP, 0.0, False),
        ("flame", RAMP[:0], 0.0, False),
        ("flame", RAMP[:0], 1.0, True),
        ("flameTemperature", np.ones(8, np.float32), 0.0, True),
        ("temperature", RAMP, 0.0, True),
        ("temperature", 0 * RAMP, 0.0, False),
        ("temperature", RAMP[:0], 0.0, False),
        ("temperature", np.full(8, 293, np.float32), 0.0, False),
        ("temperature", np.full(8, 1, np.float32), 0.0, False),
        ("temperature", 240 + 60 * RAMP, 293.0, False),
        ("temperature", np.append(240 + 60 * RAMP, 0).astype(np.float32), 0.0, False),
        ("temperature", 240 + 1000 * RAMP, 293.0, True),
        ("temperature", 20 * RAMP - 5, 0.0, True),
        ("temperature", np.append(240 + 60 * RAMP, np.nan).astype(np.float32), 0.0, True),
    ],
)
def test_values_decide(name: str, values: np.ndarray[tuple[int, ...], np.dtype[np.float32]], background: float, light: bool) -> None:
    assert glows(name, values, background) == light


def test_grids_of_a_file() -> None:
    assert emissive_grids(DATA / "fire.vdb") == ("temperature", "FlameColour")
    # What is rendered as density is no light.
    assert emissive_grids(DATA / "fire.vdb", "temperature") == ("FlameColour",)
    assert emissive_grids(DATA / "weather.vdb") == ()
    assert emissive_grids(DATA / "several.vdb", "heat") == ("flames",)
    assert emissive_grids(DATA / "tiles.vdb") == ()
    with pytest.raises(InputError, match="no grid called 'smoke'"):
        emissive_grids(DATA / "fire.vdb", "smoke")
