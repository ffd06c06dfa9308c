"""OpenVDB files: what they hold, one fog volume as a `Volume`, and a `Volume` as a fog volume.

Voxel centres lie at integer indices, so the box of a grid whose active voxels run from ``min`` to ``max`` is the index range
``[min - 0.5, max + 0.5]``: half a voxel beyond the outermost centres on every side.

Source: K. Museth, "VDB: High-Resolution Sparse Volumes with Dynamic Topology", ACM TOG 32(3), 2013; the OpenVDB library reads the file.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deepclouds.errors import EmptyGridError, InputError
from deepclouds.replacing import replacing
from deepclouds.volume import _openvdb
from deepclouds.volume._clean import clean
from deepclouds.volume._volume import Volume
from deepclouds.volume.bricks import BRICK_VOXELS, Bricks
from deepclouds.volume.sparse import MAX_VOXELS, SparseVolume

DENSE_VOXELS = 2**26
"""Boxes up to this many voxels, 256 MiB, are read densely: lookups are quicker there."""

MAX_BOX = 2**36
"""Largest box that is read: what points at its bricks takes 4 GiB. A grid with two far-flung voxels must not exhaust the machine."""

# OpenVDB keeps its own facts among a grid's metadata, under these names.
_RESERVED = ("class", "name", "is_local_space", "is_saved_as_half_float", "vector_type", "value_type")


@dataclass(frozen=True, eq=False)
class GridInfo:
    """One grid of a .vdb file.

    Attributes
    ----------
    name
        the name, as written in the file.
    unique_name
        the name, with ``[0]``, ``[1]``, ... where a file has several grids of one name; `read_vdb` accepts either.
    value_type
        ``float``, ``vec3s``, ``int32``, ...
    half
        whether values are stored with 16 bits.
    grid_class
        ``fog volume``, ``level set``, ``staggered`` or ``unknown``.
    transform_type
        OpenVDB's name of the map from index to world space; empty when OpenVDB does not know the grid's type.
    index_to_world
        float64 (4, 4), acting on column vectors; None for frustums.
    voxel_size
        edge lengths along the grid's x, y and z axes, world units; zeros for frustums.
    active_voxels
        how many voxels are active, those inside active tiles included.
    index_box
        smallest and largest index (x, y, z) of an active voxel, both inside; None for an empty grid.
    bricks
        how many bricks of 8^3 voxels of the box hold something; None for grids that are not of floats, empty, or too large to be read.
    metadata
        the grid's metadata; values that are neither text, number nor truth value appear as text.
    """

    name: str
    unique_name: str
    value_type: str
    half: bool
    grid_class: str
    transform_type: str
    index_to_world: NDArray[np.float64] | None
    voxel_size: tuple[float, float, float]
    active_voxels: int
    index_box: tuple[tuple[int, int, int], tuple[int, int, int]] | None
    bricks: int | None
    metadata: Mapping[str, str | int | float | bool]


@contextmanager
def _native_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except MemoryError as error:
        raise InputError(f"{path}: not enough memory to read it, or the file is damaged") from error
    except RuntimeError as error:
        raise InputError(f"{path}: not a readable OpenVDB file: {error}") from error


def _existing(path: str | PathLike[str]) -> Path:
    file = Path(path)
    if file.is_dir():
        raise InputError(f"{file} is a folder; name a .vdb file")
    if not file.is_file():
        raise InputError(f"{file}: no such file")
    return file


def list_grids(path: str | PathLike[str]) -> list[GridInfo]:
    """Describe every grid of a .vdb file; reads the whole file.

    Raises
    ------
    InputError
        when the file is missing, damaged or not an OpenVDB file.
    """
    file = _existing(path)
    grids = []
    with _native_errors(file):
        for index, header in enumerate(_openvdb.read_headers(str(file))):
            name, unique, kind, half = header["name"], header["unique_name"], header["value_type"], header["half"]
            if not header["known"]:
                grids.append(GridInfo(name, unique, kind, half, "unknown", "", None, (0.0, 0.0, 0.0), 0, None, None, {}))
                continue
            d = _openvdb.describe_grid(str(file), index)
            bricks = _openvdb.count_bricks(str(file), index, MAX_VOXELS) if kind == "float" else None
            matrix = None if d["index_to_world"] is None else np.array(d["index_to_world"], np.float64)
            grids.append(
                GridInfo(
                    name,
                    unique,
                    kind,
                    half,
                    d["grid_class"],
                    d["transform_type"],
                    matrix,
                    d["voxel_size"],
                    d["active_voxels"],
                    d["index_box"],
                    bricks,
                    d["metadata"],
                )
            )
    return grids


def _choose(file: Path, headers: Sequence[_openvdb.Header], grid: str | None) -> int:
    """Index of the grid that `grid` names; without a name the only float grid, or else the one called ``density``."""
    listing = ", ".join(f"{h['unique_name']} ({h['value_type']})" for h in headers) or "none"
    floats = [i for i, h in enumerate(headers) if h["value_type"] == "float"]
    if grid is None:
        if len(floats) != 1:
            floats = [i for i in floats if headers[i]["name"] == "density"]
        if len(floats) == 1:
            return floats[0]
        raise InputError(
            f"{file}: name the grid to read; there is no single float grid, and no single one called 'density'. Grids: {listing}"
        )
    return _named(file, headers, grid, ("float",))


def _named(file: Path, headers: Sequence[_openvdb.Header], grid: str, kinds: tuple[str, ...]) -> int:
    """Index of the grid called `grid`, which has to hold values of one of the `kinds`."""
    listing = ", ".join(f"{h['unique_name']} ({h['value_type']})" for h in headers) or "none"
    matches = [i for i, h in enumerate(headers) if h["unique_name"] == grid] or [i for i, h in enumerate(headers) if h["name"] == grid]
    if not matches:
        raise InputError(f"{file}: no grid called '{grid}'. Grids: {listing}")
    if len(matches) > 1:
        raise InputError(f"{file}: {len(matches)} grids are called '{grid}'; add the number in brackets. Grids: {listing}")
    kind = headers[matches[0]]["value_type"]
    if kind not in kinds:
        raise InputError(f"{file}: the grid '{grid}' holds {kind} values, not {' or '.join(kinds)}. Grids: {listing}")
    return matches[0]


def chosen_grid(path: str | PathLike[str], grid: str | None = None) -> tuple[list[_openvdb.Header], int]:
    """Headers of the grids of a .vdb file, and the number of the one that `read_vdb` reads; raises InputError where there is none."""
    file = _existing(path)
    with _native_errors(file):
        headers = _openvdb.read_headers(str(file))
    return headers, _choose(file, headers, grid)


def read_vdb(path: str | PathLike[str], grid: str | None = None, clamp: bool = False, dense_voxels: int = DENSE_VOXELS) -> Volume:
    """Read one fog volume, cropped to the box of its active voxels.

    Values are those that OpenVDB itself returns at each index of that box: active voxels, active tiles and, where a file has
    any, values stored in inactive voxels. Rotated, sheared and non-uniform transforms are kept.

    A box of more than `dense_voxels` voxels becomes a `SparseVolume` where the bricks of 8^3 voxels that hold something take at most half
    of it, and where it has more than `MAX_VOXELS`.

    Parameters
    ----------
    path
        a .vdb file.
    grid
        name of a float grid (stored with 32 or 16 bits); without it the only float grid, or else the one called ``density``.
    clamp
        set negative values and NaN to 0 instead of refusing them.
    dense_voxels
        boxes up to this many voxels are dense whatever they hold.

    Raises
    ------
    InputError
        when the file is missing or damaged, the name is missing or ambiguous, or the grid is not a fog volume with an affine
        transform and background 0, has no active voxel, or holds values that are no density.
    """
    file = Path(path)
    headers, index = chosen_grid(file, grid)
    source = f"{file}: the grid '{headers[index]['unique_name']}'"
    with _native_errors(file):
        info, density, places, values = _openvdb.read_floats(str(file), index, dense_voxels, MAX_VOXELS, MAX_BOX)
    if info["grid_class"] == "level set":
        raise InputError(f"{source} is a level set, a distance to a surface; convert it to a fog volume first")
    if info["background"] != 0:
        raise InputError(f"{source} has the background value {info['background']:g}: it is not empty outside; set its background to 0")
    (nx, ny, nz), to_world = _placed(info, source)
    if density is not None:
        return Volume(clean(density, source, clamp), to_world)
    assert places is not None
    assert values is not None
    return SparseVolume(Bricks((nz, ny, nx), places, clean(values, source, clamp)), to_world)


def _placed(info: _openvdb.Description, source: str) -> tuple[tuple[int, int, int], NDArray[np.float64]]:
    """Voxels of a grid's box along x, y and z, and the map from the box's unit cube to the world."""
    if info["index_to_world"] is None:
        raise InputError(f"{source} has a {info['transform_type']}, which is not affine; resample it to an affine transform first")
    if info["index_box"] is None:
        raise EmptyGridError(f"{source} is empty: it has no active voxel")
    lower, upper = (np.array(corner, np.int64) for corner in info["index_box"])
    nx, ny, nz = (int(n) for n in upper - lower + 1)
    unit_to_index = np.diag([float(nx), ny, nz, 1.0])
    unit_to_index[:3, 3] = lower - 0.5
    return (nx, ny, nz), np.array(info["index_to_world"], np.float64) @ unit_to_index


def read_vdb_values(path: str | PathLike[str], grid: str) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Read a grid of numbers or colours, of any meaning, cropped to the box of its active voxels.

    Parameters
    ----------
    path
        a .vdb file.
    grid
        name of a grid of floats or of three floats (``vec3s``).

    Returns
    -------
    values (nz, ny, nx, channels), as `read_vdb` takes them over, and the 4 x 4 map from the unit cube of the box to the world.

    Raises
    ------
    InputError
        when the file is missing or damaged, or has no such grid; for one without active voxels, of another type, of more than `MAX_VOXELS`
        values, or with a transform that is not affine.
    """
    file = _existing(path)
    with _native_errors(file):
        headers = _openvdb.read_headers(str(file))
    index = _named(file, headers, grid, ("float", "vec3s"))
    source = f"{file}: the grid '{headers[index]['unique_name']}'"
    info: _openvdb.Description
    values: NDArray[np.float32] | None
    with _native_errors(file):
        if headers[index]["value_type"] == "float":
            info, values, _, _ = _openvdb.read_floats(str(file), index, MAX_VOXELS, MAX_VOXELS, MAX_VOXELS)
        else:
            info, values = _openvdb.read_vectors(str(file), index, MAX_VOXELS // 3)
    (nx, ny, nz), to_world = _placed(info, source)
    assert values is not None
    return values.reshape(nz, ny, nx, -1), to_world


def kept_in_bricks(voxels: int, bricks: int, dense_voxels: int = DENSE_VOXELS) -> bool:
    """Whether `read_vdb` keeps a box of `voxels` voxels, of which `bricks` bricks hold something, in bricks."""
    return voxels > dense_voxels and (2 * bricks * BRICK_VOXELS <= voxels or voxels > MAX_VOXELS)


def write_vdb(
    path: str | PathLike[str],
    volume: Volume,
    name: str = "density",
    half: bool = False,
    metadata: Mapping[str, str | int | float | bool] | None = None,
    prune: bool = True,
) -> None:
    """Write `volume` as a sparse fog volume: voxels that are 0 stay inactive.

    Reading it back crops it to its voxels above 0, at the same place in the world.

    Parameters
    ----------
    path
        the .vdb file to write; it appears only when it is complete.
    volume
        density and any affine transform.
    name
        the grid's name.
    half
        store 16-bit floats: a relative error up to 2^-11.
    metadata
        text, numbers and truth values to keep with the grid.
    prune
        replace blocks of one value by active tiles; otherwise every active voxel is stored on its own.

    Raises
    ------
    InputError
        when the folder is missing, a name in `metadata` belongs to OpenVDB, or `half` is asked for values beyond 65504.
    """
    file = Path(path)
    reserved = [key for key in metadata or {} if key in _RESERVED or key.startswith("file_")]
    if reserved:
        raise InputError(f"{file}: OpenVDB keeps the metadata {', '.join(reserved)} itself; choose other names")
    highest = float(volume.stored.max(initial=0))
    if half and highest > float(np.finfo(np.float16).max):
        raise InputError(f"{file}: the largest density, {highest:g}, does not fit into 16 bits; write it with half=False")
    nx, ny, nz = volume.resolution
    index_to_unit = np.diag([1 / nx, 1 / ny, 1 / nz, 1.0])
    index_to_unit[:3, 3] = 0.5 / np.array([nx, ny, nz])
    index_to_world = np.ascontiguousarray(volume.to_world @ index_to_unit)
    with replacing(file) as temporary, _native_errors(file):
        if isinstance(volume, SparseVolume):
            places, values = volume.bricks.places, volume.bricks.values
            _openvdb.write_bricks(str(temporary), places, values, index_to_world, name, half, prune, dict(metadata or {}))
        else:
            _openvdb.write_dense(str(temporary), volume.density, index_to_world, name, half, prune, dict(metadata or {}))
