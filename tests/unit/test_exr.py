"""EXR files come back as they were written; damaged ones are refused, not half read."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from deepclouds.errors import InputError
from deepclouds.exr import Exr, read_exr, srgb, tone_map, write_exr, write_png
from deepclouds.replacing import replacing


@pytest.fixture
def image() -> np.ndarray:
    return np.random.default_rng(1).gamma(0.5, 2.0, size=(7, 5, 3)).astype(np.float32)


def layers(image: np.ndarray, prefix: str = "") -> dict[str, np.ndarray]:
    return {prefix + c: np.ascontiguousarray(image[..., i]) for i, c in enumerate("RGB")}


def test_round_trip_keeps_every_bit_and_the_attributes(tmp_path: Path, image: np.ndarray) -> None:
    path = tmp_path / "a.exr"
    attributes: dict[str, str | float | int] = {"model": "sha256:0123", "spp": 64, "seconds": 1.5, "negative": -3}
    write_exr(path, {**{c: image[..., i] for i, c in enumerate("RGB")}, "A": image[..., 0], "J.R": image[..., 1]}, attributes)
    back = read_exr(path)
    assert set(back.channels) == {"R", "G", "B", "A", "J.R"}
    assert all(c.dtype == np.float32 for c in back.channels.values())
    np.testing.assert_array_equal(back.rgb(), image)
    np.testing.assert_array_equal(back.channels["J.R"], image[..., 1])
    assert back.attributes == attributes
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]


def test_half_and_integer_channels_become_float32(tmp_path: Path) -> None:
    openexr = pytest.importorskip("OpenEXR")
    half, whole = np.full((2, 3), 0.5, np.float16), np.arange(6, dtype=np.uint32).reshape(2, 3)
    path = tmp_path / "h.exr"
    with openexr.File({"type": openexr.scanlineimage}, {"Y": half, "id": whole}) as file:
        file.write(str(path))
    back = read_exr(path)
    assert back.channels["Y"].dtype == back.channels["id"].dtype == np.float32
    np.testing.assert_array_equal(back.channels["id"], whole)


def test_parts_carry_their_names(tmp_path: Path, image: np.ndarray) -> None:
    openexr = pytest.importorskip("OpenEXR")
    header = {"type": openexr.scanlineimage}
    parts = [openexr.Part({**header, "name": n}, layers(image * k)) for n, k in (("first", 1), ("second", 2))]
    path = tmp_path / "parts.exr"
    with openexr.File(parts) as file:
        file.write(str(path))
    back = read_exr(path)
    assert back.layers == ("first", "second")
    np.testing.assert_array_equal(back.rgb("second"), 2 * image)
    with pytest.raises(InputError, match="several layers"):
        back.rgb()


def test_rgb_finds_the_colours(image: np.ndarray) -> None:
    r, g, b = (image[..., i] for i in range(3))
    np.testing.assert_array_equal(Exr({"B": b, "G": g, "R": r, "nn.R": g, "nn.G": g, "nn.B": g}, {}).rgb(), image)
    np.testing.assert_array_equal(Exr({"beauty.view.R": r, "beauty.view.G": g, "beauty.view.B": b, "A": r}, {}).rgb(), image)
    np.testing.assert_array_equal(Exr({"Y": r, "A": g}, {}).rgb(), np.stack([r, r, r], axis=-1))
    np.testing.assert_array_equal(Exr({"depth": r}, {}).rgb()[..., 2], r)
    with pytest.raises(InputError, match="no layer 'x'"):
        Exr({"R": r, "G": g, "B": b}, {}).rgb("x")
    with pytest.raises(InputError, match="neither R, G, B"):
        Exr({"u": r, "v": g}, {}).rgb()


@pytest.mark.parametrize("keep", [0, 3, 100, 0.5, -1])
def test_truncated_files_are_refused(tmp_path: Path, image: np.ndarray, keep: float) -> None:
    path = tmp_path / "a.exr"
    write_exr(path, layers(image))
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * keep) if isinstance(keep, float) else keep])
    with pytest.raises(InputError, match=r"a\.exr"):
        read_exr(path)


def test_garbage_and_missing_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "b.exr"
    path.write_bytes(bytes(range(256)) * 8)
    with pytest.raises(InputError, match="not a readable OpenEXR file"):
        read_exr(path)
    with pytest.raises(InputError, match="no such image"):
        read_exr(tmp_path / "none.exr")
    with pytest.raises(InputError, match="no such image"):
        read_exr(tmp_path)


def test_damaged_compressed_pixels_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "c.exr"
    write_exr(path, {"Y": np.tile(np.arange(64.0), (64, 1))})
    content = bytearray(path.read_bytes())
    content[-200:-100] = bytes(100)
    path.write_bytes(bytes(content))
    with pytest.raises(InputError, match=r"c\.exr"):
        read_exr(path)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e60])
def test_non_finite_pixels_are_not_written(tmp_path: Path, bad: float) -> None:
    pixels = np.zeros((4, 4))
    pixels[1, 2] = pixels[3, 3] = bad
    with pytest.raises(InputError, match="holds 2 NaN or infinite"):
        write_exr(tmp_path / "a.exr", {"R": pixels})
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_stored_is_refused(tmp_path: Path) -> None:
    one, path = np.ones((2, 2)), tmp_path / "a.exr"
    with pytest.raises(InputError, match="different shapes"):
        write_exr(path, {"R": one, "G": np.ones((3, 2))})
    with pytest.raises(InputError, match="at least one channel"):
        write_exr(path, {})
    with pytest.raises(InputError, match="shape"):
        write_exr(path, {"R": np.ones(4)})
    with pytest.raises(InputError, match="32 bits"):
        write_exr(path, {"R": one}, {"samples": 2**31})
    with pytest.raises(InputError, match="own layout"):
        write_exr(path, {"R": one}, {"compression": "none"})
    with pytest.raises(InputError, match="text or a number"):
        write_exr(path, {"R": one}, {"flag": True})
    with pytest.raises(InputError, match=r"end in \.exr"):
        write_exr(tmp_path / "a.hdr", {"R": one})
    with pytest.raises(InputError, match="does not exist"):
        write_exr(tmp_path / "none" / "a.exr", {"R": one})
    assert not list(tmp_path.iterdir())


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, image: np.ndarray) -> None:
    path = tmp_path / "a.exr"
    write_exr(path, layers(image))
    before = path.read_bytes()

    def fail() -> None:
        with replacing(path, ".exr") as temporary:
            temporary.write_bytes(b"half")
            raise RuntimeError("disk full")

    with pytest.raises(RuntimeError, match="disk full"):
        fail()
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]


@pytest.mark.parametrize(("suffix", "size"), [(".exr", 8), (".exr", 256), (".png", 8)])
def test_a_full_disk_is_bad_input_and_leaves_the_old_file(tmp_path: Path, suffix: str, size: int) -> None:
    """Of a small image only the last bytes are written, which OpenEXR itself does not miss."""
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"old")
    (tmp_path / f".a.{os.getpid()}.tmp{suffix}").symlink_to("/dev/full")
    rgb = np.random.default_rng(1).random((size, size, 3))
    with pytest.raises(InputError, match=rf"a\{suffix}: cannot be written \(.+\); make room on the disk"):
        write_exr(path, layers(rgb)) if suffix == ".exr" else write_png(path, rgb)
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_preview(tmp_path: Path) -> None:
    pillow = pytest.importorskip("PIL.Image")
    rgb = np.zeros((2, 3, 3))
    rgb[0, 0], rgb[0, 1], rgb[1, 2] = 4.0, -1.0, (1.0, 0.0, 0.0)
    write_png(tmp_path / "p.png", rgb)
    with pillow.open(tmp_path / "p.png") as picture:
        pixels = np.asarray(picture)
    assert pixels.shape == (2, 3, 3)
    assert pixels.dtype == np.uint8
    np.testing.assert_array_equal(pixels[0, 0], 255)
    np.testing.assert_array_equal(pixels[0, 1], 0)
    # 1 (1 + 1/16) / 2 = 0.53125 linear is 0.7556 in sRGB.
    np.testing.assert_array_equal(pixels[1, 2], (193, 0, 0))
    with pytest.raises(InputError, match="1 NaN"):
        write_png(tmp_path / "q.png", [[[np.nan, 0.0, 1.0]]])
    with pytest.raises(InputError, match="shape"):
        write_png(tmp_path / "q.png", np.zeros((2, 2)))


def test_exposure_and_transfer_curve() -> None:
    x = np.linspace(0, 2, 41)
    np.testing.assert_allclose(tone_map(x, 1.0), tone_map(2 * x))
    assert np.all(np.diff(tone_map(np.linspace(0, 4, 100))) > 0)
    np.testing.assert_allclose(srgb(np.array([0.0, 0.0031308, 0.214041, 1.0])), [0, 0.04045, 0.5, 1], atol=1e-4)
