"""Numbered files: a sequence of volumes as artists name it, the frames asked of it, and the names of what is written."""

from __future__ import annotations

import glob
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from deepclouds.errors import InputError

VOLUMES = (".vdb", ".vol")
_PATTERN = re.compile(r"%(?:0(\d+))?d|(#+)")
_GLOB = re.compile(r"[*?\[]")
_PART = re.compile(r"(\d+)(?:-(\d+)(?:x(\d+))?)?")
# Most of the missing frames that a message names.
_NAMED = 8
_DIGITS = 4


@dataclass(frozen=True)
class FileSequence:
    """Volumes with a number each.

    Attributes
    ----------
    name
        the sequence in words, with the number as ``%04d``.
    files
        frame -> file, in the order of the frames; all that lie on the disk.
    digits
        digits that the numbers are filled up to with zeros.
    """

    name: str
    files: dict[int, Path]
    digits: int

    @property
    def key_frames(self) -> tuple[int, ...]:
        """The first, the middle and the last frame on the disk: what must not change over the sequence is taken from them."""
        frames = list(self.files)
        return tuple(dict.fromkeys((frames[0], frames[len(frames) // 2], frames[-1])))

    def chosen(self, asked: Sequence[int] | None) -> tuple[int, ...]:
        """Frames to render: those `asked` for, or all of them.

        Raises
        ------
        InputError
            when one that is asked for is missing; when none is named and there is a hole in the numbers.
        """
        if asked is not None:
            missing = [frame for frame in asked if frame not in self.files]
            if missing:
                raise InputError(f"{self.name}: {_numbers(missing)} missing; there are {ranges(self.files)}")
            return tuple(asked)
        frames = list(self.files)
        step = min((b - a for a, b in pairwise(frames)), default=1)
        missing = sorted(set(range(frames[0], frames[-1] + 1, step)) - set(frames))
        if missing:
            raise InputError(f"{self.name}: {_numbers(missing)} missing; write them, or name those to render: --frames {ranges(frames)}")
        return tuple(frames)


def find_sequence(inputs: Sequence[str]) -> FileSequence | None:
    """The sequence that the command line means; None for a single file.

    Parameters
    ----------
    inputs
        one name with ``%04d`` or ``####`` in the place of the number, a folder, a name with ``*``; or several files.

    Raises
    ------
    InputError
        when there is no such file, or when files of more than one sequence fit.
    """
    if len(inputs) > 1:
        return _grouped("the files given", [Path(name) for name in inputs])
    path = Path(inputs[0])
    if path.is_file():
        return None
    if path.is_dir():
        return _grouped(f"{path}", sorted(p for p in path.iterdir() if p.suffix.lower() in VOLUMES and not p.name.startswith(".")))
    if _PATTERN.search(path.name):
        return _matching(path)
    if _GLOB.search(inputs[0]):
        return _grouped(inputs[0], sorted(Path(name) for name in glob.glob(inputs[0])))
    return None


def parse_frames(text: str) -> tuple[int, ...]:
    """Frames of ``1-48``, ``1-48x2`` (every second one), ``7`` or several of these with commas between, each once.

    Raises
    ------
    ValueError
        for anything else.
    """
    frames: list[int] = []
    for part in text.split(","):
        match = _PART.fullmatch(part.strip())
        if match is None:
            raise ValueError(f"'{text}' is not a list of frames, as in 1-48, 1-48x2 or 1,5,9-12")
        first, step = int(match[1]), int(match[3] or 1)
        last = int(match[2] or first)
        if last < first or step < 1:
            raise ValueError(f"'{part}' holds no frame: write the smaller number first, and a step of 1 or more")
        frames += range(first, last + 1, step)
    return tuple(dict.fromkeys(frames))


def numbered(path: Path, frame: int, digits: int = _DIGITS) -> Path:
    """The name of one frame's file: the number in the place of ``%04d`` or ``####``, else before the ending."""
    match = _PATTERN.search(path.name)
    if match is None:
        return path.with_name(f"{path.stem}.{frame:0{digits}d}{path.suffix}")
    width = len(match[2]) if match[2] else int(match[1] or 1)
    return path.with_name(f"{path.name[: match.start()]}{frame:0{width}d}{path.name[match.end() :]}")


def ranges(frames: Iterable[int]) -> str:
    """Frames as `parse_frames` reads them: ``1-6,8-48``."""
    parts: list[list[int]] = []
    for frame in frames:
        if parts and parts[-1][1] == frame - 1:
            parts[-1][1] = frame
        else:
            parts.append([frame, frame])
    return ",".join(f"{a}-{b}" if b > a else f"{a}" for a, b in parts)


def _matching(path: Path) -> FileSequence:
    matches = list(_PATTERN.finditer(path.name))
    if len(matches) > 1:
        raise InputError(f"{path}: the number of the frame stands in one place only")
    match = matches[0]
    digits = len(match[2]) if match[2] else int(match[1] or 1)
    name = re.compile(re.escape(path.name[: match.start()]) + r"(\d+)" + re.escape(path.name[match.end() :]))
    found = {}
    for file in path.parent.iterdir() if path.parent.is_dir() else ():
        number = name.fullmatch(file.name)
        # `%04d` writes 12345 with five digits, and 7 with four.
        if number is not None and number[1] == f"{int(number[1]):0{digits}d}":
            found[int(number[1])] = file
    if not found:
        raise InputError(f"{path}: no such file, whatever the number of the frame")
    return FileSequence(str(path), dict(sorted(found.items())), max(digits, len(str(min(found)))))


def _grouped(words: str, files: Sequence[Path]) -> FileSequence:
    """The one sequence that `files` belong to, by the last number in their names."""
    groups: dict[tuple[str, str], dict[int, Path]] = {}
    texts: dict[tuple[str, str], list[str]] = {}
    for file in files:
        if file.suffix.lower() not in VOLUMES:
            raise InputError(f"{file}: a sequence is made of volumes (.vdb, .vol)")
        if not file.is_file():
            raise InputError(f"{file}: no such file")
        match = re.search(r"(\d+)(?=\D*$)", file.stem)
        if match is None:
            raise InputError(f"{file}: no number in the name says which frame of the sequence it is; render it alone")
        key = str(file.parent / file.stem[: match.start()]), file.stem[match.end() :] + file.suffix
        if int(match[1]) in groups.setdefault(key, {}):
            raise InputError(f"{file}: frame {int(match[1])} is there twice, as {groups[key][int(match[1])].name} too; remove one of them")
        groups[key][int(match[1])] = file
        texts.setdefault(key, []).append(match[1])
    if not groups:
        raise InputError(f"{words}: no .vdb or .vol files there")
    if len(groups) > 1:
        names = ", ".join(f"{before}####{after}" for before, after in sorted(groups))
        raise InputError(f"{words}: files of {len(groups)} sequences ({names}); name one of them")
    ((key, found),) = groups.items()
    digits = min(len(text) for text in texts[key])
    return FileSequence(f"{key[0]}%0{digits}d{key[1]}", dict(sorted(found.items())), digits)


def _numbers(frames: Sequence[int]) -> str:
    named = ", ".join(str(frame) for frame in frames[:_NAMED]) + (", ..." if len(frames) > _NAMED else "")
    return f"frame {named} is" if len(frames) == 1 else f"{len(frames)} frames ({named}) are"
