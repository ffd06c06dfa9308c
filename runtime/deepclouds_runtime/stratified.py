"""Random numbers of a pixel's samples: well spread within the pixel, independent from pixel to pixel, given by a seed."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np

# Fractional parts of the square roots of primes (Richtmyer 1951), as 32-bit fixed-point steps, so that long sequences keep their digits;
# the first two are the powers of the plastic number instead, the best spread for pairs.
_STEPS = tuple(
    round(float(value % 1.0) * 2**32)
    for value in (0.7548776662466927, 0.5698402909980532, *np.sqrt([3, 5, 7, 11, 13, 17, 19, 29, 31, 37, 41, 43]))
)
(
    PIXEL_X,
    PIXEL_Y,
    LIGHT_U,
    LIGHT_V,
    PHASE_U,
    PHASE_V,
    SURFACE_U,
    SURFACE_V,
    SURFACE_W,
    ROULETTE,
    PLACE,
    SHARE,
    LENS_U,
    LENS_V,
) = range(len(_STEPS))
DEPTH = len(_STEPS)
# The step of `DEPTH` where it is not known how many samples there will be: the golden ratio's.
_DEPTH_STEP = round(0.6180339887498949 * 2**32)
_DIMENSIONS = DEPTH + 1


class Stratified:
    """Numbers in [0, 1) for the samples of pixels.

    Within a pixel, dimension `d` of sample `i` is ``frac(i * step_d + r)`` with a random shift ``r`` of the pixel and the dimension: each
    number is uniform, and those of a pixel are evenly spread (Cranley and Patterson 1976). `DEPTH` is stratified outright,
    ``(i + r) / count``, where the number of samples is known.

    Parameters
    ----------
    types
        Dr.Jit types.
    pixel, sample
        number of the pixel, and of the sample within it, of every lane.
    count
        samples of a pixel; 0 where there may be any number of them.
    seed
        32 bits; another seed gives independent shifts.
    """

    def __init__(self, types: ModuleType, pixel: Any, sample: Any, count: Any, seed: Any) -> None:
        self._types, self._pixel, self._sample, self._count, self._seed = types, pixel, sample, count, seed
        self._spread = True

    def number(self, dimension: int, part: int = 0, parts: int = 1) -> Any:
        """The number of `dimension`; `part` of `parts` numbers of each sample that continue the same sequence."""
        u32 = self._types.UInt32
        if not self._spread:
            mixed = self._pixel ^ _hash(u32, self._sample * parts + part + _hash(u32, self._seed + u32(0x85EBCA6B) * (dimension + 1)))
            return _unit(self._types, _hash(u32, mixed))
        shift = _hash(u32, self._pixel ^ _hash(u32, self._seed + u32(0x9E3779B9) * (dimension + 1)))
        if dimension == DEPTH:
            # The first of many would all lie at the near end.
            open_ended = _unit(self._types, self._sample * u32(_DEPTH_STEP) + shift)
            outright = (self._types.Float(self._sample) + _unit(self._types, shift)) / self._types.Float(dr.maximum(self._count, 1))
            return dr.select(self._count == 0, open_ended, outright)
        index = self._sample * parts + part
        return _unit(self._types, index * u32(_STEPS[dimension]) + shift)

    def unrelated(self, stream: int = 0) -> Stratified:
        """Numbers for the same lanes that are independent of these, and of each other: for integrals inside of an integral.

        Each `stream` has numbers of its own; the same one asked for twice in a row leads back to where it began.
        """
        mask = (0xC2B2AE35 + 0x9E3779B9 * stream) & 0xFFFFFFFF
        other = Stratified(self._types, self._pixel, self._sample, self._count, self._seed ^ self._types.UInt32(mask))
        other._spread = False
        return other

    def several(self, count: int) -> Stratified:
        """Numbers for `count` lanes in place of each, which continue the same sequences."""
        u32 = self._types.UInt32
        many = dr.opaque(u32, count)
        lane = dr.arange(u32, dr.width(self._pixel, self._sample) * count)
        of = lane // many
        pixel, sample = (dr.gather(u32, values, of) if dr.width(values) > 1 else values for values in (self._pixel, self._sample))
        numbers = Stratified(self._types, pixel, sample * many + (lane - of * many), self._count * many, self._seed)
        numbers._spread = self._spread
        return numbers

    def take(self, lanes: Any) -> Stratified:
        """The same numbers for the lanes with these indices only."""
        pixel, sample = (dr.gather(self._types.UInt32, values, lanes) for values in (self._pixel, self._sample))
        taken = Stratified(self._types, pixel, sample, self._count, self._seed)
        taken._spread = self._spread
        return taken


def _unit(types: ModuleType, bits: Any) -> Any:
    return types.Float(bits >> 8) * (1.0 / 16777216.0)


def _hash(u32: Any, value: Any) -> Any:
    """Permute 32 bits so that neighbours become unrelated (the output function of PCG, O'Neill 2014, after one step)."""
    state = value * u32(747796405) + u32(2891336453)
    word = ((state >> ((state >> 28) + 4)) ^ state) * u32(277803737)
    return (word >> 22) ^ word
