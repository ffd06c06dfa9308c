"""The released model on test scenes with path-traced references: effect sizes, not significance.

The scenes lie beside the checkout and belong to no release; without them these tests are skipped and counted.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from deepclouds.exr import read_exr
from deepclouds.metrics import ErrorReport, error_report

SAMPLES = {"cloud_front": 48, "smoke_rgb": 32, "cube": 16, "cloud_sky": 96, "cube_ground": 16}


@cache
def network_alone(folder: Path, name: str) -> ErrorReport:
    """Error of an image that nothing corrects, which is finite and not negative."""
    import deepclouds_runtime

    result = deepclouds_runtime.render(folder / name / "scene.xml", spp=SAMPLES[name], seed=4711, defines={"size": "96"})
    return report_of(folder / name, result.rgb)


def report_of(folder: Path, rgb: np.ndarray) -> ErrorReport:
    """Error of a finite image that is not negative."""
    assert np.isfinite(rgb).all()
    assert (rgb >= 0).all()
    return error_report(rgb, *(read_exr(folder / f"ref_{letter}.exr").rgb() for letter in "ab"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "rrmse"), [("cloud_front", 0.15), ("smoke_rgb", 0.15), ("cube", 0.15), ("cloud_sky", 0.20), ("cube_ground", 0.20)]
)
def test_error_on_a_public_scene(public_scenes: Path, name: str, rrmse: float) -> None:
    """Rationale: the network is biased, so the test asserts how large its error may be, by the upper end of its 95 % interval.

    Expected: rRMSE within the bounds of the first release.
    """
    report = network_alone(public_scenes, name)
    assert report.rrmse_interval[1] <= rrmse, report


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "energy"),
    [
        ("cloud_front", 0.06),
        ("smoke_rgb", 0.06),
        # -5.6 to -5.8 %, by the seed, and -5.7 % without interpolation; the interval ends at 6.1 to 6.2 %.
        pytest.param("cube", 0.06, marks=pytest.mark.xfail(reason="the network makes the cube too dark by more", strict=True)),
        ("cloud_sky", 0.08),
    ],
)
def test_energy_on_a_public_scene(public_scenes: Path, name: str, energy: float) -> None:
    """Expected: energy, in all of its interval, within the bounds of the first release."""
    report = network_alone(public_scenes, name)
    assert max(abs(e) for e in report.energy_interval) <= energy, report


@pytest.mark.slow
@pytest.mark.parametrize("name", SAMPLES)
def test_error_of_a_corrected_image(public_scenes: Path, name: str) -> None:
    """Rationale: what the command line renders is corrected by walks.

    Expected: the goals of docs/accuracy.md, 4 % and 1.5 %, each by its estimate of three seeds, whose walks differ; by the end of the
    interval of each half as much again at most.
    """
    from deepclouds_runtime.loading import load

    renderer = load(public_scenes / name / "scene.xml", defines={"size": "96"})
    reports = [report_of(public_scenes / name, renderer.render(SAMPLES[name], seed=seed, correct=True).rgb) for seed in (4711, 4712, 4713)]
    assert float(np.sqrt(np.mean([report.rrmse**2 for report in reports]))) <= 0.04, reports
    assert abs(float(np.mean([report.energy for report in reports]))) <= 0.015, reports
    for report in reports:
        assert report.rrmse_interval[1] <= 0.06, report
        assert max(abs(e) for e in report.energy_interval) <= 0.0225, report
