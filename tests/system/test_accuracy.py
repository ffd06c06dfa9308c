"""The measurement of the accuracy: its arithmetic against exact cases, and that it runs; no accuracy decides anything here.

Expected behaviour: a planted error is found whatever the noise; a slab's flux comes out exactly when J is exact, for a sun overhead and
a low one; intervals hold what they should; the last line has the agreed form; and the page is written between its marks only.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from deepclouds_training.calibrate import Judged
from numpy.typing import NDArray
from scipy import special

from benchmarks import accuracy
from benchmarks.accuracy_confidence import rise, tenths
from benchmarks.accuracy_figures import bootstrap, noise_free
from benchmarks.accuracy_furnace import FurnaceCloud, furnace_rows, plan, tile_means
from benchmarks.accuracy_slabs import Slab, cases, discrete_ordinates, leaving_flux
from benchmarks.bench import ROOT
from benchmarks.page import marks, write_results
from deepclouds.backend import backend
from deepclouds.errors import InputError
from deepclouds.medium.field import Field
from deepclouds.medium.multiple_scattering import trace_walks
from deepclouds.model import multiple_scattering
from deepclouds.model.trust import FLOOR
from deepclouds.volume import Volume

Floats = NDArray[np.float64]


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    """Of 400 samples of 50 normal numbers, the 95 % intervals of the mean miss 0 about 5 % of the time, and 0.6 nearly always."""
    rng = np.random.default_rng(1)
    found = [bootstrap(rng.normal(size=50), lambda v: v.mean(axis=1), resamples=400) for _ in range(400)]
    missed = np.mean([not f.low < 0 < f.high for f in found])
    assert 0.02 < missed < 0.11
    assert np.mean([f.high < 0.6 for f in found]) > 0.95


def test_a_planted_error_is_found_under_noise() -> None:
    rng = np.random.default_rng(2)
    truth = rng.uniform(0.5, 1.5, 1000)
    a, b = (truth * (1 + 0.2 * rng.normal(size=truth.shape)) for _ in range(2))
    wrong = truth * 1.03 + 0.1 * np.where(rng.random(truth.shape) < 0.5, -1, 1)
    found = noise_free(wrong, a, b)
    expected = np.sqrt(np.mean((wrong - truth) ** 2)) / truth.mean()
    # Not the labels' own noise, which is twice as large.
    assert found["rRMSE"].value == pytest.approx(expected, rel=0.2)
    assert found["rRMSE"].low < expected < found["rRMSE"].high
    assert found["energy"].value == pytest.approx(0.03, abs=0.015)
    # Percentages with the sign only where one has a meaning.
    assert re.fullmatch(r"\d+\.\d\d % \[\d+\.\d\d, \d+\.\d\d\]", found["rRMSE"].text)
    assert found["energy"].text.startswith("+")


def test_tiles_count_covered_pixels() -> None:
    image = np.ones((24, 24, 3))
    counts = np.zeros((24, 24), bool)
    counts[:12, :12] = True
    image[:12, :12] = 1.5
    # A quarter of a tile counts, one pixel less does not; what is not covered has no say.
    counts[:6, 12:18] = True
    image[:6, 12:18], image[6:12, 12:] = 0.9, 77
    counts[12:18, :6] = True
    counts[12, 0] = False
    np.testing.assert_allclose(tile_means([image, 2 * image], counts), [[1.5, 3.0], [0.9, 1.8]])


def test_the_furnace_takes_noise_out() -> None:
    rng = np.random.default_rng(3)
    clouds = []
    for i in range(12):
        bias = 0.02 * np.where(rng.random((400, 1)) < 0.5, -1, 1) + 0.01
        tiles = 1 + bias + 0.03 * rng.normal(size=(400, 2))
        clouds.append(FurnaceCloud("congestus", i, 30.0, (0.0, 0.6, 0.85)[i % 3], tiles, 2 * tiles - 1))
    rows = furnace_rows(clouds)
    assert [row.case for row in rows] == ["all, 12 clouds", "g 0.0, 4 clouds", "g 0.6, 4 clouds", "g 0.85, 4 clouds", "all, 12 clouds"]
    assert [row.part for row in rows] == 4 * ["furnace"] + ["furnace, corrected"]
    assert rows[4].figures["rms"].value == pytest.approx(2 * rows[0].figures["rms"].value)
    figures = rows[0].figures
    assert figures["rms"].value == pytest.approx(np.sqrt(0.02**2 + 0.01**2), rel=0.05)
    assert figures["mean"].value == pytest.approx(0.01, abs=0.002)
    # Of the mean of two seeds.
    assert figures["noise taken out"].value == pytest.approx(0.03 / np.sqrt(2), rel=0.05)


def test_the_furnace_is_the_one_described() -> None:
    clouds = plan(20)
    assert len(clouds) == 20
    assert {family for family, *_ in clouds} == {"congestus", "plume"}
    assert [min(size for _, _, size, _ in clouds), max(size for _, _, size, _ in clouds)] == pytest.approx([5, 300])
    assert {g for *_, g in clouds} == {0.0, 0.6, 0.85}


def isotropic_source(slab: Slab, cells: int = 1200) -> tuple[Floats, Floats]:
    """Optical depths and J / E there from the integral equation with the kernel E1 / 2 (Chandrasekhar 1960, chapter 1)."""
    edges = np.linspace(0, slab.tau, cells + 1)
    middle = 0.5 * (edges[1:] + edges[:-1])
    distance = edges[None] - middle[:, None]
    # Antiderivative of E1(|s|): odd, zero at zero.
    operator = 0.5 * np.diff(np.sign(distance) * (1 - special.expn(2, np.abs(distance))), axis=1)
    light = slab.height * -np.diff(np.exp(-edges / slab.height)) / np.diff(edges)
    source = np.linalg.solve(np.eye(cells) - slab.albedo * operator, slab.albedo**2 * (operator @ light))
    return middle, source / (4 * np.pi)


@pytest.mark.parametrize("slab", [Slab(0.5, 0.0, 1.0, 0.5), Slab(8.0, 0.0, 0.9, 1.0), Slab(8.0, 0.0, 1.0, 0.5)])
def test_an_exact_source_gives_the_exact_flux(slab: Slab) -> None:
    depth, j = isotropic_source(slab)
    assert leaving_flux(slab, lambda d, w: np.interp(d, depth, j)) == pytest.approx(discrete_ordinates(slab), abs=5e-4)


@pytest.mark.parametrize("height", [1.0, 0.5])
@pytest.mark.parametrize("tau", [0.05, 0.5])
def test_single_scattering_goes_where_the_phase_function_says(tau: float, height: float) -> None:
    """At a tiny albedo single scattering is all there is; most of it goes forward at g 0.85."""
    slab = Slab(tau, 0.85, 1e-4, height)
    beam = height * np.exp(-tau / height)
    found, exact = (np.array(f) - [0, beam] for f in (leaving_flux(slab, lambda d, w: 0 * d), discrete_ordinates(slab)))
    np.testing.assert_allclose(found, exact, rtol=2e-3)
    assert exact[1] > 3 * exact[0]


def test_walks_give_the_exact_flux() -> None:
    """J of an oblique sun with a forward peak, from our tracker: directions and depths are where they should be."""
    slab = Slab(2.0, 0.85, 0.99, 0.5)
    field = Field(backend(), Volume.from_box(np.ones((3, 3, 3)), (-30, -30, 0), (30, 30, 1)), slab.tau)

    def source(depth: Floats, w: Floats) -> Floats:
        n = len(depth)
        points = np.stack([0 * depth, 0 * depth, 1 - depth / slab.tau], axis=1).astype(np.float32)
        suns = np.broadcast_to(slab.omega_sun.astype(np.float32), (n, 1, 3))
        albedo = np.full((n, 1), slab.albedo, np.float32)
        j = trace_walks(field, points, w.astype(np.float32), np.full(n, slab.g, np.float32), suns, albedo, 512, seed=11)
        return multiple_scattering(j[:, :, 0, 0].mean(axis=1, dtype=np.float64), slab.albedo)

    found, exact = leaving_flux(slab, source), discrete_ordinates(slab)
    assert found == pytest.approx(exact, abs=0.004)


def test_the_exact_fluxes_are_those_of_the_published_table() -> None:
    """Values that adding-doubling, another method, agrees with to five digits."""
    rows = [(1.0, 1.0, 0.0, 0.34133, 0.65867), (8.0, 1.0, 0.85, 0.35843, 0.64157), (1.0, 0.99, 0.0, 0.33292, 0.65098)]
    for tau, albedo, g, reflected, transmitted in rows:
        assert discrete_ordinates(Slab(tau, g, albedo, 1.0)) == pytest.approx((reflected, transmitted), abs=2e-5)
    thirty = cases()
    assert len(set(thirty)) == 30
    assert all(sum(s.albedo == a for s in thirty) == 10 for a in (1.0, 0.99, 0.9))


def test_the_page_is_written_between_its_marks(tmp_path: Path) -> None:
    page = tmp_path / "accuracy.md"
    page.write_text("before\n" + "\nold\n".join(marks("accuracy")) + "\nafter\n")
    write_results(page, "accuracy", "new")
    assert page.read_text() == f"before\n{marks('accuracy')[0]}\n\nnew\n\n{marks('accuracy')[1]}\nafter\n"
    page.write_text("no marks")
    with pytest.raises(InputError, match="once each"):
        write_results(page, "accuracy", "new")
    # The page that is there can be written.
    text = (ROOT / "docs" / "accuracy.md").read_text()
    assert all(text.count(mark) == 1 for mark in marks("accuracy"))


def test_tenths_find_an_error_that_is_known() -> None:
    """Expected behaviour: errors that grow with what sorts the labels rise from tenth to tenth; what is expected is returned as it is."""
    rng = np.random.default_rng(5)
    n = 20_000
    expected = rng.uniform(0.05, 0.4, n)
    j = rng.uniform(0.5, 2.0, n)
    truth = j + expected * (j + FLOOR) * np.where(rng.random(n) < 0.5, -1, 1)
    half_a, half_b = (truth + 0.1 * rng.normal(size=n) for _ in range(2))
    judged = Judged(rng.random(n), j, half_a, half_b, np.full(n, 0.07), rng.integers(0, 30, n))
    deciles = tenths(judged, expected, expected)
    for decile in deciles:
        assert decile.found.value == pytest.approx(decile.expected, rel=0.1)
        assert decile.found.low <= decile.expected * 1.1
        assert decile.found.high >= decile.expected * 0.9
    assert rise(deciles) == pytest.approx(0.365 / 0.085, rel=0.1)
    # Distances that have nothing to do with the error.
    assert rise(tenths(judged, expected, judged.distance)) == pytest.approx(1, abs=0.1)


def test_it_runs(tmp_path: Path, small_dataset: Path, capsys: pytest.CaptureFixture[str], llvm_mitsuba: object) -> None:
    """Expected behaviour: very little of every part is measured, written and drawn, and the last line sums it up."""
    where = ["--labels", str(small_dataset), "--out", str(tmp_path)]
    assert accuracy.main(["--quick", "--only", "ball_isotropic", *where]) == 0
    lines = capsys.readouterr().out.strip().splitlines()
    number = r"[+-]?\d+\.\d+"
    last = f"accuracy: worst rRMSE {number} %, worst energy {number} %, furnace rms {number} %, slab error {number}"
    assert re.fullmatch(last, lines[-1])
    written = (tmp_path / "accuracy.md").read_text()
    for part in ("ball_isotropic", "congestus 7100", "depth 0.5", "ring", "backlit stratus", "sphere", "box", "second cloud's shadow"):
        assert any(part in line for line in lines), part
        assert part in written or part == "congestus 7100"
    assert lines[-1] in written
    pictures = {"scenes", "furnace", "slabs", "special", "labels", "confidence"}
    assert {p.name for p in tmp_path.glob("*.png")} == {f"accuracy_{name}.png" for name in pictures}
    kept = json.loads((tmp_path / "accuracy.json").read_text())
    assert kept["headline"] == lines[-1]
    assert {row["part"] for row in kept["rows"]} == {
        "scene",
        "corrected",
        "furnace",
        "furnace, corrected",
        "slabs",
        "labels",
        "special",
        "confidence",
    }


def test_bad_input_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no scene"):
        accuracy.main(["--scenes", str(tmp_path)])
    with pytest.raises(InputError, match="no such model"):
        accuracy.main(["--model", str(tmp_path / "nothing.onnx")])
