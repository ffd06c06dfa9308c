"""Cumulonimbus: a deep tower whose top spreads into an anvil below the tropopause."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from deepclouds_training.clouds._heap import HeapParameters, heap
from deepclouds_training.clouds._noise import Array, SmoothNoise, smoothstep
from deepclouds_training.clouds._parameters import Streams, number
from deepclouds_training.clouds._raster import Field, Grid
from deepclouds_training.clouds._turrets import bud
from deepclouds_training.clouds.congestus import tower


@dataclass(frozen=True, kw_only=True)
class CumulonimbusParameters(HeapParameters):
    """Parameters of a cumulonimbus."""

    mean_to_max: float = number(0.3, 0.6, "extinction-weighted mean density over the maximum")
    height: float = number(1.1, 2.0, "height of the anvil's top over the width of the base")
    shoulders: int = number(3, 8, "lower towers beside the main one", integer=True)
    shear: float = number(0.0, 0.3, "how far the top leans over the base, over the height")
    anvil: float = number(0.6, 1.6, "length of the anvil downwind of the tower over the height")
    anvil_thickness: float = number(0.14, 0.3, "thickness of the anvil near the tower over the height")
    anvil_density: float = number(0.1, 0.5, "density of the anvil over that of the tower's core", log=True)
    overshoot: float = number(0.0, 0.08, "how far domes rise above the anvil, over the height")


def build(parameters: CumulonimbusParameters, streams: Streams) -> Field:
    """Density of a cumulonimbus over space; the base lies at y = 0 and is about 1 wide, the anvil points toward +x."""
    rng = streams("towers")
    top = parameters.height
    trunk = tower(rng, top * (1 + parameters.overshoot), 7, parameters.shear, parameters.shoulders, waist=0.06)
    balls = bud(rng, trunk, 2, 7, 0.45, upward=0.3, floor=0.0)
    # Rain empties the upper half of the updraught: its water grows no more there.
    body = heap(balls, parameters, streams, turret=0.26, lid=0.5 * top)
    fibres, lumps, ragged = (SmoothNoise.draw(streams(name)) for name in ("fibres", "lumps", "ragged"))
    thick, down, up = parameters.anvil_thickness * top, parameters.anvil * top, 0.45 + 0.2 * parameters.anvil
    half_z = 0.45 + 0.35 * down
    middle = parameters.shear * top

    def evaluate(grid: Grid) -> Array:
        x, y, z = grid.open()
        plane = Grid(grid.x, np.full(1, top, np.float32), grid.z, grid.spacing)
        along = x - np.float32(middle)
        # The anvil widens downwind, as outflow does in a shear.
        wide = np.float32(half_z) * (1 + np.float32(0.35) * np.clip(along / np.float32(down), -1, 1))
        away = np.sqrt((along / np.where(along > 0, np.float32(down), np.float32(up))) ** 2 + (z / wide) ** 2)
        away = away + np.float32(0.13) * ragged.octaves(plane, 1.2, 7, 0.68, stretch=(2.5, 1, 1))
        # A wedge that tapers outward, and flares into the tower below.
        local = np.clip(1 - away, 0, 1) ** np.float32(0.6) * (np.float32(0.8) + np.float32(1.6) * np.exp(-((away / np.float32(0.3)) ** 2)))
        streaks = fibres.octaves(grid, 2.5, 6, 0.65, stretch=(3.5, 0.6, 1))
        # Mammatus: pouches that hang from the anvil's underside.
        pouch = np.float32(0.16) * np.abs(lumps.octaves(plane, 3.0, 3, 0.5))
        depth = np.minimum(
            np.float32(top) - y + np.float32(0.05 * thick) * streaks, y - np.float32(top) + np.float32(thick) * local * (1 + pouch)
        )
        edge = smoothstep(0.0, 0.3 * thick, depth + np.float32(0.06 * thick) * streaks * np.minimum(local * 4, 1)) * (local > 0)
        thin = np.clip(1 - np.float32(0.6) * away, 0.2, 1) * smoothstep(0.0, 0.5, 1 - away + np.float32(0.08) * streaks)
        anvil = np.float32(parameters.anvil_density) * edge * thin * np.exp(np.float32(0.45) * streaks)
        return np.asarray(np.maximum(body.evaluate(grid), anvil), np.float32)

    reach = (middle - 1.5 * up, top - 3 * thick, -1.9 * half_z), (middle + 1.5 * down, top + 0.3 * thick, 1.9 * half_z)
    return replace(
        body,
        lower=tuple(np.minimum(body.lower, reach[0])),
        upper=tuple(np.maximum(body.upper, reach[1])),
        evaluate=evaluate,
    )
