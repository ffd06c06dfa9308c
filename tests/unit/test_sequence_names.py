"""Numbered files: how artists name a sequence, which frames they ask for, and what is refused before the first is rendered."""

from __future__ import annotations

from pathlib import Path

import pytest
from deepclouds_runtime.sequence import find_sequence, numbered, parse_frames, ranges

from deepclouds.errors import InputError


def _touch(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).touch()


@pytest.mark.parametrize("name", ["fire.%04d.vdb", "fire.####.vdb", "fire.%d.vdb", "fire.*.vdb", ""])
def test_every_way_to_write_a_sequence(tmp_path: Path, name: str) -> None:
    digits = "" if name == "fire.%d.vdb" else "000"
    _touch(tmp_path, *(f"fire.{digits}{i}.vdb" for i in (3, 1, 2)), "notes.txt")
    found = find_sequence([str(tmp_path / name)])
    assert found is not None
    assert [(frame, file.name) for frame, file in found.files.items()] == [(i, f"fire.{digits}{i}.vdb") for i in (1, 2, 3)]
    assert found.chosen(None) == (1, 2, 3)
    assert found.chosen((3, 1)) == (3, 1)


def test_files_that_the_shell_has_listed_are_a_sequence(tmp_path: Path) -> None:
    _touch(tmp_path, "a_v2_0009.vdb", "a_v2_0010.vdb")
    found = find_sequence([str(tmp_path / "a_v2_0010.vdb"), str(tmp_path / "a_v2_0009.vdb")])
    assert found is not None
    assert list(found.files) == [9, 10]
    assert found.digits == 4


def test_a_pattern_takes_only_names_that_it_writes(tmp_path: Path) -> None:
    _touch(tmp_path, "c_0001.vdb", "c_1.vdb", "c_00002.vdb", "c_12345.vdb")
    found = find_sequence([str(tmp_path / "c_%04d.vdb")])
    assert found is not None
    assert list(found.files) == [1, 12345]


def test_one_file_is_no_sequence(tmp_path: Path) -> None:
    _touch(tmp_path, "cloud_0001.vdb", "odd_%04d.vdb")
    assert find_sequence([str(tmp_path / "cloud_0001.vdb")]) is None
    assert find_sequence([str(tmp_path / "odd_%04d.vdb")]) is None
    assert find_sequence([str(tmp_path / "nothing.vdb")]) is None


def test_key_frames_do_not_depend_on_what_is_asked_for(tmp_path: Path) -> None:
    _touch(tmp_path, *(f"c_{i:02d}.vdb" for i in range(1, 10)))
    found = find_sequence([str(tmp_path / "c_##.vdb")])
    assert found is not None
    assert found.key_frames == (1, 5, 9)
    (tmp_path / "alone").mkdir()
    _touch(tmp_path / "alone", "c_01.vdb")
    alone = find_sequence([str(tmp_path / "alone")])
    assert alone is not None
    assert alone.key_frames == (1,)


def test_missing_frames_are_named(tmp_path: Path) -> None:
    _touch(tmp_path, *(f"c_{i:04d}.vdb" for i in (1, 2, 4, 5)))
    found = find_sequence([str(tmp_path / "c_%04d.vdb")])
    assert found is not None
    with pytest.raises(InputError, match=r"frame 3 is missing; write them, or name those to render: --frames 1-2,4-5"):
        found.chosen(None)
    with pytest.raises(InputError, match=r"2 frames \(3, 7\) are missing; there are 1-2,4-5"):
        found.chosen((1, 3, 7))
    assert found.chosen((4, 5)) == (4, 5)


def test_every_second_frame_has_no_hole(tmp_path: Path) -> None:
    _touch(tmp_path, "c_0001.vdb", "c_0003.vdb", "c_0005.vdb")
    found = find_sequence([str(tmp_path)])
    assert found is not None
    assert found.chosen(None) == (1, 3, 5)


@pytest.mark.parametrize(
    ("names", "asked", "said"),
    [
        (["a_1.vdb", "b_1.vdb"], "", "files of 2 sequences"),
        (["cloud.vdb", "b_1.vdb"], "", "no number in the name"),
        (["a_1.vdb", "a_01.vdb"], "", "frame 1 is there twice"),
        (["a.txt"], "", "no .vdb or .vol files there"),
        ([], "a_%04d.vdb", "no such file, whatever the number"),
        ([], "a_*.vdb", "no .vdb or .vol files there"),
        (["s_1.xml"], "s_*.xml", r"a sequence is made of volumes \(.vdb, .vol\)"),
        ([], "a_##_##.vdb", "in one place only"),
    ],
)
def test_what_is_no_sequence_is_refused(tmp_path: Path, names: list[str], asked: str, said: str) -> None:
    _touch(tmp_path, *names)
    with pytest.raises(InputError, match=said):
        find_sequence([str(tmp_path / asked)])


def test_frames_are_read_and_written() -> None:
    assert parse_frames("1-3") == (1, 2, 3)
    assert parse_frames("7") == (7,)
    assert parse_frames("1-9x4, 2,5") == (1, 5, 9, 2)
    assert ranges((1, 2, 3, 5, 7, 8)) == "1-3,5,7-8"
    for text in ("", "3-1", "1-", "a", "1-5x0", "-3", "1.5"):
        with pytest.raises(ValueError, match="frame"):
            parse_frames(text)


@pytest.mark.parametrize(
    ("name", "written"), [("o.exr", "o.0007.exr"), ("o_##.exr", "o_07.exr"), ("o%05d.exr", "o00007.exr"), ("o-%d-x.exr", "o-7-x.exr")]
)
def test_output_names(name: str, written: str) -> None:
    assert numbered(Path("f") / name, 7) == Path("f") / written
