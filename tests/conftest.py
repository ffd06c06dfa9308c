"""What every test may ask for."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import pytest

# Matrix products of torch round alike on all processors, for tests whose limits are those of rounding; read when torch is first used.
os.environ.setdefault("MKL_CBWR", "AVX2")
ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def root() -> Path:
    """The checkout."""
    return ROOT


@pytest.fixture(scope="session")
def public_scenes() -> Path:
    """The public test scenes, which lie beside the checkout where there are any."""
    folder = ROOT.parent / "shared" / "scenes"
    if not folder.is_dir():
        pytest.skip(f"the public scenes are not at {folder}")
    return folder


@pytest.fixture(params=["llvm", "cuda"])
def any_backend(request: pytest.FixtureRequest) -> ModuleType:
    """The Dr.Jit types of each backend in turn; that of a GPU is skipped where there is none."""
    from deepclouds.backend import backend
    from deepclouds.errors import InputError

    try:
        return backend(request.param)
    except InputError as error:
        if request.param != "cuda":
            raise
        pytest.skip(str(error))


@contextmanager
def _variant(name: str) -> Iterator[ModuleType]:
    import mitsuba

    before = mitsuba.variant()
    mitsuba.set_variant(name)
    yield mitsuba
    if before is not None:
        mitsuba.set_variant(before)


@pytest.fixture
def scalar_mitsuba() -> Iterator[ModuleType]:
    """Mitsuba with the variant scalar_rgb; the variant that was set before comes back afterwards."""
    with _variant("scalar_rgb") as module:
        yield module


@pytest.fixture
def llvm_mitsuba() -> Iterator[ModuleType]:
    """The same with llvm_ad_rgb."""
    with _variant("llvm_ad_rgb") as module:
        yield module
