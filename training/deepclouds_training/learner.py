"""One network in training: its weights, their running mean, Adam, and what a checkpoint keeps of them."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from deepclouds_training.average import WeightAverage
from deepclouds_training.network import Network, NetworkConfig


class Learner:
    """A network, its averaged weights and its optimiser, which are stepped, saved and restored together.

    Parameters
    ----------
    config
        the network's shape; its weights are drawn from torch's global generator.
    decay
        of the weights' running mean.
    half
        compute the hidden layers' products in bfloat16; weights, last layer and averages are float32 either way.
    device
        where the weights live.
    """

    def __init__(self, config: NetworkConfig, decay: float, half: bool, device: torch.device) -> None:
        self.network = Network(config).to(device)
        self.average = WeightAverage(self.network, decay)
        # Every step sets the rate by its schedule.
        self.optimiser = torch.optim.Adam(self.network.parameters(), fused=True)
        self._half = half
        self._device = device

    def predict(self, stencil: Tensor, aux: Tensor) -> Tensor:
        """Predict j (n,) by the present weights, in the arithmetic of training; with a gradient where torch records one."""
        with torch.autocast(self._device.type, torch.bfloat16, enabled=self._half):
            hidden = self.network.hidden(stencil, aux)
        return self.network.leave(hidden.float())

    def backward(self, loss: Tensor) -> None:
        """Gradients of a scalar, in place of those there were."""
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]

    def update(self, rate: float) -> None:
        """One step of Adam along the gradients, and the averages after it."""
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        self.optimiser.step()
        self.average.update()

    def averaged(self) -> Network:
        """A copy of the network with the averaged weights."""
        return self.average.averaged(self.network)

    def state_dict(self) -> dict[str, Any]:
        """What `load_state_dict` restores."""
        return {"network": self.network.state_dict(), "average": self.average.state_dict(), "optimiser": self.optimiser.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore `state_dict`."""
        self.network.load_state_dict(state["network"])
        self.average.load_state_dict(state["average"])
        self.optimiser.load_state_dict(state["optimiser"])

    def start_from_average(self, state: dict[str, Any], decay: float) -> None:
        """Take the averaged weights of another learner's `state`, whose running mean had `decay`, and nothing else."""
        self.network.load_state_dict(averaged_network(self.network.config, state, decay).state_dict())


def averaged_network(config: NetworkConfig, state: dict[str, Any], decay: float) -> Network:
    """The averaged weights in the `state` of a learner, on the processor."""
    network = Network(config)
    network.load_state_dict(state["network"])
    average = WeightAverage(network, decay)
    average.load_state_dict(state["average"])
    return average.averaged(network)
