"""Export: one file that onnxruntime runs as torch does, with its metadata, or no file at all."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from deepclouds_runtime.predictor import MODELS, RELEASED, Predictor
from deepclouds_training import export
from deepclouds_training.network import Network, NetworkConfig
from deepclouds_training.run_folder import RunFolder
from deepclouds_training.shards import open_dataset, read_shard
from deepclouds_training.train import main as train
from deepclouds_training.trainer import predict

from deepclouds.errors import InputError
from deepclouds.model import AUX, INPUT_AUX, INPUT_STENCIL, OUTPUT

# What every runtime that reads ONNX offers: nothing with control flow, and no five-dimensional sampling.
BASIC = {
    *("Abs", "Add", "Clip", "Cos", "Div", "Exp", "Gemm", "Less", "Log", "MatMul", "Mul", "Neg", "Relu", "Sin", "Sqrt", "Sub", "Where"),
    *("Concat", "Expand", "Gather", "Reshape", "Shape", "Slice", "Split", "Squeeze"),
}


@pytest.fixture(scope="module")
def run(small_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two steps."""
    folder = tmp_path_factory.mktemp("export")
    config = folder / "run.toml"
    config.write_text(f'data = "{small_dataset}"\nsteps = 2\nbatch = 16\n[network]\nwidth = 8\n[samples]\nshards = 2\nqueries = 16\n')
    assert train([str(config), "-o", str(folder / "run"), "--threads", "1"], "train") == 0
    return folder / "run"


@pytest.fixture(scope="module")
def exported(run: Path) -> Path:
    target = run.parent / "model.onnx"
    assert export.main([str(run), "-o", str(target), "--name", "trial"], "export") == 0
    return target


def test_file_stands_alone_and_uses_basic_operations(exported: Path) -> None:
    assert sorted(p.name for p in exported.parent.iterdir()) == ["model.onnx", "run", "run.toml"]
    model = onnx.load(exported, load_external_data=False)
    assert not [i.name for i in model.graph.initializer if i.data_location == onnx.TensorProto.EXTERNAL]
    assert [(o.domain, o.version) for o in model.opset_import] == [("", export.OPSET)]
    assert {n.op_type for n in model.graph.node} <= BASIC
    shapes = {v.name: [d.dim_param or d.dim_value for d in v.type.tensor_type.shape.dim] for v in (*model.graph.input, *model.graph.output)}
    batch = shapes[OUTPUT][0]
    assert isinstance(batch, str), "the batch is dynamic"
    assert shapes == {INPUT_STENCIL: [batch, 10, 225], INPUT_AUX: [batch, 6], OUTPUT: [batch]}


def test_metadata_tells_where_the_model_comes_from(exported: Path, run: Path, small_dataset: Path) -> None:
    metadata = Predictor(exported, threads=1).metadata
    assert metadata.name == "trial"
    assert metadata.config_hash == RunFolder(run).config().hash
    assert metadata.dataset_hash == open_dataset(small_dataset).hash
    assert metadata.metrics["step"] == 2
    assert np.isfinite(metadata.metrics["all.rrmse"])
    weights = np.concatenate([read_shard(small_dataset / s.file)[0].phase[:, 2] for s in open_dataset(small_dataset).shards])
    low, high = metadata.ranges["lobe_weight"]
    assert weights.min() <= low < high <= weights.max()
    assert 0 <= metadata.ranges["gamma"][0] < metadata.ranges["gamma"][1] <= np.float32(np.pi)
    assert metadata.ranges["tau"][1] == pytest.approx(np.expm1(metadata.ranges["log1p_tau"][1]), rel=1e-5)


@pytest.mark.parametrize("raw", [False, True])
def test_averaged_and_raw_weights_are_different_files(run: Path, tmp_path: Path, raw: bool) -> None:
    target = tmp_path / "m.onnx"
    assert export.main([str(run), "-o", str(target), "--raw" if raw else "--ema"], "export") == 0
    state = RunFolder(run).load_checkpoint()
    assert state is not None
    network = Network(RunFolder(run).config().network)
    network.load_state_dict(state["network"])
    stencil, aux = export.seeded_samples(64, seed=8)
    equal = np.allclose(Predictor(target, threads=1).predict(stencil, aux), predict(network, stencil, aux), rtol=export.TOLERANCE)
    assert equal == raw


@pytest.mark.parametrize(
    "shape",
    [
        {"order": "coarse_first", "compression": "log"},
        {"order": "fine_first", "compression": "root"},
        {"symmetric": True, "head": "octaves", "scale": "density", "compression": "root"},
        {"channels": 16, "together": 2, "head": "octaves", "scale": "density", "compression": "root"},
        {"channels": 8, "levels": (0, 3, 7, 9)},
    ],
    ids=str,
)
def test_graph_is_the_network_for_every_batch_size(shape: dict[str, Any]) -> None:
    torch.manual_seed(5)
    network = Network(NetworkConfig(width=24, **shape))
    stencil, aux = export.seeded_samples(1000, seed=4)
    network.fit_inputs(stencil, np.ones(8, np.float32))
    session = onnxruntime.InferenceSession(export.to_onnx(network).SerializeToString(), providers=["CPUExecutionProvider"])
    expected = predict(network, stencil, aux)
    assert expected.std() > 0.01 * expected.mean(), "the samples must tell networks apart"
    for n in (1, 2, 7, 1000):
        got = session.run([OUTPUT], {INPUT_STENCIL: stencil[:n], INPUT_AUX: aux[:n]})[0]
        assert got.shape == (n,)
        np.testing.assert_allclose(got, expected[:n], rtol=export.TOLERANCE)


def test_a_file_that_disagrees_is_not_written(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    to_onnx = export.to_onnx

    def other_weights(network: Network) -> Any:
        with torch.no_grad():
            changed = Network(network.config)
            changed.load_state_dict(network.state_dict())
            changed.head.bias.add_(1e-3)
        return to_onnx(changed)

    monkeypatch.setattr(export, "to_onnx", other_weights)
    with pytest.raises(InputError, match="differs from torch"):
        export.main([str(run), "-o", str(tmp_path / "m.onnx")], "export")
    assert not list(tmp_path.iterdir())


def test_bad_targets_and_runs_are_refused(run: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"ends in \.onnx"):
        export.main([str(run), "-o", str(tmp_path / "m.bin")], "export")
    with pytest.raises(InputError, match="does not exist"):
        export.main([str(run), "-o", str(tmp_path / "nowhere" / "m.onnx")], "export")
    with pytest.raises(InputError, match="not the folder of a training run"):
        export.main([str(tmp_path), "-o", str(tmp_path / "m.onnx")], "export")


def test_seeded_samples_cover_the_contract() -> None:
    stencil, aux = export.seeded_samples(500)
    assert stencil.shape == (500, 10, 225)
    assert aux.shape == (500, len(AUX))
    assert stencil.min() == 0
    assert stencil.max() > 5
    assert hashlib.sha256(stencil.tobytes()).digest() == hashlib.sha256(export.seeded_samples(500)[0].tobytes()).digest()
    assert np.count_nonzero(aux[:, 0] == 0) > 50
    assert 150 < np.count_nonzero(aux[:, 3] == 1) < 350


def test_no_weight_makes_subnormal_numbers() -> None:
    torch.manual_seed(6)
    network = Network(NetworkConfig(width=24))
    with torch.no_grad():
        for weights in network.parameters():
            if weights.ndim == 2:
                weights[:, 0] = 1e-39
    files = [export.to_onnx(network), *(onnx.load(str(MODELS / f"{name}.onnx")) for name in RELEASED)]
    for model in files:
        for initialiser in model.graph.initializer:
            values = np.abs(onnx.numpy_helper.to_array(initialiser).astype(np.float64))
            assert not np.any((values > 0) & (values < 1e-30)), initialiser.name
    stencil, aux = export.seeded_samples(64, seed=8)
    assert export.parity(network, files[0].SerializeToString(), stencil, aux) < export.TOLERANCE
