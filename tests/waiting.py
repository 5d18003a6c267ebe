"""Waiting for what another thread or process does: for the event, not for a duration."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress

import psutil

EACH_S = 0.01
PATIENCE_S = 300.0  # a machine with ten times too much to do; a test has 600


def within(
    there: Callable[[], object],
    what: str,
    *,
    said: Callable[[], str] = lambda: "",
    code: Callable[[], int | None] = lambda: None,
) -> float:
    """How long it took. ``said`` and ``code``: what the process that brings it about has shown, and
    its exit code once it has ended.
    """
    start_s = time.monotonic()
    while not there():
        assert time.monotonic() - start_s < PATIENCE_S, (
            f"not within {PATIENCE_S:g} s: {what}\n{said()}"
        )
        assert code() is None, f"ended with {code()} before: {what}\n{said()}"
        time.sleep(EACH_S)
    return time.monotonic() - start_s


def alive(pid: int) -> bool:
    """Whether a process has not ended."""
    with suppress(psutil.NoSuchProcess):
        return bool(psutil.Process(pid).status() != psutil.STATUS_ZOMBIE)
    return False
