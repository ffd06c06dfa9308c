"""The command line of `deepclouds render`: parses, renders, writes, reports."""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Callable, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

from deepclouds.errors import InputError
from deepclouds_runtime._job import ERROR_OF_FRAMES, Plan, corrects, plan
from deepclouds_runtime.sequence import parse_frames

# Seconds of a time limit in which nodes of the default model are too few.
_SHORT = 2.0

_PAIR = "AZ,EL"


def _numbers(counts: tuple[int, ...]) -> Callable[[str], tuple[float, ...]]:
    def parse(text: str) -> tuple[float, ...]:
        try:
            values = tuple(float(part) for part in text.split(","))
        except ValueError:
            values = ()
        if len(values) not in counts:
            raise argparse.ArgumentTypeError(f"'{text}' is not {' or '.join(str(c) for c in counts)} numbers with commas between")
        return values

    return parse


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)x(\d+)", text)
    if match is None or "0" in match.groups():
        raise argparse.ArgumentTypeError(f"'{text}' is not WIDTHxHEIGHT in pixels, as in 640x480")
    return int(match[1]), int(match[2])


def _positive(text: str) -> int:
    if not re.fullmatch(r"\d+", text) or int(text) < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number above 0")
    return int(text)


def _seed(text: str) -> int:
    if not re.fullmatch(r"\d+", text) or int(text) > 0xFFFFFFFF:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number below {1 << 32}")
    return int(text)


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"'{text}' is not a number of seconds; with --progressive last, write its input first")
    return value


def _frames(text: str) -> tuple[int, ...]:
    try:
        return parse_frames(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Render a cloud: a Mitsuba 3 scene (.xml) or a volume (.vdb, .vol). The image is a float32 EXR, linear Rec. 709, "
        "with the light's parts as layers.",
    )
    parser.add_argument(
        "input",
        metavar="INPUT",
        nargs="+",
        help="scene.xml, cloud.vdb or cloud.vol; a sequence of volumes as cloud_%%04d.vdb, cloud_####.vdb, a folder, or several files",
    )
    parser.add_argument(
        "-o",
        "--output",
        metavar="OUT.exr",
        type=Path,
        required=True,
        help="image to write; for several frames with %%04d or #### in the place of their number (default: OUT.0001.exr, ...)",
    )
    parser.add_argument("--spp", type=_positive, help="samples a pixel (default: as many as --error asks for); fewer where --time is over")
    parser.add_argument(
        "--error",
        type=float,
        help="error of a pixel to aim at, as a share of the mean: noise, and what a correction leaves "
        f"(default 0.02; of several frames {ERROR_OF_FRAMES}); not with --mode reference",
    )
    parser.add_argument(
        "--audit", action="store_true", help="measure the network's error in this image with path-traced walks, and report it (fast mode)"
    )
    parser.add_argument(
        "--correct",
        action=argparse.BooleanOptionalAction,
        help="audit, and correct the network by what the walks say (default: for an image alone in the fast mode)",
    )
    parser.add_argument(
        "--time",
        type=float,
        metavar="SECONDS",
        help="end in time; without --error and --spp all of it is used, in a corrected image of less than "
        f"{_SHORT:g} seconds with the model 'fast'. The image then depends on the machine",
    )
    parser.add_argument(
        "--mode", choices=("fast", "reference"), default="fast", help="reference: every sample asks the network (default %(default)s)"
    )
    parser.add_argument(
        "--exact-orders", metavar="N", type=_positive, help="sample N orders of scattering before the network is asked (default 1)"
    )
    parser.add_argument(
        "--unbiased", action="store_true", help="trace paths until --error, --time or --spp is reached; no network is loaded"
    )
    parser.add_argument("--seed", type=_seed, default=0, help="of all random numbers (default %(default)s)")
    parser.add_argument("--model", metavar="FILE", help="network to use, a file or a name (default: accurate; see --time)")
    parser.add_argument(
        "--extrapolate", action="store_true", help="ask the network about media it was not trained on, in place of tracing paths there"
    )
    parser.add_argument(
        "--max-depth", type=int, help="-1 for all orders of scattering, 2 for single scattering alone (default: the scene's)"
    )
    parser.add_argument("--hide-emitters", action="store_true", default=None, help="black behind the cloud in place of the sky")
    parser.add_argument("--env-directions", type=_positive, help="directions drawn from an environment at each sample (default 2)")
    parser.add_argument(
        "--no-interreflection", action="store_true", help="leave out the light that surfaces and cloud, and surfaces, throw on each other"
    )
    parser.add_argument("--png", metavar="FILE", nargs="?", const="", help="also write a tone-mapped preview (default name: OUT.png)")
    parser.add_argument("--exposure", type=float, default=0.0, help="of the preview, in stops (default %(default)s)")
    parser.add_argument("--variant", metavar="NAME", help="Mitsuba's variant, such as cuda_ad_rgb (default llvm_ad_rgb)")
    parser.add_argument("--threads", type=_positive, help="threads to use (default: all cores)")
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    parser.add_argument(
        "--progressive",
        metavar="SECONDS",
        nargs="?",
        type=_seconds,
        const=1.0,
        help="write the image while it is refined: a quick look first, then at most one each SECONDS (default %(const)g)",
    )
    parser.add_argument(
        "--unit", type=float, help="unit of length of the network's input, world units (default: the mean free path at the mean extinction)"
    )
    several = parser.add_argument_group("several frames")
    several.add_argument(
        "--frames", metavar="LIST", type=_frames, help="of a sequence or a turn, as in 1-48, 1-48x2 or 1,5,9-12 (default: all)"
    )
    several.add_argument("--turntable", metavar="N", type=_positive, help="go once round the cloud in N frames, counted from 1")
    several.add_argument(
        "--resume", "--skip-existing", dest="skip_existing", action="store_true", help="leave out frames whose image is there and finished"
    )
    scene = parser.add_argument_group("a scene")
    scene.add_argument("-D", dest="defines", metavar="KEY=VALUE", action="append", default=[], help="value for a parameter of the scene")
    scene.add_argument("--sensor", type=int, help="number of the camera, from 0 (default 0)")
    volume = parser.add_argument_group("a volume")
    volume.add_argument("--optical-depth", type=float, help="of the densest line along the longest axis of the grid (default 60)")
    volume.add_argument("--extinction", type=float, help="extinction at density 1, per world unit, in place of --optical-depth")
    volume.add_argument("--albedo", type=_numbers((1, 3)), metavar="A|R,G,B", help="single-scattering albedo (default 1)")
    volume.add_argument("--g", type=float, help="Henyey-Greenstein parameter, -1 to 1 (default 0.85)")
    volume.add_argument(
        "--phase",
        type=_numbers((3,)),
        metavar="G1,G2,WEIGHT",
        help="two Henyey-Greenstein lobes and the first one's weight, in place of --g",
    )
    volume.add_argument(
        "--sun", type=_numbers((2,)), metavar=_PAIR, help="where the sun stands, degrees; azimuth 0 is +Z and grows to +X (default 100,35)"
    )
    volume.add_argument("--irradiance", type=_numbers((1, 3)), metavar="E|R,G,B", help="of the sun, perpendicular to it (default 12)")
    volume.add_argument("--sun-diameter", metavar="DEG", type=float, help="of the sun's disc, an angle (default 0; the real one has 0.53)")
    volume.add_argument("--env", metavar="FILE", help="environment map for light and background, in place of sun and sky")
    volume.add_argument("--sky", type=_numbers((1, 3)), metavar="L|R,G,B", help="radiance of the uniform sky (default 0.09,0.17,0.34)")
    volume.add_argument("--up", choices=("y", "z"), help="axis that points up; with z, azimuth 0 is +X and grows to +Y (default y)")
    volume.add_argument("--view", type=_numbers((2,)), metavar=_PAIR, help="where the camera stands, degrees, like --sun (default 0,5)")
    volume.add_argument("--size", type=_size, metavar="WxH", help="pixels (default 640x480)")
    volume.add_argument("--grid", metavar="NAME", help="grid in a .vdb file")
    volume.add_argument("--albedo-grid", metavar="NAME", help="grid in a .vdb file that is the albedo, numbers or colours")
    volume.add_argument("--clamp", action="store_true", help="set negative values and NaN in the file to 0")
    volume.add_argument("--ignore-emission", action="store_true", help="render what a fire scatters, without the light that it gives off")
    return parser


_VOLUME = ("optical_depth", "extinction", "albedo", "g", "phase", "sun", "irradiance", "sun_diameter", "env", "sky", "up", "view", "size")
_BOTH = ("max_depth", "hide_emitters")
_MAY_BE_NEGATIVE = ("--phase", "--sun", "--view", "--albedo", "--irradiance", "--sky", "--size")


def run(argv: Sequence[str], prog: str) -> int:
    """Parse `argv`, render and write; returns 0, or 130 when it was interrupted; raises InputError for bad input."""
    arguments = _parser(prog).parse_args(_negative_pairs(argv))
    if arguments.mode == "reference" and arguments.error is not None:
        raise InputError(f"--error {arguments.error:g}: the reference mode takes the samples of --spp, whatever their noise; leave it out")
    made = plan(arguments)
    options: dict[str, Any] = {
        k: getattr(arguments, k) for k in (*_VOLUME, *_BOTH, "sensor", "grid", "albedo_grid") if getattr(arguments, k) is not None
    }
    if arguments.clamp:
        options["clamp"] = True
    if arguments.ignore_emission:
        options["ignore_emission"] = True
    how: dict[str, Any] = {"mode": arguments.mode, "interreflection": not arguments.no_interreflection}
    if arguments.unbiased:
        how["unbiased"] = True
    if arguments.exact_orders is not None:
        how["exact_orders"] = arguments.exact_orders
    if arguments.extrapolate:
        how["extrapolate"] = True
    if arguments.env_directions is not None:
        how["environment_directions"] = arguments.env_directions

    if arguments.unit is not None:
        how["unit"] = arguments.unit

    from deepclouds_runtime._job import run as run_job
    from deepclouds_runtime._mitsuba import select
    from deepclouds_runtime.output import check_exposure

    check_exposure(arguments.exposure)
    if arguments.variant is not None:
        select(arguments.variant)
    defines = dict(_define(text) for text in arguments.defines)
    record = {
        "command": shlex.join([*prog.split(), *argv]),
        "version": version("deepclouds"),
        "error": arguments.error,
        "time": arguments.time,
        "correct": corrects(arguments, made),
        "seed": arguments.seed,
        "defines": defines,
        "options": options,
        "turntable": made.turntable,
        **how,
    }
    say: Callable[[str], None] = (lambda text: None) if arguments.quiet else partial(print, flush=True)
    load = {"defines": defines, "model": _model(arguments, made), "threads": arguments.threads, **options, **how}
    return run_job(made, arguments, load, record, say)


def _model(arguments: argparse.Namespace, made: Plan) -> str | None:
    """The model to load: in a short time the quick one, of which more nodes are ready."""
    short = arguments.time is not None and arguments.time < _SHORT
    if arguments.model is None and short and arguments.error is None and corrects(arguments, made):
        return "fast"
    model: str | None = arguments.model
    return model


def _negative_pairs(argv: Sequence[str]) -> list[str]:
    """Join `--sun -30,40` to `--sun=-30,40`: argparse takes what starts with a minus sign and is no plain number for an option."""
    joined: list[str] = []
    for text in argv:
        if joined and joined[-1] in _MAY_BE_NEGATIVE and re.match(r"-[\d.]", text):
            joined[-1] += f"={text}"
        else:
            joined.append(text)
    return joined


def _define(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not name or not equals:
        raise InputError(f"-D{text}: write -DNAME=VALUE")
    return name, value
