"""`deepclouds compare`: the figures of one image against references, and a map of where it errs."""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepclouds.errors import InputError
from deepclouds.exr import read_exr, srgb, tone_map, write_png_bytes
from deepclouds.metrics import ErrorReport, bright_mask, error_report, finite_image, to_reference_size
from deepclouds.replacing import replacing


def main(argv: Sequence[str], prog: str = "deepclouds compare") -> int:
    """Print the error of an image against one or two references; returns 0, raises InputError for bad input."""
    parser = argparse.ArgumentParser(
        prog=prog,
        description="Error of an image against one or two references, with intervals. Two independent references (their seeds differ "
        "from each other and from the image's) make the figures free of the references' own noise.",
    )
    parser.add_argument("image", metavar="IMAGE", help="the image to judge (.exr); a multiple of the references' size is averaged")
    parser.add_argument("--ref", metavar="EXR", action="append", required=True, help="a reference (.exr); give it twice for A and B")
    parser.add_argument("--noise", metavar="EXR", help="the same image from another seed: reports the noise and the error of one pixel")
    parser.add_argument("--layer", metavar="NAME", help="layer of IMAGE that holds the colours, where the file has several")
    parser.add_argument("--map", metavar="PNG", type=Path, help="write image, reference and signed relative error side by side")
    parser.add_argument("--tile", type=int, default=12, help="side of the tiles for the worst tile, pixels (default %(default)s)")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of text")
    options = parser.parse_args(argv)
    if len(options.ref) > 2:
        raise InputError(f"--ref was given {len(options.ref)} times; one or two references make sense")

    image = finite_image(read_exr(options.image).rgb(options.layer), options.image)
    references = [finite_image(read_exr(path).rgb(), path) for path in options.ref]
    if len(references) == 2 and references[0].shape == references[1].shape and np.array_equal(references[0], references[1]):
        raise InputError(f"{options.ref[0]} and {options.ref[1]} are the same image; independent references come from different seeds")
    second_seed = None
    if options.noise is not None:
        second_seed = read_exr(options.noise).rgb(options.layer)
        if second_seed.shape == image.shape and np.array_equal(second_seed, image):
            raise InputError(f"{options.noise} equals {options.image}: --noise needs another seed")
    report = error_report(
        to_reference_size(image, references[0], options.image) if second_seed is None else image,
        *references,
        second_seed=second_seed,
        flip=find_spec("flip_evaluator") is not None,
        tile=options.tile,
    )
    if options.map is not None:
        write_error_map(options.map, image, *references)
    if options.json:
        print(json.dumps({"image": options.image, "references": options.ref, **report.as_dict()}))
    else:
        print(describe(report))
        if options.map is not None:
            print(f"wrote {options.map}")
    return 0


def describe(report: ErrorReport) -> str:
    """Put the report into lines of text, in per cent."""

    def interval(bounds: tuple[float, float]) -> str:
        return f"[{100 * bounds[0]:.2f}, {100 * bounds[1]:.2f}]"

    row, column = report.worst_tile_at
    lines = [
        f"rRMSE          {100 * report.rrmse:7.2f} %   {interval(report.rrmse_interval)}",
        f"energy         {100 * report.energy:+7.2f} %   {interval(report.energy_interval)}",
        f"darkest third  {100 * report.dark_energy:+7.2f} %   {interval(report.dark_energy_interval)}",
        f"worst tile     {100 * report.worst_tile:+7.2f} %   energy; first pixel at row {row}, column {column}",
    ]
    if report.noise is not None:
        lines.append(f"noise          {100 * report.noise:7.2f} %   of one value at the references' size, from two seeds")
    if report.pixel_error is not None and report.pixel_error_interval is not None:
        own = f"{interval(report.pixel_error_interval)}   rRMSE, and the noise at the image's own size"
        lines.append(f"error, a pixel {100 * report.pixel_error:7.2f} %   {own}")
    lines.append(
        f"FLIP           {report.flip:7.4f}"
        if report.flip is not None
        else "FLIP            not computed: the package 'flip-evaluator' is missing"
    )
    blocks = f"{report.block} x {report.block} pixels" if report.block > 1 else "single pixels"
    lines.append(
        f"{100 * report.confidence:g} % intervals, bootstrap over blocks of {blocks}; {report.values} values brighter than 2 % of the peak"
    )
    if not report.independent:
        lines.append("One reference only: the figures INCLUDE the reference's own noise. Give a second, independent --ref to be rid of it.")
    return "\n".join(lines)


def relative_error(image: ArrayLike, a: ArrayLike, b: ArrayLike | None = None) -> NDArray[np.float64]:
    """Signed error of each pixel (h, w), channels averaged, over the reference; 0 outside the mask of the figures.

    The denominator is the pixel's reference, but at least a tenth of the masked mean: a nearly black pixel would outshine the rest.
    """
    first = finite_image(a, "reference A")
    second = first if b is None else finite_image(b, "reference B")
    pixels = to_reference_size(image, first)
    mask = bright_mask(first, second).any(axis=2)
    middle = ((first + second) / 2).mean(axis=2)
    error: NDArray[np.float64] = (pixels.mean(axis=2) - middle) / np.maximum(middle, 0.1 * middle[mask].mean())
    return np.where(mask, error, 0.0)


def write_error_map(path: str | os.PathLike[str], image: ArrayLike, a: ArrayLike, b: ArrayLike | None = None) -> None:
    """Write a PNG: image, reference and signed relative error (blue too dark, red too bright) with a labelled scale.

    Uses matplotlib where it is installed and plain arrays with pillow where it is not. The scale reaches the 99th percentile of the
    error's magnitude, rounded up to a whole 5 %.

    Raises
    ------
    InputError
        when the images do not fit each other or the file cannot be written.
    """
    first = finite_image(a, "reference A")
    middle = first if b is None else (first + finite_image(b, "reference B")) / 2
    error = relative_error(image, a, b)
    pixels = to_reference_size(image, first)
    shown = error[error != 0]
    limit = max(0.05, float(np.ceil(20 * np.quantile(np.abs(shown), 0.99)) / 20)) if shown.size else 0.05
    # Both pictures get the exposure that puts the reference's bright pixels at middle white.
    exposure = float(-np.log2(max(float(np.percentile(middle, 99)), 1e-12)))
    pictures = [
        srgb(tone_map(np.broadcast_to(p, (*p.shape[:2], 3)) if p.shape[2] == 1 else p[..., :3], exposure)) for p in (pixels, middle)
    ]
    if find_spec("matplotlib") is not None:
        _map_with_matplotlib(path, pictures, error, limit)
    else:
        _map_with_pillow(path, pictures, error, limit)


def diverging(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Colours (..., 3) in [0, 1] for values in [-1, 1]: blue, white at 0, red."""
    v = np.clip(values, -1.0, 1.0)[..., None]
    white, blue, red = np.ones(3), np.array([0.13, 0.30, 0.66]), np.array([0.70, 0.07, 0.13])
    colours: NDArray[np.float64] = white + np.abs(v) * (np.where(v < 0, blue, red) - white)
    return colours


def _map_with_matplotlib(
    path: str | os.PathLike[str], pictures: list[NDArray[np.float64]], error: NDArray[np.float64], limit: float
) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize
    from matplotlib.figure import Figure

    # A figure of its own, without pyplot: no global state, no display.
    figure = Figure(figsize=(11, 3.6), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 3)
    colours = ListedColormap(list(diverging(np.linspace(-1, 1, 255))))
    for axis, picture, title in zip(axes, [*pictures, diverging(error / limit)], ["image", "reference", "error / reference"], strict=True):
        axis.imshow(picture, interpolation="nearest")
        axis.set_title(title)
        axis.set_axis_off()
    bar = figure.colorbar(ScalarMappable(Normalize(-100 * limit, 100 * limit), colours), ax=axes[2])
    bar.set_label("too dark    % of the reference    too bright")
    with replacing(path, ".png") as temporary:
        figure.savefig(temporary, format="png")


def _map_with_pillow(path: str | os.PathLike[str], pictures: list[NDArray[np.float64]], error: NDArray[np.float64], limit: float) -> None:
    from PIL import Image, ImageDraw

    scale = max(1, -(-240 // error.shape[0]))
    panels = [np.repeat(np.repeat(p, scale, axis=0), scale, axis=1) for p in (*pictures, diverging(error / limit))]
    height = panels[0].shape[0]
    ramp = np.broadcast_to(diverging(np.linspace(1, -1, height))[:, None], (height, 14, 3))
    gap, margin, labels = np.ones((height, 8, 3)), 18, 60
    row = np.concatenate([panels[0], gap, panels[1], gap, panels[2], gap, ramp, np.ones((height, labels, 3))], axis=1)
    page = np.concatenate([np.ones((margin, row.shape[1], 3)), row, np.ones((margin, row.shape[1], 3))])
    picture = Image.fromarray(np.rint(255 * page).astype(np.uint8))
    draw = ImageDraw.Draw(picture)
    for index, title in enumerate(("image", "reference", "error / reference")):
        draw.text((index * (panels[0].shape[1] + 8), 2), title, fill=(0, 0, 0))
    x = row.shape[1] - labels + 4
    for fraction in (1.0, 0.5, 0.0, -0.5, -1.0):
        draw.text((x, margin + (1 - fraction) / 2 * (height - 1) - 6), f"{100 * limit * fraction:+.3g} %", fill=(0, 0, 0))
    write_png_bytes(path, np.asarray(picture))
