"""What the kernels of walks are made of: what walks start from, their random numbers, and how they turn."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from deepclouds.backend import lanes_of
from deepclouds.medium.elementary import circle
from deepclouds.medium.phase import distinct, hg, inverse_hg, sample_hg, sample_two_lobe, turned, two_lobe

# Lanes begin walks at every so many steps.
TURN = 8
# Walks with less weight than this under every albedo go on with a chance, and then with this weight.
_FAINT = 0.1


class Queries:
    """What walks start from, on the device: an array of one value where it is the same for all."""

    def __init__(self, types: Any, points: Any, directions: Any, lobes: Any, suns: Any, albedos: Any) -> None:
        def upload(values: Any) -> list[Any]:
            return [lanes_of(types.Float, values[:, c]) for c in range(values.shape[1])]

        def upload_or_one(values: Any) -> list[Any]:
            # What is the same for all walks is one number, which no lane has to remember.
            same = np.all(distinct(values) == values[:1])
            return [dr.opaque(types.Float, float(v)) for v in values[0]] if same else upload(values)

        self.points, self.directions = upload(points), upload(directions)
        # A second lobe doubles the cost of a connection: it is left out, with the same result, where no point has one.
        self.lobes = upload_or_one(lobes[:, :1] if np.all(distinct(lobes)[:, 2] == 1) else lobes)
        self.suns = [upload_or_one(suns[:, k]) for k in range(suns.shape[1])]
        self.albedos = upload_or_one(albedos)
        dr.eval(self.points, self.directions, self.lobes, self.suns, self.albedos)


class Job:
    """How many walks a kernel traces, `total` in all with so many `results` each, and how; what they find, and the next one's number."""

    def __init__(self, types: Any, walks: int, total: int, results: int, seed: int, lanes: int, connect: float, roulette: bool) -> None:
        self.walks, self.total, self.lanes, self.connect, self.roulette = walks, total, min(lanes, total), connect, roulette
        self.result = dr.zeros(types.Float, total * results)
        self.counter = dr.zeros(types.UInt32, 1)
        self.key = types.UInt64(int(np.random.SeedSequence(seed).generate_state(1, np.uint64)[0]))
        dr.make_opaque(self.result, self.counter, self.key)


def uniform(types: Any, rng: list[Any]) -> tuple[list[Any], Any]:
    """The next state and a number in [0, 1) of xoroshiro64* (Blackman and Vigna 2021), which needs 32-bit arithmetic alone."""
    rng, bits = _bits(rng)
    return rng, types.Float(bits >> 8) * (1.0 / 16777216.0)


def _bits(rng: list[Any]) -> tuple[list[Any], Any]:
    s0, s1 = rng
    bits = s0 * 0x9E3779BB
    s1 = s1 ^ s0
    s0 = ((s0 << 26) | (s0 >> 6)) ^ s1 ^ (s1 << 9)
    s1 = (s1 << 13) | (s1 >> 19)
    return [s0, s1], bits


def two_uniform(types: Any, rng: list[Any]) -> tuple[list[Any], Any, Any]:
    """The next state and two numbers of 16 bits each, in the middle of their intervals."""
    rng, bits = _bits(rng)
    return rng, *((types.Float(part) + 0.5) * (1.0 / 65536.0) for part in (bits >> 16, bits & 0xFFFF))


def three_uniform(types: Any, rng: list[Any]) -> tuple[list[Any], list[Any]]:
    """The next state and three numbers of ten bits each, in the middle of their intervals: for choices that need no more."""
    rng, bits = _bits(rng)
    return rng, [(types.Float((bits >> shift) & 1023) + 0.5) * (1.0 / 1024.0) for shift in (22, 12, 2)]


def stream(types: Any, key: Any, number: Any) -> list[Any]:
    """The starting state of the walk `number`: SplitMix64 of key and number (Steele et al. 2014)."""
    z = key + types.UInt64(number) * 0x9E3779B97F4A7C15
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9
    z = (z ^ (z >> 27)) * 0x94D049BB133111EB
    z = z ^ (z >> 31)
    return [types.UInt32(z & 0xFFFFFFFF) | 1, types.UInt32(z >> 32)]


def thinned(types: Any, rng: list[Any], weight: list[Any], active: Any) -> tuple[list[Any], Any, list[Any]]:
    """Russian roulette of walks whose weights are all below `_FAINT`: the next random state, who is lost, and the weights of the others."""
    heaviest = weight[0]
    for value in weight[1:]:
        heaviest = dr.maximum(heaviest, value)
    faint = active & (heaviest < _FAINT)
    rng, u = uniform(types, rng)
    gain = dr.select(faint, _FAINT / dr.maximum(heaviest, 1e-30), 1)
    return rng, faint & (u * _FAINT >= heaviest), [value * gain for value in weight]


def phase_value(lobes: list[Any], cos_theta: Any) -> Any:
    """The phase function, 1/sr."""
    return hg(cos_theta, *lobes) if len(lobes) == 1 else two_lobe(cos_theta, *lobes)


def inverse_phase(lobes: list[Any], cos_theta: Any) -> Any:
    """One over the phase function, sr."""
    return inverse_hg(cos_theta, *lobes) if len(lobes) == 1 else dr.rcp(two_lobe(cos_theta, *lobes))


def sample_phase(lobes: list[Any], u: Any) -> tuple[Any, Any]:
    """One minus the cosine of a scattering angle, and one over the phase function there, sr."""
    if len(lobes) == 1:
        return sample_hg(u, *lobes)
    beside = sample_two_lobe(u, *lobes)
    return beside, dr.rcp(two_lobe(1 - beside, *lobes))


def direction_around(direction: Any, beside: Any, u_azimuth: Any) -> Any:
    """Unit vectors around `direction`, given one minus the cosine of the angle between them and a number in [0, 1) for the azimuth."""
    cos_a, sin_a = circle(u_azimuth)
    return turned(direction, 1 - beside, dr.safe_sqrt(beside * (2 - beside)), cos_a, sin_a)


def remembered(values: Any, lanes: int) -> Any:
    """Room for what each lane takes from `values` with each walk; the one value where there is only one."""
    return dr.zeros(type(values), lanes) if dr.width(values) > 1 else values
