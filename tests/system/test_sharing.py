"""Rationale: nodes that stand in one cell of the coarsest ones share what the network makes of the coarse levels of their stencils.

Colour channels share queries too: of three albedos two are asked for.

Expected behaviour: the image stays what it is but for much less than the network's own error; where corners cannot tell, at edges that
see the light and along it, the network is asked in full; networks that cannot be cut share nothing.
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from deepclouds_runtime.loading import load
from deepclouds_runtime.predicted import _between
from deepclouds_runtime.result import RenderResult
from deepclouds_runtime.scattering import Coarse
from deepclouds_training.clouds import make_cloud, scale_for_optical_depth

from deepclouds.volume import write_vol
from tests.system.smooth_network import Smooth

SIZE = 48


@pytest.fixture
def smoke(tmp_path: Path, llvm_mitsuba: ModuleType) -> Path:
    """A plume of three albedos in the sun."""
    volume = make_cloud("plume", 5, 48)
    write_vol(tmp_path / "plume.vol", volume)
    to_world = " ".join(str(float(v)) for v in volume.to_world.ravel())
    half = np.diag([0.5, 0.5, 0.5, 1.0])
    half[:3, 3] = 0.5
    cube = " ".join(str(float(v)) for v in (volume.to_world @ half).ravel())
    lower, upper = volume.bounds
    middle, away = 0.5 * (lower + upper), float(np.linalg.norm(upper - lower))
    eye = middle + away * np.array([0.3, -1.3, 0.4])
    path = tmp_path / "scene.xml"
    path.write_text(f"""<scene version="3.0.0">
      <sensor type="perspective"><float name="fov" value="35"/><transform name="to_world">
        <lookat origin="{eye[0]}, {eye[1]}, {eye[2]}" target="{middle[0]}, {middle[1]}, {middle[2]}" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><integer name="width" value="{SIZE}"/><integer name="height" value="{SIZE}"/><rfilter type="box"/></film>
      </sensor>
      <emitter type="directional"><vector name="direction" value="-0.8, 0.4, -0.6"/><rgb name="irradiance" value="3 3 3"/></emitter>
      <shape type="cube"><transform name="to_world"><matrix value="{cube}"/></transform><bsdf type="null"/>
        <medium type="heterogeneous" name="interior">
          <float name="scale" value="{scale_for_optical_depth(volume, 30.0)}"/><rgb name="albedo" value="0.9 0.97 0.999"/>
          <phase type="hg"><float name="g" value="0.8"/></phase>
          <volume type="gridvolume" name="sigma_t"><string name="filename" value="plume.vol"/>
            <transform name="to_world"><matrix value="{to_world}"/></transform></volume>
      </medium></shape></scene>""")
    return path


def _shared(image: RenderResult) -> tuple[int, int]:
    source = image.statistics.sources["suns"]
    return source["shared"], source["queries"]


def test_an_image_stays_what_it_is(smoke: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    renderer = load(smoke)
    found = renderer.render(16, 3)
    monkeypatch.setattr("deepclouds_runtime.predicted.shared_levels", lambda spacing: 0)
    full = renderer.render(16, 3)
    shared, queries = _shared(found)
    assert queries // 4 < shared < queries
    assert _shared(full) == (0, full.statistics.sources["suns"]["queries"])
    error = float(np.sqrt(np.mean((found.rgb - full.rgb) ** 2)) / full.rgb.mean())
    assert 0 < error < 0.02
    assert found.rgb.sum() == pytest.approx(full.rgb.sum(), rel=0.003)
    # What is to be expected of the errors comes from means at corners.
    doubt = [image.channels["confidence"][image.channels["volume_opacity"] > 0.5] for image in (found, full)]
    np.testing.assert_allclose(doubt[0], doubt[1], atol=0.02)


@pytest.mark.parametrize("how", ["fast", "smooth"])
def test_networks_that_cannot_be_cut_share_nothing(smoke: Path, how: str) -> None:
    image = load(smoke, predictor=Smooth()).render(1) if how == "smooth" else load(smoke, model="fast").render(1)
    assert _shared(image)[0] == 0
    assert _shared(image)[1] > 0


def test_corners_tell_nothing_along_the_light_and_at_edges() -> None:
    n = 4
    coarse = Coarse(np.zeros((n, 1, 2), np.float32), np.zeros((n, 7, 2), np.float32), np.log1p(np.full(n, 3.0, np.float32)))
    toward = np.array([[1.0, 0, 0], [1, 0, 0], [0, 0, 1], [0.01, 0, -0.99995]])
    light = np.broadcast_to([0.0, 0, 1], (n, 3))
    assert _between(coarse, toward, light, np.array([3.1, 1.5, 3.0, 3.0])).tolist() == [True, False, False, False]


def test_the_middle_of_three_albedos_is_not_asked_for(smoke: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    renderer = load(smoke)
    found = renderer.render(16, 3)
    monkeypatch.setattr("deepclouds_runtime.between_albedos._WRONG", 0.0)
    full = renderer.render(16, 3)
    (fewer, spared), (queries, none) = (
        (image.statistics.sources["suns"]["queries"], image.statistics.skipped["albedos between two others"]) for image in (found, full)
    )
    assert none == 0
    assert fewer + spared == pytest.approx(queries, rel=0.05)
    assert fewer < 0.8 * queries
    first, middle, last = np.linalg.norm(found.rgb - full.rgb, axis=(0, 1)) / np.linalg.norm(full.rgb, axis=(0, 1))
    assert 0 < middle < 0.03
    assert max(first, last) < 0.005
