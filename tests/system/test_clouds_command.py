"""`deepclouds clouds`, called as the command line calls it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from deepclouds_training.clouds import FAMILIES, make_cloud
from deepclouds_training.clouds.command import main

from deepclouds.errors import InputError
from deepclouds.volume import read_vol


def run(*argv: object) -> int:
    return main([str(a) for a in argv], "deepclouds clouds")


def test_list_names_every_family_and_parameter(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("list") == 0
    text = capsys.readouterr().out
    for name, family in FAMILIES.items():
        assert f"{name}: {family.summary}" in text
        assert all(parameter in text and str(domain) in text for parameter, domain in family.ranges.items())


def test_list_measures_on_request(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("list", "stratus", "shapes", "--statistics", 2, "--resolution", 16) == 0
    text = capsys.readouterr().out
    assert text.count("measured on 2 clouds at 16") == 2
    assert "cumulus" not in text
    for quantity in ("cover", "chi", "nu", "slope", "outline", "mean_to_max", "filled", "aspect"):
        assert text.count(f"        {quantity} ") == 2


def test_make_writes_the_cloud_that_the_function_makes(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "cloud"
    assert run("make", "stratus", "-o", folder, "--seed", 3, "--resolution", 24, "--set", "edges=cut", "--set", "thickness=0.2") == 0
    assert sorted(p.name for p in folder.iterdir()) == ["cloud.json", "density.vdb", "density.vol", "scene.xml"]
    expected = make_cloud("stratus", 3, 24, edges="cut", thickness=0.2)
    assert read_vol(folder / "density.vol").density.tobytes() == expected.density.tobytes()
    record = json.loads((folder / "cloud.json").read_text())
    assert record["parameters"]["thickness"] == 0.2
    # What the record names makes the same cloud again.
    again = make_cloud(record["family"], record["seed"], record["resolution"], **record["parameters"])
    assert again.density.tobytes() == expected.density.tobytes()


def test_preview_draws_a_row_a_family(tmp_path: Path) -> None:
    from PIL import Image

    picture = tmp_path / "sheet.png"
    assert run("preview", "shapes", "cumulus", "-o", picture, "--count", 2, "--resolution", 16, "--size", 40) == 0
    with Image.open(picture) as image:
        pixels = np.asarray(image)
    assert pixels.shape[0] > 80
    assert pixels.shape[1] >= 80
    # Sky and cloud: a sheet of one colour shows nothing.
    assert pixels.std() > 10


def test_preview_into_a_folder_draws_a_sheet_a_family_with_a_view_from_above(tmp_path: Path) -> None:
    from PIL import Image

    assert run("preview", "stratocumulus", "shapes", "-o", tmp_path / "new", "--count", 1, "--resolution", 16, "--size", 40) == 0
    assert sorted(p.name for p in (tmp_path / "new").iterdir()) == ["clouds_shapes.png", "clouds_stratocumulus.png"]
    with Image.open(tmp_path / "new" / "clouds_shapes.png") as image:
        pixels = np.asarray(image.convert("RGB")).astype(np.float64)
    # The sea behind the view from above is darker than the sky, at the bottom left of both pictures.
    half = pixels.shape[0] // 2
    assert pixels[-8, 6].sum() < pixels[half - 8, 6].sum()


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["make", "nimbus", "-o", "x"], "nimbus"),
        (["make", "cumulus", "-o", "x", "--set", "turets=3"], "turets"),
        (["make", "cumulus", "-o", "x", "--set", "turrets=99"], "3 to 9"),
        (["make", "cumulus", "-o", "x", "--set", "turrets"], "NAME=VALUE"),
        (["make", "cumulus", "-o", "x", "--optical-depth", "-1", "--resolution", "8"], "optical depth"),
        (["preview", "nimbus", "-o", "x.png"], "nimbus"),
        (["preview", "-o", "x.jpg"], "png"),
        (["preview", "-o", "x.png", "--count", "0"], "count"),
    ],
)
def test_bad_input_is_refused_and_leaves_nothing(argv: list[str], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=words):
        run(*argv)
    assert not list(tmp_path.iterdir())
