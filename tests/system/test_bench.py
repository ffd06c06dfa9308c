"""The benchmark's arithmetic, its tables, and one run end to end; no timing decides anything here."""

from __future__ import annotations

import csv
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from benchmarks import bench, make_scenes, worker
from benchmarks.bench_plots import write_plots
from benchmarks.bench_rows import Row, compared, markdown, medians, models, speed_ups, write_csv
from benchmarks.equal_error import Timing, interpolated_seconds, unbiased_seconds
from benchmarks.page import marks
from deepclouds.errors import InputError
from deepclouds.exr import read_exr, write_exr
from deepclouds.metrics import ErrorReport, error_report
from deepclouds.volume import read_vol

SCENES = Path(bench.__file__).parent / "scenes"


def report(error: float) -> ErrorReport:
    a = np.random.default_rng(1).normal(1, 1e-6, (24, 24, 1))
    signs = np.where(np.indices((24, 24)).sum(axis=0) % 2, 1.0, -1.0)[..., None]
    return error_report(a * (1 + error * signs), a, a)


def row(method: str, spp: int, seconds: float, error: float, model: str = "", scene: str = "s") -> Row:
    return Row(method, scene, spp, seconds, None, report(error), model)


def test_unbiased_time_is_quadratic() -> None:
    timings = [Timing(1.0, 0.4), Timing(16.0, 0.1)]
    assert unbiased_seconds(timings, 0.05).value == pytest.approx(64.0)
    assert unbiased_seconds(timings, 0.2).value == pytest.approx(4.0)
    assert unbiased_seconds(timings, 0.2).bound == ""


def test_denoised_time_is_interpolated_in_the_logarithm() -> None:
    timings = [Timing(1.0, 0.16), Timing(100.0, 0.04)]
    assert interpolated_seconds(timings, 0.08).value == pytest.approx(10.0)
    assert interpolated_seconds(timings, 0.16).value == pytest.approx(1.0)
    assert interpolated_seconds(timings, 0.04).value == pytest.approx(100.0)
    assert interpolated_seconds(timings, 0.04).bound == ""


def test_beyond_its_points_the_denoiser_gets_a_bound() -> None:
    timings = [Timing(1.0, 0.16), Timing(4.0, 0.08), Timing(16.0, 0.09)]
    worse, better = interpolated_seconds(timings, 0.5), interpolated_seconds(timings, 0.01)
    assert (worse.value, worse.bound) == (1.0, "<=")
    # The third point is slower and no better, so nothing is known beyond the second.
    assert (better.value, better.bound) == (4.0, ">=")
    assert str(better.over(2.0)) == ">= 2"
    with pytest.raises(ValueError, match="above 0"):
        interpolated_seconds(timings, 0.0)
    with pytest.raises(ValueError, match="at least one"):
        unbiased_seconds([], 0.1)


def test_speed_up_lines() -> None:
    rows = [row("volpath", 16, 2.0, 0.4), row("oidn", 16, 2.0, 0.05), row("deepclouds", 0, 0.5, 0.1), row("deepclouds", 64, 5.0, 0.09)]
    (line,) = speed_ups(rows)
    # volpath: 2 s * (0.4 / 0.1)^2 = 32 s, 64 times 0.5 s. The denoiser is better than we are from its first point on.
    assert line.startswith("s: deepclouds reaches 10.00 % in 0.5 s; at equal error 64 x [64, 64] against volpath (32 s)")
    assert "<= 4 x" in line
    assert speed_ups(rows[:2]) == ["s: no speed-up, deepclouds was not run"]
    table = markdown(rows)
    assert "32 s (64 x)" in table
    assert "| default |" in table
    assert len(table.splitlines()) == 2 + len(rows)


def test_medians_of_scenes_by_what_lights_them() -> None:
    rows = []
    for scene, seconds in (("a", 0.5), ("b", 0.25), ("c", 1.0), ("sky", 2.0)):
        for method, spp, warm, error in (("volpath", 16, 2.0, 0.4), ("oidn", 16, 2.0, 0.05), ("deepclouds", 0, seconds, 0.1)):
            rows.append(Row(method, scene, spp, warm, None, report(error)))
    line = medians(rows, {"a": "sun", "b": "sun", "c": "sun", "sky": "environment"})
    # 32 s over 0.5, 0.25 and 1 s; the denoiser is better than we are from its first point, 2 s, on.
    assert line == "speed: sun 64 x volpath, <= 4 x volpath+OIDN; environment 16 x volpath"
    assert {bench.light_of(SCENES / name / "scene.xml") for name in ("heap_sun", "ball_isotropic")} == {"sun"}
    assert bench.light_of(SCENES / "plume_sky" / "scene.xml") == "environment"


def test_results_replace_only_what_lies_between_the_marks(tmp_path: Path) -> None:
    page = tmp_path / "benchmark.md"
    page.write_text("before\n" + "\n\nold figures\n\n".join(marks("bench")) + "\nafter\n")
    (tmp_path / "images").mkdir()
    rows = [row("volpath", 16, 2.0, 0.4), row("deepclouds", 0, 0.5, 0.1)]
    for _ in range(2):
        bench.write_docs(rows, markdown(rows), tmp_path)
        text = page.read_text()
        assert text.startswith("before\n" + marks("bench")[0])
        assert text.endswith(marks("bench")[1] + "\nafter\n")
        assert "old figures" not in text
        assert text.count("| s | volpath |") == 1
    page.write_text("no marks")
    with pytest.raises(InputError, match="once each"):
        bench.write_docs(rows, "", tmp_path)


@pytest.mark.parametrize("name", sorted(make_scenes.RECIPES))
def test_our_scenes_are_what_their_recipe_makes(name: str, tmp_path: Path) -> None:
    """Expected behaviour: a recipe writes the very volume and scene that are in the repository; references exist, differ and agree."""
    assert make_scenes.main(["--out", str(tmp_path), "--only", name, "--no-references"]) == 0
    fresh, kept = (read_vol(folder / name / "density.vol").density for folder in (tmp_path, SCENES))
    # Sums of sines and exponentials may differ in the last bit between machines.
    np.testing.assert_allclose(fresh, kept, atol=1e-6)
    assert (tmp_path / name / "scene.xml").read_text() == (SCENES / name / "scene.xml").read_text()
    assert 0 < kept.mean() < kept.max() == pytest.approx(1.0)
    assert all(np.all(face == 0) for axis in range(3) for face in (kept.take(0, axis), kept.take(-1, axis)))
    assert all(f.stat().st_size < 400_000 for f in (SCENES / name).iterdir())
    a, b = (read_exr(SCENES / name / f"ref_{x}.exr") for x in "ab")
    record = json.loads((SCENES / name / "ref.json").read_text())
    assert a.attributes["spp"] == b.attributes["spp"] == record["spp_each"]
    assert a.attributes["firstSeed"] != b.attributes["firstSeed"]
    between = error_report(a.rgb(), b.rgb())
    # Independent noise: neither the same image nor another picture.
    assert 0.005 < between.rrmse < 0.4
    assert abs(between.energy) < 0.03


def test_scenes_are_looked_up_by_name(tmp_path: Path) -> None:
    assert [p.name for p in bench.find_scenes(SCENES, "plume_sky,heap_sun")] == ["plume_sky", "heap_sun"]
    with pytest.raises(InputError, match="no scene nowhere"):
        bench.find_scenes(SCENES, "nowhere")
    with pytest.raises(InputError, match="no scene; a scene is"):
        bench.find_scenes(tmp_path, None)
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "scene.xml").write_text("<scene/>")
    with pytest.raises(InputError, match=r"ref_a\.exr: missing"):
        bench.find_scenes(tmp_path, None)
    with pytest.raises(InputError, match="unknown magic"):
        bench.main(["--methods", "magic"])
    with pytest.raises(InputError, match=r"--spp 0"):
        bench.main(["--spp", "0"])
    with pytest.raises(InputError, match="not a multiple"):
        bench.main(["--size", "50", "--out", str(tmp_path / "out")])


@pytest.mark.slow
def test_peers_end_to_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Expected behaviour: volpath is unbiased and gets better with samples, denoising helps, single scattering lacks energy.

    Octaves lie between.
    """
    pytest.importorskip("mitsuba")
    pytest.importorskip("mitsuba_oidn")
    code = bench.main(
        [
            "--only",
            "ball_isotropic",
            "--methods",
            "unbiased,octaves,volpath,oidn,single",
            "--ours",
            "2",
            "--spp",
            "4,32",
            "--size",
            "48",
            "--out",
            str(tmp_path),
        ]
    )
    assert code == 0
    with open(tmp_path / "bench.csv", newline="", encoding="utf-8") as file:
        rows = {(r["method"], r["spp"]): r for r in csv.DictReader(file)}
    assert set(rows) == {("octaves", "2"), *((m, s) for m in ("unbiased", "volpath", "oidn", "single") for s in ("4", "32"))}
    error = {key: float(r["rrmse"]) for key, r in rows.items()}
    assert error["volpath", "4"] / error["volpath", "32"] == pytest.approx(math.sqrt(8), rel=0.25)
    assert error["oidn", "4"] < 0.5 * error["volpath", "4"]
    assert error["unbiased", "32"] < error["unbiased", "4"]
    assert all(abs(float(rows[method, "32"]["energy"])) < 0.05 for method in ("volpath", "unbiased"))
    assert float(rows["single", "32"]["energy"]) < -0.4
    # Octaves add what single scattering lacks, and are far from path tracing all the same.
    assert error["oidn", "32"] < error["octaves", "2"] < error["single", "32"]
    assert all(float(r["seconds_warm"]) > 0 for r in rows.values())
    # Of our own modes the first image of the process is the cold one.
    assert {key for key, r in rows.items() if not r["seconds_cold"]} == {("unbiased", "32")}
    assert all(float(r["seconds_cold"]) > float(r["seconds_warm"]) for r in rows.values() if r["seconds_cold"])
    assert capsys.readouterr().out.strip().splitlines()[-2] == "ball_isotropic: no speed-up, deepclouds was not run"
    assert (tmp_path / "bench.md").is_file()


def test_a_method_that_fails_is_named_and_the_rest_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def fail(*arguments: object) -> str:
        return "ModuleNotFoundError: nothing here"

    patch = pytest.MonkeyPatch()
    patch.setattr(bench, "run_worker", fail)
    try:
        assert bench.main(["--only", "ball_isotropic", "--quick", "--out", str(tmp_path)]) == 1
    finally:
        patch.undo()
    out = capsys.readouterr().out.strip().splitlines()
    assert sum("did not run: ModuleNotFoundError" in line for line in out) == 7
    assert out[-1] == "speed: sun unknown x volpath, unknown x volpath+OIDN; environment unknown x volpath"
    assert (tmp_path / "bench.csv").read_text().splitlines()[0].startswith("method,model,scene,spp")


def test_the_runtime_is_loaded_once_and_timed_warm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Expected behaviour: two renders a setting with different seeds, of which the second is the warm one; the first pays for loading."""
    loads: list[dict[str, object]] = []
    renders: list[tuple[object, ...]] = []
    clock = [10.0]
    monkeypatch.setattr("benchmarks.worker.time.perf_counter", lambda: clock[0])

    def render(spp: int | None, seed: int, *, correct: bool) -> SimpleNamespace:
        renders.append((spp, seed, correct))
        clock[0] += 0.05 if len(renders) % 2 else 0.04
        return SimpleNamespace(rgb=np.full((8, 8, 3), float(len(renders))))

    def load(scene: Path, **options: object) -> SimpleNamespace:
        loads.append(options)
        clock[0] += 0.15
        known = None if options["model"] == "stranger" else "0" * 64
        return SimpleNamespace(render=render, model_hash=known, predictor=SimpleNamespace(path=Path("somewhere/first.onnx")))

    runtime = ModuleType("deepclouds_runtime.loading")
    monkeypatch.setattr(runtime, "load", load, raising=False)
    monkeypatch.setitem(sys.modules, "deepclouds_runtime.loading", runtime)
    arguments = ["scene.xml", "--size", "8", "--spp", "0,16", "--seed", "5", "--out", str(tmp_path)]
    assert worker.main(["deepclouds", *arguments]) == 0
    assert loads == [{"defines": {"size": "8"}, "model": None, "mode": "fast"}]
    assert [r[0] for r in renders] == [None, None, 16, 16]
    assert len({r[1] for r in renders}) == 4
    assert not any(r[2] for r in renders)
    default, fixed = json.loads((tmp_path / "deepclouds.json").read_text())
    assert (default["spp"], fixed["spp"]) == (0, 16)
    assert {default["model"], fixed["model"]} == {"first"}
    assert default["seconds_cold"] == pytest.approx(0.2)
    assert default["seconds_warm"] == fixed["seconds_warm"] == pytest.approx(0.04)
    assert fixed["seconds_cold"] is None
    np.testing.assert_array_equal(read_exr(tmp_path / fixed["files"][0]).rgb(), 4.0)
    np.testing.assert_array_equal(read_exr(tmp_path / fixed["files"][1]).rgb(), 3.0)
    assert worker.main(["corrected", *arguments]) == 0
    assert all(r[2] for r in renders[4:])
    assert worker.main(["reference", *arguments]) == 0
    assert loads[-1]["mode"] == "reference"
    assert worker.main(["unbiased", *arguments]) == 0
    assert loads[-1] == {"defines": {"size": "8"}, "model": None, "unbiased": True}
    assert json.loads((tmp_path / "unbiased.json").read_text())[0]["model"] == ""
    # One that was asked for by name and does not know the medium would be measured as walks.
    count = len(renders)
    assert worker.main(["deepclouds", *arguments, "--model", "stranger"]) == 0
    assert json.loads((tmp_path / "deepclouds.json").read_text()) == []
    assert len(renders) == count


def test_each_model_is_run_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Expected behaviour: the released models in their order, the default first; one may be left out.

    The last line is of the default; every model has a line of its own before.
    """
    asked: list[tuple[str, str | None]] = []

    def run(
        method: str, scene: Path, size: int, spps: Sequence[int], seed: int, out: Path, model: str | None, seconds: float | None
    ) -> None:
        assert seconds is None
        asked.append((method, model))
        out.mkdir(parents=True, exist_ok=True)
        rows = []
        name = model or ""
        truth = read_exr(scene.parent / "ref_a.exr").rgb()
        for spp in [] if model == "stranger" else spps:
            file = f"{method}_{spp}.exr"
            write_exr(out / file, {c: 1.5 * truth[..., i] for i, c in enumerate("RGB")})
            warm = 0.5 if name == "b" else 0.25
            rows.append({"method": method, "model": name, "spp": spp, "files": [file, file], "seconds_warm": warm, "seconds_cold": None})
        (out / f"{method}.json").write_text(json.dumps(rows))

    monkeypatch.setattr(bench, "run_worker", run)
    monkeypatch.setattr(bench, "RELEASED", ("b", "a", "stranger"))
    monkeypatch.setattr(bench, "find_model", lambda model: model)
    arguments = [
        "--only",
        "ball_isotropic",
        "--methods",
        "deepclouds,corrected,octaves,volpath",
        "--ours",
        "0,2",
        "--spp",
        "16",
        "--out",
        str(tmp_path),
    ]
    assert bench.main(arguments) == 0
    assert asked == [(m, model) for m in ("deepclouds", "corrected") for model in ("b", "a", "stranger")] + [
        ("octaves", None),
        ("volpath", None),
    ]
    out = capsys.readouterr().out
    assert "ball_isotropic: deepclouds stranger was left out: the model was not trained on such a medium" in out
    ends = out.strip().splitlines()[-3:]
    # volpath's error is ours here, at a quarter of a second: half of our time with b, the same as ours with a.
    assert ends[0] == "b, speed: sun 0.5 x volpath, unknown x volpath+OIDN; environment unknown x volpath"
    assert ends[1] == "a, speed: sun 1 x volpath, unknown x volpath+OIDN; environment unknown x volpath"
    assert ends[2] == ends[0].removeprefix("b, ")
    with open(tmp_path / "bench.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [(r["method"], r["model"], r["spp"]) for r in rows[:6]] == [
        ("deepclouds", "b", "default"),
        ("deepclouds", "b", "2"),
        ("deepclouds", "a", "default"),
        ("deepclouds", "a", "2"),
        ("corrected", "b", "default"),
        ("corrected", "a", "default"),
    ]
    assert [(r["method"], r["spp"]) for r in rows[6:]] == [("octaves", "2"), ("volpath", "4")]
    assert all(len(r) == 18 and None not in r.values() for r in rows)
    asked.clear()
    assert bench.main([*arguments, "--models", "a,work/c.onnx", "--methods", "deepclouds"]) == 0
    assert asked == [("deepclouds", "a"), ("deepclouds", "work/c.onnx")]
    monkeypatch.undo()
    with pytest.raises(InputError, match="no released model is named 'nobody'"):
        bench.main(["--models", "nobody"])


def test_models_are_told_apart(tmp_path: Path) -> None:
    rows = [row("volpath", 16, 2.0, 0.4), row("deepclouds", 0, 0.5, 0.1, "a"), row("deepclouds", 4, 0.6, 0.1, "b")]
    rows += [row("corrected", 0, 4.0, 0.05, "a"), row("deepclouds", 0, 1.0, 0.1, "b", "t"), row("volpath", 16, 2.0, 0.4, scene="t")]
    assert models(rows) == ["a", "b"]
    assert models(rows, "t") == ["b"]
    assert compared(rows, "s") is rows[3]
    assert compared(rows, "s", "a", "deepclouds") is rows[1]
    assert compared(rows, "s", "b") is rows[2]
    assert compared(rows, "t", "a") is None
    first, corrected, second, third = speed_ups(rows)
    assert first.startswith("s: deepclouds a reaches 10.00 % in 0.5 s; at equal error 64 x")
    assert corrected.startswith("s: deepclouds a, corrected reaches 5.00 % in 4 s; at equal error 32 x")
    assert second.startswith("s: deepclouds b reaches 10.00 % in 0.6 s")
    assert third.startswith("t: deepclouds b")
    table = markdown(rows)
    assert "| deepclouds a, corrected | default |" in table
    kinds = {"s": "sun", "t": "environment"}
    assert medians(rows, kinds) == "speed: sun 32 x volpath, unknown x volpath+OIDN; environment 32 x volpath"
    assert medians(rows, kinds, "a") == "a, speed: sun 32 x volpath, unknown x volpath+OIDN; environment unknown x volpath"
    write_csv(tmp_path / "bench.csv", rows)
    with open(tmp_path / "bench.csv", newline="", encoding="utf-8") as file:
        assert [r["model"] for r in csv.DictReader(file)] == ["", "a", "b", "a", "b", ""]
    pytest.importorskip("matplotlib")
    assert write_plots(tmp_path, rows) == 2
    assert all((tmp_path / f"bench_{scene}.png").read_bytes().startswith(b"\x89PNG") for scene in "st")


def test_a_worker_reports_its_last_complaint(tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text("<scene version='3.0.0'></scene>")
    pytest.importorskip("mitsuba")
    problem = bench.run_worker("volpath", tmp_path / "scene.xml", 8, [1], 1, tmp_path, None)
    assert problem is not None
    assert "needs an <integrator>" in problem
