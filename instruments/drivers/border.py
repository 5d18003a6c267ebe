"""Calls of another package's code: whatever it raises, and what never comes back, becomes an
InstrumentError. In virtual time it is called directly, and is late by the clock alone.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from typing import Any, Generic, TypeVar

from instruments.clock import Clock, VirtualClock
from instruments.drivers.entry_points import Plugin, by_ctrl_c, one_line, said, undisturbed
from instruments.errors import DriverError, InstrumentError, LinkError, ProtocolError

CALL_S, OPEN_S, CLOSE_S, BEAT_S = 10.0, 10.0, 2.0, 1.0
T = TypeVar("T")
Made = TypeVar("Made")


class PluginBoundary(Generic[Made]):
    """The plug-in ``plugged`` as ``who``, opened when it is first needed and again after a lost
    link. `call` is for one thread at a time. What it gives is checked within the call, so that no
    value of another's makes an exception outside.
    """

    def __init__(self, plugged: Plugin, who: str, clock: Clock) -> None:
        self.who, self.plugged = who, plugged
        self.clock = clock
        self._made: Made | None = None
        self.locked = threading.RLock()  # so that several calls aren't parted
        self._owner = threading.local()
        self._opened = 0
        self.look = f"Look at the device, then at its driver: {plugged}."

    def call(self, what: str, work: Callable[[Made], T], limit_s: float | None = None) -> T:
        """``work`` on the plug-in. Raises InstrumentError alone."""
        with self.locked:
            made = self.open()
            try:
                return self._within(what, lambda: work(made), limit_s)
            except LinkError:
                self.forget()
                raise

    def open(self) -> Made:
        """The plug-in, opened where it is not. Raises InstrumentError."""
        with self.locked:
            if self._made is None:
                self._made = self._within("open", lambda: self.plugged.make(self.clock), OPEN_S)
                self._opened += 1
            return self._made

    @property
    def link(self) -> int:
        """The number of the opening that is used; 0 where it was closed or lost."""
        return self._opened if self._made is not None else 0

    def aside(self, what: str, work: Callable[[Made], T]) -> T:
        """``work`` at once, beside a call that is under way. Raises InstrumentError alone."""
        made = self.open() if self._made is None else self._made
        return self._within(what, lambda: work(made), None)

    def forget(self) -> None:
        """Close the plug-in, in 2 s at most; another one is opened when it is next needed."""
        made, self._made = self._made, None
        if made is not None:
            with suppress(InstrumentError):  # it is gone, or hangs
                self._within("close", lambda: made.close(), CLOSE_S)  # type: ignore[attr-defined]

    @contextmanager
    def opening(self) -> Iterator[None]:
        """Close it where what is asked of it first fails."""
        try:
            yield
        except BaseException:
            self.forget()
            raise

    @undisturbed()
    def _within(self, what: str, work: Callable[[], T], limit_s: float | None) -> T:
        limit_s, by = CALL_S if limit_s is None else limit_s, f"{self.who}: {what}"
        job: Future[T] = Future()
        try:
            if getattr(self._owner, "is_us", False):
                return work()
            if isinstance(self.clock, VirtualClock):
                late_s, given = self.clock.now() + limit_s, work()
                if self.clock.now() > late_s:
                    raise self._late(what, limit_s)
                return given
            thread = threading.Thread(None, self._run, by, (job, work), daemon=True)
            try:
                thread.start()
            except Exception:  # no more threads are to be had: without a limit, yet done
                return work()
            self._wait_for(thread, what, limit_s)
            return job.result()
        except InstrumentError as error:
            self._name(error)
            raise
        except BaseException as error:  # another's code: not every library's errors are Exceptions
            if by_ctrl_c(error) and not (job.done() and job.exception() is error):
                raise
            kind, hint = LinkError if isinstance(error, OSError) else DriverError, self.look
            if what == "open" and isinstance(error, ValueError):  # a key is no number
                hint = f"Correct the keys of {self.plugged.url}; they are of {self.plugged}."
            raise kind(self.who, said(error), asked=what, hint=hint) from error

    def _wait_for(self, thread: threading.Thread, what: str, limit_s: float) -> None:
        late_s = self.clock.now() + limit_s
        while thread.is_alive() and (left_s := late_s - self.clock.now()) > 0.0:
            thread.join(min(left_s, BEAT_S))  # each look at the clock is a heartbeat
        if thread.is_alive():
            raise self._late(what, limit_s)

    def _late(self, what: str, limit_s: float) -> LinkError:
        hint = f"Look at the device, its power and its cable: {self.plugged} hangs."
        return LinkError(self.who, "no answer", asked=what, seconds=limit_s, hint=hint)

    def _run(self, job: Future[T], work: Callable[[], T]) -> None:
        self._owner.is_us = True
        try:
            job.set_result(work())
        except BaseException as error:
            job.set_exception(error)

    def _name(self, error: InstrumentError) -> None:
        """Of an error that the driver raised itself: which instrument has it, by whose driver."""
        given = {"who": "", "what": said(error), **vars(error)}  # its class may have none of them
        if self.who in (by := str(given["who"])):
            return
        who = self.who if by.lower() in self.who else f"{self.who} ({by})"
        facts = {key: given.get(key) for key in ("asked", "seen", "seconds")}
        hint = given.get("hint") or self.look
        InstrumentError.__init__(error, who, one_line(str(given["what"])), **facts, hint=hint)

    def broken(self, what: str, seen: object) -> ProtocolError:
        """What to raise where it gives what no device can show."""
        return ProtocolError(self.who, what, seen=said(seen), hint=f"Correct {self.plugged}.")

    def texts(self, given: object) -> dict[str, str]:
        """Its identity as text. Raises ProtocolError."""
        if not isinstance(given, Mapping) or not given:
            raise self.broken("its identity is no mapping with something in it", given)
        return {one_line(str(key)): one_line(str(value)) for key, value in given.items()}

    def number(self, value: object, what: str) -> float:
        """A finite number. Raises ProtocolError."""
        with suppress(TypeError, ValueError, OverflowError):
            if abs(found := float(value)) < float("inf"):  # type: ignore[arg-type]
                return found
        raise self.broken(f"its {what} is no number", value)

    def flag(self, value: object, what: str) -> bool:
        """True or False, NumPy's too, or 1 or 0. Raises ProtocolError."""
        with suppress(TypeError, ValueError):  # an array is neither, and says so
            if value in (True, False):
                return bool(value)
        raise self.broken(f"its {what} is neither True nor False", value)


class Plugged:
    """What each kind of instrument of another package has."""

    _border: PluginBoundary[Any]

    def close(self) -> None:
        """Close it as it is, without stopping it; once more is no error."""
        self._border.forget()
