"""A render as files: every channel and its settings in an EXR, a preview as PNG."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from os import PathLike
from typing import Any

import numpy as np

from deepclouds.errors import InputError
from deepclouds.exr import read_attributes, write_exr, write_png
from deepclouds_runtime.result import RenderResult

ATTRIBUTE = "deepclouds"
_MOST_STOPS = 60


def check_exposure(stops: float) -> None:
    """Refuse, by InputError, an exposure that turns every image black, white, or into NaN."""
    if not -_MOST_STOPS <= stops <= _MOST_STOPS:
        raise InputError(f"exposure = {stops:g}: give stops between -{_MOST_STOPS} and {_MOST_STOPS}")


def is_complete(path: str | PathLike[str]) -> bool:
    """Whether an image is there whole: false for one of ours that was written on the way or interrupted, and for what cannot be read.

    Images that others wrote count as whole.
    """
    try:
        stored = read_attributes(path).get(ATTRIBUTE)
    except InputError:
        return False
    return stored is None or bool(json.loads(str(stored)).get("statistics", {}).get("complete", True))


def save(
    result: RenderResult,
    path: str | PathLike[str],
    settings: Mapping[str, Any] | None = None,
    png: str | PathLike[str] | None = None,
    exposure: float = 0.0,
) -> None:
    """Write a render.

    Parameters
    ----------
    result
        what to write.
    path
        the .exr: float32, linear Rec. 709, all channels of `RenderResult.channels`.
    settings
        how it was made; stored as JSON in the header's attribute ``deepclouds``, with the model's hash on its own as ``modelHash``.
    png
        the preview, when wanted; `exposure` in stops.

    Raises
    ------
    InputError
        when a folder is missing, the image is not finite, or the exposure is out of range; nothing is written then.
    """
    if png is not None:
        check_exposure(exposure)
    record = {k: v for k, v in (settings or {}).items() if v is not None}
    attributes: dict[str, str | float | int] = {
        "software": "deepclouds",
        ATTRIBUTE: json.dumps(
            {
                **record,
                "seconds": {k: round(v, 4) for k, v in result.seconds.items()},
                "counts": asdict(result.counts),
                "statistics": asdict(result.statistics),
                "notes": list(result.notes),
            }
        ),
    }
    if "model_hash" in record:
        attributes["modelHash"] = str(record["model_hash"])
    write_exr(path, {name: np.asarray(values) for name, values in result.channels.items()}, attributes)
    if png is not None:
        write_png(png, result.rgb, exposure)
