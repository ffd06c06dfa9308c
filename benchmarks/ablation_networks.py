"""Networks that depart from the released architecture in one respect each, to measure what that respect is worth."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
import torch
from deepclouds_training.network import FEATURES, ROOT_FLOOR, STENCIL_LIMIT, Block, Network, NetworkConfig
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from deepclouds.descriptor import offsets
from deepclouds.model import LEVELS, POINTS

# Columns of the features by what they are made of.
PHASE_COLUMNS = (2, 3, 4, 5)
TAU_COLUMNS = (10, 11, 12)
SIMILARITY, LOG1P_TAU, LOG1P_REDUCED = 9, 10, 11


def mirrored_points() -> NDArray[np.int64]:
    """Place of every point's mirror image across the plane of light and view, (225,)."""
    places = {tuple(p): i for i, p in enumerate(offsets().tolist())}
    return np.array([places[-x, y, z] for x, y, z in offsets().tolist()])


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


class Mirrored(Network):
    """The first layer of every block sees the stencil and its mirror image and adds both: the output is symmetric by construction."""

    mirror: Tensor

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        self.register_buffer("mirror", torch.from_numpy(mirrored_points()), persistent=False)

    def through(self, level: Callable[[int], Tensor], f: Tensor, plain: bool) -> Tensor:
        """With even and odd parts e and o of the level this is relu(We e + Wo o) + relu(We e - Wo o)."""
        o: Tensor | None = None
        for k, block in zip(self.sequence, self.blocks, strict=True):
            assert isinstance(block, Block)
            own: tuple[Tensor, Tensor] = (block.stencil.weight, block.stencil.bias)
            weight, bias = own if plain else block.standardised(self.level_mean[k], self.level_scale[k])
            x = level(k)
            h = F.linear(f, block.features.weight, bias)
            if block.carried is not None and o is not None:
                h = torch.addmm(h, o, block.carried.weight.t())
            both = F.relu(torch.addmm(h, x, weight.t())) + F.relu(torch.addmm(h, x, weight[:, self.mirror].t()))
            h = block.out(0.5 * both)
            o = F.relu(h if o is None else h + o)
        assert o is not None
        return self.finish(o, f)


class Ratio(Network):
    """The head gives the ratio of j to an analytic estimate E made of the features, so the estimate's logarithm is added to its argument.

    ``octaves``: E = 0.02 + sum over i = 1, 2, 3 of 0.5^i exp(-0.5^i tau) 4 pi p_(2^i)(gamma), p_n the phase function after n scatterings:
    the octaves of Wrenninge et al. 2013, "Oz: The Great and Volumetric" (a = b = 0.5, first octave left out because j counts multiple
    scattering alone), with exact convolutions in the place of their scaled g.
    ``diffusion``: E = exp(-min(8, sqrt(3) s t)) / (1 + 0.75 t), t = tau (1 - g), s = sqrt((1 - albedo) / (1 - albedo g)): the
    transmission of a slab in the Eddington approximation without absorption, times diffusion's exponential decay (van de Hulst 1980,
    section 14.1).
    """

    def __init__(self, config: NetworkConfig, estimate: Literal["octaves", "diffusion"]) -> None:
        super().__init__(config)
        self.estimate = estimate

    def log_estimate(self, f: Tensor) -> Tensor:
        """Logarithm of E, (n, 1), from the features (n, `FEATURES`)."""
        columns = torch.split(f, 1, dim=1)
        tau = torch.exp(4.0 * columns[LOG1P_TAU]) - 1.0
        if self.estimate == "octaves":
            terms = [0.5**i * torch.exp(4.0 * columns[PHASE_COLUMNS[i]] - 0.5**i * tau) for i in (1, 2, 3)]
            return torch.log(terms[0] + terms[1] + terms[2] + 0.02)
        reduced = torch.exp(4.0 * columns[LOG1P_REDUCED]) - 1.0
        # Beyond some ten diffusion lengths the estimate would leave the range of the head.
        decay = torch.clamp(3**0.5 * columns[SIMILARITY] * reduced, max=8.0)
        return -decay - torch.log(1.0 + 0.75 * reduced)

    def through(self, level: Callable[[int], Tensor], f: Tensor, plain: bool) -> Tensor:
        """As the network's own, with the estimate's logarithm as one more column."""
        return torch.cat([super().through(level, f, plain), self.log_estimate(f)], dim=1)

    def leave(self, hidden: Tensor) -> Tensor:
        """The exponential of the head's value and the estimate's logarithm together."""
        return super()._exponential(self.head(hidden[:, :-1]) + hidden[:, -1:])


class Pooled(Network):
    """A cheap network: one small matrix pools the 225 points of every level before the compression, and few layers read what is left.

    A pooled value is a weighted mean of extinctions with weights that are not negative and the same for a point and its mirror image:
    an optical depth like the stencil's own values, from a product over memory that is read once. Ten levels of `channels` values
    are then a single vector.

    Parameters
    ----------
    config
        width of the layers after the pooling.
    channels
        pooled values a level.
    blocks
        read the pooled levels in blocks from coarse to fine instead of all at once.
    """

    mirror: Tensor

    def __init__(self, config: NetworkConfig, channels: int, blocks: bool) -> None:
        super().__init__(config)
        width = config.width
        self.channels = channels
        self.register_buffer("mirror", torch.from_numpy(mirrored_points()), persistent=False)
        self.pool = nn.Parameter(_bumps(channels))
        if blocks:
            self.levels_in = nn.ModuleList(nn.Linear(channels + FEATURES + width, width) for _ in range(LEVELS))
            self.levels_out = nn.ModuleList(nn.Linear(width, width) for _ in range(LEVELS))
        else:
            self.entry = nn.Linear(LEVELS * channels + FEATURES, width)
            self.inner = nn.Linear(width + FEATURES, width)
            self.outer = nn.Linear(width, width)
        self.by_blocks = blocks
        self.blocks = nn.ModuleList()
        del self.fc_2
        for module in self.modules():
            if isinstance(module, nn.Linear) and module is not self.head:
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
                nn.init.zeros_(module.bias)
        with torch.no_grad():
            for branch in self.levels_out if blocks else [self.outer]:
                assert isinstance(branch, nn.Linear)
                branch.weight.mul_(LEVELS**-0.5)

    def pooling(self) -> Tensor:
        """The pooling matrix (225, channels): squares, so that it is not negative, and symmetric."""
        weight = torch.square(self.pool)
        return 0.5 * (weight + weight[:, self.mirror]).t()

    def pooled(self, stencil: Tensor) -> Tensor:
        """(n, 10, channels), standardised, of a stencil (n, 10, 225)."""
        value = torch.matmul(stencil, self.pooling()).float()
        floor = torch.tensor([[self._floor(k)] for k in range(LEVELS)])
        root = torch.sqrt(torch.sqrt(torch.clamp(value, 0.0, STENCIL_LIMIT) + ROOT_FLOOR * floor))
        return (root - self.level_mean.unsqueeze(1)) * self.level_scale.unsqueeze(1)

    @torch.no_grad()
    def fit_inputs(self, stencil: NDArray[np.float32], label: NDArray[np.float32]) -> None:
        """As the network's own, of the pooled values."""
        self.level_mean.zero_()
        self.level_scale.fill_(1.0)
        value = self.pooled(torch.from_numpy(stencil))
        self.level_mean.copy_(value.mean(dim=(0, 2)))
        self.level_scale.copy_(1.0 / value.std(dim=(0, 2)).clamp(min=1e-3))
        self.head.bias.fill_(float(np.log(label.mean(dtype=np.float64))))

    def hidden(self, stencil: Tensor, aux: Tensor) -> Tensor:
        """All layers but the last."""
        return self.read(stencil, self.angle(aux))

    def read(self, stencil: Tensor, f: Tensor) -> Tensor:
        """The same with the features `f` in the place of aux."""
        z = self.pooled(stencil)
        if self.by_blocks:
            o = torch.zeros_like(f[:, :1]).expand(-1, self.config.width)
            for k, entry, out in zip(self.sequence, self.levels_in, self.levels_out, strict=True):
                o = F.relu(o + out(F.relu(entry(torch.cat([z[:, k], f, o], dim=1)))))
        else:
            o = F.relu(self.entry(torch.cat([z.flatten(1), f], dim=1)))
            o = F.relu(o + self.outer(F.relu(self.inner(torch.cat([o, f], dim=1)))))
        h: Tensor = F.relu(self.fc_1(torch.cat([o, f], dim=1)))
        return h

    def folded(self) -> Network:
        """There is nothing to fold: the pooled values are few."""
        return self


def _bumps(channels: int) -> Tensor:
    """Square roots of Gaussian weights of sum 1 around random places of the stencil, (channels, 225); random, from torch's own stream."""
    places = torch.from_numpy(offsets()).float()
    low, high = places.min(dim=0).values, places.max(dim=0).values
    middle = low + (high - low) * torch.rand(channels, 1, 3)
    size = 0.6 * 4.0 ** torch.rand(channels, 1)
    weight = torch.exp(-0.5 * torch.square(places - middle).sum(dim=2) / torch.square(size))
    assert weight.shape[1] == POINTS
    return torch.sqrt(weight / weight.sum(dim=1, keepdim=True))
