"""`deepclouds clouds`: list the families, make one cloud as a scene, preview many."""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from deepclouds.errors import InputError
from deepclouds_training.clouds._make import FAMILIES, HELD_OUT, draw_parameters, find_family, make_cloud
from deepclouds_training.clouds._parameters import Choice, meanings
from deepclouds_training.clouds._raster import weighted_mean


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
    show.add_argument("--statistics", type=int, default=0, metavar="COUNT", help="also measure COUNT clouds of each family")
    make = verbs.add_parser("make", help="write one cloud: density.vdb, density.vol, scene.xml and cloud.json")
    make.add_argument("family", metavar="FAMILY")
    make.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    make.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="fix a parameter; the rest are drawn with the seed")
    make.add_argument("--optical-depth", type=float, default=40.0, metavar="T", help="of the densest vertical column (default: 40)")
    make.add_argument("--albedo", type=float, nargs="+", default=[1.0], help="one value or three (default: 1)")
    make.add_argument("--g", type=float, default=0.85, help="of the Henyey-Greenstein phase function (default: 0.85)")
    make.add_argument("--sun", type=float, nargs=3, default=[0.4, 0.7, 1.0], metavar=("X", "Y", "Z"), help="direction toward the sun")
    sheet = verbs.add_parser("preview", help="a contact sheet, a row a family")
    sheet.add_argument("families", nargs="*", metavar="FAMILY", help="default: all")
    sheet.add_argument("-o", "--output", type=Path, required=True, metavar="PNG")
    sheet.add_argument("--count", type=int, default=5, help="clouds of each family (default: 5)")
    sheet.add_argument("--size", type=int, default=200, help="pixels along a picture (default: 200)")
    for sub, resolution in ((make, 128), (sheet, 128), (show, 64)):
        sub.add_argument("--seed", type=int, default=0, help="of the (first) cloud (default: 0)")
        sub.add_argument("--resolution", type=int, default=resolution, help=f"samples along the longest axis (default: {resolution})")
    arguments = parser.parse_args(list(argv))
    if arguments.verb == "list":
        _list(arguments.statistics, arguments.seed, arguments.resolution)
    elif arguments.verb == "make":
        _make(arguments)
    else:
        _preview(arguments)
    return 0


def _list(statistics: int, seed: int, resolution: int) -> None:
    for name, family in FAMILIES.items():
        print(f"{name}: {family.summary}{' (validation only)' if name in HELD_OUT else ''}")
        about = meanings(family.parameters)
        for parameter, domain in family.ranges.items():
            print(f"    {parameter:<13} {about[parameter]}: {domain}")
        if statistics > 0:
            clouds = [make_cloud(name, seed + k, resolution) for k in range(statistics)]
            mean = [weighted_mean(cloud.density) for cloud in clouds]
            filled = [np.count_nonzero(cloud.density) / cloud.density.size for cloud in clouds]
            print(
                f"    measured on {statistics} clouds at {resolution}: extinction-weighted mean over maximum {_spread(mean)}; "
                f"share of the box that is not empty {_spread(filled)}"
            )


def _spread(values: Sequence[float]) -> str:
    return f"{np.mean(values):.2f} ({min(values):.2f} to {max(values):.2f})"


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
    from PIL import Image

    from deepclouds.replacing import replacing
    from deepclouds_training.clouds._preview import contact_sheet

    if arguments.output.suffix.lower() != ".png":
        raise InputError(f"{arguments.output}: previews are written as .png")
    for name, value in (("count", arguments.count), ("size", arguments.size)):
        if value < 1:
            raise InputError(f"--{name} {value} shows nothing; it takes 1 or more")
    names = arguments.families or list(FAMILIES)
    rows = []
    for name in names:
        # A family with kinds shows them one after the other rather than by chance.
        kinds = [(key, d.options) for key, d in find_family(name).ranges.items() if isinstance(d, Choice)]
        row = []
        for k in range(arguments.count):
            fixed = {key: options[k % len(options)] for key, options in kinds}
            label = ", ".join([str(arguments.seed + k), *fixed.values()])
            row.append((label, make_cloud(name, arguments.seed + k, arguments.resolution, **fixed)))
        rows.append((f"{name}: {FAMILIES[name].summary}", row))
    picture = Image.fromarray(contact_sheet(rows, arguments.size))
    with replacing(arguments.output) as temporary:
        picture.save(temporary, format="PNG", optimize=True)
    print(f"{arguments.output}: {arguments.count} clouds of each of {', '.join(names)}")
