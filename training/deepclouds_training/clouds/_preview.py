"""A quick look at a volume: an orthographic march, one sun with shadows, a sky. For the eye, not for measuring."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from deepclouds.volume import Volume

_VIEW = (0.25, 0.28, 1.0)
_SUN = (-0.75, 0.8, 0.75)
_SKY_TOP, _SKY_LOW = np.array([0.24, 0.40, 0.66]), np.array([0.62, 0.74, 0.86])


def _frame(toward: Sequence[float]) -> NDArray[np.float64]:
    """Rows right, up, toward: an orthonormal frame with a unit direction and the world's Y up."""
    axis = np.array(toward, np.float64) / np.linalg.norm(toward)
    right = np.cross((0.0, 1.0, 0.0), axis)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(axis, right), axis])


def _resample(volume: Volume, frame: NDArray[np.float64], reach: float, n: int) -> NDArray[np.float32]:
    """Density on a lattice (n, n, n) along the frame's axes (toward, up, right), spanning -reach to reach."""
    t = ((np.arange(n) + 0.5) / n * 2 - 1) * reach
    toward, up, right = np.meshgrid(t, t, t, indexing="ij")
    inverse = np.linalg.inv(volume.to_world)
    turn = inverse[:3, :3] @ frame.T
    unit = np.tensordot(turn, np.stack([right, up, toward]), axes=1) + inverse[:3, 3].reshape(3, 1, 1, 1)
    counts = np.array(volume.resolution).reshape(3, 1, 1, 1)
    inside = np.all((unit >= 0) & (unit <= 1), axis=0)
    cells = (unit * counts - 0.5)[::-1]
    values = map_coordinates(volume.density, cells, order=1, mode="nearest")
    return np.asarray(np.where(inside, values, 0), np.float32)


def preview(volume: Volume, optical_depth: float = 40.0, size: int = 160, steps: int = 160) -> NDArray[np.uint8]:
    """Render a volume of white scatterers against a sky.

    Single scattering with shadows toward a sun high on the left, two softened copies of it that stand for the light scattered on,
    and an ambient term that darkens with depth below the sky; no phase function.

    Parameters
    ----------
    optical_depth
        of a ray through the world's length 2 at the extinction-weighted mean density.
    size
        pixels along both sides; the view spans the volume's largest radius.

    Returns
    -------
    array (size, size, 3), uint8, sRGB.
    """
    lower, upper = volume.bounds
    reach = float(np.linalg.norm(upper - lower) / 2)
    flat = volume.density.astype(np.float64)
    sigma = optical_depth / 2 * flat.sum() / (flat**2).sum()
    camera, sun, zenith = _frame(_VIEW), _frame(_SUN), _frame((1e-6, 1.0, 1e-6))
    density = _resample(volume, camera, reach, steps)
    h = 2 * reach / steps
    toward_sun = _depth_toward(volume, sun, reach, 112, camera, steps) * sigma
    toward_sky = _depth_toward(volume, zenith, reach, 72, camera, steps) * sigma
    light = 0.75 * np.exp(-toward_sun) + 0.28 * np.exp(-0.2 * toward_sun) + 0.12 * np.exp(-0.04 * toward_sun)
    ambient = 0.22 * np.exp(-0.15 * toward_sky) + 0.07
    # The lattice's first axis points toward the eye, so the march starts at its far end.
    tau = density[::-1] * np.float32(sigma * h)
    before = np.cumsum(tau, axis=0) - tau
    weight = np.exp(-before) * (1 - np.exp(-tau))
    colour = light[::-1, ..., None] * np.array([1.0, 0.97, 0.92]) + ambient[::-1, ..., None] * np.array([0.75, 0.88, 1.1])
    seen = (weight[..., None] * colour).sum(axis=0)
    behind = np.exp(-tau.sum(axis=0))[..., None]
    height = np.linspace(0, 1, steps)[:, None, None]
    picture = seen + behind * (_SKY_LOW * (1 - height) + _SKY_TOP * height)
    picture = np.clip(picture, 0, 1)[::-1] ** (1 / 2.2)
    rows = (np.arange(size) * steps) // size
    return np.asarray(np.rint(picture[rows][:, rows] * 255), np.uint8)


def _depth_toward(
    volume: Volume, frame: NDArray[np.float64], reach: float, n: int, camera: NDArray[np.float64], steps: int
) -> NDArray[np.float32]:
    """Integral of the density from each sample of the camera's lattice toward the frame's third axis."""
    density = _resample(volume, frame, reach, n)
    spacing = 2 * reach / n
    column = (np.cumsum(density[::-1], axis=0)[::-1] - 0.5 * density) * np.float32(spacing)
    t = ((np.arange(steps) + 0.5) / steps * 2 - 1) * reach
    toward, up, right = np.meshgrid(t, t, t, indexing="ij")
    there = np.tensordot(frame @ camera.T, np.stack([right, up, toward]), axes=1)
    cells = ((there / reach + 1) / 2 * n - 0.5)[::-1]
    return np.asarray(map_coordinates(column, cells, order=1, mode="nearest"), np.float32)


def contact_sheet(rows: Sequence[tuple[str, Sequence[tuple[str, Volume]]]], size: int = 160) -> NDArray[np.uint8]:
    """Previews in labelled rows: each row a title and its (label, volume) pairs; returns an image (height, width, 3), uint8."""
    from PIL import Image, ImageDraw, ImageFont

    columns = max(len(row) for _, row in rows)
    heading, gap = 18, 4
    sheet = Image.new("RGB", (columns * (size + gap) + gap, len(rows) * (size + heading + gap) + gap), (250, 250, 250))
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=12)
    for k, (title, row) in enumerate(rows):
        top = gap + k * (size + heading + gap)
        draw.text((gap + 2, top), title, fill=(20, 20, 20), font=font)
        for i, (label, volume) in enumerate(row):
            left = gap + i * (size + gap)
            sheet.paste(Image.fromarray(preview(volume, size=size)), (left, top + heading))
            draw.text((left + 4, top + heading + 2), label, fill=(255, 255, 255), font=font)
    return np.asarray(sheet)
