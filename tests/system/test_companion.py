"""A companion: a small network that learns beside a large one, or from a finished one."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from deepclouds_runtime.predictor import Predictor
from deepclouds_training import export
from deepclouds_training.learner import averaged_network
from deepclouds_training.run_folder import RunFolder
from deepclouds_training.trainer import predict

from deepclouds.errors import InputError
from tests.system.small_run import settings, trainer

SMALL = {"width": 9}


@pytest.fixture(scope="module")
def run(small_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four steps with a companion."""
    folder = tmp_path_factory.mktemp("companion") / "run"
    assert trainer(folder, settings(small_dataset, companion=SMALL)).train(lambda: False)
    return folder


def test_the_large_network_does_not_notice(small_dataset: Path, run: Path, tmp_path: Path) -> None:
    """Its weights, averages and optimiser are to the bit those of a run without a companion."""
    assert trainer(tmp_path / "alone", settings(small_dataset)).train(lambda: False)
    alone, beside = (RunFolder(folder).load_checkpoint() for folder in (tmp_path / "alone", run))
    assert alone is not None
    assert beside is not None
    assert all(torch.equal(value, beside["network"][name]) for name, value in alone["network"].items())
    assert all(torch.equal(a, b) for a, b in zip(alone["average"]["sums"], beside["average"]["sums"], strict=True))
    entry = next(e for e in RunFolder(run).metrics() if e["kind"] == "valid")
    assert entry["companion"].keys() == entry["figures"].keys()
    assert entry["companion"]["all"] != entry["figures"]["all"]


def test_one_step_follows_the_mix(small_dataset: Path, tmp_path: Path) -> None:
    """Rationale: the target is the label, the large network's prediction, or what lies between.

    Expected behaviour: the loss is linear in the target where its gradient is taken, so the gradient at mix 0.25 is a quarter of the
    one at 1 and three quarters of the one at 0.
    """
    moments = {}
    for mix in (0.0, 0.25, 1.0):
        one = trainer(tmp_path / str(mix), settings(small_dataset, companion=SMALL, companion_mix=mix, steps=1, power=0))
        assert one.train(lambda: False)
        assert one.companion is not None
        state = one.companion.optimiser.state
        moments[mix] = torch.cat([state[p]["exp_avg"].flatten() for p in one.companion.network.parameters()])
    scale = float(moments[0.0].abs().max())
    assert not torch.allclose(moments[0.0], moments[1.0], atol=1e-2 * scale)
    assert torch.allclose(moments[0.25], 0.75 * moments[0.0] + 0.25 * moments[1.0], atol=1e-5 * scale)


def test_a_finished_run_teaches(small_dataset: Path, run: Path, tmp_path: Path) -> None:
    """The teacher's averaged weights stay as they are; the companion sets out from that of the run where its shape is the same."""
    state = RunFolder(run).load_checkpoint()
    assert state is not None
    config = RunFolder(run).config()
    teacher = averaged_network(config.network, state, config.ema).state_dict()
    for shape in (SMALL, {"width": 10}):
        one = trainer(tmp_path / str(shape["width"]), settings(small_dataset, start=str(run), frozen=True, companion=shape))
        assert one.companion is not None
        assert config.companion is not None
        start = {name: value.clone() for name, value in one.companion.network.state_dict().items()}
        before = averaged_network(config.companion, state["companion"], config.ema).state_dict()
        same = start.keys() == before.keys() and all(torch.equal(start[name], before[name]) for name in start if shape == SMALL)
        assert same
        assert one.train(lambda: False)
        assert all(torch.equal(value, one.network.state_dict()[name]) for name, value in teacher.items())
        assert not torch.equal(start["fc_1.weight"], one.companion.network.fc_1.weight)
        fitted = not torch.equal(start["level_scale"], one.companion.network.level_scale)
        assert fitted == (shape != SMALL), "the standardisation is fitted once"


def test_the_companion_is_exported_as_a_model_of_its_own(run: Path, tmp_path: Path) -> None:
    target = tmp_path / "fast.onnx"
    assert export.main([str(run), "--companion", "-o", str(target)], "export") == 0
    state = RunFolder(run).load_checkpoint()
    assert state is not None
    config = RunFolder(run).config()
    assert config.companion is not None
    network = averaged_network(config.companion, state["companion"], config.ema)
    model = Predictor(target, threads=1)
    stencil, aux = export.seeded_samples(64, seed=8)
    np.testing.assert_allclose(model.predict(stencil, aux), predict(network, stencil, aux), rtol=export.TOLERANCE)
    export.main([str(run), "-o", str(tmp_path / "large.onnx")], "export")
    large = Predictor(tmp_path / "large.onnx", threads=1).metadata
    assert (model.metadata.name, model.metadata.contract, model.metadata.ranges) == ("fast", large.contract, large.ranges)
    assert (model.metadata.config_hash, model.metadata.dataset_hash) == (large.config_hash, large.dataset_hash)
    last = json.loads((run / "metrics.jsonl").read_text().splitlines()[-1])
    assert model.metadata.metrics["all.energy"] == last["companion"]["all"]["energy"]
    assert large.metrics["all.energy"] == last["figures"]["all"]["energy"]


def test_what_there_is_not_cannot_be_exported(small_dataset: Path, tmp_path: Path) -> None:
    assert trainer(tmp_path / "run", settings(small_dataset, steps=1)).train(lambda: False)
    with pytest.raises(InputError, match="trained without a companion"):
        export.main([str(tmp_path / "run"), "--companion", "-o", str(tmp_path / "m.onnx")], "export")
