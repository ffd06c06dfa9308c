"""`deepclouds dataset`: look at a data set, check it, and write stencils for people who train elsewhere."""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from deepclouds.errors import InputError
from deepclouds.replacing import replacing
from deepclouds_training.shards import Dataset, ShardInfo, open_dataset, read_shard, shard_file, write_manifest


def main(argv: Sequence[str], prog: str) -> int:
    """Run `deepclouds dataset info|verify|merge|export-stencils`."""
    parser = argparse.ArgumentParser(prog=prog, description=__doc__)
    verbs = parser.add_subparsers(dest="verb", required=True)
    info = verbs.add_parser("info", help="counts, ranges and noise of the labels")
    info.add_argument("folder", type=Path)
    merge = verbs.add_parser("merge", help="join data sets into one")
    merge.add_argument("folders", type=Path, nargs="+", help="data sets with the same schema and tracer")
    merge.add_argument("-o", "--output", type=Path, required=True, help="folder of the joined data set; must not exist")
    verify = verbs.add_parser("verify", help="check every shard against the hash in the manifest")
    verify.add_argument("folder", type=Path)
    export = verbs.add_parser("export-stencils", help="write stencils, inputs and labels as one .npz file")
    export.add_argument("folder", type=Path)
    export.add_argument("-o", "--output", type=Path, required=True, help="file to write, ending in .npz")
    export.add_argument("--split", choices=("train", "valid"), default="train")
    export.add_argument("--queries", type=int, default=1024, help="queries drawn from every shard (default 1024)")
    export.add_argument("--shards", type=int, help="at most so many shards, evenly chosen (default all)")
    export.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args(argv)
    if arguments.verb == "merge":
        _merge([open_dataset(folder) for folder in arguments.folders], arguments.output)
        return 0
    dataset = open_dataset(arguments.folder)
    if arguments.verb == "info":
        _info(dataset)
        return 0
    if arguments.verb == "verify":
        return _verify(dataset)
    if arguments.output.suffix != ".npz":
        raise InputError(f"{arguments.output}: stencils are written as .npz; choose such a name")
    if arguments.queries < 1 or (arguments.shards is not None and arguments.shards < 1):
        raise InputError("--queries and --shards must be at least 1")
    _export(dataset, arguments.output, arguments.split, arguments.queries, arguments.shards, arguments.seed)
    return 0


def _info(dataset: Dataset) -> None:
    total = dataset.manifest.get("total_shards", len(dataset.shards))
    points = sum(s.count for s in dataset.shards)
    print(f"{dataset.folder}: {len(dataset.shards)} of {total} shards, {points} points, tracer {dataset.manifest.get('tracer')}")
    for split in ("train", "valid"):
        families = Counter(s.family for s in dataset.shards if s.split == split)
        print(f"  {split}: {sum(families.values())} clouds: {', '.join(f'{name} {count}' for name, count in sorted(families.items()))}")
    rows: dict[str, list[np.ndarray]] = {name: [] for name in ("size", "g", "albedo", "tau_sun", "label", "relative error")}
    for entry in dataset.shards:
        shard, header = read_shard(dataset.folder / entry.file)
        seen = shard.label > 0.01 * shard.label.mean()
        rows["size"].append(np.array([header["size"]]))
        rows["g"].append(shard.g)
        rows["albedo"].append(shard.albedo.ravel())
        rows["tau_sun"].append(shard.tau_sun.ravel())
        rows["label"].append(shard.label.ravel()[:: max(1, shard.label.size // 4096)])
        rows["relative error"].append((shard.error[seen] / shard.label[seen])[:: max(1, int(seen.sum()) // 4096)])
    print(f"  {'':16s}{'least':>10s}{'5 %':>10s}{'median':>10s}{'mean':>10s}{'95 %':>10s}{'largest':>12s}")
    for name, parts in rows.items():
        values = np.concatenate(parts) if parts else np.zeros(1)
        low, five, middle, ninety_five, high = np.percentile(values, (0, 5, 50, 95, 100))
        print(f"  {name:16s}{low:10.4g}{five:10.4g}{middle:10.4g}{values.mean():10.4g}{ninety_five:10.4g}{high:12.4g}")


def _merge(datasets: list[Dataset], output: Path) -> None:
    tracers = sorted({str(d.manifest.get("tracer")) for d in datasets})
    if len(tracers) > 1:
        raise InputError(f"the data sets come from different tracers ({', '.join(tracers)}): merge those of one")
    held_out = {s.family for d in datasets for s in d.shards if s.split == "valid"}
    both = held_out & {s.family for d in datasets for s in d.shards if s.split == "train"}
    if both:
        raise InputError(f"families {sorted(both)} are trained on in one data set and held out in another: they cannot be joined")
    if output.exists():
        raise InputError(f"{output}: exists already; name a new folder")
    # Made under another name and renamed, so that an interrupted merge leaves nothing that looks like a data set.
    partial = output.with_name(f".{output.name}.{os.getpid()}.tmp")
    partial.mkdir(parents=True)
    try:
        shards: dict[int, ShardInfo] = {}
        for dataset in datasets:
            for entry in dataset.shards:
                index = len(shards)
                target = partial / shard_file(index)
                # The bytes are the same: a second name costs no disk where both folders share one.
                try:
                    os.link(dataset.folder / entry.file, target)
                except OSError:
                    shutil.copyfile(dataset.folder / entry.file, target)
                shards[index] = replace(entry, index=index, file=target.name)
        sources = [{"config": d.manifest.get("config"), "config_hash": d.manifest.get("config_hash"), "hash": d.hash} for d in datasets]
        write_manifest(partial, {"merged": sources, "tracer": tracers[0], "total_shards": len(shards)}, shards)
        partial.rename(output)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    print(f"{output}: {len(shards)} shards of {len(datasets)} data sets")


def _verify(dataset: Dataset) -> int:
    bad = []
    for entry in dataset.shards:
        path = dataset.folder / entry.file
        if not path.exists():
            bad.append(f"{path}: missing")
        elif hashlib.sha256(path.read_bytes()).hexdigest() != entry.sha256:
            bad.append(f"{path}: its bytes are not those of the manifest")
    if bad:
        raise InputError("\n".join([*bad, "run `deepclouds generate` again: it makes the damaged shards anew"]))
    print(f"{dataset.folder}: all {len(dataset.shards)} shards are whole")
    return 0


def _export(dataset: Dataset, output: Path, split: str, queries: int, most: int | None, seed: int) -> None:
    from deepclouds_training.samples import SampleConfig, SampleSource

    shards = tuple(s for s in dataset.shards if s.split == split)
    if most is not None and most < len(shards):
        shards = tuple(shards[i] for i in np.linspace(0, len(shards) - 1, most).astype(int))
    samples = SampleSource(dataset, shards, SampleConfig(), seed).every_shard(queries)
    with replacing(output) as temporary, temporary.open("wb") as stream:
        np.savez(
            stream,
            stencil=samples.stencil,
            aux=samples.aux,
            label=samples.label,
            error=samples.error,
            shard=samples.shard,
            dataset_hash=np.array(dataset.hash),
        )
    print(f"{output}: {len(samples)} stencils of {len(shards)} clouds ({output.stat().st_size / 2**20:.0f} MiB); layout: docs/contract.md")
