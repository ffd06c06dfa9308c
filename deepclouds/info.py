"""`deepclouds info FILE`: what a volume, model or image file holds."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from deepclouds.errors import InputError
from deepclouds.memory import field_bytes, gib
from deepclouds.volume import Volume, read_vol
from deepclouds.volume.bricks import EDGE
from deepclouds.volume.sparse import MAX_VOXELS

if TYPE_CHECKING:
    from deepclouds.volume.vdb import GridInfo


@dataclass(frozen=True)
class Section:
    """A titled list of facts.

    Attributes
    ----------
    title
        what the facts are about: a grid, a channel, the file.
    facts
        pairs of a name and its value as text.
    """

    title: str
    facts: list[tuple[str, str]]


def main(argv: Sequence[str], prog: str = "deepclouds info") -> int:
    """Print what one file holds: tables on a terminal, plain lines elsewhere."""
    parser = argparse.ArgumentParser(prog=prog, description="Print what a .vdb, .vol, .onnx or .exr file holds.")
    parser.add_argument("file", type=Path)
    file: Path = parser.parse_args(argv).file
    sections = describe(file)
    if sys.stdout.isatty():
        _print_tables(sections)
    else:
        print("\n\n".join(_plain(s) for s in sections))
    return 0


def describe(path: Path) -> list[Section]:
    """Return the facts about a .vdb, .vol, .onnx or .exr file, by its suffix.

    Raises
    ------
    InputError
        for another suffix, and for a file that is missing or damaged.
    """
    kinds = {".vdb": _vdb, ".vol": _vol, ".onnx": _onnx, ".exr": _exr}
    suffix = path.suffix.lower()
    if suffix not in kinds:
        raise InputError(f"{path}: nothing is known about the suffix '{suffix}'; known are {', '.join(kinds)}")
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    return kinds[suffix](path)


def _numbers(values: Iterable[float]) -> str:
    return " ".join(f"{v:.6g}" for v in values)


def _vdb(path: Path) -> list[Section]:
    from deepclouds.volume.vdb import list_grids

    sections = []
    for grid in list_grids(path):
        facts = [
            ("values", f"{grid.value_type}, stored with 16 bits" if grid.half else grid.value_type),
            ("class", grid.grid_class),
            ("transform", grid.transform_type or "unknown"),
            ("voxel size", _numbers(grid.voxel_size)),
        ]
        if grid.index_box is not None:
            lower, upper = grid.index_box
            facts.append(("index box", f"({_numbers(lower)}) to ({_numbers(upper)})"))
            facts.extend(_sizes(grid, [b - a + 1 for a, b in zip(lower, upper, strict=True)]))
        else:
            facts.append(("active voxels", "0"))
        if grid.index_to_world is not None:
            facts.extend((f"index to world {i}", _numbers(row)) for i, row in enumerate(grid.index_to_world))
        facts.extend((f"metadata {key}", str(value)) for key, value in sorted(grid.metadata.items()))
        sections.append(Section(f"grid {grid.unique_name}", facts))
    return sections or [Section(path.name, [("grids", "none")])]


def _sizes(grid: GridInfo, resolution: list[int]) -> list[tuple[str, str]]:
    """Voxels of the box, how many are active, and the memory that a render's extinction takes."""
    from deepclouds.volume.vdb import kept_in_bricks

    voxels = math.prod(resolution)
    facts = [
        ("resolution", " x ".join(map(str, resolution))),
        ("voxels", str(voxels)),
        ("active voxels", str(grid.active_voxels)),
        ("active share", f"{100 * grid.active_voxels / voxels:.3g} %"),
    ]
    if grid.value_type != "float":
        return facts
    if grid.bricks is not None and kept_in_bricks(voxels, grid.bricks):
        return [*facts, ("memory", f"about {gib(field_bytes(voxels, grid.bricks))} in {grid.bricks} bricks of {EDGE}^3 voxels")]
    if voxels <= MAX_VOXELS:
        return [*facts, ("memory", f"about {gib(field_bytes(voxels))} as a dense grid")]
    return [*facts, ("memory", f"too large: more than {MAX_VOXELS} voxels, in bricks too")]


def _vol(path: Path) -> list[Section]:
    try:
        return [Section(path.name, _density(read_vol(path)))]
    except InputError as refusal:
        # A file with a few negative voxels or NaN can still be looked at; a damaged one fails again.
        facts = _density(read_vol(path, clamp=True))
        return [Section(path.name, [*facts, ("clamped", str(refusal))])]


def _density(volume: Volume) -> list[tuple[str, str]]:
    density = volume.density.astype(np.float64)
    mean, highest = float(density.mean()), float(density.max())
    lower, upper = volume.bounds
    facts = [
        ("resolution", " x ".join(map(str, volume.resolution))),
        ("voxels", str(density.size)),
        ("filled voxels", str(np.count_nonzero(density))),
        ("filled share", f"{100 * np.count_nonzero(density) / density.size:.3g} %"),
        ("memory", f"about {gib(field_bytes(density.size))} as a dense grid"),
        ("box", f"({_numbers(lower)}) to ({_numbers(upper)})"),
        ("voxel size", _numbers(volume.voxel_size)),
        ("density min", f"{density.min():.6g}"),
        ("density max", f"{highest:.6g}"),
        ("density mean", f"{mean:.6g}"),
    ]
    if highest > 0:
        facts.append(("mean / max", f"{mean / highest:.6g}"))
        # The mean weighted by the density itself: what most of the medium looks like.
        facts.append(("weighted mean / max", f"{float(np.square(density).sum() / density.sum()) / highest:.6g}"))
    return facts


def _onnx(path: Path) -> list[Section]:
    import onnx

    try:
        model = onnx.load(str(path), load_external_data=False)
    # protobuf's DecodeError is not part of onnx's own interface.
    except Exception as error:
        raise InputError(f"{path} is not a readable ONNX model: {error}") from error
    if not model.graph.node:
        raise InputError(f"{path} is not an ONNX model: its graph has no node")

    def signature(value: onnx.ValueInfoProto) -> str:
        kind = value.type.tensor_type
        name = onnx.helper.tensor_dtype_to_np_dtype(kind.elem_type).name
        return f"{name} [{', '.join(d.dim_param or str(d.dim_value) for d in kind.shape.dim)}]"

    weights = sum(int(np.prod(t.dims)) for t in model.graph.initializer)
    facts = [(f"input {v.name}", signature(v)) for v in model.graph.input]
    facts += [(f"output {v.name}", signature(v)) for v in model.graph.output]
    facts += [(f"opset {o.domain or 'ai.onnx'}", str(o.version)) for o in model.opset_import]
    facts += [("nodes", str(len(model.graph.node))), ("weights", str(weights)), ("bytes", str(path.stat().st_size))]
    facts += [fact for m in sorted(model.metadata_props, key=lambda m: m.key) for fact in _unfolded(f"metadata {m.key}", m.value)]
    return [Section(path.name, facts)]


def _exr(path: Path) -> list[Section]:
    from deepclouds.exr import read_exr

    image = read_exr(path)
    attributes = [fact for key, value in sorted(image.attributes.items()) for fact in _unfolded(key, str(value))]
    sections = [Section(path.name, attributes or [("attributes", "none")])]
    for name, pixels in image.channels.items():
        finite = pixels[np.isfinite(pixels)]
        facts = [("size", f"{pixels.shape[1]} x {pixels.shape[0]}")]
        if finite.size < pixels.size:
            facts.append(("not finite", f"{pixels.size - finite.size} pixels"))
        if finite.size:
            facts += [("min", f"{finite.min():.6g}"), ("max", f"{finite.max():.6g}"), ("mean", f"{finite.mean(dtype=np.float64):.6g}")]
        sections.append(Section(f"channel {name}", facts))
    return sections


def _unfolded(name: str, text: str) -> list[tuple[str, str]]:
    """One fact for every entry of a JSON object, and `text` as it stands where it is none."""
    try:
        content = json.loads(text)
    except ValueError:
        return [(name, text)]
    if not isinstance(content, dict) or not content:
        return [(name, text)]
    return [
        (f"{name} {key}", f"{v:.6g}" if isinstance(v, float) else v if isinstance(v, str) else json.dumps(v)) for key, v in content.items()
    ]


def _plain(section: Section) -> str:
    width = max(len(name) for name, _ in section.facts)
    return "\n".join([section.title, *(f"  {name:<{width}}  {value}" for name, value in section.facts)])


def _print_tables(sections: Sequence[Section]) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console()
    for section in sections:
        table = Table(title=Text(section.title), title_justify="left", show_header=False)
        for name, value in section.facts:
            # Text, since names in a file may look like rich's markup.
            table.add_row(Text(name), Text(value))
        console.print(table)
