"""Samples of the furnace identity, made beside the labels of a pool: at albedo 1 the light of all suns adds up to exactly 1."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from deepclouds_training.points import around, uniform_directions
from deepclouds_training.samples import Samples, SampleSource, angle_between
from deepclouds_training.shards import Shard, ShardInfo
from numpy.random import Generator
from numpy.typing import NDArray
from torch import Tensor

from deepclouds.descriptor import Descriptor, default_unit
from deepclouds.medium.field import Field
from deepclouds.medium.optical_depth import optical_depth
from deepclouds.medium.phase import INV_4PI, hg_numpy, sample_two_lobe_cosine
from deepclouds.model import aux_inputs

# Suns of a point: two independent sets.
SUN_SETS, SUNS = 2, 8

Singles = NDArray[np.float32]


@dataclass(frozen=True)
class Furnace:
    """m points with `SUN_SETS` * `SUNS` suns each, flat over points and suns.

    Attributes
    ----------
    stencil, aux
        (m * 16, 10, 225) and (m * 16, 6), of albedo 1.
    single, weight
        (m * 16,): a sun's single scattering 4 pi S1 / E, and 1 / (4 pi density) of its direction.
    """

    stencil: Singles
    aux: Singles
    single: Singles
    weight: Singles


def furnace_loss(j: Tensor, single: Tensor, weight: Tensor) -> Tensor:
    """Mean over points of the product of both sets' residuals, whose expectation is the square of the network's own residual.

    For every point x and direction w at albedo 1 the integral over all suns of (S1 + J) / E is 1 (light that only scatters inside of a
    uniform radiance of 1 stays 1), and J / E = j / (4 pi). The suns of the two sets are independent, so their noise does not add up.
    """
    residual = ((single + j) * weight).view(-1, SUN_SETS, SUNS).mean(dim=2) - 1.0
    return torch.mean(residual[:, 0] * residual[:, 1])


class FurnaceSource(SampleSource):
    """The samples of a `SampleSource`, and beside each visit to a shard `points` of its points under suns of the furnace.

    `furnace` holds those of all visits since `begin`.
    """

    points = 0
    _last: tuple[ShardInfo, tuple[Shard, Field]] | None = None
    _parts: list[Furnace]

    def begin(self) -> None:
        """Forget the samples of the pool before."""
        self._parts = []

    @property
    def furnace(self) -> Furnace:
        """Of the shards drawn from since `begin`."""
        return Furnace(**{name: np.concatenate([getattr(p, name) for p in self._parts]) for name in vars(self._parts[0])})

    def draw(
        self,
        info: ShardInfo,
        queries: int,
        rng: Generator,
        unit_factor: float,
        mirror: bool,
        out: NDArray[np.float32] | None = None,
    ) -> Samples:
        """As of `SampleSource`."""
        self._last = info, self._load(info)
        samples = super().draw(info, queries, rng, unit_factor, mirror, out)
        if self.points:
            shard, field = self._last[1]
            self._parts.append(furnace_of(shard, field, self.points, rng, unit_factor))
        return samples

    def _load(self, info: ShardInfo) -> tuple[Shard, Field]:
        # The shard is needed twice and may not fit the cache.
        return self._last[1] if self._last is not None and self._last[0] is info else super()._load(info)


def furnace_of(shard: Shard, field: Field, points: int, rng: Generator, unit_factor: float) -> Furnace:
    """Random points of a shard; half of each set's suns are uniform on the sphere and half follow the phase function.

    The density of the mixture of both weighs them all (balance heuristic), so that neither the phase peak nor the rest is left to chance.
    """
    types = field.types
    i = np.repeat(rng.integers(0, len(shard.point), points), SUN_SETS * SUNS)
    n = len(i)
    point, w, phase = shard.point[i], shard.w[i], shard.phase[i]
    g1, g2, share = phase.T
    u, *lobes = (types.Float(np.ascontiguousarray(v, np.float32)) for v in (rng.random(n), g1, g2, share))
    cosine = np.array(sample_two_lobe_cosine(u, *lobes), np.float64)
    sun = np.where((np.arange(n) % 2 == 0)[:, None], uniform_directions(rng, n), around(rng, w, np.arccos(np.clip(cosine, -1, 1)))).astype(
        np.float32
    )
    cosine = np.sum(w.astype(np.float64) * sun, axis=1)
    p = (share * hg_numpy(cosine, g1) + (1 - share) * hg_numpy(cosine, g2)) / INV_4PI
    o, d = (types.Array3f(np.ascontiguousarray(v.T)) for v in (point, sun))
    tau = np.array(optical_depth(field, o, d, types.Float(0), types.Float(1e30), types.Bool(np.ones(n, bool))), np.float64)
    stencil = Descriptor(field, unit=unit_factor * default_unit(field)).stencils_numpy(point, w, sun, rng.uniform(0, 2 * np.pi, n))
    aux = aux_inputs(angle_between(w, sun), g1, g2, share, 1.0, tau)
    return Furnace(stencil, aux, (p * np.exp(-tau)).astype(np.float32), (1 / (0.5 + 0.5 * p)).astype(np.float32))
