"""`deepclouds calibrate`: what a model was trained on and how wrong it is, as numbers in its metadata that say when not to trust it.

The summaries of training queries give the distance from the training data, held-out labels the error that goes with it: see
`deepclouds.model.trust`. Weights stay as they are.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepclouds.errors import InputError
from deepclouds.model import INPUT_AUX, INPUT_STENCIL, OUTPUT, ModelMetadata, Trust
from deepclouds.model.trust import FLOOR, LARGEST, design, summaries
from deepclouds_training.samples import SampleConfig, SampleSource
from deepclouds_training.shards import Dataset, open_dataset, write_atomically

Floats = NDArray[np.float64]
SHARES = (0.5, 0.9, 0.99, 0.999)
# Directions in which the training data hardly vary count as if they varied so much, or rounding would be far from them.
_LEAST_VARIANCE = 1e-3
_LEAST_DEVIATION = 1e-3
# One label's squared relative error beyond this says no more: predictions in deep shade may be off by any factor.
_MOST_SQUARED = 2.0
_SMALLEST_SQUARED = 4e-4
_ITERATIONS = 60
_BATCH = 512
# Digits that are worth keeping.
_DIGITS = 7


@dataclass(frozen=True)
class Judged:
    """Held-out labels beside predictions, all (n,): distance, prediction, both halves, the standard error of their mean, cloud."""

    distance: Floats
    prediction: Floats
    half_a: Floats
    half_b: Floats
    error: Floats
    cloud: NDArray[np.int64]

    @property
    def squared(self) -> Floats:
        """Squared errors in units of ``j + 0.05``, free of the labels' noise in expectation."""
        found: Floats = (self.prediction - self.half_a) * (self.prediction - self.half_b) / np.square(self.prediction + FLOOR)
        return found


def main(argv: Sequence[str], prog: str = "deepclouds calibrate") -> int:
    """Write the metadata anew; returns 0, raises InputError for files that cannot be read or do not belong together."""
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Tell a model how far its predictions can be trusted: distances from its training data, and the error that held-out "
        "labels show at each. Changes the metadata of the file and no weight.",
    )
    parser.add_argument("model", metavar="MODEL.onnx", type=Path)
    parser.add_argument("--data", metavar="DATA", type=Path, required=True, help="the data set that it was trained on")
    parser.add_argument("--labels", metavar="LABELS", type=Path, required=True, help="held-out labels with small errors, in two halves")
    parser.add_argument("-o", "--output", metavar="OUT.onnx", type=Path, help="file to write (default: MODEL.onnx itself)")
    parser.add_argument("--shards", type=int, default=240, help="training clouds that are looked at, spread over all (default %(default)s)")
    parser.add_argument("--queries", type=int, default=64, help="queries of each of them (default %(default)s)")
    parser.add_argument("--backend", choices=("llvm", "cuda"), default="llvm")
    options = parser.parse_args(argv)
    if options.shards < 1 or options.queries < 1:
        raise InputError(f"shards = {options.shards}, queries = {options.queries}: at least one of each is needed")
    proto, metadata = read_model(options.model)
    data = open_dataset(options.data)
    if data.hash != metadata.dataset_hash:
        raise InputError(
            f"{options.data}: has the hash {data.hash[:16]}..., {options.model} was trained on {metadata.dataset_hash[:16]}...; "
            "give the data set that it was trained on"
        )
    samples = training_summaries(data, options.shards, options.queries, options.backend)
    trust = calibrated(proto.SerializeToString(), samples, options.labels, options.backend)
    described = metadata.model_copy(update={"trust": trust, "size": sizes(data.manifest), "data": in_words(data)})
    target = options.output or options.model
    write_model(proto, described, target)
    quantiles = ", ".join(f"{100 * float(share):g} % {distance:.3g}" for share, distance in trust.quantiles.items())
    print(f"distance of the training data: {quantiles}")
    print(f"{target}: {trust.queries} queries of the training data, {trust.labels} held-out labels")
    return 0


def sizes(manifest: Mapping[str, Any]) -> tuple[float, float] | None:
    """Least and greatest longest side of a data set's clouds, in mean free paths, over all that was merged; None where a part has none."""
    parts = [part.get("config") or {} for part in manifest.get("merged", [manifest])]
    if not all("size" in part for part in parts):
        return None
    return min(float(part["size"][0]) for part in parts), max(float(part["size"][1]) for part in parts)


def read_model(path: Path) -> tuple[Any, ModelMetadata]:
    """The file's ``onnx.ModelProto`` and its metadata.

    Raises
    ------
    InputError
        when the file cannot be read or follows another contract.
    """
    import onnx

    try:
        proto = onnx.load(path)
    except Exception as error:
        raise InputError(f"{path}: cannot be read as an ONNX file ({error})") from error
    metadata = ModelMetadata.from_properties({p.key: p.value for p in proto.metadata_props}, str(path))
    metadata.require_this_contract(str(path))
    return proto, metadata


def write_model(proto: Any, metadata: ModelMetadata, target: Path) -> None:
    """Write the model with these metadata, all or nothing."""
    import onnx

    del proto.metadata_props[:]
    onnx.helper.set_model_props(proto, metadata.to_properties())
    write_atomically(target, proto.SerializeToString())


def training_summaries(data: Dataset, shards: int, queries: int, backend: Any) -> Floats:
    """Summaries (n, 27) of queries as training draws them, from up to so many clouds."""
    chosen = [s for s in data.shards if s.split == "train"]
    if not chosen:
        raise InputError(f"{data.folder}: holds no clouds to train on; give the data set that the model was trained on")
    chosen = [chosen[i] for i in np.unique(np.linspace(0, len(chosen) - 1, min(shards, len(chosen))).astype(int))]
    config = SampleConfig(backend=backend, cache_gb=0)
    source = SampleSource(data, tuple(chosen), config, seed=0)
    parts = []
    for info in chosen:
        rng = np.random.default_rng([0, info.index])
        drawn = source.draw(info, queries, rng, config.unit_jitter ** rng.uniform(-1.0, 1.0), config.mirror)
        parts.append(summaries(drawn.stencil, drawn.aux))
    return np.concatenate(parts)


def in_words(data: Dataset) -> str:
    """What a data set holds, in a sentence."""
    train, held = ([s for s in data.shards if s.split == split] for split in ("train", "valid"))
    _, suns, albedos = data.load(train[0]).label.shape
    points = sum(s.count for s in train)
    text = (
        f"{points * suns * albedos:,} labels at {points:,} points of {len(train)} clouds ({', '.join(sorted({s.family for s in train}))})"
    )
    if held:
        text += f"; never trained on: {', '.join(sorted({s.family for s in held}))}"
    return text


def calibrated(model: bytes, training: Floats, labels: Path, backend: Any) -> Trust:
    """Find the numbers of a `Trust` for a model from the summaries of its training data and a set of held-out labels."""
    mean, whitening = whitened(training)
    distance = np.sqrt(np.mean(np.square((training - mean) @ whitening), axis=1))
    data = open_dataset(labels)
    trust = Trust(
        mean=tuple(mean.tolist()),
        whitening=tuple(map(tuple, whitening.tolist())),
        quantiles={f"{share:g}": _rounded(np.quantile(distance, share)) for share in SHARES},
        coefficients=(0.0, 0.0, 0.0, 0.0),
        least=0.0,
        queries=len(training),
        labels=0,
        labels_hash=data.hash,
    )
    judged = judge(model, trust, data, backend)
    columns = design(judged.distance / trust.quantiles["0.5"], judged.prediction)
    found = fitted(columns, judged)
    coefficients = tuple(_rounded(c) for c in found)
    expected = np.exp(0.5 * columns @ np.array(coefficients))
    least = _rounded(np.quantile(expected, 0.01))
    return trust.model_copy(update={"coefficients": coefficients, "least": least, "labels": len(judged.cloud)})


def whitened(values: Floats) -> tuple[Floats, Floats]:
    """Mean (k,) of values (n, k), and a matrix (k, k) that turns their deviations from it into components of variance 1."""
    mean, deviation = values.mean(axis=0), np.maximum(values.std(axis=0), _LEAST_DEVIATION)
    variance, axes = np.linalg.eigh(np.cov(((values - mean) / deviation).T))
    whitening = axes / np.sqrt(np.maximum(variance, _LEAST_VARIANCE)) / deviation[:, None]
    rounded: Floats = np.vectorize(_rounded)(whitening)
    return np.vectorize(_rounded)(mean), rounded


def judge(model: bytes, trust: Trust, data: Dataset, backend: Any = "llvm") -> Judged:
    """Predictions of a model and their distances beside the labels of a data set's held-out clouds."""
    import onnxruntime

    shards = tuple(s for s in data.shards if s.split == "valid")
    if not shards:
        raise InputError(f"{data.folder}: holds no clouds of held-out families; `deepclouds generate` with valid_shards makes them")
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    source = SampleSource(data, shards, SampleConfig(backend=backend, cache_gb=0), seed=0)
    parts = []
    for info in shards:
        samples, _ = source.all_of(info)
        rows = [slice(i, i + _BATCH) for i in range(0, len(samples), _BATCH)]
        j = [session.run([OUTPUT], {INPUT_STENCIL: samples.stencil[r], INPUT_AUX: samples.aux[r]})[0] for r in rows]
        half = samples.half.astype(np.float64)
        parts.append(
            Judged(
                trust.distance(samples.stencil, samples.aux),
                np.concatenate(j).astype(np.float64),
                half[:, 0],
                half[:, 1],
                samples.error.astype(np.float64),
                np.full(len(samples), info.index, np.int64),
            )
        )
    return Judged(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in vars(parts[0])})


def fitted(columns: Floats, judged: Judged, distances: bool = True) -> Floats:
    """Coefficients of the logarithm of the expected squared error, linear in `columns` (n, k).

    That of column 1, where it stands for `distances`, is not negative: no error falls with the distance.

    Quasi-likelihood by Fisher's scoring: only means and variances of the squared errors enter, whose noise may make single ones negative.
    """
    squared = np.clip(judged.squared, -_MOST_SQUARED, _MOST_SQUARED)
    # The variance that the noise of two halves gives to each.
    noise = np.square(2 * judged.error / (judged.prediction + FLOOR))
    result = np.zeros(columns.shape[1])
    result[0] = np.log(0.05)
    for _ in range(_ITERATIONS):
        mean = np.exp(np.clip(columns @ result, np.log(_SMALLEST_SQUARED), 2 * np.log(LARGEST)))
        weight = np.square(mean) / (2 * np.square(mean) + np.square(noise) + 2 * noise * mean)
        gradient = columns.T @ (weight * (squared - mean) / mean)
        step = np.linalg.solve((columns * weight[:, None]).T @ columns + 1e-6 * np.eye(len(result)), gradient)
        result += step * min(1.0, 0.7 / max(float(np.abs(columns @ step).max()), 1e-12))
    if distances and result[1] < 0:
        # Distances that tell nothing: brightness alone is left.
        return np.insert(fitted(np.delete(columns, 1, axis=1), judged, distances=False), 1, 0.0)
    return result


def _rounded(value: Any) -> float:
    return float(f"{float(value):.{_DIGITS}g}")
