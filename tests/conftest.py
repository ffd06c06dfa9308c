"""What every test may ask for."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

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


@pytest.fixture
def scalar_mitsuba() -> Iterator[ModuleType]:
    """Mitsuba with the variant scalar_rgb; the variant that was set before comes back afterwards."""
    import mitsuba

    before = mitsuba.variant()
    mitsuba.set_variant("scalar_rgb")
    yield mitsuba
    if before is not None:
        mitsuba.set_variant(before)
