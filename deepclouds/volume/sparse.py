"""A density field that costs memory by what it holds: a `Volume` whose grid is kept as bricks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from deepclouds.errors import InputError
from deepclouds.volume._volume import Volume, checked
from deepclouds.volume.bricks import Bricks

MAX_VOXELS = 2**30
"""Most voxels that are kept at once, as one dense grid or in bricks: 4 GiB of float32."""


class SparseVolume(Volume):
    """The density field of `Volume` kept as bricks: the same values everywhere, memory by the bricks that hold something.

    Parameters
    ----------
    bricks
        density, finite and not negative.
    to_world
        as for `Volume`.

    Raises
    ------
    InputError
        as `Volume` does.
    """

    bricks: Bricks

    def __init__(self, bricks: Bricks, to_world: NDArray[np.float64]) -> None:
        values, matrix = checked(bricks.values, to_world)
        object.__setattr__(self, "bricks", Bricks(bricks.shape, bricks.places, values))
        object.__setattr__(self, "to_world", matrix)

    # A frozen dataclass keeps its fields as attributes of the instance, so that a property of the class takes the field's place.
    @property
    def density(self) -> NDArray[np.float32]:
        """The whole grid (nz, ny, nx), made anew at each call.

        Raises
        ------
        InputError
            when it would hold more than `MAX_VOXELS`.
        """
        voxels = int(np.prod(self.bricks.shape, dtype=np.int64))
        if voxels > MAX_VOXELS:
            raise InputError(
                f"a grid of {' x '.join(map(str, self.resolution))} voxels is needed whole here, which would take "
                f"{voxels * 4 / 2**30:.0f} GiB; crop it, or resample it to larger voxels"
            )
        return self.bricks.dense()

    @property
    def resolution(self) -> tuple[int, int, int]:
        """Number of samples along x, y and z."""
        nz, ny, nx = self.bricks.shape
        return nx, ny, nz

    @property
    def stored(self) -> NDArray[np.float32]:
        """Every sample that may differ from 0, as an array of three axes in any order."""
        return self.bricks.values.reshape(-1, *self.bricks.values.shape[2:])

    def sums(self, axis: int | tuple[int, int]) -> NDArray[np.float64]:
        """Sums of the density along an axis, or two in growing order (0 is z), float64."""
        if isinstance(axis, int):
            return self.bricks.sums(axis)
        # Without the first axis the second one is numbered one lower.
        total: NDArray[np.float64] = self.bricks.sums(axis[0]).sum(axis=axis[1] - 1)
        return total

    def row_ends(self, above: float | np.float32) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """The rows along x with a sample larger than `above`, not below 0: (z, y) of each, and its first and last such sample."""
        return self.bricks.row_ends(above)

    def _at(self, z: NDArray[np.int64], y: NDArray[np.int64], x: NDArray[np.int64]) -> NDArray[np.float32]:
        return self.bricks.at(z, y, x)
