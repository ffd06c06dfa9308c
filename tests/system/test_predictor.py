"""The predictor: what it refuses, and that it predicts what torch does."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from deepclouds_runtime import predictor
from deepclouds_runtime.predictor import BATCH, RELEASED, Predictor, find_model
from deepclouds_training.export import TOLERANCE, export_network, seeded_samples
from deepclouds_training.network import Network, NetworkConfig
from deepclouds_training.trainer import predict

from deepclouds.errors import InputError
from deepclouds.model import AUX

RANGES = {**{a.name: (0.2, 1.0) for a in AUX}, "tau": (0.2, 1.0)}


@pytest.fixture(scope="module")
def network() -> Network:
    torch.manual_seed(9)
    return Network(NetworkConfig(width=16))


@pytest.fixture(scope="module")
def model(network: Network, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "small.onnx"
    metadata = {"name": "small", "created_by": "test", "ranges": RANGES, "config_hash": "", "dataset_hash": "", "metrics": {}}
    export_network(network, path, metadata, *seeded_samples(100))
    return path


def rewritten(model: Path, target: Path, **properties: str | None) -> onnx.ModelProto:
    """The model with other metadata, ready for more changes; also written to `target`."""
    proto = onnx.load(model)
    kept = {p.key: p.value for p in proto.metadata_props}
    del proto.metadata_props[:]
    changed = {**kept, **{f"deepclouds.{k}": v for k, v in properties.items()}}
    onnx.helper.set_model_props(proto, {k: v for k, v in changed.items() if v is not None})
    onnx.save(proto, target)
    return proto


def test_predictions_are_torchs_for_any_number_of_rows(model: Path, network: Network) -> None:
    stencil, aux = seeded_samples(2 * BATCH + 3, seed=21)
    one = Predictor(model, threads=1)
    j = one.predict(stencil, aux)
    assert j.dtype == np.float32
    np.testing.assert_allclose(j, predict(network, stencil, aux), rtol=TOLERANCE)
    np.testing.assert_allclose(one.predict(stencil[:5], aux[:5]), j[:5], rtol=1e-6)
    np.testing.assert_allclose(Predictor(model, threads=2).predict(stencil, aux), j, rtol=1e-6)
    assert one.predict(stencil[:0], aux[:0]).shape == (0,)


def test_wrong_shapes_and_nan_are_refused(model: Path) -> None:
    stencil, aux = seeded_samples(4)
    one = Predictor(model, threads=1)
    for bad in ((stencil[:3], aux), (stencil[:, :9], aux), (stencil, aux[:, :5])):
        with pytest.raises(ValueError, match="expected"):
            one.predict(*bad)
    for array in (stencil, aux):
        broken = array.copy()
        broken[2].flat[0] = np.nan
        with pytest.raises(ValueError, match="1 of 4 predictions"):
            one.predict(*((broken, aux) if array is stencil else (stencil, broken)))


def test_rows_outside_of_the_training_data_are_counted_by_input(model: Path) -> None:
    aux = np.full((5, 6), 0.5, np.float32)
    one = Predictor(model, threads=1)
    assert set(one.out_of_range(aux).values()) == {0}
    aux[0, 1], aux[1:3, 4], aux[4, 0] = -0.9, 0.1, np.nan
    assert one.out_of_range(aux) == {"gamma": 1, "g1": 1, "g2": 0, "lobe_weight": 0, "albedo": 2, "log1p_tau": 0}


@pytest.mark.parametrize(
    ("properties", "message"),
    [
        ({"contract": "2"}, "contract version '2'"),
        ({"contract": None}, "no deepclouds metadata"),
        ({"aux": '["gamma"]'}, "aux"),
        ({"initialisers_sha256": "0" * 64}, "sha256"),
        ({"ranges": "{}"}, "malformed"),
    ],
)
def test_metadata_that_does_not_fit_is_refused(model: Path, tmp_path: Path, properties: dict[str, str | None], message: str) -> None:
    target = tmp_path / "other.onnx"
    rewritten(model, target, **properties)
    with pytest.raises(InputError, match=message) as caught:
        Predictor(target)
    assert str(target) in str(caught.value)


def test_changed_weights_are_refused(model: Path, tmp_path: Path) -> None:
    proto = rewritten(model, tmp_path / "other.onnx")
    Predictor(tmp_path / "other.onnx", threads=1)
    largest = max(proto.graph.initializer, key=lambda i: len(i.raw_data))
    raw = bytearray(largest.raw_data)
    raw[17] ^= 1
    largest.raw_data = bytes(raw)
    onnx.save(proto, tmp_path / "other.onnx")
    with pytest.raises(InputError, match="the weights' sha256"):
        Predictor(tmp_path / "other.onnx")


def test_other_names_of_inputs_are_refused(model: Path, tmp_path: Path) -> None:
    proto = rewritten(model, tmp_path / "other.onnx")
    for node in proto.graph.node:
        node.input[:] = ["density" if name == "stencil" else name for name in node.input]
    proto.graph.input[0].name = "density"
    onnx.save(proto, tmp_path / "other.onnx")
    with pytest.raises(InputError, match="density"):
        Predictor(tmp_path / "other.onnx")


@pytest.mark.parametrize("keep", [0.0, 0.3, 0.999])
def test_a_file_cut_short_is_refused(model: Path, tmp_path: Path, keep: float) -> None:
    data = model.read_bytes()
    target = tmp_path / "cut.onnx"
    target.write_bytes(data[: int(keep * len(data))])
    with pytest.raises(InputError, match=r"cut\.onnx"):
        Predictor(target)


def test_what_is_no_onnx_file_is_refused(tmp_path: Path) -> None:
    target = tmp_path / "text.onnx"
    target.write_text("not a model, just words")
    with pytest.raises(InputError, match="not an ONNX file"):
        Predictor(target)
    with pytest.raises(InputError, match="no such model file"):
        Predictor(tmp_path / "absent.onnx")
    with pytest.raises(InputError, match="at least one thread"):
        Predictor(target, threads=0)


def test_names_mean_released_models_and_paths_mean_files(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(predictor, "MODELS", model.parent)
    monkeypatch.setattr(predictor, "RELEASED", ("small",))
    assert find_model("small") == find_model(None) == find_model(model) == find_model(str(model)) == model
    with pytest.raises(InputError, match=r"no released model is named 'large'; there are: small"):
        find_model("large")
    with pytest.raises(InputError, match="no such model file"):
        find_model("./small")


@pytest.mark.parametrize("name", RELEASED)
def test_a_released_model_knows_what_it_was_trained_on(name: str) -> None:
    model = Predictor(name)
    assert model.path.stem == model.metadata.name == name
    for phase in ((0.85, 0.0, 1.0), (0.85, -0.3, 0.8), (-0.3, 0.85, 0.2), (0.0, 0.0, 1.0)):
        assert model.outside(phase, (1.0, 0.9), 1000.0) == [], phase
    (said,) = model.outside((0.99, -0.3, 0.8), (1.0,), 100.0)
    assert said.startswith("g1 = 0.99 (trained on -0.")
    (said,) = model.outside((0.85, 0.0, 1.0), (1.0,), 5000.0)
    assert said.startswith("a cloud of 5e+03 mean free paths")
    assert model.metadata.trust is not None


def test_the_accurate_model_is_the_default_and_the_fast_one_is_small() -> None:
    assert Predictor(None).path.stem == "accurate"
    sizes = [sum(np.prod(i.dims) for i in onnx.load(predictor.MODELS / f"{name}.onnx").graph.initializer) for name in RELEASED]
    assert sizes[0] <= 1_500_000
    assert sizes[1] <= 60_000


def test_predicting_never_loads_torch(model: Path) -> None:
    code = (
        "import sys, numpy as np\n"
        "from deepclouds_runtime.predictor import Predictor\n"
        "p = Predictor(sys.argv[1], threads=1)\n"
        "p.predict(np.zeros((1, 10, 225), np.float32), np.zeros((1, 6), np.float32))\n"
        "assert 'torch' not in sys.modules and 'deepclouds_training' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code, str(model)], check=True)
