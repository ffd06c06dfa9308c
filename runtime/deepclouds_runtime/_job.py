"""The frames that one call of `deepclouds render` makes: a single image, a sequence of volumes, or a turn around one cloud."""

from __future__ import annotations

import sys
import time
from argparse import Namespace
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deepclouds.errors import InputError
from deepclouds.replacing import check_writable
from deepclouds_runtime.sequence import VOLUMES, FileSequence, find_sequence, numbered

if TYPE_CHECKING:
    from deepclouds_runtime.progressive import Interruption
    from deepclouds_runtime.renderer import Renderer
    from deepclouds_runtime.result import RenderResult
    from deepclouds_runtime.turntable import Turntable

# Noise of a pixel that a frame among others aims at, over the mean: with the noise of an image alone, moving clouds would flicker.
ERROR_OF_FRAMES = 0.014


@dataclass(frozen=True)
class Frame:
    """One image: its number (None for an image alone), what it shows, and where it is written."""

    number: int | None
    source: str
    output: Path
    png: Path | None


@dataclass(frozen=True)
class Plan:
    """All images, and the sequence of volumes where there is one."""

    frames: tuple[Frame, ...]
    sequence: FileSequence | None
    turntable: int | None


def plan(arguments: Namespace) -> Plan:
    """What the arguments ask for; raises InputError for frames that are missing and files that cannot be written."""
    output: Path = arguments.output
    png = None if arguments.png is None else Path(arguments.png or output.with_suffix(".png"))
    inputs: Sequence[str] = arguments.input
    sequence = find_sequence(inputs)
    turn: int | None = arguments.turntable
    if sequence is not None and turn is not None:
        raise InputError(f"--turntable {turn} goes round a cloud that stands still; name one frame of {sequence.name}")
    if sequence is None and turn is None:
        if arguments.frames is not None:
            raise InputError(f"{inputs[0]} is one file, so --frames has no meaning; write %04d or #### in the place of the number")
        return Plan(_writable((Frame(None, inputs[0], output, png),)), None, None)
    if sequence is not None:
        chosen, digits = sequence.chosen(arguments.frames), sequence.digits
    else:
        assert turn is not None
        chosen, digits = arguments.frames or tuple(range(1, turn + 1)), 4
        outside = [frame for frame in chosen if not 1 <= frame <= turn]
        if outside:
            raise InputError(f"--frames: frame {outside[0]} is none of the {turn} of the turn, which are counted from 1")
    frames = tuple(
        Frame(
            number,
            inputs[0] if sequence is None else str(sequence.files[number]),
            numbered(output, number, digits),
            None if png is None else numbered(png, number, digits),
        )
        for number in chosen
    )
    return Plan(_writable(frames), sequence, turn)


def _writable(frames: tuple[Frame, ...]) -> tuple[Frame, ...]:
    """The frames, once their files are known to be writable; raises InputError before any work is done."""
    for frame in frames:
        check_writable(frame.output, ".exr")
        if frame.png is not None:
            check_writable(frame.png, ".png")
    return frames


def corrects(arguments: Namespace, made: Plan) -> bool:
    """Whether images are corrected: unless told, an image alone in the fast mode, as the correction's noise differs between frames."""
    if arguments.correct is not None:
        return bool(arguments.correct)
    interpolated = arguments.mode == "fast" and not arguments.unbiased and (arguments.exact_orders or 1) == 1
    return interpolated and not arguments.audit and made.sequence is None and made.turntable is None


def run(made: Plan, arguments: Namespace, load: Mapping[str, Any], record: Mapping[str, Any], say: Callable[[str], None]) -> int:
    """Render the frames of a plan.

    Parameters
    ----------
    made
        the plan.
    arguments
        the command line.
    load
        what `deepclouds_runtime.loading.load` is given.
    record
        goes into the headers.
    say
        takes what is printed.

    Returns
    -------
    0, or 130 when it was interrupted.
    """
    from deepclouds_runtime.progressive import INTERRUPTED, Interruption, to_stderr

    frames = made.frames
    if arguments.skip_existing:
        frames = tuple(frame for frame in frames if not _finished(frame, say))
        if not frames:
            say("every frame is there already")
            return 0
    job = _Job(made, arguments, load, record, say)
    # An image alone has nothing to lose before its first pass.
    if made.sequence is None:
        job.load(frames[0])
    with Interruption(to_stderr) as interruption:
        for index, frame in enumerate(frames):
            if made.sequence is not None and not interruption():
                job.load(frame)
            if interruption() and (index > 0 or made.sequence is not None):
                break
            job.render(frame, interruption, f" ({index + 1} of {len(frames)})" if len(frames) > 1 else "")
            if interruption():
                index += job.complete
                break
        else:
            return 0
    left = len(frames) - index
    if frames[0].number is not None and left:
        to_stderr(f"interrupted: {left} of {len(frames)} frames are left; the same command with --skip-existing goes on")
    return INTERRUPTED if left else 0


class _Job:
    """What is kept from frame to frame."""

    def __init__(
        self, made: Plan, arguments: Namespace, load: Mapping[str, Any], record: Mapping[str, Any], say: Callable[[str], None]
    ) -> None:
        self._made, self._arguments, self._load, self._record, self._say = made, arguments, dict(load), record, say
        self._renderer: Renderer | None = None
        self._turntable: Turntable | None = None
        self._described = False
        self._started = time.perf_counter()
        self.complete = True

    def load(self, frame: Frame) -> None:
        """Read what the frame shows."""
        from deepclouds_runtime import loading
        from deepclouds_runtime.key_frames import fixed_by
        from deepclouds_runtime.volume_scene import NAMES, options_from, pivot

        made, up = self._made, "y"
        self._started = time.perf_counter()
        if made.sequence is not None and "fixed" not in self._load:
            options = options_from({k: v for k, v in self._load.items() if k in NAMES})
            files = [made.sequence.files[key] for key in made.sequence.key_frames]
            self._load["fixed"] = fixed_by(files, options, self._load.get("grid"), bool(self._load.get("clamp")))
        if made.turntable is not None:
            up = self._load.get("up", "y")
            if Path(frame.source).suffix.lower() not in VOLUMES:
                # A scene has its own camera, which turns around what we are told is upright.
                self._load.pop("up", None)
            self._load["turn"] = made.turntable
        # Two frames' grids at once may be more than the machine has.
        self._renderer = None
        self._renderer = loading.load(frame.source, **self._load)
        if made.sequence is not None:
            # The networks are read once, and every frame asks the same.
            self._load |= {"predictor": self._renderer.predictor, "quick": self._renderer.quick}
        if made.turntable is not None:
            from deepclouds_runtime.turntable import Turntable
            from deepclouds_runtime.volume_scene import framed_corners

            scene = self._renderer.scene
            self._turntable = Turntable(scene.sensor, made.turntable, pivot(framed_corners(scene.volume), up), up)

    def render(self, frame: Frame, interruption: Interruption, place: str) -> None:
        """Render and write one frame."""
        from deepclouds_runtime import _report
        from deepclouds_runtime.output import save
        from deepclouds_runtime.progressive import Pictures

        renderer, arguments, say = self._renderer, self._arguments, self._say
        assert renderer is not None
        if frame.number is not None and self._turntable is not None:
            self._turntable.turn(frame.number)
        if not self._described:
            _report.describe(renderer, say)
        dial = self._dial(frame)
        of_scene = _report.settings(renderer, dial["correct"])

        def write(result: RenderResult) -> None:
            given = {"input": frame.source, "frame": frame.number, "spp": result.statistics.spp}
            save(result, frame.output, {**self._record, **given, **of_scene}, frame.png, arguments.exposure)

        started = time.perf_counter() if self._described else self._started
        pictures = None if arguments.progressive is None else Pictures(write, arguments.progressive)
        words = "rendering" if frame.number is None else f"frame {frame.number}{place}"
        with _progress(arguments.quiet, words) as (progress, estimate):
            result = renderer.render(
                arguments.spp, arguments.seed, progress, partial=pictures, interrupted=interruption, estimate=estimate, **dial
            )
        write(result)
        self.complete = result.statistics.complete
        named = f"{frame.output}" + (f" and {frame.png}" if frame.png is not None else "")
        if not self.complete:
            from deepclouds_runtime.progressive import to_stderr

            to_stderr(f"interrupted: wrote {named} with {_report.noise_words(result)}")
        elif frame.number is None:
            _report.report(result, say)
        if not self._described:
            for note in result.notes:
                if note not in renderer.notes:
                    say(f"warning: {note}")
        if self.complete and frame.number is None:
            say(f"wrote {named}")
        elif self.complete:
            say(f"frame {frame.number}{place}: {time.perf_counter() - started:.1f} s, {_report.noise_words(result)}; wrote {named}")
        self._described = True

    def _dial(self, frame: Frame) -> dict[str, Any]:
        """What `Renderer.render` is told of error, time, and walks."""
        arguments = self._arguments
        dial: dict[str, Any] = {"audit": arguments.audit, "correct": corrects(arguments, self._made), "time_limit": arguments.time}
        # Time alone is used up, and so is a number of paths.
        alone = arguments.time is not None or (arguments.unbiased and arguments.spp is not None)
        if arguments.error is not None:
            dial["error"] = arguments.error
        elif frame.number is not None and not alone:
            dial["error"] = ERROR_OF_FRAMES
        return dial


def _finished(frame: Frame, say: Callable[[str], None]) -> bool:
    """Whether a frame need not be rendered again."""
    from deepclouds_runtime.output import is_complete

    if not frame.output.exists() or (frame.png is not None and not frame.png.exists()):
        return False
    if not is_complete(frame.output):
        say(f"{frame.output} is not finished or cannot be read: it is rendered again")
        return False
    return True


@contextmanager
def _progress(quiet: bool, words: str) -> Iterator[tuple[Callable[[float], None] | None, Callable[[float], None] | None]]:
    """A bar on the terminal: what takes the share of the work done, and what takes the noise."""
    if quiet or not sys.stderr.isatty():
        yield None, None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(words, total=1.0)
        yield (
            lambda share: bar.update(task, completed=share),
            lambda noise: bar.update(task, description=f"{words}, noise of about {100 * noise:.2g} %"),
        )
