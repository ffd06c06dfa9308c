"""Where a run's time goes, and how fast its two halves are: stencils built, samples stepped."""

from __future__ import annotations

import time

PHASES = ("building", "stepping", "validating")


class Pace:
    """Seconds by phase and counts of work, since the start of the process and since the last report."""

    def __init__(self) -> None:
        self.start()
        self._began = {"stencils": 0.0, "samples": 0.0, **dict.fromkeys(PHASES, 0.0)}
        self._total = dict(self._began)

    def start(self) -> None:
        """Begin a lap: what came before is nobody's time."""
        self._last = time.monotonic()

    def lap(self, phase: str, stencils: int = 0, samples: int = 0) -> float:
        """Book the seconds since the last lap, which are returned, and the work done in them, under `phase`."""
        now = time.monotonic()
        seconds, self._last = now - self._last, now
        self._total[phase] += seconds
        self._total["stencils"] += stencils
        self._total["samples"] += samples
        return seconds

    def report(self) -> dict[str, float | None]:
        """Rates since the last report, as `rates` gives them."""
        found = _rates({name: value - self._began[name] for name, value in self._total.items()})
        self._began = dict(self._total)
        return found

    def rates(self) -> dict[str, float | None]:
        """Rates since the start of the process.

        Returns
        -------
        ``samples_per_second`` over all the time; ``stencils_built_per_second`` over the seconds of building and
        ``samples_stepped_per_second`` over those of stepping, None where there was none; ``building_share``, the part of the time
        that went into building.
        """
        return _rates(self._total)


def pace_text(rates: dict[str, float | None]) -> str:
    """`rates` as part of a sentence."""
    text = f"{rates['samples_per_second']:,.0f} samples/s"
    if rates["samples_stepped_per_second"] is not None:
        text += f" (steps alone {rates['samples_stepped_per_second']:,.0f}/s"
        if rates["stencils_built_per_second"] is not None:
            text += (
                f", stencils built {rates['stencils_built_per_second']:,.0f}/s in {100 * (rates['building_share'] or 0):.0f} % of the time"
            )
        text += ")"
    return text


def _rates(spent: dict[str, float]) -> dict[str, float | None]:
    seconds = sum(spent[phase] for phase in PHASES)
    return {
        "samples_per_second": spent["samples"] / max(seconds, 1e-9),
        "stencils_built_per_second": spent["stencils"] / spent["building"] if spent["stencils"] else None,
        "samples_stepped_per_second": spent["samples"] / spent["stepping"] if spent["samples"] else None,
        "building_share": spent["building"] / max(seconds, 1e-9),
    }
