"""Conformance vectors: queries into a small cloud, their stencils and a model's outputs, for whoever implements the contract.

Two files. ``data/conformance.bin`` belongs to the contract and to no model: a volume, media that fill it, queries, the input ``aux``
of each, digests of every stencil and some stencils in full. ``models/NAME.conformance`` is text and belongs to the weights of one
model: its output j for every query. docs/renderer_authors.md describes both; `deepclouds verify` and runtime/cpp/verify.cpp read them.

``python -m deepclouds_runtime.conformance MODEL`` writes the second file for a model, and with ``--stencils FILE`` the first.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import struct
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from deepclouds.descriptor import LEVELS, POINTS, offsets
from deepclouds.errors import InputError
from deepclouds.model import AUX
from deepclouds.replacing import replacing
from deepclouds.volume import Volume

if TYPE_CHECKING:
    from deepclouds_runtime.predictor import Predictor

VECTORS = Path(__file__).parent / "data" / "conformance.bin"
SUFFIX = ".conformance"

# Largest difference that rounding may cause. Single precision reaches a tenth of each; the usual mistakes exceed them a thousandfold.
STENCIL_TOLERANCE = 2e-4
DIGEST_TOLERANCE = 2e-5
AUX_TOLERANCE = 2e-6
# Relative: what two runtimes may differ by (docs/contract.md), and the same again for the rounding of the stencils.
J_TOLERANCE = 2e-4

_MAGIC = b"DCCONF01"
_HEADER = "<8s6i3d"
QUERY_COLUMNS = 14
DIGESTS = 5


@dataclass(frozen=True)
class Medium:
    """One scaling of the volume, and the queries that belong to it.

    Attributes
    ----------
    scale
        extinction per unit of density, 1 / world unit.
    unit
        the descriptor's unit of length, world units.
    origin
        world point that the filter's cells are aligned to.
    default
        whether unit and origin are those that the contract prescribes, which an implementation then has to find by itself.
    first, count
        the medium's rows of the queries.
    """

    scale: float
    unit: float
    origin: tuple[float, ...]
    default: bool
    first: int
    count: int


@dataclass(frozen=True)
class Vectors:
    """The part of the conformance vectors that holds for every model.

    Attributes
    ----------
    volume
        the density; its values are exact in half precision.
    media
        scalings of it; together they own all queries.
    queries
        float32 (n, 14): point, w and omega_sun (three columns each, world space), g1, g2, lobe_weight, albedo, tau toward the sun.
    aux
        float32 (n, 6), the contract's input of that name.
    digests
        float32 (n, 10, 5), see `digests`.
    full_rows, full
        int32 (m,) rows of the queries whose stencils are stored, and those stencils, float32 (m, 10, 225).
    """

    volume: Volume
    media: tuple[Medium, ...]
    queries: NDArray[np.float32]
    aux: NDArray[np.float32]
    digests: NDArray[np.float32]
    full_rows: NDArray[np.int32]
    full: NDArray[np.float32]


@dataclass(frozen=True)
class Outputs:
    """What one model answers to the queries.

    Attributes
    ----------
    model
        the model's name.
    initialisers_sha256
        hash of its weights (docs/contract.md).
    vectors_sha256
        hash of the file of the vectors.
    j
        float32 (n,).
    """

    model: str
    initialisers_sha256: str
    vectors_sha256: str
    j: NDArray[np.float32]


def digest_weights() -> NDArray[np.float64]:
    """Weights (5, 225) of the digests of one level: 1, x / 2, y / 2, z / 6 with the offsets in spacings, and a fixed scramble.

    The first tells the density, the next three where it lies, so that they name a swapped or mirrored axis; the last, element i of
    which is ``(2654435761 i mod 2^32) / 2^31 - 1``, notices any other disorder. No weight exceeds 1.
    """
    x, y, z = offsets().T
    scramble = (np.arange(POINTS, dtype=np.uint64) * np.uint64(2654435761) % np.uint64(2**32)).astype(np.float64) / 2**31 - 1
    return np.stack([np.ones(POINTS), x / 2, y / 2, z / 6, scramble])


def digests(stencil: NDArray[np.float32]) -> NDArray[np.float32]:
    """Five weighted means (n, 10, 5) of each level of stencils (n, 10, 225), weights as in `digest_weights`."""
    values: NDArray[np.float32] = (stencil.astype(np.float64) @ (digest_weights().T / POINTS)).astype(np.float32)
    return values


def write_vectors(path: str | os.PathLike[str], vectors: Vectors) -> None:
    """Write the vectors as one binary file, little-endian, in the order of docs/renderer_authors.md."""
    volume = vectors.volume
    header = struct.pack(
        _HEADER,
        _MAGIC,
        *volume.resolution,
        len(vectors.media),
        len(vectors.queries),
        len(vectors.full),
        STENCIL_TOLERANCE,
        DIGEST_TOLERANCE,
        AUX_TOLERANCE,
    )
    media = np.array([(m.scale, m.unit, *m.origin, m.default, m.first, m.count) for m in vectors.media])
    arrays = [
        volume.to_world.astype("<f8"),
        media.astype("<f8"),
        volume.density.astype("<f4"),
        vectors.queries.astype("<f4"),
        vectors.aux.astype("<f4"),
        vectors.digests.astype("<f4"),
        vectors.full_rows.astype("<i4"),
        vectors.full.astype("<f4"),
    ]
    with replacing(path) as temporary:
        temporary.write_bytes(header + b"".join(a.tobytes() for a in arrays))


def read_vectors(path: str | os.PathLike[str] = VECTORS) -> Vectors:
    """Read what `write_vectors` wrote.

    Raises
    ------
    InputError
        when the file is missing, something else, or cut short.
    """
    data = _read_bytes(Path(path))
    size = struct.calcsize(_HEADER)
    if len(data) < size or data[:8] != _MAGIC:
        raise InputError(f"{path}: no conformance vectors of this version; take the file that comes with deepclouds")
    nx, ny, nz, media_count, count, full_count, *_ = struct.unpack(_HEADER, data[:size])[1:]
    shapes = [
        ("<f8", (4, 4)),
        ("<f8", (media_count, 8)),
        ("<f4", (nz, ny, nx)),
        ("<f4", (count, QUERY_COLUMNS)),
        ("<f4", (count, len(AUX))),
        ("<f4", (count, LEVELS, DIGESTS)),
        ("<i4", (full_count,)),
        ("<f4", (full_count, LEVELS, POINTS)),
    ]
    expected = size + sum(np.dtype(kind).itemsize * int(np.prod(shape)) for kind, shape in shapes)
    if len(data) != expected:
        raise InputError(f"{path}: {len(data)} bytes where {expected} belong; the file was cut short or edited, take another copy")
    arrays, place = [], size
    for kind, shape in shapes:
        arrays.append(np.frombuffer(data, kind, int(np.prod(shape)), place).reshape(shape))
        place += arrays[-1].nbytes
    to_world, media, density, queries, aux, digest, full_rows, full = arrays
    return Vectors(
        volume=Volume(density, to_world),
        media=tuple(Medium(m[0], m[1], tuple(m[2:5]), bool(m[5]), int(m[6]), int(m[7])) for m in media.tolist()),
        queries=queries,
        aux=aux,
        digests=digest,
        full_rows=full_rows,
        full=full,
    )


def make_outputs(predictor: Predictor, stencil: NDArray[np.float32], vectors: Vectors, path: Path = VECTORS) -> Outputs:
    """The outputs of a model for the `stencil` of every query of the `vectors`, which the file `path` holds."""
    metadata = predictor.metadata
    return Outputs(metadata.name, metadata.initialisers_sha256, _sha256(path), predictor.predict(stencil, vectors.aux))


def write_outputs(path: str | os.PathLike[str], outputs: Outputs) -> None:
    """Write the outputs as text: names and values in the first lines, then ``j`` and one number a line."""
    head = [
        "deepclouds_conformance 1",
        f"model {outputs.model}",
        f"initialisers_sha256 {outputs.initialisers_sha256}",
        f"vectors_sha256 {outputs.vectors_sha256}",
        f"relative_tolerance {J_TOLERANCE:g}",
        f"j {len(outputs.j)}",
    ]
    with replacing(path, SUFFIX) as temporary:
        temporary.write_text("\n".join(head + [f"{value:.9g}" for value in outputs.j]) + "\n", encoding="utf-8")


def read_outputs(path: str | os.PathLike[str]) -> Outputs:
    """Read what `write_outputs` wrote.

    Raises
    ------
    InputError
        when the file is missing, something else, or cut short.
    """
    lines = _read_bytes(Path(path)).decode("utf-8", "replace").splitlines()
    fields = {key: value for key, _, value in (line.partition(" ") for line in lines[:6])}
    names = ("deepclouds_conformance", "model", "initialisers_sha256", "vectors_sha256", "relative_tolerance", "j")
    try:
        if tuple(fields) != names or fields["deepclouds_conformance"] != "1":
            raise ValueError
        j = np.array([float(line) for line in lines[6:]], np.float32)
        if len(j) != int(fields["j"]):
            raise ValueError
    except ValueError:
        raise InputError(f"{path}: not a whole file of conformance outputs; make it again with `{_COMMAND}`") from None
    return Outputs(fields["model"], fields["initialisers_sha256"], fields["vectors_sha256"], j)


def find_outputs(model: Path, initialisers_sha256: str, vectors: Path = VECTORS) -> Outputs | None:
    """The outputs that belong to a model file: those beside it, or those of a released model with the same weights; None without any.

    Raises
    ------
    InputError
        when the file beside the model belongs to other weights or other vectors.
    """
    from deepclouds_runtime.predictor import MODELS

    beside = model.with_suffix(SUFFIX)
    for path in dict.fromkeys([beside, *sorted(MODELS.glob(f"*{SUFFIX}"))]):
        if not path.is_file():
            continue
        outputs = read_outputs(path)
        same = outputs.initialisers_sha256 == initialisers_sha256
        if path == beside and not same:
            raise InputError(f"{path} belongs to other weights than {model}; make it again with `{_COMMAND}`")
        if same and outputs.vectors_sha256 != _sha256(vectors):
            raise InputError(f"{path} belongs to other vectors than {vectors}; make it again with `{_COMMAND}`")
        if same:
            return outputs
    return None


_COMMAND = "python -m deepclouds_runtime.conformance MODEL"


def main(argv: Sequence[str]) -> int:
    """Write the outputs of a model for the conformance vectors, or the vectors themselves."""
    from deepclouds_runtime._conformance_vectors import all_stencils, make_vectors
    from deepclouds_runtime.predictor import Predictor

    parser = argparse.ArgumentParser(prog=_COMMAND.rpartition(" ")[0], description="Make the conformance vectors of a model.")
    parser.add_argument("model", metavar="MODEL", nargs="?", help="the .onnx file or the name of a released model")
    parser.add_argument(
        "-o", "--output", metavar=f"OUT{SUFFIX}", type=Path, help=f"file to write (default: MODEL with the suffix {SUFFIX})"
    )
    parser.add_argument(
        "--stencils", metavar="FILE", type=Path, help="make the vectors anew first; every model's outputs are then out of date"
    )
    options = parser.parse_args(argv)
    if options.model is None and options.stencils is None:
        parser.error("nothing to make: name a MODEL, or --stencils FILE")
    if options.stencils is not None:
        write_vectors(options.stencils, make_vectors())
        print(f"wrote {options.stencils}")
    if options.model is not None:
        path = options.stencils or VECTORS
        vectors, predictor = read_vectors(path), Predictor(options.model)
        output = options.output or predictor.path.with_suffix(SUFFIX)
        write_outputs(output, make_outputs(predictor, all_stencils(vectors), vectors, path))
        print(f"wrote {output}")
    return 0


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


def _sha256(path: Path) -> str:
    return hashlib.sha256(_read_bytes(path)).hexdigest()


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except InputError as error:
        print(f"{_COMMAND}: {error}", file=sys.stderr)
        sys.exit(2)
