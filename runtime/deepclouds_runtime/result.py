"""What a render returns."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepclouds_runtime.transport import Counts

Image = NDArray[np.float32]
COLOURS = ("R", "G", "B")
LAYERS = ("volume_direct", "volume_indirect", "surface", "background")


@dataclass
class Statistics:
    """How an image came about.

    Attributes
    ----------
    mode
        ``"fast"``, ``"reference"``, or ``"path-traced"``.
    spp
        samples of the pixels that took most of them.
    mean_spp
        samples a pixel, on average.
    noise
        estimated noise of a pixel, root of the mean square over the mean, where the image is not dark; None where one round was asked for.
    sources
        name of a source of multiple scattering -> what it took: ``lights`` it stands for, ``nodes`` predicted, ``queries``, ``refined``
        cells level by level, and ``error`` of the interpolation at a point, measured.
    skipped
        reason -> queries that were not needed.
    complete
        whether the render came to its end: neither interrupted, nor a picture on the way.
    network
        where the network knows its errors: ``error`` to expect of the cloud's light, and ``doubtful``, the share of that light in pixels of
        low confidence.
    error
        both parts of the image's error, and how they are known: see `deepclouds_runtime.error_parts.error_parts`.
    audit
        where walks audited the network: ``walks``; ``network``, its error over regions of the image, root of the mean square over the mean,
        and its energy, each with an interval of 95 %; whether it was ``corrected``, on how many ``levels``, and what is ``remaining``.
    memory
        bytes: ``field``, of density, extinction and majorants; ``levels``, of the field filtered for the network; ``peak``, what the whole
        process had at most so far.
    """

    mode: str
    spp: int = 0
    mean_spp: float = 0.0
    noise: float | None = None
    complete: bool = True
    sources: dict[str, dict[str, Any]] = field(default_factory=dict)
    skipped: dict[str, int] = field(default_factory=dict)
    network: dict[str, float] = field(default_factory=dict)
    error: dict[str, Any] = field(default_factory=dict)
    audit: dict[str, Any] = field(default_factory=dict)
    memory: dict[str, int] = field(default_factory=dict)


@dataclass
class RenderResult:
    """An image with its parts.

    Attributes
    ----------
    rgb
        (h, w, 3) linear Rec. 709 radiance.
    alpha
        (h, w) share of each pixel that shows cloud, surface or a visible environment.
    channels
        name -> (h, w): ``R, G, B, A``; ``volume_direct.*``, ``volume_indirect.*``, ``surface.*`` and ``background.*``, whose sum is
        the image; ``volume_opacity``; ``volume_Z``, the mean distance from the camera of what hides, world units, 0 without cloud;
        ``confidence``, 1 less the network's error to expect as a share of the pixel, in the fast mode where the model knows its errors.
    seconds
        stage -> seconds; ``load`` is what was done once, ``total`` all the rest.
    counts
        camera samples, those that met the cloud, network queries made and skipped.
    statistics
        samples, nodes, and estimated errors.
    notes
        what was approximated, in sentences.
    """

    rgb: Image
    alpha: Image
    channels: dict[str, Image]
    seconds: dict[str, float]
    counts: Counts
    statistics: Statistics
    notes: tuple[str, ...] = ()
