"""Training samples from labelled shards: stencils are built when they are needed, never stored."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from deepclouds.backend import backend
from deepclouds.descriptor import LEVELS, POINTS, Descriptor, default_unit
from deepclouds.errors import InputError
from deepclouds.medium.field import Field as Extinction
from deepclouds.model import AUX, aux_inputs
from deepclouds_training.shards import Dataset, Shard, ShardInfo


class SampleConfig(BaseModel):
    """How training samples are drawn.

    Attributes
    ----------
    shards, queries
        shards in a pool and queries drawn from each; a query is one point, one of its suns and one of its albedos.
    passes
        how often a pool is gone through before the next one is built.
    unit_jitter
        the unit of length is multiplied by a log-uniform factor between 1 / unit_jitter and unit_jitter, one a visit to a shard.
    mirror
        mirror half of the stencils across the plane of sun and view, which leaves J unchanged.
    cache_gb
        memory for shards that stay loaded.
    backend
        Dr.Jit backend that builds the stencils.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    shards: int = Field(default=32, ge=1)
    queries: int = Field(default=2048, ge=1)
    passes: int = Field(default=2, ge=1)
    unit_jitter: float = Field(default=2.0, ge=1.0)
    mirror: bool = True
    cache_gb: float = Field(default=3.0, ge=0.0)
    backend: Literal["llvm", "cuda"] = "llvm"


@dataclass(frozen=True)
class Samples:
    """n samples: stencil (n, 10, 225), aux (n, 6), label, its standard error, its independent halves (n, 2), and the shard it came from."""

    stencil: NDArray[np.float32]
    aux: NDArray[np.float32]
    label: NDArray[np.float32]
    error: NDArray[np.float32]
    half: NDArray[np.float32]
    shard: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.label)

    def ranges(self) -> dict[str, tuple[float, float]]:
        """Smallest and largest value of every column of aux, and of the optical depth."""
        found = {a.name: (float(self.aux[:, i].min()), float(self.aux[:, i].max())) for i, a in enumerate(AUX)}
        low, high = found["log1p_tau"]
        return {**found, "tau": (float(np.expm1(low)), float(np.expm1(high)))}


class SampleSource:
    """Samples from the shards of one split.

    Parameters
    ----------
    dataset
        the opened data set.
    shards
        the shards to draw from.
    config
        how samples are drawn.
    seed
        root of the random streams: pool k is a function of the shards, `config`, `seed` and k alone.
    part
        (i, n): build the i-th of n equal parts of every pool, n a divisor of `config.shards`.

    Raises
    ------
    InputError
        when there are no shards.
    """

    def __init__(
        self, dataset: Dataset, shards: tuple[ShardInfo, ...], config: SampleConfig, seed: int, part: tuple[int, int] = (0, 1)
    ) -> None:
        if not shards:
            raise InputError(f"{dataset.folder}: no shards to draw samples from; `deepclouds generate` makes more")
        self.dataset = dataset
        self.shards = shards
        self.config = config
        self.seed = seed
        self._types = backend(config.backend)
        self._cache: dict[int, tuple[Shard, Extinction]] = {}
        self._free_bytes = config.cache_gb * 2**30
        each = config.shards // part[1]
        self._slots = range(part[0] * each, (part[0] + 1) * each)
        self._pool: Samples | None = None
        self._held: int | None = None

    def pool(self, k: int, interrupted: Callable[[], bool] = lambda: False) -> Samples | None:
        """Build this source's part of pool `k`, or return None when `interrupted` said so between two shards.

        It is valid until another one is asked for, which reuses its memory; asked for again, it is not built again.
        """
        if self._pool is None:
            self._pool = _empty(len(self._slots) * self.config.queries)
        if self._held != k:
            self._held = None
            if not self._fill(self._pool, k, self._slots, interrupted):
                return None
            self._held = k
        return self._pool

    def whole_pool(self, k: int) -> Samples:
        """All parts of pool `k`, in memory of their own."""
        pool = _empty(self.config.shards * self.config.queries)
        self._fill(pool, k, range(self.config.shards), lambda: False)
        return pool

    def own(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """Those of some `rows` of a whole pool that lie in this source's part, as rows of the part."""
        low, high = (slot * self.config.queries for slot in (self._slots.start, self._slots.stop))
        return rows[(rows >= low) & (rows < high)] - low

    def _fill(self, pool: Samples, k: int, slots: range, interrupted: Callable[[], bool]) -> bool:
        """Build the shards of pool `k` in `slots` into `pool`; False when interrupted."""
        config = self.config
        for place_number, i in enumerate(slots):
            if interrupted():
                return False
            number, visit = self._turn(k * config.shards + i)
            rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(1, number, visit)))
            factor = config.unit_jitter ** rng.uniform(-1.0, 1.0)
            place = slice(place_number * config.queries, (place_number + 1) * config.queries)
            part = self.draw(self.shards[number], config.queries, rng, factor, config.mirror, pool.stencil[place])
            for field in fields(Samples):
                if field.name != "stencil":
                    getattr(pool, field.name)[place] = getattr(part, field.name)
        return True

    def every_shard(self, queries: int) -> Samples:
        """The same `queries` of every shard, with the unit of length as it is: a validation set."""
        parts = []
        for number, info in enumerate(self.shards):
            rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(2, number)))
            parts.append(self.draw(info, queries, rng, 1.0, False))
        return Samples(**{field.name: np.concatenate([getattr(p, field.name) for p in parts]) for field in fields(Samples)})

    def draw(
        self,
        info: ShardInfo,
        queries: int,
        rng: np.random.Generator,
        unit_factor: float,
        mirror: bool,
        out: NDArray[np.float32] | None = None,
    ) -> Samples:
        """Random queries of one shard, stencils built with the shard's own unit of length times `unit_factor`; into `out` if given."""
        shard, field = self._load(info)
        i = rng.integers(0, len(shard.point), queries)
        k = rng.integers(0, shard.omega_sun.shape[1], queries)
        m = rng.integers(0, shard.albedo.shape[1], queries)
        azimuth = rng.uniform(0.0, 2 * np.pi, queries)
        side = np.where(rng.random(queries) < 0.5, -1.0, 1.0) if mirror else None
        descriptor = Descriptor(field, unit=unit_factor * default_unit(field))
        return self._samples(
            info, shard, (i, k, m), descriptor.stencils_numpy(shard.point[i], shard.w[i], shard.omega_sun[i, k], azimuth, side, out)
        )

    def all_of(self, info: ShardInfo) -> tuple[Samples, float]:
        """Every label of one shard, in the order point, sun, albedo, and the longest side of its box in units of length."""
        shard, field = self._load(info)
        i, k, m = (v.ravel() for v in np.indices(shard.error.shape))
        descriptor = Descriptor(field)
        stencil = descriptor.stencils_numpy(shard.point[i], shard.w[i], shard.omega_sun[i, k])
        longest = float(np.linalg.norm(shard.volume.to_world[:3, :3], axis=0).max())
        return self._samples(info, shard, (i, k, m), stencil), longest / descriptor.unit

    def _samples(self, info: ShardInfo, shard: Shard, chosen: tuple[NDArray[np.int64], ...], stencil: NDArray[np.float32]) -> Samples:
        """The labels at the `chosen` points, suns and albedos of a shard, with their stencils."""
        i, k, m = chosen
        w, sun = shard.w[i], shard.omega_sun[i, k]
        g1, g2, weight = shard.phase[i].T
        aux = aux_inputs(angle_between(w, sun), g1, g2, weight, shard.albedo[i, m], shard.tau_sun[i, k])
        half, error = shard.half[i, k, m], shard.error[i, k, m]
        label = half.mean(axis=-1)
        if not (np.all(np.isfinite(label)) and np.all(np.isfinite(error)) and np.all(np.isfinite(stencil))):
            path = self.dataset.folder / info.file
            raise InputError(f"{path}: labels or stencils are not finite; delete the shard and generate it again")
        return Samples(stencil, aux, label, error, half, np.full(len(i), info.index, np.int64))

    def _turn(self, position: int) -> tuple[int, int]:
        """Shard number and visit at a position of the endless sequence that visits all shards in a new random order each time."""
        visit, place = divmod(position, len(self.shards))
        order = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(0, visit))).permutation(len(self.shards))
        return int(order[place]), visit

    def _load(self, info: ShardInfo) -> tuple[Shard, Extinction]:
        if info.index in self._cache:
            return self._cache[info.index]
        shard = self.dataset.load(info)
        loaded = shard, Extinction(self._types, shard.volume, shard.scale)
        # All shards come round equally often, so throwing out one for another would gain nothing.
        size = 2 * shard.volume.density.nbytes + sum(v.nbytes for v in vars(shard).values() if isinstance(v, np.ndarray))
        if size <= self._free_bytes:
            self._free_bytes -= size
            self._cache[info.index] = loaded
        return loaded


def angle_between(w: NDArray[np.float32], omega_sun: NDArray[np.float32]) -> NDArray[np.float64]:
    """The angle gamma between unit vectors (n, 3), radians; precise near 0 and pi, where an arc cosine is not."""
    a, b = w.astype(np.float64), omega_sun.astype(np.float64)
    gamma: NDArray[np.float64] = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1))
    return gamma


def _empty(n: int) -> Samples:
    return Samples(
        np.empty((n, LEVELS, POINTS), np.float32),
        np.empty((n, len(AUX)), np.float32),
        np.empty(n, np.float32),
        np.empty(n, np.float32),
        np.empty((n, 2), np.float32),
        np.empty(n, np.int64),
    )
