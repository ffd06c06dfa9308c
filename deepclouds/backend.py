"""The Dr.Jit types a kernel runs on: LLVM on the processor or CUDA on a GPU, chosen by name."""

from __future__ import annotations

import glob
import importlib
import os
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepclouds.errors import InputError

NAMES = ("llvm", "cuda")
_ALIGNMENT = 64
_LLVM_PATTERNS = (
    "/usr/lib/*-linux-gnu/libLLVM-[0-9]*.so.1",
    "/usr/lib/*-linux-gnu/libLLVM.so.[0-9]*",
    "/usr/lib/llvm-*/lib/libLLVM*.so*",
    "/usr/lib64/libLLVM*.so*",
    "/opt/homebrew/opt/llvm/lib/libLLVM.dylib",
)


@cache
def backend(name: str = "llvm") -> ModuleType:
    """The module ``drjit.llvm`` or ``drjit.cuda``, whose types (Float, Array3f, ...) every kernel takes as its first argument.

    Raises
    ------
    InputError
        for an unknown name, or when the LLVM library or the CUDA driver is missing.
    """
    if name not in NAMES:
        raise InputError(f"unknown backend '{name}'; there are: {', '.join(NAMES)}")
    if name == "llvm" and "DRJIT_LIBLLVM_PATH" not in os.environ:
        found = sorted(path for pattern in _LLVM_PATTERNS for path in glob.glob(pattern))
        if found:
            os.environ["DRJIT_LIBLLVM_PATH"] = found[-1]
    import drjit as dr

    module = importlib.import_module(f"drjit.{name}")
    if not dr.has_backend(dr.JitBackend.LLVM if name == "llvm" else dr.JitBackend.CUDA):
        remedy = (
            "install LLVM (Debian: apt-get install libllvm19) or point DRJIT_LIBLLVM_PATH at libLLVM.so"
            if name == "llvm"
            else "install the NVIDIA driver or use the backend 'llvm'"
        )
        raise InputError(f"the Dr.Jit backend '{name}' is not available: {remedy}")
    return module


def lanes_of(kind: Any, values: ArrayLike) -> Any:
    """Numbers (n,) as a Dr.Jit array of the type `kind` (Float, UInt32, ...), one a lane.

    Dr.Jit takes the memory of a NumPy array as it is, and compiles one kernel for memory that begins at a multiple of 64 bytes and another
    for memory that does not, for each array that a kernel reads; from the latter it gathers number by number where packets were asked for.
    NumPy's memory begins anywhere: it is copied to where it suits.
    """
    import drjit as dr

    given = np.asarray(values, np.float32 if dr.is_float_v(kind) else np.int32 if dr.is_signed_v(kind) else np.uint32)
    memory = np.empty(given.nbytes + _ALIGNMENT, np.uint8)
    first = -memory.ctypes.data % _ALIGNMENT
    aligned = memory[first : first + given.nbytes].view(given.dtype)
    aligned[:] = given
    return kind(aligned)


def vectors_of(types: ModuleType, values: ArrayLike) -> Any:
    """Points or vectors (n, 3) of NumPy arrays as an Array3f, one a lane: what `rows` takes back."""
    given = np.asarray(values)
    return types.Array3f(*(lanes_of(types.Float, given[:, c]) for c in range(3)))


def rows(vector: Any) -> NDArray[np.float32]:
    """An Array3f as rows (n, 3) of a NumPy array.

    It is taken over component by component: as a whole it would pass through a kernel in which n is a constant, and each new n would
    compile one more.
    """
    import drjit as dr

    dr.eval(vector)
    result: NDArray[np.float32] = np.stack(np.broadcast_arrays(*(np.array(component) for component in vector)), axis=1)
    return result
