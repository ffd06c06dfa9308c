"""A run's metrics as TensorBoard events."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from deepclouds.errors import InputError


class Events:
    """Writes every number of a metrics entry as a scalar named by its place in it: ``valid/figures/all/rrmse``.

    Parameters
    ----------
    folder
        where TensorBoard looks: ``tensorboard --logdir FOLDER``.

    Raises
    ------
    InputError
        when the package tensorboard is missing.
    """

    def __init__(self, folder: Path) -> None:
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError as error:
            raise InputError(
                f"tensorboard = true: the package is missing ({error}); pip install tensorboard, or leave the key out"
            ) from error
        self._make, self._folder = SummaryWriter, folder
        self._writer: SummaryWriter | None = None

    def open(self, step: int) -> None:
        """Begin a file for what comes after `step`; what an earlier process wrote beyond it is hidden."""
        self._writer = self._make(str(self._folder), purge_step=step + 1)

    def write(self, entry: dict[str, Any]) -> None:
        """Add the numbers of one entry, which has a ``kind`` and a ``step``."""
        assert self._writer is not None
        for name, value in _scalars({k: v for k, v in entry.items() if k not in ("kind", "step", "clouds")}, entry["kind"]):
            self._writer.add_scalar(name, value, entry["step"])
        self._writer.flush()

    def close(self) -> None:
        """Close the file."""
        if self._writer is not None:
            self._writer.close()


def _scalars(value: Any, name: str) -> Iterator[tuple[str, float]]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _scalars(inner, f"{name}/{key}")
    elif isinstance(value, int | float):
        yield name, float(value)
