"""`deepclouds clouds`: list the families, make one cloud as a scene, preview many."""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from deepclouds.errors import InputError
from deepclouds_training.clouds._make import FAMILIES, HELD_OUT, draw_parameters, find_family, make_cloud
from deepclouds_training.clouds._parameters import Choice, meanings
from deepclouds_training.clouds._statistics import CloudStatistics, measure

if TYPE_CHECKING:
    from deepclouds_training.clouds._preview import Row


def main(argv: Sequence[str], prog: str) -> int:
    """Run `deepclouds clouds`: parse `argv`, write what was asked for, return the exit code 0.

    Raises
    ------
    InputError
        for unknown families and parameters, and values outside their ranges.
    """
    parser = argparse.ArgumentParser(prog=prog, description="Procedural clouds to train on and to try.")
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    show = verbs.add_parser("list", help="families, their parameters and ranges")
    show.add_argument("families", nargs="*", metavar="FAMILY", help="default: all")
    show.add_argument("--statistics", type=int, default=0, metavar="COUNT", help="also measure COUNT clouds of each family")
    make = verbs.add_parser("make", help="write one cloud: density.vdb, density.vol, scene.xml and cloud.json")
    make.add_argument("family", metavar="FAMILY")
    make.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    make.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="fix a parameter; the rest are drawn with the seed")
    make.add_argument("--optical-depth", type=float, default=40.0, metavar="T", help="of the densest vertical column (default: 40)")
    make.add_argument("--albedo", type=float, nargs="+", default=[1.0], help="one value or three (default: 1)")
    make.add_argument("--g", type=float, default=0.85, help="of the Henyey-Greenstein phase function (default: 0.85)")
    make.add_argument("--sun", type=float, nargs=3, default=[0.4, 0.7, 1.0], metavar=("X", "Y", "Z"), help="direction toward the sun")
    sheet = verbs.add_parser("preview", help="contact sheets: one with a row a family, or one a family from the side and above")
    sheet.add_argument("families", nargs="*", metavar="FAMILY", help="default: all")
    sheet.add_argument("-o", "--output", type=Path, required=True, metavar="PNG|DIR", help="a picture, or a folder for a picture a family")
    sheet.add_argument("--count", type=int, default=5, help="clouds of each family (default: 5)")
    sheet.add_argument("--size", type=int, default=200, help="pixels along a picture (default: 200)")
    for sub, resolution in ((make, 128), (sheet, 128), (show, 64)):
        sub.add_argument("--seed", type=int, default=0, help="of the (first) cloud (default: 0)")
        sub.add_argument("--resolution", type=int, default=resolution, help=f"samples along the longest axis (default: {resolution})")
    arguments = parser.parse_args(list(argv))
    if arguments.verb == "list":
        _list(arguments.families, arguments.statistics, arguments.seed, arguments.resolution)
    elif arguments.verb == "make":
        _make(arguments)
    else:
        _preview(arguments)
    return 0


def _list(names: Sequence[str], statistics: int, seed: int, resolution: int) -> None:
    for name in names or FAMILIES:
        family = find_family(name)
        print(f"{name}: {family.summary}{' (validation only)' if name in HELD_OUT else ''}")
        about = meanings(family.parameters)
        for parameter, domain in family.ranges.items():
            print(f"    {parameter:<13} {about[parameter]}: {domain}")
        if statistics > 0:
            measured = [measure(make_cloud(name, seed + k, resolution)) for k in range(statistics)]
            print(f"    measured on {statistics} clouds at {resolution}: median (10th to 90th percentile)")
            for quantity in dataclasses.fields(CloudStatistics):
                print(f"        {quantity.name:<12} {_spread([getattr(m, quantity.name) for m in measured])}")


def _spread(values: Sequence[float]) -> str:
    finite = [v for v in values if np.isfinite(v)]
    if not finite:
        return "none"
    low, middle, high = np.quantile(finite, (0.1, 0.5, 0.9))
    few = f", {len(finite)} clouds" if len(finite) < len(values) else ""
    return f"{middle:.2f} ({low:.2f} to {high:.2f}{few})"


def _make(arguments: argparse.Namespace) -> None:
    # The writers load a native module, which listing and previews do without.
    from deepclouds.replacing import replacing
    from deepclouds_training.clouds.scene import scale_for_optical_depth, write_mitsuba_scene

    given: dict[str, str] = {}
    for item in arguments.set:
        name, equals, value = item.partition("=")
        if not equals or not name or not value:
            raise InputError(f"--set {item}: write NAME=VALUE")
        given[name] = value
    volume = make_cloud(arguments.family, arguments.seed, arguments.resolution, **given)
    scale = scale_for_optical_depth(volume, arguments.optical_depth)
    albedo = arguments.albedo[0] if len(arguments.albedo) == 1 else arguments.albedo
    scene = write_mitsuba_scene(arguments.output, volume, scale=scale, albedo=albedo, g=arguments.g, omega_sun=arguments.sun)
    record = {
        "family": arguments.family,
        "seed": arguments.seed,
        "resolution": arguments.resolution,
        "parameters": dataclasses.asdict(draw_parameters(arguments.family, arguments.seed, **given)),
        "scale": scale,
        "density_sha256": hashlib.sha256(volume.density.tobytes()).hexdigest(),
    }
    with replacing(arguments.output / "cloud.json") as temporary:
        temporary.write_text(json.dumps(record, indent=2) + "\n")
    x, y, z = volume.resolution
    print(f"{scene}: {arguments.family} of {x} x {y} x {z} samples, extinction {scale:.4g} a world unit at density 1")


def _preview(arguments: argparse.Namespace) -> None:
    from deepclouds_training.clouds._preview import Row

    sheets = arguments.output.suffix.lower() != ".png"
    if sheets and arguments.output.suffix:
        raise InputError(f"{arguments.output}: previews are written as .png, or into a folder")
    for name, value in (("count", arguments.count), ("size", arguments.size)):
        if value < 1:
            raise InputError(f"--{name} {value} shows nothing; it takes 1 or more")
    names = arguments.families or list(FAMILIES)
    families = [find_family(name) for name in names]
    rows: list[Row] = []
    for family in families:
        # A family with kinds shows them one after the other rather than by chance.
        kinds = [(key, d.options) for key, d in family.ranges.items() if isinstance(d, Choice)]
        row = []
        for k in range(arguments.count):
            fixed = {key: options[k % len(options)] for key, options in kinds}
            label = ", ".join([str(arguments.seed + k), *fixed.values()])
            row.append((label, make_cloud(family.name, arguments.seed + k, arguments.resolution, **fixed)))
        side = Row(f"{family.name}: {family.summary}", row, family.optical_depth)
        if sheets:
            above = Row("from above", row, family.optical_depth, "top")
            _write_sheet(arguments.output / f"clouds_{family.name}.png", [side, above], arguments.size)
        else:
            rows.append(side)
    if rows:
        _write_sheet(arguments.output, rows, arguments.size)
    print(f"{arguments.output}: {arguments.count} clouds of each of {', '.join(names)}")


def _write_sheet(path: Path, rows: Sequence[Row], size: int) -> None:
    from PIL import Image

    from deepclouds.replacing import replacing
    from deepclouds_training.clouds._preview import contact_sheet

    path.parent.mkdir(parents=True, exist_ok=True)
    # 128 colours show these pictures as well and take a third of the space.
    picture = Image.fromarray(contact_sheet(rows, size)).quantize(128, dither=Image.Dither.NONE)
    with replacing(path) as temporary:
        picture.save(temporary, format="PNG", optimize=True)
