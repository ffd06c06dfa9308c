"""`deepclouds verify MODEL`: stencils and network outputs on this machine against the conformance vectors."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepclouds_runtime.conformance import (
    AUX_TOLERANCE,
    DIGEST_TOLERANCE,
    J_TOLERANCE,
    STENCIL_TOLERANCE,
    VECTORS,
    Medium,
    Vectors,
    digests,
    find_outputs,
    read_vectors,
)

# A midpoint march with steps of half a voxel against the integral itself: 5 % of a large tau.
TAU_TOLERANCE = 0.05


@dataclass(frozen=True)
class Comparison:
    """The largest difference between what was computed here and what is stored.

    Attributes
    ----------
    name
        what was compared.
    compared
        how many values of which kind, for people.
    largest
        the largest difference; relative where `name` says so.
    tolerance
        the largest that passes.
    """

    name: str
    compared: str
    largest: float
    tolerance: float

    @property
    def passed(self) -> bool:
        """Whether the difference is within the tolerance; NaN is not."""
        return self.largest <= self.tolerance


def kernel_stencils(types: ModuleType, vectors: Vectors) -> NDArray[np.float32]:
    """Stencils (n, 10, 225) of all queries by the Dr.Jit kernel on the backend `types`."""
    from deepclouds.descriptor import Descriptor
    from deepclouds.medium.field import Field

    parts = []
    for medium in vectors.media:
        field = Field(types, vectors.volume, medium.scale)
        descriptor = Descriptor(field) if medium.default else Descriptor(field, medium.unit, medium.origin)
        rows = _rows(vectors, medium)
        parts.append(descriptor.stencils_numpy(rows[:, 0:3], rows[:, 3:6], rows[:, 6:9]))
    return np.concatenate(parts)


def kernel_aux(types: ModuleType, vectors: Vectors) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The input `aux` (n, 6) as the renderer makes it from the stored tau, and tau (n,) by the renderer's own sum over cells."""
    import drjit as dr

    from deepclouds.backend import vectors_of
    from deepclouds.medium.field import Field
    from deepclouds.medium.optical_depth import optical_depth
    from deepclouds.model import aux_inputs

    rows = vectors.queries
    w, sun = vectors_of(types, rows[:, 3:6]), vectors_of(types, rows[:, 6:9])
    gamma = np.array(dr.atan2(dr.norm(dr.cross(w, sun)), dr.dot(w, sun)))
    depths = []
    for medium in vectors.media:
        part = _rows(vectors, medium)
        field, zero = Field(types, vectors.volume, medium.scale), types.Float(0)
        points, toward = vectors_of(types, part[:, 0:3]), vectors_of(types, part[:, 6:9])
        tau = optical_depth(field, points, toward, zero, types.Float(math.inf), types.Bool(True), math.inf)
        depths.append(np.array(tau))
    return aux_inputs(gamma, *(rows[:, c] for c in range(9, 14))), np.concatenate(depths)


def compare_inputs(vectors: Vectors, stencil: NDArray[np.float32], aux: NDArray[np.float32]) -> list[Comparison]:
    """Hold stencils (n, 10, 225) and the input aux (n, 6) of all queries against the vectors."""
    n, full = len(vectors.queries), len(vectors.full)
    return [
        Comparison("stencil", f"{full} stencils of 10 x 225 values", _largest(stencil[vectors.full_rows], vectors.full), STENCIL_TOLERANCE),
        Comparison(
            "digest", f"5 weighted means of 10 levels of {n} stencils", _largest(digests(stencil), vectors.digests), DIGEST_TOLERANCE
        ),
        Comparison("aux", f"{n} rows of 6 inputs", _largest(aux, vectors.aux), AUX_TOLERANCE),
    ]


def compare_outputs(expected: NDArray[np.float32], j: NDArray[np.float32]) -> Comparison:
    """Hold a network's outputs j (n,) against the stored ones."""
    return Comparison("j", f"{len(j)} outputs, relative", _largest(j / expected, np.ones_like(expected)), J_TOLERANCE)


def main(argv: Sequence[str], prog: str = "deepclouds verify") -> int:
    """Compare, print the largest differences; returns 0 when all are within their tolerances and 1 otherwise."""
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Check that stencils and a model's outputs are on this machine what they were where the model was released: "
        "our kernel and onnxruntime against stored vectors. Exit code 0: all within the tolerances; 1: not; 2: bad input.",
    )
    parser.add_argument(
        "model", metavar="MODEL", nargs="?", help="an .onnx file or the name of a released model (default: the default one)"
    )
    parser.add_argument("--vectors", metavar="FILE", type=Path, default=VECTORS, help="other conformance vectors than those of deepclouds")
    parser.add_argument("--backend", choices=("llvm", "cuda"), default="llvm", help="where the kernel runs (default %(default)s)")
    options = parser.parse_args(argv)

    from deepclouds.backend import backend
    from deepclouds_runtime.predictor import Predictor

    predictor = Predictor(options.model)
    vectors = read_vectors(options.vectors)
    outputs = find_outputs(predictor.path, predictor.metadata.initialisers_sha256, options.vectors)
    types = backend(options.backend)
    stencil = kernel_stencils(types, vectors)
    aux, tau = kernel_aux(types, vectors)
    found = compare_inputs(vectors, stencil, aux)
    depth = _largest(np.log1p(tau), vectors.aux[:, 5])
    found.append(Comparison("tau", f"{len(tau)} ray marches, as log1p(tau)", depth, TAU_TOLERANCE))
    if outputs is not None:
        found.append(compare_outputs(outputs.j, predictor.predict(stencil, aux)))

    resolution = " x ".join(map(str, vectors.volume.resolution))
    print(f"model    {predictor.path}, weights {predictor.metadata.initialisers_sha256[:16]}")
    print(f"vectors  {len(vectors.queries)} queries into a cloud of {resolution} samples, {len(vectors.media)} media")
    for one in found:
        verdict = "ok" if one.passed else "FAILED"
        print(f"{one.name:8} {one.compared:45} largest difference {one.largest:8.2g}, tolerance {one.tolerance:.0e}: {verdict}")
    if outputs is None:
        print("j        not compared: no outputs are stored for these weights; `python -m deepclouds_runtime.conformance` stores them")
    return 0 if all(one.passed for one in found) else 1


def _rows(vectors: Vectors, medium: Medium) -> NDArray[np.float32]:
    return vectors.queries[medium.first : medium.first + medium.count]


def _largest(a: NDArray[Any], b: NDArray[Any]) -> float:
    return float(np.max(np.abs(a.astype(np.float64) - b)))
