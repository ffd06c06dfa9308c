"""Renders a scene that was read: camera samples in passes, the cloud's light along them, surfaces and background behind it."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepclouds.backend import lanes_of
from deepclouds.errors import InputError
from deepclouds.medium.field import Field
from deepclouds.memory import peak_bytes
from deepclouds_runtime import stratified
from deepclouds_runtime._mitsuba import mitsuba, plain, types_of
from deepclouds_runtime.all_round import AllRound, spread
from deepclouds_runtime.audit import FEWEST, MOST, WALKS_A_PIXEL, Audit, audited
from deepclouds_runtime.camera import Camera
from deepclouds_runtime.confidence import confidence, doubtful, relative_errors, warning
from deepclouds_runtime.disc import background, looks_into
from deepclouds_runtime.error_parts import error_parts
from deepclouds_runtime.fast import fast_cloud_light
from deepclouds_runtime.frame_source import Arriving, FrameSource, frame_source, from_source, from_suns, seen_by
from deepclouds_runtime.lights import Environment, Shade, environment
from deepclouds_runtime.scattering import NetworkScattering, Predicts, Stopped, WalkScattering
from deepclouds_runtime.scene import CloudScene
from deepclouds_runtime.stratified import Stratified
from deepclouds_runtime.surfaces import Reflectors, reflected, reflected_from_cloud
from deepclouds_runtime.transport import Cloud, Counts, Lights, cloud_light

_LOG = logging.getLogger(__name__)
Image = NDArray[np.float32]

# Camera samples in flight: enough to fill the machine, few enough to stay below 1 GB. Those that end in a query or a walk take long, and
# an interruption waits for them.
_PASS, _SLOW_PASS = 1 << 19, 1 << 16
# A pixel's samples are in flight together.
_MOST_SAMPLES = 1 << 20
# What the fast mode stops at by itself: a scene whose noise is still too large then says so.
_MOST_AUTOMATIC = 1024
# Noise of a pixel that the fast mode aims at, over the mean.
ERROR = 0.02
# Samples a pixel of which path tracing foretells how many it will take.
_FORETELL = 16
# Values below this share of the brightest do not count in the noise.
_DARK = 0.02
# Error of the interpolation at a point over the noise of a pixel, both aimed at: along rays and between pixels that of points averages out.
_INTERPOLATION = 2.5
# Side of the blocks of pixels that rest together, and the share of the noise asked for that resting blocks may have.
_BLOCK, _REST = 8, 0.5
# The variance of well spread samples falls a little faster than with their number: the power of the number that it asks for.
_CONVERGENCE = 0.75
# Rays that look for what the camera sees, and collisions on each of them.
_PILOT, _PILOT_DEPTHS = 1 << 16, 4
# Most queries for the suns, and as many for the light from all around.
_BUDGET = 60_000
# Directions that stand for light from all around, and the share of it from which one of them is treated as a sun.
_BEAMS, _BRIGHT = 48, 0.1
# The same for light that the cloud throws on surfaces.
_BEAMS_THROWN = 12
# Edge of the coarsest cells in units of length (mean free paths), for the suns and for light from all around, under which J is smoother.
_ROOT, _ROOT_AROUND = 2.0, 4.0
# Collisions of a camera ray that get shadow rays.
_DEPTHS = 4
COLOURS = ("R", "G", "B")
MODES = ("fast", "reference")
LAYERS = ("volume_direct", "volume_indirect", "surface", "background")


@dataclass
class Statistics:
    """How an image came about.

    Attributes
    ----------
    mode
        ``"fast"``, ``"reference"``, or ``"path-traced"``.
    spp
        samples of the pixels that took most of them.
    mean_spp
        samples a pixel, on average.
    noise
        estimated noise of a pixel, root of the mean square over the mean, where the image is not dark; None where one round was asked for.
    sources
        name of a source of multiple scattering -> what it took: ``lights`` it stands for, ``nodes`` predicted, ``queries``, ``refined``
        cells level by level, and ``error`` of the interpolation at a point, measured.
    skipped
        reason -> queries that were not needed.
    complete
        whether the render came to its end: neither interrupted, nor a picture on the way.
    network
        where the network knows its errors: ``error`` to expect of the cloud's light, and ``doubtful``, the share of that light in pixels of
        low confidence.
    error
        both parts of the image's error, and how they are known: see `deepclouds_runtime.error_parts.error_parts`.
    audit
        where walks audited the network: ``walks``; ``network``, its error over regions of the image, root of the mean square over the mean,
        and its energy, each with an interval of 95 %; whether it was ``corrected``, on how many ``levels``, and what is ``remaining``.
    memory
        bytes: ``field``, of density, extinction and majorants; ``levels``, of the field filtered for the network; ``peak``, what the whole
        process had at most so far.
    """

    mode: str
    spp: int = 0
    mean_spp: float = 0.0
    noise: float | None = None
    complete: bool = True
    sources: dict[str, dict[str, Any]] = field(default_factory=dict)
    skipped: dict[str, int] = field(default_factory=dict)
    network: dict[str, float] = field(default_factory=dict)
    error: dict[str, Any] = field(default_factory=dict)
    audit: dict[str, Any] = field(default_factory=dict)
    memory: dict[str, int] = field(default_factory=dict)


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
        the image; ``volume_opacity``; ``volume_Z``, the mean distance from the camera of what hides, world units, 0 without cloud;
        ``confidence``, 1 less the network's error to expect as a share of the pixel, in the fast mode where the model knows its errors.
    seconds
        stage -> seconds; ``load`` is what was done once, ``total`` all the rest.
    counts
        camera samples, those that met the cloud, network queries made and skipped.
    statistics
        samples, nodes, and estimated errors.
    notes
        what was approximated, in sentences.
    """

    rgb: Image
    alpha: Image
    channels: dict[str, Image]
    seconds: dict[str, float]
    counts: Counts
    statistics: Statistics
    notes: tuple[str, ...] = ()


class Renderer:
    """One scene, loaded once and rendered as often as asked.

    What depends on neither sun nor camera is kept: the extinction on the device, the pyramid of filtered levels, the network.

    Parameters
    ----------
    scene
        what `deepclouds_runtime.scene.read_scene` returns.
    predictor
        the network; not needed with `unbiased` or in a scene with ``max_depth = 2``.
    unbiased
        whether J comes from Monte Carlo walks, one a sample, in place of the network.
    exact_orders
        orders of scattering that are sampled before the network is asked. With 1, single scattering, it is asked about what the camera
        sees; with n about what light that was scattered n times sees, and no longer interpolated.
    environment_directions
        directions drawn from an environment at each sample of the cloud.
    interreflection
        whether surfaces receive the cloud's light, and the cloud that of the surfaces. Light that goes back and forth more than once,
        and light from one surface to another, are left out.
    mode
        ``"fast"``: J is predicted at a sparse set of points and interpolated, samples are spent until the noise is as asked; or
        ``"reference"``: the method as published, where every sample asks the network. With `unbiased` there is but one.
    extrapolate
        whether the network is asked about media that it was not trained on; by default J then comes from walks.
    unit, origin
        of the descriptor, see `deepclouds.descriptor.Descriptor`: fixed for a sequence of frames; by default those of the cloud.
    load_seconds
        what loading took before, reported as ``seconds["load"]``.

    Attributes
    ----------
    notes
        what was approximated in reading the scene, and what of its medium the model was not trained on, in sentences.
    model_hash
        of the weights that are asked, or None.
    predictor
        the network that was given.

    Raises
    ------
    InputError
        for options that make no sense, alone or together.
    """

    def __init__(
        self,
        scene: CloudScene,
        predictor: Predicts | None = None,
        *,
        unbiased: bool = False,
        exact_orders: int = 1,
        environment_directions: int = 2,
        interreflection: bool = True,
        mode: str = "fast",
        extrapolate: bool = False,
        unit: float | None = None,
        origin: NDArray[np.float64] | None = None,
        load_seconds: float = 0.0,
    ) -> None:
        if mode not in MODES:
            raise InputError(f"mode = '{mode}': there are {' and '.join(repr(m) for m in MODES)}")
        if exact_orders < 1:
            raise InputError(f"exact orders = {exact_orders}: single scattering is always exact; give 1 or more")
        if unbiased and exact_orders > 1:
            raise InputError(f"exact orders = {exact_orders}: an unbiased render has all orders exact; leave one of the two out")
        if unbiased and mode != "fast":
            raise InputError(f"mode = '{mode}': an unbiased render asks no network; leave one of the two out")
        if environment_directions < 1:
            raise InputError(f"environment directions = {environment_directions}: at least one is drawn at each sample")
        if unit is not None and not (math.isfinite(unit) and unit > 0):
            raise InputError(f"unit = {unit:g}: give a length in world units, about the mean free path in the cloud")
        started = time.perf_counter()
        self.scene = scene
        self.mode, self.unbiased, self._exact_orders = mode, unbiased, exact_orders
        self.environment_directions = environment_directions
        self.predictor = predictor
        self._types = types_of(mitsuba())
        self._field = Field(self._types, scene.volume, scene.scale)
        self._network: NetworkScattering | None = None
        # Whether paths are traced in place of the network, asked for or not.
        self._walks = unbiased and scene.max_depth != 2
        if scene.max_depth != 2 and not unbiased:
            if predictor is None:
                raise InputError("multiple scattering needs a model; give one, or render single scattering alone (max_depth 2)")
            self._network = NetworkScattering(self._field, predictor, unit, origin)
        # Single scattering alone stops before light that surfaces have reflected, as volpath with max_depth 2 does.
        self._interreflection = interreflection and scene.surfaces is not None and scene.max_depth != 2
        self.notes = scene.notes
        if unbiased:
            self.notes += ("unbiased: paths are traced with our own tracker until the noise is as asked; no network is asked",)
        if self._network is not None and (unknown := _unknown(self._network, predictor, scene)):
            instead = "extrapolated" if extrapolate else "path-traced in place of it, noisy and slow ('extrapolate' asks it all the same)"
            self.notes += (f"the model was not trained for {', '.join(unknown)}: multiple scattering is {instead}",)
            if not extrapolate:
                self._network, self._walks = None, True
        self.model_hash: str | None = None
        if self._network is not None:
            self.model_hash = getattr(getattr(predictor, "metadata", None), "initialisers_sha256", None)
        self._load_seconds = load_seconds + time.perf_counter() - started

    @property
    def unit(self) -> float | None:
        """Unit of length of the network's input, world units; None where no network is asked."""
        return None if self._network is None else self._network.descriptor.unit

    def samples(self, spp: int | None) -> int:
        """Samples a pixel of a render that is asked for `spp`; for None those of the camera's sampler."""
        count = int(self.scene.sensor.sampler().sample_count()) if spp is None else int(spp)
        if count < 1:
            raise InputError(f"spp = {count}: a pixel needs at least one sample")
        if count > _MOST_SAMPLES:
            raise InputError(f"spp = {count}: at most {_MOST_SAMPLES:,}; average several renders with different seeds")
        return count

    def render(
        self,
        spp: int | None = None,
        seed: int = 0,
        progress: Callable[[float], None] | None = None,
        error: float | None = None,
        partial: Callable[[RenderResult], None] | None = None,
        interrupted: Callable[[], bool] | None = None,
        estimate: Callable[[float], None] | None = None,
        *,
        audit: bool = False,
        correct: bool = False,
        time_limit: float | None = None,
    ) -> RenderResult:
        """Render an image.

        Parameters
        ----------
        spp
            samples a pixel. By default the fast mode takes as many as `error` asks for, the reference mode those of the camera's sampler,
            which is also the most that paths take that nobody asked for (`extrapolate`).
        seed
            of all random numbers.
        progress
            is called with the share of the work done, 0 to 1.
        error
            of the fast mode: noise of a pixel to aim at, root of the mean square over the mean; the interpolation may add half as much.
            By default 0.02; in an unbiased render with a `time_limit` the time alone decides.
        partial
            is called with the image so far, first of all with a quick look (fast mode: one sample a pixel with one collision, J at few
            nodes, surfaces without the cloud's light), then after each round of samples but the last. The look is thrown away: the final
            image is the same with and without `partial`, but for rounding.
        interrupted
            is asked between passes, and between batches of a prediction, whether to stop. The image is then made of what there is, of one
            sample of every pixel at least, and its statistics are not ``complete``. In place of a prediction that was not finished it has
            that of a quick look, without the light that the cloud throws on surfaces.
        estimate
            is called with the estimated noise after each round.
        audit
            of the fast mode: measure the network's error in this image with walks, until it is known to be below `error`, or as many
            walks are spent as the error is worth.
        correct
            audit, and correct the network's multiple scattering by what the walks say, where they say that it helps. The light that the
            cloud throws on surfaces is not corrected.
        time_limit
            seconds: the audit ends after half of them, sampling with the last round that should end in time. The result then depends on the
            machine.

        Raises
        ------
        InputError
            when `spp` is below 1 or above 1,048,576, `error` or `time_limit` is not positive, or what is to be audited is not interpolated.
        """
        scene, types = self.scene, self._types
        timed = self.unbiased and error is None and time_limit is not None
        error = ERROR if error is None else error
        if not error > 0:
            raise InputError(f"error = {error}: give the noise to aim at as a share of the mean, for example {ERROR}")
        if time_limit is not None and not time_limit > 0:
            raise InputError(f"time = {time_limit:g}: give the seconds that the render may take, for example 10")
        if (audit or correct) and self.mode != "fast":
            raise InputError(f"mode = '{self.mode}': only the fast mode is audited and corrected; choose mode 'fast'")
        if (audit or correct) and self.unbiased:
            raise InputError("an unbiased render asks no network that could be audited or corrected; leave one of the two out")
        if (audit or correct) and self._exact_orders > 1:
            raise InputError(
                f"exact orders = {self._exact_orders}: the network is audited and corrected with 1 only; leave one of the two out"
            )
        started = time.perf_counter()
        scattering = None
        if scene.max_depth != 2:
            scattering = WalkScattering(self._field, 1, seed) if self._walks else self._network
        adaptive = self.mode == "fast"
        # Whether rays end in a walk or a query of their own; otherwise multiple scattering of the fast mode is interpolated.
        sampled = adaptive and scattering is not None and (self._walks or self._exact_orders > 1)
        fast = adaptive and not sampled
        most = self.samples(spp) if spp is not None or not adaptive or (self._walks and not self.unbiased) else _MOST_AUTOMATIC
        if spp is None and self.unbiased:
            most = _MOST_SAMPLES
        exact = 1 if self._walks else self._exact_orders
        cloud, lights = Cloud(self._field, scene.albedo, scene.phase, scattering, exact=exact), self._lights()
        camera = Camera(types, scene.sensor)
        work = _Work(scene, camera, cloud, lights, lights, types, seed, self._interreflection, sampled=sampled)
        work.spent("lights", started)
        if adaptive and not self._walks and partial is not None:
            clock = time.perf_counter()
            look = self._quick_look(cloud, lights, camera, seed)
            look.round(0, 1, most, None)
            partial(self._result(look, started, None, False))
            work.counts.queries += look.counts.queries
            work.spent("quick look", clock)
        try:
            if self._network is not None:
                self._network.stop = interrupted
            if adaptive and not self._walks and self._interreflection:
                work.prepare_thrown(_INTERPOLATION * error)
            if self._interreflection:
                clock = time.perf_counter()
                reflectors = Reflectors(work.thrower, lights, seed & 0xFFFFFFFF, work.counts)
                work.on_cloud = replace(lights, sources=(*lights.sources, (reflectors, 1)))
                work.spent("probe", clock)
            if fast:
                work.prepare(_INTERPOLATION * error)
        except Stopped:
            assert self._network is not None
            self._network.stop = None
            look = self._quick_look(cloud, lights, camera, seed)
            look.round(0, 1, most, None)
            return self._result(look, started, None, False)
        finally:
            if self._network is not None:
                self._network.stop = None
        if fast and (audit or correct):
            half_time = math.inf if time_limit is None else started + 0.5 * time_limit
            work.audit(correct, error, half_time, interrupted)
        noise = math.inf
        stopped = False
        if (spp is not None or not adaptive) and partial is None and interrupted is None:
            work.round(0, most, most, progress)
        elif spp is not None or not adaptive:
            # The same samples, in rounds that double their number.
            work.round(0, 1, most, progress)
            while work.samples < most and not (stopped := interrupted is not None and interrupted()):
                before, done = work.beauty(), work.samples
                if partial is not None:
                    partial(self._result(work, started, noise, False))
                stopped = work.round(done, min(done, most - done), most, progress, interrupted)
                if stopped:
                    break
                noise, _ = work.settle(before, done, error, rest=False)
                if estimate is not None:
                    estimate(noise)
        else:
            _say_ignored(error, int(scene.sensor.sampler().sample_count()))
            growth = 2.0
            work.round(0, 1, most, None)
            end = math.inf if time_limit is None else started + time_limit
            pace = 0.0
            while work.samples < most and (timed or not noise <= error) and not (stopped := interrupted is not None and interrupted()):
                before, done = work.beauty(), work.samples
                more = min(math.ceil(done * (growth - 1)), most - done)
                if done > 1 and not math.isinf(end):
                    left = end - time.perf_counter()
                    more = min(more, int(left / pace)) if left > 0 else 0
                if more < 1:
                    break
                if partial is not None:
                    partial(self._result(work, started, noise, False))
                clock = time.perf_counter()
                stopped = work.round(done, more, most, None, interrupted)
                if stopped:
                    break
                pace = max(time.perf_counter() - clock, 1e-6) / more
                # Blocks that rested because their paths found little light by chance would make an unbiased image dark.
                noise, growth = work.settle(before, done, error, rest=not self._walks)
                if self._walks and done < _FORETELL <= work.samples and noise > error:
                    _say_ahead(work.samples, noise, error, end, most, pace)
                if estimate is not None:
                    estimate(noise)
                if progress is not None:
                    done_share = min(error / max(noise, 1e-9), 1.0) ** 2
                    progress(done_share if not timed else min((time.perf_counter() - started) / (end - started), 1.0))
        return self._result(work, started, noise, not stopped)

    def _quick_look(self, cloud: Cloud, lights: Lights, camera: Camera, seed: int) -> _Work:
        """What a quick look is rendered with: one collision a sample, few nodes, surfaces without the cloud's light."""
        look = _Work(self.scene, camera, replace(cloud, exact=1), lights, lights, self._types, seed, False, depths=1)
        look.prepare(math.inf, quick=True)
        return look

    def _result(self, work: _Work, started: float, noise: float | None, complete: bool) -> RenderResult:
        """The image so far; `noise` as estimated, infinite or None where it was not."""
        channels = work.image()
        seconds = {"load": self._load_seconds, **work.seconds, "total": time.perf_counter() - started}
        rgb = np.stack([channels[c] for c in COLOURS], axis=-1)
        mode = "reference" if self.mode == "reference" else "path-traced" if self._walks else "fast"
        statistics = Statistics(
            mode,
            int(work.taken.max()),
            float(work.taken.mean()),
            noise if noise is not None and math.isfinite(noise) else None,
            complete,
        )
        for name, source in (*work.named.items(), ("light on surfaces", None if work.all_round is None else work.all_round.source)):
            if source is not None:
                statistics.sources[name] = source.summary()
        statistics.skipped = work.skipped()
        statistics.audit = work.found
        levels = 0 if self._network is None else self._network.descriptor.nbytes
        statistics.memory = {"field": self._field.nbytes, "levels": levels, "peak": peak_bytes()}
        notes = self.notes
        if "confidence" in channels:
            statistics.network = doubtful(channels["confidence"], channels)
            notes += tuple(filter(None, [warning(statistics.network)]))
        whole = float(rgb.sum(dtype=np.float64))
        indirect = sum(float(channels[f"volume_indirect.{c}"].sum(dtype=np.float64)) for c in COLOURS)
        statistics.error = error_parts(
            statistics.noise,
            [source.error for source in work.sources or []],
            indirect / whole if whole > 0 else 0.0,
            self._network is not None,
            work.found,
            statistics.network,
            getattr(getattr(self.predictor, "metadata", None), "metrics", {}),
        )
        return RenderResult(rgb, channels["A"], channels, seconds, replace(work.counts), statistics, notes)

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
    seed: int
    interreflection: bool
    depths: int = _DEPTHS
    sampled: bool = False
    counts: Counts = field(default_factory=Counts)
    seconds: dict[str, float] = field(default_factory=dict)
    sums: dict[str, Image] = field(default_factory=dict)
    samples: int = 0
    sources: list[FrameSource] | None = None
    named: dict[str, FrameSource] = field(default_factory=dict)
    all_round: AllRound | None = None
    errors: Image | None = None
    found: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        width, height = self.scene.size
        # Pixels that still take samples, how many each has taken, and the estimated variance of its mean.
        self._active = np.arange(width * height, dtype=np.uint32)
        self.taken = np.zeros(width * height, np.float32)
        self._variance = np.zeros((width * height, 3), np.float64)
        # Those that look into a sun's disc: so bright, they would be all that counts in the noise.
        self._dazzled = np.zeros(width * height, bool)
        # Of the means of rounds: how many there were after the first, and their sum of squared deviations, weighted by samples.
        self._rounds, self._scatter = 0, np.zeros((width * height, 3), np.float64)

    def skipped(self) -> dict[str, int]:
        """Queries that were not needed, by reason; a sample counts as the one query that the reference mode would ask."""
        if self.sources is None or self.sampled:
            return {"thin samples": self.counts.skipped}
        distinct = len({a for a in self.cloud.albedo if a > 0})
        return {
            "samples that met no cloud": self.counts.camera_samples - self.counts.cloud_samples,
            "samples interpolated": self.counts.cloud_samples,
            "equal colour channels": sum(s.queries for s in self.sources) // max(distinct, 1) * (len(self.cloud.albedo) - distinct),
            "suns without power": sum(max(sun.irradiance) <= 0 for sun in self.on_cloud.suns),
        }

    @property
    def thrower(self) -> Cloud:
        """The cloud as surfaces see it."""
        return self.cloud if self.all_round is None else replace(self.cloud, scattering=None, known=self.all_round, exact=1)

    def prepare_thrown(self, tolerance: float) -> None:
        """Predict multiple scattering for the light that the cloud throws on surfaces; from then on their rays ask no network."""
        clock = time.perf_counter()
        types = self.types
        lower, upper = self.cloud.field.volume.bounds
        middle = types.Array3f(*(dr.opaque(types.Float, float(v)) for v in 0.5 * (lower + upper)))
        radius = 0.5 * float(np.linalg.norm(upper - lower))
        pixel, numbers = self._pilot(_PILOT // 8)
        origin, direction, _ = self.camera.rays(pixel, numbers)
        # What the camera sees of the surfaces, and what the middle of the cloud sees of them: the probe stands there.
        around = spread(_PILOT // 8).astype(np.float32)
        out = types.Array3f(*(lanes_of(types.Float, around[:, c]) for c in range(3)))
        parts = []
        for start, ahead in ((origin, direction), (dr.zeros(types.Array3f, len(around)) + middle, out)):
            _, distance, shown = self._surfaces(start, ahead, dr.full(types.Float, math.inf, dr.width(ahead)))
            found: Any = dr.compress(shown)
            place = dr.fma(ahead, distance, start)
            parts.append([np.array(dr.gather(types.Float, v, found)) for v in place])
        places = np.concatenate([np.stack(part, axis=1) for part in parts])
        if len(places):
            # Toward points spread through the cloud's sphere.
            aims = np.array(0.5 * (lower + upper)) + radius * np.cbrt((np.arange(len(places)) * 0.6180339887) % 1)[:, None] * np.roll(
                spread(len(places)), len(places) // 3, axis=0
            )
            ahead = aims - places
            ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-20)
            o, d = (types.Array3f(*(lanes_of(types.Float, v[:, c]) for c in range(3))) for v in (places, ahead))
            end = dr.full(types.Float, math.inf, len(places))
            seen = seen_by(self.cloud.field, o, d, end, types.Float(0.5), 2)
            lights = from_suns(types, self.on_surfaces.suns, self.on_surfaces.shade)
            for source, _ in self.on_surfaces.sources:
                lights += from_source(types, source, _BEAMS_THROWN, True, self.seed)
            self.all_round = AllRound(self.cloud, lights, seen, _ROOT_AROUND, 2 * tolerance, _BUDGET // 4)
            self.counts.queries += self.all_round.queries
        self.spent("light on surfaces", clock)

    def _pilot(self, most: int) -> tuple[Any, Stratified]:
        """Pixels spread over the image, no more than `most`, and random numbers for them."""
        width, height = self.scene.size
        stride = math.ceil(math.sqrt(width * height / most))
        columns, rows = np.arange(0, width, stride), np.arange(0, height, stride)
        pixel = lanes_of(self.types.UInt32, (rows[:, None] * width + columns).ravel())
        one = dr.opaque(self.types.UInt32, 1)
        return pixel, Stratified(self.types, pixel, dr.zeros(self.types.UInt32, len(pixel)), one, self._seed()).unrelated()

    def prepare(self, tolerance: float, quick: bool = False) -> None:
        """Predict multiple scattering for this camera; from then on camera rays ask no network. `quick`: at an eighth of the nodes."""
        clock = time.perf_counter()
        pixel, numbers = self._pilot(_PILOT // 4 if quick else _PILOT)
        origin, direction, end = self._camera_rays(pixel, numbers)
        seen = seen_by(self.cloud.field, origin, direction, end, numbers.number(stratified.SHARE), _PILOT_DEPTHS)
        self.spent("pilot", clock)
        clock = time.perf_counter()
        suns = from_suns(self.types, self.on_cloud.suns, self.on_cloud.shade)
        around: list[Arriving] = []
        wide, beams = (2, _BEAMS_THROWN) if quick else (1, _BEAMS)
        for source, _ in self.on_cloud.sources:
            around += from_source(self.types, source, beams, isinstance(source, Environment), self.seed)
        # What is a large part of all light gets the fine nodes of a sun.
        power = sum(max(light.irradiance) for light in around)
        suns += [light for light in around if max(light.irradiance) > _BRIGHT * power]
        around = [light for light in around if max(light.irradiance) <= _BRIGHT * power]
        found = {
            "suns": frame_source(self.cloud, suns, [self.camera], seen, wide * _ROOT, tolerance, _BUDGET),
            "light from all around": frame_source(self.cloud, around, [self.camera], seen, wide * _ROOT_AROUND, tolerance, _BUDGET),
        }
        self.named = {name: source for name, source in found.items() if source is not None}
        self.sources = list(self.named.values())
        self.errors = relative_errors(self.sources, seen, np.array(pixel), self.scene.size)
        self.counts.queries += sum(source.queries for source in self.sources)
        self.spent("prediction", clock)

    def audit(self, correct: bool, error: float, until: float, interrupted: Callable[[], bool] | None) -> None:
        """Audit the sources, and correct them, with walks; no further round begins after the time `until`."""
        if not self.sources:
            return
        clock = time.perf_counter()
        width, height = self.scene.size
        found = Audit(self.cloud, self.on_cloud, self.sources, self._camera_rays, (width, height), self.seed)
        # Walks are as noisy as any path: half of the error takes four times as many.
        worth = WALKS_A_PIXEL * width * height * (ERROR / error) ** 2
        most = int(np.clip(worth, FEWEST, MOST)) if math.isinf(until) else MOST

        def more() -> bool:
            return time.perf_counter() < until and not (interrupted is not None and interrupted())

        outcome = audited(found, self.sources, correct, error, most, more)
        self.sources, self.found = outcome.sources, outcome.found
        self.spent("audit", clock)

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
        """Take `samples` more samples of every pixel, numbered from `first` on, of `most` in all; returns whether it was interrupted."""
        total = len(self._active)
        pixels = max(1, (_SLOW_PASS if self.sampled else _PASS) // samples)
        for start in range(0, total, pixels):
            if interrupted is not None and interrupted():
                return True
            chosen = self._active[start : start + pixels]
            self.add(chosen, first, samples, most)
            self.taken[chosen] += samples
            if progress is not None:
                progress((first + samples * min(start + pixels, total) / total) / most)
        self.samples += samples
        return False

    def settle(self, before: Image, done: int, error: float, rest: bool = True) -> tuple[float, float]:
        """Estimate the noise, and let blocks of pixels rest that add little to it.

        Parameters
        ----------
        before, done
            the image before the last round, and how many samples its pixels had taken.
        error
            noise to aim at, over the mean.
        rest
            whether blocks may rest.

        Returns
        -------
        The noise of the whole image over the mean, and by how much the number of samples of the remaining pixels should grow.
        """
        width, height = self.scene.size
        after, active = np.where(self._dazzled[:, None], 0, self.beauty()), self._active
        # Of a mean of which the last part is independent of the first.
        change = np.square((after[active] - before[active]).astype(np.float64))
        if rest:
            self._variance[active] = change * (done / (self.samples - done))
        else:
            # Where all pixels have the same rounds, each round tells as much as any other.
            self._rounds += 1
            self._scatter += change * (done / (self.samples - done) * self.samples)
            self._variance = self._scatter / (self._rounds * self.samples)
        lit = after > _DARK * np.quantile(after, 0.999)
        if not lit.any():
            return 0.0, 1.0
        allowed = (error * float(after[lit].mean(dtype=np.float64))) ** 2 * np.count_nonzero(lit)
        noise = error * math.sqrt(float(self._variance[lit].sum()) / allowed) if allowed > 0 else 0.0
        if not rest:
            return noise, float(np.clip((noise / error) ** 2, 1.0 + 0.5 / self.samples, 4.0))
        # A pixel's own estimate has two numbers behind it, a block's has many.
        index = np.arange(width * height)
        columns = -(-width // _BLOCK)
        block = index // width // _BLOCK * columns + index % width // _BLOCK
        of_block = np.bincount(block, np.where(lit, self._variance, 0).sum(axis=1))
        awake = np.zeros(len(of_block), bool)
        awake[block[active]] = True
        resting = float(of_block[~awake].sum())
        order = np.flatnonzero(awake)[np.argsort(of_block[awake])]
        sleepy = order[resting + np.cumsum(of_block[order]) <= _REST * allowed]
        # What never stays awake cannot bring the noise down.
        if len(sleepy) < len(order):
            awake[sleepy] = False
            resting += float(of_block[sleepy].sum())
            self._active = active[awake[block[active]]]
        moving = float(of_block[awake].sum())
        growth = (moving / max(allowed - resting, 1e-30)) ** _CONVERGENCE
        return noise, float(np.clip(growth, 1.0 + 0.5 / self.samples, 4.0))

    def _seed(self) -> Any:
        return dr.opaque(self.types.UInt32, self.seed & 0xFFFFFFFF)

    def add(self, pixels: NDArray[np.uint32], sample: int, samples: int, most: int) -> None:
        """Render the pixels of these numbers, `samples` samples each from number `sample` of `most` on."""
        types, scene = self.types, self.scene
        n = len(pixels) * samples
        self.counts.camera_samples += n
        count = dr.opaque(types.UInt32, samples)
        index = dr.arange(types.UInt32, n)
        local = index // count
        pixel = dr.gather(types.UInt32, types.UInt32(pixels), local)
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
            light = fast_cloud_light(
                self.cloud, self.on_cloud, sources, origin, direction, end, numbers, self.counts, self.depths, self.sampled
            )
        dr.eval(light.direct, light.indirect)
        dr.sync_thread()
        self.spent("cloud", clock)
        clock = time.perf_counter()
        self._collect(where, "volume_direct", light.direct)
        self._collect(where, "volume_indirect", light.indirect)
        self._collect(where, "volume_opacity", [light.opacity])
        depth = self.camera.distance(dr.fma(direction, light.distance, origin))
        self._collect(where, "volume_Z", [depth * light.opacity])
        through = light.transmittance
        behind = through
        alpha = light.opacity
        if interaction is not None:
            colours = reflected(self.cloud, self.on_surfaces, interaction, numbers)
            if self.interreflection:
                weight = dr.select(shown, through, 0)
                thrown = reflected_from_cloud(self.thrower, self.on_cloud, interaction, weight, numbers, self.counts)
                colours = [a + b for a, b in zip(colours, thrown, strict=True)]
            self._collect(where, "surface", [value * through for value in colours])
            behind = dr.select(shown, 0, through)
            alpha = alpha + dr.select(shown, through, 0)
        look = None if scene.hide_emitters else background(types, scene.backdrop, scene.suns)
        if look is not None:
            sky, shines = look(direction)
            self._collect(where, "background", [value * behind for value in sky])
            alpha = alpha + dr.select(shines, behind, 0)
            into = looks_into(types, scene.suns, direction)
            if into is not None:
                self._dazzled[pixels] |= np.array(dr.block_sum(dr.select(into, types.Float(1), 0), samples)) > 0
        self._collect(where, "A", [alpha])
        self.spent("surfaces and background", clock)

    def _surfaces(self, origin: Any, direction: Any, end: Any) -> tuple[Any, Any, Any]:
        """What the rays hit, where they end, and whether they hit anything."""
        mi, types = mitsuba(), self.types
        ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction))
        ray.maxt = mi.Float(end)
        interaction = self.scene.surfaces.ray_intersect(ray)
        shown = plain(types, interaction.is_valid())
        return interaction, dr.select(shown, plain(types, interaction.t), end), shown

    def _collect(self, where: tuple[NDArray[np.uint32], int], name: str, values: list[Any]) -> None:
        """Add the samples of each pixel to what is kept under `name`."""
        pixels, n = where
        # Together, or each channel would trace its own rays again.
        dr.eval(values)
        width, height = self.scene.size
        kept = self.sums.setdefault(name, np.zeros((width * height, len(values)), np.float32))
        for c, value in enumerate(values):
            kept[pixels, c] += np.array(dr.block_sum(value, n))

    def spent(self, stage: str, since: float) -> None:
        """Add the seconds since `since` to a stage."""
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - since

    def beauty(self) -> Image:
        """The image so far (pixels, 3)."""
        width, height = self.scene.size
        total = np.zeros((width * height, 3), np.float32)
        for layer in LAYERS:
            if layer in self.sums:
                total += self.sums[layer]
        total /= np.maximum(self.taken, 1)[:, None]
        return total

    def image(self) -> dict[str, Image]:
        """All channels (h, w) of the finished image."""
        width, height = self.scene.size
        means = {name: values / self.taken[:, None] for name, values in self.sums.items()}
        channels: dict[str, Image] = {}
        for layer in LAYERS:
            values = np.broadcast_to(means.get(layer, np.zeros((width * height, 3), np.float32)), (width * height, 3))
            for c, colour in enumerate(COLOURS):
                channels[f"{layer}.{colour}"] = np.ascontiguousarray(values[:, c]).reshape(height, width)
        beauty = self.beauty()
        opacity, depth, alpha = (means[name].reshape(height, width) for name in ("volume_opacity", "volume_Z", "A"))
        channels |= {colour: np.ascontiguousarray(beauty[:, c]).reshape(height, width) for c, colour in enumerate(COLOURS)}
        channels["A"] = np.minimum(alpha, 1)
        channels["volume_opacity"] = opacity
        channels["volume_Z"] = np.where(opacity > 0, depth / np.where(opacity > 0, opacity, 1), 0).astype(np.float32)
        if self.errors is not None:
            channels["confidence"] = confidence(self.errors, channels)
        return channels


@cache
def _say_ignored(error: float, asked: int) -> None:
    """Once for all frames of a sequence."""
    _LOG.info("samples a pixel are chosen for an error of %g; the scene's own %d are ignored (spp forces a number)", error, asked)


def _unknown(network: NetworkScattering, predictor: Predicts | None, scene: CloudScene) -> list[str]:
    """What of the scene's medium the model was not trained on, in words."""
    outside = getattr(predictor, "outside", None)
    if outside is None or network.descriptor.empty:
        return []
    longest = float(np.linalg.norm(scene.volume.to_world[:3, :3], axis=0).max())
    found: list[str] = outside(scene.phase, scene.albedo, longest / network.descriptor.unit)
    return found


def _say_ahead(samples: int, noise: float, error: float, end: float, most: int, pace: float) -> None:
    """Say what a path-traced image will take."""
    whole = min(samples * (noise / error) ** 2, most)
    seconds = (whole - samples) * pace
    left = end - time.perf_counter()
    text = f"path tracing: noise of a pixel is about {noise:.2g} after {samples} samples; {error:g} takes about {whole:,.0f}"
    _LOG.info("%s, %.0f s more%s", text, seconds, "" if seconds <= left else f", but there are only {max(left, 0.0):.0f} s left")
