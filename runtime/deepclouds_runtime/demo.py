"""The demonstration: the cloud that comes with the package, rendered with the network that comes with it.

    python -m deepclouds_runtime.demo [--reference]

writes ``out/demo.exr`` and ``out/demo.png``; with ``--reference`` also what Mitsuba's path tracer makes of the same scene.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from deepclouds.errors import InputError

DATA = Path(__file__).parent / "data" / "demo.vdb"
_OPTIONS: dict[str, Any] = {"optical_depth": 60.0, "g": 0.85, "sun": (65.0, 35.0), "view": (0.0, 5.0)}


def main(argv: Sequence[str] | None = None, prog: str = "python -m deepclouds_runtime.demo") -> int:
    """Render the demonstration; returns 0, or 2 when an input is bad."""
    parser = argparse.ArgumentParser(prog=prog, description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the images, made when missing (default %(default)s)")
    parser.add_argument("--size", type=int, default=320, help="width in pixels; the height is three quarters of it (default %(default)s)")
    parser.add_argument("--spp", type=int, default=16, help="samples a pixel (default %(default)s)")
    parser.add_argument("--model", metavar="FILE", help="network to use (default: the one that comes with the package)")
    parser.add_argument("--reference", action="store_true", help="also render the scene with Mitsuba's volpath, which takes minutes")
    parser.add_argument("--reference-spp", type=int, default=64, help="samples a pixel of the reference (default %(default)s)")
    parser.add_argument("--unbiased", action="store_true", help="trace paths in place of asking the network")
    arguments = parser.parse_args(argv)
    try:
        if min(arguments.size, arguments.spp, arguments.reference_spp) < 1:
            raise InputError("size and samples are whole numbers above 0")
        arguments.out.mkdir(parents=True, exist_ok=True)
        _run(arguments, partial(print, flush=True))
    except InputError as error:
        print(f"{prog}: {error}", file=sys.stderr)
        return 2
    return 0


def _run(arguments: argparse.Namespace, say: Callable[[str], None]) -> None:
    started = time.perf_counter()
    from deepclouds_runtime.loading import load
    from deepclouds_runtime.output import save

    size = (arguments.size, max(1, arguments.size * 3 // 4))
    say(f"{DATA.name}: a procedural cumulus under a sun and a blue sky, {size[0]} x {size[1]} pixels, {arguments.spp} samples each")
    renderer = load(str(DATA), model=arguments.model, unbiased=arguments.unbiased, size=size, **_OPTIONS)
    loaded = time.perf_counter()
    result = renderer.render(arguments.spp, seed=1)
    image = arguments.out / "demo.exr"
    settings = {
        "input": DATA.name,
        "spp": arguments.spp,
        "seed": 1,
        **_OPTIONS,
        "unbiased": arguments.unbiased,
        "model_hash": renderer.model_hash,
    }
    save(result, image, settings, image.with_suffix(".png"))
    say(f"{image}: all layers; {image.with_suffix('.png')}: to look at")
    say(f"  start-up and loading {loaded - started:.1f} s, rendering {result.seconds['total']:.1f} s, {result.counts.queries:,} queries")
    if arguments.reference:
        _reference(arguments, size, say)
    say("next: `deepclouds render CLOUD.vdb -o cloud.exr --png`, `deepclouds render SCENE.xml -o scene.exr`, `deepclouds render --help`")


def _reference(arguments: argparse.Namespace, size: tuple[int, int], say: Callable[[str], None]) -> None:
    import mitsuba as mi

    from deepclouds.exr import write_exr, write_png
    from deepclouds.volume import read_volume
    from deepclouds_runtime.volume_scene import cloud_description, options_from

    # The path tracer runs fastest in the scalar variant; ours has finished, so the variant may change.
    mi.set_variant("scalar_rgb")
    options = options_from({**_OPTIONS, "size": size})
    scene = mi.load_dict(cloud_description(read_volume(DATA), options, DATA.name))
    started = time.perf_counter()
    rendered = np.array(mi.render(scene, spp=arguments.reference_spp, seed=2))[..., :3]
    seconds = time.perf_counter() - started
    path = arguments.out / "demo_reference.exr"
    write_exr(path, {c: rendered[..., i] for i, c in enumerate("RGB")}, {"software": "Mitsuba volpath", "spp": arguments.reference_spp})
    write_png(path.with_suffix(".png"), rendered)
    say(f"{path}, {path.with_suffix('.png')}: Mitsuba's volpath, {arguments.reference_spp} samples a pixel, {seconds:.1f} s")
    say(f"  compare them: `deepclouds compare {arguments.out / 'demo.exr'} --ref {path}`")


if __name__ == "__main__":
    raise SystemExit(main())
