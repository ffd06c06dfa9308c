"""What share of the machine's measured float32 peak the network's inference reaches.

    python -m benchmarks.inference [--models name,...] [--threads N] [--quick] [--docs]

The peak is that of large matrix products by the library that runs the network, onnxruntime, with as many threads. Rates of the network
are those of its file at each of several batches, one on each thread, stencils given; `as rendered` is what `Predictor.predict` reaches
with its fixed batch. A multiply-add counts as two operations; those of a query are counted in the file's graph: matrix products alone.
All of it is measured in turns, several rounds in one run, and of each the quickest round counts, since other work on the machine only
adds. Shares of the peak are given twice: of the seconds that pass, which is what users wait for, and of the processor's, which hold on a
busy machine too.

Last line: `inference: N % of the measured peak, N % by processor time`, of the first model.
"""

from __future__ import annotations

import argparse
import csv
import math
import os
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from deepclouds_runtime.multiply_adds import multiply_adds
from deepclouds_runtime.predictor import BATCH, RELEASED, Predictor
from numpy.typing import NDArray

from benchmarks.bench import ROOT, machine, model_name
from benchmarks.page import write_results
from deepclouds.errors import InputError
from deepclouds.model import AUX, INPUT_AUX, INPUT_STENCIL, LEVELS, OUTPUT, POINTS
from deepclouds.replacing import replacing

PAGE = ROOT / "docs" / "benchmark.md"
_BATCHES = (64, 128, 256, 512, 1024, 2048, 4096)
_SIDES = (512, 1024, 2048, 4096)
_COLUMNS = (
    *("what", "model", "batch", "multiply_adds", "seconds", "processor_seconds"),
    *("gflops", "share_of_peak", "share_of_peak_by_processor_time", "queries_per_second"),
)


@dataclass(frozen=True)
class Rate:
    """How quick something is: the quickest of its rounds.

    Attributes
    ----------
    what, model
        ``matmul``, ``network`` or ``rendered``, and the model's name.
    batch
        rows: queries of a network, the side of a square matrix.
    multiply_adds
        of one row.
    seconds, processor_seconds
        of one batch; the latter summed over threads.
    """

    what: str
    model: str
    batch: int
    multiply_adds: int
    seconds: float
    processor_seconds: float

    @property
    def operations(self) -> float:
        """Floating-point operations a second."""
        return 2.0 * self.multiply_adds * self.batch / self.seconds

    @property
    def operations_of_processors(self) -> float:
        """Floating-point operations a second of one processor."""
        return 2.0 * self.multiply_adds * self.batch / self.processor_seconds

    @property
    def rows(self) -> float:
        """Rows a second."""
        return self.batch / self.seconds


def quickest(works: Sequence[Callable[[], object]], rounds: int, least_seconds: float) -> list[tuple[float, float]]:
    """Seconds, and processor seconds, of one call of each: of the quickest of so many rounds in which all take turns.

    A turn repeats its call until `least_seconds` are over, so that clocks are fine enough.
    """
    best = [(math.inf, math.inf)] * len(works)
    for work in works:
        work()
    for _ in range(rounds):
        for index, work in enumerate(works):
            count, wall, processor = 0, time.perf_counter(), time.process_time()
            while count == 0 or time.perf_counter() - wall < least_seconds:
                work()
                count += 1
            spent = (time.perf_counter() - wall) / count, (time.process_time() - processor) / count
            best[index] = min(best[index][0], spent[0]), min(best[index][1], spent[1])
    return best


def session(model: bytes, threads: int) -> Any:
    """The network, or a product."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    # Nothing else runs beside it here, so that waiting threads may spin: the peak is the highest that can be had.
    return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])


def matrix_product(side: int) -> Any:
    """ONNX model: ``rows`` (n, side) times a constant square matrix, float32."""
    import onnx

    weights = np.random.default_rng(0).standard_normal((side, side)).astype(np.float32) / np.float32(np.sqrt(side))
    helper = onnx.helper
    values = [helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["batch", side]) for name in ("rows", "product")]
    node = helper.make_node("MatMul", ["rows", "weights"], ["product"])
    graph = helper.make_graph([node], "product", values[:1], values[1:], [onnx.numpy_helper.from_array(weights, "weights")])
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)


def queries(count: int, seed: int = 0) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Stencils and inputs of a network, plausible and arbitrary: the time does not depend on them."""
    rng = np.random.default_rng(seed)
    aux = np.tile(np.array([[1.0, 0.8, 0.0, 1.0, 1.0, 1.0]], np.float32), (count, 1))
    assert aux.shape[1] == len(AUX)
    return rng.uniform(0, 0.1, (count, LEVELS, POINTS)).astype(np.float32), aux


def at_once(pool: ThreadPoolExecutor, ask: Callable[[Any], object], feeds: Sequence[dict[str, Any]]) -> list[object]:
    """Answers to several batches, one on each thread."""
    return list(pool.map(ask, feeds))


def measure(models: Sequence[str], threads: int, batches: Sequence[int], sides: Sequence[int], rounds: int, turn: float) -> list[Rate]:
    """Rates of matrix products, and of each model at every batch and as rendered."""
    works: list[tuple[str, str, int, int]] = []
    calls: list[Callable[[], object]] = []
    batches_a_call: list[int] = []

    def add(what: str, model: str, batch: int, cost: int, call: Callable[[], object], count: int = 1) -> None:
        works.append((what, model, batch, cost))
        calls.append(call)
        batches_a_call.append(count)

    for side in sides:
        product = session(matrix_product(side).SerializeToString(), threads)
        rows = np.random.default_rng(side).standard_normal((side, side)).astype(np.float32)
        add("matmul", "", side, side * side, partial(product.run, None, {"rows": rows}))
    for name in models:
        predictor = Predictor(name, threads)
        data = predictor.path.read_bytes()
        cost, pool, ask = multiply_adds(data), ThreadPoolExecutor(threads), partial(session(data, 1).run, [OUTPUT])
        for batch in batches:
            feeds = []
            for seed in range(threads):
                stencil, aux = queries(batch, seed)
                feeds.append({INPUT_STENCIL: stencil, INPUT_AUX: aux})
            add("network", model_name(name), batch, cost, partial(at_once, pool, ask, feeds), threads)
        many = queries(4 * BATCH)
        add("rendered", model_name(name), 4 * BATCH, cost, partial(predictor.predict, *many))
    measured = zip(works, quickest(calls, rounds, turn), batches_a_call, strict=True)
    return [Rate(*work, *(seconds / count for seconds in spent)) for work, spent, count in measured]


def peak(rates: Sequence[Rate]) -> Rate:
    """The quickest matrix product."""
    return max((r for r in rates if r.what == "matmul"), key=lambda r: r.operations)


def shares(rates: Sequence[Rate], rate: Rate) -> tuple[float, float]:
    """What of the peak is reached, by seconds and by processor seconds; the latter has the highest product by that measure as its peak."""
    by_processor = max(r.operations_of_processors for r in rates if r.what == "matmul")
    return rate.operations / peak(rates).operations, rate.operations_of_processors / by_processor


def best(rates: Sequence[Rate], model: str) -> Rate:
    """A model at its best batch."""
    return max((r for r in rates if (r.what, r.model) == ("network", model)), key=lambda r: r.rows)


def write_csv(path: Path, rates: Sequence[Rate]) -> None:
    """One line a rate; operations in 10^9 a second; queries only where rows are queries."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path, ".csv") as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(_COLUMNS)
        for r in rates:
            figures = [r.seconds, r.processor_seconds, r.operations / 1e9, *shares(rates, r)]
            asked = "" if r.what == "matmul" else f"{r.rows:.6g}"
            writer.writerow([r.what, r.model, r.batch, r.multiply_adds, *(f"{x:.6g}" for x in figures), asked])


def markdown(rates: Sequence[Rate], threads: int) -> str:
    """The peak, and two lines a model."""
    top = peak(rates)
    lines = [
        f"Peak: {top.operations / 1e9:.0f} GFLOP/s, products of {top.batch} x {top.batch} matrices, {threads} threads.",
        "",
        "| model | multiply-adds a query | batch | queries/s | GFLOP/s | of the peak % | by processor time % |",
        "|---|---|---|---|---|---|---|",
    ]
    for model in dict.fromkeys(r.model for r in rates if r.model):
        rendered = next(r for r in rates if (r.what, r.model) == ("rendered", model))
        for rate, batch in ((best(rates, model), "{} (best)"), (rendered, f"{BATCH} (as rendered)")):
            cells = [model, f"{rate.multiply_adds:,}", batch.format(rate.batch), f"{rate.rows:,.0f}", f"{rate.operations / 1e9:.0f}"]
            lines.append("| " + " | ".join([*cells, *(f"{100 * share:.0f}" for share in shares(rates, rate))]) + " |")
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print, write `inference.csv`, and with ``--docs`` the page."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.inference", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--models", default=",".join(RELEASED), help="comma-separated names or files (default: the released, %(default)s)")
    parser.add_argument("--threads", type=int, help="of onnxruntime (default: all processors)")
    parser.add_argument("--out", type=Path, default=Path("out/inference"), help="folder of the table (default %(default)s)")
    parser.add_argument("--quick", action="store_true", help="small and short: a check that it runs, not a measurement")
    parser.add_argument("--docs", action="store_true", help="write the results into docs/benchmark.md")
    options = parser.parse_args(argv)
    threads = options.threads
    if threads is None:
        threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if threads < 1:
        raise InputError(f"threads = {threads}: at least one is needed")
    names = options.models.split(",")
    batches, sides, rounds, turn = ((64,), (256,), 1, 0.0) if options.quick else (_BATCHES, _SIDES, 8, 0.3)
    rates = measure(names, threads, batches, sides, rounds, turn)
    write_csv(options.out / "inference.csv", rates)
    table = markdown(rates, threads)
    print(machine(), table, f"wrote {options.out}/inference.csv", sep="\n")
    if options.docs:
        write_results(PAGE, "inference", f"Measured on: {machine()}\n\n{table}")
    by_seconds, by_processor = shares(rates, best(rates, model_name(names[0])))
    print(f"inference: {100 * by_seconds:.0f} % of the measured peak, {100 * by_processor:.0f} % by processor time")
    return 0


if __name__ == "__main__":
    try:
        raise SystemExit(main())
    except InputError as error:
        print(f"benchmarks.inference: {error}", file=sys.stderr)
        raise SystemExit(2) from None
