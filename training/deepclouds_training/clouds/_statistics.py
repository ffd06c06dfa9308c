"""What observers of real clouds measure, measured on a volume: cover, spread and spectrum of the columns, outline."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepclouds.volume import Volume
from deepclouds_training.clouds._raster import weighted_mean

# A column is cloudy above this share of the mean over all columns that are not empty.
_CLOUDY = 0.02


@dataclass(frozen=True)
class CloudStatistics:
    """Statistics of one cloud; columns are along the grid's y axis, and optical depths relative.

    Parameters
    ----------
    cover
        share of the plan view of the box that is cloudy.
    chi
        exp(mean(log tau)) / mean(tau) over cloudy columns: 1 for an even layer (Cahalan et al. 1994).
    nu
        mean(tau)^2 / variance(tau) over cloudy columns: the shape of a gamma distribution (Barker et al. 1996); infinite if even.
    slope
        exponent of the power spectrum of tau along the rows of the plan, for waves from a third of the box to 8 voxels.
    outline
        dimension of the outline of the plan view, from its length seen in blocks of 2, 4 and 8 voxels: 1 for a smooth one.
    mean_to_max
        extinction-weighted mean density over the maximum.
    filled
        share of the box's voxels that are not empty.
    aspect
        height over the greatest width of what is not empty.
    """

    cover: float
    chi: float
    nu: float
    slope: float
    outline: float
    mean_to_max: float
    filled: float
    aspect: float


def measure(volume: Volume) -> CloudStatistics:
    """Statistics of a volume that holds at least one voxel that is not empty."""
    tau = volume.density.sum(axis=1, dtype=np.float64)
    threshold = _CLOUDY * float(tau[tau > 0].mean())
    cloudy = tau > threshold
    inside = tau[cloudy]
    variance = float(inside.var())
    sides = []
    for axis in range(3):
        held = np.flatnonzero(volume.density.any(axis=tuple(a for a in range(3) if a != 2 - axis)))
        sides.append((held[-1] - held[0] + 1) * volume.voxel_size[axis])
    return CloudStatistics(
        cover=float(cloudy.mean()),
        chi=float(np.exp(np.log(inside).mean()) / inside.mean()),
        nu=float(inside.mean() ** 2 / variance) if variance > 1e-12 * inside.mean() ** 2 else float("inf"),
        slope=spectral_slope(tau),
        outline=outline_dimension(tau, threshold),
        mean_to_max=weighted_mean(volume.density),
        filled=float(np.count_nonzero(volume.density) / volume.density.size),
        aspect=float(sides[1] / max(sides[0], sides[2])),
    )


def spectral_slope(field: NDArray[np.float64]) -> float:
    """Exponent of the mean power spectrum of the rows of a plane (m, n), for waves from a third of a row to 8 samples, in octaves' halves.

    A Hann window keeps the jump between a row's ends out of the spectrum. NaN for rows of fewer than 48 samples, and even planes.
    """
    n = field.shape[1]
    if n < 48:
        return float("nan")
    power = (np.abs(np.fft.rfft((field - field.mean()) * np.hanning(n), axis=1)) ** 2).mean(axis=0)
    waves = np.arange(3, n // 8 + 1)
    if power[waves].min() <= 1e-20 * (field**2).sum():
        return float("nan")
    # Every half octave counts the same, however many waves it holds.
    bins = np.floor(2 * np.log2(waves / 3)).astype(int)
    per_bin = np.bincount(bins)
    held = per_bin > 0
    wave = np.bincount(bins, np.log(waves))[held] / per_bin[held]
    level = np.log(np.bincount(bins, power[waves])[held] / per_bin[held])
    return float(np.polyfit(wave, level, 1)[0])


def outline_dimension(columns: NDArray[np.float64], threshold: float) -> float:
    """Dimension of the outline of a plane (m, n) where it exceeds `threshold`: its length grows as block size to the power 1 - dimension.

    Sides of blocks count, so that a smooth outline of any form has the dimension 1. NaN where there is no outline.
    """
    lengths, blocks = [], (2, 4, 8)
    for side in blocks:
        m, n = (k // side for k in columns.shape)
        if min(m, n) < 4:
            return float("nan")
        mask = columns[: m * side, : n * side].reshape(m, side, n, side).mean(axis=(1, 3)) > threshold
        lengths.append(side * float(np.count_nonzero(mask[1:] != mask[:-1]) + np.count_nonzero(mask[:, 1:] != mask[:, :-1])))
    return 1 - float(np.polyfit(np.log(blocks), np.log(lengths), 1)[0]) if min(lengths) > 0 else float("nan")
