"""What a data set holds: counts, ranges, noise, and histograms as a picture."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deepclouds.replacing import replacing
from deepclouds_training.labels import FLOOR
from deepclouds_training.shards import Dataset, Shard, read_shard

# Values kept of every shard for percentiles and histograms.
_KEPT = 4096
_LOGARITHMIC = ("size", "voxels a side", "depth a voxel", "tau_sun", "label", "relative error", "walks")


def relative_errors(shard: Shard) -> NDArray[np.float64]:
    """Standard error over the label, or over a tenth of the cloud's mean label where that is larger, (n, k, m)."""
    label = shard.label.astype(np.float64)
    ratio: NDArray[np.float64] = shard.error / np.maximum(np.maximum(label, FLOOR * label.mean()), 1e-30)
    return ratio


def print_info(dataset: Dataset, picture: Path | None) -> None:
    """Print the data set's counts and ranges; write histograms to `picture` where one is named."""
    total = dataset.manifest.get("total_shards", len(dataset.shards))
    points = sum(s.count for s in dataset.shards)
    print(f"{dataset.folder}: {len(dataset.shards)} of {total} shards, {points} points, tracer {dataset.manifest.get('tracer')}")
    rows: dict[str, list[NDArray[np.float64]]] = {}
    labels, effective, effective_points, within, relative_sum = 0, 0.0, 0.0, 0, 0.0
    target = dataset.manifest.get("config", {}).get("target")
    for entry in dataset.shards:
        shard, header = read_shard(dataset.folder / entry.file, entry.sha256)
        relative = relative_errors(shard)
        worth = 1 / (1 + relative**2)
        labels += relative.size
        effective += float(worth.sum())
        effective_points += float(worth.mean(axis=(1, 2)).sum())
        relative_sum += float(relative.sum())
        within += int((relative <= (target or np.inf)).sum())
        for name, values in _columns(shard, header, relative).items():
            rows.setdefault(name, []).append(values)
    for split in ("train", "valid"):
        families = Counter(s.family for s in dataset.shards if s.split == split)
        print(f"  {split}: {sum(families.values())} clouds: {', '.join(f'{name} {count}' for name, count in sorted(families.items()))}")
    if not labels:
        return
    print(f"  {labels} labels, worth {effective:.0f} exact ones; {points} points, worth {effective_points:.0f}")
    share = f", {within / labels:.1%} of them within the target {target:g}" if target else ""
    print(f"  mean relative standard error {relative_sum / labels:.4f}{share}")
    table = {name: np.concatenate(parts) for name, parts in rows.items()}
    print(f"  {'':16s}{'least':>10s}{'5 %':>10s}{'median':>10s}{'mean':>10s}{'95 %':>10s}{'largest':>12s}")
    for name, values in table.items():
        low, five, middle, ninety_five, high = np.percentile(values, (0, 5, 50, 95, 100))
        print(f"  {name:16s}{low:10.4g}{five:10.4g}{middle:10.4g}{values.mean():10.4g}{ninety_five:10.4g}{high:12.4g}")
    if picture is not None:
        _histograms(table, picture)
        print(f"{picture}: histograms")


def _columns(shard: Shard, header: dict[str, object], relative: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    size, resolution = float(str(header.get("size", "nan"))), float(max(shard.volume.density.shape))
    cosine = np.einsum("nc,nkc->nk", shard.w.astype(np.float64), shard.omega_sun.astype(np.float64))
    two = shard.phase[:, 2] < 1
    columns = {
        "size": np.array([size]),
        "voxels a side": np.array([resolution]),
        "depth a voxel": np.array([size / resolution]),
        "g of one lobe": shard.phase[~two, 0],
        "g1 of two": shard.phase[two, 0],
        "g2 of two": shard.phase[two, 1],
        "weight of two": shard.phase[two, 2],
        "albedo": shard.albedo,
        "gamma": np.arccos(np.clip(cosine, -1, 1)),
        "tau_sun": shard.tau_sun,
        "label": shard.label,
        "relative error": relative,
        "walks": shard.walks,
    }
    return {name: _thinned(values) for name, values in columns.items()}


def _thinned(values: NDArray[np.generic]) -> NDArray[np.float64]:
    flat = values.ravel()
    if flat.size > _KEPT:
        # Drawn, not every so-manyth: a stride would see one albedo or one sun of every point alone.
        flat = flat[np.random.default_rng(0).integers(0, flat.size, _KEPT)]
    return flat.astype(np.float64)


def _histograms(table: dict[str, NDArray[np.float64]], picture: Path) -> None:
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter

    across = 4
    down = -(-len(table) // across)
    figure = Figure(figsize=(4 * across, 2.6 * down), layout="constrained")
    for number, (name, values) in enumerate(table.items()):
        axes = figure.add_subplot(down, across, number + 1)
        axes.set_title(name)
        axes.set_yticks([])
        if name in _LOGARITHMIC:
            values = values[values > 0]
            if values.size:
                low, high = np.percentile(values, (1, 100)) * (0.9, 1.1)
                axes.hist(np.clip(values, low, None), list(np.geomspace(low, high, 60)))
            axes.set_xscale("log")
            axes.xaxis.set_minor_formatter(NullFormatter())
        else:
            axes.hist(values, 60)
    with replacing(picture, ".png") as temporary:
        figure.savefig(temporary, dpi=80)
