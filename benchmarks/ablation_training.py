"""Many networks trained side by side: the same samples in the same order, stencils built and compressed once for all of them."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from deepclouds_training.average import WeightAverage
from deepclouds_training.features import AngleFeatures
from deepclouds_training.loss import relative_squared_error
from deepclouds_training.network import Network, NetworkConfig
from deepclouds_training.samples import SampleConfig, Samples
from deepclouds_training.shards import open_dataset
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.ablation_furnace import SUN_SETS, SUNS, Furnace, FurnaceSource, furnace_loss
from benchmarks.ablation_variants import Variant
from deepclouds.model import LEVELS
from deepclouds.replacing import replacing

log = logging.getLogger(__name__)
BATCH = 1024
# Steps that a network takes before the next one has its turn: its weights stay in the cache.
CHUNK = 16
FURNACE_POINTS = 16
SAVE_SECONDS = 240.0
Recipe = tuple[str, str]


@dataclass(frozen=True)
class Plan:
    """How long and on what: data folder, minutes, shards a pool, queries a shard, rates, decay of the averages, processors."""

    data: Path
    minutes: float
    shards: int = 32
    queries: int = 8192
    passes: int = 2
    learning_rate: float = 1e-3
    final_learning_rate: float = 1e-5
    warmup: int = 200
    ema: float = 0.998
    threads: int = 2
    seed: int = 0


@dataclass(frozen=True)
class Inputs:
    """n rows: the stencil as it is (n, 10, 225), its standardised levels by recipe, features (n, 13)."""

    raw: Tensor
    levels: dict[Recipe, list[Tensor]]
    f: Tensor

    def rows(self, first: int, count: int) -> Inputs:
        """Some of the rows."""
        place = slice(first, first + count)
        return Inputs(self.raw[place], {r: [x[place] for x in levels] for r, levels in self.levels.items()}, self.f[place])


class Readings:
    """What networks read of stencils, for every recipe (scale and compression) once.

    Parameters
    ----------
    models
        a network for every recipe, of which the standardisation alone is used.
    """

    def __init__(self, models: dict[Recipe, Network]) -> None:
        self.angle = AngleFeatures()
        self.models = models

    @staticmethod
    def fitted(samples: Samples, recipes: Sequence[Recipe]) -> Readings:
        """Every level of `samples` then has mean 0 and deviation 1."""
        readings = Readings({recipe: _reader(recipe) for recipe in recipes})
        for model in readings.models.values():
            model.fit_inputs(samples.stencil, samples.label)
        return readings

    def state(self) -> dict[Recipe, tuple[Tensor, Tensor]]:
        """What `restored` takes."""
        return {recipe: (model.level_mean, model.level_scale) for recipe, model in self.models.items()}

    @staticmethod
    def restored(state: dict[Recipe, tuple[Tensor, Tensor]]) -> Readings:
        """The readings that had this `state`."""
        readings = Readings({recipe: _reader(recipe) for recipe in state})
        for recipe, (mean, scale) in state.items():
            readings.models[recipe].level_mean.copy_(mean)
            readings.models[recipe].level_scale.copy_(scale)
        return readings

    @torch.no_grad()
    def of(self, stencil: NDArray[np.float32], aux: NDArray[np.float32], dtype: torch.dtype) -> Inputs:
        """The inputs of some samples in the given arithmetic; features stay float32."""
        raw = torch.from_numpy(stencil)
        levels = {}
        for recipe, model in self.models.items():
            mean, scale = model.level_mean, model.level_scale
            levels[recipe] = [((model.compressed(raw[:, k], k) - mean[k]) * scale[k]).to(dtype) for k in range(LEVELS)]
        return Inputs(raw.to(dtype), levels, self.angle(torch.from_numpy(aux)))


def recipe_of(config: NetworkConfig) -> Recipe:
    """What `Readings` calls the way in which a network compresses its levels."""
    return config.scale, config.compression


def hidden(network: Network, inputs: Inputs) -> Tensor:
    """All layers but the last."""
    if network.pooling is not None:
        pooled = network.pooled(inputs.raw)
        return network.through(lambda k: pooled[k], inputs.f, True)
    levels = inputs.levels[recipe_of(network.config)]
    return network.through(lambda k: levels[k], inputs.f, True)


def _reader(recipe: Recipe) -> Network:
    return Network(NetworkConfig.model_validate({"width": 8, "scale": recipe[0], "compression": recipe[1]}))


class Learner:
    """One network with its optimiser and its averaged weights."""

    def __init__(self, variant: Variant, seed: int, plan: Plan) -> None:
        torch.manual_seed(1000 + seed)
        self.variant, self.seed = variant, seed
        self.network = variant.build()
        self.average = WeightAverage(self.network, plan.ema)
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=plan.learning_rate, fused=True)
        self.loss = math.nan
        self.seconds = 0.0

    @property
    def key(self) -> str:
        """Name in checkpoints and results."""
        return f"{self.variant.name}/{self.seed}"

    def fit(self, samples: Samples, readings: Readings) -> None:
        """Standardise the inputs, and start the head at the mean label."""
        self.network.fit_inputs(samples.stencil[:: max(1, len(samples) // 4096)], samples.label)
        if self.network.pooling is None:
            model = readings.models[recipe_of(self.network.config)]
            self.network.level_mean.copy_(model.level_mean)
            self.network.level_scale.copy_(model.level_scale)

    def learn(self, inputs: Inputs, label: Tensor, rates: Sequence[float], furnace: tuple[Inputs, Tensor, Tensor] | None) -> None:
        """A step on every batch; `furnace` holds as many batches of its own."""
        torch.set_num_threads(1)
        started = time.thread_time()
        for b, rate in enumerate(rates):
            self._step(inputs.rows(b * BATCH, BATCH), label[b * BATCH : (b + 1) * BATCH], rate, _batch_of(furnace, b))
        self.seconds += time.thread_time() - started

    def _step(self, inputs: Inputs, label: Tensor, rate: float, furnace: tuple[Inputs, Tensor, Tensor] | None) -> None:
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        prediction = self._predict(inputs)
        loss = sum((share * relative_squared_error(prediction, label, power) for power, share in self.variant.powers), torch.zeros(()))
        if furnace is not None and self.variant.furnace:
            loss = loss + self.variant.furnace * furnace_loss(self._predict(furnace[0]), *furnace[1:])
        self.loss = float(loss.detach())
        if not math.isfinite(self.loss):
            raise ArithmeticError(f"{self.key}: the loss became {self.loss}")
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimiser.step()
        self.average.update()

    def _predict(self, inputs: Inputs) -> Tensor:
        with torch.autocast("cpu", torch.bfloat16):
            value = hidden(self.network, inputs)
        return self.network.leave(value.float())

    def state(self) -> dict[str, Any]:
        """What `restore` takes."""
        return {
            "seconds": self.seconds,
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "optimiser": self.optimiser.state_dict(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from `state`."""
        self.network.load_state_dict(state["network"])
        self.average.load_state_dict(state["average"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.seconds = state["seconds"]


def _batch_of(furnace: tuple[Inputs, Tensor, Tensor] | None, b: int) -> tuple[Inputs, Tensor, Tensor] | None:
    if furnace is None:
        return None
    size = FURNACE_POINTS * SUN_SETS * SUNS
    inputs, single, weight = furnace
    place = slice(b * size, (b + 1) * size)
    return inputs.rows(b * size, size), single[place], weight[place]


class Race:
    """All learners on the same pools; progress, and with it the learning rate, is the time that has passed."""

    def __init__(self, plan: Plan, learners: list[Learner], folder: Path) -> None:
        self.plan, self.learners = plan, learners
        self.path = folder / "checkpoint.pt"
        dataset = open_dataset(plan.data)
        shards = tuple(s for s in dataset.shards if s.split == "train")
        config = SampleConfig(shards=plan.shards, queries=plan.queries, passes=plan.passes, cache_gb=0)
        self.source = FurnaceSource(dataset, shards, config, plan.seed)
        self.batches = plan.shards * plan.queries // BATCH // CHUNK * CHUNK
        if any(learner.variant.furnace for learner in learners):
            # Every point of the furnace comes round four times in two passes.
            self.source.points = max(1, plan.passes * self.batches * FURNACE_POINTS // (4 * plan.shards))
        self.recipes = sorted({recipe_of(learner.network.config) for learner in learners})
        self.readings: Readings | None = None
        self.step, self.elapsed = 0, 0.0
        self._resume()

    @property
    def progress(self) -> float:
        """0 to 1."""
        return min(1.0, self.elapsed / (60 * self.plan.minutes))

    def run(self) -> None:
        """Train to the end, saving now and then."""
        last = saved = time.monotonic()
        with ThreadPoolExecutor(self.plan.threads) as workers:
            while self.progress < 1:
                visit, batch = divmod(self.step, self.batches)
                number, turn = divmod(visit, self.plan.passes)
                pool, furnace = self._pool(number)
                for later in range(turn, self.plan.passes):
                    order = np.random.default_rng([self.plan.seed, 3, number, later]).permutation(len(pool))
                    for first in range(batch, self.batches, CHUNK):
                        self._chunk(workers, pool, furnace, order[first * BATCH : (first + CHUNK) * BATCH])
                        now = time.monotonic()
                        self.elapsed, last = self.elapsed + now - last, now
                        if now - saved > SAVE_SECONDS:
                            self._save()
                            saved = now
                        if self.progress >= 1:
                            break
                    batch = 0
                    if self.progress >= 1:
                        break
        self._save()

    def _pool(self, number: int) -> tuple[Samples, Furnace | None]:
        self.source.begin()
        pool = self.source.pool(number)
        assert pool is not None
        if self.readings is None:
            # The standardisation is that of the first pool, also after a resumption.
            self.readings = Readings.fitted(pool, self.recipes)
            for learner in self.learners:
                learner.fit(pool, self.readings)
        return pool, self.source.furnace if self.source.points else None

    def _chunk(self, workers: ThreadPoolExecutor, pool: Samples, furnace: Furnace | None, rows: NDArray[np.int64]) -> None:
        assert self.readings is not None
        inputs = self.readings.of(pool.stencil[rows], pool.aux[rows], torch.bfloat16)
        label = torch.from_numpy(pool.label[rows])
        extra = None
        if furnace is not None:
            each, points = SUN_SETS * SUNS, len(furnace.single) // (SUN_SETS * SUNS)
            chosen = (self.step * FURNACE_POINTS + np.arange(CHUNK * FURNACE_POINTS)) % points
            flat = (chosen[:, None] * each + np.arange(each)).ravel()
            of = self.readings.of(furnace.stencil[flat], furnace.aux[flat], torch.bfloat16)
            extra = of, torch.from_numpy(furnace.single[flat]), torch.from_numpy(furnace.weight[flat])
        rates = [self._rate(self.step + i) for i in range(CHUNK)]
        # The dearest go first, so that the workers end together.
        turns = sorted(self.learners, key=lambda learner: -learner.seconds)
        list(workers.map(lambda learner: learner.learn(inputs, label, rates, extra), turns))
        self.step += CHUNK
        if self.step % (4 * CHUNK) == 0:
            base = self.learners[0]
            log.info("%.1f %%: step %d, %.0f s, loss of %s %.4f", 100 * self.progress, self.step, self.elapsed, base.key, base.loss)

    def _rate(self, step: int) -> float:
        plan = self.plan
        fall = 0.5 * (1 + math.cos(math.pi * self.progress))
        return min(1.0, (step + 1) / plan.warmup) * (plan.final_learning_rate + (plan.learning_rate - plan.final_learning_rate) * fall)

    def _save(self) -> None:
        assert self.readings is not None
        state = {
            "step": self.step,
            "elapsed": self.elapsed,
            "plan": repr(self.plan),
            "readings": self.readings.state(),
            "learners": {learner.key: learner.state() for learner in self.learners},
        }
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(self.path, ".pt") as temporary:
            torch.save(state, temporary)

    def _resume(self) -> None:
        if not self.path.exists():
            return
        state = torch.load(self.path)
        if state["plan"] != repr(self.plan) or set(state["learners"]) != {learner.key for learner in self.learners}:
            raise ValueError(f"{self.path}: of another plan or other variants; delete it or name another folder")
        self.step, self.elapsed = state["step"], state["elapsed"]
        for learner in self.learners:
            learner.restore(state["learners"][learner.key])
        self.readings = Readings.restored(state["readings"])
