"""How far an image is from the truth: errors free of the references' own noise, with intervals, and tests of equality.

The convention throughout: ``image`` is the picture under judgement, ``a`` and ``b`` are two independent unbiased references that
share no random number with it or with each other. Where only one reference exists its noise is part of every figure, and the report
says so. All values are linear radiance, arrays of shape (h, w) or (h, w, channels).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepclouds.errors import InputError

Floats = NDArray[np.float64]
Interval = tuple[float, float]

_FLOOR = 0.02
_PERCENTILE = 99.9
_MIN_BLOCKS = 16


@dataclass(frozen=True)
class ErrorReport:
    """Figures of one image against its references; every interval is a bootstrap over blocks of pixels.

    Parameters
    ----------
    rrmse, rrmse_interval
        ``sqrt(max(0, mean((I - A)(I - B)))) / mean((A + B) / 2)`` over the mask.
    energy, energy_interval
        ``mean(I) / mean((A + B) / 2) - 1`` over the mask.
    worst_tile, worst_tile_at
        energy error of the tile where it is largest in magnitude, and (row, column) of that tile's first pixel.
    dark_energy, dark_energy_interval
        energy error of the darkest third of the mask.
    reference_mean
        mean of (A + B) / 2 over the mask, the unit of the figures above.
    values
        how many values (pixels times channels) lie in the mask.
    independent
        False when there was one reference only: the figures then include its noise.
    noise
        standard deviation of one value between two seeds, over `reference_mean`, at the references' size; None without a second seed.
    pixel_error, pixel_error_interval
        error of a pixel of the image as it is, of which `rrmse` sees averages only where it is larger than the references:
        ``sqrt(rrmse^2 + n^2 - noise^2)`` with n the noise of one value at the image's own size. What a box averages away besides noise is
        left out. None without a second seed.
    flip
        mean HDR-FLIP of the image against (A + B) / 2; None when not computed.
    confidence, block
        level of the intervals, and the side in pixels of the blocks that were resampled.
    """

    rrmse: float
    rrmse_interval: Interval
    energy: float
    energy_interval: Interval
    worst_tile: float
    worst_tile_at: tuple[int, int]
    dark_energy: float
    dark_energy_interval: Interval
    reference_mean: float
    values: int
    independent: bool
    noise: float | None
    pixel_error: float | None
    pixel_error_interval: Interval | None
    flip: float | None
    confidence: float
    block: int

    def as_dict(self) -> dict[str, object]:
        """Plain dictionary for JSON."""
        return asdict(self)


def finite_image(image: ArrayLike, name: str = "image") -> Floats:
    """Check an image and return it as float64 array (h, w, channels).

    Raises
    ------
    InputError
        when it is not an image or holds NaN or Inf; the message counts them.
    """
    pixels = np.asarray(image, dtype=np.float64)
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.ndim != 3 or pixels.size == 0:
        raise InputError(f"{name}: an image has shape (h, w) or (h, w, channels), got {np.shape(image)}")
    nans, infinities = int(np.count_nonzero(np.isnan(pixels))), int(np.count_nonzero(np.isinf(pixels)))
    if nans or infinities:
        raise InputError(f"{name}: {nans} NaN and {infinities} infinite of {pixels.size} values; render it again, no figure can be trusted")
    return pixels


def box_average(image: ArrayLike, factor: int) -> Floats:
    """Mean over boxes of `factor` x `factor` pixels: (h, w, ...) -> (h / factor, w / factor, ...), exactly what a box filter records.

    Raises
    ------
    InputError
        when a side is not a multiple of `factor`.
    """
    pixels = np.asarray(image, dtype=np.float64)
    if factor < 1 or pixels.ndim < 2 or pixels.shape[0] % factor or pixels.shape[1] % factor:
        raise InputError(f"an image of shape {pixels.shape} does not divide into boxes of {factor} x {factor} pixels")
    h, w = pixels.shape[0] // factor, pixels.shape[1] // factor
    averaged: Floats = pixels.reshape(h, factor, w, factor, *pixels.shape[2:]).mean(axis=(1, 3))
    return averaged


def to_reference_size(image: ArrayLike, reference: ArrayLike, name: str = "image") -> Floats:
    """Bring an image to the reference's size: as it is, or averaged over exact boxes when it is an integer multiple of it.

    Returns
    -------
    numpy.ndarray
        float64 (h, w, channels).

    Raises
    ------
    InputError
        when the shapes do not fit, or the image holds NaN or Inf.
    """
    pixels, target = finite_image(image, name), finite_image(reference, "reference")
    (h, w, c), (rows, columns, channels) = pixels.shape, target.shape
    if c != channels:
        raise InputError(f"{name}: {c} channels, but the reference has {channels}")
    factor = h // rows
    if factor < 1 or (h, w) != (rows * factor, columns * factor):
        raise InputError(
            f"{name}: {w} x {h} pixels is neither the references' {columns} x {rows} nor an integer multiple; render at such a size"
        )
    return box_average(pixels, factor)


def bright_mask(a: ArrayLike, b: ArrayLike) -> NDArray[np.bool_]:
    """Values of (A + B) / 2 above 2 % of its 99.9th percentile, over all channels: boolean (h, w, channels).

    Raises
    ------
    InputError
        when nothing exceeds it (a black reference), or the references do not fit each other.
    """
    first, second = _pair(a, b)
    middle = (first + second) / 2
    mask: NDArray[np.bool_] = middle > _FLOOR * np.percentile(middle, _PERCENTILE)
    if not mask.any() or middle[mask].mean() <= 0:
        raise InputError("the references are black: there is nothing to compare with")
    return mask


def rrmse(image: ArrayLike, a: ArrayLike, b: ArrayLike) -> float:
    """Relative root mean square error, free of the noise of two independent references: see `ErrorReport`.

    The product ``(I - A)(I - B)`` has the expectation ``(I - truth)^2`` because the noises of A and B are independent, so a perfect
    image scores 0 up to chance, however noisy the references are.
    """
    return error_report(image, a, b, resamples=0).rrmse


def energy_error(image: ArrayLike, a: ArrayLike, b: ArrayLike) -> float:
    """Relative error of the image's mean over the mask: see `ErrorReport`."""
    return error_report(image, a, b, resamples=0).energy


def error_report(
    image: ArrayLike,
    a: ArrayLike,
    b: ArrayLike | None = None,
    *,
    second_seed: ArrayLike | None = None,
    flip: bool = False,
    tile: int = 12,
    block: int = 8,
    resamples: int = 2000,
    confidence: float = 0.95,
    seed: int = 0,
) -> ErrorReport:
    """All figures of one image.

    Parameters
    ----------
    image
        (h, w) or (h, w, channels); an integer multiple of the references' size is averaged over exact boxes first.
    a, b
        two independent references of one shape. Without `b` the figures include the noise of `a`.
    second_seed
        the same image from another seed, of the same size as `image`: gives `ErrorReport.noise` and `ErrorReport.pixel_error`.
    flip
        compute HDR-FLIP (needs the package ``flip-evaluator``).
    tile
        side of the tiles of `worst_tile`, pixels. Tiles with less than a quarter of their values in the mask are left out as long as
        one is fuller: three pixels at a silhouette say nothing about a renderer.
    block
        side of the blocks that the bootstrap resamples, pixels. Errors of a network or a denoiser are correlated between neighbours,
        so blocks are resampled with replacement, not pixels; when fewer than 16 blocks hold masked pixels the block becomes one
        pixel. The interval speaks of where in the picture the error was looked for, not of other scenes.
    resamples, confidence, seed
        number of bootstrap resamples (0: no intervals, they are NaN), level of the percentile interval, seed of the resampling.

    Raises
    ------
    InputError
        for NaN or Inf (with counts), shapes that do not fit, black references.
    """
    first, second = _pair(a, a if b is None else b)
    pixels = to_reference_size(image, first)
    mask = bright_mask(first, second)
    middle = (first + second) / 2

    dark_image, dark_reference = _dark_third(pixels, first, second, mask)
    fields = [
        np.where(mask, (pixels - first) * (pixels - second), 0.0),
        np.where(mask, pixels, 0.0),
        np.where(mask, middle, 0.0),
        mask.astype(np.float64),
        dark_image,
        dark_reference,
    ]
    planes = np.stack([f.sum(axis=2) for f in fields])
    figures = _figures(planes.sum(axis=(1, 2))[:, None])[:, 0]
    intervals, used = _bootstrap(planes, block, resamples, confidence, seed)
    worst, where = worst_tile(pixels, first, second, tile)

    noise = pixel_error = pixel_interval = None
    if second_seed is not None:
        if np.shape(second_seed) != np.shape(image):
            raise InputError(
                f"second seed: shape {np.shape(second_seed)} differs from the image's {np.shape(image)}; render both at one size"
            )
        noise = pixel_noise(pixels, to_reference_size(second_seed, first, "second seed"), first, second)
        factor = np.shape(image)[0] // mask.shape[0]
        own = finite_image(image), finite_image(second_seed, "second seed")
        finer = max(0.0, _noise(*own, mask.repeat(factor, axis=0).repeat(factor, axis=1)) ** 2 / middle[mask].mean() ** 2 - noise**2)
        pixel_error, *ends = (float(np.hypot(e, np.sqrt(finer))) for e in (figures[0], *intervals[0]))
        pixel_interval = (ends[0], ends[1])
    return ErrorReport(
        rrmse=float(figures[0]),
        rrmse_interval=intervals[0],
        energy=float(figures[1]),
        energy_interval=intervals[1],
        worst_tile=worst,
        worst_tile_at=where,
        dark_energy=float(figures[2]),
        dark_energy_interval=intervals[2],
        reference_mean=float(middle[mask].mean()),
        values=int(mask.sum()),
        independent=b is not None,
        noise=noise,
        pixel_error=pixel_error,
        pixel_error_interval=pixel_interval,
        flip=flip_error(pixels, middle) if flip else None,
        confidence=confidence,
        block=used,
    )


def worst_tile(image: ArrayLike, a: ArrayLike, b: ArrayLike, tile: int = 12) -> tuple[float, tuple[int, int]]:
    """Signed energy error of the worst tile, over the mask, and (row, column) of its first pixel; tiles at the far edges may be cut.

    See `error_report` for the tiles that count.
    """
    if tile < 1:
        raise InputError(f"a tile needs at least one pixel a side, got {tile}")
    first, second = _pair(a, b)
    pixels = to_reference_size(image, first)
    mask = bright_mask(first, second)
    middle = (first + second) / 2
    energy = np.stack([_blocks(np.where(mask, f, 0.0).sum(axis=2), tile) for f in (pixels, middle, np.ones_like(middle))])
    full = _blocks(np.full(middle.shape[:2], float(middle.shape[2])), tile)
    counts = energy[2] >= 0.25 * full
    counts &= energy[1] > 0
    if not counts.any():
        counts = energy[1] > 0
    error = np.where(counts, energy[0] / np.where(counts, energy[1], 1.0) - 1, 0.0)
    row, column = np.unravel_index(int(np.argmax(np.where(counts, np.abs(error), -1.0))), error.shape)
    return float(error[row, column]), (int(row) * tile, int(column) * tile)


def pixel_noise(first_seed: ArrayLike, second_seed: ArrayLike, a: ArrayLike, b: ArrayLike) -> float:
    """Noise of one value, from two renders that differ in their seed: ``sqrt(mean((I1 - I2)^2) / 2) / mean((A + B) / 2)`` over the mask."""
    reference_a, reference_b = _pair(a, b)
    one = to_reference_size(first_seed, reference_a, "first seed")
    two = to_reference_size(second_seed, reference_a, "second seed")
    mask = bright_mask(reference_a, reference_b)
    scale = ((reference_a + reference_b) / 2)[mask].mean()
    return _noise(one, two, mask) / float(scale)


def _noise(one: Floats, two: Floats, mask: NDArray[np.bool_]) -> float:
    """Standard deviation of one value inside the mask, from two seeds."""
    return float(np.sqrt(np.mean((one - two)[mask] ** 2) / 2))


def flip_error(image: ArrayLike, reference: ArrayLike) -> float:
    """Mean HDR-FLIP in [0, 1] (Andersson et al. 2021), exposures chosen from the reference; what an eye sees when flipping between both.

    Negative values count as black. FLIP has no notion of a noisy reference: that noise is part of the figure.

    Raises
    ------
    InputError
        when the package ``flip-evaluator`` is missing or the image cannot be compared.
    """
    target = finite_image(reference, "reference")
    pixels = to_reference_size(image, target)
    try:
        from flip_evaluator import evaluate
    except ImportError as error:
        raise InputError("FLIP needs the package 'flip-evaluator': pip install flip-evaluator") from error
    if target.max() <= 0:
        raise InputError("the reference is black: FLIP has no exposure to look at it with")

    def colours(values: Floats) -> NDArray[np.float32]:
        rgb = np.repeat(values, 3, axis=2) if values.shape[2] == 1 else values
        if rgb.shape[2] != 3:
            raise InputError(f"FLIP needs 1 or 3 channels, got {rgb.shape[2]}")
        return np.ascontiguousarray(np.maximum(rgb, 0.0), dtype=np.float32)

    _, mean, _ = evaluate(colours(target), colours(pixels), "HDR", applyMagma=False)
    return float(mean)


@dataclass(frozen=True)
class WelchReport:
    """Two-sided p-values of "both sets of renders have the same expectation", at three levels.

    Parameters
    ----------
    t_image, p_image
        Welch's t and its p-value for the mean of the whole picture; positive when the first set is brighter.
    p_tiles, p_pixels
        smallest p-value over tiles (all channels of a tile together) and over single values, corrected for having looked at all of
        them (Sidak; safe for the correlated channels of a pixel too).
    worst_tile_at
        (row, column) of the first pixel of the tile with the smallest p-value.
    """

    t_image: float
    p_image: float
    p_tiles: float
    p_pixels: float
    worst_tile_at: tuple[int, int]

    def agrees(self, alpha: float = 0.01) -> bool:
        """Return True unless one of the three levels rejects; a true null is rejected with probability of at most `alpha`."""
        return min(self.p_image, self.p_tiles, self.p_pixels) > alpha / 3


def welch(first: ArrayLike, second: ArrayLike, tile: int = 12) -> WelchReport:
    """Test whether two sets of independent renders agree in expectation (Welch 1947), for the image, its tiles and its pixels.

    A small uniform bias shows in the image's mean long before any pixel sees it; a local bias shows in a tile; a broken pixel in
    the pixels. The three are therefore tested together.

    Parameters
    ----------
    first, second
        arrays (n, h, w) or (n, h, w, channels): n independent renders each, n >= 2, the two n may differ. With equal n the skewness
        of Monte Carlo noise cancels to first order; with unequal n and noise this skewed, use n of 16 or more.
    tile
        side of a tile, pixels.

    Raises
    ------
    InputError
        for fewer than two renders, NaN or Inf, or different image shapes.
    """
    sets = []
    for name, stack in (("first", first), ("second", second)):
        values = np.asarray(stack, dtype=np.float64)
        if values.ndim == 3:
            values = values[..., None]
        if values.ndim != 4 or values.shape[0] < 2:
            raise InputError(f"the {name} set needs shape (n, h, w[, channels]) with n >= 2, got {np.shape(stack)}")
        finite_image(values.reshape(values.shape[0] * values.shape[1], *values.shape[2:]), f"the {name} set")
        sets.append(values)
    if sets[0].shape[1:] != sets[1].shape[1:]:
        raise InputError(f"the two sets have images of different shapes, {sets[0].shape[1:]} and {sets[1].shape[1:]}")
    if tile < 1:
        raise InputError(f"a tile needs at least one pixel a side, got {tile}")

    def levels(measure: Callable[[Floats], Floats]) -> tuple[Floats, Floats]:
        return _welch_t(*(np.stack([measure(render) for render in s]) for s in sets))

    t_image, p_image = levels(lambda render: np.asarray(render.mean()))
    _, p_tiles = levels(lambda render: _blocks(render.sum(axis=2), tile))
    _, p_pixels = levels(lambda render: render)
    row, column = np.unravel_index(int(np.argmin(p_tiles)), p_tiles.shape)
    return WelchReport(float(t_image), float(p_image), _sidak(p_tiles), _sidak(p_pixels), (int(row) * tile, int(column) * tile))


def _welch_t(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """T and two-sided p along axis 0; two constant and equal samples agree, two constant and different ones do not."""
    vx, vy = x.var(axis=0, ddof=1) / len(x), y.var(axis=0, ddof=1) / len(y)
    difference, variance = x.mean(axis=0) - y.mean(axis=0), vx + vy
    # Identical renders may differ from their own mean by rounding; that is no evidence of anything.
    scale = np.maximum(np.abs(x).max(axis=0), np.abs(y).max(axis=0))
    constant = variance <= (8 * np.finfo(np.float64).eps * scale) ** 2
    safe = np.where(constant, 1.0, variance)
    dof = safe**2 / np.where(constant, 1.0, vx**2 / (len(x) - 1) + vy**2 / (len(y) - 1))
    t = np.where(constant, np.where(np.abs(difference) <= 16 * np.finfo(np.float64).eps * scale, 0.0, np.inf), difference / np.sqrt(safe))
    p = np.where(constant, np.where(t == 0, 1.0, 0.0), student_p(np.where(constant, 0.0, t), np.where(constant, 1.0, dof)))
    return t, p


def student_p(t: ArrayLike, dof: ArrayLike) -> Floats:
    """Two-sided p-value of Student's t with `dof` degrees of freedom (any real number above 0), elementwise.

    With t = sqrt(dof) tan(theta) the density becomes cos(theta)^(dof - 1) on a finite interval, which 64 Gauss points integrate.
    """
    t_, nu = np.broadcast_arrays(np.abs(np.asarray(t, np.float64)), np.asarray(dof, np.float64))
    start = np.arctan(t_ / np.sqrt(nu))
    # Beyond start + 14 / sqrt(dof) the integrand has fallen by more than exp(-98): nothing is left there for large dof.
    width = np.minimum(np.pi / 2 - start, 14 / np.sqrt(nu))
    nodes, weights = _gauss_points()
    theta = start[..., None] + width[..., None] * (nodes + 1) / 2
    log_norm = np.vectorize(lambda n: math.lgamma((n + 1) / 2) - math.lgamma(n / 2), otypes=[np.float64])(nu) - 0.5 * math.log(math.pi)
    with np.errstate(divide="ignore", under="ignore"):
        integrand = np.exp((nu[..., None] - 1) * np.log(np.cos(theta)) + log_norm[..., None])
    p: Floats = np.clip(width * (integrand @ weights), 0.0, 1.0)
    return p


@lru_cache(maxsize=1)
def _gauss_points() -> tuple[Floats, Floats]:
    nodes, weights = np.polynomial.legendre.leggauss(64)
    return nodes, weights


def _sidak(p: Floats) -> float:
    # Where both sets are constant and equal (the black around a cloud) nothing was tested, so nothing is corrected for.
    tested = p[p < 1]
    return -math.expm1(tested.size * math.log1p(-float(tested.min()))) if tested.size and tested.min() > 0 else float(tested.size == 0)


def _pair(a: ArrayLike, b: ArrayLike) -> tuple[Floats, Floats]:
    first, second = finite_image(a, "reference A"), finite_image(b, "reference B")
    if first.shape != second.shape:
        raise InputError(f"the references have different shapes, {first.shape} and {second.shape}")
    return first, second


def _dark_third(image: Floats, a: Floats, b: Floats, mask: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """Image and reference summed over the darkest third, as fields (h, w, c).

    Whoever picks dark pixels by a noisy reference picks those where its noise is negative, and then finds every image too bright.
    So A chooses where B measures, and B where A measures.
    """
    by_a, by_b = (mask & (r <= np.quantile(r[mask], 1 / 3)) for r in (a, b))
    return image * by_a + image * by_b, b * by_a + a * by_b


def _figures(sums: Floats) -> Floats:
    """RRMSE, energy, energy of the dark third from the summed fields (6, n) -> (3, n)."""
    product, image, reference, count, dark_image, dark_reference = sums
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack(
            [
                np.sqrt(np.maximum(0.0, product / count)) / (reference / count),
                image / reference - 1,
                dark_image / dark_reference - 1,
            ]
        )


def _blocks(plane: Floats, side: int) -> Floats:
    """Sum a plane (h, w) over blocks of `side` x `side`, those at the far edges cut."""
    rows, columns = np.arange(0, plane.shape[0], side), np.arange(0, plane.shape[1], side)
    summed: Floats = np.add.reduceat(np.add.reduceat(plane, rows, axis=0), columns, axis=1)
    return summed


def _bootstrap(planes: Floats, block: int, resamples: int, confidence: float, seed: int) -> tuple[list[Interval], int]:
    if block < 1 or not 0 < confidence < 1 or resamples < 0:
        raise InputError(
            f"block = {block}, resamples = {resamples}, confidence = {confidence}: need block >= 1, resamples >= 0, 0 < confidence < 1"
        )
    if resamples == 0:
        return [(math.nan, math.nan)] * 3, block
    sums = np.empty((0, 0))
    for side in (block, 1):
        sums = np.stack([_blocks(p, side).ravel() for p in planes])
        sums = sums[:, sums[3] > 0]
        if sums.shape[1] >= _MIN_BLOCKS:
            break
    n = sums.shape[1]
    rng = np.random.default_rng(seed)
    tails = [(1 - confidence) / 2, (1 + confidence) / 2]
    # One multinomial draw says how often each block came up; drawn in portions so that large images stay small in memory.
    portion = max(1, 4_000_000 // n)
    drawn = [
        _figures(sums @ rng.multinomial(n, np.full(n, 1 / n), size=min(portion, resamples - start)).T.astype(np.float64))
        for start in range(0, resamples, portion)
    ]
    low, high = np.nanquantile(np.concatenate(drawn, axis=1), tails, axis=1)
    return [(float(x), float(y)) for x, y in zip(low, high, strict=True)], side
