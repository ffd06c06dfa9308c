"""A quick look at a volume: an orthographic march, one sun with shadows, a sky. For the eye, not for measuring."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, zoom

from deepclouds.volume import Volume

# Directions toward the eye. Straight up the world's Y cannot be the picture's up, so the view from the top leans by a millionth.
VIEWS = {"side": (0.25, 0.28, 1.0), "top": (0.0, 1.0, 1e-6)}
_SUN = (-0.75, 0.8, 0.75)
# Linear colours behind a cloud, at the picture's top and bottom.
_BEHIND = {"side": (np.array([0.24, 0.40, 0.66]), np.array([0.62, 0.74, 0.86])), "top": (np.array([0.03, 0.08, 0.14]),) * 2}


@dataclass(frozen=True)
class Row:
    """A row of a contact sheet: a title, labelled volumes, the optical depth of their thick columns and a view, "side" or "top"."""

    title: str
    clouds: Sequence[tuple[str, Volume]]
    optical_depth: float
    view: str = "side"


def _frame(toward: Sequence[float]) -> NDArray[np.float64]:
    """Rows right, up, toward: an orthonormal frame with a unit direction and the world's Y up."""
    axis = np.array(toward, np.float64) / np.linalg.norm(toward)
    right = np.cross((0.0, 1.0, 0.0), axis)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(axis, right), axis])


def _lattice(reach: float, side: float, n: int) -> NDArray[np.float32]:
    """Positions (3, n, n, n) along a frame's axes right, up (to `side`) and toward (to `reach`); the array runs toward, up, right."""
    t = ((np.arange(n) + 0.5) / n * 2 - 1).astype(np.float32)
    toward, up, right = np.meshgrid(t * np.float32(reach), t * np.float32(side), t * np.float32(side), indexing="ij")
    return np.stack([right, up, toward])


def _resample(volume: Volume, frame: NDArray[np.float64], lattice: NDArray[np.float32]) -> NDArray[np.float32]:
    """Density (n, n, n) at a frame's lattice."""
    inverse = np.linalg.inv(volume.to_world)
    turn = (inverse[:3, :3] @ frame.T).astype(np.float32)
    unit = np.tensordot(turn, lattice, axes=1) + inverse[:3, 3].astype(np.float32).reshape(3, 1, 1, 1)
    counts = np.array(volume.resolution, np.float32).reshape(3, 1, 1, 1)
    inside = np.all((unit >= 0) & (unit <= 1), axis=0)
    cells = (unit * counts - np.float32(0.5))[::-1]
    values = map_coordinates(volume.density, cells, order=1, mode="nearest")
    return np.asarray(np.where(inside, values, 0), np.float32)


def preview(volume: Volume, optical_depth: float = 25.0, size: int = 160, steps: int = 128, view: str = "side") -> NDArray[np.uint8]:
    """Render a volume of white scatterers against a sky, or from above against the sea.

    Single scattering with shadows toward a sun high on the left, two softened copies of it that stand for the light scattered on,
    and an ambient term that darkens with depth below the sky; no phase function.

    Parameters
    ----------
    optical_depth
        of a thick column: nine in ten of the vertical columns that hold any cloud are thinner.
    size
        pixels along both sides; the picture just holds the box.
    steps
        samples along each ray.
    view
        "side" or "top".

    Returns
    -------
    array (size, size, 3), uint8, sRGB.
    """
    lower, upper = volume.bounds
    reach = float(np.linalg.norm(upper - lower) / 2)
    columns = volume.density.sum(axis=1, dtype=np.float64) * volume.voxel_size[1]
    sigma = optical_depth / float(np.quantile(columns[columns > 0], 0.9))
    camera, sun, zenith = _frame(VIEWS[view]), _frame(_SUN), _frame((1e-6, 1.0, 1e-6))
    corners = np.array([[x, y, z] for x in (lower[0], upper[0]) for y in (lower[1], upper[1]) for z in (lower[2], upper[2])])
    side = 1.04 * float(np.abs(corners @ camera[:2].T).max())
    seen_at = _lattice(reach, side, steps)
    density = _resample(volume, camera, seen_at)
    h = 2 * reach / steps
    toward_sun = _depth_toward(volume, sun, reach, 112, camera, seen_at) * sigma
    toward_sky = _depth_toward(volume, zenith, reach, 64, camera, seen_at) * sigma
    light = 0.48 * np.exp(-toward_sun) + 0.2 * np.exp(-0.2 * toward_sun) + 0.08 * np.exp(-0.04 * toward_sun)
    ambient = 0.13 * np.exp(-0.15 * toward_sky) + 0.05
    # The lattice's first axis points toward the eye, so the march starts at its far end.
    tau = density[::-1] * np.float32(sigma * h)
    before = np.cumsum(tau, axis=0) - tau
    weight = np.exp(-before) * (1 - np.exp(-tau))
    colour = light[::-1, ..., None] * np.array([1.0, 0.97, 0.92]) + ambient[::-1, ..., None] * np.array([0.75, 0.88, 1.1])
    seen = (weight[..., None] * colour).sum(axis=0)
    behind = np.exp(-tau.sum(axis=0))[..., None]
    height = np.linspace(0, 1, steps)[:, None, None]
    top, low = _BEHIND[view]
    picture = seen + behind * (low * (1 - height) + top * height)
    picture = np.clip(picture, 0, 1)[::-1] ** (1 / 2.2)
    finer = zoom(picture, (size / steps, size / steps, 1), order=1, grid_mode=True, mode="nearest")
    return np.asarray(np.rint(finer * 255), np.uint8)


def _depth_toward(
    volume: Volume, frame: NDArray[np.float64], reach: float, n: int, camera: NDArray[np.float64], lattice: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Integral of the density from each position of the camera's lattice toward the frame's third axis."""
    density = _resample(volume, frame, _lattice(reach, reach, n))
    spacing = 2 * reach / n
    column = (np.cumsum(density[::-1], axis=0)[::-1] - 0.5 * density) * np.float32(spacing)
    there = np.tensordot((frame @ camera.T).astype(np.float32), lattice, axes=1)
    # A step and a half toward the light, so that the lattice's own steps do not shadow a surface.
    there[2] += np.float32(1.5 * spacing)
    cells = ((there / np.float32(reach) + 1) * np.float32(n / 2) - np.float32(0.5))[::-1]
    return np.asarray(map_coordinates(column, cells, order=1, mode="nearest"), np.float32)


def contact_sheet(rows: Sequence[Row], size: int = 160) -> NDArray[np.uint8]:
    """Previews in labelled rows: an image (height, width, 3), uint8."""
    from PIL import Image, ImageDraw, ImageFont

    columns = max(len(row.clouds) for row in rows)
    heading, gap = 18, 4
    sheet = Image.new("RGB", (columns * (size + gap) + gap, len(rows) * (size + heading + gap) + gap), (250, 250, 250))
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=12)
    for k, row in enumerate(rows):
        top = gap + k * (size + heading + gap)
        draw.text((gap + 2, top), row.title, fill=(20, 20, 20), font=font)
        for i, (label, volume) in enumerate(row.clouds):
            left = gap + i * (size + gap)
            sheet.paste(Image.fromarray(preview(volume, row.optical_depth, size, view=row.view)), (left, top + heading))
            draw.text((left + 4, top + heading + 2), label, fill=(255, 255, 255), font=font)
    return np.asarray(sheet)
