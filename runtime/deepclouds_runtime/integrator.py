"""The Mitsuba integrator plugin `deepclouds`.

| parameter | type | meaning |
|---|---|---|
| max_depth | integer | -1: all orders of scattering (default); 2: single scattering alone; other values are refused |
| rr_depth | integer | accepted for scenes written for `volpath`, and ignored: there are no paths to end |
| hide_emitters | boolean | black behind the cloud in place of the environment (default false) |
| model | string | path of a network, or the name of a released one (default: the one that comes with the package) |
| environment_directions | integer | directions drawn from an environment at each sample of the cloud (default 2) |
| interreflection | boolean | light that surfaces and cloud, and surfaces, throw on each other (default true) |
| mode | string | `fast` (default), or `reference`: every sample asks the network |
| error | float | of the fast mode without a number of samples: noise of a pixel to aim at over the mean (default 0.02) |
| exact_orders | integer | orders of scattering that are sampled before the network is asked (default 1) |
| unbiased | boolean | trace paths in place of asking the network (default false) |
| extrapolate | boolean | ask the network about media that it was not trained on, in place of walks there (default false) |

The plugin exists in Python, after ``import deepclouds_runtime``, in the variants ``llvm_ad_rgb``, ``llvm_ad_mono``, ``cuda_ad_rgb`` and
``cuda_ad_mono``; Mitsuba's own command line is a C++ program that does not see it. It renders whole images only: there are no gradients,
and other pixel filters than `box` are replaced by it.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from deepclouds.errors import InputError
from deepclouds_runtime._mitsuba import VARIANTS

NAME = "deepclouds"


def register() -> None:
    """Make the plugin known to Mitsuba's current variant; in variants that it cannot run in, it says so when a scene asks for it."""
    import mitsuba as mi

    variant = mi.variant()
    if variant is None:
        return
    mi.register_integrator(NAME, _integrator_class(mi) if variant in VARIANTS else _refuse)


def _refuse(properties: Any) -> Any:
    import mitsuba as mi

    raise InputError(f"the integrator '{NAME}' does not run in Mitsuba's variant '{mi.variant()}'; choose one of {', '.join(VARIANTS)}")


def _integrator_class(mi: Any) -> Any:
    # Each variant has base classes of its own, so the class is made anew for each.
    class DeepCloudsIntegrator(mi.SamplingIntegrator):  # type: ignore[misc]
        """See the module."""

        def __init__(self, properties: Any) -> None:
            from deepclouds_runtime.scene import check_depth

            super().__init__(properties)
            self.max_depth = check_depth(int(properties.get("max_depth", -1)))
            self.rr_depth = int(properties.get("rr_depth", 5))
            self.model = str(properties.get("model", "")) or None
            self.environment_directions = int(properties.get("environment_directions", 2))
            self.interreflection = bool(properties.get("interreflection", True))
            self.mode = str(properties.get("mode", "fast"))
            self.error = float(properties.get("error", 0.02))
            self.exact_orders = int(properties.get("exact_orders", 1))
            self.unbiased = bool(properties.get("unbiased", False))
            self.extrapolate = bool(properties.get("extrapolate", False))

        def render(self, scene: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0, develop: bool = True, evaluate: bool = True) -> Any:
            """Render through the film: a tensor (h, w, channels of the film's pixel format), empty unless `develop`."""
            from deepclouds_runtime.predictor import kept
            from deepclouds_runtime.renderer import Renderer
            from deepclouds_runtime.scene import read_scene

            started = time.perf_counter()
            read = read_scene(scene, sensor, self.max_depth, bool(self.hide_emitters))
            needs_model = self.max_depth != 2 and not self.unbiased
            renderer = Renderer(
                read,
                kept(self.model) if needs_model else None,
                unbiased=self.unbiased,
                exact_orders=self.exact_orders,
                environment_directions=self.environment_directions,
                interreflection=self.interreflection,
                mode=self.mode,
                extrapolate=self.extrapolate,
                load_seconds=time.perf_counter() - started,
            )
            # A number of samples is forced, whatever their noise.
            how = {"spp": spp} if spp > 0 else {"error": self.error}
            result = renderer.render(seed=int(np.ravel(np.array(seed))[0]), **how)
            return _develop(mi, read.sensor.film(), result, develop)

        def to_string(self) -> str:
            return (
                f"DeepCloudsIntegrator[\n  max_depth = {self.max_depth},\n  hide_emitters = {bool(self.hide_emitters)},\n"
                f"  model = {self.model or 'default'},\n  environment_directions = {self.environment_directions},\n"
                f"  interreflection = {self.interreflection},\n  exact_orders = {self.exact_orders},\n  unbiased = {self.unbiased}\n]"
            )

    return DeepCloudsIntegrator


def _develop(mi: Any, film: Any, result: Any, develop: bool) -> Any:
    """Put the image into the film, so that its pixel format holds and `film.bitmap()` works."""
    channels = film.prepare([])
    # A film stores R, G, B, then alpha if it has one, then the weight.
    planes = [result.rgb, np.ones_like(result.alpha)[..., None]]
    if channels == 5:
        planes.insert(1, result.alpha[..., None])
    block = mi.ImageBlock(mi.TensorXf(np.ascontiguousarray(np.concatenate(planes, axis=-1))), film.crop_offset())
    film.put_block(block)
    return film.develop() if develop else mi.TensorXf()
