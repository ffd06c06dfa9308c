"""Mitsuba's .vol files: the bytes, the types, and what is refused."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from deepclouds.errors import InputError
from deepclouds.volume import Volume, read_vol, write_vol

BOX = (-1.0, 0.0, 2.0, 1.0, 0.5, 6.0)


def vol_bytes(
    values: bytes,
    kind: int = 1,
    size: tuple[int, int, int] = (2, 1, 3),
    channels: int = 1,
    version: int = 3,
    box: tuple[float, ...] = BOX,
) -> bytes:
    return b"VOL" + bytes([version]) + struct.pack("<5i6f", kind, *size, channels, *box) + values


def test_layout_is_x_fastest_and_the_box_is_its_own(tmp_path: Path) -> None:
    file = tmp_path / "a.vol"
    file.write_bytes(vol_bytes(struct.pack("<6f", 0, 1, 2, 3, 4, 5)))
    volume = read_vol(file)
    np.testing.assert_array_equal(volume.density, np.arange(6).reshape(3, 1, 2))
    lower, upper = volume.bounds
    np.testing.assert_array_equal(np.concatenate([lower, upper]), BOX)


def test_written_bytes_are_those_of_the_format(tmp_path: Path) -> None:
    volume = Volume.from_box(np.arange(6).reshape(3, 1, 2), BOX[:3], BOX[3:])
    write_vol(tmp_path / "a.vol", volume)
    assert (tmp_path / "a.vol").read_bytes() == vol_bytes(struct.pack("<6f", 0, 1, 2, 3, 4, 5))
    assert [p.name for p in tmp_path.iterdir()] == ["a.vol"]


@pytest.mark.parametrize(("kind", "dtype", "scale"), [(2, np.float16, 1.0), (3, np.uint8, 1 / 255)])
def test_narrow_types(tmp_path: Path, kind: int, dtype: type[np.float16] | type[np.uint8], scale: float) -> None:
    values = np.array([0, 1, 2, 3, 128, 255]).astype(dtype)
    (tmp_path / "a.vol").write_bytes(vol_bytes(values.tobytes(), kind))
    np.testing.assert_allclose(read_vol(tmp_path / "a.vol").density.ravel(), values.astype(np.float64) * scale, rtol=1e-6)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a binary .vol"),
        (b"VOL\x03", "not a binary .vol"),
        (b"PFM" + bytes(80), "not a binary .vol"),
        (vol_bytes(bytes(24), version=2), "version 2"),
        (vol_bytes(bytes(24), kind=4), "type 4"),
        (vol_bytes(bytes(72), channels=3), "3 channels"),
        (vol_bytes(bytes(24), size=(2, -1, 3)), "damaged"),
        (vol_bytes(bytes(23)), "need 72 bytes, the file has 71"),
        (vol_bytes(bytes(25)), "need 72 bytes, the file has 73"),
        (vol_bytes(bytes(24), size=(2**30, 2**30, 2**30)), "damaged"),
        (vol_bytes(bytes(24), box=(0, 0, 0, 1, 0, 1)), "no volume"),
        (vol_bytes(bytes(24), box=(0, 0, 0, 1, float("nan"), 1)), "no volume"),
        (vol_bytes(struct.pack("<6f", 1, 1, 1, 1, float("inf"), 1)), "1 infinite"),
    ],
)
def test_refuses_damaged_and_unknown_files(tmp_path: Path, content: bytes, message: str) -> None:
    file = tmp_path / "bad.vol"
    file.write_bytes(content)
    with pytest.raises(InputError, match=message) as error:
        read_vol(file, clamp=True)
    assert str(file) in str(error.value)


def test_refuses_folders_and_missing_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="folder"):
        read_vol(tmp_path)
    with pytest.raises(InputError, match="no such file"):
        read_vol(tmp_path / "none.vol")
    with pytest.raises(InputError, match="does not exist"):
        write_vol(tmp_path / "none" / "a.vol", Volume.from_box(np.ones((1, 1, 1)), (0, 0, 0), (1, 1, 1)))


def test_negative_values_and_nan_are_counted_or_clamped(tmp_path: Path) -> None:
    (tmp_path / "a.vol").write_bytes(vol_bytes(struct.pack("<6f", -1, -0.5, float("nan"), 0, 2, 3)))
    with pytest.raises(InputError, match=r"2 negative values and 1 NaN among 6 voxels; .*--clamp"):
        read_vol(tmp_path / "a.vol")
    np.testing.assert_array_equal(read_vol(tmp_path / "a.vol", clamp=True).density.ravel(), [0, 0, 0, 0, 2, 3])


@pytest.mark.parametrize("flip", [(0, 1), (0, 0)])
def test_writes_no_rotated_or_mirrored_volume(tmp_path: Path, flip: tuple[int, int]) -> None:
    to_world = np.eye(4)
    to_world[flip] = -0.5
    with pytest.raises(InputError, match="rotated or mirrored"):
        write_vol(tmp_path / "a.vol", Volume(np.ones((1, 1, 1), np.float32), to_world))
    assert not list(tmp_path.iterdir())
