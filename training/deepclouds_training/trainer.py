"""The training loop: pools of samples, Adam, averaged weights, validation by cloud, checkpoints that resume exactly."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from deepclouds.errors import InputError
from deepclouds_training.average import WeightAverage
from deepclouds_training.loss import relative_squared_error
from deepclouds_training.network import Network
from deepclouds_training.predicted_plot import write_predicted_plot
from deepclouds_training.run_folder import RunFolder
from deepclouds_training.samples import Samples, SampleSource
from deepclouds_training.shards import Dataset, ShardInfo
from deepclouds_training.train_config import TrainConfig
from deepclouds_training.validation import Figures, energy_by_cloud, figures_by_family

log = logging.getLogger(__name__)
REPORT_SECONDS = 30.0
PREDICT_BATCH = 1024


class Trainer:
    """One run, from its first step or from its last checkpoint.

    A step depends on the configuration, the shards and its own number alone (with `minutes`, on the time elapsed as well), so a run
    that was interrupted and resumed goes through the same weights as one that was not.
    """

    def __init__(self, config: TrainConfig, run: RunFolder, dataset: Dataset, shards: tuple[ShardInfo, ...]) -> None:
        self.config = config
        self.run = run
        train = tuple(s for s in shards if s.split == "train")
        valid = tuple(s for s in shards if s.split == "valid")
        if not train:
            raise InputError(f"{dataset.folder}: holds no training shards; `deepclouds generate` makes them")
        if not valid:
            raise InputError(f"{dataset.folder}: holds no validation shards; generate some, or the run would not know how good it is")
        self.families = {s.index: s.family for s in valid}
        self.source = SampleSource(dataset, train, config.samples, config.seed)
        self.valid_source = SampleSource(dataset, valid[: config.valid_shards], config.samples, config.seed + 1)
        self.valid: Samples | None = None
        torch.manual_seed(config.seed)
        self.network = Network(config.network)
        self.average = WeightAverage(self.network, config.ema)
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=config.learning_rate, fused=True)
        self.step = 0
        self.elapsed = 0.0
        self.ranges: dict[str, tuple[float, float]] = {}
        pool = config.samples.shards * config.samples.queries
        self.batches = pool // config.batch
        self.fresh = config.start is None
        self.resumed = self._restore()
        if not self.resumed and config.start is not None:
            self._set_out_from(config.start)

    def _set_out_from(self, folder: str) -> None:
        run = RunFolder(Path(folder))
        state = run.load_checkpoint()
        if state is None:
            raise InputError(f"start = '{folder}': holds no checkpoint; name the folder of a run")
        if run.config().network != self.config.network:
            raise InputError(f"start = '{folder}': its network is another one; give this run the same [network] table")
        self.network.load_state_dict(state["network"])
        average = WeightAverage(self.network, run.config().ema)
        average.load_state_dict(state["average"])
        self.network.load_state_dict(average.averaged(self.network).state_dict())
        self.ranges = {name: (low, high) for name, (low, high) in state["ranges"].items()}

    def _restore(self) -> bool:
        state = self.run.load_checkpoint()
        if state is None:
            return False
        self.network.load_state_dict(state["network"])
        self.average.load_state_dict(state["average"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.step, self.elapsed = state["step"], state["elapsed"]
        self.ranges = {name: (low, high) for name, (low, high) in state["ranges"].items()}
        torch.set_rng_state(state["torch_rng"])
        self.run.forget_after(self.step)
        return True

    def checkpoint(self) -> None:
        """Save everything the next step depends on."""
        self.run.save_checkpoint(
            {
                "network": self.network.state_dict(),
                "average": self.average.state_dict(),
                "optimiser": self.optimiser.state_dict(),
                "step": self.step,
                "elapsed": self.elapsed,
                "ranges": {name: list(pair) for name, pair in self.ranges.items()},
                "torch_rng": torch.get_rng_state(),
            }
        )

    def progress(self) -> float:
        """How much of the schedule is done, 0 to 1."""
        if self.config.minutes is not None:
            return min(1.0, self.elapsed / (60 * self.config.minutes))
        return min(1.0, self.step / self.config.steps)

    def learning_rate(self) -> float:
        """Linear rise, then half a cosine."""
        config = self.config
        rise = min(1.0, (self.step + 1) / config.warmup) if config.warmup else 1.0
        fall = 0.5 * (1 + math.cos(math.pi * self.progress()))
        return rise * (config.final_learning_rate + (config.learning_rate - config.final_learning_rate) * fall)

    def train(self, interrupted: Callable[[], bool], display: AbstractContextManager[Any] | None = None) -> bool:
        """Run to the end of the schedule; False when `interrupted` said so before. A checkpoint is written either way."""
        clock = _Clock(self)
        last_saved = last_report = time.monotonic()
        losses: list[float] = []
        with display if display is not None else nullcontext() as bar:
            while self.progress() < 1.0:
                visit, batch = divmod(self.step, self.batches)
                number, turn = divmod(visit, self.config.samples.passes)
                pool = self.source.pool(number, interrupted)
                if pool is None:
                    return self._stopped(clock)
                self._see(pool, number)
                order = np.random.default_rng(np.random.SeedSequence(self.config.seed, spawn_key=(3, number, turn))).permutation(len(pool))
                for b in range(batch, self.batches):
                    if interrupted():
                        return self._stopped(clock)
                    if self.progress() >= 1.0:
                        break
                    rows = order[b * self.config.batch : (b + 1) * self.config.batch]
                    losses.append(self._update(pool, rows))
                    clock.tick()
                    now = time.monotonic()
                    if self.step % self.config.valid_every == 0:
                        self.validate()
                        clock.tick()
                    if now - last_saved > self.config.checkpoint_seconds:
                        self.checkpoint()
                        last_saved = now
                    if bar is not None:
                        bar.show(self, losses[-1])
                    if now - last_report > REPORT_SECONDS or self.progress() >= 1.0:
                        self._report(losses, now - last_report, quiet=bar is not None)
                        losses, last_report = [], now
            if self.step % self.config.valid_every:
                self.validate()
                clock.tick()
            self.checkpoint()
        return True

    def _see(self, pool: Samples, number: int) -> None:
        if self.step == 0 and self.fresh:
            self.network.fit_inputs(pool.stencil, pool.label)
        for name, (low, high) in pool.ranges().items():
            before = self.ranges.get(name, (low, high))
            self.ranges[name] = (min(low, before[0]), max(high, before[1]))

    def _update(self, pool: Samples, rows: NDArray[np.int64]) -> float:
        for group in self.optimiser.param_groups:
            group["lr"] = self.learning_rate()
        stencil, aux, label = (torch.from_numpy(v[rows]) for v in (pool.stencil, pool.aux, pool.label))
        with torch.autocast("cpu", torch.bfloat16, enabled=self.config.precision == "bfloat16"):
            hidden = self.network.hidden(stencil, aux)
        loss = relative_squared_error(self.network.leave(hidden.float()), label, self.config.power)
        value = float(loss.detach())
        if not math.isfinite(value):
            raise InputError(
                f"{self.run.path}: the loss became {value} at step {self.step}; lower learning_rate (now {self.config.learning_rate:g}) "
                "and resume from the last checkpoint, or start over"
            )
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimiser.step()
        self.average.update()
        self.step += 1
        return value

    def validate(self) -> dict[str, Figures]:
        """Figures of the averaged weights on the validation clouds: logged, and drawn."""
        if self.valid is None:
            self.valid = self.valid_source.every_shard(self.config.valid_queries)
        valid = self.valid
        prediction = predict(self.average.averaged(self.network), valid.stencil, valid.aux)
        found = figures_by_family(prediction, valid.label, valid.error, valid.shard, self.families)
        clouds = energy_by_cloud(prediction, valid.label, valid.shard)
        self.run.log(
            {
                "kind": "valid",
                "step": self.step,
                "elapsed": self.elapsed,
                "figures": {name: f.as_dict() for name, f in found.items()},
                "clouds": {str(n): {"family": self.families[n], "energy": e, "error": s} for n, (e, s) in clouds.items()},
            }
        )
        write_predicted_plot(self.run.picture, prediction, valid.label, f"{self.run.path.name}, step {self.step}")
        a = found["all"]
        log.info(
            "step %d: validation rRMSE %.1f %% [%.1f, %.1f], energy %+.1f %% [%+.1f, %+.1f]",
            self.step,
            *(100 * v for v in (a.rrmse, a.rrmse_low, a.rrmse_high, a.energy, a.energy_low, a.energy_high)),
        )
        return found

    def _report(self, losses: list[float], seconds: float, quiet: bool) -> None:
        rate = len(losses) * self.config.batch / max(seconds, 1e-9)
        entry = {"loss": float(np.mean(losses)), "learning_rate": self.learning_rate(), "samples_per_second": rate}
        self.run.log({"kind": "train", "step": self.step, "elapsed": self.elapsed, **entry})
        if not quiet:
            log.info("step %d (%.0f %%): loss %.4f, %.0f samples/s", self.step, 100 * self.progress(), entry["loss"], rate)

    def _stopped(self, clock: _Clock) -> bool:
        clock.tick()
        self.checkpoint()
        return False


class _Clock:
    """Adds the time that has passed to the trainer's own, which checkpoints carry from one start to the next."""

    def __init__(self, trainer: Trainer) -> None:
        self._trainer = trainer
        self._last = time.monotonic()

    def tick(self) -> None:
        now = time.monotonic()
        self._trainer.elapsed += now - self._last
        self._last = now


@torch.no_grad()
def predict(network: Network, stencil: NDArray[np.float32], aux: NDArray[np.float32]) -> NDArray[np.float32]:
    """Predictions (n,) of many rows, in batches."""
    network.eval()
    result = np.empty(len(aux), np.float32)
    for start in range(0, len(aux), PREDICT_BATCH):
        rows = slice(start, start + PREDICT_BATCH)
        result[rows] = network(torch.from_numpy(stencil[rows]), torch.from_numpy(aux[rows])).numpy()
    return result
