"""`deepclouds info` on each kind of file, through the command line's front door."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from deepclouds.cli import main
from deepclouds.volume import Bricks, SparseVolume, Volume, write_vdb, write_vol


def facts(text: str) -> dict[str, str]:
    """The lines of one section: name, two or more blanks, value."""
    pairs = (line.strip().split("  ", 1) for line in text.splitlines() if line.startswith("  "))
    return {name: value.strip() for name, value in pairs}


@pytest.fixture
def volume() -> Volume:
    density = np.zeros((4, 3, 2), np.float32)
    density[1:3, 1, :] = [[1.0, 3.0], [2.0, 2.0]]
    return Volume.from_box(density, (0, 0, 0), (1, 1.5, 2))


def test_vdb_lists_every_grid(capsys: pytest.CaptureFixture[str], root: Path) -> None:
    assert main(["info", str(root / "tests" / "unit" / "data" / "several.vdb")]) == 0
    sections = capsys.readouterr().out.split("\n\n")
    assert [s.splitlines()[0] for s in sections] == [
        f"grid {name}" for name in ("flames", "heat", "twin[0]", "twin[1]", "shared", "wind", "label")
    ]
    shared = facts(sections[4])
    assert shared["voxel size"] == "2 2 2"
    assert shared["active voxels"] == "1"
    assert shared["index box"] == "(1 2 3) to (1 2 3)"
    assert facts(sections[5])["values"] == "vec3s"


def test_vdb_states_half_and_metadata(capsys: pytest.CaptureFixture[str], tmp_path: Path, volume: Volume) -> None:
    write_vdb(tmp_path / "a.vdb", volume, half=True, metadata={"author": "someone"})
    assert main(["info", str(tmp_path / "a.vdb")]) == 0
    found = facts(capsys.readouterr().out)
    assert found["values"] == "float, stored with 16 bits"
    assert found["resolution"] == "2 x 1 x 2"
    assert (found["voxels"], found["active voxels"], found["active share"]) == ("4", "4", "100 %")
    assert found["memory"].endswith("as a dense grid")
    assert found["metadata author"] == "someone"


def test_vdb_states_the_memory_of_a_large_box_by_what_it_holds(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """A box of 2e9 voxels with two of them active: two bricks, and a table for the 4 million of the box."""
    values = np.zeros((2, 8, 8, 8), np.float32)
    values[:, 3, 4, 5] = 1
    volume = SparseVolume(Bricks((1264,) * 3, np.array([[0, 0, 0], [157, 157, 157]], np.int32), values), np.eye(4))
    write_vdb(tmp_path / "a.vdb", volume)
    assert main(["info", str(tmp_path / "a.vdb")]) == 0
    found = facts(capsys.readouterr().out)
    assert (found["voxels"], found["active voxels"]) == (str(1257**3), "2")
    number, unit = found["memory"].split()[1:3]
    assert unit == "GiB"
    assert float(number) == pytest.approx(32 * 158**3 / 2**30, rel=0.1)
    assert found["memory"].endswith("in 2 bricks of 8^3 voxels")


def test_vol_statistics(capsys: pytest.CaptureFixture[str], tmp_path: Path, volume: Volume) -> None:
    write_vol(tmp_path / "a.vol", volume)
    assert main(["info", str(tmp_path / "a.vol")]) == 0
    found = facts(capsys.readouterr().out)
    assert found["resolution"] == "2 x 3 x 4"
    assert (found["voxels"], found["filled voxels"], found["filled share"]) == ("24", "4", "16.7 %")
    assert found["box"] == "(0 0 0) to (1 1.5 2)"
    assert float(found["density max"]) == 3
    assert float(found["density mean"]) == pytest.approx(8 / 24, rel=1e-5)
    assert float(found["mean / max"]) == pytest.approx(8 / 24 / 3, rel=1e-5)
    assert float(found["weighted mean / max"]) == pytest.approx(18 / 8 / 3, rel=1e-5)


def test_vol_with_negative_values_is_shown_and_they_are_counted(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    content = b"VOL\x03" + struct.pack("<5i6f", 1, 2, 1, 1, 1, 0, 0, 0, 1, 1, 1) + struct.pack("<2f", -1, 4)
    (tmp_path / "a.vol").write_bytes(content)
    assert main(["info", str(tmp_path / "a.vol")]) == 0
    found = facts(capsys.readouterr().out)
    assert float(found["density max"]) == 4
    assert "1 negative values" in found["clamped"]


def test_exr_size_channels_and_attributes(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    import OpenEXR

    pixels = np.arange(6, dtype=np.float32).reshape(2, 3)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "renderer": "by hand"}
    with OpenEXR.File(header, {"J": OpenEXR.Channel(pixels)}) as file:
        file.write(str(tmp_path / "a.exr"))
    assert main(["info", str(tmp_path / "a.exr")]) == 0
    head, channel = capsys.readouterr().out.split("\n\n")
    assert facts(head)["renderer"] == "by hand"
    assert channel.splitlines()[0] == "channel J"
    assert facts(channel) == {"size": "3 x 2", "min": "0", "max": "5", "mean": "2.5"}


@pytest.fixture
def model(tmp_path: Path) -> Path:
    import onnx
    from onnx import TensorProto, helper

    graph = helper.make_graph(
        [helper.make_node("MatMul", ["x", "w"], ["y"])],
        "product",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, ["batch", 3])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, ["batch", 2])],
        [helper.make_tensor("w", TensorProto.FLOAT, [3, 2], [0.0] * 6)],
    )
    built = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(built, {"licence": "CC0", "ranges": json.dumps({"g": [-0.3, 0.9], "error": 0.123456789, "note": "none"})})
    path = tmp_path / "model.onnx"
    onnx.save(built, str(path))
    return path


def test_onnx_signature_and_metadata(capsys: pytest.CaptureFixture[str], model: Path) -> None:
    assert main(["info", str(model)]) == 0
    found = facts(capsys.readouterr().out)
    assert found["input x"] == "float32 [batch, 3]"
    assert found["output y"] == "float32 [batch, 2]"
    assert found["metadata licence"] == "CC0"
    assert found["metadata ranges g"] == "[-0.3, 0.9]"
    assert found["metadata ranges error"] == "0.123457"
    assert found["metadata ranges note"] == "none"
    assert found["bytes"] == str(model.stat().st_size)
    assert found["opset ai.onnx"] == "17"
    assert found["weights"] == "6"


def test_onnx_refuses_what_is_no_model(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for content in (b"", b"not a model at all"):
        (tmp_path / "a.onnx").write_bytes(content)
        assert main(["info", str(tmp_path / "a.onnx")]) == 2
        assert str(tmp_path / "a.onnx") in capfd.readouterr().err


@pytest.mark.parametrize("name", ["a.vdb", "a.vol", "a.onnx", "a.exr"])
def test_missing_and_damaged_files_exit_with_2(capfd: pytest.CaptureFixture[str], tmp_path: Path, name: str) -> None:
    assert main(["info", str(tmp_path / name)]) == 2
    assert "no such file" in capfd.readouterr().err
    (tmp_path / name).write_bytes(b"0123456789" * 20)
    assert main(["info", str(tmp_path / name)]) == 2
    assert str(tmp_path / name) in capfd.readouterr().err


def test_unknown_suffix_exits_with_2_and_names_the_known(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["info", str(tmp_path / "a.txt")]) == 2
    assert ".vdb, .vol, .onnx, .exr" in capsys.readouterr().err


def test_a_terminal_gets_tables(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, volume: Volume
) -> None:
    write_vdb(tmp_path / "a.vdb", volume, name="[red]fog[/red]")
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    assert main(["info", str(tmp_path / "a.vdb")]) == 0
    out = capsys.readouterr().out
    assert "[red]fog[/red]" in out
    assert "voxel size" in out
    assert "│" in out


def test_a_reader_that_has_seen_enough_ends_it_quietly(model: Path) -> None:
    """Rationale: `deepclouds info ... | head -1` is ordinary use."""
    code = "import sys; from deepclouds.cli import main; sys.exit(main(sys.argv[1:]))"
    process = subprocess.Popen([sys.executable, "-c", code, "info", str(model)], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    with process.stderr as stream:
        assert stream.read() == b""
    assert process.wait() == 0
