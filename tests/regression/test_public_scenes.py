"""The released model on test scenes with path-traced references: effect sizes, not significance.

The scenes lie beside the checkout and belong to no release; without them these tests are skipped and counted.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepclouds.exr import read_exr
from deepclouds.metrics import error_report


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "spp", "rrmse", "energy"),
    [
        ("cloud_front", 48, 0.15, 0.06),
        ("smoke_rgb", 32, 0.15, 0.06),
        ("cube", 16, 0.15, 0.06),
        ("cloud_sky", 96, 0.20, 0.08),
        ("cube_ground", 16, 0.20, None),
    ],
)
def test_error_on_a_public_scene(public_scenes: Path, name: str, spp: int, rrmse: float, energy: float | None) -> None:
    """Rationale: the network is biased, so the test asserts how large its error may be, by the upper end of its 95 % interval.

    Expected: rRMSE and energy within the bounds of the first release; the image is finite and not negative.
    """
    import deepclouds_runtime

    result = deepclouds_runtime.render(public_scenes / name / "scene.xml", spp=spp, seed=4711, defines={"size": "96"})
    assert np.isfinite(result.rgb).all()
    assert (result.rgb >= 0).all()
    references = [read_exr(public_scenes / name / f"ref_{letter}.exr").rgb() for letter in "ab"]
    report = error_report(result.rgb, *references)
    assert report.rrmse_interval[1] <= rrmse, report
    if energy is not None:
        assert max(abs(e) for e in report.energy_interval) <= energy, report
