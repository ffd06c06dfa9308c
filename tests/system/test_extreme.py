"""Rationale: a renderer meets scenes at the ends of every range; whatever they hold, an image must stay finite and not negative.

Expected behaviour: about a hundred tiny renders with a stand-in for the network, none with NaN, Inf or a negative value in any channel,
layers that add up, and an alpha between 0 and 1.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from deepclouds_runtime._mitsuba import mitsuba
from deepclouds_runtime.renderer import Renderer
from deepclouds_runtime.result import COLOURS, LAYERS, RenderResult
from deepclouds_runtime.scene import CloudScene, surfaces_alone
from deepclouds_runtime.scene_lights import read_lights
from numpy.typing import NDArray

from deepclouds.volume import Volume


class Formula:
    """Stands in for a network: smooth, positive, and moved by every input."""

    def predict(self, stencil: NDArray[np.float32], aux: NDArray[np.float32]) -> NDArray[np.float32]:
        """Some j (n,)."""
        assert np.all(np.isfinite(stencil))
        assert np.all(np.isfinite(aux))
        assert np.all(stencil >= 0)
        depth = np.log1p(stencil.mean(axis=(1, 2)))
        value: NDArray[np.float32] = (depth * np.exp(-0.3 * aux[:, 5]) * (1 + aux[:, 4] + 0.1 * np.cos(aux[:, 0]))).astype(np.float32)
        return value


@dataclass(frozen=True)
class Case:
    """A scene around one grid; lengths in units of the box's half size."""

    density: str = "ball"
    optical_depth: float = 8.0
    g: float = 0.85
    albedo: tuple[float, ...] = (1.0, 0.9, 0.5)
    sun: tuple[float, float, float] | None = (0.5, 0.7, 0.4)
    sky: str | None = None
    origin: tuple[float, float, float] = (0.3, 0.4, 4.0)
    target: tuple[float, float, float] = (0.0, 0.0, 0.0)
    half: tuple[float, float, float] = (1.0, 1.0, 1.0)
    world: float = 1.0
    size: tuple[int, int] = (8, 8)
    surface: str | None = None
    max_depth: int = -1
    spp: int = 2


def _grid(kind: str) -> NDArray[np.float32]:
    if kind == "ball":
        c = (np.arange(8) + 0.5) / 4 - 1
        z, y, x = np.meshgrid(c, c, c, indexing="ij")
        return np.clip(1.2 - np.sqrt(x * x + y * y + z * z), 0, 1).astype(np.float32)
    if kind == "spike":
        grid = np.zeros((6, 6, 6), np.float32)
        grid[3, 2, 4] = 1
        return grid
    if kind == "noise":
        return np.random.default_rng(5).random((7, 5, 6)).astype(np.float32) ** 8
    shape = tuple(int(n) for n in kind.removeprefix("zeros").removeprefix("ones").split("x"))
    return (np.zeros if kind.startswith("zeros") else np.ones)(shape, np.float32)


SURFACES: dict[str, dict[str, Any]] = {
    "behind": {"type": "rectangle", "at": (0, 0, -3), "scale": 6},
    "in front": {"type": "sphere", "at": (0.2, 0.2, 2.4), "scale": 0.3},
    "inside": {"type": "sphere", "at": (0, 0, 0), "scale": 0.4},
    "around": {"type": "sphere", "at": (0, 0, 0), "scale": 20},
    "mirror": {"type": "sphere", "at": (-1.5, 0, 0), "scale": 0.6, "bsdf": {"type": "conductor"}},
}


@pytest.fixture(scope="module")
def mi() -> Iterator[ModuleType]:
    import mitsuba as module

    before = module.variant()
    module.set_variant("llvm_ad_rgb")
    yield mitsuba()
    if before is not None:
        module.set_variant(before)


def _render(mi: Any, case: Case) -> RenderResult:
    half = np.array(case.half) * case.world
    grid = _grid(case.density)
    volume = Volume.from_box(grid, -half, half)
    line = float(grid.sum(axis=2).max() * volume.voxel_size[0])
    description: dict[str, Any] = {"type": "scene"}
    if case.sun is not None:
        description["sun"] = {"type": "directional", "direction": [-v for v in case.sun], "irradiance": {"type": "rgb", "value": [3, 2, 1]}}
    if case.sky == "constant":
        description["sky"] = {"type": "constant", "radiance": {"type": "rgb", "value": [0.2, 0.3, 0.5]}}
    elif case.sky is not None:
        image = np.full((8, 16, 3), 0.1, np.float32)
        image[2, 5] = 1e5 if case.sky == "bright pixel" else 0.1
        image = np.zeros_like(image) if case.sky == "black" else image
        description["sky"] = {"type": "envmap", "bitmap": mi.Bitmap(image)}
    world = [v * case.world for v in case.origin]
    target = [v * case.world for v in case.target]
    up = (
        [0, 1, 0]
        if abs(np.array(case.target)[1] - case.origin[1]) < 0.9 * np.linalg.norm(np.array(case.target) - case.origin)
        else [1, 0, 0]
    )
    description["camera"] = {
        "type": "perspective",
        "fov": 40,
        "near_clip": 1e-3 * case.world,
        "far_clip": 1e8 * case.world,
        "to_world": mi.ScalarTransform4f().look_at(origin=world, target=target, up=up),
        "film": {"type": "hdrfilm", "width": case.size[0], "height": case.size[1], "rfilter": {"type": "box"}},
    }
    if case.surface is not None:
        shape = dict(SURFACES[case.surface])
        at, scale = [v * case.world for v in shape.pop("at")], shape.pop("scale") * case.world
        shape["to_world"] = mi.ScalarTransform4f().translate(at) @ mi.ScalarTransform4f().scale(scale)
        shape.setdefault("bsdf", {"type": "twosided", "inner": {"type": "diffuse"}})
        description["surface"] = shape
    scene = mi.load_dict(description)
    lights = read_lights(scene.emitters())
    read = CloudScene(
        volume,
        case.optical_depth / line if line > 0 else 1.0,
        case.albedo,
        (case.g, 0.0, 1.0),
        lights.suns,
        lights.environment,
        surfaces_alone(list(scene.shapes())),
        scene.sensors()[0],
        max_depth=case.max_depth,
        backdrop=lights.backdrop,
    )
    return Renderer(read, Formula()).render(case.spp, seed=3)


BASE = Case()
CASES: dict[str, Case] = {
    "empty grid": replace(BASE, density="zeros4x4x4"),
    "empty voxel": replace(BASE, density="zeros1x1x1"),
    "one voxel": replace(BASE, density="ones1x1x1"),
    "spike": replace(BASE, density="spike"),
    "noise": replace(BASE, density="noise"),
    "noise, thick": replace(BASE, density="noise", optical_depth=1e3),
    "homogeneous, thick": replace(BASE, density="ones2x2x2", optical_depth=1e5),
    "1 x 1 image": replace(BASE, size=(1, 1)),
    "wide image": replace(BASE, size=(33, 1)),
    "tall image": replace(BASE, size=(1, 33)),
    "one sample": replace(BASE, spp=1),
    "many samples": replace(BASE, size=(1, 1), spp=1000),
    "single scattering": replace(BASE, max_depth=2),
    "no light": replace(BASE, sun=None),
    "far camera": replace(BASE, origin=(0, 100, 1e4)),
    "very far camera": replace(BASE, origin=(1e5, 1e5, 1e6)),
    "camera looks away": replace(BASE, origin=(0, 0, 4), target=(0, 0, 8)),
    "camera at the face": replace(BASE, origin=(0, 0, 1)),
    "camera at a corner": replace(BASE, origin=(1, 1, 1)),
    "flat voxels": replace(BASE, half=(1, 0.05, 1)),
    "long voxels": replace(BASE, half=(20, 1, 1), origin=(0, 3, 60)),
    "extreme voxels": replace(BASE, half=(1000, 1, 0.01), origin=(0, 30, 3000)),
    "grey albedo": replace(BASE, albedo=(0.9, 0.9, 0.9)),
    "black": replace(BASE, albedo=(0, 0, 0)),
    "white": replace(BASE, albedo=(1, 1, 1)),
    "one black channel": replace(BASE, albedo=(1, 0, 0.5)),
}
CASES |= {
    f"grid {kind}": replace(BASE, density=f"ones{kind}")
    for kind in ("1x1x5", "1x5x1", "5x1x1", "1x4x4", "4x1x4", "4x4x1", "2x3x50", "50x2x1")
}
CASES |= {f"optical depth {depth:g}": replace(BASE, optical_depth=depth) for depth in (0, 1e-20, 1e-6, 1e-3, 1, 100, 1e3, 1e5, 1e8)}
CASES |= {f"g {g}": replace(BASE, g=g) for g in (-0.99, -0.5, 0.0, 1e-4, 0.5, 0.99, 0.999)}
CASES |= {f"g {g} under a sky": replace(BASE, g=g, sky="map") for g in (-0.99, 0.0, 0.99)}
CASES |= {f"albedo {a}": replace(BASE, albedo=(a, a, a)) for a in (1e-6, 0.5, 0.999999)}
AXES = {"+x": (1, 0, 0), "-x": (-1, 0, 0), "+y": (0, 1, 0), "-y": (0, -1, 0), "+z": (0, 0, 1), "-z": (0, 0, -1)}
CASES |= {f"sun along {name}": replace(BASE, sun=axis) for name, axis in AXES.items()}
CASES |= {f"view from {name}": replace(BASE, origin=(4 * axis[0], 4 * axis[1], 4 * axis[2])) for name, axis in AXES.items()}
for g in (0.0, 0.99):
    CASES[f"into the sun, g {g}"] = replace(BASE, sun=(0, 0, -1), origin=(0, 0, 4), g=g, size=(9, 9))
    CASES[f"away from the sun, g {g}"] = replace(BASE, sun=(0, 0, 1), origin=(0, 0, 4), g=g, size=(9, 9))
    CASES[f"camera inside, g {g}"] = replace(BASE, origin=(0.1, 0.2, -0.3), target=(1, 0, 0), g=g)
CASES |= {f"camera inside, optical depth {d:g}": replace(BASE, origin=(0.1, 0, 0), target=(0, 1, 0), optical_depth=d) for d in (1e-3, 1e4)}
CASES |= {f"world of {world:g}": replace(BASE, world=world) for world in (1e-4, 1e-2, 1e2, 1e4)}
CASES |= {f"world of {world:g}, floor and sky": replace(BASE, world=world, surface="behind", sky="constant") for world in (1e-4, 1e4)}
CASES |= {f"sky: {sky}": replace(BASE, sky=sky, sun=None) for sky in ("constant", "map", "bright pixel", "black")}
CASES |= {f"sun and sky: {sky}": replace(BASE, sky=sky) for sky in ("constant", "bright pixel")}
CASES |= {f"camera inside, sky {sky}": replace(BASE, sky=sky, sun=None, origin=(0.1, 0.2, 0.3)) for sky in ("constant", "map")}
CASES |= {f"empty grid, sky {sky}": replace(BASE, sky=sky, density="zeros4x4x4") for sky in ("constant", "map")}
CASES |= {f"surface {name}": replace(BASE, surface=name) for name in SURFACES}
CASES |= {f"surface {name}, sky": replace(BASE, surface=name, sky="map", sun=None) for name in SURFACES}
CASES |= {f"surface {name}, no cloud": replace(BASE, surface=name, density="zeros4x4x4") for name in ("behind", "inside")}
CASES |= {f"surface {name}, thick": replace(BASE, surface=name, optical_depth=1e5) for name in ("behind", "around")}


@pytest.mark.parametrize("name", CASES)
def test_images_are_finite_and_not_negative(mi: ModuleType, name: str) -> None:
    case = CASES[name]
    result = _render(mi, case)
    assert result.rgb.shape == (case.size[1], case.size[0], 3)
    for channel, values in result.channels.items():
        assert np.all(np.isfinite(values)), f"{channel}: {np.count_nonzero(~np.isfinite(values))} values are not finite"
        assert values.min() >= 0, f"{channel} goes down to {values.min()}"
    assert result.alpha.max() <= 1
    assert result.channels["volume_opacity"].max() <= 1 + 1e-6
    for c, colour in enumerate(COLOURS):
        parts = sum(result.channels[f"{layer}.{colour}"].astype(np.float64) for layer in LAYERS)
        np.testing.assert_allclose(result.rgb[..., c], parts, rtol=1e-5)
    if case.density.startswith("zeros") or case.optical_depth == 0:
        assert result.channels["volume_opacity"].max() == 0
    if case.albedo == (0, 0, 0):
        assert all(result.channels[f"volume_{part}.{c}"].max() == 0 for part in ("direct", "indirect") for c in COLOURS)


def test_the_cases_show_something(mi: ModuleType) -> None:
    """A scene in the middle of every range is lit, so that the test above does not pass on black images."""
    result = _render(mi, replace(BASE, size=(16, 16), spp=8))
    assert result.channels["volume_direct.R"].max() > 1e-3
    assert result.channels["volume_indirect.R"].max() > 1e-3
    assert 0.5 < result.channels["volume_opacity"].max() <= 1
    assert len(CASES) >= 95
