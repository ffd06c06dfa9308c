"""The error of an image in its two parts: what more samples and nodes bring down, and the network's own, which they do not."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

# Error of the interpolation in the image over that at a point: along rays and between pixels it averages out.
AVERAGED = 0.2


def error_parts(
    noise: float | None,
    points: Iterable[tuple[float, float]],
    indirect: float,
    asked: bool,
    audit: Mapping[str, Any],
    expected: Mapping[str, float],
    metrics: Mapping[str, float],
) -> dict[str, Any]:
    """What is known of an image's error, for a report and the header; shares, root of the mean square over the mean.

    Parameters
    ----------
    noise
        of a pixel, as estimated; None where it was not.
    points
        error of the interpolation at a point, over the mean, and this mean, of each source of multiple scattering.
    indirect
        share of interpolated light in all light of the image.
    asked
        whether a network was asked.
    audit
        what walks found, `deepclouds_runtime.audit.Outcome.found`.
    expected
        what the network expects to err in this image, `deepclouds_runtime.confidence.doubtful`.
    metrics
        the validation of the network, from its metadata.

    Returns
    -------
    ``sampling``, the noise of a pixel, or None; ``interpolation`` in the image, or None where nothing is interpolated; ``both``, or None
    without noise; and ``network``: ``by`` tells how its ``error`` is known, with its ``interval`` of 95 % where there is one, and ``of``
    tells what it is a share of. ``by`` is "none" where no network was asked; "walks" of the audit; "expectation", from what it knows of its
    errors for such inputs; "validation", on held-out clouds and not on this one; or "unknown".
    """
    parts = [(float(error), float(level)) for error, level in points]
    total = sum(level for _, level in parts)
    at_points = math.hypot(*(error * level for error, level in parts)) / total if total > 0 else 0.0
    interpolation = AVERAGED * indirect * at_points if parts else None
    both = None if noise is None else math.hypot(noise, interpolation or 0.0)
    return {
        "sampling": noise,
        "interpolation": interpolation,
        "both": both,
        "network": _of_network(asked, audit, expected, metrics),
    }


def _of_network(asked: bool, audit: Mapping[str, Any], expected: Mapping[str, float], metrics: Mapping[str, float]) -> dict[str, Any]:
    if not asked:
        return {"by": "none"}
    if audit:
        found = audit["remaining"] if audit["corrected"] else audit["network"]
        of = "the multiple scattering of regions of the image"
        return {"by": "walks", "error": found["error"], "interval": list(found["error_interval"]), "of": of}
    if expected:
        return {"by": "expectation", "error": expected["error"], "of": "the cloud's light"}
    names = ("all.rrmse", "all.rrmse_low", "all.rrmse_high")
    if all(name in metrics for name in names):
        error, low, high = (float(metrics[name]) for name in names)
        return {
            "by": "validation",
            "error": error,
            "interval": [low, high],
            "of": "multiple scattering at single points of held-out clouds",
        }
    return {"by": "unknown"}


def in_words(parts: Mapping[str, Any]) -> tuple[str, str]:
    """Both parts, each in a few words."""
    noise, interpolation, network = parts["sampling"], parts["interpolation"], parts["network"]
    first = "noise unknown (one round of samples)" if noise is None else f"noise of a pixel {_percent(noise)}"
    if interpolation is not None:
        first += f", interpolation {_percent(interpolation)}"
        first += "" if noise is None else f", together {_percent(parts['both'])}"
    by = network["by"]
    if by == "none":
        return first, "none was asked"
    if by == "unknown":
        return first, "unknown: nothing has measured it here (--audit), and the model does not say"
    interval = f" ({_percent(network['interval'][0], '')} to {_percent(network['interval'][1])})" if "interval" in network else ""
    how = {"walks": "measured", "expectation": "expected, not measured here (--audit)", "validation": "unknown here (--audit measures it)"}
    return first, f"{_percent(network['error'])}{interval} of {network['of']}, {how[by]}"


def _percent(value: float, unit: str = " %") -> str:
    return f"{100 * value:.2g}{unit}"
