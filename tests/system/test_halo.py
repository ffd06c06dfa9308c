"""Rationale: thin edges of a cloud under a forward peak send the sun's light on by few degrees, several times: a bright ring of light lies
around the cloud's shadow. Harmonics of low order know nothing of such peaks.

Expected behaviour: the light that a cloud throws on a floor around its shadow is that of paths; where no peak is, nothing more is sampled.
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from deepclouds_runtime import frame
from deepclouds_runtime.loading import load
from deepclouds_runtime.result import RenderResult
from deepclouds_runtime.surfaces import reflected_from_cloud
from deepclouds_runtime.transport import Cloud
from numpy.typing import NDArray

from deepclouds.volume import Volume, write_vol
from tests.system.smooth_network import Smooth

SIZE = 24
SUN = '<emitter type="directional"><vector name="direction" value="0.1, -1, 0.05"/><rgb name="irradiance" value="3 3 3"/></emitter>'
SKY = '<emitter type="constant"><rgb name="radiance" value="1"/></emitter>'


@pytest.fixture
def below(tmp_path: Path, llvm_mitsuba: ModuleType) -> Path:
    """A floor seen from right below a soft ball that hides the sun."""
    axis = np.linspace(-1, 1, 32)
    squared = axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2
    write_vol(tmp_path / "ball.vol", Volume.from_box(np.exp(-6 * squared).astype(np.float32), (-1.0,) * 3, (1.0,) * 3))
    path = tmp_path / "scene.xml"
    path.write_text(f"""<scene version="3.0.0"><default name="light" value="sun"/><default name="g" value="0.85"/>
      <sensor type="perspective"><float name="fov" value="120"/>
        <transform name="to_world"><lookat origin="0, -1.1, 0" target="0, -3, 0" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><integer name="width" value="{SIZE}"/><integer name="height" value="{SIZE}"/><rfilter type="box"/></film>
      </sensor>LIGHT
      <shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="20"/><translate y="-2"/></transform>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.1"/></bsdf></shape>
      <shape type="cube"><bsdf type="null"/><medium type="heterogeneous" name="interior">
        <float name="scale" value="9"/><rgb name="albedo" value="1"/><phase type="hg"><float name="g" value="$g"/></phase>
        <volume type="gridvolume" name="sigma_t"><string name="filename" value="ball.vol"/>
          <transform name="to_world"><translate x="-0.5" y="-0.5" z="-0.5"/><scale value="2"/></transform></volume>
      </medium></shape></scene>""")
    (tmp_path / "sun.xml").write_text(path.read_text().replace("LIGHT", SUN))
    (tmp_path / "sky.xml").write_text(path.read_text().replace("LIGHT", SKY))
    return tmp_path


def _tiles(image: RenderResult) -> NDArray[np.float64]:
    tiles: NDArray[np.float64] = image.rgb.astype(np.float64).reshape(6, 4, 6, 4, 3).mean(axis=(1, 3, 4))
    return tiles


def test_thrown_light_has_its_peaks(below: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Six seeds with a sixteenth of these samples differ by 2.5 % and 1.9 % in the darkest tile.
    paths = _tiles(load(below / "sun.xml", unbiased=True).render(16384, 3))
    renderer = load(below / "sun.xml")
    corrected = _tiles(renderer.render(2048, 4, correct=True))
    np.testing.assert_allclose(corrected, paths, rtol=0.03)
    # The network alone: most of it with three orders sampled.
    alone = abs(_tiles(renderer.render(128, 4)) / paths - 1).max()
    monkeypatch.setattr(frame, "_MOST_EXACT", 1)
    without = abs(_tiles(renderer.render(128, 4)) / paths - 1).max()
    assert without > 0.2
    assert alone < 0.6 * without


@pytest.mark.parametrize(
    ("light", "g", "exact"), [("sun", 0.85, 3), ("sun", 0.75, 2), ("sun", 0.3, 1), ("sun", -0.75, 2), ("sky", 0.85, 1)]
)
def test_orders_are_sampled_where_peaks_are(below: Path, monkeypatch: pytest.MonkeyPatch, light: str, g: float, exact: int) -> None:
    found = set()

    def noted(cloud: Cloud, *arguments: Any) -> Any:
        found.add(cloud.exact)
        return reflected_from_cloud(cloud, *arguments)

    monkeypatch.setattr(frame, "reflected_from_cloud", noted)
    load(below / f"{light}.xml", defines={"g": str(g)}, predictor=Smooth()).render(1)
    assert found == {exact}
