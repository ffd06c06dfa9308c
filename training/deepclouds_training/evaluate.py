"""`deepclouds evaluate`: how far a model's predictions are from held-out labels, free of the labels' own noise."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from deepclouds.errors import InputError
from deepclouds.model import INPUT_AUX, INPUT_STENCIL, OUTPUT, ModelMetadata
from deepclouds_training.samples import SampleConfig, Samples, SampleSource
from deepclouds_training.shards import open_dataset

Floats = NDArray[np.float64]
# Labels below this share of their cloud's mean are judged by their absolute error.
DARK = 0.01
# Percentiles count labels whose own noise is well below the errors that are measured.
CONVERGED = 0.03
RESAMPLES = 400
_BATCH = 512


@dataclass(frozen=True)
class Labels:
    """Predictions beside labels, all (n,), and what they belong to.

    Attributes
    ----------
    prediction, half_a, half_b, error
        j as predicted, its two independent labels, and the standard error of the labels' mean.
    cloud
        number of the cloud.
    mean
        the cloud's mean label.
    family
        the cloud's family.
    size
        longest side of the cloud in units of length.
    g, albedo, gamma, tau
        mean cosine of the phase function, albedo, angle between view and sun in radians, optical depth toward the sun.
    """

    prediction: Floats
    half_a: Floats
    half_b: Floats
    error: Floats
    cloud: NDArray[np.int64]
    mean: Floats
    family: NDArray[np.str_]
    size: Floats
    g: Floats
    albedo: Floats
    gamma: Floats
    tau: Floats

    @property
    def label(self) -> Floats:
        """Mean of both halves."""
        return 0.5 * (self.half_a + self.half_b)

    def where(self, chosen: NDArray[np.bool_]) -> Labels:
        """The chosen labels."""
        return Labels(**{name: values[chosen] for name, values in vars(self).items()})


@dataclass(frozen=True)
class Figure:
    """A figure with the ends of its 95 % interval: percentiles of a bootstrap over clouds."""

    value: float
    low: float
    high: float

    def percent(self) -> str:
        """As text."""
        return f"{100 * self.value:+.2f} % [{100 * self.low:+.2f}, {100 * self.high:+.2f}]"


def predict_labels(model: Path, data: Path, backend: Literal["llvm", "cuda"] = "llvm") -> Labels:
    """Ask a model for every label of the held-out clouds of a data set.

    Raises
    ------
    InputError
        when the model or the data set cannot be read, or the latter holds no held-out clouds.
    """
    dataset = open_dataset(data)
    shards = tuple(s for s in dataset.shards if s.split == "valid")
    if not shards:
        raise InputError(f"{data}: holds no clouds of held-out families; `deepclouds generate` with valid_shards makes them")
    session = _session(model)
    source = SampleSource(dataset, shards, SampleConfig(backend=backend, cache_gb=0), seed=0)
    parts = []
    for info in shards:
        samples, size = source.all_of(info)
        parts.append(labels_of(samples, _predict(session, samples), info.index, info.family, size))
    return Labels(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in vars(parts[0])})


def labels_of(samples: Samples, prediction: Floats, cloud: int, family: str, size: float) -> Labels:
    """Predictions (n,) beside the samples of one cloud: its number, its family and its longest side in units of length."""
    n = len(samples)
    gamma, g1, g2, weight, albedo, log1p_tau = (samples.aux[:, i].astype(np.float64) for i in range(6))
    half = samples.half.astype(np.float64)
    return Labels(
        prediction=prediction,
        half_a=half[:, 0],
        half_b=half[:, 1],
        error=samples.error.astype(np.float64),
        cloud=np.full(n, cloud, np.int64),
        mean=np.full(n, half.mean()),
        family=np.full(n, family),
        size=np.full(n, size),
        g=weight * g1 + (1 - weight) * g2,
        albedo=albedo,
        gamma=gamma,
        tau=np.expm1(log1p_tau),
    )


def _session(model: Path) -> Any:
    import onnx
    import onnxruntime

    try:
        proto = onnx.load(model)
    except Exception as error:
        raise InputError(f"{model}: cannot be read as an ONNX file ({error})") from error
    ModelMetadata.from_properties({p.key: p.value for p in proto.metadata_props}, str(model)).require_this_contract(str(model))
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(proto.SerializeToString(), options, providers=["CPUExecutionProvider"])


def _predict(session: Any, samples: Samples) -> Floats:
    rows = [slice(i, i + _BATCH) for i in range(0, len(samples), _BATCH)]
    j = [session.run([OUTPUT], {INPUT_STENCIL: samples.stencil[r], INPUT_AUX: samples.aux[r]})[0] for r in rows]
    return np.concatenate(j).astype(np.float64)


def noise_free(labels: Labels, seed: int = 0) -> dict[str, Figure]:
    """``rRMSE``, sqrt(mean((p - A)(p - B))) / mean(y), and ``energy``, mean(p) / mean(y) - 1.

    The noises of the halves A and B are independent, so the product's expectation is the squared error of p alone.
    """
    product = (labels.prediction - labels.half_a) * (labels.prediction - labels.half_b)
    sums = _by_cloud(labels, [np.ones_like(product), product, labels.prediction, labels.label])

    def rrmse(s: Floats) -> Floats:
        value: Floats = np.sqrt(np.maximum(s[1] / s[0], 0)) / np.maximum(s[3] / s[0], 1e-12)
        return value

    def energy(s: Floats) -> Floats:
        value: Floats = s[2] / np.maximum(s[3], 1e-12) - 1
        return value

    return {"rRMSE": _figure(sums, rrmse, seed), "energy": _figure(sums, energy, seed)}


def percentiles(labels: Labels, seed: int = 0) -> dict[str, Figure]:
    """Median and 95th percentile of the relative error where a label exceeds 1 % of its cloud's mean, and what the labels' noise adds.

    Only labels whose own standard error is below 3 % count; their noise still widens the percentiles a little: ``noise`` is the median
    standard error. Darker labels give ``dark``, the 95th percentile of their absolute error over their cloud's mean.
    """
    bright = labels.label > DARK * labels.mean
    used = labels.where(bright & (labels.error < CONVERGED * labels.label))
    dark = labels.where(~bright)
    found = {}
    if len(used.cloud):
        relative = np.abs(used.prediction - used.label) / used.label
        found["median"] = _quantile(relative, used.cloud, 0.5, seed)
        found["95 %"] = _quantile(relative, used.cloud, 0.95, seed)
        found["noise"] = _quantile(used.error / used.label, used.cloud, 0.5, seed)
    if len(dark.cloud):
        found["dark"] = _quantile(np.abs(dark.prediction - dark.label) / np.maximum(dark.mean, 1e-12), dark.cloud, 0.95, seed)
    return found


def _by_cloud(labels: Labels, values: list[Floats]) -> Floats:
    _, group = np.unique(labels.cloud, return_inverse=True)
    return np.stack([np.bincount(group, weights=v) for v in values])


def _figure(sums: Floats, statistic: Callable[[Floats], Floats], seed: int) -> Figure:
    clouds = sums.shape[1]
    picks = np.random.default_rng(seed).multinomial(clouds, np.full(clouds, 1 / clouds), size=RESAMPLES)
    low, high = np.quantile(statistic(sums @ picks.T.astype(np.float64)), [0.025, 0.975])
    return Figure(float(statistic(sums.sum(axis=1, keepdims=True))[0]), float(low), float(high))


def _quantile(values: Floats, cloud: NDArray[np.int64], q: float, seed: int) -> Figure:
    rng = np.random.default_rng(seed)
    names = np.unique(cloud)
    groups = [values[cloud == name] for name in names]
    resampled = [np.quantile(np.concatenate([groups[i] for i in rng.integers(0, len(groups), len(groups))]), q) for _ in range(RESAMPLES)]
    low, high = np.quantile(resampled, [0.025, 0.975])
    return Figure(float(np.quantile(values, q)), float(low), float(high))


def main(argv: Sequence[str], prog: str = "deepclouds evaluate") -> int:
    """Print the figures of a model on held-out labels, and draw them."""
    parser = argparse.ArgumentParser(prog=prog, description=__doc__)
    parser.add_argument("model", metavar="MODEL.onnx", type=Path)
    parser.add_argument("data", metavar="DATA", type=Path, nargs="+", help="folders of data sets; their held-out clouds are used")
    parser.add_argument("--picture", metavar="FILE.png", type=Path, help="draw the errors by family, size, g, albedo, angle and depth")
    parser.add_argument("--backend", choices=("llvm", "cuda"), default="llvm")
    options = parser.parse_args(argv)
    sets = [predict_labels(options.model, folder, options.backend) for folder in options.data]
    for folder, labels in zip(options.data, sets, strict=True):
        print(f"{folder}: {len(labels.cloud)} labels of {len(np.unique(labels.cloud))} held-out clouds")
        for name, chosen in [("all", np.full(len(labels.cloud), True)), *((f, labels.family == f) for f in np.unique(labels.family))]:
            part = labels.where(chosen)
            rows = {**noise_free(part), **percentiles(part)}
            print(f"  {name:14s}" + "   ".join(f"{key} {figure.percent()}" for key, figure in rows.items()))
    if options.picture is not None:
        from deepclouds_training.evaluated_plot import write_evaluated_plot

        write_evaluated_plot(options.picture, sets, [str(folder) for folder in options.data], options.model.stem)
        print(f"wrote {options.picture}")
    return 0
