"""What the benchmark makes of its images: the rows of its table, times at equal error, and their medians."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.equal_error import Bounded, Timing, interpolated_seconds, unbiased_seconds
from benchmarks.worker import DEFAULT_SPP, OURS, TIMED
from deepclouds.metrics import ErrorReport
from deepclouds.replacing import replacing

_LABELS = {
    "unbiased": "deepclouds, unbiased",
    "octaves": "octaves",
    "volpath": "volpath",
    "oidn": "volpath + OIDN",
    "single": "single scattering",
}
# What the modes of deepclouds add to the model's name.
# The fast mode, what `deepclouds render` does by itself first.
FAST = ("corrected", "deepclouds")
_MODES = {"deepclouds": "", "corrected": ", corrected", "reference": ", every sample asks", TIMED: ", limited in time"}


@dataclass(frozen=True)
class Row:
    """One image of one method, with one model where it asks any: what it cost and how wrong it is."""

    method: str
    scene: str
    spp: int
    seconds_warm: float
    seconds_cold: float | None
    report: ErrorReport
    model: str = ""

    @property
    def spp_text(self) -> str:
        """The spp, or the word for a renderer's own choice."""
        return "default" if self.spp == DEFAULT_SPP else str(self.spp)

    @property
    def label(self) -> str:
        """The method in words."""
        return label(self.method, self.model)

    @property
    def error(self) -> float:
        """What methods are compared at: the error of a pixel, or, of an image without a second seed, its rRMSE."""
        return self.report.rrmse if self.report.pixel_error is None else self.report.pixel_error

    @property
    def interval(self) -> tuple[float, float]:
        """Interval of `error`."""
        return self.report.pixel_error_interval or self.report.rrmse_interval


def label(method: str, model: str = "") -> str:
    """A method and its model in words."""
    if method in OURS:
        return f"deepclouds {model}".rstrip() + _MODES[method]
    return _LABELS[method]


def models(rows: Sequence[Row], scene: str | None = None) -> list[str]:
    """Models that deepclouds was run with in its fast mode, in a scene or in any, the first one first."""
    return list(dict.fromkeys(r.model for r in rows if r.method in FAST and scene in (None, r.scene)))


def compared(rows: Sequence[Row], scene: str, model: str | None = None, method: str | None = None) -> Row | None:
    """The row of deepclouds that is held against its peers: that with its own choice of samples, else the one with most.

    Parameters
    ----------
    model
        which one; by default the scene's first. None is returned where it was not run.
    method
        corrected or not; by default corrected, as `deepclouds render` does it, where that was run.
    """
    if method is None:
        return next(filter(None, (compared(rows, scene, model, each) for each in FAST)), None)
    candidates = [r for r in rows if (r.scene, r.method) == (scene, method)]
    if model is None and candidates:
        model = candidates[0].model
    candidates = [r for r in candidates if r.model == model]
    if not candidates:
        return None
    return next((r for r in candidates if r.spp == DEFAULT_SPP), max(candidates, key=lambda r: r.spp))


def equal_error(rows: Sequence[Row], ours: Row, error: float | None = None) -> dict[str, Bounded]:
    """Seconds that each peer needs on the scene of `ours` to reach an error (default: that of `ours`)."""
    target = ours.error if error is None else error
    peers: dict[str, Bounded] = {}
    for method, seconds in (("volpath", unbiased_seconds), ("oidn", interpolated_seconds)):
        timings = [Timing(r.seconds_warm, r.error) for r in rows if (r.method, r.scene) == (method, ours.scene)]
        if timings and target > 0 and all(t.error > 0 for t in timings):
            peers[method] = seconds(timings, target)
    return peers


def speed_ups(rows: Sequence[Row]) -> list[str]:
    """One line a scene, model and mode: deepclouds' time and error, what its peers need to the same error, and the ratios.

    The range in brackets is the ratio at both ends of the interval of deepclouds' error.
    """
    lines = []
    for scene in dict.fromkeys(r.scene for r in rows):
        found = [compared(rows, scene, model, method) for model in models(rows, scene) for method in reversed(FAST)]
        if not any(found):
            lines.append(f"{scene}: no speed-up, deepclouds was not run")
        for ours in found:
            if ours is None:
                continue
            parts = []
            for method, needed in equal_error(rows, ours).items():
                low, high = (equal_error(rows, ours, e).get(method) for e in reversed(ours.interval))
                ends = None if low is None or high is None else (low.over(ours.seconds_warm), high.over(ours.seconds_warm))
                spread = f" [{ends[0]}, {ends[1]}]" if ends is not None else ""
                parts.append(f"{needed.over(ours.seconds_warm)} x{spread} against {label(method)} ({needed} s)")
            reached = f"{scene}: {ours.label} reaches {100 * ours.error:.2f} % in {ours.seconds_warm:.3g} s"
            lines.append(f"{reached}; at equal error {'; '.join(parts)}" if parts else f"{reached}; no peer to compare with")
    return lines


def medians(rows: Sequence[Row], kinds: Mapping[str, str], model: str | None = None) -> str:
    """Medians over scenes of the speed-up at equal error, under suns alone and under an environment; corrected, where that was run.

    Parameters
    ----------
    kinds
        scene -> what lights it, "sun" or "environment".
    model
        with which deepclouds rendered; by default in each scene the first, and for another the line begins with its name.
    """

    def median(kind: str, method: str) -> str:
        ratios = []
        for scene in (s for s in dict.fromkeys(r.scene for r in rows) if kinds[s] == kind):
            ours = compared(rows, scene, model)
            needed = None if ours is None else equal_error(rows, ours).get(method)
            if ours is not None and needed is not None:
                ratios.append(needed.over(ours.seconds_warm))
        if not ratios:
            return "unknown"
        ratios.sort(key=lambda r: r.value)
        low, high = ratios[(len(ratios) - 1) // 2], ratios[len(ratios) // 2]
        bounds = {b for b in (low.bound, high.bound) if b}
        return str(Bounded(0.5 * (low.value + high.value), bounds.pop() if len(bounds) == 1 else ""))

    sun = f"sun {median('sun', 'volpath')} x volpath, {median('sun', 'oidn')} x volpath+OIDN"
    line = f"speed: {sun}; environment {median('environment', 'volpath')} x volpath"
    return line if model is None else f"{model}, {line}"


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write one line an image; fractions, not per cent; an empty field is a figure that was not measured."""
    path.parent.mkdir(parents=True, exist_ok=True)
    names = ["method", "model", "scene", "spp", "seconds_warm", "seconds_cold", "rrmse", "rrmse_low", "rrmse_high"]
    names += ["pixel_error", "pixel_error_low", "pixel_error_high"]
    names += ["energy", "energy_low", "energy_high", "dark_energy", "worst_tile", "flip"]

    with replacing(path, ".csv") as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(names)
        for row in rows:
            r = row.report
            cold = "" if row.seconds_cold is None else f"{row.seconds_cold:.6g}"
            figures = [r.rrmse, *r.rrmse_interval, row.error, *row.interval, r.energy, *r.energy_interval, r.dark_energy, r.worst_tile]
            texts = [f"{x:.6g}" for x in figures] + ["" if r.flip is None else f"{r.flip:.6g}"]
            writer.writerow([row.method, row.model, row.scene, row.spp_text, f"{row.seconds_warm:.6g}", cold, *texts])


def markdown(rows: Sequence[Row]) -> str:
    """Lay the rows out as a table, in per cent, with the time that the peers need to the error of each deepclouds row."""
    lines = [
        "| scene | method | spp | warm s | cold s | rRMSE % | a pixel % | energy % | worst tile % | FLIP | volpath to it | OIDN to it |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        r = row.report
        interval = f"{100 * r.rrmse:.2f} [{100 * r.rrmse_interval[0]:.2f}, {100 * r.rrmse_interval[1]:.2f}]"
        energy = f"{100 * r.energy:+.2f} [{100 * r.energy_interval[0]:+.2f}, {100 * r.energy_interval[1]:+.2f}]"
        peers = equal_error(rows, row) if row.method in (*OURS, "unbiased") else {}
        needed = [f"{peers[m]} s ({peers[m].over(row.seconds_warm)} x)" if m in peers else "" for m in ("volpath", "oidn")]
        cold = "" if row.seconds_cold is None else f"{row.seconds_cold:.3g}"
        flip = "" if r.flip is None else f"{r.flip:.4f}"
        cells = [row.scene, row.label, row.spp_text, f"{row.seconds_warm:.3g}", cold]
        cells += [interval, f"{100 * row.error:.2f}", energy, f"{100 * r.worst_tile:+.1f}", flip]
        lines.append("| " + " | ".join([*cells, *needed]) + " |")
    return "\n".join(lines)
