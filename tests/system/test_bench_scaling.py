"""The scaling benchmark: its points, tables and plots, and one point measured; no timing decides anything here."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from deepclouds_runtime.predictor import RELEASED

from benchmarks import scaling, scaling_point
from benchmarks.page import marks
from benchmarks.scaling import Cloud, Measured, Setting, axes, drawn, markdown, run_point, series, summary, write_csv
from benchmarks.scaling_plots import write_plot
from benchmarks.scaling_point import Point, usable
from deepclouds.errors import InputError
from deepclouds.volume import Volume, write_vol


def point(**changed: Any) -> Point:
    values: dict[str, Any] = {
        "pixels": 256,
        "optical_depth": 60.0,
        "cores": 2,
        "active_voxels": 100,
        "box_voxels": 1000,
        "model": "a",
        "seconds": 1.0,
        "processor_seconds": 1.8,
        "prediction_seconds": 0.4,
        "load_seconds": 0.2,
        "queries": 5000,
        "mean_spp": 4.0,
        "field_bytes": 4000,
        "peak_bytes": 2**30,
    }
    return Point(**{**values, **changed})


def rows() -> list[Measured]:
    pixels, voxels = axes(quick=True)["pixels"], axes(quick=True)["voxels"]
    return [
        Measured(pixels, "cumulus", point(pixels=1024, seconds=3.0)),
        Measured(pixels, "cumulus", point(pixels=256, seconds=1.5)),
        Measured(pixels, "cumulus", point(pixels=256, seconds=0.5, model="b")),
        Measured(voxels, "cumulus", point(active_voxels=10)),
        Measured(voxels, "scattered cumuli", point(active_voxels=20, seconds=0.25)),
        Measured(voxels, "cumulus", point(active_voxels=1000, seconds=2.0)),
    ]


@pytest.fixture
def cloud(tmp_path: Path) -> Path:
    """A soft ball of 12 voxels a side of which the outermost are empty."""
    axis = (np.arange(12) + 0.5) / 6 - 1
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    density = np.clip((0.8 - np.sqrt(x * x + y * y + z * z)) / 0.3, 0, 1).astype(np.float32)
    write_vol(tmp_path / "ball.vol", Volume.from_box(density, (-1, -1, -1), (1, 1, 1)))
    return tmp_path / "ball.vol"


def test_one_thing_is_varied_at_a_time() -> None:
    for quick in (True, False):
        found = axes(quick)
        assert list(found) == ["pixels", "depth", "voxels", "cores"]
        varied = {name: {(s.cloud, s.size, s.optical_depth, s.cores) for s in axis.settings} for name, axis in found.items()}
        for name, column in {"voxels": 0, "pixels": 1, "depth": 2, "cores": 3}.items():
            assert len({setting[column] for setting in varied[name]}) == len(found[name].settings)
            others = {tuple(v for i, v in enumerate(setting) if i != column) for setting in varied[name]}
            assert len(others) == 1, name
        cores = [s.cores for s in found["cores"].settings]
        assert cores[-1] == len(usable())
        assert {s.cloud.family for s in found["voxels"].settings} == {"cumulus", "scattered cumuli"}


def test_series_and_ratios(tmp_path: Path) -> None:
    """Expected behaviour: one series a model and kind of cloud, ascending; times over the first point of their own series."""
    found = rows()
    pixels = series(found[:3])
    assert list(pixels) == [("a", "cumulus"), ("b", "cumulus")]
    assert [r.x for r in pixels["a", "cumulus"]] == [256, 1024]
    assert summary(found) == "scaling: pixels 4 x, time 2 x; active voxels 100 x, time 2 x"
    write_csv(tmp_path / "new" / "scaling_voxels.csv", found[3:])
    with open(tmp_path / "new" / "scaling_voxels.csv", newline="", encoding="utf-8") as file:
        lines = list(csv.DictReader(file))
    assert [(r["varied"], r["cloud"], r["active_voxels"], r["time_over_first"]) for r in lines] == [
        ("voxels", "cumulus", "10", "1"),
        ("voxels", "cumulus", "1000", "2"),
        ("voxels", "scattered cumuli", "20", "1"),
    ]
    assert all(None not in r and None not in r.values() for r in lines)
    table = markdown(found).splitlines()
    assert len(table) == 2 + len(found)
    assert table[3].startswith("| pixels | a, cumulus | 1,024 | 3 | 2 | 0.4 | 1.8 | 5,000 | 4 | 0.2 | 1.00 |")
    assert len({line.count("|") for line in table}) == 1
    assert drawn(found[3:]) == {"a, cumulus": [(10, 1.0, 0.4), (1000, 2.0, 0.4)], "a, scattered cumuli": [(20, 0.25, 0.4)]}


def test_a_point_is_what_was_asked_for(cloud: Path) -> None:
    """Expected behaviour: figures of the very cloud and image; a cloud that the model was not trained on gives none."""
    pytest.importorskip("mitsuba")
    model = RELEASED[-1]
    found = scaling_point.measure(cloud, 16, 8.0, "y", None, model, repeats=2)
    assert found is not None
    assert (found.pixels, found.optical_depth, found.box_voxels, found.model) == (256, 8.0, 12**3, model)
    assert found.cores == len(usable())
    assert 0 < found.active_voxels < 12**3
    assert found.queries > 0
    assert found.mean_spp >= 1
    assert 0 < found.prediction_seconds < found.seconds
    assert found.peak_bytes > found.field_bytes > 4 * 12**3
    assert scaling_point.measure(cloud, 16, 1e-3, "y", None, model, repeats=1) is None


def test_a_process_with_one_processor(cloud: Path) -> None:
    pytest.importorskip("mitsuba")
    setting = Setting(Cloud(12), size=8, optical_depth=8.0, cores=1)
    found = run_point(setting, cloud, RELEASED[-1], repeats=1)
    assert found is not None
    assert (found.cores, found.pixels) == (1, 64)
    with pytest.raises(InputError, match=r"ball\.vol: --cores 10000: this process may use"):
        run_point(Setting(Cloud(12), cores=10000), cloud, RELEASED[-1], repeats=1)


def test_scattered_cumuli_keep_their_box(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from deepclouds.volume import read_volume

    monkeypatch.setattr(scaling, "_FILLED", 0.003)

    path = Cloud((40, 32, 48)).write(tmp_path)
    volume = read_volume(path)
    assert volume.resolution == (40, 32, 48)
    assert np.linalg.norm(volume.to_world[:3, :3], axis=0).max() == pytest.approx(1.0)
    written = path.stat().st_mtime_ns
    assert Cloud((40, 32, 48)).write(tmp_path).stat().st_mtime_ns == written
    assert max(read_volume(Cloud(12).write(tmp_path)).resolution) == 12


def test_the_whole_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Expected behaviour: every axis for every model, tables and plots of each, and with ``--docs`` the page between its marks."""
    asked: list[tuple[Setting, str]] = []

    def measured(setting: Setting, cloud: Path, model: str, repeats: int) -> Point | None:
        assert cloud.is_file()
        asked.append((setting, model))
        if setting.optical_depth == 4.0:
            return None
        edge = setting.cloud.resolution if isinstance(setting.cloud.resolution, int) else sum(setting.cloud.resolution)
        return point(pixels=setting.size**2, optical_depth=setting.optical_depth, cores=setting.cores or 2, active_voxels=edge, model=model)

    page = tmp_path / "docs" / "benchmark.md"
    page.parent.mkdir()
    page.write_text("before\n" + "\nold\n".join(marks("scaling")) + "\nafter\n")
    monkeypatch.setattr(scaling, "run_point", measured)
    monkeypatch.setattr(scaling, "PAGE", page)
    monkeypatch.setattr(Cloud, "write", lambda self, folder: page)
    models = list(RELEASED)
    assert scaling.main(["--quick", "--docs", "--out", str(tmp_path / "out")]) == 0
    assert len(asked) == len(models) * sum(len(axis.settings) for axis in axes(quick=True).values())
    out = capsys.readouterr().out
    assert out.strip().splitlines()[-1].startswith("scaling: pixels 4 x, time 1 x; ")
    assert out.count("left out, it was not trained") == len(models)
    text = page.read_text()
    assert text.startswith("before")
    assert text.endswith("after\n")
    assert "old" not in text
    for name in axes(quick=True):
        assert f"(images/scaling_{name}.png)" in text
        assert (page.parent / "images" / f"scaling_{name}.png").read_bytes() == (tmp_path / "out" / f"scaling_{name}.png").read_bytes()
        assert (page.parent / "figures" / f"scaling_{name}.csv").read_text() == (tmp_path / "out" / f"scaling_{name}.csv").read_text()
    with pytest.raises(InputError, match="unknown colours; there are pixels, depth"):
        scaling.main(["--only", "colours"])
    with pytest.raises(InputError, match="leave out --only pixels"):
        scaling.main(["--only", "pixels", "--docs"])
    with pytest.raises(InputError, match="--repeats 0"):
        scaling.main(["--repeats", "0"])
    with pytest.raises(InputError, match="no released model is named 'nobody'"):
        scaling.main(["--models", "nobody"])


def test_a_plot_of_one_point(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    assert write_plot(tmp_path / "one.png", "processors", {"a": [(1.0, 0.5, 0.2)]})
    assert (tmp_path / "one.png").read_bytes().startswith(b"\x89PNG")
