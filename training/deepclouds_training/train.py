"""`deepclouds train`: fit the network to labelled shards."""

from __future__ import annotations

import argparse
import logging
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from deepclouds.errors import InputError

if TYPE_CHECKING:
    from deepclouds_training.processes import Processes
    from deepclouds_training.trainer import Trainer

log = logging.getLogger(__name__)


def main(argv: Sequence[str], prog: str = "deepclouds train") -> int:
    """Start or resume a run; returns 0 at the end of the schedule, 130 when interrupted (after a checkpoint)."""
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Fit the network to labelled shards. RUN receives the resolved configuration, metrics.jsonl, checkpoint.pt and "
        "predicted.png; Ctrl-C saves a checkpoint, and --resume continues as if nothing had happened. Several processes share the work "
        "when torchrun starts them: torchrun --nproc-per-node 2 -m deepclouds_training.train CONFIG.toml -o RUN",
    )
    parser.add_argument("config", metavar="CONFIG.toml", type=Path, nargs="?", help="the run's settings; with --resume RUN has its own")
    parser.add_argument("-o", "--output", metavar="RUN", type=Path, required=True, help="folder of the run")
    parser.add_argument("--data", metavar="FOLDER", help="data set; overrides the file")
    parser.add_argument("--resume", action="store_true", help="continue the run in RUN from its last checkpoint")
    parser.add_argument("--new-data", action="store_true", help="with --resume: take in shards generated since the run began")
    parser.add_argument("--steps", type=int, help="length of the schedule, optimiser steps; overrides the file")
    parser.add_argument("--minutes", type=float, help="length of the schedule, minutes of training in all; overrides the file")
    parser.add_argument(
        "--threads", type=int, help="threads of the optimiser (default: all processors, shared by this machine's processes)"
    )
    parser.add_argument("--seed", type=int, help="root of the random streams; overrides the file")
    options = parser.parse_args(argv)
    if options.threads is not None and options.threads < 1:
        raise InputError(f"--threads {options.threads}: at least one thread is needed")
    if options.new_data and not options.resume:
        raise InputError("--new-data goes with --resume; a new run takes every shard anyway")

    from deepclouds_training.processes import Processes

    with Processes() as processes:
        return _train(options, prog, processes)


def _train(options: argparse.Namespace, prog: str, processes: Processes) -> int:
    import torch

    from deepclouds_training.pace import pace_text
    from deepclouds_training.run_folder import RunFolder
    from deepclouds_training.shards import open_dataset
    from deepclouds_training.train_config import checked, read_config
    from deepclouds_training.trainer import Trainer

    torch.set_num_threads(options.threads or max(1, (os.cpu_count() or 1) // processes.local_count))
    if processes.local_count > 1:
        import drjit

        drjit.set_thread_count(torch.get_num_threads())
    if not processes.writes:
        # What all of them have to say is said once.
        logging.getLogger("deepclouds_training").setLevel(logging.WARNING)
    run = RunFolder(options.output)
    overrides = {"data": options.data, "steps": options.steps, "minutes": options.minutes, "seed": options.seed}
    if options.resume:
        if options.config is not None or options.seed is not None:
            raise InputError(f"--resume takes the configuration and the seed from {options.output}; leave CONFIG.toml and --seed out")
        given = {key: value for key, value in overrides.items() if value is not None}
        config = checked({**run.config().model_dump(), **given}, "command line")
        dataset = open_dataset(config.data)
        if options.new_data and processes.writes:
            run.adopt(dataset)
        processes.wait()
        shards = run.shards(dataset)
        if processes.writes:
            run.save_config(config)
    else:
        if options.config is None:
            raise InputError("name a CONFIG.toml, or continue a run with --resume")
        config = read_config(options.config, overrides)
        dataset = open_dataset(config.data)
        shards = dataset.shards
        run.refuse_existing()
        processes.wait()
    trainer = Trainer(config, run, dataset, shards, processes)
    if not options.resume:
        if processes.writes:
            run.begin(config, dataset)
    else:
        log.info("resuming at step %d" if trainer.resumed else "no checkpoint yet: starting at step %d", trainer.step)
    with _interrupts() as interrupted:
        display = _Bar() if sys.stderr.isatty() and processes.writes else None
        if not trainer.train(lambda: interrupted[0], display):
            log.info("interrupted at step %d; continue with: %s --resume -o %s", trainer.step, prog, options.output)
            return 130
    log.info("%s", pace_text(trainer.pace.rates()))
    if trainer.progress() < 1.0:
        log.info("stopped early: %d validations in a row without a new best", config.patience)
    log.info("done: %d steps in %.1f minutes; next: deepclouds export %s -o model.onnx", trainer.step, trainer.elapsed / 60, options.output)
    return 0


@contextmanager
def _interrupts() -> Iterator[list[bool]]:
    """A flag that SIGINT and SIGTERM raise instead of ending the process, so that the loop can save first."""
    flag = [False]

    def raise_flag(number: int, frame: FrameType | None) -> None:
        flag[0] = True

    before = {number: signal.signal(number, raise_flag) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield flag
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class _Bar:
    """A progress bar on a terminal."""

    def __enter__(self) -> _Bar:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:.0f} %"), TimeElapsedColumn())
        self._progress = Progress(*columns, console=Console(stderr=True))
        self._task = self._progress.add_task("training", total=1.0)
        self._progress.start()
        return self

    def __exit__(self, *_: Any) -> None:
        self._progress.stop()

    def show(self, trainer: Trainer, loss: float) -> None:
        """Move the bar to where `trainer` is."""
        self._progress.update(self._task, completed=trainer.progress(), description=f"step {trainer.step}, loss {loss:.4f}")


if __name__ == "__main__":
    # torchrun starts modules; the command adds logging and exit codes.
    from deepclouds.cli import main as command

    sys.exit(command(["train", *sys.argv[1:]]))
