"""Waiting for what another thread or process does: for the event, not for a duration."""

from __future__ import annotations

import time
from collections.abc import Callable

EACH_S = 0.01


def within(
    seconds: float,
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
        assert time.monotonic() - start_s < seconds, f"not within {seconds:g} s: {what}\n{said()}"
        assert code() is None, f"ended with {code()} before: {what}\n{said()}"
        time.sleep(EACH_S)
    return time.monotonic() - start_s
