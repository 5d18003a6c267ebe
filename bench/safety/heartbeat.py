"""Signs of life of the bench's threads, for the guardian: each says what it does, how long that may
take, and how long in silence.

Whoever looks at the clock lives, so a long move shows life all the time, while a computation or a
prompt may not. A thread that is silent for longer than it said hangs, and so does one that takes
longer in all. Time is real time: a hung bench is hung in the world, whatever its clock says. May
not know who looks.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass

from instruments.clock import stopwatch_s

BRIEF_S = 10.0  # what needs no word of its own is over by then


@dataclass(slots=True)
class _Doing:
    """What a thread does: ``until_s`` in all, ``silent_until_s`` without a further sign of life."""

    what: str
    thread: int
    at_most_s: float
    until_s: float
    silence_s: float
    silent_until_s: float


class Heartbeat:
    """Who signs, what is being done, and until when. May be used by all threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._doing: dict[str, _Doing] = {}

    def sign(
        self,
        what: str,
        at_most_s: float = BRIEF_S,
        *,
        silence_s: float | None = None,
        who: str = "the main thread",
    ) -> None:
        """``who`` is alive and now does ``what``, which takes ``at_most_s``; the next ``sign`` ends
        it.

        With ``silence_s`` it has to be ``alive`` that often meanwhile.
        """
        now_s, quiet_s = stopwatch_s(), at_most_s if silence_s is None else silence_s
        with self._lock:
            self._doing[who] = _Doing(
                what, threading.get_ident(), at_most_s, now_s + at_most_s, quiet_s, now_s + quiet_s
            )

    def alive(self, asleep_s: float = 0.0) -> None:
        """The calling thread lives, and will sleep for ``asleep_s``; no word where it has signed
        nothing.
        """
        now_s, caller = stopwatch_s(), threading.get_ident()
        with self._lock:
            for doing in self._doing.values():
                if doing.thread == caller:
                    doing.silent_until_s = now_s + asleep_s + doing.silence_s

    def rest(self, who: str) -> None:
        """``who`` has ended as it should, and signs no more."""
        with self._lock:
            self._doing.pop(who, None)

    def overdue(self) -> str | None:
        """Who hangs, and in what; None when all signed in time."""
        now = stopwatch_s()
        with self._lock:
            for who, doing in self._doing.items():
                if now > doing.until_s:
                    return f"{who} hangs: {doing.what} took more than {doing.at_most_s:g} s"
                if now > doing.silent_until_s:
                    return (
                        f"{who} hangs: {doing.what}, and no sign of life for {doing.silence_s:g} s"
                    )
        return None
