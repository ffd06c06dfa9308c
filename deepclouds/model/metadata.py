"""What a model file says about itself: contract, descriptor, training ranges, origin, metrics and the hash of its weights."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BaseModel, ConfigDict, ValidationError, field_validator

from deepclouds.errors import InputError
from deepclouds.model.contract import AUX, CONTRACT_VERSION, INPUT_AUX, INPUT_STENCIL, LEVELS, OUTPUT, POINTS
from deepclouds.model.trust import VERSION as TRUST_VERSION
from deepclouds.model.trust import Trust

PREFIX = "deepclouds."


class DescriptorSpec(BaseModel):
    """The stencil that a model was trained on.

    Attributes
    ----------
    levels, points
        shape of one stencil.
    grid
        points along z, y and x of one level.
    lower, upper
        (x, y, z) corners of level 0 in units of length; each further level doubles them.
    unit
        how the unit of length is defined.
    value
        what a stencil value is.
    order
        memory order of a stencil.
    axes
        the frame of the stencil.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    levels: int = LEVELS
    points: int = POINTS
    grid: tuple[int, int, int] = (9, 5, 5)
    lower: tuple[float, float, float] = (-1.0, -1.0, -1.0)
    upper: tuple[float, float, float] = (1.0, 1.0, 3.0)
    unit: str = "integral of sigma_t / integral of sigma_t^2: the mean free path at the extinction-weighted mean extinction"
    value: str = "sigma_t * unit, filtered to the spacing of the level; zero outside of the volume's box"
    order: str = "[level][z][y][x], level 0 the finest"
    axes: str = "z toward the sun, x perpendicular to the plane of the sun and the view"


class ModelMetadata(BaseModel):
    """The metadata of a model file; `to_properties` and `from_properties` map it to ONNX ``metadata_props``.

    Attributes
    ----------
    contract
        version of the contract (docs/contract.md).
    name
        the model's name.
    created_by
        program and version that wrote the file.
    inputs, output, aux, aux_units
        names, in order, of the graph's inputs and output and of the columns of ``aux``, with the columns' units.
    output_meaning
        how the output relates to J.
    descriptor
        the stencil.
    ranges
        smallest and largest value of each column of ``aux`` and of the optical depth ``tau`` toward the sun in the training data.
    config_hash, dataset_hash
        sha256 of the resolved training configuration and of the data set.
    metrics
        figures of the validation, by name.
    initialisers_sha256
        `initialiser_hash` over the graph's initialisers.
    data
        what the training data are, in words; empty where that is not known.
    size
        smallest and largest cloud of the training data: longest side of its box in mean free paths, see
        `deepclouds.volume.pyramid.optical_size`. None where it is not known.
    trust
        how far predictions can be trusted, as `deepclouds calibrate` finds it; None for a model without, and where it is of a version that
        this program does not know.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    contract: str = CONTRACT_VERSION
    name: str
    created_by: str
    inputs: tuple[str, str] = (INPUT_STENCIL, INPUT_AUX)
    output: str = OUTPUT
    output_meaning: str = "j = 4 pi J / (albedo^2 E), positive"
    aux: tuple[str, ...] = tuple(a.name for a in AUX)
    aux_units: tuple[str, ...] = tuple(a.unit for a in AUX)
    descriptor: DescriptorSpec = DescriptorSpec()
    ranges: dict[str, tuple[float, float]]
    config_hash: str
    dataset_hash: str
    metrics: dict[str, float]
    initialisers_sha256: str
    data: str = ""
    size: tuple[float, float] | None = None
    trust: Trust | None = None

    @field_validator("size")
    @classmethod
    def _ordered_size(cls, size: tuple[float, float] | None) -> tuple[float, float] | None:
        if size is not None and not (0 <= size[0] <= size[1] < float("inf")):
            raise ValueError(f"size must be finite and ordered, got {size}")
        return size

    @field_validator("trust", mode="before")
    @classmethod
    def _known_trust(cls, trust: Any) -> Any:
        # Advice about the network, and no part of what it computes: a model is of use without it.
        return None if isinstance(trust, dict) and trust.get("version") != TRUST_VERSION else trust

    @field_validator("ranges")
    @classmethod
    def _ranges_of_every_input(cls, ranges: dict[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
        expected = {a.name for a in AUX} | {"tau"}
        if set(ranges) != expected:
            raise ValueError(f"ranges must name {sorted(expected)}, got {sorted(ranges)}")
        for name, (low, high) in ranges.items():
            if not (np.isfinite(low) and np.isfinite(high) and low <= high):
                raise ValueError(f"the range of {name} must be finite and ordered, got {low}, {high}")
        return ranges

    def to_properties(self) -> dict[str, str]:
        """The metadata as a flat dictionary of strings: plain text where a field is text, JSON elsewhere; without what is not known."""
        fields = self.model_dump(mode="json", exclude_none=True)
        return {PREFIX + key: value if isinstance(value, str) else json.dumps(value, sort_keys=True) for key, value in fields.items()}

    @staticmethod
    def from_properties(properties: Mapping[str, str], source: str) -> ModelMetadata:
        """Read the metadata of the file `source` from its dictionary of strings; properties of other programs are ignored.

        Raises
        ------
        InputError
            when the properties of deepclouds are missing or malformed, or belong to another version of the contract.
        """
        own = {key[len(PREFIX) :]: value for key, value in properties.items() if key.startswith(PREFIX)}
        if "contract" not in own:
            raise InputError(f"{source} carries no deepclouds metadata; write the file with `deepclouds export`")
        if own["contract"] != CONTRACT_VERSION:
            raise InputError(
                f"{source} follows contract version {own['contract']!r}, this program version {CONTRACT_VERSION!r}; "
                "use a model of that version, or the deepclouds release that wrote it"
            )
        text = {name for name, field in ModelMetadata.model_fields.items() if field.annotation is str}
        try:
            return ModelMetadata.model_validate({key: value if key in text else json.loads(value) for key, value in own.items()})
        except (ValidationError, ValueError) as error:
            raise InputError(f"{source}: its deepclouds metadata is malformed ({_first_line(error)}); export the model again") from error

    def require_this_contract(self, source: str) -> None:
        """Raise InputError unless inputs, output, columns and stencil are those of this program's contract."""
        here = {
            "inputs": (INPUT_STENCIL, INPUT_AUX),
            "output": OUTPUT,
            "aux": tuple(a.name for a in AUX),
            "descriptor": DescriptorSpec(),
        }
        for field, value in here.items():
            if getattr(self, field) != value:
                raise InputError(f"{source}: the model's {field} is {getattr(self, field)}, the contract says {value}; export it again")


def initialiser_hash(initialisers: Iterable[tuple[str, ArrayLike]]) -> str:
    """sha256 (hexadecimal) over named arrays: names, dtypes, shapes and little-endian C-ordered values, sorted by name."""
    digest = hashlib.sha256()
    for name, values in sorted(((n, np.asarray(v)) for n, v in initialisers), key=lambda pair: pair[0]):
        little = values.astype(values.dtype.newbyteorder("<"), copy=False)
        digest.update(json.dumps([name, little.dtype.str, list(little.shape)]).encode())
        digest.update(np.ascontiguousarray(little).tobytes())
    return digest.hexdigest()


def _first_line(error: Exception) -> str:
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        return f"{'.'.join(str(part) for part in first['loc'])}: {first['msg']}"
    return str(error).splitlines()[0]
