"""Mitsuba's binary .vol files, version 3: one channel on a regular grid inside an axis-aligned box.

Layout, little-endian: ``VOL``, version (1 byte), value type, nx, ny, nz, channels (int32 each), box minimum and maximum (6 x float32),
then the values, x fastest. Value type 1 is float32, 2 float16, 3 uint8 (0 to 255 stand for 0 to 1). Mitsuba 3 itself reads type 1 alone.

Source: Mitsuba's documentation of the ``gridvolume`` plugin.
"""

from __future__ import annotations

import struct
from os import PathLike
from pathlib import Path

import numpy as np

from deepclouds.errors import InputError
from deepclouds.replacing import replacing
from deepclouds.volume._clean import clean
from deepclouds.volume._volume import Volume

_HEADER = struct.Struct("<3sB5i6f")
_FLOAT32 = 1
_VALUE_TYPES: dict[int, np.dtype[np.float32] | np.dtype[np.float16] | np.dtype[np.uint8]] = {
    _FLOAT32: np.dtype("<f4"),
    2: np.dtype("<f2"),
    3: np.dtype("u1"),
}


def read_vol(path: str | PathLike[str], clamp: bool = False) -> Volume:
    """Read a .vol file and place it in its own box.

    Parameters
    ----------
    path
        a binary .vol file of version 3 with one channel.
    clamp
        set negative values and NaN to 0 instead of refusing them.

    Raises
    ------
    InputError
        when the file is missing, is not such a file, has another length than its header says, or holds values that are no density.
    """
    file = Path(path)
    if file.is_dir():
        raise InputError(f"{file} is a folder; name a .vol file")
    try:
        content = file.read_bytes()
    except FileNotFoundError as error:
        raise InputError(f"{file}: no such file") from error
    except OSError as error:
        raise InputError(f"{file}: {error.strerror}") from error
    if len(content) < _HEADER.size or content[:3] != b"VOL":
        raise InputError(f"{file} is not a binary .vol file: it does not begin with 'VOL' and a header of {_HEADER.size} bytes")
    _, version, kind, nx, ny, nz, channels, *box = _HEADER.unpack_from(content)
    if version != 3:
        raise InputError(f"{file} is a .vol file of version {version}; only version 3 is known")
    if kind not in _VALUE_TYPES:
        raise InputError(f"{file} holds values of type {kind}; known are 1 (float32), 2 (float16) and 3 (uint8)")
    if channels != 1:
        raise InputError(f"{file} has {channels} channels; a density has one")
    if min(nx, ny, nz) < 1:
        raise InputError(f"{file}: its header claims {nx} x {ny} x {nz} voxels; the file is damaged")
    dtype = _VALUE_TYPES[kind]
    expected = _HEADER.size + nx * ny * nz * dtype.itemsize
    if len(content) != expected:
        raise InputError(f"{file}: {nx} x {ny} x {nz} voxels need {expected} bytes, the file has {len(content)}; it is damaged")
    if not np.all(np.isfinite(box)) or any(low >= high for low, high in zip(box[:3], box[3:], strict=True)):
        raise InputError(f"{file}: its box from {box[:3]} to {box[3:]} has no volume")
    values = np.frombuffer(content, dtype, offset=_HEADER.size).reshape(nz, ny, nx).astype(np.float32)
    if dtype.kind == "u":
        values = values / np.float32(255)
    return Volume.from_box(clean(values, str(file), clamp), box[:3], box[3:])


def write_vol(path: str | PathLike[str], volume: Volume) -> None:
    """Write `volume` as a float32 .vol file; the box is rounded to float32.

    Raises
    ------
    InputError
        when the volume's axes are not those of the world, or the folder is missing.
    """
    file = Path(path)
    edges = np.diag(volume.to_world)[:3]
    off_axis = volume.to_world[:3, :3] - np.diag(edges)
    if np.any(edges <= 0) or np.abs(off_axis).max() > 1e-7 * edges.max():
        raise InputError(
            f"{file}: a .vol file's box is aligned with the world's axes, this volume is rotated or mirrored; write a .vdb file"
        )
    lower = volume.to_world[:3, 3]
    header = _HEADER.pack(b"VOL", 3, _FLOAT32, *volume.resolution, 1, *lower, *(lower + edges))
    with replacing(file) as temporary, temporary.open("wb") as stream:
        stream.write(header)
        stream.write(volume.density.astype("<f4", copy=False).tobytes())
