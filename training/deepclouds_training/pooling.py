"""The pooling of a stencil's levels, for networks that must be cheap, and the stencil's mirror image."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from deepclouds.descriptor import POINTS, offsets


def mirrored_points() -> NDArray[np.int64]:
    """Place of every point's mirror image across the plane of light and view, (225,); J is the same in both."""
    places = {tuple(p): i for i, p in enumerate(offsets().tolist())}
    return np.array([places[-x, y, z] for x, y, z in offsets().tolist()])


class Pooling(nn.Module):
    """One small matrix makes `channels` weighted means of the 225 points of every level.

    Its weights are squares, hence not negative, and the same for a point and its mirror image: what it gives is extinction, as its
    input is, and the network behind it is symmetric. All that is done for each of the stencil's 2,250 values is one product over memory
    that is read once; compression and layers see `channels` values a level. Begins as Gaussians around random places.

    Parameters
    ----------
    channels
        means a level.
    """

    mirror: Tensor

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.register_buffer("mirror", torch.from_numpy(mirrored_points()), persistent=False)
        places = torch.from_numpy(offsets()).float()
        low, high = places.min(dim=0).values, places.max(dim=0).values
        middle = low + (high - low) * torch.rand(channels, 1, 3)
        size = 0.6 * 4.0 ** torch.rand(channels, 1)
        weight = torch.exp(-0.5 * torch.square(places - middle).sum(dim=2) / torch.square(size))
        self.root = nn.Parameter(torch.sqrt(weight / weight.sum(dim=1, keepdim=True)))

    def weight(self) -> Tensor:
        """The matrix, (225, channels)."""
        weight = torch.square(self.root)
        return 0.5 * (weight + weight[:, self.mirror]).t()

    def forward(self, stencil: Tensor) -> Tensor:
        """(n, levels, channels) of (n, levels, 225)."""
        assert stencil.shape[2] == POINTS
        return torch.matmul(stencil, self.weight())
