"""Block: a homogeneous or vertically graded medium that fills its box, from a cube to a layer eighty times as wide as it is thick."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deepclouds_training.clouds._noise import Array
from deepclouds_training.clouds._parameters import CloudParameters, Streams, number
from deepclouds_training.clouds._raster import Field, Grid


@dataclass(frozen=True, kw_only=True)
class BlockParameters(CloudParameters):
    """Parameters of a block."""

    thickness: float = number(0.0125, 1.0, "height over the longest side", log=True)
    depth: float = number(0.4, 1.0, "second horizontal side over the longest one", usual=1.0, usual_share=0.5)
    lightest: float = number(
        0.1, 1.0, "density of the lighter one of the upper and the lower face over the other", usual=1.0, usual_share=0.7
    )


def build(parameters: BlockParameters, streams: Streams) -> Field:
    """Density of a block over space; it is 1 wide and linear in height."""
    half = np.array([1.0, parameters.thickness, parameters.depth]) / 2
    up = bool(streams("face").random() < 0.5)

    def evaluate(grid: Grid) -> Array:
        share = np.clip(grid.y / np.float32(2 * half[1]) + np.float32(0.5), 0, 1)
        profile = np.float32(parameters.lightest) + np.float32(1 - parameters.lightest) * (share if up else 1 - share)
        return np.broadcast_to(profile[None, :, None], grid.shape).astype(np.float32)

    return Field(tuple(-half), tuple(half), evaluate, cut=(True, True, True))
