"""Training runs: resumed equals uninterrupted, interrupted runs save, bad input is refused."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from deepclouds_training.average import WeightAverage
from deepclouds_training.network import Network, NetworkConfig
from deepclouds_training.run_folder import RunFolder
from deepclouds_training.shards import open_dataset
from deepclouds_training.train import main
from deepclouds_training.trainer import Trainer

from deepclouds.errors import InputError
from tests.system.small_run import settings, trainer


def after(steps: int, one: Trainer) -> Callable[[], bool]:
    return lambda: one.step >= steps


def same(a: object, b: object) -> bool:
    if isinstance(a, torch.Tensor):
        return isinstance(b, torch.Tensor) and torch.equal(a, b)
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list | tuple):
        return isinstance(b, list | tuple) and len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return a == b


@pytest.mark.parametrize(
    "parts",
    [
        pytest.param({}, id="plain"),
        pytest.param({"companion": {"width": 8}, "patience": 5, "tensorboard": True, "precision": "bfloat16"}, id="companion"),
    ],
)
@pytest.mark.parametrize("passes", [1, 2])
def test_two_steps_and_two_more_equal_four(small_dataset: Path, tmp_path: Path, passes: int, parts: dict[str, object]) -> None:
    """Rationale: a run that was killed must be worth as much as one that was not.

    Expected behaviour: weights, averages, optimisers, patience, ranges and logged validation agree bit for bit.
    """
    config = settings(small_dataset, samples={"shards": 3, "queries": 16, "passes": passes}, **parts)
    whole = trainer(tmp_path / "whole", config)
    assert whole.train(lambda: False)
    first = trainer(tmp_path / "halves", config)
    assert not first.train(after(2, first))
    assert first.step == 2
    second = trainer(tmp_path / "halves", config)
    assert second.resumed
    assert second.train(lambda: False)
    states = [RunFolder(tmp_path / name).load_checkpoint() for name in ("whole", "halves")]
    for state in states:
        assert state is not None
        assert state.pop("elapsed") > 0
    assert same(states[0], states[1])
    assert ("companion" in (states[0] or {})) == ("companion" in parts)
    valid = [
        [(e["figures"], e.get("companion")) for e in RunFolder(tmp_path / n).metrics() if e["kind"] == "valid"] for n in ("whole", "halves")
    ]
    assert valid[0] == valid[1]
    assert len(valid[0]) == 2


def test_a_run_says_everything_about_itself(small_dataset: Path, tmp_path: Path) -> None:
    config = tmp_path / "run.toml"
    config.write_text(f'data = "{small_dataset}"\nsteps = 9\nbatch = 16\n[network]\nwidth = 8\n[samples]\nshards = 2\nqueries = 16\n')
    run = tmp_path / "run"
    assert main([str(config), "-o", str(run), "--steps", "2", "--threads", "1"], "train") == 0
    saved = json.loads((run / "config.json").read_text())
    assert saved["config"]["steps"] == 2, "a flag overrides the file"
    assert saved["config"]["network"]["width"] == 8
    assert saved["hash"] == RunFolder(run).config().hash
    assert json.loads((run / "environment.json").read_text())["packages"]["torch"]
    entries = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert {e["kind"] for e in entries} == {"train", "valid"}
    assert set(entries[-1]["figures"]) == {"all", "ring"} or set(entries[0]["figures"]) == {"all", "ring"}
    assert (run / "predicted.png").read_bytes().startswith(b"\x89PNG")
    assert not [p for p in run.iterdir() if p.name.startswith(".")], "no temporary files are left"
    with pytest.raises(InputError, match="holds a run already"):
        main([str(config), "-o", str(run)], "train")
    assert main(["-o", str(run), "--resume", "--steps", "3"], "train") == 0
    state = RunFolder(run).load_checkpoint()
    assert state is not None
    assert state["step"] == 3


def test_a_run_can_set_out_from_the_averaged_weights_of_another(small_dataset: Path, tmp_path: Path) -> None:
    first = trainer(tmp_path / "first", settings(small_dataset))
    assert first.train(lambda: False)
    expected = first.learner.averaged().state_dict()
    second = trainer(tmp_path / "second", settings(small_dataset, start=str(tmp_path / "first"), seed=5))
    assert all(torch.equal(value, second.network.state_dict()[name]) for name, value in expected.items())
    assert second.step == 0
    before = second.network.level_mean.clone()
    assert second.train(after(1, second)) is False
    # The standardisation belongs to the weights: it is not fitted again.
    assert torch.equal(before, second.network.level_mean)
    with pytest.raises(InputError, match="its network is another"):
        trainer(tmp_path / "third", settings(small_dataset, start=str(tmp_path / "first"), network={"width": 16}))
    with pytest.raises(InputError, match="holds no checkpoint"):
        trainer(tmp_path / "fourth", settings(small_dataset, start=str(tmp_path / "nothing")))


def test_sigterm_saves_and_exits_130(small_dataset: Path, tmp_path: Path, root: Path) -> None:
    config = tmp_path / "run.toml"
    config.write_text(f'data = "{small_dataset}"\nsteps = 1000000\nbatch = 16\n[network]\nwidth = 8\n[samples]\nshards = 2\nqueries = 16\n')
    run = tmp_path / "run"
    command = "import sys; from deepclouds_training.train import main; sys.exit(main(sys.argv[1:]))"
    path = os.pathsep.join([str(root), str(root / "training"), os.environ.get("PYTHONPATH", "")])
    process = subprocess.Popen(
        [sys.executable, "-c", command, str(config), "-o", str(run), "--threads", "1"], env={**os.environ, "PYTHONPATH": path}
    )
    try:
        deadline = time.monotonic() + 120
        while not (run / "config.json").exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        assert process.poll() is None, "the run ended by itself"
        time.sleep(2)
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=60) == 130
    finally:
        process.kill()
        process.wait()
    assert RunFolder(run).load_checkpoint() is not None


def test_nan_is_refused_with_the_step(small_dataset: Path, tmp_path: Path) -> None:
    one = trainer(tmp_path / "run", settings(small_dataset))
    with torch.no_grad():
        one.network.fc_1.bias.fill_(float("nan"))
    with pytest.raises(InputError, match="loss became nan at step 0"):
        one.train(lambda: False)


def test_grown_data_set_is_taken_in_only_on_request(small_dataset: Path, tmp_path: Path) -> None:
    dataset = open_dataset(small_dataset)
    run = RunFolder(tmp_path)
    fewer = type(dataset)(dataset.folder, dataset.manifest, dataset.shards[1:])
    run.begin(settings(small_dataset), fewer)
    assert run.shards(dataset) == fewer.shards
    with pytest.raises(InputError, match="have changed"):
        run.shards(type(dataset)(dataset.folder, dataset.manifest, dataset.shards[2:]))
    run.adopt(dataset)
    assert run.shards(dataset) == dataset.shards
    assert run.data_hash == dataset.hash


def test_schedule_follows_steps_or_minutes(small_dataset: Path, tmp_path: Path) -> None:
    one = trainer(tmp_path / "run", settings(small_dataset, steps=100, warmup=10, learning_rate=1e-2, final_learning_rate=1e-4))
    rates = []
    for step in range(101):
        one.step = step
        rates.append(one.learning_rate())
    assert rates[0] == pytest.approx(1e-3, rel=1e-2)
    assert int(np.argmax(rates)) in (9, 10)
    assert rates[100] == pytest.approx(1e-4)
    assert all(a > b for a, b in pairwise(rates[10:]))
    one.config = settings(small_dataset, minutes=2.0)
    one.elapsed = 60.0
    assert one.progress() == pytest.approx(0.5)


def test_a_run_ends_when_patience_does(small_dataset: Path, tmp_path: Path) -> None:
    """A network that cannot move has its best validation at the first; two more without a better one end the run, also when resumed."""
    still = settings(small_dataset, steps=50, valid_every=1, patience=2, learning_rate=1e-30, final_learning_rate=0, ema=0)
    one = trainer(tmp_path / "run", still)
    assert one.train(lambda: False)
    assert one.step == 3
    assert one.progress() < 1.0
    again = trainer(tmp_path / "run", still)
    assert again.train(lambda: False)
    assert again.step == 3
    without = trainer(
        tmp_path / "without", settings(small_dataset, steps=5, valid_every=1, learning_rate=1e-30, final_learning_rate=0, ema=0)
    )
    assert without.train(lambda: False)
    assert without.step == 5


def test_both_rates_are_reported(small_dataset: Path, tmp_path: Path) -> None:
    """Two pools of 48 samples, each gone through twice in three batches: stencils are built once a pool, samples stepped twice."""
    one = trainer(tmp_path / "run", settings(small_dataset, steps=12, samples={"shards": 3, "queries": 16, "passes": 2}))
    built: list[int] = []
    stepped: list[int] = []
    lap = one.pace.lap

    def spy(phase: str, stencils: int = 0, samples: int = 0) -> float:
        built.append(stencils)
        stepped.append(samples)
        return lap(phase, stencils, samples)

    one.pace.lap = spy  # type: ignore[method-assign]
    assert one.train(lambda: False)
    assert (sum(built), sum(stepped)) == (96, 192)
    entry = next(e for e in RunFolder(tmp_path / "run").metrics() if e["kind"] == "train")
    assert 0 < entry["building_share"] < 1
    assert entry["stencils_built_per_second"] > 0
    assert entry["samples_stepped_per_second"] > entry["samples_per_second"] > 0


def test_events_hold_the_metrics(small_dataset: Path, tmp_path: Path) -> None:
    """Every figure of metrics.jsonl is found again in TensorBoard's files, those of a resumed run as well."""
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator  # type: ignore[import-untyped]

    config = settings(small_dataset, tensorboard=True, valid_every=1)
    first = trainer(tmp_path / "run", config)
    assert not first.train(after(2, first))
    assert trainer(tmp_path / "run", config).train(lambda: False)
    run = RunFolder(tmp_path / "run")
    read = EventAccumulator(str(run.events)).Reload()
    expected = {e["step"]: e["figures"]["all"]["energy"] for e in run.metrics() if e["kind"] == "valid"}
    assert list(expected) == [1, 2, 3, 4]
    found = {e.step: e.value for e in read.Scalars("valid/figures/all/energy")}
    assert found == pytest.approx(expected, rel=1e-6)
    assert {"train/loss", "train/learning_rate", "train/samples_per_second"} <= set(read.Tags()["scalars"])


def test_average_is_the_mean_without_a_start_at_zero() -> None:
    network = Network(NetworkConfig(width=8))
    average = WeightAverage(network, 0.9)
    values, weights = [], []
    for i in range(6):
        with torch.no_grad():
            network.head.bias.fill_(float(i**2))
        average.update()
        values.append(float(i**2))
        weights.append(0.9 ** (5 - i))
    assert float(average.averaged(network).head.bias.detach()) == pytest.approx(np.average(values, weights=weights), rel=1e-5)
    assert float(network.head.bias.detach()) == 25.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("stepz = 3", "stepz"),
        ("[network]\nwidht = 8", r"network\.widht"),
        ("steps = 0", "steps"),
        ("steps = ", "TOML"),
        ("batch = 100000000", "batch"),
        ("frozen = true", "frozen trains a companion alone"),
        ("companion_mix = 2", "companion_mix"),
        ("[companion]\nwidht = 8", r"companion\.widht"),
        ("patience = 0", "patience"),
        ('device = "tpu"', "device"),
    ],
)
def test_bad_configuration_is_refused(tmp_path: Path, text: str, message: str) -> None:
    config = tmp_path / "bad.toml"
    config.write_text(f'data = "nowhere"\n{text}\n' if "TOML" not in message else text)
    with pytest.raises(InputError, match=message) as caught:
        main([str(config), "-o", str(tmp_path / "run")], "train")
    assert "bad.toml" in str(caught.value)
    assert not (tmp_path / "run").exists()


def test_missing_things_are_named(tmp_path: Path, small_dataset: Path) -> None:
    with pytest.raises(InputError, match=r"absent\.toml"):
        main([str(tmp_path / "absent.toml"), "-o", str(tmp_path / "run")], "train")
    with pytest.raises(InputError, match="not the folder of a training run"):
        main(["-o", str(tmp_path / "run"), "--resume"], "train")
    with pytest.raises(InputError, match="--resume"):
        main(["-o", str(tmp_path / "run")], "train")
    trainer(tmp_path / "damaged", settings(small_dataset))
    (tmp_path / "damaged" / "checkpoint.pt").write_bytes(b"half a checkpoint")
    with pytest.raises(InputError, match=r"checkpoint\.pt"):
        main(["-o", str(tmp_path / "damaged"), "--resume"], "train")


def test_a_line_that_was_cut_short_is_no_metric(tmp_path: Path) -> None:
    """As a full disk leaves it; a damaged line amid others is said."""
    run = RunFolder(tmp_path)
    run.log({"step": 1})
    run.log({"step": 2})
    path = tmp_path / "metrics.jsonl"
    path.write_text(path.read_text() + '{"step": 3, "fig')
    assert [e["step"] for e in run.metrics()] == [1, 2]
    run.forget_after(1)
    assert path.read_text() == '{"step": 1}\n'
    path.write_text('{"step": 1}\n{"ste\n{"step": 3}\n')
    with pytest.raises(InputError, match="line 2: no valid JSON"):
        run.metrics()
    path.unlink()
    path.symlink_to("/dev/full")
    with pytest.raises(InputError, match="cannot be written"):
        run.log({"step": 1})
