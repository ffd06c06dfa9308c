"""`deepclouds dataset`: look at a data set, check it, and write stencils for people who train elsewhere."""

from __future__ import annotations

import argparse
import os
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from deepclouds.errors import InputError
from deepclouds.replacing import replacing
from deepclouds_training.dataset_compare import print_comparison
from deepclouds_training.dataset_info import print_info
from deepclouds_training.shards import Dataset, check_shard, open_dataset, shard_file, write_manifest, write_record


def main(argv: Sequence[str], prog: str) -> int:
    """Run `deepclouds dataset info|verify|compare|merge|export-stencils`."""
    parser = argparse.ArgumentParser(prog=prog, description=__doc__)
    verbs = parser.add_subparsers(dest="verb", required=True)
    info = verbs.add_parser("info", help="counts, ranges and noise of the labels")
    info.add_argument("folder", type=Path)
    info.add_argument("--picture", type=Path, help="write histograms there, a .png")
    merge = verbs.add_parser("merge", help="join the parts of one data set, or different data sets, into one")
    merge.add_argument("folders", type=Path, nargs="+", help="data sets with the same schema and tracer")
    merge.add_argument("-o", "--output", type=Path, required=True, help="folder of the joined data set; must not exist")
    verify = verbs.add_parser("verify", help="check every shard against the hash in its record")
    verify.add_argument("folder", type=Path)
    compare = verbs.add_parser("compare", help="hold two independent label sets of the same points together")
    compare.add_argument("folders", type=Path, nargs=2, metavar="DIR")
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
    if arguments.verb == "compare":
        print_comparison(*(open_dataset(folder) for folder in arguments.folders))
        return 0
    dataset = open_dataset(arguments.folder)
    if arguments.verb == "info":
        print_info(dataset, arguments.picture)
        return 0
    if arguments.verb == "verify":
        return _verify(dataset)
    if arguments.output.suffix != ".npz":
        raise InputError(f"{arguments.output}: stencils are written as .npz; choose such a name")
    if arguments.queries < 1 or (arguments.shards is not None and arguments.shards < 1):
        raise InputError("--queries and --shards must be at least 1")
    _export(dataset, arguments.output, arguments.split, arguments.queries, arguments.shards, arguments.seed)
    return 0


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
    entries = [(d, entry) for d in datasets for entry in d.shards]
    # The parts of one data set become what one machine would have made, under the same numbers; different ones are numbered anew.
    if all(d.manifest == datasets[0].manifest for d in datasets) and "config_hash" in datasets[0].manifest:
        manifest = datasets[0].manifest
        chosen = {entry.index: (d, entry) for d, entry in entries}
        for d, entry in entries:
            other, same = chosen[entry.index]
            if entry.sha256 != same.sha256:
                raise InputError(f"{d.folder / entry.file} and {other.folder / same.file} differ: one of the two is not of this data set")
    else:
        # Of what was merged before, its parts.
        sources = [
            part
            for d in datasets
            for part in d.manifest.get(
                "merged", [{"config": d.manifest.get("config"), "config_hash": d.manifest.get("config_hash"), "hash": d.hash}]
            )
        ]
        manifest = {"merged": sources, "tracer": tracers[0], "total_shards": len(entries)}
        chosen = {i: (d, replace(entry, index=i, file=shard_file(i))) for i, (d, entry) in enumerate(entries)}
    names = {(d.folder, entry.sha256): entry.file for d, entry in entries}
    # Made under another name and renamed, so that an interrupted merge leaves nothing that looks like a data set.
    partial = output.with_name(f".{output.name}.{os.getpid()}.tmp")
    partial.mkdir(parents=True)
    try:
        for d, entry in (chosen[index] for index in sorted(chosen)):
            source, target = d.folder / names[d.folder, entry.sha256], partial / entry.file
            check_shard(source, entry.sha256)
            # The bytes are the same: a second name costs no disk where both folders share one.
            try:
                os.link(source, target)
            except OSError:
                shutil.copyfile(source, target)
            write_record(partial, entry)
        write_manifest(partial, manifest)
        partial.rename(output)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    print(f"{output}: {len(chosen)} of {manifest['total_shards']} shards, from {len(datasets)} data sets")


def _verify(dataset: Dataset) -> int:
    bad = []
    for entry in dataset.shards:
        try:
            check_shard(dataset.folder / entry.file, entry.sha256)
        except InputError as error:
            bad.append(str(error))
    if bad:
        raise InputError("\n".join(bad))
    total = dataset.manifest.get("total_shards", len(dataset.shards))
    print(f"{dataset.folder}: {len(dataset.shards)} of {total} shards, all whole")
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
            half=samples.half,
            shard=samples.shard,
            dataset_hash=np.array(dataset.hash),
        )
    print(f"{output}: {len(samples)} stencils of {len(shards)} clouds ({output.stat().st_size / 2**20:.0f} MiB); layout: docs/contract.md")
