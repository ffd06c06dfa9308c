"""The labelled data set on disk: a folder of shards and a manifest.

One shard is one cloud: its density, the points and directions asked about, and their labels. Layout and units: docs/dataset.md.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepclouds.errors import InputError
from deepclouds.replacing import replacing
from deepclouds.volume import Volume

SCHEMA = 1
MANIFEST = "manifest.json"

# Kinds of points; docs/dataset.md says how each is drawn.
FIRST_COLLISION, SECOND_COLLISION, ANYWHERE = 0, 1, 2


@dataclass(frozen=True)
class ShardInfo:
    """A shard as the manifest lists it: number, file name, cloud family, "train" or "valid", points, SHA-256 of the file."""

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
    point, w, g, kind
        (n, 3) world points, (n, 3) unit directions of the camera ray's travel, (n,) Henyey-Greenstein parameters, (n,) uint8.
    omega_sun, tau_sun
        (n, k, 3) unit directions TOWARD the suns and (n, k) optical depths that way.
    albedo
        (n, m) single-scattering albedos.
    label, error
        (n, k, m) noisy unbiased ``4 pi J / (albedo^2 E)`` and its standard error.
    """

    volume: Volume
    scale: float
    point: NDArray[np.float32]
    w: NDArray[np.float32]
    g: NDArray[np.float32]
    kind: NDArray[np.uint8]
    omega_sun: NDArray[np.float32]
    tau_sun: NDArray[np.float32]
    albedo: NDArray[np.float32]
    label: NDArray[np.float32]
    error: NDArray[np.float32]


_ARRAYS = ("point", "w", "g", "kind", "omega_sun", "tau_sun", "albedo", "label", "error")


def shard_file(index: int) -> str:
    """File name of shard `index`."""
    return f"shard_{index:05d}.npz"


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file under a temporary name beside it and rename it, so that it is there whole or not at all."""
    with replacing(path) as temporary, temporary.open("wb") as stream:
        stream.write(data)
        stream.flush()
        # A machine that stops right after the renaming must not leave an empty file under the final name.
        os.fsync(stream.fileno())


def write_shard(path: Path, shard: Shard, header: Mapping[str, Any]) -> str:
    """Write one shard with its JSON `header`; returns the SHA-256 of the file. Density is stored as float16: round it before tracing."""
    stream = io.BytesIO()
    arrays = {name: getattr(shard, name) for name in _ARRAYS}
    np.savez_compressed(
        stream,
        header=np.array(json.dumps(dict(header), sort_keys=True)),
        density=shard.volume.density.astype(np.float16),
        to_world=shard.volume.to_world,
        scale=np.float64(shard.scale),
        **arrays,
    )
    data = stream.getvalue()
    write_atomically(path, data)
    return hashlib.sha256(data).hexdigest()


def read_shard(path: Path) -> tuple[Shard, dict[str, Any]]:
    """Read a shard and its header.

    Raises
    ------
    InputError
        when the file is missing, truncated or no shard.
    """
    try:
        # Opened here: numpy leaves a file of its own open when the archive in it is damaged.
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            header = json.loads(str(stored["header"]))
            volume = Volume(stored["density"].astype(np.float32), stored["to_world"])
            return Shard(volume=volume, scale=float(stored["scale"]), **{name: stored[name] for name in _ARRAYS}), header
    except FileNotFoundError:
        raise InputError(f"{path}: no such shard; run `deepclouds generate` again to make it") from None
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
        """Read one shard."""
        return read_shard(self.folder / info.file)[0]


def write_manifest(folder: Path, manifest: Mapping[str, Any], shards: Mapping[int, ShardInfo]) -> None:
    """Write the manifest of a folder: schema, configuration and its hash, and every finished shard."""
    content = dict(manifest)
    content["schema"] = SCHEMA
    content["shards"] = [vars(shards[index]) for index in sorted(shards)]
    write_atomically(folder / MANIFEST, json.dumps(content, indent=1, sort_keys=True).encode())


def open_dataset(folder: str | Path) -> Dataset:
    """Open the data set in `folder`.

    Raises
    ------
    InputError
        when there is no manifest, it is not readable, or its schema is another.
    """
    folder = Path(folder)
    path = folder / MANIFEST
    try:
        manifest = json.loads(path.read_text())
        shards = tuple(ShardInfo(**entry) for entry in manifest["shards"])
        schema = manifest["schema"]
    except FileNotFoundError:
        raise InputError(f"{path}: no data set there; make one with `deepclouds generate CONFIG.toml -o {folder}`") from None
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: not a manifest of a data set ({error})") from error
    if schema != SCHEMA:
        raise InputError(f"{path}: schema {schema}, this version reads {SCHEMA}; generate the data set again")
    return Dataset(folder, manifest, shards)
