"""The share of the peak: what is counted, what is made of rates, and one short run; no timing decides anything here."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from deepclouds_runtime.multiply_adds import multiply_adds
from deepclouds_runtime.predictor import BATCH, RELEASED

from benchmarks import inference
from benchmarks.inference import Rate, best, markdown, matrix_product, peak, shares, write_csv
from deepclouds.errors import InputError


def rates() -> list[Rate]:
    small, large = Rate("matmul", "", 100, 10_000, 1e-5, 2e-5), Rate("matmul", "", 1000, 1_000_000, 1e-2, 1.25e-2)
    return [
        small,
        large,
        Rate("network", "a", 64, 1_000_000, 1e-3, 2e-3),
        Rate("network", "a", 512, 1_000_000, 1.024e-2, 2.048e-2),
        Rate("network", "a", 4096, 1_000_000, 1.0, 2.0),
        Rate("rendered", "a", 2048, 1_000_000, 0.08192, 0.16384),
    ]


def test_multiply_adds_are_those_of_the_training_code() -> None:
    """Rationale: a matrix that every level uses is stored once, and a mirrored one multiplies twice.

    Expected behaviour: counted in the exported graph as torch counts it, whatever blocks share.
    """
    pytest.importorskip("torch")
    from deepclouds_training.export import to_onnx
    from deepclouds_training.network import Network, NetworkConfig

    from benchmarks.ablation_results import multiply_adds as by_torch

    counted = {}
    for name, config in {
        "symmetric": NetworkConfig(width=8, levels=(0, 5), symmetric=True),
        "pooled": NetworkConfig(width=8, levels=(0, 5), channels=4, together=2),
    }.items():
        network = Network(config)
        counted[name] = multiply_adds(to_onnx(network).SerializeToString())
        assert counted[name] == by_torch(network), name
    assert len(set(counted.values())) > 1


def test_a_matrix_product_is_what_it_says() -> None:
    model = matrix_product(24)
    assert multiply_adds(model.SerializeToString()) == 24 * 24
    pytest.importorskip("onnxruntime")
    onnx = pytest.importorskip("onnx")
    rows = np.random.default_rng(1).standard_normal((5, 24)).astype(np.float32)
    (found,) = inference.session(model.SerializeToString(), 1).run(None, {"rows": rows})
    weights = onnx.numpy_helper.to_array(model.graph.initializer[0])
    np.testing.assert_allclose(found, rows @ weights, rtol=1e-5, atol=1e-5)


def test_what_cannot_be_counted_is_refused() -> None:
    onnx = pytest.importorskip("onnx")
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    values = [helper.make_tensor_value_info(name, kind, ["batch", "unknown"]) for name in ("a", "b", "c")]
    graph = helper.make_graph([helper.make_node("MatMul", ["a", "b"], ["c"], name="blurred")], "g", values[:2], values[2:])
    with pytest.raises(InputError, match="'blurred' are unknown"):
        multiply_adds(helper.make_model(graph).SerializeToString())


def test_shares_of_the_peak() -> None:
    """Expected behaviour: a network's best batch over the best product, operations twice the multiply-adds; by both clocks."""
    found = rates()
    assert peak(found) is found[1]
    assert found[1].operations == pytest.approx(2e11)
    top = best(found, "a")
    assert top.batch == 64
    assert top.rows == pytest.approx(64_000)
    assert top.operations == pytest.approx(1.28e11)
    by_seconds, by_processor = shares(found, top)
    assert by_seconds == pytest.approx(0.64)
    # Of the processor's seconds the large product takes the fewest an operation: 1.25e-14.
    assert by_processor == pytest.approx(0.4)
    table = markdown(found, 2).splitlines()
    assert table[0] == "Peak: 200 GFLOP/s, products of 1000 x 1000 matrices, 2 threads."
    assert table[-2:] == [
        "| a | 1,000,000 | 64 (best) | 64,000 | 128 | 64 | 40 |",
        f"| a | 1,000,000 | {BATCH} (as rendered) | 25,000 | 50 | 25 | 16 |",
    ]


def test_the_table_is_well_formed(tmp_path: Path) -> None:
    write_csv(tmp_path / "inference.csv", rates())
    with open(tmp_path / "inference.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [r["what"] for r in rows] == ["matmul", "matmul", "network", "network", "network", "rendered"]
    assert all(None not in r.values() and None not in r for r in rows)
    assert rows[1]["share_of_peak"] == "1"
    assert float(rows[2]["share_of_peak"]) == pytest.approx(0.64)
    assert [r["queries_per_second"] for r in rows[:3]] == ["", "", "64000"]


def test_a_short_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("onnxruntime")
    name = RELEASED[0]
    assert inference.main(["--quick", "--models", name, "--threads", "1", "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out.strip().splitlines()
    assert out[-1].startswith("inference: ")
    assert out[-1].endswith(" % by processor time")
    with open(tmp_path / "inference.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [(r["what"], r["model"]) for r in rows] == [("matmul", ""), ("network", name), ("rendered", name)]
    assert all(float(r["seconds"]) > 0 for r in rows)
    with pytest.raises(InputError, match="no released model is named 'nobody'"):
        inference.main(["--quick", "--models", "nobody", "--out", str(tmp_path)])
    with pytest.raises(InputError, match="threads = 0"):
        inference.main(["--quick", "--threads", "0", "--out", str(tmp_path)])
