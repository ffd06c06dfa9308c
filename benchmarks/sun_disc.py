"""What is left out where multiple scattering takes a sun's disc for a point in its middle.

    python -m benchmarks.sun_disc [--rays 2500] [--walks 128] [--docs]

J at points that the camera sees, with the sun in the middle of its disc, and as the mean over directions drawn from it: by walks, connected
to all of these directions, and by the network, which has no noise but an error of its own. Two halves of the walks and of the directions
share nothing, so that the mean of the product of what they say is free of noise:

    point  = sqrt( max(0, mean( D_1 D_2 )) ) / mean( J )           energy = mean( D ) / mean( J ),   D = J(middle) - J(disc)

each with the standard error of groups of points.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import drjit as dr
import numpy as np
from deepclouds_runtime._mitsuba import mitsuba, types_of
from deepclouds_runtime.camera import Camera
from deepclouds_runtime.demo import DATA
from deepclouds_runtime.disc import Disc
from deepclouds_runtime.lights import Shade
from deepclouds_runtime.loading import load
from deepclouds_runtime.scattering import NetworkScattering
from deepclouds_runtime.scene_lights import Sun
from deepclouds_runtime.stratified import Stratified
from numpy.typing import NDArray

from benchmarks.page import write_results
from deepclouds.backend import rows
from deepclouds.errors import InputError
from deepclouds.medium.field import Field
from deepclouds.medium.first_collision import first_collisions
from deepclouds.medium.multiple_scattering import trace_walks
from deepclouds.medium.optical_depth import optical_depth

PAGE = Path(__file__).parents[1] / "docs" / "rendering.md"
# Azimuth and elevation; the camera stands at azimuth 0 and looks down by five degrees.
SUNS = {"from the side": (100.0, 35.0), "behind the camera": (20.0, 30.0), "ten degrees beside the view": (190.0, 5.0)}
DIAMETERS = (0.53, 5.0, 20.0)
# The network is told the whole depth toward the sun.
_DEEP = 1e6
# Directions drawn from a disc for each half of the walks, and groups of points.
_DRAWN, _GROUPS = 4, 20


@dataclass(frozen=True)
class View:
    """First collisions `points` (n, 3) of camera rays with directions `w` (n, 3) in the demo cloud, and what lights and describes it."""

    field: Field
    network: NetworkScattering
    sun: Sun
    phase: tuple[float, float, float]
    points: NDArray[np.float32]
    w: NDArray[np.float32]


def seen(sun: tuple[float, float], rays: int, seed: int) -> View:
    """What the demo's camera sees under a sun at azimuth and elevation, degrees."""
    side = round(math.sqrt(rays))
    renderer = load(DATA, sun=sun, sky=0.0, size=(side, side))
    scene, types = renderer.scene, types_of(mitsuba())
    assert renderer.predictor is not None
    field = Field(types, scene.volume, scene.scale)
    pixel, one = dr.arange(types.UInt32, side * side), dr.opaque(types.UInt32, 1)
    numbers = Stratified(types, pixel, dr.zeros(types.UInt32, side * side), one, dr.opaque(types.UInt32, seed))
    origin, direction, _ = Camera(types, scene.sensor).rays(pixel, numbers)
    o, d = (np.broadcast_to(rows(v), (side * side, 3)) for v in (origin, direction))
    points, hit = first_collisions(field, o, d, seed)
    return View(field, NetworkScattering(field, renderer.predictor), scene.suns[0], scene.phase, points[hit], d[hit])


def drawn(disc: Sun, n: int, random: np.random.Generator) -> NDArray[np.float32]:
    """Directions (n, `_DRAWN`, 3) from a disc, those of a point evenly around its middle: a slope across the disc cancels."""
    types = types_of(mitsuba())
    around = (random.random((n, 1)) + np.arange(_DRAWN) / _DRAWN) % 1
    u, v = (types.Float(np.minimum(t.ravel(), 1 - 1e-7).astype(np.float32)) for t in (np.repeat(random.random(n), _DRAWN), around))
    omega, _ = Disc(types, disc, Shade(types, None)).sample(u, v)
    return rows(omega).reshape(n, _DRAWN, 3)


Halves = tuple[NDArray[np.float64], NDArray[np.float64]]


def by_walks(view: View, disc: Sun, walks: int, random: np.random.Generator) -> tuple[Halves, float]:
    """What two halves of the walks say that J (n,) from the middle has too much, and the mean of J."""
    n, halves, mean = len(view.points), [], 0.0
    for _ in range(2):
        middle = np.broadcast_to(np.array(disc.omega_sun, np.float32), (n, _DRAWN, 3))
        values = trace_walks(
            view.field,
            view.points,
            view.w,
            np.broadcast_to(np.array(view.phase, np.float32), (n, 3)),
            np.concatenate([middle, drawn(disc, n, random)], axis=1),
            np.ones((n, 1), np.float32),
            walks // 2,
            int(random.integers(1 << 62)),
        )
        j = values.mean(axis=1, dtype=np.float64)[..., 0]
        halves.append(j[:, :_DRAWN].mean(axis=1) - j[:, _DRAWN:].mean(axis=1))
        mean += 0.5 * float(j.mean())
    return (halves[0], halves[1]), mean


def by_network(view: View, disc: Sun, random: np.random.Generator) -> tuple[Halves, float]:
    """The same of the network, the halves being directions from the disc."""
    types = view.field.types
    points, w = (types.Array3f(np.ascontiguousarray(v.T)) for v in (view.points, view.w))

    def ask(omega: NDArray[np.float32]) -> NDArray[np.float64]:
        toward = types.Array3f(np.ascontiguousarray(omega.T))
        tau = optical_depth(view.field, points, toward, types.Float(0), types.Float(math.inf), types.Bool(True), _DEEP)
        return view.network(points, w, toward, view.phase, (1.0,), tau)[:, 0].astype(np.float64)

    n = len(view.points)
    middle = ask(np.broadcast_to(np.array(disc.omega_sun, np.float32), (n, 3)))
    first, second = (middle - np.mean([ask(omega) for omega in drawn(disc, n, random).transpose(1, 0, 2)], axis=0) for _ in range(2))
    return (first, second), float(middle.mean())


def left_out(halves: Halves, mean: float) -> str:
    """Errors of a point and of the energy, with standard errors, in per cent of the mean."""
    n = len(halves[0])
    # Neighbouring rays go to different groups.
    groups = [np.arange(k, n, _GROUPS) for k in range(_GROUPS)]
    product = np.array([np.mean(halves[0][k] * halves[1][k]) for k in groups]) / mean**2
    energy = np.array([np.mean(halves[0][k] + halves[1][k]) for k in groups]) * 0.5 / mean
    point = math.sqrt(max(product.mean(), 0))
    spread = float(product.std(ddof=1)) / math.sqrt(_GROUPS)
    # Of the root; where the square is no more than noise, the root of that noise.
    of_point = spread / (2 * point) if product.mean() > spread else math.sqrt(spread)
    of_energy = float(energy.std(ddof=1)) / math.sqrt(_GROUPS)
    return f"{100 * point:.2g} +- {100 * of_point:.1g} | {100 * energy.mean():+.2g} +- {100 * of_energy:.1g}"


def main(argv: Sequence[str]) -> int:
    """Measure; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.sun_disc", description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--rays", type=int, default=2500, help="camera rays; about half of them meet the cloud (default %(default)s)")
    parser.add_argument("--walks", type=int, default=128, help="walks a point (default %(default)s)")
    parser.add_argument("--docs", action="store_true", help=f"write the table into {PAGE.name}")
    arguments = parser.parse_args(argv)
    table = [
        "| sun | its diameter | walks: a point % | energy % | network: a point % | energy % |",
        "|---|---|---|---|---|---|",
    ]
    for name, sun in SUNS.items():
        view = seen(sun, arguments.rays, 1)
        if len(view.points) < _GROUPS:
            raise InputError(f"--rays {arguments.rays}: {len(view.points)} of them meet the cloud, at least {_GROUPS} must; give more")
        for diameter in DIAMETERS:
            clock, random = time.process_time(), np.random.default_rng(2)
            disc = replace(view.sun, radius=math.radians(diameter / 2))
            found = [left_out(*by_walks(view, disc, arguments.walks, random)), left_out(*by_network(view, disc, random))]
            table.append(f"| {name} | {diameter:g} | {' | '.join(found)} |")
            print(f"{table[-1]} {time.process_time() - clock:.1f} s", flush=True)
    if arguments.docs:
        write_results(PAGE, "sun_disc", "\n".join(table))
    return 0


if __name__ == "__main__":
    try:
        raise SystemExit(main(sys.argv[1:]))
    except InputError as error:
        print(f"benchmarks.sun_disc: {error}", file=sys.stderr)
        raise SystemExit(2) from None
