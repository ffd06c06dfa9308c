"""The sums of an image's samples, layer by layer."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepclouds_runtime.result import COLOURS, LAYERS, Image
from deepclouds_runtime.thrown import ThrownLight


class Film:
    """Samples of every pixel, gathered by name.

    Parameters
    ----------
    size
        (width, height), pixels.

    Attributes
    ----------
    taken
        (pixels,) samples of each pixel.
    thrown
        part of the layer ``surface`` that is kept apart, to be smoothed; None smooths nothing.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self.size = size
        self.pixels = size[0] * size[1]
        self.thrown: ThrownLight | None = None
        self.taken = np.zeros(self.pixels, np.float32)
        self._sums: dict[str, Image] = {}

    def add(self, pixels: NDArray[np.uint32], samples: int, name: str, values: list[Any]) -> None:
        """Add `samples` samples, one after the other, of each of the `pixels` to what is kept under `name`; one Float a channel."""
        # Together, or each channel would trace its own rays again.
        dr.eval(values)
        kept = self._sums.setdefault(name, np.zeros((self.pixels, len(values)), np.float32))
        for c, value in enumerate(values):
            kept[pixels, c] += np.array(dr.block_sum(value, samples))

    def sums(self) -> Image:
        """The sums (pixels, 3) of all light but that of the background."""
        total: Image = np.sum([self._sums[layer] for layer in LAYERS if layer in self._sums and layer != "background"], axis=0)
        return total

    def beauty(self) -> Image:
        """The image so far (pixels, 3)."""
        return self._together(self._smoothed())

    def _smoothed(self) -> dict[str, Image]:
        """The sums, the layer ``surface`` with what is kept apart."""
        if self.thrown is None:
            return self._sums
        return {**self._sums, "surface": self._sums["surface"] + self.thrown.smoothed()}

    def _together(self, sums: dict[str, Image]) -> Image:
        total = np.zeros((self.pixels, 3), np.float32)
        for layer in LAYERS:
            if layer in sums:
                total += sums[layer]
        total /= np.maximum(self.taken, 1)[:, None]
        return total

    def channels(self) -> dict[str, Image]:
        """All channels (h, w) of an image of which every pixel has a sample."""
        width, height = self.size
        sums = self._smoothed()
        means = {name: values / self.taken[:, None] for name, values in sums.items()}
        channels: dict[str, Image] = {}
        for layer in LAYERS:
            values = np.broadcast_to(means.get(layer, np.zeros((self.pixels, 3), np.float32)), (self.pixels, 3))
            for c, colour in enumerate(COLOURS):
                channels[f"{layer}.{colour}"] = np.ascontiguousarray(values[:, c]).reshape(height, width)
        beauty = self._together(sums)
        opacity, depth, alpha = (means[name].reshape(height, width) for name in ("volume_opacity", "volume_Z", "A"))
        channels |= {colour: np.ascontiguousarray(beauty[:, c]).reshape(height, width) for c, colour in enumerate(COLOURS)}
        channels["A"] = np.minimum(alpha, 1)
        channels["volume_opacity"] = opacity
        channels["volume_Z"] = np.where(opacity > 0, depth / np.where(opacity > 0, opacity, 1), 0).astype(np.float32)
        return channels
