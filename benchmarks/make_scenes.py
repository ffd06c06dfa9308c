"""Makes the small scenes of the benchmark: three procedural volumes, a sky, and two independent references each.

    python -m benchmarks.make_scenes [--out benchmarks/scenes] [--only name,...] [--spp 1024]

The volumes come from formulas of their own, not from the generator of training clouds: a benchmark on the training distribution would
flatter the network. Each scene is a folder with `scene.xml` (parameters: integrator, spp, size), its `.vol`, `ref_a.exr`, `ref_b.exr`
and `ref.json`, which says how the references were made. Images are to share no seed with them: the references use seeds above 500000.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deepclouds.errors import InputError
from deepclouds.exr import write_exr
from deepclouds.volume import Volume, write_vol

Grid = NDArray[np.float64]
HERE = Path(__file__).parent / "scenes"
_SIZE = 48
_CHUNK = 64
_SEEDS = {"a": 500_000, "b": 900_000}


@dataclass(frozen=True)
class Recipe:
    """One scene: its density (values in 0..1 over the box), and the text of its lights, medium and camera."""

    density: Callable[[], Grid]
    scale: float
    albedo: str
    g: float
    emitters: str
    origin: str
    fov: float
    spp_factor: float


def fractal_noise(shape: tuple[int, int, int], base: int, octaves: int, seed: int) -> Grid:
    """Sum of trilinearly interpolated random lattices, (nz, ny, nx), each octave twice as fine and half as strong; values in -1..1."""
    rng = np.random.default_rng(seed)
    total, weight = np.zeros(shape), 0.0
    for octave in range(octaves):
        cells = base * 2**octave
        values = rng.uniform(-1, 1, (cells + 1,) * 3)
        for axis, n in enumerate(shape):
            x = (np.arange(n) + 0.5) / n * cells
            low = np.minimum(x.astype(int), cells - 1)
            fraction = (x - low).reshape([-1 if a == axis else 1 for a in range(3)])
            # Smoothed fractions hide the lattice, whose creases the eye finds at once.
            fraction = fraction * fraction * (3 - 2 * fraction)
            values = np.take(values, low, axis=axis) * (1 - fraction) + np.take(values, low + 1, axis=axis) * fraction
        total += values * 0.5**octave
        weight += 0.5**octave
    return total / weight


def _axes(n: int) -> tuple[Grid, Grid, Grid]:
    c = (np.arange(n) + 0.5) / n * 2 - 1
    z, y, x = np.meshgrid(c, c, c, indexing="ij")
    return x, y, z


def heap(n: int = 44, seed: int = 11) -> Grid:
    """Lay a heap of overlapping balls on a flat base, with a ragged surface: something like a cumulus. (n, n, n), values in 0..1."""
    rng = np.random.default_rng(seed)
    x, y, z = _axes(n)
    distance = np.full(x.shape, np.inf)
    for index in range(14):
        height = 1.0 if index == 0 else float(rng.uniform(0, 1))
        radius = 0.42 if index == 0 else float(rng.uniform(0.2, 0.4)) * (1.1 - 0.4 * height)
        angle, spread = rng.uniform(0, 2 * np.pi), 0.62 * (1 - height) ** 0.7
        cx, cz, cy = spread * np.cos(angle), spread * np.sin(angle), -0.45 + 0.75 * height * (0.35 if index == 0 else 1)
        distance = np.minimum(distance, np.sqrt((x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2) - radius)
    noise = fractal_noise((n, n, n), 5, 3, seed + 1)
    flat = np.clip((y + 0.6) / 0.08, 0, 1)
    return _edge_free(np.clip(0.5 - (distance + 0.16 * noise) / 0.10, 0, 1) * flat * (0.8 + 0.2 * noise))


def soft_ball(n: int = 24) -> Grid:
    """Fill a ball that is uniform inside and fades over its outer third. (n, n, n), values in 0..1."""
    x, y, z = _axes(n)
    return _edge_free(np.clip((0.95 - np.sqrt(x * x + y * y + z * z)) / 0.3, 0, 1))


def plume(n: int = 44, seed: int = 23) -> Grid:
    """Wind a rising, widening column that breaks up towards its top. (n, n, n), values in 0..1."""
    x, y, z = _axes(n)
    rise = (y + 1) / 2
    cx, cz = 0.25 * np.sin(4.2 * rise) * rise, 0.25 * np.cos(3.1 * rise + 0.5) * rise
    radius = 0.14 + 0.42 * rise
    noise = fractal_noise((n, n, n), 4, 4, seed)
    distance = np.sqrt((x - cx) ** 2 + (z - cz) ** 2) / radius - 0.8
    body = np.clip(0.5 - (distance + (0.4 + 0.9 * rise) * noise) / 0.5, 0, 1)
    return _edge_free(body * np.exp(-1.2 * rise) * np.clip((0.95 - y) / 0.25, 0, 1))


def _edge_free(density: Grid) -> Grid:
    """Empty the outermost voxels: the field ends inside its box, as a cropped .vdb does."""
    inner = np.zeros_like(density)
    inner[1:-1, 1:-1, 1:-1] = np.maximum(density, 0)[1:-1, 1:-1, 1:-1]
    scaled: Grid = inner / inner.max()
    return scaled


def sky_image(width: int = 64) -> NDArray[np.float32]:
    """Paint a clear sky over dark ground with a soft bright sun, latitude-longitude (width / 2, width, 3), linear radiance."""
    height = width // 2
    theta = (np.arange(height) + 0.5)[:, None] / height * np.pi
    phi = (np.arange(width) + 0.5)[None, :] / width * 2 * np.pi
    up = np.broadcast_to(np.cos(theta), (height, width))
    zenith, horizon, ground = np.array([0.18, 0.34, 0.75]), np.array([0.75, 0.82, 0.9]), np.array([0.12, 0.10, 0.08])
    blend = np.clip(up, 0, 1)[..., None] ** 0.5
    image = np.where(up[..., None] > 0, horizon + blend * (zenith - horizon), ground)
    direction = np.stack(np.broadcast_arrays(np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)), axis=-1)
    sun = np.array([0.55, 0.62, 0.56])
    image = image + 25 * np.exp(90 * (direction @ (sun / np.linalg.norm(sun)) - 1))[..., None] * np.array([1.0, 0.93, 0.8])
    painted: NDArray[np.float32] = image.astype(np.float32)
    return painted


def _sun(direction: str) -> str:
    return f'<emitter type="directional"><vector name="direction" value="{direction}"/><rgb name="irradiance" value="3 3 3"/></emitter>'


RECIPES: dict[str, Recipe] = {
    "heap_sun": Recipe(heap, 22.0, "1 1 1", 0.85, _sun("-0.7, -0.6, -0.7"), "0.6, 0.1, 4.1", 27.0, 2.0),
    "ball_isotropic": Recipe(soft_ball, 7.0, "1 1 1", 0.0, _sun("-0.6, -1, -0.4"), "0, 0.5, 4.3", 30.0, 0.5),
    "plume_sky": Recipe(
        plume,
        16.0,
        "0.98 0.9 0.75",
        0.6,
        '<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>',
        "0, 0, 4.3",
        28.0,
        1.0,
    ),
}

_XML = """<scene version="3.0.0">
  <default name="integrator" value="volpath"/>
  <default name="spp" value="64"/>
  <default name="size" value="96"/>
  <integrator type="$integrator">
    <integer name="max_depth" value="-1"/>
    <integer name="rr_depth" value="1000000"/>
    <boolean name="hide_emitters" value="{hide}"/>
  </integrator>
  <sensor type="perspective">
    <float name="fov" value="{fov}"/>
    <transform name="to_world"><lookat origin="{origin}" target="0, 0, 0" up="0, 1, 0"/></transform>
    <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
    <film type="hdrfilm">
      <integer name="width" value="$size"/><integer name="height" value="$size"/>
      <rfilter type="box"/><string name="component_format" value="float32"/>
    </film>
  </sensor>
  {emitters}
  <shape type="cube">
    <bsdf type="null"/>
    <medium type="heterogeneous" name="interior">
      <rgb name="albedo" value="{albedo}"/>
      <float name="scale" value="{scale}"/>
      <volume type="gridvolume" name="sigma_t">
        <string name="filename" value="density.vol"/>
        <transform name="to_world"><translate x="-0.5" y="-0.5" z="-0.5"/><scale value="2"/></transform>
      </volume>
      <phase type="hg"><float name="g" value="{g}"/></phase>
    </medium>
  </shape>
</scene>
"""


def write_scene(folder: Path, recipe: Recipe) -> None:
    """Write `scene.xml`, `density.vol` and, where the scene has one, `sky.exr` into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    sky = "envmap" in recipe.emitters
    xml = _XML.format(
        hide="true" if sky else "false", **{k: getattr(recipe, k) for k in ("fov", "origin", "emitters", "albedo", "scale", "g")}
    )
    _replace(folder / "scene.xml", xml.encode())
    write_vol(folder / "density.vol", Volume.from_box(recipe.density(), (0, 0, 0), (1, 1, 1)))
    if sky:
        image = sky_image()
        write_exr(folder / "sky.exr", {c: image[..., i] for i, c in enumerate("RGB")})


def _replace(path: Path, content: bytes) -> None:
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", delete=False) as file:
        file.write(content)
    os.chmod(file.name, 0o644)
    os.replace(file.name, path)


def render_references(folder: Path, spp: int) -> None:
    """Render `ref_a.exr` and `ref_b.exr` of a scene with Mitsuba's volpath and write `ref.json`; selects the variant scalar_rgb.

    Parameters
    ----------
    folder
        a folder with `scene.xml`.
    spp
        samples a pixel of each reference, rounded up to whole chunks of 64 with a seed each.
    """
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    chunks = max(1, -(-spp // _CHUNK))
    scene = mi.load_file(str(folder / "scene.xml"), size=str(_SIZE), spp=str(_CHUNK))
    for name, first in _SEEDS.items():
        total = np.zeros((_SIZE, _SIZE, 3))
        for chunk in range(chunks):
            total += np.asarray(mi.render(scene, spp=_CHUNK, seed=first + chunk), dtype=np.float64)[..., :3]
        image = total / chunks
        write_exr(folder / f"ref_{name}.exr", {c: image[..., i] for i, c in enumerate("RGB")}, {"spp": chunks * _CHUNK, "firstSeed": first})
    record = {
        "spp_each": chunks * _CHUNK,
        "size": _SIZE,
        "mitsuba": mi.__version__,
        "variant": "scalar_rgb",
        "integrator": "volpath",
        "seeds": f"a: {_SEEDS['a']} + chunk, b: {_SEEDS['b']} + chunk, chunks of {_CHUNK} spp",
    }
    _replace(folder / "ref.json", (json.dumps(record, indent=2) + "\n").encode())


def main(argv: Sequence[str] | None = None) -> int:
    """Write the scenes and render their references."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.make_scenes", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=HERE, help="folder for the scenes (default %(default)s)")
    parser.add_argument("--only", help=f"comma-separated names out of {', '.join(RECIPES)}")
    parser.add_argument(
        "--spp", type=int, default=1024, help="samples a pixel of each reference, times a factor of the scene (default %(default)s)"
    )
    parser.add_argument("--no-references", action="store_true", help="write the scenes only")
    options = parser.parse_args(argv)
    names = list(RECIPES) if options.only is None else options.only.split(",")
    unknown = [n for n in names if n not in RECIPES]
    if unknown or options.spp < 1:
        raise InputError(f"--only {','.join(unknown)}, --spp {options.spp}: scenes are {', '.join(RECIPES)}, and spp is at least 1")
    for name in names:
        write_scene(options.out / name, RECIPES[name])
        if not options.no_references:
            render_references(options.out / name, int(options.spp * RECIPES[name].spp_factor))
        print(f"wrote {options.out / name}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
