"""Named parameters with documented domains: drawing, checking and describing them."""

from __future__ import annotations

import dataclasses
import math
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from deepclouds.errors import InputError

Streams = Callable[[str], np.random.Generator]


def named_streams(seed: int, *keys: str) -> Streams:
    """Independent random streams of one root `seed`, one for each name.

    The stream of a name never depends on which other names are in use, so fixing one parameter leaves the draws of the rest.
    """
    prefix = tuple(zlib.crc32(key.encode()) for key in keys)

    def stream(name: str) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(*prefix, zlib.crc32(name.encode()))))

    return stream


@dataclass(frozen=True)
class Range:
    """Closed interval of numbers; a share of the draws may take one `usual` value instead of a uniform (or log-uniform) one."""

    low: float
    high: float
    log: bool = False
    integer: bool = False
    usual: float | None = None
    usual_share: float = 0.0

    def draw(self, rng: np.random.Generator) -> float | int:
        """One value from the interval."""
        common, u = rng.random(2)
        if self.usual is not None and common < self.usual_share:
            value = self.usual
        elif self.log:
            value = self.low * (self.high / self.low) ** u
            value = math.floor(value + 0.5) if self.integer else value
        elif self.integer:
            value = min(math.floor(self.low + u * (self.high - self.low + 1)), self.high)
        else:
            value = self.low + u * (self.high - self.low)
        value = min(max(value, self.low), self.high)
        return int(value) if self.integer else float(value)

    def check(self, name: str, value: Any) -> float | int:
        """Return `value` as a number of this range, or raise InputError."""
        try:
            number = float(value)
        except (TypeError, ValueError):
            raise InputError(f"parameter {name} = {value!r} is not a number; it takes {self}") from None
        if not self.low <= number <= self.high:
            raise InputError(f"parameter {name} = {value} is outside its range; it takes {self}")
        if self.integer and number != int(number):
            raise InputError(f"parameter {name} = {value} is not a whole number; it takes {self}")
        return int(number) if self.integer else number

    def __str__(self) -> str:
        """The range in words."""
        text = f"{self.low:g} to {self.high:g}"
        if self.integer:
            text += ", whole numbers"
        if self.log:
            text += ", log-uniform"
        if self.usual is not None:
            text += f", {self.usual_share:.0%} of draws are {self.usual:g}"
        return text


@dataclass(frozen=True)
class Choice:
    """One of several words, drawn with equal chances."""

    options: tuple[str, ...]

    def draw(self, rng: np.random.Generator) -> str:
        """One of the options."""
        return self.options[int(rng.integers(len(self.options)))]

    def check(self, name: str, value: Any) -> str:
        """Return `value` if it is an option, or raise InputError."""
        if value not in self.options:
            raise InputError(f"parameter {name} = {value!r} is unknown; it takes {self}")
        return str(value)

    def __str__(self) -> str:
        """The options in words."""
        return "one of " + ", ".join(self.options)


def number(low: float, high: float, meaning: str, **how: Any) -> Any:
    """Declare a dataclass field that holds a number between `low` and `high`; `how` goes to `Range`."""
    return dataclasses.field(metadata={"domain": Range(low, high, **how), "meaning": meaning})


def choice(options: tuple[str, ...], meaning: str) -> Any:
    """Declare a dataclass field that holds one of `options`."""
    return dataclasses.field(metadata={"domain": Choice(options), "meaning": meaning})


@dataclass(frozen=True, kw_only=True)
class CloudParameters:
    """What every family has."""

    voxel_aspect: float = number(0.5, 2.0, "height of a voxel over its width", log=True, usual=1.0, usual_share=0.6)


def domains(kind: type[CloudParameters]) -> dict[str, Range | Choice]:
    """Domain of each parameter of a family's parameter type, in the order of declaration."""
    return {field.name: field.metadata["domain"] for field in dataclasses.fields(kind)}


def meanings(kind: type[CloudParameters]) -> dict[str, str]:
    """Meaning of each parameter of a family's parameter type."""
    return {field.name: field.metadata["meaning"] for field in dataclasses.fields(kind)}


def resolve(kind: type[CloudParameters], family: str, given: Mapping[str, Any], streams: Streams) -> CloudParameters:
    """Check the `given` values and draw the others.

    Raises
    ------
    InputError
        for a name the family does not have, or a value outside its domain.
    """
    known = domains(kind)
    for name in given:
        if name not in known:
            raise InputError(f"the cloud family {family} has no parameter '{name}'; it has: {', '.join(known)}")
    values: dict[str, Any] = {name: d.check(name, given[name]) if name in given else d.draw(streams(name)) for name, d in known.items()}
    return kind(**values)
