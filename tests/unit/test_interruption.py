"""The first signal asks, the second one ends; pictures on the way come no more often than asked."""

from __future__ import annotations

import os
import signal
from typing import Any

import pytest
from deepclouds_runtime.progressive import Interruption, Pictures


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_signal_asks_and_the_second_ends(number: int) -> None:
    before = signal.getsignal(number)
    said: list[str] = []
    with pytest.raises(KeyboardInterrupt), Interruption(said.append) as interruption:  # noqa: PT012
        assert not interruption()
        os.kill(os.getpid(), number)
        assert interruption()
        assert len(said) == 1
        os.kill(os.getpid(), number)
    assert signal.getsignal(number) is before


def test_an_error_that_hides_the_second_signal_does_not_stay() -> None:
    with pytest.raises(KeyboardInterrupt), Interruption(lambda text: None):  # noqa: PT012
        os.kill(os.getpid(), signal.SIGINT)
        try:
            os.kill(os.getpid(), signal.SIGINT)
        except KeyboardInterrupt as error:
            raise RuntimeError("a kernel failed") from error


def test_other_errors_pass() -> None:
    with pytest.raises(ValueError, match="mine"), Interruption(lambda text: None):
        raise ValueError("mine")


def test_pictures_keep_their_distance(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([10.0, 11.0, 12.5, 12.5])
    monkeypatch.setattr("deepclouds_runtime.progressive.time.monotonic", lambda: next(clock))
    written: list[Any] = []
    pictures = Pictures(written.append, 2.0)
    for result in ("look", "first", "second"):
        pictures(result)  # type: ignore[arg-type]
    assert written == ["look", "second"]
