"""Ctrl-C at a moment of a test's choosing, beside the timer that ends a test which hangs."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

import pytest

AGAIN_S = 20.0


@contextmanager
def interrupts() -> Iterator[Callable[[float], None]]:
    """Yields a function that brings Ctrl-C to its handler in the main thread, once, in so many
    seconds.

    Call it where the interrupt is waited for: on a busy machine it may come at once. One that got
    lost comes once more after `AGAIN_S`, since who waits for it has no other end. The timer of
    pytest-timeout, which is the same one, goes on afterwards.
    """
    if not hasattr(signal, "setitimer"):
        pytest.skip("needs interval timers, which this system has none of")

    def interrupt(_number: int, frame: FrameType | None) -> None:
        handler = signal.getsignal(signal.SIGINT)
        assert callable(handler)
        handler(signal.SIGINT, frame)

    def interrupt_in(seconds: float) -> None:
        signal.setitimer(signal.ITIMER_REAL, seconds, AGAIN_S)

    left_s, _ = signal.setitimer(signal.ITIMER_REAL, 0.0)
    began = time.monotonic()
    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        yield interrupt_in
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
        if left_s:
            signal.setitimer(signal.ITIMER_REAL, max(0.001, left_s - (time.monotonic() - began)))
