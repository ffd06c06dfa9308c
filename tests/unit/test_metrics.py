"""The figures against cases done by hand, against noise of known size, and the tests of equality against their promised rates."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from deepclouds.errors import InputError
from deepclouds.metrics import (
    box_average,
    bright_mask,
    energy_error,
    error_report,
    flip_error,
    pixel_noise,
    rrmse,
    student_p,
    to_reference_size,
    welch,
    worst_tile,
)


def scene(side: int = 48, channels: int = 3) -> np.ndarray:
    """Smooth positive truth with a black frame, like a cloud before a black sky."""
    y, x = np.mgrid[:side, :side] / side
    truth: np.ndarray = (0.2 + x + 0.5 * np.sin(6 * y) ** 2)[..., None] * np.linspace(1, 0.6, channels)
    truth[:4] = truth[:, :4] = 0
    return truth


def noisy(truth: np.ndarray, relative: float, rng: np.random.Generator) -> np.ndarray:
    """Unbiased, skewed noise with the given relative standard deviation: gamma distributed, as path tracing roughly is."""
    shape = 1 / relative**2
    return np.asarray(truth * rng.gamma(shape, 1 / shape, size=truth.shape))


def test_figures_by_hand() -> None:
    a = np.array([[[1.0], [3.0]], [[2.0], [0.0]]])
    b = np.array([[[3.0], [5.0]], [[2.0], [0.0]]])
    image = np.array([[[4.0], [5.0]], [[1.0], [9.0]]])
    # The last pixel is black in both references, hence outside the mask, whatever the image holds there.
    # (I-A)(I-B): 3*1, 2*0, (-1)(-1); their mean 4/3; mean of (A+B)/2 = (2+4+2)/3 = 8/3; mean of I = 10/3.
    assert bright_mask(a, b).ravel().tolist() == [True, True, True, False]
    assert rrmse(image, a, b) == pytest.approx(math.sqrt(4 / 3) / (8 / 3))
    assert energy_error(image, a, b) == pytest.approx(10 / 8 - 1)
    # A negative mean product is chance: the figure is 0, not NaN.
    assert rrmse((a + b) / 2, a, b) == 0.0
    report = error_report(image, a, b)
    assert report.reference_mean == pytest.approx(8 / 3)
    assert report.values == 3
    assert report.independent


def test_mask_is_two_per_cent_of_the_peak() -> None:
    reference = np.zeros((100, 100))
    reference[50:] = 1.0
    reference[0, 0], reference[0, 1] = 0.0201, 0.0199
    mask = bright_mask(reference, reference)
    assert mask[0, 0]
    assert not mask[0, 1]
    assert mask.sum() == 5001


def test_the_mask_ignores_a_few_fireflies() -> None:
    reference = np.ones((100, 100))
    reference[3, :5] = 1e6
    assert bright_mask(reference, reference).all()


def test_one_reference_counts_its_noise() -> None:
    rng = np.random.default_rng(3)
    truth = scene()
    a = noisy(truth, 0.2, rng)
    alone = error_report(truth, a)
    assert not alone.independent
    expected = math.sqrt(np.mean((0.2 * truth[truth > 0]) ** 2)) / truth[truth > 0].mean()
    assert alone.rrmse == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("noise", [0.05, 0.3])
def test_reference_noise_does_not_enter(noise: float) -> None:
    """Rationale: rRMSE judges the image, not its references.

    Expected behaviour: over 40 pairs of references, the mean squared figure of a perfect image is 0 and that of an image with a known
    error is that error squared, both within four standard errors, although the references are noisier than the image is wrong.
    """
    rng = np.random.default_rng(11)
    truth = scene()
    inside = truth > 0
    wave = 1 + 0.08 * np.sin(np.arange(truth.shape[1]))[None, :, None]
    known = math.sqrt(np.mean(((wave - 1) * truth)[inside] ** 2)) / truth[inside].mean()
    squares: dict[str, list[float]] = {"perfect": [], "wavy": []}
    for _ in range(40):
        a, b = noisy(truth, noise, rng), noisy(truth, noise, rng)
        middle = ((a + b) / 2)[inside].mean()
        squares["perfect"].append(float(np.mean(((truth - a) * (truth - b))[inside])) / middle**2)
        squares["wavy"].append(rrmse(truth * wave, a, b) ** 2)
        # The public figure is that same product, cut at 0.
        assert rrmse(truth, a, b) ** 2 == pytest.approx(max(0.0, squares["perfect"][-1]), abs=1e-12)
    for name, expected in (("perfect", 0.0), ("wavy", known**2)):
        values = np.array(squares[name])
        assert abs(values.mean() - expected) < 4 * values.std(ddof=1) / math.sqrt(len(values))
    assert np.std(squares["wavy"], ddof=1) / math.sqrt(40) < 0.1 * known**2


def test_the_noise_of_the_image_itself_does_enter() -> None:
    rng = np.random.default_rng(5)
    truth = scene()
    a, b, image, other = (noisy(truth, s, rng) for s in (0.1, 0.1, 0.15, 0.15))
    inside = truth > 0
    expected = 0.15 * math.sqrt(np.mean(truth[inside] ** 2)) / truth[inside].mean()
    assert rrmse(image, a, b) == pytest.approx(expected, rel=0.06)
    assert pixel_noise(image, other, a, b) == pytest.approx(expected, rel=0.06)
    assert error_report(image, a, b, second_seed=other).noise == pytest.approx(expected, rel=0.06)


def test_dark_third_is_free_of_selection_bias() -> None:
    """Rationale: pixels chosen for being dark in a noisy reference are darker there than in truth.

    Expected behaviour: a perfect image shows no energy error in the darkest third, even where choosing and measuring by the same
    reference would show several per cent; an image that is wrong in the dark shows that error.
    """
    rng = np.random.default_rng(8)
    truth = np.full((96, 96, 1), 1.0) * np.linspace(0.9, 1.1, 96)[:, None, None]
    a, b = noisy(truth, 0.3, rng), noisy(truth, 0.3, rng)
    report = error_report(truth, a, b)
    assert abs(report.dark_energy) < 0.02
    middle = (a + b) / 2
    naive = truth[middle <= np.quantile(middle, 1 / 3)].sum() / middle[middle <= np.quantile(middle, 1 / 3)].sum() - 1
    assert naive > 0.1
    steep = np.full((96, 96, 1), 1.0) * np.linspace(0.5, 2, 96)[:, None, None]
    dark_wrong = np.where(steep <= np.quantile(steep, 1 / 3), 1.2 * steep, steep)
    quiet = error_report(dark_wrong, noisy(steep, 0.001, rng), noisy(steep, 0.001, rng))
    assert quiet.dark_energy == pytest.approx(0.2, abs=0.01)
    assert quiet.energy < 0.05


def test_worst_tile() -> None:
    truth = np.ones((48, 36, 3))
    image = truth.copy()
    image[12:24, 24:36] *= 0.7
    image[0, 0] *= 5
    error, where = worst_tile(image, truth, truth)
    assert error == pytest.approx(-0.3)
    assert where == (12, 24)


def test_sparse_tiles_do_not_count_unless_all_are_sparse() -> None:
    truth = np.zeros((24, 24))
    truth[:12, :12] = 1.0
    truth[20, 20] = 1.0
    image = truth.copy()
    image[:12, :12] *= 1.1
    image[20, 20] = 3.0
    error, where = worst_tile(image, truth, truth)
    assert error == pytest.approx(0.1)
    assert where == (0, 0)
    truth[:12, :12] = image[:12, :12] = 0
    error, where = worst_tile(image, truth, truth)
    assert error == pytest.approx(2.0)
    assert where == (12, 12)


def test_box_average_is_exact() -> None:
    rng = np.random.default_rng(2)
    image = rng.random((480, 480, 3))
    small = box_average(image, 5)
    assert small.shape == (96, 96, 3)
    assert small[7, 11, 2] == pytest.approx(image[35:40, 55:60, 2].mean(), rel=1e-14)
    np.testing.assert_array_equal(box_average(image[..., 0], 1), image[..., 0])
    with pytest.raises(InputError, match="does not divide"):
        box_average(image, 7)


def test_multiples_of_the_size_are_averaged_and_others_refused() -> None:
    truth = scene(48)
    large = np.repeat(np.repeat(truth, 2, axis=0), 2, axis=1)
    assert rrmse(large, truth, truth) == pytest.approx(0.0, abs=1e-12)
    for shape in ((72, 72, 3), (96, 48, 3), (24, 24, 3)):
        with pytest.raises(InputError, match="integer multiple"):
            to_reference_size(np.ones(shape), truth)
    with pytest.raises(InputError, match="1 channels, but the reference has 3"):
        rrmse(truth[..., 0], truth, truth)


def test_bad_images_are_refused_with_counts() -> None:
    truth = scene()
    broken = truth.copy()
    broken[5, 5, 0] = broken[6, 6, 1] = np.nan
    broken[7, 7, 2] = np.inf
    with pytest.raises(InputError, match=f"2 NaN and 1 infinite of {truth.size}"):
        rrmse(broken, truth, truth)
    with pytest.raises(InputError, match="reference B"):
        rrmse(truth, truth, broken)
    with pytest.raises(InputError, match="different shapes"):
        rrmse(truth, truth, truth[:24])
    with pytest.raises(InputError, match="black"):
        rrmse(truth, 0 * truth, 0 * truth)
    with pytest.raises(InputError, match="shape"):
        rrmse(truth.ravel(), truth, truth)
    with pytest.raises(InputError, match="second seed"):
        error_report(truth, truth, truth, second_seed=truth[:24])


def test_the_error_of_a_pixel_counts_the_noise_that_boxes_average_away() -> None:
    """Expected behaviour: bias and all noise of a five times larger image; of one at the references' size the rRMSE."""
    rng = np.random.default_rng(11)
    truth = np.full((96, 96, 3), 2.0)
    a, b = noisy(truth, 0.05, rng), noisy(truth, 0.05, rng)
    large = np.full((480, 480, 3), 2.0)
    one, two = (1.03 * large + rng.normal(0, 0.08, large.shape) for _ in range(2))
    report = error_report(one, a, b, second_seed=two, resamples=200)
    assert report.rrmse == pytest.approx(np.hypot(0.03, 0.04 / 5), rel=0.06)
    assert report.pixel_error == pytest.approx(np.hypot(0.03, 0.04), rel=0.03)
    assert report.pixel_error is not None
    assert report.pixel_error_interval is not None
    assert report.pixel_error_interval[0] < report.pixel_error < report.pixel_error_interval[1]
    same_size = error_report(one[:96, :96], a, b, second_seed=two[:96, :96], resamples=0)
    assert same_size.pixel_error == same_size.rrmse
    assert error_report(one, a, b, resamples=0).pixel_error is None


@pytest.mark.parametrize("correlated", [1, 8])
def test_bootstrap_intervals_cover(correlated: int) -> None:
    """Rationale: an interval that covers less than it says makes noise look like a result.

    Expected behaviour: over 200 images whose error is drawn afresh (per pixel, or constant on 8 x 8 blocks as a network's is), the 95 %
    intervals hold the expected energy and rRMSE in 88 % to 100 %: near the nominal level, percentile intervals of few blocks being
    slightly short.
    """
    rng = np.random.default_rng(21)
    truth = np.ones((96, 96, 1))
    sigma, bias = 0.15, 0.05
    hits = np.zeros(2)
    for index in range(200):
        coarse = rng.normal(bias, sigma, size=(96 // correlated, 96 // correlated, 1))
        image = truth + np.repeat(np.repeat(coarse, correlated, axis=0), correlated, axis=1)
        a, b = noisy(truth, 0.05, rng), noisy(truth, 0.05, rng)
        report = error_report(image, a, b, resamples=400, seed=index)
        expected = (math.hypot(sigma, bias), bias)
        for k, (low, high) in enumerate((report.rrmse_interval, report.energy_interval)):
            hits[k] += low <= expected[k] <= high
    assert np.all(hits >= 0.88 * 200)
    # A far too wide interval would always hit; of 200 intervals at 95 %, some must miss.
    assert np.all(hits < 200)


def test_small_images_fall_back_to_pixels() -> None:
    rng = np.random.default_rng(4)
    truth = np.ones((12, 12))
    report = error_report(noisy(truth, 0.1, rng), truth, noisy(truth, 0.01, rng))
    assert report.block == 1
    low, high = report.rrmse_interval
    assert low < report.rrmse < high


def test_intervals_repeat_with_their_seed() -> None:
    rng = np.random.default_rng(4)
    truth = scene()
    image, a, b = (noisy(truth, 0.1, rng) for _ in range(3))
    assert error_report(image, a, b, seed=5) == error_report(image, a, b, seed=5)
    assert error_report(image, a, b, seed=5).rrmse_interval != error_report(image, a, b, seed=6).rrmse_interval


def test_flip_grows_with_the_error() -> None:
    pytest.importorskip("flip_evaluator")
    truth = scene()
    assert flip_error(truth, truth) == pytest.approx(0.0, abs=1e-6)
    assert 0 < flip_error(1.05 * truth, truth) < flip_error(1.4 * truth, truth) < 1
    report = error_report(1.4 * truth, truth, truth, flip=True)
    assert report.flip == pytest.approx(flip_error(1.4 * truth, truth))
    assert error_report(truth, truth, truth).flip is None


def test_student_p_against_scipy() -> None:
    t = np.array([0.0, 0.3, 1.0, 2.5, 6.0, 15.0])
    for dof in (1.0, 1.7, 3.0, 12.5, 200.0, 1e4):
        np.testing.assert_allclose(student_p(t, dof), 2 * stats.t.sf(t, dof), rtol=1e-5, atol=1e-30)
        np.testing.assert_array_equal(student_p(-t, dof), student_p(t, dof))


def renders(n: int, rng: np.random.Generator, truth: np.ndarray, relative: float = 0.5) -> np.ndarray:
    return np.stack([noisy(truth, relative, rng) for _ in range(n)])


def test_welch_matches_scipy_at_the_image_level() -> None:
    rng = np.random.default_rng(9)
    x, y = renders(6, rng, scene(24)), renders(9, rng, 1.002 * scene(24), 0.8)
    expected = stats.ttest_ind(x.mean(axis=(1, 2, 3)), y.mean(axis=(1, 2, 3)), equal_var=False)
    report = welch(x, y)
    assert report.t_image == pytest.approx(expected.statistic)
    assert report.p_image == pytest.approx(expected.pvalue, rel=1e-6)


def test_welch_null_rate() -> None:
    """Rationale: a helper that rejects true nulls makes every suite that uses it fail by chance; one that never rejects tests nothing.

    Expected behaviour: 400 comparisons of equal expectation are rejected at alpha = 0.05 in at most 7.5 % (2.3 standard errors above
    5 %), and the p-value of the image level is uniform.
    """
    rng = np.random.default_rng(17)
    truth = scene(24, 1)
    reports = [welch(renders(16, rng, truth), renders(16, rng, truth)) for _ in range(400)]
    rejected = sum(not r.agrees(0.05) for r in reports)
    assert 1 <= rejected <= 30
    assert stats.kstest([r.p_image for r in reports], "uniform").pvalue > 1e-3


@pytest.mark.parametrize(
    ("level", "where", "factor", "noise"),
    [("p_image", np.s_[:, :], 1.05, 0.5), ("p_tiles", np.s_[12:, 12:], 1.15, 0.5), ("p_pixels", np.s_[15, 15], 1.5, 0.15)],
)
def test_welch_power(level: str, where: tuple[slice | int, ...], factor: float, noise: float) -> None:
    """Expected behaviour: a uniform bias, one bright tile or one bright pixel is found, at its own level, in at least 45 of 50 trials."""
    rng = np.random.default_rng(23)
    truth = scene(24, 1)
    wrong = truth.copy()
    wrong[where] *= factor
    reports = [welch(renders(16, rng, wrong, noise), renders(16, rng, truth, noise)) for _ in range(50)]
    assert sum(not r.agrees(0.01) for r in reports) >= 45
    assert sum(getattr(r, level) < 0.01 / 3 for r in reports) >= 45
    if level == "p_tiles":
        assert sum(r.worst_tile_at == (12, 12) for r in reports) >= 45


def test_welch_on_constant_pixels() -> None:
    rng = np.random.default_rng(1)
    black = np.zeros((4, 24, 24, 1))
    assert welch(black, black).agrees()
    varying = renders(4, rng, scene(24, 1))
    assert welch(varying, varying.copy()).agrees()
    lit = black.copy()
    lit[:, 3, 3] = 0.1
    assert welch(lit, black).p_pixels == 0.0
    # The same constant summed in two orders differs in the last bits; that is no difference.
    tenth = np.full((4, 24, 24, 1), 0.1)
    assert welch(tenth, tenth + 1e-17).agrees()


def test_welch_refuses_nonsense() -> None:
    ones = np.ones((4, 8, 8, 3))
    with pytest.raises(InputError, match="n >= 2"):
        welch(ones[:1], ones)
    with pytest.raises(InputError, match="different shapes"):
        welch(ones, ones[:, :4])
    with pytest.raises(InputError, match="NaN"):
        welch(ones, np.where(np.arange(8)[None, None, :, None] == 3, np.nan, ones))
