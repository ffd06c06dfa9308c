"""Grids of a .vdb file that tell of light which a cloud gives off itself: flames, and temperatures that glow.

A file keeps them beside the density, by names that programs for fire and smoke have in common. No more than such a name says what a grid
means, so its values are looked at too: a weather model's temperature is no fire.
"""

from __future__ import annotations

import re
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deepclouds.volume import _openvdb
from deepclouds.volume.sparse import MAX_VOXELS
from deepclouds.volume.vdb import DENSE_VOXELS, MAX_BOX, chosen_grid

GLOW = 798.0
"""Kelvin from which bodies glow visibly (J. W. Draper, "On the Production of Light by Heat", 1847)."""

# Below it values are read as degrees Celsius or as numbers of the artist's own scale, in which a flame may have any value.
_COLDEST = 100.0
_TEMPERATURE = re.compile(r"temperature|\b(temp|heat)\b")
_LIGHT = re.compile(r"flame|emission|emissive|incandescen|blackbody|\b(fires?|burn|burning|emit|glow)\b")


def emissive_grids(path: str | PathLike[str], grid: str | None = None) -> tuple[str, ...]:
    """Names of the grids of a .vdb file by which the cloud gives off light.

    Parameters
    ----------
    path
        a .vdb file.
    grid
        the grid that is rendered as density, see `deepclouds.volume.read_vdb`; it is none of them, whatever its name.

    Raises
    ------
    InputError
        when the file cannot be read, or `grid` is none of its grids.

    Notes
    -----
    Grids with values other than single numbers, and those too large to be looked at, count by their names alone if they hold anything.
    """
    headers, chosen = chosen_grid(path, grid)
    found = []
    for index, header in enumerate(headers):
        if index != chosen and may_glow(header["name"]) and _holds_light(str(Path(path)), index, header):
            found.append(header["unique_name"])
    return tuple(found)


def may_glow(name: str) -> bool:
    """Whether a grid of this name may tell of light."""
    words = _words(name)
    return _TEMPERATURE.search(words) is not None or _LIGHT.search(words) is not None


def glows(name: str, values: NDArray[np.float32], background: float = 0.0) -> bool:
    """Whether values under such a name mean light.

    Parameters
    ----------
    name
        of the grid.
    values
        those of the box around its active voxels, of any shape.
    background
        the value everywhere else.

    Notes
    -----
    Flames are light wherever they are not 0. A temperature is none where it is the same in the whole box, however warm, nor where it is
    given in Kelvin and stays below `GLOW`: values other than 0 that all lie above 100 are taken for Kelvin.
    """
    if _LIGHT.search(_words(name)) is not None:
        return background != 0 or bool(np.any(values != 0))
    if not values.size or float(np.ptp(values)) == 0:
        return False
    told = values[values != 0]
    return not bool(np.all((told >= _COLDEST) & (told < GLOW)))


def _words(name: str) -> str:
    """A name in lower case, its words apart: `flameHeat_2` is ``flame heat``."""
    return " ".join(re.findall(r"[A-Z]?[a-z]+|[A-Z]+", name)).lower()


def _holds_light(path: str, index: int, header: _openvdb.Header) -> bool:
    if header["value_type"] != "float":
        return not header["known"] or _openvdb.describe_grid(path, index)["active_voxels"] > 0
    try:
        info, dense, _, bricks = _openvdb.read_floats(path, index, DENSE_VOXELS, MAX_VOXELS, MAX_BOX)
    except _openvdb.VdbError:
        return True
    values = dense if dense is not None else bricks
    if values is None:
        values = np.zeros(0, np.float32)
    elif dense is None:
        # Bricks that hold 0 alone are left out.
        values = np.append(values.ravel(), np.float32(0))
    return glows(header["name"], values, info["background"])
