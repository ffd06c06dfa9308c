"""Memory: what this process took at most, and what a cloud will take."""

from __future__ import annotations

import sys
from contextlib import suppress
from pathlib import Path

from deepclouds.volume.bricks import BRICK_VOXELS, EDGE

# Bytes of the majorants of a brick, on both sides, and the edge of a brick of a dense grid's: see `deepclouds.medium.majorants`.
_MAJORANT, _MAJORANT_EDGE = 28, 4
# Bricks on the device to those of the file: beside them lie some that only interpolation reaches.
_BESIDE = 1.1


def peak_bytes() -> int:
    """Largest resident size that this process has had so far, in bytes."""
    import resource

    # Linux hands `ru_maxrss` on from the parent to a process that it starts; this line of its status begins anew with the program.
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith("VmHWM:"):
                return 1024 * int(line.split()[1])
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # Kilobytes but for macOS, which counts bytes.
    return largest if sys.platform == "darwin" else 1024 * largest


def field_bytes(voxels: int, bricks: int | None = None) -> int:
    """About the bytes that the extinction of a cloud takes in a render: density, samples on the device, majorants.

    Parameters
    ----------
    voxels
        of the whole box.
    bricks
        kept, for a cloud in bricks; None for a dense grid.
    """
    if bricks is None:
        return voxels * 2 * 4 + voxels // _MAJORANT_EDGE**3 * _MAJORANT
    # A brick as it is in the file, and as it is on the device with a sample more along each axis; then one entry of the table for each
    # brick of the box.
    return int(bricks * 4 * (BRICK_VOXELS + _BESIDE * (EDGE + 1) ** 3)) + voxels // BRICK_VOXELS * (4 + _MAJORANT)


def gib(count: float) -> str:
    """Bytes as text: ``1.25 GiB``, or ``12 MiB`` below a tenth of that."""
    return f"{count / 2**30:.2f} GiB" if count >= 2**30 / 10 else f"{count / 2**20:.3g} MiB"
