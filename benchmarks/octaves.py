"""Multiple scattering by octaves: what renderers in production use in its place, as a peer of the benchmark.

Wrenninge, Kulla and Lundqvist, "Oz: The Great and Volumetric", ACM SIGGRAPH 2013 Talks: light that has scattered often is taken for light
that has scattered once in a medium that hides less and scatters less forward. With the optical depth tau toward the light,

    J = albedo E  sum over i = 1 .. n - 1 of  b^i p(cos, c^i g) exp(-a^i tau)

is added to single scattering, the term of i = 0. Each lobe of a phase function has its g scaled. There is no network here: all the rest,
camera, marches, lights and surfaces, is the product's own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from deepclouds_runtime import stratified
from deepclouds_runtime._mitsuba import mitsuba, plain, types_of
from deepclouds_runtime.camera import Camera
from deepclouds_runtime.disc import background
from deepclouds_runtime.lights import Shade, environment
from deepclouds_runtime.march import depths
from deepclouds_runtime.scene import CloudScene
from deepclouds_runtime.stratified import Stratified
from deepclouds_runtime.surfaces import reflected
from deepclouds_runtime.transport import Cloud, Lights, opacity_of, single_scattering, taker
from numpy.typing import NDArray

from deepclouds.errors import InputError
from deepclouds.medium.field import Field
from deepclouds.medium.optical_depth import optical_depth
from deepclouds.medium.phase import two_lobe

Image = NDArray[np.float32]
# Camera samples in flight, collisions of each, and directions drawn from an environment at each collision: those of the product.
_PASS = 1 << 19
_DEPTHS = 4
_DIRECTIONS = 2


@dataclass(frozen=True)
class Octaves:
    """Parameters of the approximation.

    Attributes
    ----------
    count
        octaves, single scattering among them. With contributions that halve, more than eight would add less than a hundredth to the sum.
    attenuation, contribution, eccentricity
        a, b and c above: the factors from octave to octave of the extinction, of the light and of g. All three are a half, the value that
        implementations begin with; fitting them to a picture would be an artist's work.
    """

    count: int = 8
    attenuation: float = 0.5
    contribution: float = 0.5
    eccentricity: float = 0.5

    def __post_init__(self) -> None:
        if self.count < 1:
            raise InputError(f"octaves = {self.count}: the first one is single scattering; give 1 or more")

    def source(self, cosine: Any, tau: Any, phase: tuple[float, float, float], types: Any) -> Any:
        """J over albedo and irradiance of light that arrives through `tau`, Float arrays; `phase` is (g1, g2, weight)."""
        total = types.Float(0)
        for i in range(1, self.count):
            g1, g2 = (dr.opaque(types.Float, g * self.eccentricity**i) for g in phase[:2])
            scattered = two_lobe(cosine, g1, g2, dr.opaque(types.Float, phase[2])) * dr.exp(-tau * self.attenuation**i)
            total += self.contribution**i * scattered
        return total


class OctaveRenderer:
    """A scene with single scattering and octaves; what depends on neither sun nor camera is kept between renders.

    Parameters
    ----------
    scene
        what `deepclouds_runtime.scene.read_scene` returns.
    octaves
        the approximation's parameters.
    """

    def __init__(self, scene: CloudScene, octaves: Octaves | None = None) -> None:
        self.scene, self.octaves = scene, octaves or Octaves()
        self._types = types_of(mitsuba())
        self._cloud = Cloud(Field(self._types, scene.volume, scene.scale), scene.albedo, scene.phase, None)

    def render(self, spp: int, seed: int = 0) -> Image:
        """Linear image (h, w, 3) of `spp` samples a pixel.

        Notes
        -----
        Surfaces are lit through the cloud, but neither by it nor do they light it.
        """
        types, scene = self._types, self.scene
        shade = Shade(types, scene.surfaces)
        sources = [] if scene.environment is None else [(environment(types, scene.environment, shade), _DIRECTIONS)]
        lights = Lights(scene.suns, tuple(sources), shade)
        camera = Camera(types, scene.sensor)
        width, height = scene.size
        image = np.empty((width * height, 3), np.float32)
        rows = max(1, _PASS // spp)
        for start in range(0, width * height, rows):
            pixels = np.arange(start, min(start + rows, width * height), dtype=np.uint32)
            index = dr.arange(types.UInt32, len(pixels) * spp)
            local = index // dr.opaque(types.UInt32, spp)
            pixel = dr.gather(types.UInt32, types.UInt32(pixels), local)
            count = dr.opaque(types.UInt32, spp)
            numbers = Stratified(types, pixel, index - local * count, count, dr.opaque(types.UInt32, seed & 0xFFFFFFFF))
            for c, colour in enumerate(self._samples(camera, lights, pixel, numbers)):
                image[pixels, c] = np.array(dr.block_sum(colour, spp)) / spp
        return image.reshape(height, width, 3)

    def _samples(self, camera: Camera, lights: Lights, pixel: Any, numbers: Stratified) -> list[Any]:
        """Radiance of camera samples, one Float a colour channel."""
        mi, types, scene = mitsuba(), self._types, self.scene
        origin, direction, end = camera.rays(pixel, numbers)
        interaction: Any = None
        shown = types.Bool(False)
        if scene.surfaces is not None:
            ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction))
            ray.maxt = mi.Float(end)
            interaction = scene.surfaces.ray_intersect(ray)
            shown = plain(types, interaction.is_valid())
            end = dr.select(shown, plain(types, interaction.t), end)
        colours, through = self._cloud_light(lights, origin, direction, end, numbers)
        if interaction is not None:
            colours = [a + b * through for a, b in zip(colours, reflected(self._cloud, lights, interaction, numbers), strict=True)]
        look = None if scene.hide_emitters else background(types, scene.backdrop, scene.suns)
        if look is not None:
            sky, _ = look(direction)
            colours = [a + dr.select(shown, 0, b * through) for a, b in zip(colours, sky, strict=True)]
        dr.eval(colours)
        return colours

    def _cloud_light(self, lights: Lights, origin: Any, direction: Any, end: Any, numbers: Stratified) -> tuple[list[Any], Any]:
        """What the cloud sends back along rays, one Float a colour channel, and what it lets pass."""
        types, cloud = self._types, self._cloud
        n, channels = dr.width(origin, direction, end), len(cloud.albedo)
        tau = optical_depth(cloud.field, origin, direction, types.Float(0), end, types.Bool(True))
        hidden = opacity_of(tau)
        through = dr.exp(-tau)
        colours = [dr.zeros(types.Float, n) for _ in range(channels)]
        dr.eval(hidden, through, origin, direction, end)
        lanes: Any = dr.compress(hidden > 0)
        if len(lanes) == 0 or not any(a > 0 for a in cloud.albedo):
            return colours, through
        o, d, e, hidden = map(taker(types, lanes), (origin, direction, end, hidden))
        own = numbers.take(lanes)
        distance = depths(cloud.field, o, d, e, hidden, own.number(stratified.SHARE), _DEPTHS, types.Bool(True))
        dr.eval(distance)
        take = taker(types, dr.arange(types.UInt32, len(lanes) * _DEPTHS) // dr.opaque(types.UInt32, _DEPTHS))
        w = take(d)
        points = dr.fma(w, distance, take(o))
        more = [dr.zeros(types.Float, len(lanes) * _DEPTHS) for _ in range(channels)]

        def octaves(omega: Any, radiance: list[Any], depth: Any) -> None:
            source = self.octaves.source(dr.dot(w, omega), depth, cloud.phase, types)
            for c in range(channels):
                more[c] += dr.opaque(types.Float, cloud.albedo[c]) * radiance[c] * source
            dr.eval(more)

        single = single_scattering(cloud, lights, points, w, own.several(_DEPTHS), octaves if self.octaves.count > 1 else None)
        for c in range(channels):
            dr.scatter(colours[c], dr.block_sum(single[c] + more[c], _DEPTHS) * hidden * (1 / _DEPTHS), lanes)
        return colours, through
