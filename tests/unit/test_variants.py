"""The variants of Mitsuba that we run in; the CUDA ones as far as a machine without a GPU can tell."""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from deepclouds_runtime import _mitsuba
from deepclouds_runtime.integrator import NAME, register

from deepclouds.errors import InputError


def _no_llvm(name: str = "llvm") -> ModuleType:
    if name == "llvm":
        raise InputError("the Dr.Jit backend 'llvm' is not available")
    import drjit.cuda

    return drjit.cuda


@pytest.mark.parametrize("variant", ["cuda_ad_rgb", "cuda_ad_mono"])
def test_a_cuda_variant_needs_no_llvm(monkeypatch: pytest.MonkeyPatch, variant: str) -> None:
    import drjit.cuda
    import mitsuba as mi

    monkeypatch.setattr(mi, "variant", lambda: variant)
    monkeypatch.setattr(_mitsuba, "backend", _no_llvm)
    for select in (False, True):
        assert _mitsuba.mitsuba(select) is mi
    assert _mitsuba.types_of(mi) is drjit.cuda


def test_the_default_variant_says_when_llvm_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    import mitsuba as mi

    monkeypatch.setattr(mi, "variant", lambda: None)
    monkeypatch.setattr(_mitsuba, "backend", _no_llvm)
    with pytest.raises(InputError, match="'llvm' is not available"):
        _mitsuba.mitsuba(select=True)
    with pytest.raises(InputError, match="not set"):
        _mitsuba.mitsuba()


def test_the_plugin_is_registered_in_every_variant_and_refuses_in_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    made: dict[str, Any] = {}
    for variant in (*_mitsuba.VARIANTS, "scalar_rgb", "llvm_ad_spectral"):
        stand_in = SimpleNamespace(
            variant=lambda name=variant: name,
            SamplingIntegrator=object,
            register_integrator=lambda name, make, variant=variant: made.update({f"{variant} {name}": make}),
        )
        monkeypatch.setitem(sys.modules, "mitsuba", stand_in)
        register()
    assert {key for key, make in made.items() if isinstance(make, type)} == {f"{variant} {NAME}" for variant in _mitsuba.VARIANTS}
    with pytest.raises(InputError, match="llvm_ad_spectral"):
        made[f"llvm_ad_spectral {NAME}"](None)


def test_a_gpu_that_is_not_there_is_named() -> None:
    import drjit as dr

    if dr.has_backend(dr.JitBackend.CUDA):
        pytest.skip("there is a CUDA device on this machine")
    with pytest.raises(InputError, match="'cuda' is not available: install the NVIDIA driver"):
        _mitsuba.select("cuda_ad_rgb")


def test_the_plugin_loads_on_a_gpu() -> None:
    import drjit as dr
    import mitsuba as mi

    if not dr.has_backend(dr.JitBackend.CUDA):
        pytest.skip("no CUDA device on this machine")
    before = mi.variant()
    try:
        for variant in ("cuda_ad_rgb", "cuda_ad_mono"):
            mi.set_variant(variant)
            assert mi.load_dict({"type": NAME, "max_depth": 2}).max_depth == 2
    finally:
        if before is not None:
            mi.set_variant(before)
