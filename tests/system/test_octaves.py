"""The benchmark's octaves: their formula, single scattering as their first term, and the light that further ones add."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from benchmarks.octaves import OctaveRenderer, Octaves
from deepclouds.backend import backend
from deepclouds.errors import InputError
from deepclouds.medium.phase import two_lobe_numpy

SCENES = Path(__file__).parents[2] / "benchmarks" / "scenes"
FLOOR = (
    '<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="3"/><translate y="-1.05"/></transform>'
    '<bsdf type="diffuse"><rgb name="reflectance" value="0.5, 0.45, 0.4"/></bsdf></shape></scene>'
)


@pytest.fixture(autouse=True)
def mi(llvm_mitsuba: ModuleType) -> ModuleType:
    return llvm_mitsuba


def scene_of(path: Path, size: int = 24) -> Any:
    from deepclouds_runtime.loading import load_xml
    from deepclouds_runtime.scene import read_scene

    return read_scene(load_xml(path, {"size": str(size)}))


def single_scattering(path: Path, size: int = 24) -> np.ndarray[Any, Any]:
    from deepclouds_runtime.loading import load

    result = load(path, defines={"size": str(size)}, max_depth=2, mode="reference").render(64, seed=3)
    return np.asarray(result.rgb, np.float64)


def test_the_source_is_the_published_sum() -> None:
    """Expected behaviour: sum over i of b^i p(cos, c^i g) exp(-a^i tau) without i = 0, each lobe's g scaled."""
    types = backend("llvm")
    cosine, tau = np.array([-1.0, 0.2, 0.99]), np.array([0.0, 3.0, 60.0])
    octaves = Octaves(4, attenuation=0.4, contribution=0.6, eccentricity=0.5)
    found = np.array(octaves.source(types.Float(cosine), types.Float(tau), (0.85, -0.3, 0.7), types))
    terms = [0.6**i * two_lobe_numpy(cosine, 0.85 * 0.5**i, -0.3 * 0.5**i, 0.7) * np.exp(-(0.4**i) * tau) for i in (1, 2, 3)]
    np.testing.assert_allclose(found, sum(terms), rtol=1e-5)
    with pytest.raises(InputError, match="octaves = 0"):
        Octaves(0)


@pytest.mark.parametrize("name", ["heap_sun", "plume_sky", "plume_sky over a floor"])
def test_one_octave_is_single_scattering(name: str, tmp_path: Path) -> None:
    """Rationale: cameras, marches, lights, surfaces and background are put together anew.

    Expected behaviour: with one octave the image is the product's own with `max_depth` 2, in the mean and pixel by pixel.
    """
    folder = SCENES / name.split()[0]
    path = folder / "scene.xml"
    if "floor" in name:
        text = path.read_text().replace("</scene>", FLOOR).replace('"hide_emitters" value="true"', '"hide_emitters" value="false"')
        for file in ("density.vol", "sky.exr"):
            (tmp_path / file).symlink_to(folder / file)
        path = tmp_path / "scene.xml"
        path.write_text(text)
    image, other = OctaveRenderer(scene_of(path), Octaves(1)).render(32, seed=1).astype(np.float64), single_scattering(path)
    scale = other.mean()
    assert abs(image.mean() - scale) < 0.02 * scale
    assert np.sqrt(np.mean((image - other) ** 2)) < 0.2 * scale


def test_octaves_add_light_to_single_scattering() -> None:
    """Expected behaviour: more octaves, more light, each adding less once the first few are there; the cloud hides what it hid."""
    scene = scene_of(SCENES / "heap_sun" / "scene.xml")
    means = [float(OctaveRenderer(scene, Octaves(n)).render(8, seed=1).mean()) for n in (1, 2, 4, 8, 12)]
    assert all(b > a for a, b in pairwise(means))
    # The first octaves multiply the light of a dense cloud; after eight of them hardly anything is left to add.
    assert means[3] > 5 * means[0]
    assert means[4] < 1.03 * means[3]


def test_seeds_and_sizes() -> None:
    scene = scene_of(SCENES / "ball_isotropic" / "scene.xml", 16)
    renderer = OctaveRenderer(scene)
    first, again, other = (renderer.render(2, seed) for seed in (1, 1, 2))
    assert first.shape == (16, 16, 3)
    np.testing.assert_array_equal(first, again)
    assert np.any(first != other)
    # Isotropic light stays isotropic, whatever the octave: only the attenuation differs.
    assert 0 < first.mean() < OctaveRenderer(scene, Octaves(attenuation=0.25)).render(2, 1).mean()
