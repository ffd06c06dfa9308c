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
from torch import Tensor

from deepclouds.errors import InputError
from deepclouds_training.device import chosen_device, multiplies_bfloat16
from deepclouds_training.events import Events
from deepclouds_training.learner import Learner
from deepclouds_training.loss import relative_squared_error
from deepclouds_training.network import Network
from deepclouds_training.pace import Pace, pace_text
from deepclouds_training.patience import Patience
from deepclouds_training.predicted_plot import write_predicted_plot
from deepclouds_training.processes import Processes
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

    Parameters
    ----------
    config, run
        what to do, and where it is kept.
    dataset, shards
        the opened data set and the shards of it to use.
    processes
        the processes that share the work; all of them make a trainer with the same arguments.

    Raises
    ------
    InputError
        for shards or settings that cannot be trained with.
    """

    def __init__(
        self, config: TrainConfig, run: RunFolder, dataset: Dataset, shards: tuple[ShardInfo, ...], processes: Processes | None = None
    ) -> None:
        self.config = config
        self.run = run
        self.processes = processes or Processes()
        self.processes.require_equal_parts(config.samples.shards, config.batch)
        train = tuple(s for s in shards if s.split == "train")
        valid = tuple(s for s in shards if s.split == "valid")
        if not train:
            raise InputError(f"{dataset.folder}: holds no training shards; `deepclouds generate` makes them")
        if not valid:
            raise InputError(f"{dataset.folder}: holds no validation shards; generate some, or the run would not know how good it is")
        self.families = {s.index: s.family for s in valid}
        self.source = SampleSource(dataset, train, config.samples, config.seed, (self.processes.rank, self.processes.count))
        self.valid_source = SampleSource(dataset, valid[: config.valid_shards], config.samples, config.seed + 1)
        self.valid: Samples | None = None
        self.device = chosen_device(config.device, self.processes.local_rank)
        half = config.precision == "bfloat16" and multiplies_bfloat16(self.device)
        if half != (config.precision == "bfloat16"):
            log.info("precision = 'bfloat16': this %s would emulate it, many times slower; float32 in its place", self.device.type.upper())
        torch.manual_seed(config.seed)
        self.learner = Learner(config.network, config.ema, half, self.device)
        self.companion = Learner(config.companion, config.ema, half, self.device) if config.companion is not None else None
        self.patience = Patience(config.patience)
        self.events = Events(run.events) if config.tensorboard and self.processes.writes else None
        self.pace = Pace()
        self.step = 0
        self.elapsed = 0.0
        self.ranges: dict[str, tuple[float, float]] = {}
        self.pool_size = config.samples.shards * config.samples.queries
        self.batches = self.pool_size // config.batch
        self._interrupted = False
        self._unfitted = [learner.network for learner in (self.learner, self.companion) if learner is not None]
        self.resumed = self._restore()
        if not self.resumed and config.start is not None:
            self._set_out_from(config.start)

    @property
    def network(self) -> Network:
        """The network in training, with the weights of the last step."""
        return self.learner.network

    def _set_out_from(self, folder: str) -> None:
        run = RunFolder(Path(folder))
        state = run.load_checkpoint()
        if state is None:
            raise InputError(f"start = '{folder}': holds no checkpoint; name the folder of a run")
        before = run.config()
        if before.network != self.config.network:
            raise InputError(f"start = '{folder}': its network is another one; give this run the same [network] table")
        self._unfitted.remove(self.learner.network)
        self.learner.start_from_average(state, before.ema)
        if self.companion is not None and before.companion == self.config.companion:
            self._unfitted.remove(self.companion.network)
            self.companion.start_from_average(state["companion"], before.ema)
        self.ranges = {name: (low, high) for name, (low, high) in state["ranges"].items()}

    def _restore(self) -> bool:
        state = self.run.load_checkpoint()
        # Before the first step there is nothing to go on with: the inputs have not been looked at yet.
        if state is None or state["step"] == 0:
            return False
        self._unfitted.clear()
        self.learner.load_state_dict(state)
        if self.companion is not None:
            self.companion.load_state_dict(state["companion"])
        if "patience" in state:
            self.patience.load_state_dict(state["patience"])
        self.step, self.elapsed = state["step"], state["elapsed"]
        self.ranges = {name: (low, high) for name, (low, high) in state["ranges"].items()}
        torch.set_rng_state(state["torch_rng"])
        if self.processes.writes:
            self.run.forget_after(self.step)
        return True

    def checkpoint(self) -> None:
        """Save everything the next step depends on."""
        if not self.processes.writes:
            return
        self.run.save_checkpoint(
            {
                **self.learner.state_dict(),
                **({"companion": self.companion.state_dict()} if self.companion is not None else {}),
                "patience": self.patience.state_dict(),
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
        """Run to the end of the schedule, or until patience is at its end; False when `interrupted` said so before.

        A checkpoint is written either way.
        """
        self.pace.start()
        if self.events is not None:
            self.events.open(self.step)
        last_saved = last_report = time.monotonic()
        losses: list[float] = []
        # One process may stop between two shards; of several, each must come to the step at which all of them agree to stop.
        while_building = interrupted if self.processes.count == 1 else lambda: False
        with display if display is not None else nullcontext() as bar:
            while not self._over(interrupted):
                visit, batch = divmod(self.step, self.batches)
                number, turn = divmod(visit, self.config.samples.passes)
                pool = self.source.pool(number, while_building)
                if pool is None:
                    self._interrupted = True
                    break
                self._lap("building", stencils=self.pool_size if turn == 0 or batch else 0)
                self._see(pool, number)
                order = np.random.default_rng(np.random.SeedSequence(self.config.seed, spawn_key=(3, number, turn))).permutation(
                    self.pool_size
                )
                for b in range(batch, self.batches):
                    if self._over(interrupted):
                        break
                    rows = order[b * self.config.batch : (b + 1) * self.config.batch]
                    losses.append(self._update(pool, self.source.own(rows)))
                    self._lap("stepping", samples=len(rows))
                    now = time.monotonic()
                    if self.step % self.config.valid_every == 0:
                        self.validate()
                    if now - last_saved > self.config.checkpoint_seconds:
                        self.checkpoint()
                        last_saved = now
                    if bar is not None:
                        bar.show(self, losses[-1])
                    if now - last_report > REPORT_SECONDS:
                        self._report(losses, quiet=bar is not None)
                        losses, last_report = [], now
            if not self._interrupted:
                if losses:
                    self._report(losses, quiet=bar is not None)
                if self.step % self.config.valid_every:
                    self.validate()
            self.checkpoint()
        if self.events is not None:
            self.events.close()
        return not self._interrupted

    def _over(self, interrupted: Callable[[], bool]) -> bool:
        """Whether to leave the loop; every process gets the same answer, and the same time elapsed, on which the schedule may depend."""
        self.elapsed, self._interrupted, tired = self.processes.agree(self.elapsed, interrupted(), self.patience.exhausted)
        return self._interrupted or tired or self.progress() >= 1.0

    def _lap(self, phase: str, stencils: int = 0, samples: int = 0) -> None:
        self.elapsed += self.pace.lap(phase, stencils, samples)

    def _see(self, pool: Samples, number: int) -> None:
        if self._unfitted:
            if self.processes.writes:
                # All of the first pool, so that the number of processes makes no difference.
                whole = pool if self.processes.count == 1 else self.source.whole_pool(number)
                for network in self._unfitted:
                    # Samples lie in main memory, and so does all of the network while it looks at them.
                    network.cpu().fit_inputs(whole.stencil, whole.label)
                    network.to(self.device)
            for network in self._unfitted:
                self.processes.share(network.state_dict().values())
            self._unfitted.clear()
        found = pool.ranges()
        pairs = np.array([(*pair, *self.ranges.get(name, pair)) for name, pair in found.items()])
        lows, highs = self.processes.extremes(pairs.min(axis=1), pairs.max(axis=1))
        self.ranges = {name: (float(low), float(high)) for name, low, high in zip(found, lows, highs, strict=True)}

    def _update(self, pool: Samples, rows: NDArray[np.int64]) -> float:
        """One step on `rows` of this process's part of the pool; the loss over the batch."""
        stencil, aux, label = (torch.from_numpy(v[rows]).to(self.device) for v in (pool.stencil, pool.aux, pool.label))
        rate = self.learning_rate()
        with torch.set_grad_enabled(not self.config.frozen):
            prediction = self.learner.predict(stencil, aux)
        value = 0.0
        if not self.config.frozen:
            value = self._descend(self.learner, prediction, label, rate)
        if self.companion is not None:
            target = torch.lerp(label, prediction.detach(), self.config.companion_mix)
            companion_value = self._descend(self.companion, self.companion.predict(stencil, aux), target, rate)
            value = companion_value if self.config.frozen else value
        self.step += 1
        return value

    def _descend(self, learner: Learner, prediction: Tensor, target: Tensor, rate: float) -> float:
        """Step the weights that `prediction` comes from toward `target`."""
        # This process's share of the mean over the batch; none of its rows may be in it.
        part = len(target) / self.config.batch
        loss = part * relative_squared_error(prediction, target, self.config.power) if len(target) else prediction.sum()
        learner.backward(loss)
        value = self.processes.sum_gradients(learner.network, loss)
        if not math.isfinite(value):
            raise InputError(
                f"{self.run.path}: the loss became {value} at step {self.step}; lower learning_rate (now {self.config.learning_rate:g}) "
                "in its config.json and resume from the last checkpoint, or start over"
            )
        learner.update(rate)
        return value

    def validate(self) -> None:
        """Figures of the averaged weights on the validation clouds: logged, and drawn."""
        if self.processes.writes:
            if self.valid is None:
                self.valid = self.valid_source.every_shard(self.config.valid_queries)
            valid = self.valid
            prediction = predict(self.learner.averaged(), valid.stencil, valid.aux)
            clouds = energy_by_cloud(prediction, valid.label, valid.shard)
            entry: dict[str, Any] = {
                "kind": "valid",
                "step": self.step,
                "elapsed": self.elapsed,
                "figures": self._figures(prediction, valid, "validation"),
                "clouds": {str(n): {"family": self.families[n], "energy": e, "error": s} for n, (e, s) in clouds.items()},
            }
            write_predicted_plot(self.run.picture, prediction, valid.label, f"{self.run.path.name}, step {self.step}")
            if self.companion is not None:
                prediction = predict(self.companion.averaged(), valid.stencil, valid.aux)
                entry["companion"] = self._figures(prediction, valid, "companion")
            self.patience.take(entry["companion" if self.config.frozen else "figures"]["all"])
            self._log(entry)
        self._lap("validating")

    def _figures(self, prediction: NDArray[np.float32], valid: Samples, title: str) -> dict[str, dict[str, float]]:
        found = figures_by_family(prediction, valid.label, valid.error, valid.shard, self.families)
        a: Figures = found["all"]
        log.info(
            "step %d: %s rRMSE %.1f %% [%.1f, %.1f], energy %+.1f %% [%+.1f, %+.1f]",
            self.step,
            title,
            *(100 * v for v in (a.rrmse, a.rrmse_low, a.rrmse_high, a.energy, a.energy_low, a.energy_high)),
        )
        return {name: f.as_dict() for name, f in found.items()}

    def _report(self, losses: list[float], quiet: bool) -> None:
        rates = self.pace.report()
        loss = float(np.mean(losses))
        if self.processes.writes:
            entry = {"loss": loss, "learning_rate": self.learning_rate(), **rates}
            self._log({"kind": "train", "step": self.step, "elapsed": self.elapsed, **entry})
        if not quiet:
            log.info("step %d (%.0f %%): loss %.4f, %s", self.step, 100 * self.progress(), loss, pace_text(rates))

    def _log(self, entry: dict[str, Any]) -> None:
        self.run.log(entry)
        if self.events is not None:
            self.events.write(entry)


@torch.no_grad()
def predict(network: Network, stencil: NDArray[np.float32], aux: NDArray[np.float32]) -> NDArray[np.float32]:
    """Predictions (n,) of many rows, in batches."""
    network.eval()
    device = network.level_mean.device
    result = np.empty(len(aux), np.float32)
    for start in range(0, len(aux), PREDICT_BATCH):
        rows = slice(start, start + PREDICT_BATCH)
        result[rows] = network(torch.from_numpy(stencil[rows]).to(device), torch.from_numpy(aux[rows]).to(device)).cpu().numpy()
    return result
