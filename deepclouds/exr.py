"""OpenEXR images in and out, and an 8-bit preview: the one place where image files are touched.

OpenEXR and pillow are imported inside the functions, so that reading this module costs nothing.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepclouds.errors import InputError
from deepclouds.replacing import replacing

# Fields every EXR header has for its own bookkeeping; all others are free attributes.
_STRUCTURE = frozenset(
    {
        "channels",
        "chunkCount",
        "compression",
        "dataWindow",
        "displayWindow",
        "lineOrder",
        "name",
        "pixelAspectRatio",
        "screenWindowCenter",
        "screenWindowWidth",
        "tiles",
        "type",
        "version",
        "view",
    }
)


@dataclass(frozen=True)
class Exr:
    """Channels and free attributes of one EXR file.

    Parameters
    ----------
    channels
        name -> float32 array (h, w), the pixels of the file's data window. Half and integer channels are converted. In a file of
        several named parts the part's name is put in front: ``part.R``.
    attributes
        the header's text and numbers, without the fields that only describe the layout of the file.
    path
        where it was read from, for messages.
    """

    channels: dict[str, NDArray[np.float32]]
    attributes: dict[str, str | float | int]
    path: str = "the image"

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the layers that hold R, G and B; the empty name is the file's own, unnamed layer."""
        names = {name[: -len(name.rpartition(".")[2])] for name in self.channels}
        return tuple(sorted(n.removesuffix(".") for n in names if all(n + c in self.channels for c in "RGB")))

    def rgb(self, layer: str | None = None) -> NDArray[np.float32]:
        """Colour image (h, w, 3), linear.

        Parameters
        ----------
        layer
            the layer to take (``"image"`` for ``image.R``, ...). None: the unnamed layer, else the only layer with R, G and B,
            else luminance (``Y``, or the only channel) three times.

        Raises
        ------
        InputError
            when the layer does not exist, or when none was named and the file leaves a choice.
        """
        layers = self.layers
        if layer is None:
            if "" in layers:
                layer = ""
            elif len(layers) == 1:
                layer = layers[0]
        if layer is not None and layer in layers:
            prefix = f"{layer}." if layer else ""
            return np.stack([self.channels[prefix + c] for c in "RGB"], axis=-1)
        if layer is not None:
            raise InputError(f"{self.path}: no layer '{layer}' with R, G and B; the channels are {', '.join(sorted(self.channels))}")
        if layers:
            raise InputError(f"{self.path}: several layers hold colours ({', '.join(layers)}); name one")
        grey = [n for n in self.channels if n.rpartition(".")[2] in ("Y", "L")] or [n for n in self.channels if n.rpartition(".")[2] != "A"]
        if len(grey) != 1:
            raise InputError(f"{self.path}: neither R, G, B nor one luminance among the channels {', '.join(sorted(self.channels))}")
        return np.repeat(self.channels[grey[0]][..., None], 3, axis=-1)


def read_exr(path: str | os.PathLike[str]) -> Exr:
    """Read every channel of an EXR file (scan lines or tiles, one part or several of the same size).

    Returns
    -------
    Exr
        float32 channels (h, w) of the data window, and the header's free attributes.

    Raises
    ------
    InputError
        when the file is missing, not an EXR file, cut short or corrupted, holds deep data, subsampled channels or parts of different
        sizes. NaN and Inf are read as they stand; what uses the image decides about them.
    """
    with _opened(path, separate_channels=True) as (name, file):
        parts = [(dict(part.header), dict(part.channels)) for part in file.parts]
        if not parts:
            raise InputError(f"{name}: the pixels cannot be read; the file is cut short or corrupted, write it again")
        return _collect(name, parts)


def read_attributes(path: str | os.PathLike[str]) -> dict[str, str | float | int]:
    """Free attributes of an EXR file's header, without its pixels; raises InputError like `read_exr`."""
    with _opened(path, header_only=True) as (_, file):
        header = dict(file.parts[0].header)
    return {k: v for k, v in header.items() if k not in _STRUCTURE and isinstance(v, str | int | float) and not isinstance(v, bool)}


@contextmanager
def _opened(path: str | os.PathLike[str], **how: bool) -> Iterator[tuple[str, Any]]:
    """Name and OpenEXR's file object of an image; whatever goes wrong inside is an InputError that names the file."""
    name = os.fspath(path)
    if not os.path.isfile(name):
        raise InputError(f"{name}: no such image file")
    openexr = _openexr()
    try:
        with warnings.catch_warnings():
            # The binding warns about colour metadata that a file may lack; that says nothing about its pixels.
            warnings.simplefilter("ignore")
            with openexr.File(name, **how) as file:
                yield name, file
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{name}: not a readable OpenEXR file ({error}); write it again") from error


def _collect(path: str, parts: list[tuple[dict[str, object], dict[str, object]]]) -> Exr:
    channels: dict[str, NDArray[np.float32]] = {}
    attributes: dict[str, str | float | int] = {}
    for header, found in parts:
        prefix = f"{header['name']}." if len(parts) > 1 and header.get("name") else ""
        for name, channel in found.items():
            pixels = getattr(channel, "pixels", None)
            if getattr(channel, "xSampling", 1) != 1 or getattr(channel, "ySampling", 1) != 1:
                raise InputError(f"{path}: channel '{name}' is subsampled; store every channel at full resolution")
            if not isinstance(pixels, np.ndarray) or pixels.ndim != 2 or pixels.dtype == object:
                raise InputError(f"{path}: channel '{name}' is not a flat image (deep data?); flatten it first")
            channels[prefix + name] = pixels.astype(np.float32)
        for key, value in header.items():
            if key in _STRUCTURE:
                continue
            if isinstance(value, str | int | float) and not isinstance(value, bool):
                attributes.setdefault(key, value)
    if not channels:
        raise InputError(f"{path}: the file holds no channels")
    shapes = {c.shape for c in channels.values()}
    if len(shapes) > 1:
        raise InputError(f"{path}: the parts have different sizes {sorted(shapes)}; store one size")
    return Exr(channels, attributes, path)


def write_exr(
    path: str | os.PathLike[str],
    channels: Mapping[str, ArrayLike],
    attributes: Mapping[str, str | float | int] | None = None,
) -> None:
    """Write float32 channels with ZIP compression, to a temporary name that is then renamed.

    Parameters
    ----------
    path
        target, ending in ``.exr``; its folder must exist.
    channels
        name -> array (h, w), all of one shape; names as OpenEXR has them (``R``, ``A``, ``layer.R``).
    attributes
        text and numbers for the header; integers of 32 bits (larger ones as text).

    Raises
    ------
    InputError
        when a channel holds NaN or Inf (with the count), shapes differ, an attribute cannot be stored, or the disk is full.
    """
    if not channels:
        raise InputError(f"{os.fspath(path)}: an image needs at least one channel")
    pixels: dict[str, NDArray[np.float32]] = {}
    for name, values in channels.items():
        wide = np.asarray(values)
        if wide.ndim != 2 or wide.size == 0:
            raise InputError(f"{os.fspath(path)}: channel '{name}' needs shape (h, w), got {wide.shape}")
        with np.errstate(over="ignore"):
            array = np.ascontiguousarray(wide, dtype=np.float32)
        bad = int(np.count_nonzero(~np.isfinite(array)))
        if bad:
            raise InputError(f"{os.fspath(path)}: channel '{name}' holds {bad} NaN or infinite values; an image must be finite")
        pixels[name] = array
    if len({a.shape for a in pixels.values()}) > 1:
        raise InputError(f"{os.fspath(path)}: channels of different shapes { ({n: a.shape for n, a in pixels.items()}) }")
    openexr = _openexr()
    header: dict[str, object] = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    for key, value in (attributes or {}).items():
        if key in _STRUCTURE or not key:
            raise InputError(f"{os.fspath(path)}: '{key}' is a field of the file's own layout; choose another attribute name")
        if isinstance(value, bool) or not isinstance(value, str | int | float):
            raise InputError(f"{os.fspath(path)}: attribute '{key}' must be text or a number, got {type(value).__name__}")
        if isinstance(value, int) and not -(2**31) <= value < 2**31:
            raise InputError(f"{os.fspath(path)}: attribute '{key}' = {value} does not fit 32 bits; pass it as text")
        header[key] = value

    with _writing(path), replacing(path, ".exr") as temporary, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with openexr.File(header, pixels) as file:
            file.write(str(temporary))
        # OpenEXR says nothing when its last bytes find no room.
        try:
            read_exr(temporary)
        except InputError as error:
            raise OSError("the file came out cut short") from error


def write_png(path: str | os.PathLike[str], rgb: ArrayLike, exposure: float = 0.0) -> None:
    """Write an 8-bit sRGB preview of a linear image: for eyes, never for numbers.

    The curve per channel is the extended Reinhard operator ``x (1 + x / 16) / (1 + x)`` with ``x = 2**exposure * value`` (white at
    x = 4), then the sRGB transfer function. Negative values become black.

    Parameters
    ----------
    path
        target, ending in ``.png``; its folder must exist.
    rgb
        linear image (h, w, 3).
    exposure
        stops: +1 doubles every value before the curve.

    Raises
    ------
    InputError
        when the image has another shape or holds NaN or Inf, or the disk is full.
    """
    image = np.asarray(rgb, dtype=np.float64)
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise InputError(f"{os.fspath(path)}: a preview needs an image of shape (h, w, 3), got {image.shape}")
    bad = int(np.count_nonzero(~np.isfinite(image)))
    if bad:
        raise InputError(f"{os.fspath(path)}: the image holds {bad} NaN or infinite values")
    write_png_bytes(path, np.rint(255 * srgb(tone_map(image, exposure))).astype(np.uint8))


def tone_map(image: NDArray[np.float64], exposure: float = 0.0) -> NDArray[np.float64]:
    """Apply the extended Reinhard curve with white at 4, clipped to [0, 1] (Reinhard et al. 2002, equation 4). Linear in, linear out."""
    x = np.maximum(image, 0.0) * 2.0**exposure
    mapped: NDArray[np.float64] = np.clip(x * (1 + x / 16) / (1 + x), 0.0, 1.0)
    return mapped


def srgb(linear: NDArray[np.float64]) -> NDArray[np.float64]:
    """Encode linear values in [0, 1] with the sRGB transfer function (IEC 61966-2-1)."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)


def write_png_bytes(path: str | os.PathLike[str], pixels: NDArray[np.uint8]) -> None:
    """Write 8-bit pixels (h, w, 3) as they stand, to a temporary name that is then renamed."""
    from PIL import Image

    picture = Image.fromarray(pixels)
    with _writing(path), replacing(path, ".png") as temporary:
        picture.save(temporary, format="PNG")


@contextmanager
def _writing(path: str | os.PathLike[str]) -> Iterator[None]:
    """Whatever a writer inside fails with, such as a full disk, is an InputError that names the file."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{os.fspath(path)}: cannot be written ({reason}); make room on the disk or choose another folder") from error


def _openexr() -> ModuleType:
    try:
        import OpenEXR
    except ImportError as error:
        raise InputError("reading and writing .exr images needs the package 'OpenEXR': pip install OpenEXR") from error
    module: ModuleType = OpenEXR
    return module
