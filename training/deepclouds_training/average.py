"""The running mean of the weights that is validated and released."""

from __future__ import annotations

import copy

import torch
from torch import Tensor

from deepclouds_training.network import Network


class WeightAverage:
    """Exponential moving average of a network's parameters, corrected for its start at zero (as Adam's moments are).

    Noisy labels make the energy wander by several percent from step to step; the average follows the mean of that walk.
    """

    def __init__(self, network: Network, decay: float) -> None:
        self.decay = decay
        self.updates = 0
        self._parameters: list[Tensor] = list(network.parameters())
        self._sums = [torch.zeros_like(p) for p in self._parameters]

    @torch.no_grad()
    def update(self) -> None:
        """Take in the network's present weights."""
        torch._foreach_lerp_(self._sums, self._parameters, 1.0 - self.decay)
        self.updates += 1

    @torch.no_grad()
    def averaged(self, network: Network) -> Network:
        """A copy of `network` with the averaged weights; before the first update, its own."""
        result = copy.deepcopy(network)
        if self.updates:
            correction = 1.0 - self.decay**self.updates
            for target, total in zip(result.parameters(), self._sums, strict=True):
                target.copy_(total / correction)
        return result

    def state_dict(self) -> dict[str, int | list[Tensor]]:
        """What `load_state_dict` restores."""
        return {"updates": self.updates, "sums": self._sums}

    def load_state_dict(self, state: dict[str, int | list[Tensor]]) -> None:
        """Restore `state_dict`."""
        updates, sums = state["updates"], state["sums"]
        assert isinstance(updates, int)
        assert isinstance(sums, list)
        self.updates = updates
        self._sums = [s.to(p.device, copy=True) for s, p in zip(sums, self._parameters, strict=True)]
