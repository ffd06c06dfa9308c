"""Both parts of an image's error: what is known, and where it comes from, is said; what is not known is said to be unknown."""

from __future__ import annotations

import math
from typing import Any

import pytest
from deepclouds_runtime.error_parts import AVERAGED, error_parts, in_words

FOUND = {"error": 0.05, "error_interval": [0.04, 0.06], "energy": 0.01, "energy_interval": [0.0, 0.02]}
LEFT = {**FOUND, "error": 0.02, "error_interval": [0.01, 0.03]}
METRICS = {"all.rrmse": 0.18, "all.rrmse_low": 0.1, "all.rrmse_high": 0.3}


def test_samples_and_interpolation_add_up() -> None:
    parts = error_parts(0.03, [(0.1, 1.0), (0.4, 3.0)], 0.5, True, {}, {}, {})
    assert parts["sampling"] == 0.03
    assert parts["interpolation"] == pytest.approx(AVERAGED * 0.5 * math.hypot(0.1, 1.2) / 4)
    assert parts["both"] == pytest.approx(math.hypot(0.03, parts["interpolation"]))
    assert in_words(parts)[0] == "noise of a pixel 3 %, interpolation 3 %, together 4.2 %"
    once = error_parts(None, [], 0.0, True, {}, {}, {})
    assert (once["both"], once["interpolation"]) == (None, None)
    assert in_words(once)[0] == "noise unknown (one round of samples)"


@pytest.mark.parametrize(
    ("audit", "expected", "metrics", "by", "said"),
    [
        ({"network": FOUND, "corrected": False}, {"error": 0.1}, METRICS, "walks", "5 % (4 to 6 %) of the multiple scattering of regions"),
        ({"network": FOUND, "corrected": True, "remaining": LEFT}, {}, {}, "walks", "2 % (1 to 3 %) of the multiple scattering of regions"),
        ({}, {"error": 0.1}, METRICS, "expectation", "10 % of the cloud's light, expected, not measured here (--audit)"),
        ({}, {}, METRICS, "validation", "18 % (10 to 30 %) of multiple scattering at single points of held-out clouds, unknown here"),
        ({}, {}, {}, "unknown", "unknown: nothing has measured it here (--audit)"),
    ],
    ids=["audited", "corrected", "expected", "validated", "unknown"],
)
def test_the_networks_part_is_by_the_best_that_is_known(
    audit: dict[str, Any], expected: dict[str, float], metrics: dict[str, float], by: str, said: str
) -> None:
    parts = error_parts(0.02, [(0.05, 1.0)], 0.7, True, audit, expected, metrics)
    assert parts["network"]["by"] == by
    assert in_words(parts)[1].startswith(said)


def test_nothing_is_said_of_a_network_that_was_not_asked() -> None:
    parts = error_parts(0.02, [], 0.7, False, {}, {}, METRICS)
    assert parts["network"] == {"by": "none"}
    assert in_words(parts)[1] == "none was asked"
