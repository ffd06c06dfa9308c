"""Two processes that share each batch give the model of one."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from deepclouds_training.run_folder import RunFolder
from deepclouds_training.train import main
from deepclouds_training.train_config import TrainConfig

from deepclouds.errors import InputError
from tests.system.small_run import settings


def config_file(folder: Path, config: TrainConfig) -> Path:
    path = folder / "run.toml"
    assert config.companion is not None
    path.write_text(
        f'data = "{config.data}"\nsteps = {config.steps}\nbatch = {config.batch}\nwarmup = 2\nvalid_queries = 16\nvalid_every = 3\n'
        f"[network]\nwidth = {config.network.width}\n[companion]\nwidth = {config.companion.width}\n"
        f"[samples]\nshards = {config.samples.shards}\nqueries = {config.samples.queries}\n"
    )
    return path


def by_two(root: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([str(root), str(root / "training"), os.environ.get("PYTHONPATH", "")])
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "deepclouds_training.train"]
    return subprocess.run(
        [*launcher, *arguments, "--threads", "1"],
        env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


def state_of(folder: Path) -> dict[str, Any]:
    state = RunFolder(folder).load_checkpoint()
    assert state is not None
    return state


def test_two_processes_give_the_model_of_one(small_dataset: Path, tmp_path: Path, root: Path) -> None:
    """Rationale: more processes must change the time that a model takes, not the model.

    Expected behaviour: after one step Adam's first moments, a tenth of the gradient, agree to 1e-5 of the largest: two sums of about
    eight float32 terms against one of sixteen. Adam divides a gradient by its own size, so where the terms cancel and nothing but
    rounding is left the steps that follow differ; after a pool and a half, resumed once, the loss and every validation agree to 0.2 %.
    """
    one, two = tmp_path / "one", tmp_path / "two"
    config = config_file(tmp_path, settings(small_dataset, steps=1, companion={"width": 8}, samples={"shards": 4, "queries": 16}))
    assert main([str(config), "-o", str(one), "--threads", "1"], "train") == 0
    done = by_two(root, str(config), "-o", str(two))
    assert done.returncode == 0, done.stderr
    expected, found = (state_of(folder) for folder in (one, two))
    assert expected["ranges"] == found["ranges"]
    for a, b in ((expected, found), (expected["companion"], found["companion"])):
        moments = [torch.cat([v["exp_avg"].flatten() for v in s["optimiser"]["state"].values()]) for s in (a, b)]
        torch.testing.assert_close(moments[1], moments[0], rtol=0, atol=1e-5 * float(moments[0].abs().max()))
    assert main(["-o", str(one), "--resume", "--steps", "6", "--threads", "1"], "train") == 0
    done = by_two(root, "-o", str(two), "--resume", "--steps", "6")
    assert done.returncode == 0, done.stderr
    assert sorted(p.name for p in two.iterdir()) == sorted(p.name for p in one.iterdir())
    entries = [RunFolder(folder).metrics() for folder in (one, two)]
    assert [(e["kind"], e["step"]) for e in entries[0]] == [(e["kind"], e["step"]) for e in entries[1]]
    for pair in zip(*entries, strict=True):
        figures = [[e["figures"]["all"], e["companion"]["all"]] if e["kind"] == "valid" else [{"loss": e["loss"]}] for e in pair]
        for of_one, of_two in zip(*figures, strict=True):
            assert of_two == pytest.approx(of_one, rel=2e-3, abs=2e-3)


@pytest.mark.parametrize(("shards", "batch", "named"), [(3, 16, "samples.shards 3"), (4, 15, "batch 15")])
def test_what_cannot_be_shared_is_refused(
    small_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shards: int, batch: int, named: str
) -> None:
    from deepclouds_training.processes import Processes
    from deepclouds_training.shards import open_dataset
    from deepclouds_training.trainer import Trainer

    monkeypatch.setenv("WORLD_SIZE", "2")
    dataset = open_dataset(small_dataset)
    config = settings(small_dataset, batch=batch, samples={"shards": shards, "queries": 16})
    with pytest.raises(InputError, match=f"{named} cannot be shared by 2 processes"):
        Trainer(config, RunFolder(tmp_path), dataset, dataset.shards, Processes())


def test_a_process_may_have_no_row_of_a_batch(small_dataset: Path) -> None:
    """Rows fall to processes by chance; none at all must give a gradient of zero, not one of 0 / 0."""
    from deepclouds_training.learner import Learner
    from deepclouds_training.network import NetworkConfig

    for half in (False, True):
        learner = Learner(NetworkConfig(width=8), 0.9, half, torch.device("cpu"))
        stencil, aux = torch.zeros(0, 10, 225), torch.zeros(0, 6)
        learner.backward(learner.predict(stencil, aux).sum())
        gradients = [p.grad for p in learner.network.parameters()]
        assert all(g is not None and np.all(g.numpy() == 0) for g in gradients)
