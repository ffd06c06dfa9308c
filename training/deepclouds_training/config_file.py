"""Configuration files: TOML in, a checked model out, and the hash of what was resolved."""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from deepclouds.errors import InputError

Config = TypeVar("Config", bound=BaseModel)


def read_toml(path: Path) -> dict[str, Any]:
    """Read the tables of a TOML file.

    Raises
    ------
    InputError
        for a file that is missing or no TOML.
    """
    try:
        return tomllib.loads(path.read_text())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give a TOML file as in configs/") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: no valid TOML ({error})") from error


def validated(model: type[Config], values: Mapping[str, Any], source: str) -> Config:
    """Check `values`, which came from `source`, against `model`.

    Raises
    ------
    InputError
        for the first unknown key, missing one or value out of range; the message lists the keys.
    """
    try:
        return model.model_validate(dict(values))
    except ValidationError as error:
        first = error.errors()[0]
        # An error of the model as a whole has no place, and its input is everything.
        where = f"{'.'.join(str(part) for part in first['loc'])}: " if first["loc"] else ""
        got = f" (got {first['input']!r})" if first["loc"] else ""
        raise InputError(f"{source}: {where}{first['msg']}{got}; the keys are {', '.join(_keys(model))}") from error


def config_hash(config: BaseModel) -> str:
    """Sha256 of the resolved configuration."""
    return hashlib.sha256(json.dumps(config.model_dump(mode="json"), sort_keys=True).encode()).hexdigest()


def _keys(model: type[BaseModel]) -> list[str]:
    """The model's keys; those of tables within it as table.key, after the plain ones."""
    plain, tables = [], []
    for name, field in model.model_fields.items():
        inner = field.annotation
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            tables += [f"{name}.{key}" for key in _keys(inner)]
        else:
            plain.append(name)
    return plain + tables
