"""Registers the integrator plugin with Mitsuba, whichever of the two is imported first, without importing Mitsuba."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType


def install() -> None:
    """Register now if Mitsuba is there, or else as soon as it is imported; and again whenever its variant changes."""
    if "mitsuba" in sys.modules:
        _connect()
    elif not any(isinstance(finder, _Watch) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Watch())


def _connect() -> None:
    import mitsuba as mi

    from deepclouds_runtime.integrator import register

    def changed(old: str | None, new: str | None) -> None:
        register()

    mi.detail.add_variant_callback(changed)
    register()


class _Watch(MetaPathFinder):
    """Stands before the usual finders until `mitsuba` is asked for once."""

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        if fullname != "mitsuba":
            return None
        sys.meta_path.remove(self)
        spec = find_spec(fullname)
        if spec is not None and spec.loader is not None:
            spec.loader = _Afterwards(spec.loader)
        return spec


class _Afterwards(Loader):
    """Loads a module as another loader does, then connects."""

    def __init__(self, loader: Loader) -> None:
        self._loader = loader

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return self._loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        self._loader.exec_module(module)
        _connect()
