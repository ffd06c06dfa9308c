from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

class VdbError(RuntimeError): ...

class Header(TypedDict):
    name: str
    unique_name: str
    value_type: str
    half: bool
    known: bool

class Description(Header):
    grid_class: str
    transform_type: str
    index_to_world: list[list[float]] | None
    voxel_size: tuple[float, float, float]
    active_voxels: int
    index_box: tuple[tuple[int, int, int], tuple[int, int, int]] | None
    metadata: dict[str, str | int | float | bool]

class FloatDescription(Description):
    background: float

library_version: str

def read_headers(path: str) -> list[Header]: ...
def describe_grid(path: str, index: int) -> Description: ...
def count_bricks(path: str, index: int, max_voxels: int) -> int | None: ...
def read_floats(
    path: str, index: int, dense_voxels: int, max_voxels: int, max_box: int
) -> tuple[FloatDescription, NDArray[np.float32] | None, NDArray[np.int32] | None, NDArray[np.float32] | None]: ...
def read_vectors(path: str, index: int, max_voxels: int) -> tuple[Description, NDArray[np.float32] | None]: ...
def write_dense(
    path: str,
    density: NDArray[np.float32],
    index_to_world: NDArray[np.float64],
    name: str,
    half: bool,
    prune: bool,
    metadata: dict[str, str | int | float | bool],
) -> None: ...
def write_bricks(
    path: str,
    places: NDArray[np.int32],
    values: NDArray[np.float32],
    index_to_world: NDArray[np.float64],
    name: str,
    half: bool,
    prune: bool,
    metadata: dict[str, str | int | float | bool],
) -> None: ...
