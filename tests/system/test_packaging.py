"""What is installed: the wheel's contents, the commands, the pinned versions, and the native module's borders."""

from __future__ import annotations

import importlib.metadata
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

COMMANDS = {"info", "compare", "clouds", "generate", "dataset", "train", "export", "evaluate", "calibrate", "render", "verify", "card"}


@pytest.fixture(scope="module")
def project(root: Path) -> dict[str, Any]:
    """pyproject.toml."""
    return tomllib.loads((root / "pyproject.toml").read_text())


@pytest.fixture(scope="module")
def pins(root: Path) -> dict[str, str]:
    """constraints.txt: canonical name -> version."""
    lines = [line for line in (root / "constraints.txt").read_text().splitlines() if line and not line.startswith("#")]
    return {canonicalize_name(name): version for name, version in (line.split("==") for line in lines)}


def requirements(project: dict[str, Any]) -> list[Requirement]:
    """Every requirement of the project, its extras and its build, without the extras that name the project itself."""
    table = project["project"]
    lines = [*table["dependencies"], *project["build-system"]["requires"]]
    lines += [line for extra in table["optional-dependencies"].values() for line in extra]
    return [r for r in map(Requirement, lines) if canonicalize_name(r.name) != "deepclouds"]


def test_every_requirement_is_pinned_inside_its_range(project: dict[str, Any], pins: dict[str, str]) -> None:
    wanted = requirements(project)
    assert len(wanted) > 15
    for requirement in wanted:
        assert requirement.specifier, f"{requirement} has no range"
        name = canonicalize_name(requirement.name)
        assert name in pins, f"constraints.txt lacks {name}"
        assert requirement.specifier.contains(pins[name]), f"{requirement} excludes the pinned {pins[name]}"


def test_constraints_name_versions_and_nothing_else(root: Path) -> None:
    for line in (root / "constraints.txt").read_text().splitlines():
        assert line.startswith("#") or re.fullmatch(r"[A-Za-z0-9._-]+==[0-9][A-Za-z0-9.]*", line), line


def test_every_command_can_be_loaded() -> None:
    found = {e.name: e for e in importlib.metadata.entry_points(group="deepclouds.commands")}
    assert set(found) == COMMANDS
    for name, entry in found.items():
        assert callable(entry.load()), name


def test_the_installed_command_runs() -> None:
    command = Path(sysconfig.get_path("scripts")) / "deepclouds"
    done = subprocess.run([str(command), "--version"], capture_output=True, text=True, check=True, cwd="/", timeout=60)
    assert done.stdout.strip() == importlib.metadata.version("deepclouds")
    listing = subprocess.run([str(command), "--help"], capture_output=True, text=True, check=True, cwd="/", timeout=60).stdout
    assert all(name in listing for name in COMMANDS)
    assert subprocess.run([str(command), "nonsense"], capture_output=True, check=False, cwd="/", timeout=60).returncode == 2


def test_versions_agree(root: Path, project: dict[str, Any]) -> None:
    version = project["project"]["version"]
    assert importlib.metadata.version("deepclouds") == version
    assert f"\nversion: {version}\n" in (root / "CITATION.cff").read_text()


@pytest.mark.skipif(shutil.which("nm") is None, reason="nm is not installed")
def test_the_native_module_exports_its_init_function_alone() -> None:
    """Rationale: visible copies of OpenVDB's registries would take the place of the library's own and crash on import."""
    from deepclouds.volume import _openvdb

    listing = subprocess.run(["nm", "-D", "--defined-only", str(_openvdb.__file__)], capture_output=True, text=True, check=True).stdout
    names = [line.split()[-1] for line in listing.splitlines()]
    assert names == ["PyInit__openvdb"]


@pytest.fixture(scope="module")
def wheel(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel built from the checkout, with every intermediate file outside it."""
    folder = tmp_path_factory.mktemp("wheel")
    # The long option, since Debian 12's pip does not know -C.
    build = f"--config-settings=build-dir={folder / 'build'}"
    options = ["--no-build-isolation", "--no-deps", "--no-index", "--wheel-dir", str(folder), build]
    done = subprocess.run(
        [sys.executable, "-m", "pip", "wheel", *options, str(root)], capture_output=True, text=True, check=False, timeout=900
    )
    assert done.returncode == 0, done.stdout + done.stderr
    (built,) = folder.glob("*.whl")
    return built


@pytest.mark.slow
def test_the_wheel_holds_three_packages_and_what_they_need_at_run_time(wheel: Path, root: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    packages = {name.partition("/")[0] for name in names if ".dist-info/" not in name}
    assert packages == {"deepclouds", "deepclouds_training", "deepclouds_runtime"}
    assert {f"{package}/py.typed" for package in packages} <= names
    assert "deepclouds/volume/_openvdb.pyi" in names
    assert any(re.fullmatch(r"deepclouds/volume/_openvdb\..*\.so", name) for name in names)
    assert not [name for name in names if name.endswith((".cpp", ".map", ".pyc"))]
    runtime = root / "runtime"
    data = [f for kind in ("models", "data") for f in (runtime / "deepclouds_runtime" / kind).rglob("*") if f.is_file()]
    missing = [str(f) for f in data if "__pycache__" not in f.parts and f.relative_to(runtime).as_posix() not in names]
    assert not missing
    assert any(name.startswith("deepclouds_runtime/models/") and name.endswith(".onnx") for name in names)


@pytest.mark.slow
def test_the_wheel_works_away_from_the_checkout(wheel: Path, tmp_path: Path) -> None:
    """Expected: unpacked, and with the editable install switched off, the wheel writes and reads a volume with its own native module."""
    zipfile.ZipFile(wheel).extractall(tmp_path)
    program = (
        "import sys\n"
        "sys.meta_path[:] = [f for f in sys.meta_path if 'ScikitBuild' not in type(f).__name__]\n"
        f"sys.path.insert(0, {str(tmp_path)!r})\n"
        "import numpy as np\n"
        "from deepclouds.volume import Volume, read_vdb, write_vdb, _openvdb\n"
        f"write_vdb({str(tmp_path / 'a.vdb')!r}, Volume.from_box(np.ones((2, 3, 4)), (0, 0, 0), (1, 1, 1)))\n"
        f"print(read_vdb({str(tmp_path / 'a.vdb')!r}).density.sum(), _openvdb.__file__)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, cwd="/", timeout=120)
    assert done.returncode == 0, done.stderr
    total, module = done.stdout.split()
    assert float(total) == 24
    assert Path(module).is_relative_to(tmp_path)
