"""What stays the same over a sequence of volumes: extinction, unit of length, alignment of the filter, and what the camera frames.

All of it comes from the sequence's key frames, whichever frames are asked for: machines that render parts of one sequence agree, and no
frame is darker or nearer than the next because its own densest voxel or its own box is another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deepclouds.errors import EmptyGridError, InputError
from deepclouds.volume import Volume, read_volume
from deepclouds.volume.pyramid import mean_extinction, volume_frame
from deepclouds_runtime.volume_scene import VolumeOptions, check, extinction, framed_corners


@dataclass(frozen=True)
class Fixed:
    """What is fixed over a sequence.

    Attributes
    ----------
    extinction
        at density 1, 1 / world length: as asked, or such that none of the key frames is optically deeper than asked.
    unit
        unit of length, world units: the mean free path at the extinction-weighted mean extinction of all key frames.
    origin
        (3,) world point that the cells of filter and octree are aligned to: the first key frame's centre of mass.
    corners
        (n, 3) world points that the camera frames: those of all key frames.
    longest
        longest side of the boxes of all key frames, world units: with it goes whether the network knows clouds of this size.
    """

    extinction: float
    unit: float
    origin: NDArray[np.float64]
    corners: NDArray[np.float64]
    longest: float


def fixed_by(files: Sequence[Path], options: VolumeOptions, grid: str | None = None, clamp: bool = False) -> Fixed:
    """Read the key frames one after the other and keep what is fixed.

    Parameters
    ----------
    files
        the key frames; empty ones do not count.
    options
        what was asked; of interest are `optical_depth` and `extinction`.
    grid, clamp
        as for `deepclouds.volume.read_volume`.

    Raises
    ------
    InputError
        for options out of range, when all key frames are empty, and for what the readers refuse.
    """
    check(options)
    scales, masses, means, corners, longest = [], [], [], [], 0.0
    origin = None
    for file in files:
        volume = read_frame(file, grid, clamp)
        mean = 0.0 if volume is None else mean_extinction(volume)
        if volume is None or mean == 0:
            continue
        if origin is None:
            origin = volume_frame(volume).origin
        scales.append(extinction(volume, options, str(file)))
        masses.append(float(volume.stored.sum(dtype=np.float64)) * float(np.prod(volume.voxel_size)))
        means.append(mean)
        corners.append(framed_corners(volume))
        longest = max(longest, float(np.linalg.norm(volume.to_world[:3, :3], axis=0).max()))
    if origin is None:
        names = ", ".join(file.name for file in files)
        raise InputError(f"{names}: the frames that fix extinction and camera of the sequence are empty; leave empty frames out of it")
    scale = min(scales)
    mean = float(np.average(means, weights=masses)) * scale
    return Fixed(scale, 1 / mean if mean > 0 else 1.0, origin, np.concatenate(corners), longest)


def read_frame(file: Path, grid: str | None = None, clamp: bool = False) -> Volume | None:
    """The density of one frame of a sequence; None where its grid has no active voxel, and so not even a box."""
    try:
        return read_volume(file, grid, clamp)
    except EmptyGridError:
        return None


def without_cloud(fixed: Fixed) -> Volume:
    """What stands for a frame without a voxel: an empty box around what the camera frames."""
    return Volume.from_box(np.zeros((2, 2, 2), np.float32), fixed.corners.min(axis=0), fixed.corners.max(axis=0))


def with_extinction(options: VolumeOptions, fixed: Fixed) -> VolumeOptions:
    """The options with the sequence's extinction in place of each frame's own."""
    return replace(options, optical_depth=None, extinction=fixed.extinction)
