"""One method on one scene in a process of its own, so that each has its own Mitsuba variant, thread pools and cold start.

    python -m benchmarks.worker METHOD scene.xml --size 96 --spp 16,64 --seed 7 --out folder

METHOD is deepclouds (its fast mode), corrected (the same with the correction by walks), timed (that with --time), reference (its method as
published: every sample asks the network), unbiased (its own path tracer), octaves (`benchmarks.octaves`), volpath, oidn (volpath and its
denoised image) or single (single scattering). Writes two EXRs an image, which differ in their seed, and `METHOD.json`: for each image its
method, model, spp, files, seconds warm and seconds cold; nothing for a model that was not trained on the scene's medium. Warm: scene,
kernels and model are loaded, all work that depends on the sun or the camera included. Cold: what a first image costs a fresh process,
imports and loading included.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepclouds.errors import InputError
from deepclouds.exr import write_exr

Image = NDArray[np.float32]
# Modes of deepclouds, which ask a model, and all methods; what is limited in time is run where a time is given.
_ASKING, TIMED = ("deepclouds", "corrected", "reference"), "timed"
OURS = (*_ASKING, TIMED)
METHODS = (*_ASKING, "unbiased", "octaves", "volpath", "oidn", "single")
# The spp that stands for "what the renderer chooses itself".
DEFAULT_SPP = 0


def main(argv: Sequence[str] | None = None) -> int:
    """Render, time and write; returns 0."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.worker", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("method", choices=(*METHODS, TIMED))
    parser.add_argument("scene", type=Path)
    parser.add_argument("--size", type=int, required=True)
    parser.add_argument("--spp", required=True, help="comma-separated; 0: the renderer's own default (deepclouds only)")
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--time", type=float, help="timed: seconds an image")
    parser.add_argument("--model", help="deepclouds: name or file of a model (default: the one that it takes by itself)")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args(argv)
    spps = [int(s) for s in options.spp.split(",")]
    options.out.mkdir(parents=True, exist_ok=True)
    if options.method in (*OURS, "unbiased"):
        rows = render_deepclouds(options.method, options.scene, options.size, spps, options.seed, options.out, options.model, options.time)
    elif options.method == "octaves":
        rows = render_octaves(options.scene, options.size, spps, options.seed, options.out)
    else:
        rows = render_peer(options.method, options.scene, options.size, spps, options.seed, options.out)
    (options.out / f"{options.method}.json").write_text(json.dumps(rows))
    return 0


def render_deepclouds(
    method: str, scene: Path, size: int, spps: list[int], seed: int, out: Path, model: str | None, seconds: float | None = None
) -> list[dict[str, Any]]:
    """Time the runtime: the second render with another seed is the warm one."""
    start = time.perf_counter()
    loading: Any = import_module("deepclouds_runtime.loading")
    how = {"unbiased": True} if method == "unbiased" else {"mode": "reference" if method == "reference" else "fast"}
    renderer = loading.load(scene, defines={"size": str(size)}, model=model, **how)
    loaded = time.perf_counter() - start
    name = ""
    if method != "unbiased":
        # Without weights, paths are traced in the network's place.
        if renderer.model_hash is None:
            return []
        name = renderer.predictor.path.stem

    def render(spp: int, seed: int) -> Image:
        limit = {"time_limit": seconds} if method == TIMED else {}
        result = renderer.render(None if spp == DEFAULT_SPP else spp, seed, correct=method in ("corrected", TIMED), **limit)
        return np.asarray(result.rgb, dtype=np.float32)[..., :3]

    return _twice(render, method, name, spps, seed, loaded, out)


def render_octaves(scene: Path, size: int, spps: list[int], seed: int, out: Path) -> list[dict[str, Any]]:
    """Time octaves as the runtime is timed."""
    start = time.perf_counter()
    from deepclouds_runtime._mitsuba import mitsuba
    from deepclouds_runtime.loading import load_xml
    from deepclouds_runtime.scene import read_scene

    from benchmarks.octaves import OctaveRenderer

    mitsuba(select=True)
    renderer = OctaveRenderer(read_scene(load_xml(scene, {"size": str(size)})))
    return _twice(renderer.render, "octaves", "", spps, seed, time.perf_counter() - start, out)


def _twice(
    render: Callable[[int, int], Image], method: str, model: str, spps: list[int], seed: int, loaded: float, out: Path
) -> list[dict[str, Any]]:
    """Render each spp with two seeds: the first image of all is cold, every second one warm."""
    rows = []
    for index, spp in enumerate(spps):
        seconds, images = [], []
        for repeat in range(2):
            start = time.perf_counter()
            images.append(render(spp, seed + 2 * index + repeat))
            seconds.append(time.perf_counter() - start)
        rows.append(_row(method, spp, images[1], images[0], seconds[1], loaded + seconds[0] if index == 0 else None, out, model))
    return rows


def render_peer(method: str, scene: Path, size: int, spps: list[int], seed: int, out: Path) -> list[dict[str, Any]]:
    """Time Mitsuba's volpath in scalar_rgb, its image denoised, or its first order alone."""
    start = time.perf_counter()
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    loaded = load_volpath(mi, scene, size, max_depth=2 if method == "single" else -1)
    denoise: Any = None
    if method == "oidn":
        import mitsuba_oidn

        denoise = mitsuba_oidn.denoise
    loading = time.perf_counter() - start

    def render(spp: int, seed: int) -> Image:
        return np.ascontiguousarray(np.asarray(mi.render(loaded, spp=spp, seed=seed), dtype=np.float32)[..., :3])

    # The filter's weights are loaded and its memory is set up by the first image of a size.
    warm_up = render(1, seed)
    if denoise is not None:
        denoise(warm_up, hdr=True)
    rows = []
    for index, spp in enumerate(spps):
        traced, filtered, noisy, clean = [], [], [], []
        for repeat in range(2):
            start = time.perf_counter()
            noisy.append(render(spp, seed + 1 + 2 * index + repeat))
            traced.append(time.perf_counter() - start)
            if denoise is not None:
                start = time.perf_counter()
                # A cloud has no albedo or normal at a first surface; both images would be empty. Colour is all the filter gets.
                clean.append(np.array(denoise(noisy[-1], hdr=True), dtype=np.float32))
                filtered.append(traced[-1] + time.perf_counter() - start)
        kind = "single" if method == "single" else "volpath"
        rows.append(_row(kind, spp, noisy[0], noisy[1], traced[0], loading + traced[0], out))
        if clean:
            rows.append(_row("oidn", spp, clean[0], clean[1], filtered[0], loading + filtered[0], out))
    return rows


def load_volpath(mi: Any, scene: Path, size: int, max_depth: int) -> Any:
    """Load a scene with volpath, no roulette and the given depth; the scene's file must take the parameters integrator and size."""
    try:
        root = ElementTree.parse(scene).getroot()
    except (OSError, ElementTree.ParseError) as error:
        raise InputError(f"{scene}: not a readable scene ({error})") from error
    integrator = root.find("integrator")
    if integrator is None:
        raise InputError(f"{scene}: a benchmark scene needs an <integrator>")
    for name, value in (("max_depth", max_depth), ("rr_depth", 1_000_000)):
        entry = next((e for e in integrator if e.get("name") == name), None)
        if entry is None:
            entry = ElementTree.SubElement(integrator, "integer", name=name)
        entry.set("value", str(value))
    # Text has no folder of its own: relative file names are looked for beside the scene.
    mi.file_resolver().append(str(scene.parent.resolve()))
    return mi.load_string(ElementTree.tostring(root, encoding="unicode"), integrator="volpath", size=str(size))


def _row(method: str, spp: int, image: Image, other: Image, warm: float, cold: float | None, out: Path, model: str = "") -> dict[str, Any]:
    """One image and, for its noise, the same from another seed."""
    names = [f"{method}_{spp}.exr", f"{method}_{spp}_b.exr"]
    for name, pixels in zip(names, (image, other), strict=True):
        write_exr(out / name, {c: pixels[..., i] for i, c in enumerate("RGB")}, {"spp": spp, "seconds": warm})
    return {"method": method, "model": model, "spp": spp, "files": names, "seconds_warm": warm, "seconds_cold": cold}


if __name__ == "__main__":
    try:
        raise SystemExit(main())
    except InputError as error:
        print(error, file=sys.stderr)
        raise SystemExit(2) from None
