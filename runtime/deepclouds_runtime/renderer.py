"""Renders a scene that was read: camera samples in passes, the cloud's light along them, surfaces and background behind it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepclouds.errors import InputError
from deepclouds.medium.field import Field
from deepclouds_runtime import stratified
from deepclouds_runtime._mitsuba import mitsuba, plain, types_of
from deepclouds_runtime.camera import Camera
from deepclouds_runtime.lights import Shade, environment, mitsuba_radiance
from deepclouds_runtime.scattering import NetworkScattering, Predicts, WalkScattering
from deepclouds_runtime.scene import CloudScene
from deepclouds_runtime.stratified import Stratified
from deepclouds_runtime.surfaces import Reflectors, reflected, reflected_from_cloud
from deepclouds_runtime.transport import Cloud, Counts, Lights, cloud_light

Image = NDArray[np.float32]

# Camera samples in flight: enough to fill the machine, few enough to stay below 1 GB.
_PASS = 1 << 19
# A pixel's samples are in flight together.
_MOST_SAMPLES = 1 << 20
COLOURS = ("R", "G", "B")
LAYERS = ("volume_direct", "volume_indirect", "surface", "background")


@dataclass
class RenderResult:
    """An image with its parts.

    Attributes
    ----------
    rgb
        (h, w, 3) linear Rec. 709 radiance.
    alpha
        (h, w) share of each pixel that shows cloud, surface or a visible environment.
    channels
        name -> (h, w): ``R, G, B, A``; ``volume_direct.*``, ``volume_indirect.*``, ``surface.*`` and ``background.*``, whose sum is
        the image; ``volume_opacity``; ``volume_Z``, the mean distance from the camera of what hides, world units, 0 without cloud.
    seconds
        stage -> seconds; ``load`` is what was done once, ``total`` all the rest.
    counts
        camera samples, those that met the cloud, network queries made and skipped.
    notes
        what was approximated, in sentences.
    """

    rgb: Image
    alpha: Image
    channels: dict[str, Image]
    seconds: dict[str, float]
    counts: Counts
    notes: tuple[str, ...] = ()


class Renderer:
    """One scene, loaded once and rendered as often as asked.

    What depends on neither sun nor camera is kept: the extinction on the device, the pyramid of filtered levels, the network.

    Parameters
    ----------
    scene
        what `deepclouds_runtime.scene.read_scene` returns.
    predictor
        the network; not needed with ``multiple = "walks"`` or in a scene with ``max_depth = 2``.
    multiple
        ``"network"``, or ``"walks"``: J from one Monte Carlo walk a query in place of the network, for tests and references.
    environment_directions
        directions drawn from an environment at each sample of the cloud.
    interreflection
        whether surfaces receive the cloud's light, and the cloud that of the surfaces. Light that goes back and forth more than once,
        and light from one surface to another, are left out.
    load_seconds
        what loading took before, reported as ``seconds["load"]``.

    Raises
    ------
    InputError
        for an unknown `multiple`.
    """

    def __init__(
        self,
        scene: CloudScene,
        predictor: Predicts | None = None,
        *,
        multiple: str = "network",
        environment_directions: int = 2,
        interreflection: bool = True,
        load_seconds: float = 0.0,
    ) -> None:
        if multiple not in ("network", "walks"):
            raise InputError(f"multiple = '{multiple}': J comes from 'network' or 'walks'")
        if environment_directions < 1:
            raise InputError(f"environment directions = {environment_directions}: at least one is drawn at each sample")
        started = time.perf_counter()
        self.scene = scene
        self._multiple = multiple
        self.environment_directions = environment_directions
        self._types = types_of(mitsuba())
        self._field = Field(self._types, scene.volume, scene.scale)
        self._network: NetworkScattering | None = None
        if scene.max_depth != 2 and multiple == "network":
            if predictor is None:
                raise InputError("multiple scattering needs a model; give one, or render single scattering alone (max_depth 2)")
            self._network = NetworkScattering(self._field, predictor)
        # Single scattering alone stops before light that surfaces have reflected, as volpath with max_depth 2 does.
        self._interreflection = interreflection and scene.surfaces is not None and scene.max_depth != 2
        self.model_hash: str | None = getattr(getattr(predictor, "metadata", None), "initialisers_sha256", None)
        self._load_seconds = load_seconds + time.perf_counter() - started

    def samples(self, spp: int | None) -> int:
        """Samples a pixel of a render that is asked for `spp`: those of the camera's sampler for None."""
        count = int(self.scene.sensor.sampler().sample_count()) if spp is None else int(spp)
        if count < 1:
            raise InputError(f"spp = {count}: a pixel needs at least one sample")
        if count > _MOST_SAMPLES:
            raise InputError(f"spp = {count}: at most {_MOST_SAMPLES:,}; average several renders with different seeds")
        return count

    def render(self, spp: int | None = None, seed: int = 0, progress: Callable[[float], None] | None = None) -> RenderResult:
        """Render an image.

        Parameters
        ----------
        spp
            samples a pixel; by default those of the camera's sampler.
        seed
            of all random numbers.
        progress
            is called with the share of the work done, 0 to 1.

        Raises
        ------
        InputError
            when `spp` is below 1 or above 1,048,576.
        """
        scene, types = self.scene, self._types
        samples = self.samples(spp)
        started = time.perf_counter()
        scattering = None
        if scene.max_depth != 2:
            scattering = self._network if self._multiple == "network" else WalkScattering(self._field, 1, seed)
        cloud, lights = Cloud(self._field, scene.albedo, scene.phase, scattering), self._lights()
        work = _Work(scene, Camera(types, scene.sensor), cloud, lights, lights, types, samples, seed, self._interreflection)
        work.spent("lights", started)
        if self._interreflection:
            clock = time.perf_counter()
            reflectors = Reflectors(cloud, lights, seed & 0xFFFFFFFF, work.counts)
            work.on_cloud = replace(lights, sources=(*lights.sources, (reflectors, 1)))
            work.spent("probe", clock)
        width, height = scene.size
        total = width * height
        pixels = max(1, _PASS // samples)
        for first in range(0, total, pixels):
            work.add(first, min(pixels, total - first))
            if progress is not None:
                progress(min(first + pixels, total) / total)
        channels = work.image(height, width)
        seconds = {"load": self._load_seconds, **work.seconds, "total": time.perf_counter() - started}
        rgb = np.stack([channels[c] for c in COLOURS], axis=-1)
        return RenderResult(rgb, channels["A"], channels, seconds, work.counts, scene.notes)

    def _lights(self) -> Lights:
        """The lights, with the tables that depend on them: made anew for each render."""
        shade = Shade(self._types, self.scene.surfaces)
        sources = []
        if self.scene.environment is not None:
            sources.append((environment(self._types, self.scene.environment, shade), self.environment_directions))
        return Lights(self.scene.suns, tuple(sources), shade)


@dataclass
class _Work:
    """The passes of one render and what they gathered."""

    scene: CloudScene
    camera: Camera
    cloud: Cloud
    on_surfaces: Lights
    on_cloud: Lights
    types: Any
    samples: int
    seed: int
    interreflection: bool
    counts: Counts = field(default_factory=Counts)
    seconds: dict[str, float] = field(default_factory=dict)
    rows: dict[str, list[Image]] = field(default_factory=dict)

    def add(self, first: int, pixels: int) -> None:
        """Render `pixels` pixels from number `first` on, all of their samples."""
        types, scene = self.types, self.scene
        n = pixels * self.samples
        self.counts.camera_samples += n
        count = dr.opaque(types.UInt32, self.samples)
        index = dr.arange(types.UInt32, n)
        local = index // count
        pixel = local + dr.opaque(types.UInt32, first)
        numbers = Stratified(types, pixel, index - local * count, count, dr.opaque(types.UInt32, self.seed & 0xFFFFFFFF))
        origin, direction, end = self.camera.rays(pixel, numbers)
        interaction: Any = None
        shown: Any = None
        if scene.surfaces is not None:
            interaction, end, shown = self._surfaces(origin, direction, end)
        clock = time.perf_counter()
        light = cloud_light(self.cloud, self.on_cloud, origin, direction, end, numbers, self.counts)
        dr.eval(light.direct, light.indirect)
        dr.sync_thread()
        self.spent("cloud", clock)
        clock = time.perf_counter()
        self._collect("volume_direct", light.direct)
        self._collect("volume_indirect", light.indirect)
        self._collect("volume_opacity", [light.opacity])
        depth = self.camera.distance(dr.fma(direction, light.distance, origin))
        self._collect("volume_Z", [depth * light.opacity])
        through = light.transmittance
        behind = through
        alpha = light.opacity
        if interaction is not None:
            colours = reflected(self.cloud, self.on_surfaces, interaction, numbers)
            if self.interreflection:
                weight = dr.select(shown, through, 0)
                thrown = reflected_from_cloud(self.cloud, self.on_cloud, interaction, weight, numbers, self.counts)
                colours = [a + b for a, b in zip(colours, thrown, strict=True)]
            self._collect("surface", [value * through for value in colours])
            behind = dr.select(shown, 0, through)
            alpha = alpha + dr.select(shown, through, 0)
        if scene.backdrop is not None and not scene.hide_emitters:
            sky = mitsuba_radiance(types, scene.backdrop)(direction)
            self._collect("background", [value * behind for value in sky])
            alpha = alpha + behind
        self._collect("A", [alpha])
        self.spent("surfaces and background", clock)

    def _surfaces(self, origin: Any, direction: Any, end: Any) -> tuple[Any, Any, Any]:
        """What the rays hit, where they end, and whether they hit anything."""
        mi, types = mitsuba(), self.types
        ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction))
        ray.maxt = mi.Float(end)
        interaction = self.scene.surfaces.ray_intersect(ray)
        shown = plain(types, interaction.is_valid())
        return interaction, dr.select(shown, plain(types, interaction.t), end), shown

    def _collect(self, name: str, values: list[Any]) -> None:
        """Average the samples of each pixel and keep the result under `name`."""
        n = self.samples
        # Together, or each channel would trace its own rays again.
        dr.eval(values)
        rows = [np.array(dr.block_sum(value, n)) * np.float32(1 / n) for value in values]
        self.rows.setdefault(name, []).append(np.stack(rows, axis=-1))

    def spent(self, stage: str, since: float) -> None:
        """Add the seconds since `since` to a stage."""
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - since

    def image(self, height: int, width: int) -> dict[str, Image]:
        """All channels (h, w) of the finished image."""
        channels: dict[str, Image] = {}
        beauty = np.zeros((height, width, 3), np.float32)
        for layer in LAYERS:
            if layer in self.rows:
                values = np.concatenate(self.rows[layer]).reshape(height, width, -1)
                values = np.broadcast_to(values, (height, width, 3))
            else:
                values = np.zeros((height, width, 3), np.float32)
            beauty = beauty + values
            for c, colour in enumerate(COLOURS):
                channels[f"{layer}.{colour}"] = np.ascontiguousarray(values[..., c])
        single = {name: np.concatenate(self.rows[name]).reshape(height, width) for name in ("volume_opacity", "volume_Z", "A")}
        opacity = single["volume_opacity"]
        channels |= {colour: np.ascontiguousarray(beauty[..., c]) for c, colour in enumerate(COLOURS)}
        channels["A"] = np.minimum(single["A"], 1)
        channels["volume_opacity"] = opacity
        channels["volume_Z"] = np.where(opacity > 0, single["volume_Z"] / np.where(opacity > 0, opacity, 1), 0).astype(np.float32)
        return channels
