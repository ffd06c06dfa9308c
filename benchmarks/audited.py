"""What the correction by audit walks gains, and what it costs.

    python -m benchmarks.audited [--only name,...] [--spp 512] [--docs]

Each scene is rendered at 192 x 192 pixels as the network has it and corrected, and compared at 96 x 96 with two references that
are path-traced by our own walks with independent seeds (`deepclouds/metrics.py`). Processor time is that of the whole process, kernels
compiled beforehand.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from deepclouds_runtime.loading import load
from deepclouds_runtime.renderer import Renderer
from deepclouds_training.clouds import make_cloud
from numpy.typing import NDArray

from benchmarks.make_scenes import heap, plume, sky_image
from benchmarks.page import write_results
from deepclouds.errors import InputError
from deepclouds.exr import write_exr
from deepclouds.metrics import energy_error, rrmse, to_reference_size
from deepclouds.volume import Volume, write_vol
from deepclouds.volume.pyramid import mean_extinction

PAGE = Path(__file__).parents[1] / "docs" / "rendering.md"
_SIZE, _REFERENCE = 192, 96
_SKY = '<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>'
_FLOOR = (
    '<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="6"/><translate y="-1.05"/></transform>'
    '<bsdf type="diffuse"><rgb name="reflectance" value="0.5, 0.45, 0.4"/></bsdf></shape>'
)


def _sun(direction: str) -> str:
    return f'<emitter type="directional"><vector name="direction" value="{direction}"/><rgb name="irradiance" value="3 3 3"/></emitter>'


@dataclass(frozen=True)
class Case:
    """A cloud in the middle of the world, its longest edge of length 2; `depth` is that of this edge at the mean extinction."""

    make: Callable[[], Volume]
    depth: float
    emitters: str
    origin: str
    target: str = "0, 0, 0"
    fov: float = 30.0
    albedo: str = "1 1 1"
    g: float = 0.85


def _centred(volume: Volume) -> Volume:
    lower, upper = volume.bounds
    middle, scale = (lower + upper) / 2, 2 / (upper - lower).max()
    return Volume.from_box(volume.density, (lower - middle) * scale, (upper - middle) * scale)


def _sphere() -> Volume:
    axis = (np.arange(64) + 0.5) / 32 - 1
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    return Volume.from_box(np.clip((0.9 - np.sqrt(x * x + y * y + z * z)) * 32 + 0.5, 0, 1).astype(np.float32), (-1, -1, -1), (1, 1, 1))


def _two_clouds() -> Volume:
    """A cloud, a gap as wide, and its mirror image: the sun stands behind one of them."""
    one = make_cloud("cumulus", 9102, 48)
    density = np.concatenate([one.density, np.zeros_like(one.density), one.density[:, :, ::-1]], axis=2)
    lower, upper = one.bounds
    return Volume.from_box(density, lower, upper + np.array([2 * (upper[0] - lower[0]), 0, 0]))


def _box(density: NDArray[np.floating[Any]]) -> Volume:
    return Volume.from_box(density.astype(np.float32), (-1, -1, -1), (1, 1, 1))


CASES: dict[str, Case] = {
    "cumulus": Case(lambda: make_cloud("cumulus", 9201, 96), 50.0, _sun("-0.7, -0.6, -0.7"), "0.6, 0.3, 4.6", fov=27),
    "stratus from below": Case(
        lambda: make_cloud("stratus", 9101, 96), 30.0, _sun("-0.8, -0.6, 0"), "-0.6, -1.6, 0.2", target="0.1, 0, 0", fov=50
    ),
    "sphere": Case(_sphere, 12.0, _sun("-0.3, -0.9, -0.3"), "2.5, 0.8, 3.4"),
    "shadow of a cloud": Case(_two_clouds, 60.0, _sun("-1, -0.05, -0.03"), "-1.2, 0.4, 4.2", target="-0.66, 0, 0", fov=11),
    "coloured smoke": Case(lambda: _box(plume()), 10.0, _sun("-0.5, -0.7, -0.6"), "0, 0, 4.3", fov=28, albedo="0.99 0.92 0.8", g=0.6),
    "cumulus under a sky": Case(lambda: make_cloud("cumulus", 9203, 96), 40.0, _SKY, "0.6, -0.2, 4.6", fov=27),
    "heap over a floor": Case(lambda: _box(heap()), 12.0, _sun("-0.5, -1, -0.4") + _FLOOR, "1, 0.8, 4.6", target="0, -0.2, 0", g=0.7),
}


def _write(folder: Path, case: Case) -> Path:
    volume = _centred(case.make())
    write_vol(folder / "density.vol", volume)
    sky = sky_image()
    write_exr(folder / "sky.exr", {name: np.ascontiguousarray(sky[..., i]) for i, name in enumerate("RGB")})
    lower, upper = volume.bounds
    middle, edges = (", ".join(f"{v:.9g}" for v in values) for values in ((lower + upper) / 2, upper - lower))
    cube = ", ".join(f"{v:.9g}" for v in (upper - lower) / 2)
    scale = case.depth / (2.0 * mean_extinction(volume))
    path = folder / "scene.xml"
    path.write_text(f"""<scene version="3.0.0">
      <default name="size" value="{_SIZE}"/>
      <integrator type="volpath"><integer name="max_depth" value="-1"/><boolean name="hide_emitters" value="true"/></integrator>
      <sensor type="perspective"><float name="fov" value="{case.fov}"/>
        <transform name="to_world"><lookat origin="{case.origin}" target="{case.target}" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="$size"/><integer name="height" value="$size"/><rfilter type="box"/></film>
      </sensor>
      {case.emitters}
      <shape type="cube"><transform name="to_world"><scale value="{cube}"/><translate value="{middle}"/></transform>
        <bsdf type="null"/>
        <medium type="heterogeneous" name="interior">
          <rgb name="albedo" value="{case.albedo}"/><float name="scale" value="{scale:.9g}"/>
          <phase type="hg"><float name="g" value="{case.g}"/></phase>
          <volume type="gridvolume" name="sigma_t"><string name="filename" value="density.vol"/>
            <transform name="to_world"><translate value="-0.5, -0.5, -0.5"/>
              <scale value="{edges}"/><translate value="{middle}"/></transform>
          </volume></medium></shape></scene>""")
    return path


def _timed(renderer: Renderer, correct: bool) -> tuple[NDArray[np.float64], float, dict[str, object]]:
    renderer.render(correct=correct, seed=7)
    started = time.process_time()
    result = renderer.render(correct=correct, seed=1)
    return result.rgb.astype(np.float64), time.process_time() - started, result.statistics.audit


def measure(name: str, spp: int) -> str:
    """Row of the table of one scene."""
    with tempfile.TemporaryDirectory() as folder:
        path = _write(Path(folder), CASES[name])
        truth = load(path, unbiased=True, defines={"size": str(_REFERENCE)})
        a, b = (truth.render(spp, seed=seed).rgb for seed in (11, 12))
        renderer = load(path)
        cells = [name]
        found: dict[str, object] = {}
        for correct in (False, True):
            image, seconds, found = _timed(renderer, correct)
            image = to_reference_size(image, a)
            cells += [f"{100 * rrmse(image, a, b):.2f}", f"{100 * energy_error(image, a, b):+.2f}", f"{seconds:.1f}"]
        cells += [f"{found['walks']:,}" if found else "", str(found.get("levels", "none"))]
    return "| " + " | ".join(cells) + " |"


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print, and with ``--docs`` write the page."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.audited", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", help=f"comma-separated names out of {', '.join(CASES)}")
    parser.add_argument("--spp", type=int, default=512, help="of the references (default %(default)s)")
    parser.add_argument("--docs", action="store_true", help="write the results into docs/rendering.md")
    options = parser.parse_args(argv)
    names = list(CASES) if options.only is None else options.only.split(",")
    if unknown := [n for n in names if n not in CASES]:
        raise InputError(f"--only {','.join(unknown)}: scenes are {', '.join(CASES)}")
    rows = [
        "| scene | network: rRMSE % | energy % | processor s | corrected: rRMSE % | energy % | processor s | walks | levels |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        print(row, flush=True)
    for name in names:
        rows.append(measure(name, options.spp))
        print(rows[-1], flush=True)
    if options.docs:
        write_results(PAGE, "audited", "\n".join(rows))
    return 0


if __name__ == "__main__":
    try:
        raise SystemExit(main())
    except InputError as error:
        print(f"benchmarks.audited: {error}", file=sys.stderr)
        raise SystemExit(2) from None
