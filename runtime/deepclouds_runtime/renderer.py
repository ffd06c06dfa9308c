"""Renders a scene that was read: camera samples in passes, the cloud's light along them, surfaces and background behind it."""

from __future__ import annotations

import gc
import logging
import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from deepclouds.errors import InputError
from deepclouds.medium.albedo import AlbedoField
from deepclouds.medium.field import Field
from deepclouds.memory import peak_bytes
from deepclouds_runtime._mitsuba import mitsuba, types_of
from deepclouds_runtime.audit import time_for_walks
from deepclouds_runtime.camera import Camera
from deepclouds_runtime.confidence import doubtful, warning
from deepclouds_runtime.error_parts import error_parts
from deepclouds_runtime.frame import ERROR, Frame
from deepclouds_runtime.frame_source import part_of_time
from deepclouds_runtime.light_walks import Paths
from deepclouds_runtime.lights import Shade, environment
from deepclouds_runtime.reflectors import Reflectors
from deepclouds_runtime.result import COLOURS, RenderResult, Statistics
from deepclouds_runtime.rounds import Watch, fixed_rounds, rounds_for_error, say_ignored
from deepclouds_runtime.scattering import NetworkScattering, Predicts, Stopped
from deepclouds_runtime.scene import CloudScene
from deepclouds_runtime.transport import Cloud, Counts, Lights

_LOG = logging.getLogger(__name__)

MODES = ("fast", "reference")
# A pixel's samples are in flight together.
_MOST_SAMPLES = 1 << 20
# What the fast mode stops at by itself: a scene whose noise is still too large then says so.
_MOST_AUTOMATIC = 1024
# The smallest error that can be asked for: what samples and walks add up is known to about six digits.
_LEAST_ERROR = 1e-6
# Where one sample a pixel takes more of what is left than this, each draws one direction from an environment.
_DEAR = 0.4
# Of a time limit, what predictions may take where walks correct them and where nothing does, and of the former what is left for them
# each time that light thrown on surfaces is predicted.
_PREDICTION, _PREDICTION_ALONE, _ON_SURFACES = 0.35, 0.7, 0.25
# How often light goes from the surfaces to the cloud and back.
_TURNS = 2
# By how much less than the usual noise keeps pixels awake where the time alone decides.
_TIMED = 0.25
# Error of the interpolation at a point over the noise of a pixel, both aimed at: along rays and between pixels that of points averages out.
_INTERPOLATION = 2.5


class Renderer:
    """One scene, loaded once and rendered as often as asked.

    What depends on neither sun nor camera is kept: the extinction on the device, the pyramid of filtered levels, the network.

    Parameters
    ----------
    scene
        what `deepclouds_runtime.scene.read_scene` returns.
    predictor
        the network; not needed with `unbiased` or in a scene with ``max_depth = 2``.
    quick
        loads a quicker one, which corrected images ask about light from all around and about what surfaces see, where that is many queries
        for little light each; called for the first of them.
    unbiased
        whether J comes from Monte Carlo walks, one a sample, in place of the network.
    exact_orders
        orders of scattering that are sampled before the network is asked. With 1, single scattering, it is asked about what the camera
        sees; with n about what light that was scattered n times sees, and no longer interpolated.
    environment_directions
        directions drawn from an environment at each sample of the cloud.
    interreflection
        whether surfaces receive the cloud's light, and the cloud that of the surfaces. Light that goes back and forth more than twice,
        and light from one surface to another, are left out.
    mode
        ``"fast"``: J is predicted at a sparse set of points and interpolated, samples are spent until the noise is as asked; or
        ``"reference"``: the method as published, where every sample asks the network. With `unbiased` there is but one.
    extrapolate
        whether the network is asked about media that it was not trained on; by default J then comes from walks.
    unit, origin
        of the descriptor, see `deepclouds.descriptor.Descriptor`: fixed for a sequence of frames; by default those of the cloud.
    longest
        in the place of the longest side of the cloud's box, world units, for the choice whether the model knows clouds of this size:
        fixed for a sequence, too.
    load_seconds
        what loading took before, reported as ``seconds["load"]``.

    Attributes
    ----------
    notes
        what was approximated in reading the scene, and what of its medium the model was not trained on, in sentences.
    model_hash
        of the weights that are asked, or None; images that `traces` tells of ask none.
    predictor, quick
        the network that was given, and what loads the quicker one.

    Raises
    ------
    InputError
        for options that make no sense, alone or together.
    """

    def __init__(
        self,
        scene: CloudScene,
        predictor: Predicts | None = None,
        quick: Callable[[], Predicts] | None = None,
        *,
        unbiased: bool = False,
        exact_orders: int = 1,
        environment_directions: int = 2,
        interreflection: bool = True,
        mode: str = "fast",
        extrapolate: bool = False,
        unit: float | None = None,
        origin: NDArray[np.float64] | None = None,
        longest: float | None = None,
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
        self._albedo = None if scene.varying is None else AlbedoField(self._field, scene.varying)
        self._network: NetworkScattering | None = None
        # Whether it was not trained on the scene's medium, and so is not asked.
        self._unknown = False
        # Whether paths are traced in place of the network, asked for or not; where the albedo varies, in images that walks do not correct.
        self._walks = (unbiased or (self._albedo is not None and predictor is None)) and scene.max_depth != 2
        if scene.max_depth != 2 and not self._walks:
            if predictor is None:
                raise InputError("multiple scattering needs a model; give one, or render single scattering alone (max_depth 2)")
            self._network = NetworkScattering(self._field, predictor, unit, origin)
        # Single scattering alone stops before light that surfaces have reflected, as volpath with max_depth 2 does.
        self._interreflection = interreflection and scene.surfaces is not None and scene.max_depth != 2
        self.notes = scene.notes
        if unbiased:
            self.notes += ("unbiased: paths are traced with our own tracker until the noise is as asked; no network is asked",)
        elif self._albedo is not None and scene.max_depth != 2:
            self.notes += (
                "the albedo varies in space, and the network knows one albedo a query: it is asked with the mean around each point, and "
                "walks correct that; in an image that is not corrected multiple scattering is path-traced, noisy and slow",
            )
        if self._network is not None and (unknown := _unknown(self._network, predictor, scene, longest)):
            self._unknown = not extrapolate
            instead = (
                "extrapolated"
                if extrapolate
                else "path-traced in place of it ('extrapolate' asks it all the same): at nodes in an image that walks correct, else for "
                "each sample, noisy and slow"
            )
            self.notes += (f"the model was not trained for {', '.join(unknown)}: multiple scattering is {instead}",)
        self.quick, self._longest = quick, longest
        self.model_hash: str | None = None
        if self._network is not None and not self._unknown:
            self.model_hash = getattr(getattr(predictor, "metadata", None), "initialisers_sha256", None)
        self._load_seconds = load_seconds + time.perf_counter() - started

    @cached_property
    def _quicker(self) -> NetworkScattering | None:
        """The quicker network, where there is one that was trained on the scene's medium."""
        if self.quick is None or self._network is None or self._unknown:
            return None
        predictor = self.quick()
        return None if _unknown(self._network, predictor, self.scene, self._longest) else self._network.asking(predictor)

    @property
    def unit(self) -> float | None:
        """Unit of length of the network's input, world units; None where no network is asked."""
        return None if self._network is None or self._unknown else self._network.descriptor.unit

    def traces(self, correct: bool) -> bool:
        """Whether an image, one that walks `correct` or not, is path-traced, and so asks no network."""
        return self._walks or ((self._albedo is not None or self._unknown) and not correct and self.scene.max_depth != 2)

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
            samples a pixel; fewer where the time is over, or in an unbiased render the noise as small as an `error` that is given. By
            default the fast mode takes as many as `error` asks for, the reference mode those of the camera's sampler, which is also the
            most that paths take that nobody asked for (`extrapolate`).
        seed
            of all random numbers.
        progress
            is called with the share of the work done, 0 to 1.
        error
            of the fast mode: noise of a pixel to aim at, root of the mean square over the mean; the interpolation may add half as much.
            By default 0.02; with a `time_limit` alone the time alone decides. Of an image that walks correct it is the error: noise, and
            what the walks find to be left of the network's; where that is more than 0.77 of it already, the noise is brought to 0.63 of it.
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
            cloud throws on surfaces is corrected by one number a channel.
        time_limit
            seconds: the audit ends where samples will need the rest, by a trial of a few; they end with the last round that should end in
            time, or once there are `spp`. The result then depends on the machine.

        Raises
        ------
        InputError
            when `spp` is below 1 or above 1,048,576, `error` is below a millionth, `time_limit` is not positive, or what is to be audited
            is not interpolated.
        """
        scene, types = self.scene, self._types
        # What ends a number of samples early: an adaptive image has as many as are asked for, whatever the noise.
        target = error if self.unbiased else None
        timed = error is None and time_limit is not None and spp is None
        error = ERROR if error is None else error
        if not error >= _LEAST_ERROR:
            raise InputError(f"error = {error}: give the share of the mean to aim at, {_LEAST_ERROR} or more, for example {ERROR}")
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
        # Shapes of scenes that nobody holds any more are among those that a kernel may call. Collected while one is traced, they leave it
        # with two kinds of calls of one function, which Dr.Jit 1.5 then defines twice, and LLVM aborts.
        gc.collect()
        watch = Watch(progress, partial, interrupted, estimate)
        adaptive = self.mode == "fast"
        walks = self.traces(correct)
        if audit and walks:
            _say_nothing_to_audit()
        paths = Paths(self._field, scene.albedo, scene.phase, self._albedo, seed) if walks else None
        scattering = None if walks else self._network
        # Whether rays end in a walk or a query of their own; otherwise multiple scattering of the fast mode is interpolated.
        sampled = adaptive and (paths is not None or (scattering is not None and self._exact_orders > 1))
        most = self.samples(spp) if spp is not None or not adaptive or (walks and not self.unbiased) else _MOST_AUTOMATIC
        if spp is None and self.unbiased:
            most = _MOST_SAMPLES
        exact = 1 if walks else self._exact_orders
        cloud, lights = Cloud(self._field, scene.albedo, scene.phase, scattering, None, exact, self._albedo, paths), self._lights()
        camera = Camera(types, scene.sensor)
        quick = self._quicker if correct else None
        frame = Frame(
            scene, camera, cloud, lights, lights, types, seed, self._interreflection, quick=quick, unknown=self._unknown, sampled=sampled
        )
        frame.spent("lights", started)
        if adaptive and not walks and partial is not None:
            clock = time.perf_counter()
            look = self._quick_look(frame, lights)
            look.round(0, 1, 1, None)
            partial(self._result(look, started, None, False))
            frame.counts.queries += look.counts.queries
            frame.spent("quick look", clock)
        # Walks make up for nodes that there was no time for.
        by = math.inf if time_limit is None else started + (_PREDICTION if correct else _PREDICTION_ALONE) * time_limit
        if not self._prepared(frame, lights, error, correct, interrupted, by):
            look = self._quick_look(frame, lights)
            look.round(0, 1, 1, None)
            return self._result(look, started, None, False)
        if adaptive and not sampled and (audit or correct):
            until = math.inf
            if time_limit is not None:
                one, all_of_them = frame.sampling_seconds(error)
                if spp is not None:
                    all_of_them = most * one
                now = time.perf_counter()
                left = started + time_limit - now
                if one > _DEAR * left:
                    sources = frame.on_cloud.sources
                    # Shadow rays toward the environment are most of what a sample costs.
                    one /= max((count for _, count in sources), default=1)
                    frame.on_cloud = replace(frame.on_cloud, sources=tuple((source, 1) for source, _ in sources))
                until = now + time_for_walks(left, one, all_of_them)
            frame.audit(correct, 0.0 if timed else error, until, interrupted)

        def so_far(noise: float) -> RenderResult:
            return self._result(frame, started, noise, False)

        end = math.inf if time_limit is None else started + time_limit
        if spp is not None or not adaptive:
            noise, stopped = fixed_rounds(frame, most, error, watch, so_far, target, end)
        else:
            # Paths that nobody asked for stop at the scene's own number.
            if (own := int(scene.sensor.sampler().sample_count())) != most:
                say_ignored(None if timed else error, own)
            # Blocks that rested because their paths found little light by chance would make an unbiased image dark.
            goal = _TIMED * error if timed and not walks else frame.noise_goal(error)
            noise, stopped = rounds_for_error(frame, most, None if timed else goal, goal, end, not walks, watch, so_far)
        return self._result(frame, started, noise, not stopped)

    def _prepared(
        self, frame: Frame, lights: Lights, error: float, correct: bool, interrupted: Callable[[], bool] | None, until: float
    ) -> bool:
        """Predict what the frame interpolates, and see what surfaces send to the cloud, by about the time `until`.

        False where somebody stopped it.
        """
        adaptive = self.mode == "fast" and frame.cloud.paths is None
        try:
            for network in filter(None, (self._network, frame.quick)):
                network.stop = interrupted
            if adaptive and self._interreflection:
                frame.prepare_thrown(_INTERPOLATION * error, correct, part_of_time(until, _ON_SURFACES))
            reflectors: Reflectors | None = None
            for turn in range(_TURNS if self._interreflection else 0):
                clock = time.perf_counter()
                seed = (frame.seed + turn) & 0xFFFFFFFF
                probed = frame.probed(correct and math.isinf(until))
                # Walks in the place of queries are none.
                counts = frame.counts if probed.paths is frame.cloud.paths else Counts()
                reflectors = Reflectors(probed, lights, frame.on_cloud, seed, counts, reflectors)
                frame.on_cloud = replace(lights, sources=(*lights.sources, (reflectors, 1)))
                frame.spent("probe", clock)
                if turn == 0 or math.isinf(until):
                    frame.prepare_thrown_back(_INTERPOLATION * error, part_of_time(until, _ON_SURFACES))
            if self.mode == "fast" and not frame.sampled:
                frame.prepare(_INTERPOLATION * error, corrected=correct, until=until)
        except Stopped:
            return False
        finally:
            for network in filter(None, (self._network, frame.quick)):
                network.stop = None
        return True

    def _quick_look(self, frame: Frame, lights: Lights) -> Frame:
        """What a quick look is rendered with: one collision a sample, few nodes, surfaces without the cloud's light."""
        cloud = replace(frame.cloud, exact=1)
        look = Frame(self.scene, frame.camera, cloud, lights, lights, self._types, frame.seed, False, depths=1, quick=frame.quick)
        look.unknown = self._unknown
        look.prepare(math.inf, quick=True)
        return look

    def _result(self, frame: Frame, started: float, noise: float | None, complete: bool) -> RenderResult:
        """The image so far; `noise` as estimated, infinite or None where it was not."""
        channels = frame.image()
        seconds = {"load": self._load_seconds, **frame.seconds, "total": time.perf_counter() - started}
        rgb = np.stack([channels[c] for c in COLOURS], axis=-1)
        mode = "reference" if self.mode == "reference" else "path-traced" if frame.cloud.paths is not None else "fast"
        statistics = Statistics(
            mode,
            int(frame.film.taken.max()),
            float(frame.film.taken.mean()),
            noise if noise is not None and math.isfinite(noise) else None,
            complete,
        )
        named = {**frame.named, "light on surfaces": None if frame.all_round is None else frame.all_round.source}
        statistics.sources |= {name: source.summary() for name, source in named.items() if source is not None}
        statistics.skipped = frame.skipped()
        statistics.audit = frame.found
        levels = 0 if self._network is None else self._network.descriptor.nbytes
        statistics.memory = {
            "field": self._field.nbytes + (0 if self._albedo is None else self._albedo.nbytes),
            "levels": levels,
            "peak": peak_bytes(),
        }
        notes = self.notes
        if "confidence" in channels:
            statistics.network = doubtful(channels["confidence"], channels)
            notes += tuple(filter(None, [warning(statistics.network)]))
        whole = float(rgb.sum(dtype=np.float64))
        indirect = sum(float(channels[f"volume_indirect.{c}"].sum(dtype=np.float64)) for c in COLOURS)
        statistics.error = error_parts(
            statistics.noise,
            [(source.error, source.level) for source in frame.sources or []],
            indirect / whole if whole > 0 else 0.0,
            self._network is not None and not self._unknown and frame.cloud.paths is None and frame.sources != [],
            frame.found,
            statistics.network,
            getattr(getattr(self.predictor, "metadata", None), "metrics", {}),
        )
        return RenderResult(rgb, channels["A"], channels, seconds, replace(frame.counts), statistics, notes)

    def _lights(self) -> Lights:
        """The lights, with the tables that depend on them: made anew for each render."""
        shade = Shade(self._types, self.scene.surfaces, self.scene.volume.bounds)
        sources = []
        if self.scene.environment is not None:
            sources.append((environment(self._types, self.scene.environment, shade), self.environment_directions))
        return Lights(self.scene.suns, tuple(sources), shade)


@cache
def _say_nothing_to_audit() -> None:
    """Say that an audit finds no network, once for all frames of a sequence."""
    _LOG.info("nothing to audit: multiple scattering is path-traced, and no network is asked")


def _unknown(network: NetworkScattering, predictor: Predicts | None, scene: CloudScene, longest: float | None) -> list[str]:
    """What of the scene's medium the model was not trained on, in words; `longest` stands for the longest side of its box."""
    outside = getattr(predictor, "outside", None)
    if outside is None or network.descriptor.empty:
        return []
    if longest is None:
        longest = float(np.linalg.norm(scene.volume.to_world[:3, :3], axis=0).max())
    found: list[str] = outside(scene.phase, scene.albedo, longest / network.descriptor.unit)
    return found
