"""Rationale: an audit is most of a render's time; it may neither stop short of what was asked for nor go on for nothing.

Expected behaviour: with a stand-in whose error falls with the fourth root of the number of walks, an audit that corrects ends where the
error asked for is reached, at three times the usual number at the latest; under a time it ends in time, by the pace that it finds, having
used what it had; who interrupts it gets what there is.
"""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
from deepclouds_runtime import audit as module
from deepclouds_runtime.audit import ROUND, RegionError, audited

USUAL = 1 << 20
ERROR = 0.02


class StandIn:
    """An audit whose walks, corrections and judgements take the seconds of a clock that nobody else moves."""

    def __init__(self, left_by_usual: float, pace: float = 1e-6, correction: float = 0.02) -> None:
        self.count, self.under_way, self.filled = 0, 0, 1000
        self.now, self.rounds = 100.0, 0
        self._left, self._pace, self._correction = left_by_usual, pace, correction

    def extend(self, walks: int, ahead: bool = True) -> None:
        self.now += self._pace * self.under_way
        self.under_way = walks
        self.count += walks
        self.rounds += 1

    def settle(self) -> None:
        self.now += self._pace * self.under_way
        self.under_way = 0

    def before(self) -> RegionError:
        self.settle()
        return RegionError(0.3, 0.001, 0.5**2, 0.0)

    def remaining(self) -> RegionError:
        self.settle()
        self.now += 2 * self._correction
        return RegionError(0.0, 0.001, (self._left * (USUAL / self.count) ** 0.25) ** 2, 0.0)

    def correction(self) -> Any:
        self.settle()
        self.now += self._correction
        return SimpleNamespace(levels=3)

    def corrected(self, correction: Any) -> list[Any]:
        self.now += self._correction
        return ["corrected"]


def ran(
    monkeypatch: pytest.MonkeyPatch, audit: StandIn, error: float, until: float = math.inf, most: int = USUAL, first: int = ROUND
) -> Any:
    monkeypatch.setattr(module, "time", SimpleNamespace(perf_counter=lambda: audit.now))
    every: Any = audit
    sources: Any = ["predicted"]
    return audited(every, sources, True, error, most, lambda: until - audit.now, first)


@pytest.mark.parametrize(("left", "times"), [(0.3, 0.25), (0.7, 0.25), (0.99, 1), (1.0, 1), (1.2, 1.2**4), (1.3, 1.3**4), (1.4, 3), (5, 3)])
def test_walks_end_where_the_error_asked_for_is_reached(monkeypatch: pytest.MonkeyPatch, left: float, times: float) -> None:
    """Or at three times the usual number; the first round, a fourth of it, is judged too."""
    audit = StandIn(left * ERROR)
    outcome = ran(monkeypatch, audit, ERROR)
    assert outcome.sources == ["corrected"]
    # What a last round would add to less than a tenth of is left out.
    assert audit.count == pytest.approx(times * USUAL, rel=0.1)
    assert outcome.found["walks"] == audit.count


@pytest.mark.parametrize("pace", [3e-7, 1e-6, 3e-6])
@pytest.mark.parametrize("seconds", [0.8, 2.0, 6.0])
def test_time_is_used_and_kept(monkeypatch: pytest.MonkeyPatch, seconds: float, pace: float) -> None:
    audit = StandIn(0.1, pace)
    began = audit.now
    ran(monkeypatch, audit, 0.0, began + seconds, 1 << 26, 1 << 15)
    taken = audit.now - began
    # Six corrections' time is set aside for two, one and one, twice as much at most for what grows with the cells.
    assert 0.5 * seconds < taken <= seconds + 0.5 * (1 << 15) * pace + 1e-9
    assert audit.rounds < seconds / (ROUND * pace) + 20


def test_no_time_is_enough_for_a_first_round(monkeypatch: pytest.MonkeyPatch) -> None:
    audit = StandIn(0.1)
    outcome = ran(monkeypatch, audit, 0.0, audit.now, 1 << 26, 1 << 15)
    assert audit.count == 1 << 15
    assert outcome.sources == ["corrected"]
    audit = StandIn(0.1)
    ran(monkeypatch, audit, ERROR, audit.now)
    assert audit.count == ROUND
