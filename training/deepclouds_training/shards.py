"""The labelled data set on disk: a folder of shards, a record beside each, and a manifest of what was asked for.

One shard is one cloud: its density, the points and directions asked about, and their labels. Layout and units: docs/dataset.md.
The manifest depends on the configuration alone and a record on its shard alone, so that many machines can write into one folder.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepclouds.errors import InputError
from deepclouds.replacing import replacing
from deepclouds.volume import Volume

SCHEMA = 2
MANIFEST = "manifest.json"

# Kinds of points; docs/dataset.md says how each is drawn.
FIRST_COLLISION, SECOND_COLLISION, ANYWHERE, BESIDE, INSIDE = range(5)


@dataclass(frozen=True)
class ShardInfo:
    """A shard's record: number, file name, cloud family, "train" or "valid", points, SHA-256 of the file."""

    index: int
    file: str
    family: str
    split: str
    count: int
    sha256: str


@dataclass(frozen=True)
class Shard:
    """One cloud with n points, k suns a point and m albedos a point.

    Attributes
    ----------
    volume, scale
        density and extinction per unit of density.
    point, w, phase, kind
        (n, 3) world points, (n, 3) unit directions of the camera ray's travel, (n, 3) phase functions as rows (g1, g2, weight),
        (n,) uint8.
    omega_sun, tau_sun
        (n, k, 3) unit directions TOWARD the suns and (n, k) optical depths that way.
    albedo
        (n, m) single-scattering albedos.
    half, error
        (n, k, m, 2) noisy unbiased ``4 pi J / (albedo^2 E)``, twice from independent walks, and (n, k, m) standard error of their mean.
    walks
        (n,) walks of the point, both halves together.
    """

    volume: Volume
    scale: float
    point: NDArray[np.float32]
    w: NDArray[np.float32]
    phase: NDArray[np.float32]
    kind: NDArray[np.uint8]
    omega_sun: NDArray[np.float32]
    tau_sun: NDArray[np.float32]
    albedo: NDArray[np.float32]
    half: NDArray[np.float32]
    error: NDArray[np.float32]
    walks: NDArray[np.int32]

    @property
    def label(self) -> NDArray[np.float32]:
        """(n, k, m) mean of the two halves, which have as many walks each."""
        mean: NDArray[np.float32] = self.half.mean(axis=-1)
        return mean


_ARRAYS = ("point", "w", "phase", "kind", "omega_sun", "tau_sun", "albedo", "half", "error", "walks")


def shard_file(index: int) -> str:
    """File name of shard `index`."""
    return f"shard_{index:05d}.npz"


def record_file(file: str) -> str:
    """Name of the record of the shard in `file`."""
    return str(Path(file).with_suffix(".json"))


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file under a temporary name beside it and rename it, so that it is there whole or not at all.

    Raises
    ------
    InputError
        when the disk is full or refuses the file; nothing is left of it then.
    """
    try:
        with replacing(path) as temporary, temporary.open("wb") as stream:
            stream.write(data)
            stream.flush()
            # A machine that stops right after the renaming must not leave an empty file under the final name.
            os.fsync(stream.fileno())
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); make room or give another folder, then run it again") from error


def write_shard(path: Path, shard: Shard, header: Mapping[str, Any]) -> str:
    """Write one shard with its JSON `header`; returns the SHA-256 of the file. Density is stored as float16: round it before tracing."""
    arrays: dict[str, NDArray[Any]] = {
        "header": np.array(json.dumps(dict(header), sort_keys=True)),
        "density": shard.volume.density.astype(np.float16),
        "to_world": shard.volume.to_world,
        "scale": np.array(shard.scale, np.float64),
        **{name: getattr(shard, name) for name in _ARRAYS},
    }
    stream = io.BytesIO()
    # As numpy.savez_compressed writes it, at the fastest level: labels are noise, and large grids are mostly zeros.
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, values in arrays.items():
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asanyarray(values), allow_pickle=False)
    data = stream.getvalue()
    write_atomically(path, data)
    return hashlib.sha256(data).hexdigest()


def check_shard(path: Path, sha256: str | None) -> bytes:
    """The bytes of a shard's file, held against `sha256` where that is given.

    Raises
    ------
    InputError
        when the file is missing, or its bytes are not those that were written.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: no such shard ({error.strerror}); run `deepclouds generate` again to make it") from None
    if sha256 is not None and hashlib.sha256(data).hexdigest() != sha256:
        raise InputError(f"{path}: its bytes are not those of its record; run `deepclouds generate` again, it makes the shard anew")
    return data


def read_shard(path: Path, sha256: str | None = None) -> tuple[Shard, dict[str, Any]]:
    """Read a shard and its header, and hold its bytes against `sha256` where that is given.

    Raises
    ------
    InputError
        when the file is missing, truncated, not the one that was written, or no shard.
    """
    data = check_shard(path, sha256)
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as stored:
            header = json.loads(str(stored["header"]))
            volume = Volume(stored["density"].astype(np.float32), stored["to_world"])
            return Shard(volume=volume, scale=float(stored["scale"]), **{name: stored[name] for name in _ARRAYS}), header
    except Exception as error:
        raise InputError(f"{path}: not a readable shard ({error}); delete it and run `deepclouds generate` again") from error


@dataclass(frozen=True)
class Dataset:
    """An opened data set: its manifest and its finished shards."""

    folder: Path
    manifest: dict[str, Any]
    shards: tuple[ShardInfo, ...]

    @property
    def hash(self) -> str:
        """SHA-256 over the shards' own hashes, in order."""
        return hashlib.sha256("".join(s.sha256 for s in self.shards).encode()).hexdigest()

    def load(self, info: ShardInfo) -> Shard:
        """Read one shard; InputError when its bytes are not those that were written."""
        return read_shard(self.folder / info.file, info.sha256)[0]


def write_manifest(folder: Path, manifest: Mapping[str, Any]) -> None:
    """Write the manifest of a folder: the schema, and what the data set is to hold. It does not change while shards are added."""
    content = {**manifest, "schema": SCHEMA}
    write_atomically(folder / MANIFEST, json.dumps(content, indent=1, sort_keys=True).encode())


def write_record(folder: Path, info: ShardInfo) -> None:
    """Write the record of a shard that is complete; without it the shard does not count."""
    write_atomically(folder / record_file(info.file), json.dumps(vars(info), indent=1, sort_keys=True).encode())


def open_dataset(folder: str | Path) -> Dataset:
    """Open the data set in `folder`: its manifest and every shard that has a record.

    Raises
    ------
    InputError
        when there is no manifest, it or a record is not readable, or the schema is another.
    """
    folder = Path(folder)
    path = folder / MANIFEST
    try:
        manifest = json.loads(path.read_text())
        schema = manifest["schema"]
    except FileNotFoundError:
        raise InputError(f"{path}: no data set there; make one with `deepclouds generate CONFIG.toml -o {folder}`") from None
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: not a manifest of a data set ({error})") from error
    if schema != SCHEMA:
        raise InputError(f"{path}: schema {schema}, this version reads {SCHEMA}; generate the data set again")
    shards = []
    for record in folder.glob("shard_*.json"):
        try:
            shards.append(ShardInfo(**json.loads(record.read_text())))
        except (ValueError, TypeError) as error:
            raise InputError(f"{record}: not a record of a shard ({error}); delete it and run `deepclouds generate` again") from error
    return Dataset(folder, manifest, tuple(sorted(shards, key=lambda s: s.index)))
