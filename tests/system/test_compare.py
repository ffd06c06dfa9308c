"""`deepclouds compare` from files to printed figures, map and refusals."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

import deepclouds.compare as compare
from deepclouds.errors import InputError
from deepclouds.exr import write_exr
from deepclouds.metrics import error_report


def save(path: Path, image: np.ndarray) -> str:
    write_exr(path, {c: image[..., i] for i, c in enumerate("RGB")})
    return str(path)


@pytest.fixture
def files(tmp_path: Path) -> dict[str, str]:
    """An image 10 % too bright at twice the size, another seed of it, and two noisy references of 48 x 48."""
    rng = np.random.default_rng(6)
    truth = np.linspace(0.3, 1.0, 48)[:, None, None] * np.array([1.0, 0.8, 0.5]) * np.ones((48, 48, 1))
    truth[:, :6] = 0
    large = np.repeat(np.repeat(1.1 * truth, 2, axis=0), 2, axis=1)
    images = {
        "image": large * rng.normal(1, 0.02, large.shape),
        "seed": large * rng.normal(1, 0.02, large.shape),
        "a": truth * rng.gamma(25, 1 / 25, truth.shape),
        "b": truth * rng.gamma(25, 1 / 25, truth.shape),
    }
    return {name: save(tmp_path / f"{name}.exr", pixels) for name, pixels in images.items()}


def test_json_holds_the_figures(files: dict[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    assert compare.main([files["image"], "--ref", files["a"], "--ref", files["b"], "--noise", files["seed"], "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["independent"] is True
    assert figures["energy"] == pytest.approx(0.1, abs=0.01)
    assert figures["rrmse"] == pytest.approx(0.11, abs=0.02)
    # 2 % in each of four pixels that are averaged.
    assert figures["noise"] == pytest.approx(0.011, rel=0.1)
    low, high = figures["energy_interval"]
    assert low < figures["energy"] < high


def test_text_agrees_with_the_library(files: dict[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    from deepclouds.exr import read_exr

    assert compare.main([files["image"], "--ref", files["a"], "--ref", files["b"]]) == 0
    out = capsys.readouterr().out
    report = error_report(*(read_exr(files[n]).rgb() for n in ("image", "a", "b")))
    assert f"rRMSE          {100 * report.rrmse:7.2f} %" in out
    assert f"energy         {100 * report.energy:+7.2f} %" in out
    assert "INCLUDE" not in out


def test_one_reference_says_so(files: dict[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    assert compare.main([files["image"], "--ref", files["a"]]) == 0
    assert "INCLUDE the reference's own noise" in capsys.readouterr().out


@pytest.mark.parametrize("matplotlib", [True, False])
def test_map(files: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, matplotlib: bool) -> None:
    """Expected behaviour: with matplotlib and without, the map is a picture in which far more area is reddish than bluish."""
    pillow = pytest.importorskip("PIL.Image")
    if matplotlib:
        pytest.importorskip("matplotlib")
    else:
        monkeypatch.setattr(compare, "find_spec", lambda name: None)
    target = tmp_path / "map.png"
    assert compare.main([files["image"], "--ref", files["a"], "--ref", files["b"], "--map", str(target)]) == 0
    with pillow.open(target) as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    assert pixels.shape[1] > 2.5 * pixels.shape[0]
    panel = pixels[:, int(0.66 * pixels.shape[1]) : int(0.85 * pixels.shape[1])]
    red = np.count_nonzero(panel[..., 0] > panel[..., 2] + 20)
    blue = np.count_nonzero(panel[..., 2] > panel[..., 0] + 20)
    assert red > 3 * blue
    assert red > 0.2 * panel[..., 0].size


def test_signed_error_and_colours() -> None:
    truth = np.ones((24, 24, 3))
    truth[:, :3] = 0.0
    image = truth.copy()
    image[:12] *= 1.2
    image[:, :3] = 5.0
    error = compare.relative_error(image, truth, truth)
    np.testing.assert_allclose(error[:12, 3:], 0.2)
    np.testing.assert_allclose(error[12:, 3:], 0.0)
    np.testing.assert_array_equal(error[:, :3], 0.0)
    low, middle, high = compare.diverging(np.array([-1.0, 0.0, 1.0]))
    assert low[2] > low[0]
    np.testing.assert_array_equal(middle, 1.0)
    assert high[0] > high[2]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{image}", "--ref", "{a}", "--ref", "{a}"], "same image"),
        (["{image}", "--ref", "{a}", "--ref", "{b}", "--ref", "{b}"], "3 times"),
        (["{image}", "--ref", "{a}", "--noise", "{image}"], "another seed"),
        (["{a}", "--ref", "{image}"], "integer multiple"),
        (["none.exr", "--ref", "{a}"], "no such image"),
        (["{image}", "--ref", "{a}", "--layer", "nn"], "no layer 'nn'"),
        (["{image}", "--ref", "{a}", "--map", "map.jpg"], r"end in \.png"),
        (["{image}", "--ref", "{a}", "--tile", "0"], "at least one pixel"),
    ],
)
def test_bad_input_is_named(files: dict[str, str], arguments: list[str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        compare.main([a.format(**files) for a in arguments])


def test_nan_is_counted(files: dict[str, str], tmp_path: Path) -> None:
    openexr = pytest.importorskip("OpenEXR")
    broken = np.ones((48, 48), np.float32)
    broken[2, 3] = np.nan
    with openexr.File({"type": openexr.scanlineimage}, dict.fromkeys("RGB", broken)) as file:
        file.write(str(tmp_path / "broken.exr"))
    with pytest.raises(InputError, match=r"broken\.exr: 3 NaN and 0 infinite"):
        compare.main([str(tmp_path / "broken.exr"), "--ref", files["a"]])


def test_corrupted_reference_is_refused(files: dict[str, str], tmp_path: Path) -> None:
    content = Path(files["a"]).read_bytes()
    (tmp_path / "cut.exr").write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match=r"cut\.exr"):
        compare.main([files["image"], "--ref", files["a"], "--ref", str(tmp_path / "cut.exr")])


def test_reading_the_module_loads_nothing_heavy() -> None:
    import subprocess

    heavy = ("torch", "mitsuba", "onnxruntime", "matplotlib", "OpenEXR", "PIL")
    code = f"import sys, deepclouds.compare; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
