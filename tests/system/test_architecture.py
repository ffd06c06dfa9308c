"""Who may import whom: training -> deepclouds <- runtime, and heavy packages only where they belong."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from packaging.requirements import Requirement

HEAVY = ("torch", "onnxruntime", "mitsuba", "onnx", "matplotlib", "scipy", "tensorboard")

# Imports every module of the package named on the command line, then tells what else came along. A module `__main__` would run.
IMPORT_ALL = """
import importlib, json, pkgutil, sys
package = importlib.import_module(sys.argv[1])
names = [m.name for m in pkgutil.walk_packages(package.__path__, package.__name__ + ".") if not m.name.endswith("__main__")]
for name in names:
    importlib.import_module(name)
print(json.dumps([names, sorted({name.partition(".")[0] for name in sys.modules})]))
"""


def run(*arguments: str) -> str:
    """Standard output of a fresh interpreter, which starts outside the checkout."""
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, check=False, cwd="/", timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


def import_all(package: str) -> tuple[set[str], set[str]]:
    """Names of the package's modules, and the top-level packages that importing them all has loaded."""
    names, loaded = json.loads(run("-c", IMPORT_ALL, package).splitlines()[-1])
    return set(names), set(loaded)


def test_the_library_loads_no_heavy_package() -> None:
    names, loaded = import_all("deepclouds")
    # The check is worth something only if it really met the native module and the deepest folders.
    assert {"deepclouds.volume._openvdb", "deepclouds.volume.vdb", "deepclouds.cli", "deepclouds.info"} <= names
    assert loaded.isdisjoint({*HEAVY, "deepclouds_training", "deepclouds_runtime"}), sorted(loaded)


def test_the_runtime_never_loads_torch() -> None:
    names, loaded = import_all("deepclouds_runtime")
    assert "deepclouds_runtime.render" in names
    assert loaded.isdisjoint({"torch", "tensorboard", "deepclouds_training"}), sorted(loaded)


def test_training_never_loads_the_runtime() -> None:
    names, loaded = import_all("deepclouds_training")
    assert {"deepclouds_training.generate", "deepclouds_training.train", "deepclouds_training.export"} <= names
    assert "deepclouds_runtime" not in loaded


def test_help_of_render_loads_no_torch() -> None:
    program = (
        "import sys\n"
        "from deepclouds.cli import main\n"
        "try:\n    code = main(['render', '--help'])\nexcept SystemExit as end:\n    code = end.code\n"
        "print(code, 'torch' in sys.modules, 'deepclouds_training' in sys.modules)\n"
    )
    lines = run("-c", program).splitlines()
    assert lines[0].startswith("usage: deepclouds render")
    assert lines[-1] == "0 False False"


def test_listing_the_commands_loads_neither_side() -> None:
    program = (
        "import sys\nfrom deepclouds.cli import main\nmain(['--help'])\n"
        "print(sorted({'torch', 'mitsuba', 'drjit', 'numpy', 'deepclouds_training', 'deepclouds_runtime'} & set(sys.modules)))\n"
    )
    assert run("-c", program).splitlines()[-1] == "[]"


def imports(file: Path) -> Iterator[str]:
    """Every module that a source file imports, also inside its functions."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"), str(file))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module is not None:
            yield node.module


def forbidden_imports(folder: Path, forbidden: tuple[str, ...]) -> list[str]:
    """``file: module`` for each import of a forbidden top-level package below `folder`."""
    return [f"{file}: {name}" for file in sorted(folder.rglob("*.py")) for name in imports(file) if name.partition(".")[0] in forbidden]


@pytest.mark.parametrize(
    ("folder", "forbidden"),
    [
        (
            "deepclouds",
            ("torch", "mitsuba", "scipy", "tensorboard", "deepclouds_training", "deepclouds_runtime", "benchmarks", "tests"),
        ),
        ("training/deepclouds_training", ("deepclouds_runtime", "benchmarks", "tests")),
        (
            "runtime/deepclouds_runtime",
            ("torch", "scipy", "tensorboard", "deepclouds_training", "benchmarks", "tests"),
        ),
    ],
)
def test_no_source_imports_against_the_arrows(root: Path, folder: str, forbidden: tuple[str, ...]) -> None:
    """Rationale: an import inside a function escapes the tests above until someone calls it."""
    assert len(list((root / folder).rglob("*.py"))) > 5
    assert not forbidden_imports(root / folder, forbidden)


def test_the_scan_finds_hidden_imports(tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text("def f():\n    if True:\n        from torch.nn import functional\n")
    (tmp_path / "b.py").write_text("import numpy, torch.onnx as t\n")
    (tmp_path / "c.py").write_text("from . import torch\nimport torchvision\n'import torch'\n")
    assert forbidden_imports(tmp_path, ("torch",)) == [f"{tmp_path / 'a.py'}: torch.nn", f"{tmp_path / 'b.py'}: torch.onnx"]


# Extras that a module looks for and does without: (file, package).
OPTIONAL = {
    ("compare.py", "matplotlib"),
    ("metrics.py", "flip_evaluator"),
}


@pytest.mark.parametrize("folder", ["deepclouds", "runtime/deepclouds_runtime"])
def test_what_is_imported_is_installed_without_extras(root: Path, folder: str) -> None:
    """Rationale: a test machine has every extra, so a missing dependency would first be met by a user."""
    lines = tomllib.loads((root / "pyproject.toml").read_text())["project"]["dependencies"]
    names = {Requirement(line).name for line in lines}
    # Distributions whose import has another name.
    imported_as = {"pillow": "PIL", "protobuf": "google"}
    allowed = {imported_as.get(name, name) for name in names} | sys.stdlib_module_names | {"deepclouds", "deepclouds_runtime"}
    found = {(file.name, name.partition(".")[0]) for file in (root / folder).rglob("*.py") for name in imports(file)}
    assert not {use for use in found if use[1] not in allowed} - OPTIONAL
