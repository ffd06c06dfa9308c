"""The border to Mitsuba: which variants we run in, and its differentiable types against our plain ones."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import drjit as dr

from deepclouds.backend import backend
from deepclouds.errors import InputError

VARIANTS = ("llvm_ad_rgb", "llvm_ad_mono", "cuda_ad_rgb", "cuda_ad_mono")
DEFAULT_VARIANT = "llvm_ad_rgb"


def mitsuba(select: bool = False) -> ModuleType:
    """Mitsuba with a variant we run in.

    Parameters
    ----------
    select
        set ``llvm_ad_rgb`` when no variant is set yet; a variant that is set is never changed.

    Raises
    ------
    InputError
        when no variant is set (and `select` is false), or one that is not in `VARIANTS`.
    """
    import mitsuba as mi

    if mi.variant() is None and select:
        # It finds the LLVM library before Mitsuba looks for it, and says what to install where there is none.
        backend("llvm")
        mi.set_variant(DEFAULT_VARIANT)
    if mi.variant() not in VARIANTS:
        raise InputError(
            f"Mitsuba's variant is {mi.variant() or 'not set'}; deepclouds renders in {', '.join(VARIANTS)}: "
            f"call mitsuba.set_variant('{DEFAULT_VARIANT}') before the scene is loaded"
        )
    module: ModuleType = mi
    return module


def select(variant: str) -> None:
    """Set Mitsuba's variant for the whole process; raises InputError for one that we do not run in, or that this machine cannot run."""
    if variant not in VARIANTS:
        raise InputError(f"variant '{variant}': there are {', '.join(VARIANTS)}")
    backend(variant.partition("_")[0])
    import mitsuba as mi

    mi.set_variant(variant)


def types_of(mi: Any) -> ModuleType:
    """``drjit.llvm`` or ``drjit.cuda``, to go with Mitsuba's current variant."""
    return backend(str(mi.variant()).partition("_")[0])


def plain(types: ModuleType, value: Any) -> Any:
    """Mitsuba's floats, points, vectors and masks without derivatives, as the types of our kernels."""
    if dr.depth_v(value) > 1:
        return types.Array3f(*(plain(types, component) for component in (value.x, value.y, value.z)))
    return dr.detach(value, preserve_type=False)


def channels(types: ModuleType, spectrum: Any) -> list[Any]:
    """One plain float array for each channel of a Mitsuba colour (three in rgb variants, one in mono)."""
    return [plain(types, spectrum[c]) for c in range(len(spectrum))]
