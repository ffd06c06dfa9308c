"""Predictions of a model file: checked when it is loaded, run by onnxruntime in batches that stay in the cache, one a thread."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from deepclouds.errors import InputError
from deepclouds.medium.phase import ordered_lobes
from deepclouds.model import AUX, INPUT_AUX, INPUT_STENCIL, LEVELS, OUTPUT, POINTS, ModelMetadata, aux_inputs, initialiser_hash
from deepclouds.model.trust import FLOOR
from deepclouds_runtime.shared_levels import cut, halves, read_levels

if TYPE_CHECKING:
    from onnx import ModelProto

MODELS = Path(__file__).parent / "models"
# Released models, the default first.
RELEASED = ("accurate", "fast")
# A batch's stencils (9 kB each) and activations then fit into a core's second-level cache.
BATCH = 512
# Inputs that a medium fixes for all of its points.
_OF_MEDIUM = ("g1", "g2", "lobe_weight", "albedo")
# Training varies the unit of length by a factor of 2: a few per cent more or less in size are nothing new.
_SLACK_SIZE = 0.05


class Predictor:
    """j = 4 pi J / (albedo^2 E) from a model file that follows the contract (docs/contract.md).

    Parameters
    ----------
    model
        path of an ONNX file, or the name of a released model; None is the default one.
    threads
        threads of the network; None takes every processor.

    Attributes
    ----------
    path
        the file.
    metadata
        what the file says about itself.
    read
        levels of a stencil that the network looks at, finest first.

    Raises
    ------
    InputError
        when the file is missing or no ONNX file, lacks the metadata, follows another contract, or its weights are not those that the
        metadata was written for.
    """

    def __init__(self, model: str | Path | None = None, threads: int | None = None) -> None:
        if threads is not None and threads < 1:
            raise InputError(f"threads = {threads}: at least one thread is needed")
        self.path = find_model(model)
        data = _read(self.path)
        proto = _parse(data, self.path)
        self.metadata = _checked_metadata(proto, self.path)
        self._session = _session(data, self.path)
        self.read = read_levels(proto)
        self._data = data
        self._halves: dict[int, Halves | None] = {}
        # Several threads in one small product wait for each other most of the time; each has a batch of its own.
        self._threads = ThreadPoolExecutor(threads or os.cpu_count() or 1, thread_name_prefix="predictor")

    def predict(self, stencil: NDArray[np.float32], aux: NDArray[np.float32]) -> NDArray[np.float32]:
        """Predict j (n,) for stencils (n, 10, 225) and aux rows (n, 6), both float32 as the contract orders them.

        Raises
        ------
        ValueError
            for other shapes, and when an input or a prediction is not finite.
        """
        stencil, aux = np.ascontiguousarray(stencil, np.float32), np.ascontiguousarray(aux, np.float32)
        n = len(aux)
        if stencil.shape != (n, LEVELS, POINTS) or aux.shape != (n, len(AUX)):
            raise ValueError(f"expected (n, {LEVELS}, {POINTS}) and (n, {len(AUX)}), got {stencil.shape} and {aux.shape}")
        j = self._run(self._session, {INPUT_STENCIL: stencil, INPUT_AUX: aux}, 1)[0]
        return self._finite(j)

    def halves(self, shared: int) -> Halves | None:
        """The network cut in two where it has seen the `shared` coarsest levels; None where it cannot be cut there."""
        if shared not in self._halves:
            proto = _parse(self._data, self.path)
            tensor = cut(proto, shared)
            sessions = None if tensor is None else tuple(_session(part, self.path) for part in halves(proto, tensor))
            self._halves[shared] = None if tensor is None or sessions is None else Halves(self, shared, tensor, sessions)
        return self._halves[shared]

    def _run(self, session: Any, inputs: dict[str, NDArray[np.float32]], outputs: int) -> list[NDArray[np.float32]]:
        """All outputs of a graph, in batches, one a thread."""
        n = len(inputs[INPUT_AUX])
        # Equal ones, and an even number of them: of two threads neither waits for the other. The same for any number of threads, since how
        # a product is rounded may depend on its size.
        size = max(math.ceil(n / (2 * max(math.ceil(n / (2 * BATCH)), 1))), 1)
        found: list[list[NDArray[np.float32]]] = [[] for _ in range(outputs)]

        def run(start: int) -> list[NDArray[np.float32]]:
            result: list[NDArray[np.float32]] = session.run(None, {k: v[start : start + size] for k, v in inputs.items()})
            return result

        for part in self._threads.map(run, range(0, n, size)):
            for values, value in zip(found, part, strict=True):
                values.append(value)
        return [np.concatenate(values) if values else np.empty(0, np.float32) for values in found]

    def _finite(self, j: NDArray[np.float32]) -> NDArray[np.float32]:
        # The graph clamps its inputs, so only NaN gets through, from an input to the output or out of damaged weights.
        if not np.all(np.isfinite(j)):
            bad = np.count_nonzero(~np.isfinite(j))
            raise ValueError(f"{bad} of {len(j)} predictions of {self.path} are not finite; check the inputs for NaN")
        return j

    def errors(
        self,
        stencil: NDArray[np.float32],
        aux: NDArray[np.float32],
        j: NDArray[np.float32],
        coarse: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32] | None:
        """Errors (n,) to expect of predictions j (n,): root of the mean square, in units of j; None for a model that knows none.

        They rise with the distance from the training data and are calibrated on held-out labels: `deepclouds.model.trust`. Of levels
        that the stencils lack `coarse` has the means, see `deepclouds.model.trust.level_means`.
        """
        trust = self.metadata.trust
        if trust is None:
            return None
        result = np.empty(len(j), np.float32)

        def fill(start: int) -> None:
            rows = slice(start, start + BATCH)
            distance = trust.distance(stencil[rows], aux[rows], None if coarse is None else coarse[rows])
            result[rows] = trust.expected_error(distance, j[rows]) * (j[rows] + FLOOR)

        # What one batch reads again is still in the cache.
        list(self._threads.map(fill, range(0, len(j), BATCH)))
        return result

    def out_of_range(self, aux: NDArray[np.float32]) -> dict[str, int]:
        """How many of the rows `aux` (n, 6) lie outside of what the model was trained on, for every input."""
        counts = {}
        for column, spec in zip(np.asarray(aux, np.float64).T, AUX, strict=True):
            low, high = self.metadata.ranges[spec.name]
            # The range was measured in float32, possibly by another formula for the same angle.
            slack = 1e-4 * max(1.0, abs(low), abs(high))
            counts[spec.name] = int(np.count_nonzero(~((column >= low - slack) & (column <= high + slack))))
        return counts

    def outside(self, phase: tuple[float, float, float], albedos: Sequence[float], size: float | None = None) -> list[str]:
        """What of a medium lies outside of the training data, in words; nothing where the model knows it.

        Parameters
        ----------
        phase
            lobes (g1, g2, weight of lobe 1), in any order.
        albedos
            single-scattering albedos.
        size
            longest side of the cloud's box in mean free paths, see `deepclouds.volume.pyramid.optical_size`; None leaves it out, and so
            does a model that does not say what sizes it knows.
        """
        found: dict[str, str] = {}
        lobes = ordered_lobes(phase)
        for albedo in albedos:
            values = dict(zip(_OF_MEDIUM, (*lobes, albedo), strict=True))
            counts = self.out_of_range(aux_inputs(0.5 * np.pi, *lobes, albedo, 0.0))
            for name in _OF_MEDIUM:
                if counts[name]:
                    low, high = self.metadata.ranges[name]
                    found[name] = f"{name} = {values[name]:g} (trained on {low:g} to {high:g})"
        if size is not None and self.metadata.size is not None:
            low, high = self.metadata.size
            if not low * (1 - _SLACK_SIZE) <= size <= high * (1 + _SLACK_SIZE):
                found["size"] = f"a cloud of {size:.3g} mean free paths (trained on {low:g} to {high:g})"
        return list(found.values())


class Halves:
    """A network cut in two, see `deepclouds_runtime.shared_levels`.

    Parameters
    ----------
    whole
        the network.
    shared
        coarse levels that the first half sees.
    tensor
        name of what it hands on.
    sessions
        both halves; the first gives j too.
    """

    def __init__(self, whole: Predictor, shared: int, tensor: str, sessions: Sequence[Any]) -> None:
        self._whole, self.shared, self._tensor = whole, shared, tensor
        self._first, self._second = sessions

    def begin(self, stencil: NDArray[np.float32], aux: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """J (n,) as `Predictor.predict` has it, and what the network made of the coarse levels (n, width)."""
        j, latent = self._whole._run(self._first, {INPUT_STENCIL: stencil, INPUT_AUX: aux}, 2)
        return self._whole._finite(j), latent

    def finish(self, latent: NDArray[np.float32], stencil: NDArray[np.float32], aux: NDArray[np.float32]) -> NDArray[np.float32]:
        """J (n,) of what the network made of the coarse levels (n, width), the fine levels of stencils, and aux rows (n, 6)."""
        inputs = {INPUT_STENCIL: np.ascontiguousarray(stencil, np.float32), INPUT_AUX: aux, self._tensor: latent}
        return self._whole._finite(self._whole._run(self._second, inputs, 1)[0])


@lru_cache(maxsize=2)
def kept(model: str | None) -> Predictor:
    """`Predictor(model)`, loaded once for callers that name it again and again."""
    return Predictor(model)


def find_model(model: str | Path | None) -> Path:
    """The file that `model` means: a path, or the name of a released model.

    Raises
    ------
    InputError
        when there is no such file; the message lists the released ones.
    """
    name = RELEASED[0] if model is None else model
    is_name = isinstance(name, str) and not Path(name).suffix and "/" not in name and os.sep not in name
    path = MODELS / f"{name}.onnx" if is_name else Path(name)
    if path.is_file():
        return path
    if is_name:
        released = sorted(p.stem for p in MODELS.glob("*.onnx"))
        raise InputError(f"no released model is named '{name}'; there are: {', '.join(released) or 'none'}; a path ends in .onnx")
    raise InputError(f"{path}: no such model file; give the path of a file made by `deepclouds export` or the name of a released model")


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


def _parse(data: bytes, path: Path) -> ModelProto:
    # onnxruntime does not show a graph's initialisers, onnx does; it is imported here because nothing but loading needs it.
    import onnx

    try:
        model = onnx.load_from_string(data)
    except Exception as error:
        raise InputError(f"{path}: not an ONNX file, or cut short; export or download it again") from error
    if not model.graph.node:
        raise InputError(f"{path}: not an ONNX file: it holds no graph; export or download it again")
    return model


def _checked_metadata(model: ModelProto, path: Path) -> ModelMetadata:
    from onnx import numpy_helper

    metadata = ModelMetadata.from_properties({p.key: p.value for p in model.metadata_props}, str(path))
    metadata.require_this_contract(str(path))
    inputs, outputs = [v.name for v in model.graph.input], [v.name for v in model.graph.output]
    if inputs != [INPUT_STENCIL, INPUT_AUX] or outputs != [OUTPUT]:
        raise InputError(f"{path}: the graph maps {inputs} to {outputs}, the contract {[INPUT_STENCIL, INPUT_AUX]} to {[OUTPUT]}")
    try:
        found = initialiser_hash((i.name, numpy_helper.to_array(i)) for i in model.graph.initializer)
    except Exception as error:
        raise InputError(f"{path}: its weights cannot be read ({error}); export or download it again") from error
    if found != metadata.initialisers_sha256:
        raise InputError(
            f"{path}: the weights' sha256 is {found[:16]}..., the metadata says {metadata.initialisers_sha256[:16]}...; "
            "the file was damaged or edited: export or download it again"
        )
    return metadata


def _session(data: bytes, path: Path) -> Any:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise InputError(f"{path}: onnxruntime refuses the file ({error})") from error
