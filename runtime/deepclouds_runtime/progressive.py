"""A render that can be stopped, and one that shows itself while it is refined."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from deepclouds_runtime.result import RenderResult

INTERRUPTED = 130
"""Exit code of a command that was stopped by a signal, whichever it was."""
_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interruption:
    """The first SIGINT or SIGTERM asks the render to stop, the second one raises `KeyboardInterrupt` at once; as a context manager.

    Outside of the main thread, where Python allows no handlers, nothing changes and nothing is ever asked.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._asked = self._twice = False
        self._before: dict[int, Any] = {}

    def __call__(self) -> bool:
        """Whether the render should stop."""
        return self._asked

    def __enter__(self) -> Interruption:
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._handle) for number in _SIGNALS}
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        # What was running may have made an error of its own out of it.
        if self._twice and error is not None and not isinstance(error, KeyboardInterrupt):
            raise KeyboardInterrupt from error

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._asked:
            self._twice = True
            raise KeyboardInterrupt
        self._asked = True
        self._say("stopping after the running pass; once more stops at once, without the image")


class Pictures:
    """Writes the image while it is refined: the first one as soon as it is there, then one each `seconds`.

    Parameters
    ----------
    write
        writes an image, all or nothing.
    seconds
        that must have passed since the last one.
    """

    def __init__(self, write: Callable[[RenderResult], None], seconds: float) -> None:
        self._write, self._seconds = write, seconds
        self._last: float | None = None

    def __call__(self, result: RenderResult) -> None:
        """Take the image so far."""
        if self._last is not None and time.monotonic() - self._last < self._seconds:
            return
        self._write(result)
        self._last = time.monotonic()


def to_stderr(text: str) -> None:
    """Say something beside the results."""
    print(text, file=sys.stderr, flush=True)
