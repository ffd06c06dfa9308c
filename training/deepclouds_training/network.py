"""The radiance-predicting network: one residual block a level of the stencil, from the coarsest to the finest.

After Kallweit et al. 2017, "Deep Scattering" (ACM TOG 36(6), section 4). Departures: the coarse scales come first, the angle enters as
features that resolve the phase peak, the phase function and the albedo are inputs, and the head is an exponential.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator
from torch import Tensor, nn
from torch.nn import functional as F

from deepclouds.model import LEVELS, POINTS
from deepclouds_training.features import FEATURES, AngleFeatures, log_octaves
from deepclouds_training.pooling import Pooling, mirrored_points

LOWEST, HIGHEST = -14.0, 6.0
STENCIL_LIMIT = 1e4
ROOT_FLOOR = 0.05
SMALLEST_DEVIATION = 0.05


class NetworkConfig(BaseModel):
    """Shape of the network.

    Attributes
    ----------
    width
        hidden units of every layer.
    order
        which end of the scales the blocks start from.
    scale
        what is compressed: ``depth``, the optical depth across one spacing of the level (stencil times 2^level), or ``density``, the
        stencil value itself.
    compression
        ``log``, log(1 + v), or ``root``, the fourth root of v + 0.05, which onnxruntime evaluates several times faster.
    levels
        the levels that are read, ascending from 0, the finest.
    head
        what the exponential of the last layer is: ``absolute``, j itself, or ``octaves``, the ratio of j to `log_octaves`.
    symmetric
        the first layer of every block sees the level and its mirror image across the plane of light and view, and adds both.
    channels
        means to which a level is pooled before it is compressed, see `Pooling`; 0 reads all points.
    together
        pooled levels that one block reads.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    width: int = Field(default=128, ge=8, le=1024)
    order: Literal["coarse_first", "fine_first"] = "coarse_first"
    scale: Literal["depth", "density"] = "depth"
    compression: Literal["log", "root"] = "log"
    levels: tuple[int, ...] = tuple(range(LEVELS))
    head: Literal["absolute", "octaves"] = "absolute"
    symmetric: bool = False
    channels: int = Field(default=0, ge=0, le=225)
    together: int = Field(default=1, ge=1, le=LEVELS)

    @field_validator("levels")
    @classmethod
    def _ascending(cls, levels: tuple[int, ...]) -> tuple[int, ...]:
        if not levels or list(levels) != sorted(set(levels) & set(range(LEVELS))):
            raise ValueError(f"levels are different, ascending numbers from 0 to {LEVELS - 1}, at least one of them")
        return levels

    @model_validator(mode="after")
    def _pooled(self) -> NetworkConfig:
        if self.symmetric and self.channels:
            raise ValueError("symmetric: pooled levels are symmetric already; leave it out, or channels")
        if self.together > 1 and not self.channels:
            raise ValueError(f"together = {self.together}: for pooled levels alone; give channels, or leave it out")
        if len(self.levels) % self.together:
            raise ValueError(f"together = {self.together}: has to divide the number of levels, {len(self.levels)}")
        return self


class Block(nn.Module):
    """``h = ReLU(V x + P f + W o + b)``, ``o' = ReLU(U h + c + o)``; the first block has no `o` to read.

    Where it is `symmetric`, h is the mean of that and of the same of the mirror image of `x`: with even and odd parts e and o of x it
    is ReLU(Ve e + Vo o + ...) + ReLU(Ve e - Vo o + ...), which has all symmetric functions within reach.
    """

    mirror: Tensor

    def __init__(self, width: int, first: bool, points: int = POINTS, symmetric: bool = False) -> None:
        super().__init__()
        self.stencil = nn.Linear(points, width)
        self.symmetric = symmetric
        if symmetric:
            self.register_buffer("mirror", torch.from_numpy(mirrored_points()), persistent=False)
        self.features = nn.Linear(FEATURES, width, bias=False)
        self.carried = None if first else nn.Linear(width, width, bias=False)
        self.out = nn.Linear(width, width)

    def standardised(self, mean: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
        """Weight and bias that take raw values as V and b take ``(x - mean) * scale``; cheaper than standardising every row.

        `mean` and `scale` are one number each, or one for every value.
        """
        weight = self.stencil.weight * scale
        return weight, self.stencil.bias - (weight * mean).sum(dim=1)

    def forward(self, x: Tensor, weight: Tensor, bias: Tensor, f: Tensor, o: Tensor | None) -> Tensor:
        """One level `x` (n, 225) through the `standardised` weights, the features `f`, the output `o` of the block before."""
        # Products accumulate into one buffer: each addmm becomes one Gemm with its addend in the exported graph.
        h = F.linear(f, self.features.weight, bias)
        if self.symmetric:
            h = h if self.carried is None or o is None else torch.addmm(h, o, self.carried.weight.t())
            mirrored = F.relu(torch.addmm(h, x, weight[:, self.mirror].t()))
            h = 0.5 * (F.relu(torch.addmm(h, x, weight.t())) + mirrored)
        else:
            h = torch.addmm(h, x, weight.t())
            h = F.relu(h if self.carried is None or o is None else torch.addmm(h, o, self.carried.weight.t()))
        if o is None:
            return F.relu(self.out(h))
        return F.relu(torch.addmm(o + self.out.bias, h, self.out.weight.t()))


class Network(nn.Module):
    """j = 4 pi J / (albedo^2 E) from a stencil and an ``aux`` row: the contract of `deepclouds.model`.

    The output is finite and positive for every finite input, because inputs are clamped to what is physical and the head is the
    exponential of a clamped value. Products such as a phase peak times a depth are sums before the exponential.

    Parameters
    ----------
    config
        width, order of the levels, and what enters the logarithm.
    """

    level_mean: Tensor
    level_scale: Tensor

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.angle = AngleFeatures()
        points = config.channels * config.together or POINTS
        count = len(config.levels) // config.together
        self.blocks = nn.ModuleList(Block(config.width, i == 0, points, config.symmetric) for i in range(count))
        self.pooling = Pooling(config.channels) if config.channels else None
        self.fc_1 = nn.Linear(config.width + FEATURES, config.width)
        self.fc_2 = nn.Linear(config.width + FEATURES, config.width)
        self.head = nn.Linear(config.width, 1)
        self.register_buffer("level_mean", torch.zeros(LEVELS))
        self.register_buffer("level_scale", torch.ones(LEVELS))
        # Levels in the order in which the blocks read them; of several that one block reads, the first.
        self.sequence = list(config.levels[:: config.together])[:: -1 if config.order == "coarse_first" else 1]
        self.is_folded = False
        self._initialise()

    def _initialise(self) -> None:
        """He's initialisation, with small residual branches so that ten blocks keep the variance of one, and a head near zero."""
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
                if module.bias is not None:
                    nn.init.zeros_(module.bias)
        with torch.no_grad():
            for block in self.blocks:
                assert isinstance(block, Block)
                block.out.weight.mul_(LEVELS**-0.5)
                # Three sources add up to one input.
                for source in (block.stencil, block.features, block.carried):
                    if source is not None:
                        source.weight.mul_(3**-0.5)
            self.head.weight.mul_(0.1)

    def fit_inputs(self, stencil: NDArray[np.float32], label: NDArray[np.float32]) -> None:
        """Standardise each level to mean 0 and deviation 1 over `stencil` (n, 10, 225), and start the head at the mean label (n,)."""
        with torch.no_grad():
            for k in range(LEVELS):
                level = torch.from_numpy(stencil[:, k])
                x = self.compressed(level if self.pooling is None else level @ self.pooling.weight(), k)
                self.level_mean[k] = x.mean()
                # Where the training data hardly vary, dividing by their deviation would blow up whatever lies outside of them.
                least = SMALLEST_DEVIATION * (self._floor(k) ** 0.25 if self.config.compression == "root" else 1.0)
                self.level_scale[k] = 1.0 / x.std().clamp(min=least)
            self.head.bias.fill_(math.log(max(float(label.mean(dtype=np.float64)), 1e-3)))

    @torch.no_grad()
    def folded(self) -> Network:
        """The same function with the standardisation inside the weights, for export; not for training."""
        result = copy.deepcopy(self)
        for k, block in zip(self.sequence, result.blocks, strict=True):
            assert isinstance(block, Block)
            # A block of pooled levels reads `together` of them, one after the other.
            first = self.config.levels.index(k)
            read = list(self.config.levels[first : first + self.config.together])
            each = block.stencil.in_features // len(read)
            mean, scale = (values[read].repeat_interleave(each) for values in (self.level_mean, self.level_scale))
            # Empty space becomes 0: large products that cancel would cost digits in the thinnest places.
            mean = mean - torch.tensor([self._empty(i) for i in read]).repeat_interleave(each)
            weight, bias = block.standardised(mean, scale)
            block.stencil.weight.copy_(weight)
            block.stencil.bias.copy_(bias)
        result.is_folded = True
        return result

    def compressed(self, level: Tensor, k: int) -> Tensor:
        """What a block reads of level `k` (n, 225), before the standardisation.

        With v = c * value, log(1 + v) is log(value + 1 / c) and the fourth root that of value + 0.05 / c, up to constants that the
        standardisation takes up: one pass less over the largest array there is.
        """
        values = self._compressed(level, self._floor(k))
        return values - self._empty(k) if self.is_folded else values

    def _empty(self, k: int) -> float:
        """What empty space is compressed to."""
        floor = self._floor(k)
        return math.log(floor) if self.config.compression == "log" else (ROOT_FLOOR * floor) ** 0.25

    def _compressed(self, values: Tensor, floor: float | Tensor) -> Tensor:
        values = torch.clamp(values, 0.0, STENCIL_LIMIT)
        if self.config.compression == "log":
            return torch.log(values + floor)
        return torch.sqrt(torch.sqrt(values + ROOT_FLOOR * floor))

    def _floor(self, k: int) -> float:
        return 2.0**-k if self.config.scale == "depth" else 1.0

    def _floors(self, levels: tuple[int, ...]) -> float | Tensor:
        """The floors of several levels, (levels, 1), or the one number that they share."""
        floors = [self._floor(k) for k in levels]
        return floors[0] if len(set(floors)) == 1 else torch.tensor(floors, device=self.level_mean.device).unsqueeze(1)

    def forward(self, stencil: Tensor, aux: Tensor) -> Tensor:
        """Predict j (n,) from `stencil` (n, 10, 225) and `aux` (n, 6)."""
        return self.leave(self.hidden(stencil, aux))

    def hidden(self, stencil: Tensor, aux: Tensor) -> Tensor:
        """All layers but the last, (n, width): what training may compute in half precision."""
        f = self.angle(aux)
        if self.pooling is not None:
            pooled = self.pooled(stencil)
            return self.through(lambda k: pooled[k], f, plain=True)
        levels = torch.unbind(stencil, dim=1)
        # Level by level, so that what is compressed is still in the cache when it is multiplied.
        return self.through(lambda k: self.compressed(levels[k], k), f, self.is_folded)

    def pooled(self, stencil: Tensor) -> dict[int, Tensor]:
        """What each block of pooled levels reads, (n, channels * together), by its first level; standardised, unless that is `folded`."""
        assert self.pooling is not None
        config = self.config
        step = config.levels[1] - config.levels[0] if len(config.levels) > 1 else 1
        even = range(config.levels[0], config.levels[-1] + 1, step)
        # A slice costs less than a gathering of levels, and nothing where it is the whole stencil.
        read = stencil[:, even.start : even.stop : step] if tuple(even) == config.levels else stencil[:, list(config.levels)]
        # All levels in one: small networks spend their time in the number of operations.
        means = self._compressed(self.pooling(read).float(), self._floors(config.levels))
        if self.is_folded:
            empty = [self._empty(k) for k in config.levels]
            means = means - (empty[0] if len(set(empty)) == 1 else torch.tensor(empty).unsqueeze(1))
        else:
            chosen = list(config.levels)
            means = (means - self.level_mean[chosen].unsqueeze(1)) * self.level_scale[chosen].unsqueeze(1)
        n = config.together
        return {config.levels[i]: means[:, i : i + n].flatten(1) for i in range(0, len(config.levels), n)}

    def through(self, level: Callable[[int], Tensor], f: Tensor, plain: bool) -> Tensor:
        """All layers but the last, from what `level` gives for level k, (n, 225) or less, and the features `f`.

        With `plain` the weights take it as it is: it is standardised already, or they are `folded`.
        """
        o: Tensor | None = None
        for k, block in zip(self.sequence, self.blocks, strict=True):
            assert isinstance(block, Block)
            own: tuple[Tensor, Tensor] = (block.stencil.weight, block.stencil.bias)
            weight, bias = own if plain else block.standardised(self.level_mean[k], self.level_scale[k])
            o = block(level(k), weight, bias, f, o)
        assert o is not None
        return self.finish(o, f)

    def finish(self, o: Tensor, f: Tensor) -> Tensor:
        """The two layers between the last block and the head; with the head ``octaves`` the estimate's logarithm is one more column."""
        h: Tensor = F.relu(self.fc_1(torch.cat([o, f], dim=1)))
        h = F.relu(self.fc_2(torch.cat([h, f], dim=1)))
        return h if self.config.head == "absolute" else torch.cat([h, log_octaves(f)], dim=1)

    def leave(self, hidden: Tensor) -> Tensor:
        """The last layer: j (n,), an exponential, whose argument needs all digits."""
        if self.config.head == "absolute":
            argument = self.head(hidden)
        else:
            argument = self.head(hidden[:, :-1]) + hidden[:, -1:]
        return torch.exp(torch.clamp(argument.squeeze(1), LOWEST, HIGHEST))
