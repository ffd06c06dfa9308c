"""`deepclouds calibrate`: a model gets to know how far it can be trusted, and computes what it did before."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from deepclouds_runtime.predictor import Predictor
from deepclouds_training import calibrate
from deepclouds_training.export import export_network, seeded_samples
from deepclouds_training.network import Network, NetworkConfig
from deepclouds_training.shards import open_dataset

from deepclouds.errors import InputError
from deepclouds.model import AUX


@pytest.fixture(scope="module")
def model(small_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("calibrate") / "small.onnx"
    metadata = {
        "name": "small",
        "created_by": "test",
        "ranges": {**{a.name: (-1.0, 1.0) for a in AUX}, "tau": (0.0, 1.0)},
        "config_hash": "",
        "dataset_hash": open_dataset(small_dataset).hash,
        "metrics": {},
    }
    export_network(Network(NetworkConfig(width=8)), path, metadata, *seeded_samples(100))
    return path


def test_a_model_gets_to_know_its_errors(model: Path, small_dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "calibrated.onnx"
    arguments = [str(model), "--data", str(small_dataset), "--labels", str(small_dataset), "-o", str(target)]
    assert calibrate.main([*arguments, "--queries", "40"]) == 0
    assert "120 queries of the training data, 384 held-out labels" in capsys.readouterr().out
    before, after = Predictor(model, threads=1), Predictor(target, threads=1)
    assert before.metadata.trust is None
    assert after.metadata.model_copy(update={"trust": None, "data": ""}) == before.metadata
    assert after.metadata.data.startswith("1,152 labels at 192 points of 3 clouds (ball, slab); never trained on: ring")
    stencil, aux = seeded_samples(700, seed=5)
    j = after.predict(stencil, aux)
    np.testing.assert_array_equal(j, before.predict(stencil, aux))
    assert before.errors(stencil, aux, j) is None
    errors = after.errors(stencil, aux, j)
    assert errors is not None
    assert errors.shape == j.shape
    assert np.all((errors > 0) & np.isfinite(errors))
    # Rows do not depend on the batch that they come in.
    part = after.errors(stencil[600:], aux[600:], j[600:])
    assert part is not None
    np.testing.assert_allclose(part, errors[600:], rtol=1e-5)
    # The same run gives the same file.
    assert calibrate.main([*arguments[:-1], str(tmp_path / "again.onnx"), "--queries", "40"]) == 0
    assert (tmp_path / "again.onnx").read_bytes() == target.read_bytes()


def test_what_does_not_belong_together_is_refused(model: Path, small_dataset: Path, tmp_path: Path) -> None:
    data = ["--data", str(small_dataset), "--labels", str(small_dataset)]
    proto, metadata = calibrate.read_model(model)
    other = tmp_path / "other.onnx"
    calibrate.write_model(proto, metadata.model_copy(update={"dataset_hash": "0" * 64}), other)
    with pytest.raises(InputError, match="was trained on 0000"):
        calibrate.main([str(other), *data])
    (tmp_path / "text.onnx").write_text("no model")
    with pytest.raises(InputError, match="cannot be read as an ONNX file"):
        calibrate.main([str(tmp_path / "text.onnx"), *data])
    with pytest.raises(InputError, match="at least one of each"):
        calibrate.main([str(model), *data, "--shards", "0"])
    with pytest.raises(InputError, match="no data set there"):
        calibrate.main([str(model), "--data", str(tmp_path), "--labels", str(small_dataset)])


def test_sizes_of_merged_data_are_those_of_all_parts() -> None:
    """A model without sizes would be asked about clouds of any."""
    first, second = {"config": {"size": [1, 200]}}, {"config": {"size": [0.5, 40.0]}}
    assert calibrate.sizes(first) == (1, 200)
    assert calibrate.sizes({"merged": [first, second]}) == (0.5, 200)
    assert calibrate.sizes({"merged": [first, {"config": None}]}) is None
    assert calibrate.sizes({}) is None
