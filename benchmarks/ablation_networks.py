"""Networks that depart from the released architecture in one respect each, to measure what that respect is worth."""

from __future__ import annotations

from collections.abc import Callable

import torch
from deepclouds_training.features import FEATURES
from deepclouds_training.network import HIGHEST, LOWEST, Block, Network, NetworkConfig
from torch import Tensor, nn
from torch.nn import functional as F

from deepclouds.model import LEVELS

# Columns of the features by what they are made of.
PHASE_COLUMNS = (2, 3, 4, 5)
TAU_COLUMNS = (10, 11, 12)
SIMILARITY, LOG1P_REDUCED = 9, 11


class Blind(Network):
    """The network without some columns of the features."""

    mask: Tensor

    def __init__(self, config: NetworkConfig, columns: tuple[int, ...]) -> None:
        super().__init__(config)
        self.register_buffer("mask", torch.tensor([float(i not in columns) for i in range(FEATURES)]), persistent=False)

    def through(self, level: Callable[[int], Tensor], f: Tensor, plain: bool) -> Tensor:
        """As the network's own, with zeros in the columns."""
        return super().through(level, f * self.mask, plain)


class Shared(Network):
    """One block for all levels, which a bias of each level tells apart.

    After Rittig et al. 2021, "Neural Acceleration of Scattering-Aware Color 3D Printing" (section 4), whose one block reads all levels.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        # A block that is not the first has weights for what is carried; the coarsest level finds zeros there.
        self.blocks = nn.ModuleList([self.blocks[1]])
        self.level_code = nn.Parameter(0.1 * torch.randn(LEVELS, config.width))

    def through(self, level: Callable[[int], Tensor], f: Tensor, plain: bool) -> Tensor:
        """As the network's own; the standardisation is a scale after the product, so that the weights stay one matrix."""
        (block,) = self.blocks
        assert isinstance(block, Block)
        assert block.carried is not None
        o: Tensor | None = None
        given = F.linear(f, block.features.weight, block.stencil.bias)
        for k in self.sequence:
            x = F.linear(level(k), block.stencil.weight)
            if not plain:
                x = (x - self.level_mean[k] * block.stencil.weight.sum(dim=1)) * self.level_scale[k]
            h = x + given + self.level_code[k]
            h = F.relu(h if o is None else h + F.linear(o, block.carried.weight))
            h = block.out(h)
            o = F.relu(h if o is None else h + o)
        assert o is not None
        return self.finish(o, f)

    def folded(self) -> Network:
        """The standardisation stays outside of the one matrix."""
        return self


class DiffusionRatio(Network):
    """The head gives the ratio of j to a diffusion estimate, as the network's own ``octaves`` does to another.

    E = exp(-min(8, sqrt(3) s t)) / (1 + 0.75 t), t = tau (1 - g), s = sqrt((1 - albedo) / (1 - albedo g)): the transmission of a slab
    in the Eddington approximation without absorption, times diffusion's exponential decay (van de Hulst 1980, section 14.1), which
    would leave the range of the head beyond some ten diffusion lengths.
    """

    def finish(self, o: Tensor, f: Tensor) -> Tensor:
        """As the network's own, with the estimate's logarithm as one more column."""
        columns = torch.split(f, 1, dim=1)
        reduced = torch.exp(4.0 * columns[LOG1P_REDUCED]) - 1.0
        decay = torch.clamp(3**0.5 * columns[SIMILARITY] * reduced, max=8.0)
        return torch.cat([super().finish(o, f), -decay - torch.log(1.0 + 0.75 * reduced)], dim=1)

    def leave(self, hidden: Tensor) -> Tensor:
        """The exponential of the head's value and the estimate's logarithm together."""
        return torch.exp(torch.clamp((self.head(hidden[:, :-1]) + hidden[:, -1:]).squeeze(1), LOWEST, HIGHEST))


class PooledAtOnce(Network):
    """Pooled levels, all read at once by a few layers in the place of blocks from coarse to fine."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        width = config.width
        self.blocks = nn.ModuleList()
        self.entry = nn.Linear(len(config.levels) * config.channels + FEATURES, width)
        self.inner = nn.Linear(width + FEATURES, width)
        self.outer = nn.Linear(width, width)
        del self.fc_2
        for layer in (self.entry, self.inner, self.outer):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
            nn.init.zeros_(layer.bias)

    def folded(self) -> Network:
        """There are no blocks whose weights could take up the standardisation."""
        return self

    def through(self, level: Callable[[int], Tensor], f: Tensor, plain: bool) -> Tensor:
        """A layer, a residual layer and another layer."""
        o = F.relu(self.entry(torch.cat([*(level(k) for k in self.sequence), f], dim=1)))
        o = F.relu(o + self.outer(F.relu(self.inner(torch.cat([o, f], dim=1)))))
        return F.relu(self.fc_1(torch.cat([o, f], dim=1)))
