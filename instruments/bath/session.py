"""One connection to a bath's controller or to a relay: opened with retries, read in pieces.

What comes is passed to ``take``, which knows the protocol.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

from instruments.bath.connection import Line
from instruments.clock import Clock, VirtualClock
from instruments.errors import DeviceError, LinkError
from instruments.link import SLICE_S, Link, Reception, Tap

CONNECT_TIMEOUT_S = 1.0
CONNECT_PAUSES_S = (0.1, 0.2, 0.4, 0.8, 1.6)  # between attempts; then we give up
CHECK_CABLE = "Check cable and power."


class RefusedError(DeviceError):
    """A request refused by an exception (``code``) or a word; ``no_row``: there is no such row."""

    code = 0
    no_row = True


class BrokenError(LinkError):
    """The link broke under a question, which may be asked again over a new one."""


class Session(ABC):
    """One connection to one device, not opened at first; for one caller at a time. A device has to
    be set to its ``expected_protocol``.
    """

    expected_protocol: str

    def __init__(self, line: Line, clock: Clock, *, who: str, tap: Tap | None = None) -> None:
        self.who = who
        self.line = line
        self.clock = clock
        self._tap = tap
        self._link: Link | None = None
        self.received_s = 0.0

    @abstractmethod
    def begin(self) -> None:
        """Begin on a link that has just been opened; the first bytes may answer another host."""

    @abstractmethod
    def take(self, data: bytes) -> None:
        """Take in bytes that came."""

    @property
    def connected(self) -> bool:
        """Whether the link is up, as far as is known."""
        return self._link is not None and self._link.connected

    def connect(self) -> None:
        """Open the link, trying again with growing pauses. Raises LinkError in the end."""
        start, why, line = self.clock.now(), "", self.line
        for pause_s in (0.0, *CONNECT_PAUSES_S):
            self.clock.sleep(pause_s)
            self.close()
            try:
                self._link = Link(
                    line.url,
                    self.clock,
                    who=self.who,
                    baud=line.baud,
                    port=line.serial,
                    connect_timeout_s=CONNECT_TIMEOUT_S,
                    tap=self._tap,
                )
            except LinkError as error:
                cause = error.__cause__
                why = "no answer" if isinstance(cause, TimeoutError) else str(cause or error.what)
                if isinstance(cause, ConnectionError) and cause.strerror:
                    why = cause.strerror
                continue
            self.begin()
            return
        what = "nothing took the connection"
        hint = f"Is the controller on, on this network, and set to {self.expected_protocol}?"
        if line.device:
            what = "the port can't be opened"
            hint = (
                "Is the adapter plugged in, and is it yours to open? 'python -m"
                " serial.tools.list_ports' lists the ports."
            )
        what = f"{what} in {len(CONNECT_PAUSES_S) + 1} tries: {why}"
        raise LinkError(self.who, what, seconds=self.clock.now() - start, hint=hint)

    def close(self) -> None:
        """Drop the link; once more is no error."""
        if self._link is not None:
            self._link.close()
            self._link = None

    def up(self) -> Link:
        """The link. Raises BrokenError where it is down."""
        if self._link is None or not self._link.connected:
            raise self.broken("the link is down")
        return self._link

    def broken(self, what: str, asked: str | None = None) -> BrokenError:
        """The error of a link that has gone."""
        return BrokenError(self.who, what, asked=asked, hint=CHECK_CABLE)

    def receive_until(self, until_s: float, done: Callable[[], bool]) -> None:
        """Take in what comes until ``done`` or ``until_s``. An exception closes the link."""
        link, clock = self.up(), self.clock
        virtual = clock if isinstance(clock, VirtualClock) else None
        moves_time = virtual is not None and not self.line.device
        wait = link.reception(until_s)
        try:
            while not done() and link.connected and not wait.over:
                if self.receive(link, 0.0 if moves_time else min(wait.left_s, SLICE_S), wait):
                    continue
                if clock.now() >= until_s or not link.connected:
                    return
                if virtual:
                    virtual.step(until_s)
        except BaseException:
            link.close()
            raise

    def drop_unasked(self, link: Link) -> bool:
        """Drop what has come without a question; whether there was any. Raises ProtocolError for a
        peer that sends without pause.
        """
        wait, any_came = link.reception(self.clock.now()), False
        while self.receive(link, 0.0, wait) and not wait.over:
            any_came = True
        return any_came

    def receive(self, link: Link, timeout_s: float, wait: Reception) -> bool:
        """Take in what has come; whether anything has."""
        try:
            data = link.receive(timeout_s)
        except LinkError:
            if link.connected:
                raise
            return False
        if data:
            wait.took(data)
            self.received_s = self.clock.now()
            self.take(data)
        return bool(data)
