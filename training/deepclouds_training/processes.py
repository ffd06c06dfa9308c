"""Processes that train one model together: what they add up, and what they agree on."""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterable
from typing import Self

import numpy as np
import torch
import torch.distributed as dist
from numpy.typing import NDArray
from torch import Tensor, nn

from deepclouds.errors import InputError


class Processes:
    """The processes that torchrun started, or the one there is: a context in which they are connected.

    Every one of them holds all weights and builds its own part of each pool of samples; a batch is the batch that one process would
    take, each row handled by the process that holds it. Gradients are sums over all rows, so the model is that of one process up to the
    order in which floats are added.

    Attributes
    ----------
    rank, count
        number of this process, from 0, and how many there are. Process 0 alone writes files.
    local_rank, local_count
        the same among the processes of this machine.
    """

    def __init__(self) -> None:
        self.rank, self.count = (int(os.environ.get(name, default)) for name, default in (("RANK", "0"), ("WORLD_SIZE", "1")))
        self.local_rank, self.local_count = (
            int(os.environ.get(name, default)) for name, default in (("LOCAL_RANK", "0"), ("LOCAL_WORLD_SIZE", "1"))
        )

    def __enter__(self) -> Self:
        if self.count > 1:
            # Adam imports this module, whose defaults keep the group that there is by then: its threads would outlive `__exit__`, and
            # one that still frees a tensor when the interpreter ends aborts the process.
            importlib.import_module("torch.distributed.nn.functional")
            # What is agreed on lies in main memory, gradients where the weights are.
            dist.init_process_group("cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo")
        return self

    def __exit__(self, *_: object) -> None:
        if self.count > 1:
            dist.destroy_process_group()

    @property
    def writes(self) -> bool:
        """Whether this process writes the run's files."""
        return self.rank == 0

    def require_equal_parts(self, shards: int, batch: int) -> None:
        """Raise InputError where a pool of `shards` shards, or a `batch`, cannot be shared evenly."""
        for name, number in (("samples.shards", shards), ("batch", batch)):
            if number % self.count:
                raise InputError(f"{name} {number} cannot be shared by {self.count} processes; make it a multiple, or start fewer of them")

    def wait(self) -> None:
        """Until every process has come here."""
        if self.count > 1:
            dist.barrier()

    def sum_gradients(self, network: nn.Module, loss: Tensor) -> float:
        """Add up every process's gradients, and its part of the loss, which is returned."""
        if self.count == 1:
            return float(loss.detach())
        parameters = [p for p in network.parameters()]
        parts = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
        flat = torch.cat([*(g.reshape(-1) for g in parts), loss.detach().reshape(1)])
        dist.all_reduce(flat)
        for p, g in zip(parameters, torch.split(flat[:-1], [p.numel() for p in parameters]), strict=True):
            p.grad = g.view_as(p)
        return float(flat[-1])

    def agree(self, elapsed: float, interrupted: bool, finished: bool) -> tuple[float, bool, bool]:
        """Process 0's `elapsed` and `finished`, and whether any process was `interrupted`: all take the same turn at every step."""
        if self.count == 1:
            return elapsed, interrupted, finished
        first = self.rank == 0
        values = torch.tensor([elapsed if first else 0.0, float(interrupted), float(finished and first)], dtype=torch.float64)
        dist.all_reduce(values)
        return float(values[0]), bool(values[1]), bool(values[2])

    def share(self, values: Iterable[Tensor]) -> None:
        """Give every process the tensors of process 0."""
        if self.count > 1:
            for value in values:
                dist.broadcast(value, 0)

    def extremes(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Smallest `low` and largest `high` over all processes, element by element."""
        if self.count == 1:
            return low, high
        both = torch.from_numpy(np.concatenate([-low, high]))
        dist.all_reduce(both, dist.ReduceOp.MAX)
        return -both[: len(low)].numpy(), both[len(low) :].numpy()
