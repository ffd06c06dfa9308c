"""One frame: what is predicted for it, its passes of camera samples, and the light along them."""

from __future__ import annotations

import functools
import itertools
import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepclouds.backend import lanes_of, vectors_of
from deepclouds_runtime import pilot
from deepclouds_runtime._mitsuba import mitsuba, plain
from deepclouds_runtime.adaptive import DARK, Adaptive
from deepclouds_runtime.all_round import ORDER, AllRound, spread
from deepclouds_runtime.audit import FEWEST, MOST, ROUND, WALKS_A_PIXEL, WALKS_A_SIGHT, Audit, audited
from deepclouds_runtime.camera import Camera, Window
from deepclouds_runtime.confidence import confidence, relative_errors
from deepclouds_runtime.disc import background, looks_into
from deepclouds_runtime.fast import fast_cloud_light
from deepclouds_runtime.film import Film
from deepclouds_runtime.frame_source import (
    Arriving,
    FrameSource,
    Seen,
    frame_source,
    from_beams,
    from_source,
    from_suns,
    of_beams,
    part_of_time,
    seen_by,
)
from deepclouds_runtime.light_walks import BRIGHT, LightWalks, Paths
from deepclouds_runtime.lights import Environment, LightSource
from deepclouds_runtime.result import Image
from deepclouds_runtime.scattering import NetworkScattering
from deepclouds_runtime.scene import CloudScene
from deepclouds_runtime.stratified import Stratified
from deepclouds_runtime.surfaces import diffuse_share, reflected, reflected_from_cloud, reflected_from_surfaces
from deepclouds_runtime.thrown import ThrownLight
from deepclouds_runtime.transport import Cloud, Counts, Lights, cloud_light
from deepclouds_runtime.walked_source import walked_source

_LOG = logging.getLogger(__name__)
# Noise of a pixel that the fast mode aims at, over the mean.
ERROR = 0.02
# Camera samples in flight: enough to fill the machine, few enough to stay below 1 GB. Those that end in a query or a walk take long, and
# an interruption waits for them.
_PASS, _SLOW_PASS = 1 << 19, 1 << 16
# Rays that look for what of the surfaces is seen.
_SURFACE_RAYS = 1 << 13
# They end so little before it.
_BEFORE = 0.9999
# Most queries for the suns, and as many for the light from all around.
_BUDGET = 60_000
# Directions that stand for light from all around, and the share of it from which one of them is treated as a sun.
_BEAMS, _BRIGHT = 48, 0.1
# The same for light that the cloud throws on surfaces, and for that of surfaces which it throws back to them.
_BEAMS_THROWN, _BEAMS_BACK = 12, 4
# Most collisions of all walks at nodes; of how many on the mean walks are still cheaper than queries, by so many that are tried.
_COLLISIONS_AROUND, _MOST_COLLISIONS, _COUNTED = 1 << 26, 1000.0, 1024
# A quick look has so many times fewer.
_QUICK = 16
# Edge of the coarsest cells in units of length (mean free paths), for the suns and for light from all around, under which J is smoother.
_ROOT, _ROOT_AROUND = 2.0, 4.0
# Edge of the finest cells in pixels, as large as these look at the nearest of what the camera sees, a quantile.
_FINEST, _NEAR = 1.0, 0.1
# Of a thin cloud it is seen first what share of the image's light was scattered more than once, by so many walks and pixels: below so much
# of the error of interpolation aimed at, none of it is rendered, and below a half its errors may be larger, so many times at most.
_TRIED, _NEGLIGIBLE, _LARGE, _MOST_SPARED = 4096, 0.04, 0.5, 4.0
# Error of the interpolation at a point over what is aimed at: where walks correct it later, and of light thrown on surfaces, each point
# of which sees many places.
_CORRECTED, _THROWN = 1.6, 4.0
# Rays from a sample of a surface that look for this light, where they are short: it is noisier than all else in a sample.
_RAYS_THROWN = 2
# Which of a sample's unrelated numbers draw the ray from surface to surface.
_BETWEEN = 9
# Orders of scattering of that light that are sampled at most, and what may be left of a peak in what is scattered more often.
_MOST_EXACT, _PEAK = 3, 0.15
# Collisions of a camera ray that get shadow rays; under suns alone, where these are all that they cost, more: along a ray noise falls with
# their number, not with its root.
_DEPTHS, _DEPTHS_SUNS = 4, 8
# Most walks where the time decides, and by how much longer than a trial says samples take: rounds end before the time does.
_MOST_TIMED, _SLOWER = 1 << 26, 1.3
# There walks come in smaller rounds, and there are none unless there are so many seconds for them.
_TIMED_ROUND, _LEAST_AUDIT = 1 << 15, 0.25
# Of more pixels than these a trial takes one in sixteen, else one in four.
_MANY_PIXELS = 1 << 16
# Of an error that is missed because of the network: samples cost less than the walks that would bring that down.
_LEAST_NOISE = 0.63


@dataclass
class Frame:
    """The passes of one render and what they gathered.

    Attributes
    ----------
    scene, camera, cloud, types, seed
        what is rendered, and the root of all random numbers.
    on_surfaces, on_cloud
        what lights the surfaces, and what lights the cloud.
    interreflection
        whether surfaces receive the cloud's light.
    depths
        collisions of a camera ray that get shadow rays; None chooses by the lights.
    quick
        a quicker network than the cloud's, asked about light from all around and about what surfaces see, which walks correct later; None
        asks the cloud's.
    unknown
        whether the network was not trained on the medium: walks at nodes take its place.
    sampled
        whether multiple scattering is sampled at one of these collisions, past the orders that are exact, in place of interpolated.
    counts, seconds
        work done, and seconds by stage.
    samples
        of the pixels that have taken most.
    sources, named
        multiple scattering of this camera, once it is predicted; and by name, as predicted, before any correction.
    all_round
        multiple scattering as the surfaces see it.
    errors
        the network's error to expect, pixel by pixel, where it knows its errors.
    found
        what an audit found.
    """

    scene: CloudScene
    camera: Camera
    cloud: Cloud
    on_surfaces: Lights
    on_cloud: Lights
    types: Any
    seed: int
    interreflection: bool
    depths: int | None = None
    quick: NetworkScattering | None = None
    unknown: bool = False
    sampled: bool = False
    counts: Counts = field(default_factory=Counts)
    seconds: dict[str, float] = field(default_factory=dict)
    samples: int = 0
    sources: list[FrameSource] | None = None
    named: dict[str, FrameSource] = field(default_factory=dict)
    all_round: AllRound | None = None
    errors: Image | None = None
    found: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.film, self._adaptive = Film(self.scene.size), Adaptive(self.scene.size)
        # Where the image shows the cloud, and what is seen of it there. Found out at once: later, what else waits to be computed would make
        # kernels with it, others in every view.
        to_world = self.cloud.field.volume.to_world
        corners = np.array(list(itertools.product((0.0, 1.0), repeat=3))) @ to_world[:3, :3].T + to_world[:3, 3]
        self._window = self.camera.window(corners)
        self._pilot: pilot.Pilot | None = None
        # What finds J of the light that a thin cloud throws on surfaces.
        self._paths: Paths | None = None
        # What finds J of the light that surfaces send back to it.
        self._probing: Paths | None = None
        # Sources whose single scattering is interpolated.
        self._smooth: tuple[LightSource, ...] = ()
        # What an error of multiple scattering is in the image, of a thin cloud; 1 of others.
        self._weight = 1.0

    def skipped(self) -> dict[str, int]:
        """Queries that were not needed, by reason; a sample counts as the one query that the reference mode would ask."""
        if self.sources is None or self.sampled:
            return {"thin samples": self.counts.skipped}
        distinct = len({a for a in self.cloud.albedo if a > 0})
        spared = sum(source.spared for source in self.sources)
        evaluations = (sum(source.queries for source in self.sources) + spared) // max(distinct, 1)
        return {
            "samples that met no cloud": self.counts.camera_samples - self.counts.cloud_samples,
            "samples interpolated": self.counts.cloud_samples,
            "equal colour channels": evaluations * (len(self.cloud.albedo) - distinct),
            "albedos between two others": spared,
            "suns without power": sum(max(sun.irradiance) <= 0 for sun in self.on_cloud.suns),
        }

    @property
    def _roughly(self) -> Cloud:
        return self.cloud if self.quick is None else replace(self.cloud, scattering=self.quick)

    @property
    def thrower(self) -> Cloud:
        """The cloud as surfaces see it."""
        if self._paths is not None:
            return replace(self.cloud, scattering=None, paths=self._paths, exact=1)
        if self.all_round is None:
            return self.cloud
        return replace(self.cloud, scattering=None, known=self.all_round, exact=self._exact_thrown)

    @functools.cached_property
    def _exact_thrown(self) -> int:
        """Orders of thrown light that are sampled: harmonics know the others, from which the phase function has taken the peaks."""
        bright = any(isinstance(s, Environment) and s.bright_part(BRIGHT) is not None for s, _ in self.on_cloud.sources)
        if not self.on_cloud.suns and not bright:
            return 1
        first, second, share = self.cloud.phase
        g = max(abs(first) if share > 0 else 0.0, abs(second) if share < 1 else 0.0)
        # Of light scattered n + 1 times harmonics of order l have what g^(l (n + 1)) leaves of them.
        return next((n for n in range(1, _MOST_EXACT) if g ** ((ORDER + 1) * (n + 1)) < _PEAK), _MOST_EXACT)

    @property
    def _sent(self) -> tuple[tuple[LightSource, int], ...]:
        """What surfaces send, once that is known."""
        return self.on_cloud.sources[len(self.on_surfaces.sources) :]

    @property
    def _of_image(self) -> Lights:
        """The lights, with what of them is interpolated in this camera's image."""
        # The same object each time, by which paths know what they have made for it.
        return replace(self.on_cloud, smooth=self._smooth) if self._smooth else self.on_cloud

    def probed(self, corrected: bool) -> Cloud:
        """The cloud as those surfaces see it whose light goes on into the cloud: in images that walks correct that is path-traced."""
        if not corrected or self.cloud.paths is not None:
            return self.thrower
        self._probing = self._probing or self._traced()
        return replace(self.cloud, scattering=None, paths=self._probing, exact=1)

    def _traced(self) -> Paths:
        return Paths(self.cloud.field, self.cloud.albedo, self.cloud.phase, self.cloud.varying, self.seed)

    def _walked(
        self,
        sources: Sequence[tuple[LightSource, int]],
        corrected: bool,
        seen: Seen,
        along: NDArray[np.float64],
        smooth: tuple[LightSource, ...] = (),
    ) -> LightWalks | None:
        """Walks for what is not bright of `sources`, where walks correct the image anyway and those from what is `seen` are short."""
        network = self.cloud.scattering
        if not corrected or not sources or not isinstance(network, NetworkScattering) or network.descriptor.empty or not len(seen.points):
            return None
        walks = LightWalks(self.cloud, Lights((), tuple(sources), self.on_cloud.shade, smooth), smooth=True)
        collisions = self._collisions(walks, seen, along)
        walks.most = int(min(walks.most, _COLLISIONS_AROUND / max(collisions, 1.0)))
        return walks if collisions <= _MOST_COLLISIONS else None

    def _collisions(self, walks: LightWalks, seen: Seen, along: NDArray[np.float64]) -> float:
        """How often walks from what is `seen` collide on the mean, by a few that are tried."""
        some = np.linspace(0, len(seen.points) - 1, _COUNTED).astype(np.int64)
        return walks.collisions(seen.points[some], along[some], np.random.default_rng([self.seed & 0xFFFFFFFF, 0xC011]))

    def _bright(self, sources: Sequence[tuple[LightSource, int]]) -> list[Arriving]:
        """What is bright of environments, as suns."""
        parts = [source.bright_part(BRIGHT) for source, _ in sources if isinstance(source, Environment)]
        return [light for part in parts if part for light in of_beams(self.types, part.light, part.beams(), True, self.seed)]

    def prepare_thrown(self, tolerance: float, corrected: bool = False, until: float = math.inf) -> None:
        """Predict multiple scattering for the light that the cloud throws on surfaces; from then on their rays ask no network.

        Parameters
        ----------
        tolerance, until
            see `prepare`.
        corrected
            walks correct the image: this light is path-traced.
        """
        types = self.types
        lower, upper = self.cloud.field.volume.bounds
        unit = self.cloud.scattering.descriptor.unit if isinstance(self.cloud.scattering, NetworkScattering) else 0.0
        if corrected:
            # Harmonics lack the peaks of what was scattered a few times, a walk for each ray costs no more than their prediction, and the
            # film smooths its noise.
            self._paths = self._traced()
            self.film.thrown = ThrownLight(types, self.scene.size, (lower, upper), unit)
            return
        clock = time.perf_counter()
        middle = types.Array3f(*(dr.opaque(types.Float, float(v)) for v in 0.5 * (lower + upper)))
        radius = 0.5 * float(np.linalg.norm(upper - lower))
        pixel, numbers, *_ = pilot.spread_pixels(types, Window.whole(self.scene.size), _SURFACE_RAYS, 0, self._seed())
        origin, direction, _ = self.camera.rays(pixel, numbers)
        # What the camera sees of the surfaces, and what the middle of the cloud sees of them: the probe stands there.
        around = spread(_SURFACE_RAYS).astype(np.float32)
        out = vectors_of(types, around)
        parts = []
        for start, ahead in ((origin, direction), (dr.zeros(types.Array3f, len(around)) + middle, out)):
            _, distance, shown = self._surfaces(start, ahead, dr.full(types.Float, math.inf, dr.width(ahead)))
            found: Any = dr.compress(shown)
            # Before the surface, or it would hide what it sees.
            place = dr.fma(ahead, distance * _BEFORE, start)
            parts.append([np.array(dr.gather(types.Float, v, found)) for v in place])
        places = np.concatenate([np.stack(part, axis=1) for part in parts])
        if len(places):
            # Toward points spread through the cloud's sphere.
            aims = np.array(0.5 * (lower + upper)) + radius * np.cbrt((np.arange(len(places)) * 0.6180339887) % 1)[:, None] * np.roll(
                spread(len(places)), len(places) // 3, axis=0
            )
            ahead = aims - places
            ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-20)
            o, d = (vectors_of(types, v) for v in (places, ahead))
            seen = seen_by(self.cloud.field, o, d, self.on_surfaces.shade.reach(o, d), types.Float(0.5), 2)
            lights = from_suns(types, self.on_surfaces.suns, self.on_surfaces.shade)
            for source, _ in self.on_surfaces.sources:
                lights += from_source(types, source, _BEAMS_THROWN, True, self.seed)
            how = _ROOT_AROUND, _THROWN * tolerance, _BUDGET // 4, until, self.on_surfaces.shade
            self.all_round = AllRound(self._roughly, lights, seen, *how)
            self.counts.queries += self.all_round.queries
            self.film.thrown = ThrownLight(types, self.scene.size, (lower, upper), unit)
        self.spent("light on surfaces", clock)

    def prepare_thrown_back(self, tolerance: float, until: float = math.inf) -> None:
        """The same for what surfaces send to the cloud, and it back to them: once, in the light that `on_cloud` has of them."""
        first = self.all_round
        if first is None:
            return
        clock = time.perf_counter()
        lights: list[Arriving] = []
        for source, _ in self._sent:
            # Of so few parts, what one point sees in the middle is a poor measure: a shadow there would stand for all.
            lights += from_beams(self.types, source, _BEAMS_BACK)
        # A fraction of a fraction of the light.
        wide = 2 * _THROWN * tolerance
        how = _ROOT_AROUND, wide, _BUDGET // 4, until, self.on_surfaces.shade
        first.again = AllRound(self._roughly, lights, first.seen, *how)
        self.counts.queries += first.again.queries
        self.spent("light on surfaces", clock)

    def _looked(self, quick: bool = False) -> pilot.Pilot:
        """What the camera sees of the cloud."""
        if self._pilot is None:
            clock = time.perf_counter()
            self._pilot = pilot.look(self.types, self.cloud.field, self._window, self._camera_rays, self._seed(), quick)
            self.spent("pilot", clock)
        return self._pilot

    def prepare(self, tolerance: float, quick: bool = False, corrected: bool = False, until: float = math.inf) -> None:
        """Predict multiple scattering for this camera; from then on camera rays ask no network.

        Parameters
        ----------
        tolerance
            of the interpolation at a point, root of the mean square over the mean.
        quick
            at an eighth of the nodes.
        corrected
            walks will correct what is predicted for suns, and with it what the interpolation errs: fewer nodes do.
        until
            about when to be done, in seconds of `time.perf_counter`: there are no more nodes than that leaves time for.
        """
        looked = self._looked(quick)
        seen = looked.seen
        if not quick and isinstance(self.cloud.scattering, NetworkScattering) and looked.thin:
            share = self._share(looked)
            if share < _NEGLIGIBLE * tolerance:
                _LOG.info("multiple scattering is %.2g %% of the image's light: single scattering alone is rendered", 100 * share)
                self.sources, self.named = [], {}
                return
            self._weight = min(max(share / _LARGE, 1 / _MOST_SPARED), 1.0)
            tolerance /= self._weight
        clock = time.perf_counter()
        finest = _FINEST * float(np.quantile(self.camera.footprint(seen.points), _NEAR)) if len(seen.points) else 0.0
        how = seen, tolerance, finest, until
        found = self._walked_sources(*how, quick) if self.unknown else self._predicted_sources(*how, quick, corrected)
        self.named = {name: source for name, source in found.items() if source is not None}
        self.sources = list(self.named.values())
        if not self.unknown:
            self.errors = relative_errors(self.sources, seen, looked.columns, looked.rows, self.scene.size)
        self.counts.queries += sum(source.queries for source in self.sources)
        self.spent("prediction", clock)

    def _walked_sources(self, seen: Seen, tolerance: float, finest: float, until: float, quick: bool) -> dict[str, FrameSource | None]:
        """J of all lights by walks at nodes, and no network."""
        network = self.cloud.scattering
        if not isinstance(network, NetworkScattering) or network.descriptor.empty or not len(seen.points):
            return {}
        walks = LightWalks(self.cloud, self.on_cloud)
        collisions = self._collisions(walks, seen, self.camera.toward(seen.points))
        most = int(min(walks.most, _COLLISIONS_AROUND / max(collisions, 1.0))) // (_QUICK if quick else 1)
        how = seen, _ROOT, tolerance, most, self.seed
        return {
            "all lights": walked_source(
                self.cloud, network, walks, self.camera, *how, until=until, finest=finest, shade=self.on_cloud.shade
            )
        }

    def _predicted_sources(
        self, seen: Seen, tolerance: float, finest: float, until: float, quick: bool, corrected: bool
    ) -> dict[str, FrameSource | None]:
        """J of suns by the network, and of light from all around by it or by walks."""
        suns = from_suns(self.types, self.on_cloud.suns, self.on_cloud.shade)
        around: list[Arriving] = []
        wide, beams = (2, _BEAMS_THROWN) if quick else (1, _BEAMS)
        # Surfaces inside of the cloud light it from near by, and each sample would find that anew.
        sent = self._sent if self.on_cloud.shade.inside else ()
        smooth = tuple(source for source, _ in sent)
        walks = self._walked(self.on_cloud.sources, corrected, seen, self.camera.toward(seen.points), smooth)
        for source, _ in self.on_cloud.sources:
            around += from_source(self.types, source, beams, isinstance(source, Environment), self.seed)
        power = sum(max(light.irradiance) for light in around)
        bright = [] if walks is None else self._bright(self.on_cloud.sources)
        suns += bright
        if walks is None:
            # What is a large part of all light gets the fine nodes of a sun.
            suns += [light for light in around if max(light.irradiance) > _BRIGHT * power]
            around = [light for light in around if max(light.irradiance) <= _BRIGHT * power]
        # Errors of both are independent: each may be the larger the less light it has.
        parts = [sum(max(light.irradiance) for light in lights) for lights in (suns, around)]
        parts[1] = max(parts[1] - sum(max(light.irradiance) for light in bright), 0.0)
        of_suns, of_around = (tolerance / math.sqrt(max(part / max(sum(parts), 1e-30), 1e-6)) for part in parts)
        of_suns *= _CORRECTED if corrected else 1.0
        eyes, first = [self.camera], part_of_time(until, 0.5) if around or walks is not None else until
        shade = self.on_cloud.shade
        found: dict[str, FrameSource | None] = {
            "suns": frame_source(self.cloud, suns, eyes, seen, wide * _ROOT, of_suns, _BUDGET, until=first, finest=finest, shade=shade),
        }
        if walks is not None and isinstance(self.cloud.scattering, NetworkScattering):
            how = seen, _ROOT_AROUND, of_around, walks.most, self.seed
            around_it = walked_source(self.cloud, self.cloud.scattering, walks, self.camera, *how, until=until, finest=finest, shade=shade)
        else:
            root = wide * _ROOT_AROUND
            how_far = root, of_around, _BUDGET
            around_it = frame_source(self._roughly, around, eyes, seen, *how_far, until=until, finest=finest, shade=shade)
        found["light from all around"] = around_it
        if walks is not None and around_it is not None:
            self._smooth = smooth
        return found

    def _share(self, looked: pilot.Pilot) -> float:
        """Share of multiple scattering in the light of the image, by walks from what the camera sees, and a few samples."""
        clock = time.perf_counter()
        random = np.random.default_rng([self.seed & 0xFFFFFFFF, 0x54A2])
        total = np.cumsum(looked.seen.weights)
        drawn = np.minimum(np.searchsorted(total, (np.arange(_TRIED) + random.random()) / _TRIED * total[-1]), len(total) - 1)
        points = looked.seen.points[drawn]
        j = LightWalks(self.cloud, self.on_cloud)(points, self.camera.toward(points), random)
        multiple = float(j.mean()) * total[-1] / looked.rays * self._window.share
        width, height = self.scene.size
        pixels = np.unique(np.linspace(0, width * height - 1, _TRIED).astype(np.uint32))
        trial = replace(self, counts=Counts(), seconds={}, samples=0, errors=None, interreflection=False, sources=[], depths=1)
        trial.add(pixels, 0, 1, 1)
        other = float(trial.film.sums()[pixels].mean())
        self.spent("trial", clock)
        return float(multiple / max(multiple + other, 1e-30))

    def audit(self, correct: bool, error: float, until: float, interrupted: Callable[[], bool] | None) -> None:
        """Audit the sources, and correct them, with walks, until about the time `until`."""
        if not self.sources:
            return
        clock = time.perf_counter()
        if until - clock < _LEAST_AUDIT:
            _LOG.info("no time was left to measure the network's error, or to correct it")
            return
        width, height = self.scene.size
        error /= self._weight
        found = Audit(self.cloud, self._of_image, self.sources, self._camera_rays, self._window, self._looked().met, self.seed)
        most, at_once = _MOST_TIMED, ROUND if math.isinf(until) else _TIMED_ROUND
        if error > 0:
            # Walks are as noisy as any path: half of the error takes four times as many.
            usual = min(WALKS_A_PIXEL * width * height, WALKS_A_SIGHT * self._looked().met * self._window.count)
            most = int(np.clip(usual * (ERROR / error) ** 2, FEWEST, MOST))

        def left() -> float:
            return 0.0 if interrupted is not None and interrupted() else until - time.perf_counter()

        outcome = audited(found, self.sources, correct, error, most, left, at_once)
        self.sources, self.found = outcome.sources, outcome.found
        self.spent("audit", clock)

    def sampling_seconds(self, error: float) -> tuple[float, float]:
        """How long camera samples will take, by two samples of some of the pixels.

        One of every pixel, and those that bring the noise to what `noise_goal` asks for at least.
        """
        clock = time.perf_counter()
        # Not what the film smooths: of that a few samples know little. It takes about as long again, and a few more of them.
        smoothed = self.film.thrown is not None
        trial = replace(self, counts=Counts(), seconds={}, samples=0, errors=None, interreflection=False)
        trial._smooth = self._smooth
        # Samples that meet nothing cost next to nothing.
        window = self._window if self.scene.surfaces is None else Window.whole(self.scene.size)
        y, x = np.divmod(np.arange(window.count), window.width)
        apart = 4 if window.count > _MANY_PIXELS else 2
        pixels = window.pixels(np.flatnonzero((x // 8 % apart == 0) & (y // 8 % apart == 0))).astype(np.uint32)
        images, spent = [], math.inf
        for sample in range(2):
            started = time.perf_counter()
            trial.add(pixels, sample, 1, 2)
            spent = min(spent, time.perf_counter() - started)
            images.append(trial.film.sums()[pixels])
        self.spent("trial", clock)
        first, mean = images[0], 0.5 * images[1]
        lit = mean > DARK * np.quantile(mean, 0.999)
        of_one = _SLOWER * spent * window.count / len(pixels)
        if not lit.any():
            return of_one, of_one
        noise = float(np.sqrt(np.mean(np.square((mean - first)[lit]))) / mean[lit].mean())
        samples = max(2 * (noise / (_LEAST_NOISE * error)) ** 1.5, 4.0 if smoothed else 3.0)
        # Two of every pixel, the others of those that are not dark.
        seconds: float = of_one * (2 + (samples - 2) * float(lit.any(axis=1).mean()))
        return of_one, (2 if smoothed else 1) * seconds

    def noise_goal(self, error: float) -> float:
        """Noise of a pixel that makes an error together with what walks have left of the network's; at least `_LEAST_NOISE` of it."""
        left = self._weight * self.found["remaining"]["error"] if self.found.get("corrected") else 0.0
        return error * math.sqrt(max(1 - (left / error) ** 2, _LEAST_NOISE**2))

    def _camera_rays(self, pixel: Any, numbers: Stratified) -> tuple[Any, Any, Any]:
        """Camera rays and where surfaces end them."""
        origin, direction, end = self.camera.rays(pixel, numbers)
        if self.scene.surfaces is not None:
            _, end, _ = self._surfaces(origin, direction, end)
        return origin, direction, end

    def round(
        self,
        first: int,
        samples: int,
        most: int,
        progress: Callable[[float], None] | None,
        interrupted: Callable[[], bool] | None = None,
    ) -> bool:
        """Take `samples` more samples of every pixel, numbered from `first` on, of `most` in all, 0 for as many as it will take.

        Returns whether it was interrupted; without a number of samples there is no `progress`.
        """
        total = len(self._adaptive.active)
        pixels = max(1, (_SLOW_PASS if self.sampled else _PASS) // samples)
        for start in range(0, total, pixels):
            if interrupted is not None and interrupted():
                return True
            chosen = self._adaptive.active[start : start + pixels]
            self.add(chosen, first, samples, most)
            self.film.taken[chosen] += samples
            if progress is not None:
                progress((first + samples * min(start + pixels, total) / total) / most)
        self.samples += samples
        return False

    def settle(self, before: Image, done: int, error: float, rest: bool = True) -> tuple[float, float]:
        """Estimate the noise after a round, see `Adaptive.settle`: `before` is the image before it, of `done` samples."""
        return self._adaptive.settle(before, self.film.beauty(), done, self.samples, error, rest)

    def _seed(self) -> Any:
        return dr.opaque(self.types.UInt32, self.seed & 0xFFFFFFFF)

    def add(self, pixels: NDArray[np.uint32], sample: int, samples: int, most: int) -> None:
        """Render the pixels of these numbers, `samples` samples each from number `sample` of `most` on, see `round`."""
        types, scene = self.types, self.scene
        n = len(pixels) * samples
        self.counts.camera_samples += n
        count = dr.opaque(types.UInt32, samples)
        index = dr.arange(types.UInt32, n)
        local = index // count
        pixel = dr.gather(types.UInt32, lanes_of(types.UInt32, pixels), local)
        numbers = Stratified(
            types, pixel, index - local * count + dr.opaque(types.UInt32, sample), dr.opaque(types.UInt32, most), self._seed()
        )
        where = pixels, samples
        origin, direction, end = self.camera.rays(pixel, numbers)
        interaction: Any = None
        shown: Any = None
        if scene.surfaces is not None:
            interaction, end, shown = self._surfaces(origin, direction, end)
        clock = time.perf_counter()
        if self.sources is None and not self.sampled:
            light = cloud_light(self.cloud, self.on_cloud, origin, direction, end, numbers, self.counts)
        else:
            sources = self.sources or []
            drawn = len(self.on_cloud.sources) > len(self._smooth)
            depths = self.depths or (_DEPTHS if drawn or self.sampled else _DEPTHS_SUNS)
            lights = self._of_image
            light = fast_cloud_light(self.cloud, lights, sources, origin, direction, end, numbers, self.counts, depths, self.sampled)
        dr.eval(light.direct, light.indirect)
        dr.sync_thread()
        self.spent("cloud", clock)
        clock = time.perf_counter()
        self.film.add(*where, "volume_direct", light.direct)
        self.film.add(*where, "volume_indirect", light.indirect)
        self.film.add(*where, "volume_opacity", [light.opacity])
        depth = self.camera.distance(dr.fma(direction, light.distance, origin))
        self.film.add(*where, "volume_Z", [depth * light.opacity])
        through = light.transmittance
        behind = through
        alpha = light.opacity
        if interaction is not None:
            colours = reflected(self.cloud, self.on_surfaces, interaction, numbers)
            if self.interreflection:
                for source, _ in self._sent:
                    more = reflected_from_surfaces(self.cloud, self.on_cloud, source, interaction, numbers.unrelated(_BETWEEN))
                    colours = [a + b for a, b in zip(colours, more, strict=True)]
                weight = dr.select(shown, through, 0)
                thrown = self._thrown(interaction, weight, numbers)
                if self.film.thrown is not None:
                    share, matt = diffuse_share(types, interaction)
                    lit, even = ([value * through for value in values] for values in (thrown, share))
                    place, normal = plain(types, interaction.p), plain(types, interaction.n)
                    self.film.thrown.add(*where, lit, even, place, normal, matt & shown)
                    thrown = [dr.select(matt & shown, 0, value) for value in thrown]
                colours = [a + b for a, b in zip(colours, thrown, strict=True)]
            self.film.add(*where, "surface", [value * through for value in colours])
            behind = dr.select(shown, 0, through)
            alpha = alpha + dr.select(shown, through, 0)
        look = None if scene.hide_emitters else background(types, scene.backdrop, scene.suns)
        if look is not None:
            sky, shines = look(direction)
            glare = self._glare(sky, behind)
            if glare is not None:
                self._adaptive.dazzled[pixels] |= np.array(dr.block_sum(dr.select(glare, types.Float(1), 0), samples)) > 0
            self.film.add(*where, "background", [value * behind for value in sky])
            alpha = alpha + dr.select(shines, behind, 0)
            into = looks_into(types, scene.suns, direction)
            if into is not None:
                self._adaptive.dazzled[pixels] |= np.array(dr.block_sum(dr.select(into, types.Float(1), 0), samples)) > 0
        self.film.add(*where, "A", [alpha])
        self.spent("surfaces and background", clock)

    def _glare(self, sky: list[Any], behind: Any) -> Any:
        """Whether rays see, past the cloud, what is bright of an environment: such pixels would be all that counts in the noise."""
        environments = [source for source, _ in self.on_surfaces.sources if isinstance(source, Environment)]
        if not environments:
            return None
        limit = dr.opaque(self.types.Float, BRIGHT * sum(environment.mean for environment in environments))
        most = sky[0]
        for value in sky[1:]:
            most = dr.maximum(most, value)
        return (most > limit) & (behind > 0.5)

    def _thrown(self, interaction: Any, weight: Any, numbers: Stratified) -> list[Any]:
        """Light of the cloud that surfaces send back, see `reflected_from_cloud`."""
        counts = Counts() if self._paths is not None else self.counts
        thrown = reflected_from_cloud(self.thrower, self.on_cloud, interaction, weight, numbers, counts)
        rays = _RAYS_THROWN if self.film.thrown is not None else 1
        for k in range(1, rays):
            more = reflected_from_cloud(self.thrower, self.on_cloud, interaction, weight, numbers.unrelated(k), counts)
            thrown = [a + b for a, b in zip(thrown, more, strict=True)]
        return [value * (1 / rays) for value in thrown]

    def _surfaces(self, origin: Any, direction: Any, end: Any) -> tuple[Any, Any, Any]:
        """What the rays hit, where they end, and whether they hit anything."""
        mi, types = mitsuba(), self.types
        ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction))
        ray.maxt = mi.Float(end)
        interaction = self.scene.surfaces.ray_intersect(ray)
        shown = plain(types, interaction.is_valid())
        return interaction, dr.select(shown, plain(types, interaction.t), end), shown

    def spent(self, stage: str, since: float) -> None:
        """Add the seconds since `since` to a stage."""
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - since

    def image(self) -> dict[str, Image]:
        """All channels (h, w) of the finished image."""
        channels = self.film.channels()
        if self.errors is not None:
            channels["confidence"] = confidence(self.errors, channels)
        return channels
