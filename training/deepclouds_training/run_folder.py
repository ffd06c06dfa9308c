"""The folder of a training run: configuration, environment, metrics and checkpoints, each written whole or not at all."""

from __future__ import annotations

import io
import json
import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

from deepclouds.errors import InputError
from deepclouds_training.shards import Dataset, ShardInfo, write_atomically
from deepclouds_training.train_config import TrainConfig, checked

CONFIG = "config.json"
DATA = "data.json"
ENVIRONMENT = "environment.json"
METRICS = "metrics.jsonl"
CHECKPOINT = "checkpoint.pt"
PICTURE = "predicted.png"
EVENTS = "events"


class RunFolder:
    """The files of one run, by meaning."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @property
    def picture(self) -> Path:
        """Where the predicted-against-true plot goes."""
        return self.path / PICTURE

    @property
    def events(self) -> Path:
        """Where the TensorBoard events go."""
        return self.path / EVENTS

    def refuse_existing(self) -> None:
        """Raise InputError when the folder already holds a run."""
        if (self.path / CONFIG).exists() or (self.path / CHECKPOINT).exists():
            raise InputError(f"{self.path}: holds a run already; continue it with --resume or name another folder")

    def begin(self, config: TrainConfig, dataset: Dataset) -> None:
        """Create the folder of a new run."""
        self.path.mkdir(parents=True, exist_ok=True)
        self._json(DATA, {"folder": str(dataset.folder), "hash": dataset.hash, "shards": [s.file for s in dataset.shards]})
        self.save_config(config)

    def save_config(self, config: TrainConfig) -> None:
        """Write the resolved configuration with its hash, and where it runs."""
        self._json(CONFIG, {"hash": config.hash, "config": config.model_dump(mode="json")})
        packages = {}
        for name in ("deepclouds", "torch", "numpy", "drjit"):
            try:
                packages[name] = version(name)
            except PackageNotFoundError:
                packages[name] = "not installed"
        where = {"python": platform.python_version(), "platform": platform.platform(), "cpus": os.cpu_count(), "packages": packages}
        self._json(ENVIRONMENT, {**where, "torch_threads": torch.get_num_threads()})

    def config(self) -> TrainConfig:
        """The run's configuration.

        Raises
        ------
        InputError
            when the folder holds no run.
        """
        return checked(self._read(CONFIG)["config"], str(self.path / CONFIG))

    def shards(self, dataset: Dataset) -> tuple[ShardInfo, ...]:
        """The shards the run began with; `dataset` may have grown since.

        Raises
        ------
        InputError
            when one of them has changed or is gone.
        """
        recorded = self._read(DATA)
        files = set(recorded["shards"])
        shards = tuple(s for s in dataset.shards if s.file in files)
        if Dataset(dataset.folder, dataset.manifest, shards).hash != recorded["hash"]:
            raise InputError(f"{dataset.folder}: the shards of {self.path} have changed; start a new run, or resume with --new-data")
        return shards

    def adopt(self, dataset: Dataset) -> None:
        """From here on the run draws from every shard that `dataset` has now."""
        self._json(DATA, {"folder": str(dataset.folder), "hash": dataset.hash, "shards": [s.file for s in dataset.shards]})

    @property
    def data_hash(self) -> str:
        """Hash of the shards in use."""
        return str(self._read(DATA)["hash"])

    def save_checkpoint(self, state: dict[str, Any]) -> None:
        """Write weights, average, optimiser and position."""
        stream = io.BytesIO()
        torch.save(state, stream)
        write_atomically(self.path / CHECKPOINT, stream.getvalue())

    def load_checkpoint(self) -> dict[str, Any] | None:
        """The last checkpoint, None where there is none yet.

        Raises
        ------
        InputError
            when the file is damaged.
        """
        path = self.path / CHECKPOINT
        if not path.exists():
            return None
        try:
            state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        except Exception as error:
            raise InputError(f"{path}: not a readable checkpoint ({error}); delete it to start the run over") from error
        return state

    def log(self, entry: dict[str, Any]) -> None:
        """Append one line to the metrics.

        Raises
        ------
        InputError
            when it cannot be written, on a full disk for example.
        """
        path = self.path / METRICS
        try:
            with open(path, "a") as stream:
                stream.write(json.dumps(entry) + "\n")
        except OSError as error:
            raise InputError(f"{path}: cannot be written ({error.strerror}); make room on the disk, then continue with --resume") from error

    def metrics(self) -> list[dict[str, Any]]:
        """All logged lines, but for a last one that was cut short.

        Raises
        ------
        InputError
            when another line is damaged.
        """
        path = self.path / METRICS
        lines = path.read_text().splitlines() if path.exists() else []
        entries = []
        for number, line in enumerate(lines, 1):
            try:
                entries.append(json.loads(line))
            except ValueError as error:
                if number < len(lines):
                    raise InputError(f"{path}, line {number}: no valid JSON ({error}); delete the line") from error
        return entries

    def forget_after(self, step: int) -> None:
        """Drop metrics of steps that the checkpoint does not know: they will be made again."""
        kept = [entry for entry in self.metrics() if entry["step"] <= step]
        write_atomically(self.path / METRICS, "".join(json.dumps(entry) + "\n" for entry in kept).encode())

    def _json(self, name: str, content: dict[str, Any]) -> None:
        write_atomically(self.path / name, (json.dumps(content, indent=1) + "\n").encode())

    def _read(self, name: str) -> dict[str, Any]:
        path = self.path / name
        try:
            content: dict[str, Any] = json.loads(path.read_text())
        except FileNotFoundError:
            raise InputError(f"{path}: missing; {self.path} is not the folder of a training run") from None
        except ValueError as error:
            raise InputError(f"{path}: no valid JSON ({error})") from error
        return content
