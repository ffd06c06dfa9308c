"""`deepclouds export`: a run's weights as one ONNX file that describes and checks itself."""

from __future__ import annotations

import argparse
import logging
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from deepclouds.errors import InputError
from deepclouds.model import AUX, INPUT_AUX, INPUT_STENCIL, LEVELS, OUTPUT, POINTS, ModelMetadata, aux_inputs, initialiser_hash

if TYPE_CHECKING:
    from deepclouds_training.network import Network

log = logging.getLogger(__name__)
OPSET = 18
TOLERANCE = 1e-4
PARITY_SAMPLES = 2048
# Weights below this count for nothing, but their products are subnormal numbers, which take some processors a hundred times as long.
_LEAST_WEIGHT = 1e-30


def main(argv: Sequence[str], prog: str = "deepclouds export") -> int:
    """Write the model of a run; returns 0, raises InputError for a run without weights or a file that does not agree with torch."""
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Write the weights of a training run as one ONNX file with its metadata, after checking it against torch.",
    )
    parser.add_argument("run", metavar="RUN", type=Path, help="folder of the training run")
    parser.add_argument("-o", "--output", metavar="MODEL.onnx", type=Path, required=True, help="file to write")
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--ema", action="store_true", help="the averaged weights (default)")
    which.add_argument("--raw", action="store_true", help="the weights of the last step")
    parser.add_argument("--companion", action="store_true", help="the small network that was trained beside the large one")
    parser.add_argument("--name", help="the model's name in its metadata (default: the file's name)")
    options = parser.parse_args(argv)
    name = options.name or options.output.stem
    metadata, error = export_run(options.run, options.output, raw=options.raw, name=name, companion=options.companion)
    log.info("%s: %s, contract %s, largest relative difference from torch %.1e", options.output, name, metadata.contract, error)
    return 0


def export_run(folder: Path, target: Path, raw: bool, name: str, companion: bool = False) -> tuple[ModelMetadata, float]:
    """Export the last checkpoint of the run in `folder`, or its companion; returns the metadata and the largest relative difference."""
    from deepclouds_training.learner import averaged_network
    from deepclouds_training.network import Network
    from deepclouds_training.run_folder import RunFolder
    from deepclouds_training.shards import open_dataset

    run = RunFolder(folder)
    config = run.config()
    state = run.load_checkpoint()
    if state is None or state["step"] == 0:
        raise InputError(f"{folder}: has no trained weights yet; let `deepclouds train` reach its first checkpoint")
    shape, learned = config.network, state
    if companion:
        if config.companion is None:
            raise InputError(f"{folder}: was trained without a companion; leave --companion out, or train with a [companion] table")
        shape, learned = config.companion, state["companion"]
    if raw:
        network = Network(shape)
        network.load_state_dict(learned["network"])
    else:
        network = averaged_network(shape, learned, config.ema)
    try:
        dataset = open_dataset(config.data)
        stencil, aux = _real_samples(dataset, run.shards(dataset), config.samples.backend)
    except InputError as error:
        log.info("the parity check uses made-up samples: %s", error)
        stencil, aux = seeded_samples(PARITY_SAMPLES)
    metadata = {
        "name": name,
        "created_by": f"deepclouds {_version()}",
        "ranges": {key: (low, high) for key, (low, high) in state["ranges"].items()},
        "config_hash": config.hash,
        "dataset_hash": run.data_hash,
        "metrics": {"step": float(state["step"]), "ema": float(not raw), **_last_figures(run.metrics(), state["step"], companion)},
    }
    return export_network(network, target, metadata, stencil, aux)


def export_network(
    network: Network, target: Path, metadata: dict[str, Any], stencil: NDArray[np.float32], aux: NDArray[np.float32]
) -> tuple[ModelMetadata, float]:
    """Write `network` to `target`, all or nothing.

    Parameters
    ----------
    network
        the weights.
    target
        the file, whose folder exists; its name ends in ``.onnx``.
    metadata
        fields of `ModelMetadata` without the hash of the initialisers.
    stencil, aux
        samples (n, 10, 225) and (n, 6) on which onnxruntime must reproduce torch.

    Returns
    -------
    the metadata as written, and the largest relative difference.

    Raises
    ------
    InputError
        when the difference exceeds 1e-4, or the file cannot be written.
    """
    import onnx

    from deepclouds_training.shards import write_atomically

    if target.suffix != ".onnx":
        raise InputError(f"{target}: the name of a model file ends in .onnx")
    if not target.parent.is_dir():
        raise InputError(f"{target}: the folder {target.parent} does not exist; create it first")
    model = to_onnx(network)
    arrays = [(i.name, onnx.numpy_helper.to_array(i)) for i in model.graph.initializer]
    described = ModelMetadata.model_validate({**metadata, "initialisers_sha256": initialiser_hash(arrays)})
    del model.metadata_props[:]
    onnx.helper.set_model_props(model, described.to_properties())
    onnx.checker.check_model(model, full_check=True)
    data = model.SerializeToString()
    difference = parity(network, data, stencil, aux)
    if not difference < TOLERANCE:
        raise InputError(f"{target}: onnxruntime differs from torch by {difference:.1e} (relative), more than {TOLERANCE:g}; not written")
    try:
        write_atomically(target, data)
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error.strerror})") from error
    return described, difference


def to_onnx(network: Network) -> Any:
    """The network as an ``onnx.ModelProto`` with the names of the contract and one dynamic axis, the batch."""
    import onnx
    import torch

    network = network.folded().eval()
    # Two rows: the exporter would take a batch of one for a constant.
    example = torch.zeros(2, LEVELS, POINTS), torch.zeros(2, len(AUX))
    batch = torch.export.Dim("batch", min=1, max=2**20)
    with tempfile.TemporaryDirectory() as folder, _quiet():
        path = Path(folder) / "model.onnx"
        torch.onnx.export(
            network,
            example,
            str(path),
            input_names=[INPUT_STENCIL, INPUT_AUX],
            output_names=[OUTPUT],
            dynamic_shapes=({0: batch}, {0: batch}),
            opset_version=OPSET,
            dynamo=True,
            external_data=False,
            verbose=False,
        )
        if [p.name for p in Path(folder).iterdir()] != [path.name]:
            raise RuntimeError("the exporter wrote more than one file")
        model = onnx.load(path)
    # Names of nodes and types of values are left; what the exporter noted about source lines is not for a released file.
    model.doc_string = ""
    for node in model.graph.node:
        del node.metadata_props[:]
        node.doc_string = ""
    for value in (*model.graph.value_info, *model.graph.input, *model.graph.output, *model.graph.initializer):
        del value.metadata_props[:]
    del model.graph.metadata_props[:]
    _zero_least_weights(model)
    return model


def _zero_least_weights(model: Any) -> None:
    from onnx import TensorProto, numpy_helper

    for initialiser in model.graph.initializer:
        if initialiser.data_type == TensorProto.FLOAT:
            values = numpy_helper.to_array(initialiser)
            kept = np.where(np.abs(values) < _LEAST_WEIGHT, np.float32(0), values)
            initialiser.CopyFrom(numpy_helper.from_array(kept, initialiser.name))


def parity(network: Network, data: bytes, stencil: NDArray[np.float32], aux: NDArray[np.float32]) -> float:
    """Largest relative difference between onnxruntime on the file's bytes and torch."""
    import onnxruntime

    from deepclouds_training.trainer import predict

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    expected = predict(network, stencil, aux)
    rows = [slice(i, i + 512) for i in range(0, len(aux), 512)]
    got = np.concatenate([session.run([OUTPUT], {INPUT_STENCIL: stencil[r], INPUT_AUX: aux[r]})[0] for r in rows])
    return float(np.max(np.abs(got - expected) / expected))


def seeded_samples(count: int, seed: int = 0) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Made-up inputs over the whole range of the contract: stencils (count, 10, 225) of every magnitude, aux (count, 6)."""
    rng = np.random.default_rng(seed)
    scale = 10 ** rng.uniform(-6, 1, (count, LEVELS, 1))
    stencil = (scale * rng.uniform(0, 1, (count, LEVELS, POINTS)) * (rng.random((count, LEVELS, POINTS)) < 0.7)).astype(np.float32)
    single = rng.random(count) < 0.5
    g1, g2 = rng.uniform(-0.95, 0.95, (2, count))
    weight = np.where(single, 1.0, rng.random(count))
    gamma = np.where(rng.random(count) < 0.2, 0.0, np.arccos(rng.uniform(-1, 1, count)))
    return stencil, aux_inputs(gamma, g1, np.where(single, 0.0, g2), weight, rng.uniform(0, 1, count), 10 ** rng.uniform(-3, 3, count))


def _real_samples(dataset: Any, shards: Any, backend: Any) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    from deepclouds_training.samples import SampleConfig, SampleSource

    chosen = [s for s in shards if s.split == "valid"][:8] or list(shards[:8])
    samples = SampleSource(dataset, tuple(chosen), SampleConfig(backend=backend), seed=0).every_shard(PARITY_SAMPLES // len(chosen))
    return samples.stencil, samples.aux


def _last_figures(metrics: list[dict[str, Any]], step: int, companion: bool) -> dict[str, float]:
    """The last validation at or before `step`, flattened; that of the companion where it is asked for."""
    validations = [entry for entry in metrics if entry["kind"] == "valid" and entry["step"] <= step]
    if not validations:
        return {}
    last = validations[-1]
    flat = {
        f"{family}.{name}": float(value)
        for family, figures in last["companion" if companion else "figures"].items()
        for name, value in figures.items()
    }
    return {"validated_at_step": float(last["step"]), **flat}


def _version() -> str:
    try:
        return version("deepclouds")
    except PackageNotFoundError:
        return "from source"


@contextmanager
def _quiet() -> Iterator[None]:
    """The exporter warns about its own deprecations and about packages it does not find; none of it concerns the file."""
    loggers = [logging.getLogger(name) for name in ("torch.onnx", "torch.export", "onnxscript", "onnx_ir")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
