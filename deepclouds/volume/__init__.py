"""A density field, its files, and its filtered pyramid."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deepclouds.errors import InputError
from deepclouds.volume._volume import Volume
from deepclouds.volume.bricks import Bricks
from deepclouds.volume.sparse import SparseVolume
from deepclouds.volume.vol import read_vol, write_vol

if TYPE_CHECKING:
    from deepclouds.volume.vdb import GridInfo, list_grids, read_vdb, write_vdb

__all__ = [
    "Bricks",
    "GridInfo",
    "SparseVolume",
    "Volume",
    "list_grids",
    "read_vdb",
    "read_vol",
    "read_volume",
    "write_vdb",
    "write_vol",
]


def __getattr__(name: str) -> Any:
    # The OpenVDB side loads a native module, so it is imported when first asked for.
    if name in ("GridInfo", "list_grids", "read_vdb", "write_vdb"):
        from deepclouds.volume import vdb

        return getattr(vdb, name)
    raise AttributeError(f"module 'deepclouds.volume' has no attribute '{name}'")


def read_volume(path: str | PathLike[str], grid: str | None = None, clamp: bool = False) -> Volume:
    """Read a density field from a .vdb or .vol file.

    Parameters
    ----------
    path
        the file; its suffix says which reader serves.
    grid
        name of the grid inside a .vdb file; see `deepclouds.volume.vdb.read_vdb`.
    clamp
        set negative values and NaN to 0 instead of refusing them.

    Raises
    ------
    InputError
        for another suffix, a `grid` with a .vol file, and everything that the readers refuse.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".vdb":
        # Loads the native module, so only here.
        from deepclouds.volume.vdb import read_vdb

        return read_vdb(path, grid, clamp)
    if suffix == ".vol":
        if grid is not None:
            raise InputError(f"{path}: a .vol file holds one grid without a name; leave out the grid '{grid}'")
        return read_vol(path, clamp)
    raise InputError(f"{path}: density fields are read from .vdb and .vol files, not from '{suffix}'")
