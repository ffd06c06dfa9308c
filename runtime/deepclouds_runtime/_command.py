"""The command line of `deepclouds render`: parses, renders, writes, reports."""

from __future__ import annotations

import argparse
import re
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deepclouds.errors import InputError

if TYPE_CHECKING:
    from deepclouds_runtime.renderer import Renderer, RenderResult

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


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Render a cloud: a Mitsuba 3 scene (.xml) or a volume (.vdb, .vol). The image is a float32 EXR, linear Rec. 709, "
        "with the light's parts as layers.",
    )
    parser.add_argument("input", metavar="INPUT", help="scene.xml, cloud.vdb or cloud.vol")
    parser.add_argument("-o", "--output", metavar="OUT.exr", type=Path, required=True, help="image to write")
    parser.add_argument("--spp", type=_positive, help="samples a pixel (default: as many as --error asks for)")
    parser.add_argument("--error", type=float, help="noise of a pixel to aim at, as a share of the mean (default 0.02)")
    parser.add_argument(
        "--mode", choices=("fast", "reference"), default="fast", help="reference: every sample asks the network (default %(default)s)"
    )
    parser.add_argument("--seed", type=_seed, default=0, help="of all random numbers (default %(default)s)")
    parser.add_argument("--model", metavar="FILE", help="network to use (default: the one that comes with deepclouds)")
    parser.add_argument(
        "--extrapolate", action="store_true", help="ask the network about media it was not trained on, in place of tracing paths there"
    )
    parser.add_argument(
        "--max-depth", type=int, help="-1 for all orders of scattering, 2 for single scattering alone (default: the scene's)"
    )
    parser.add_argument("--hide-emitters", action="store_true", default=None, help="black behind the cloud in place of the sky")
    parser.add_argument("--env-directions", type=_positive, help="directions drawn from an environment at each sample (default 2)")
    parser.add_argument("--no-interreflection", action="store_true", help="leave out the light that surfaces and cloud throw on each other")
    parser.add_argument("--png", metavar="FILE", nargs="?", const="", help="also write a tone-mapped preview (default name: OUT.png)")
    parser.add_argument("--exposure", type=float, default=0.0, help="of the preview, in stops (default %(default)s)")
    parser.add_argument("--variant", metavar="NAME", help="Mitsuba's variant, such as cuda_ad_rgb (default llvm_ad_rgb)")
    parser.add_argument("--threads", type=_positive, help="threads to use (default: all cores)")
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    parser.add_argument("--multiple", choices=("network", "walks"), default="network", help=argparse.SUPPRESS)
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
    volume.add_argument("--env", metavar="FILE", help="environment map for light and background, in place of sun and sky")
    volume.add_argument("--sky", type=_numbers((1, 3)), metavar="L|R,G,B", help="radiance of the uniform sky (default 0.09,0.17,0.34)")
    volume.add_argument("--up", choices=("y", "z"), help="axis that points up; with z, azimuth 0 is +X and grows to +Y (default y)")
    volume.add_argument("--view", type=_numbers((2,)), metavar=_PAIR, help="where the camera stands, degrees, like --sun (default 0,5)")
    volume.add_argument("--size", type=_size, metavar="WxH", help="pixels (default 640x480)")
    volume.add_argument("--grid", metavar="NAME", help="grid in a .vdb file")
    volume.add_argument("--clamp", action="store_true", help="set negative values and NaN in the file to 0")
    return parser


_VOLUME = ("optical_depth", "extinction", "albedo", "g", "phase", "sun", "irradiance", "env", "sky", "up", "view", "size")
_BOTH = ("max_depth", "hide_emitters")
_MAY_BE_NEGATIVE = ("--phase", "--sun", "--view", "--albedo", "--irradiance", "--sky", "--size")


def run(argv: Sequence[str], prog: str) -> int:
    """Parse `argv`, render and write; returns 0, raises InputError for bad input."""
    arguments = _parser(prog).parse_args(_negative_pairs(argv))
    output: Path = arguments.output
    png = None if arguments.png is None else Path(arguments.png or output.with_suffix(".png"))
    for path, suffix in ((output, ".exr"), (png, ".png")):
        if path is None:
            continue
        if path.suffix.lower() != suffix:
            raise InputError(f"{path}: the name must end in {suffix}")
        if not path.parent.is_dir():
            raise InputError(f"{path}: the folder {path.parent} does not exist; create it first")
    options: dict[str, Any] = {k: getattr(arguments, k) for k in (*_VOLUME, *_BOTH, "sensor", "grid") if getattr(arguments, k) is not None}
    if arguments.clamp:
        options["clamp"] = True
    how: dict[str, Any] = {"mode": arguments.mode, "multiple": arguments.multiple, "interreflection": not arguments.no_interreflection}
    if arguments.extrapolate:
        how["extrapolate"] = True
    if arguments.env_directions is not None:
        how["environment_directions"] = arguments.env_directions

    import numpy as np

    from deepclouds_runtime._mitsuba import mitsuba, select
    from deepclouds_runtime.loading import load
    from deepclouds_runtime.output import check_exposure, save

    check_exposure(arguments.exposure)
    if arguments.variant is not None:
        select(arguments.variant)
    defines = dict(_define(text) for text in arguments.defines)
    renderer = load(arguments.input, defines=defines, model=arguments.model, threads=arguments.threads, **options, **how)
    say: Callable[[str], None] = (lambda text: None) if arguments.quiet else print
    _describe(renderer, say)
    with _progress(arguments.quiet) as progress:
        dial = {} if arguments.error is None else {"error": arguments.error}
        result = renderer.render(arguments.spp, arguments.seed, progress, **dial)
    sensor = renderer.scene.sensor
    parameters = mitsuba().traverse(sensor)
    camera: dict[str, Any] = {
        "type": sensor.class_name(),
        "to_world": np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4).tolist(),
        "film": [int(v) for v in sensor.film().size()],
        "crop_offset": [int(v) for v in sensor.film().crop_offset()],
    }
    for name in ("x_fov", "aperture_radius", "focus_distance"):
        if name in parameters:
            camera[name] = [float(v) for v in np.ravel(np.array(parameters[name]))]
    settings = {
        "command": shlex.join([*prog.split(), *argv]),
        "version": version("deepclouds"),
        "mitsuba_variant": mitsuba().variant(),
        "input": arguments.input,
        "spp": result.statistics.spp,
        "error": arguments.error,
        "seed": arguments.seed,
        "defines": defines,
        "options": options,
        **how,
        "environment_directions": renderer.environment_directions,
        "size": renderer.scene.size,
        "camera": camera,
        "suns": [asdict(sun) for sun in renderer.scene.suns],
        "hide_emitters": renderer.scene.hide_emitters,
        "extinction": renderer.scene.scale,
        "albedo": renderer.scene.albedo,
        "phase": renderer.scene.phase,
        "max_depth": renderer.scene.max_depth,
        "model_hash": renderer.model_hash,
    }
    save(result, output, settings, png, arguments.exposure)
    _report(result, say)
    for note in result.notes:
        if note not in renderer.notes:
            say(f"warning: {note}")
    say(f"wrote {output}" + (f" and {png}" if png is not None else ""))
    return 0


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


def _describe(renderer: Renderer, say: Callable[[str], None]) -> None:
    scene = renderer.scene
    x, y, z = scene.volume.resolution
    width, height = scene.size
    albedo = ", ".join(f"{a:g}" for a in scene.albedo)
    say(f"cloud of {x} x {y} x {z} voxels, extinction {scene.scale:.5g} at density 1, albedo {albedo}, {_phase_words(scene.phase)}")
    lights = [f"{len(scene.suns)} sun{'s' if len(scene.suns) > 1 else ''}"] if scene.suns else []
    lights += [scene.environment.class_name()] if scene.environment is not None else []
    say(f"image of {width} x {height} pixels; lights: {', '.join(lights) or 'none'}")
    for note in renderer.notes:
        say(f"note: {note}")


def _phase_words(phase: tuple[float, float, float]) -> str:
    g1, g2, weight = phase
    return f"g {g1:g}" if weight == 1 else f"g {g1:g} and {g2:g} with weights {weight:g} and {1 - weight:g}"


def _report(result: RenderResult, say: Callable[[str], None]) -> None:
    statistics = result.statistics
    rows = [("mode", statistics.mode), ("samples a pixel", f"up to {statistics.spp:,}, on average {statistics.mean_spp:.3g}")]
    if statistics.noise is not None:
        rows.append(("noise of a pixel, estimated", f"{100 * statistics.noise:.2g} %"))
    if statistics.network:
        rows.append(("error of the network, expected", f"{100 * statistics.network['error']:.2g} % of the cloud's light"))
    for name, source in statistics.sources.items():
        took = f"{source['nodes']:,} nodes, {source['queries']:,} queries, error at a point {100 * source['error']:.2g} %"
        rows.append((f"{name} ({source['lights']})", f"{took}, cells refined {' + '.join(map(str, source['refined'])) or 0}"))
    rows += [(name.replace("_", " "), f"{value:,}") for name, value in asdict(result.counts).items() if name != "skipped"]
    rows += [(f"no query: {name}", f"{value:,}") for name, value in statistics.skipped.items()]
    rows += [(f"time: {name}", f"{seconds:.2f} s") for name, seconds in result.seconds.items()]
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        say(f"{name.ljust(width)}  {value}")


@contextmanager
def _progress(quiet: bool) -> Iterator[Callable[[float], None] | None]:
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("rendering", total=1.0)
        yield lambda share: bar.update(task, completed=share)
