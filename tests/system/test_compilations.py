"""Rationale: a number that changes from render to render, baked into a kernel as a constant, makes every render compile that kernel anew,
which takes longer than to run it.

Expected behaviour: once one image was rendered, others of the same size need no new kernels, whatever the numbers of samples, queries,
nodes and walks, the seed, the view, and the error.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import ModuleType

import deepclouds_runtime
import drjit as dr
import numpy as np
import pytest
from deepclouds_runtime.loading import load

from deepclouds.backend import backend, lanes_of, rows
from tests.system.smooth_network import Smooth

CLOUD = Path(deepclouds_runtime.__file__).parent / "data" / "demo.vdb"
# Renders of each kind.
TRIES = 3


@pytest.fixture(autouse=True)
def mi(llvm_mitsuba: ModuleType) -> ModuleType:
    return llvm_mitsuba


@pytest.fixture
def scattered() -> Callable[[], None]:
    """Memory that is handed out begins in other places after each call: kernels differ by whether it begins at a multiple of 64 bytes."""
    rng = np.random.default_rng(0)
    kept: list[np.ndarray] = []

    def scatter() -> None:
        kept.extend(np.empty(n, np.float32) for n in rng.choice([3, 5, 17, 33, 100, 1000, 3001], 3000))
        for place in rng.integers(1500, size=1500):
            kept.pop(place)

    return scatter


def kernels(render: Callable[[], object]) -> set[str]:
    """The different kernels that were run; that one was compiled before, in another process, does not count."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        render()
        history = dr.kernel_history()
    assert len(history) > 3
    return {str(kernel["hash"]) for kernel in history if kernel["type"] == dr.KernelType.JIT}


def test_constants_are_found_out() -> None:
    """What is counted does see a number that is baked in; numbers of lanes, and where their memory begins, are none."""
    octave = np.arange(80, dtype=np.float32)
    types = backend()

    def baked(n: int) -> None:
        for _ in range(4):
            dr.eval(dr.arange(types.Float, 64) * float(n) + 0.123)

    def points(n: int) -> None:
        for extra in range(6):
            value = lanes_of(types.Float, np.arange(n + extra)[extra:])
            rows(types.Array3f(value, 2 * value, 3 * value + 0.789))
            table = lanes_of(types.Float, octave[extra : extra + 64])
            dr.eval(dr.gather(types.ArrayXf, table, dr.arange(types.UInt32, 8), shape=(8, 8)))

    assert len(kernels(lambda: baked(4)) - kernels(lambda: baked(3))) == 1
    assert kernels(lambda: points(20)) == kernels(lambda: points(11))


@pytest.mark.parametrize("sky", [0.0, 0.3], ids=["sun", "sun and sky"])
def test_another_view_and_other_counts_compile_nothing(sky: float, scattered: Callable[[], None]) -> None:
    first, *others = (load(CLOUD, predictor=Smooth(), size=(24, 18), sky=sky, view=(40.0 * i, 5.0 + 5 * i)) for i in range(TRIES + 1))
    # An error that is easily reached takes few walks.
    known = kernels(lambda: first.render(8, seed=1, error=0.25, correct=True))
    counts: list[int] = []
    views: list[int] = []
    dialled: list[int] = []

    def new(render: Callable[[], object], found: list[int]) -> None:
        nonlocal known
        scattered()
        ran = kernels(render)
        found.append(len(ran - known))
        known |= ran

    for i, other in enumerate(others):
        new(partial(first.render, 5 - i, seed=2 + i, error=0.2 + 0.01 * i, correct=True), counts)
        new(partial(other.render, 3 + i, seed=12 + i, error=0.3 - 0.01 * i, correct=True), views)
        new(partial(other.render, seed=22 + i, error=0.1 + 0.01 * i), dialled)
    assert counts == views == [0] * TRIES
    # The dial looks up other fields than an image with a fixed number of samples.
    assert dialled[0] <= 1, dialled
    assert not any(dialled[1:]), dialled
