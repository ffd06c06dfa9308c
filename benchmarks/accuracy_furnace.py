"""White furnace: a cloud of albedo 1 in uniform light of radiance 1 is invisible, so every deviation from 1 is an error.

The light is an environment map that happens to be the same everywhere, so that the renderer splits it into directions, asks the network for
each of them, and cannot use that a uniform sky at albedo 1 has an answer in closed form.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from deepclouds_runtime.loading import load
from deepclouds_runtime.scattering import Predicts
from deepclouds_training.clouds import HELD_OUT, make_cloud
from numpy.typing import NDArray

from benchmarks.accuracy_figures import Row, bootstrap
from deepclouds.exr import write_exr
from deepclouds.volume import write_vol
from deepclouds.volume.pyramid import mean_extinction

Floats = NDArray[np.float64]
CLOUDS = 20
ASYMMETRIES = (0.0, 0.6, 0.85)
_FIRST_SEED = 7100
_SIZES = (5.0, 300.0)
_RESOLUTION = 64
_SIDE, _TILE = 96, 12
# Tiles with fewer counted pixels say little.
_LEAST = _TILE * _TILE // 4


@dataclass(frozen=True)
class FurnaceCloud:
    """One cloud: what it is, its size in mean free paths, g, and the means of its tiles (tiles, 2 seeds); those of corrected images too."""

    family: str
    seed: int
    size: float
    g: float
    tiles: Floats
    corrected: Floats | None = None

    @property
    def mean(self) -> float:
        """Mean deviation from 1."""
        return float(self.tiles.mean() - 1)

    @property
    def rms(self) -> float:
        """Root mean square deviation of the tiles from 1, free of noise."""
        return float(np.sqrt(max(0.0, float(np.mean((self.tiles[:, 0] - 1) * (self.tiles[:, 1] - 1))))))


def plan(clouds: int) -> list[tuple[str, int, float, float]]:
    """Family, seed, size in mean free paths and g of each cloud: families alternate, sizes are log-uniform, g cycles."""
    sizes = np.random.default_rng(_FIRST_SEED).permutation(np.geomspace(*_SIZES, CLOUDS))
    return [
        (HELD_OUT[i % len(HELD_OUT)], _FIRST_SEED + i, float(sizes[i]), ASYMMETRIES[i % len(ASYMMETRIES)])
        for i in range(min(clouds, CLOUDS))
    ]


def measure_furnace(predictor: Predicts, clouds: int, spp: int, progress: Callable[[str], None]) -> list[FurnaceCloud]:
    """Render each cloud twice with `spp` samples a pixel, by the network alone and corrected; clouds that cover no tile are left out."""
    done = []
    with tempfile.TemporaryDirectory() as folder:
        light, file = Path(folder) / "white.exr", Path(folder) / "cloud.vol"
        write_exr(light, {c: np.ones((16, 32), np.float32) for c in "RGB"})
        for family, seed, size, g in plan(clouds):
            volume = make_cloud(family, seed, _RESOLUTION)
            longest = float((volume.voxel_size * volume.resolution).max())
            write_vol(file, volume)
            renderer = load(
                file,
                predictor=predictor,
                extinction=size / (longest * mean_extinction(volume)),
                g=g,
                albedo=1.0,
                env=str(light),
                size=(_SIDE, _SIDE),
                view=(37.0 * seed % 360, 5.0),
            )
            alone, corrected = (
                [renderer.render(spp, 2 * seed + repeat, correct=correct) for repeat in range(2)] for correct in (False, True)
            )
            opaque = np.asarray(0.5 * (alone[0].channels["volume_opacity"] + alone[1].channels["volume_opacity"]), np.float64) > 0.5
            tiles = (tile_means([np.asarray(r.rgb, np.float64) for r in results], opaque) for results in (alone, corrected))
            cloud = FurnaceCloud(family, seed, size, g, *tiles)
            progress(f"furnace  {family} {seed}, {size:.0f} mean free paths, g {g}: {len(cloud.tiles)} tiles")
            if len(cloud.tiles):
                done.append(cloud)
    return done


def tile_means(images: list[Floats], counts: NDArray[np.bool_]) -> Floats:
    """Means of images (h, w, c) over the counted pixels of every 12 x 12 tile with at least a quarter of them: (tiles, images)."""

    def sums(values: Floats) -> Floats:
        h, w = values.shape[0] // _TILE, values.shape[1] // _TILE
        total: Floats = values.reshape(h, _TILE, w, _TILE).sum(axis=(1, 3)).ravel()
        return total

    number = sums(counts.astype(np.float64))
    full = number >= _LEAST
    return np.stack([(sums(np.where(counts, image.mean(axis=2), 0.0))[full] / number[full]) for image in images], axis=1)


def furnace_rows(clouds: list[FurnaceCloud]) -> list[Row]:
    """Rms and mean deviation of all tiles, by g, and of corrected images; intervals are over clouds."""

    def row(part: str, name: str, chosen: list[FurnaceCloud]) -> Row:
        # Per cloud: tiles, sums of the deviation, of the product of both seeds' deviations, and of their squared difference.
        cases = np.array(
            [
                [len(c.tiles), (c.tiles - 1).mean(axis=1).sum(), np.prod(c.tiles - 1, axis=1).sum(), np.square(np.diff(c.tiles)).sum() / 4]
                for c in chosen
            ]
        )

        def root(column: int) -> Callable[[Floats], Floats]:
            return lambda v: np.sqrt(np.maximum(v[..., column].sum(axis=1), 0) / v[..., 0].sum(axis=1))

        figures = {
            "rms": bootstrap(cases, root(2)),
            "mean": bootstrap(cases, lambda v: v[..., 1].sum(axis=1) / v[..., 0].sum(axis=1), signed=True),
            "noise taken out": bootstrap(cases, root(3)),
        }
        return Row(part, f"{name}, {len(chosen)} clouds", figures)

    groups = [(f"g {g}", [c for c in clouds if c.g == g]) for g in ASYMMETRIES]
    corrected = [replace(c, tiles=c.corrected) for c in clouds if c.corrected is not None]
    return [
        row("furnace", "all", clouds),
        *(row("furnace", name, chosen) for name, chosen in groups if chosen),
        *([row("furnace, corrected", "all", corrected)] if corrected else []),
    ]
