"""Signs of life of the bench's threads, for the guardian: each says what it does and how long that may take.

A thread that is silent for longer than it said hangs. Time is real time: a hung bench is hung in the world, whatever its
clock says. May not know who looks.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from instruments.clock import stopwatch_s
from instruments.operators.operator import Arrangement, Operator, Placed

BRIEF_S = 10.0  # what needs no word of its own is over by then


class Pulse:
    """Who signs, what is being done, and until when. May be used by all threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._until: dict[str, tuple[float, float, str]] = {}

    def sign(self, what: str, at_most_s: float = BRIEF_S, *, who: str = "the main thread") -> None:
        """``who`` is alive and now does ``what``, which takes ``at_most_s``; the next sign ends it."""
        with self._lock:
            self._until[who] = (stopwatch_s() + at_most_s, at_most_s, what)

    def rest(self, who: str) -> None:
        """``who`` has ended as it should, and signs no more."""
        with self._lock:
            self._until.pop(who, None)

    def overdue(self) -> str | None:
        """Who hangs, and in what; None when all signed in time."""
        now = stopwatch_s()
        with self._lock:
            for who, (until_s, allowed_s, what) in self._until.items():
                if now > until_s:
                    return f"{who} hangs: {what} took more than {allowed_s:g} s"
        return None


class AwaitedOperator:
    """An operator who may take his time: the thread that waits for him doesn't hang."""

    def __init__(self, operator: Operator, pulse: Pulse) -> None:
        self._operator = operator
        self._pulse = pulse

    def confirm_homing(self, instruction: str) -> None:
        with self._waiting("the arm to be put on its peg"):
            self._operator.confirm_homing(instruction)

    def touch_check_point(self, touch: int, of: int) -> None:
        with self._waiting("the check point to be touched"):
            self._operator.touch_check_point(touch, of)

    def set_up(self, arrangement: Arrangement) -> Placed:
        with self._waiting("the scene to be set up"):
            return self._operator.set_up(arrangement)

    def touch(self, teat: int, of: int) -> None:
        with self._waiting(f"teat {teat} to be touched"):
            self._operator.touch(teat, of)

    def release(self) -> None:
        self._operator.release()

    @contextmanager
    def _waiting(self, what: str) -> Iterator[None]:
        self._pulse.sign(f"waiting for {what}", math.inf)
        try:
            yield
        finally:
            self._pulse.sign("going on")
