"""How far the pixels of an image can be trusted, from the errors that the network's file says to expect.

The errors are known at the nodes where J is (`frame_source`). What the pilot rays saw of the cloud gives each of their pixels the error
over the multiple scattering, both summed along the ray; between them it is interpolated. Errors of one ray add up, as those of one network
at neighbouring places do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepclouds.backend import vectors_of
from deepclouds_runtime.frame_source import FrameSource, Seen

Image = NDArray[np.float32]
# A pixel is doubtful where its error is expected to be a larger share of it; so much of the cloud's light in such pixels is worth a word.
DOUBTFUL, WORTH_A_WORD = 0.25, 0.1


def relative_errors(
    sources: Sequence[FrameSource], seen: Seen, columns: NDArray[np.int64], rows: NDArray[np.int64], size: tuple[int, int]
) -> Image | None:
    """Error to expect of the multiple scattering in each pixel (h, w), as a share of it; None where the network knows none.

    Parameters
    ----------
    sources
        multiple scattering of this camera.
    seen
        what the pilot rays saw.
    columns, rows
        of the pixels that the rays are from: row by row all of them, once or more often.
    size
        (w, h) of the image.
    """
    if not sources or any(source.doubt is None for source in sources) or not len(seen.points):
        return None
    width, height = size
    light = np.zeros((2, len(rows), len(columns)))
    pixels = seen.rays % light[0].size
    for source in sources:
        octree: Any = source.doubt
        types = octree.types
        points = vectors_of(types, seen.points)
        for field, value in zip(light, octree.lookup(octree.to_local(points), types.Bool(True)), strict=True):
            of_pixel = np.bincount(pixels, seen.weights * np.array(value, np.float64), field.size)
            field += of_pixel.reshape(field.shape)
    # A ray has few collisions, and none where it happens to pass: each takes in those of its neighbours.
    predicted, error = _with_neighbours(light)
    share = np.where(predicted > 0, error / np.maximum(predicted, 1e-30), 0).astype(np.float32)
    return _between(_between(share, columns, width).T, rows, height).T


def _between(values: Image, places: NDArray[np.int64], count: int) -> Image:
    """Values (h, n) at n ascending whole `places` as values (h, count) at all places from 0 on, linear between them."""
    at = np.arange(count)
    after = np.clip(np.searchsorted(places, at), 1, max(len(places) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(places) - 1)
    width = np.maximum(places[after].astype(np.float32) - places[before], 1)
    share = np.clip((at - places[before]) / width, 0, 1).astype(np.float32)
    result: Image = values[:, before] * (1 - share) + values[:, after] * share
    return result


def _with_neighbours(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sums of images (k, h, w) over 3 x 3 pixels."""
    padded = np.pad(values, ((0, 0), (1, 1), (1, 1)))
    _, height, width = values.shape
    total: NDArray[np.float64] = np.sum([padded[:, y : y + height, x : x + width] for y in range(3) for x in range(3)], axis=0)
    return total


def confidence(share: Image, channels: Mapping[str, Image]) -> Image:
    """Confidence (h, w) in [0, 1]: 1 less the error to expect of a pixel, as a share of the pixel.

    Parameters
    ----------
    share
        what `relative_errors` says.
    channels
        of the image, see `RenderResult`. Of its light the multiple scattering alone is in doubt.
    """
    total, predicted = (sum(channels[prefix + colour] for colour in "RGB") for prefix in ("", "volume_indirect."))
    error = np.where(total > 0, share * predicted / np.where(total > 0, total, 1), 0)
    result: Image = (1 - np.clip(error, 0, 1)).astype(np.float32)
    return result


def doubtful(trusted: Image, channels: Mapping[str, Image]) -> dict[str, float]:
    """Figures of a whole image, shares of the cloud's light: ``error`` to expect, and ``doubtful``, what lies in doubtful pixels."""
    total = sum(channels[colour].astype(np.float64) for colour in "RGB")
    cloud = sum(channels[f"{layer}.{colour}"].astype(np.float64) for colour in "RGB" for layer in ("volume_direct", "volume_indirect"))
    light = max(float(np.sum(cloud)), 1e-30)
    error = float(np.sum((1 - trusted) * total)) / light
    return {"error": error, "doubtful": float(np.sum(cloud * (trusted < 1 - DOUBTFUL))) / light}


def warning(figures: Mapping[str, float]) -> str | None:
    """A sentence where much of the light is doubtful, or None."""
    if figures["doubtful"] <= WORTH_A_WORD:
        return None
    return (
        f"{100 * figures['doubtful']:.0f} % of the cloud's light lies in pixels where the network is expected to err by more than "
        f"{100 * DOUBTFUL:.0f} %: look at the channel 'confidence'"
    )
