"""Clouds that give off light of their own.

Rationale: we render what a cloud scatters; a fire without its light looks like smoke, and nobody would know. Expected behaviour: such
files end in code 2 with the grids' names and the remedy, which renders the scattering alone and says so; other files are as before.
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import pytest
from deepclouds_runtime.scene_medium import check_dark

from deepclouds.cli import main
from deepclouds.errors import InputError
from deepclouds.exr import read_exr

DATA = Path(__file__).parents[1] / "unit" / "data"
SCENE = (
    '<scene version="3.0.0"><sensor type="perspective"/><shape type="cube"><bsdf type="null"/>'
    '<medium type="homogeneous" name="interior"><float name="sigma_t" value="1"/>{0}</medium></shape></scene>'
)


@pytest.fixture(autouse=True)
def mi(llvm_mitsuba: ModuleType) -> ModuleType:
    return llvm_mitsuba


def _render(file: Path, folder: Path, *flags: str) -> int:
    small = ["--size", "8x8"] if file.suffix == ".vdb" else []
    return main(["render", str(file), "-o", str(folder / "image.exr"), "--max-depth", "2", "--spp", "1", *small, *flags])


def test_a_fire_is_refused_and_its_smoke_rendered_on_demand(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fire = DATA / "fire.vdb"
    assert _render(fire, tmp_path) == 2
    said = capsys.readouterr().err
    for part in (str(fire), "grids 'temperature', 'FlameColour'", "--ignore-emission"):
        assert part in said
    assert not (tmp_path / "image.exr").exists()
    assert _render(fire, tmp_path, "--ignore-emission") == 0
    said = capsys.readouterr().out
    assert "note: light that the cloud gives off by its grids 'temperature', 'FlameColour' is left out" in said
    assert "note: of the file 'density' alone is rendered, without its grid 'wind'" in said
    assert read_exr(tmp_path / "image.exr").channels["volume_opacity"].max() > 0


def test_a_weather_model_is_no_fire(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _render(DATA / "weather.vdb", tmp_path) == 0
    said = capsys.readouterr().out
    assert "gives off" not in said
    assert "note: of the file 'density' alone is rendered, without its grids 'temperature', 'heat', 'burn', 'flames'" in said


def test_scenes_with_light_in_the_medium_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = tmp_path / "scene.xml"
    scene.write_text(SCENE.format('<rgb name="emission" value="1 0.5 0.2"/>'))
    assert _render(scene, tmp_path) == 2
    assert "emission" in capsys.readouterr().err
    scene.write_text(SCENE.format(""))
    assert _render(scene, tmp_path, "--ignore-emission") == 2
    assert "ignore_emission belong to a volume" in capsys.readouterr().err
    # Releases of Mitsuba to come may load it.
    with pytest.raises(InputError, match=r"gives off light \('emission.value.value'\).*leave its emission out"):
        check_dark(["albedo.value.value", "emission.value.value"])
    check_dark(["albedo.value.value", "sigma_t.value.value", "scale"])
