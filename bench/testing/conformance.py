"""What every driver keeps to: open, identify, read what is there now, lose the link, come back,
make safe twice and over a link that was lost, close twice, an abort. The bench's own drivers pass
it on their emulators, and `teatbench plugin check` runs it on a driver of another package.

A `Subject` is an instrument with what a check needs to do to it. `CHECKS` are functions of one;
they raise AssertionError, and NotCheckedError where the subject can't be put into that state.
"""

from __future__ import annotations

import re
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

from instruments.bath.sequence import cause_of
from instruments.clock import Clock, VirtualClock
from instruments.errors import InstrumentError, LinkError
from instruments.link import Link
from instruments.listener import Connection, Device, Listener

CLOSED_S = 5.0  # until the other end has noticed


class NotCheckedError(Exception):
    """This subject can't be put into the state that a check needs; the text says why."""


class Subject:
    """One instrument, not opened yet. `read`: something that it measures, the same while nothing
    happens; `change`: have the device show something else, and what `read` has to give then;
    `work` has it do what `safe` ends; `is_safe` asks the device, not the driver; `cut` and `mend`:
    its link; `recover`: what the bench calls to come back; `forgiven`: what the bench has got over
    in what the driver did, and a driver may not do.
    """

    clock: Clock
    driver: Any

    def open(self) -> None:
        raise NotImplementedError

    def identify(self) -> str:
        raise NotImplementedError

    def read(self) -> object:
        raise NotImplementedError

    def change(self) -> object:
        """Raises LinkError where that needs a link, and it is cut."""
        raise NotCheckedError("nothing here can change what it measures")

    def work(self) -> None:
        raise NotImplementedError

    def recover(self) -> None:
        raise NotImplementedError

    def is_safe(self) -> bool:
        raise NotImplementedError

    def safe(self) -> None:
        self.driver.safe()

    def close(self) -> None:
        self.driver.close()

    def is_closed(self) -> bool:
        """Whether its port is free, as far as that can be seen from outside."""
        return True

    def forgiven(self) -> str:
        """In words; empty for nothing."""
        return ""

    def cut(self) -> None:
        raise NotCheckedError("nothing here can cut its link")

    def mend(self) -> None:
        raise NotCheckedError("nothing here can cut its link")

    def read_interrupted(self) -> None:
        """Read, with Ctrl-C while the answer is waited for. Raises KeyboardInterrupt."""
        raise NotCheckedError("nothing here can make it answer late")

    def end(self) -> None:
        """Whatever else has to be closed."""


class Cable:
    """Hands bytes on to a device, ``late_s`` late. It breaks where the emulated device raises; the
    first such ``fault`` in words.
    """

    def __init__(self, device: Device) -> None:
        self.device = device
        self.late_s = 0.0
        self.hosts = 0
        self.fault = ""

    def connect(self, connection: Connection) -> None:
        self.hosts += 1
        self._whole(connection, lambda: self.device.connect(connection))

    def receive(self, connection: Connection, data: bytes) -> None:
        def hand_on() -> None:
            self._whole(connection, lambda: self.device.receive(connection, data))

        connection.after(self.late_s, hand_on) if self.late_s else hand_on()

    def disconnect(self, connection: Connection) -> None:
        self.hosts -= 1
        self._whole(connection, lambda: self.device.disconnect(connection))

    def _whole(self, connection: Connection, work: Callable[[], None]) -> None:
        try:
            work()
        except Exception as error:  # another's code
            self.fault = self.fault or f"its emulator raises {cause_of(error)}"
            connection.hang_up()


class Wired(Subject):
    """An instrument on loopback: its emulator on a link that can be cut; ``late_s``: how late an
    answer comes that an abort does not wait for.
    """

    def __init__(self, clock: Clock, device: Device, name: str, late_s: float) -> None:
        self.clock = clock
        self.late_s = late_s
        self.cable = Cable(device)
        self.listen = partial(Listener, self.cable, clock, lock=threading.RLock(), name=name)
        self.listener = self.listen()

    def link(self, who: str) -> Link:
        return Link(self.listener.url, self.clock, who=who)

    def is_closed(self) -> bool:
        until_s = self.clock.now() + CLOSED_S
        while self.cable.hosts and self.clock.now() < until_s:
            self.clock.sleep(0.05)
        return not self.cable.hosts

    def cut(self) -> None:
        self.listener.close()

    def mend(self) -> None:
        self.listener = self.listen(port=self.listener.port)

    def read_interrupted(self) -> None:
        self.cable.late_s = self.late_s
        try:
            with abort_in(self.clock, self.late_s / 2):
                self.read()
        finally:
            self.cable.late_s = 0.0

    def end(self) -> None:
        self.listener.close()


class AbortedError(KeyboardInterrupt):
    """Ctrl-C as the bench's own handler raises it; a plain one would be a fault of the driver."""


@contextmanager
def abort_in(clock: Clock, seconds: float) -> Iterator[None]:
    """Ctrl-C in so many seconds of ``clock``; in real time in the main thread alone."""

    waits = True

    def interrupt(*_: object) -> None:
        if waits:
            raise AbortedError

    if isinstance(clock, VirtualClock):
        clock.call_at(clock.now() + seconds, interrupt)
        try:
            yield
        finally:
            waits = False
        return
    if not hasattr(signal, "setitimer"):
        raise NotCheckedError("this system has no interval timers")
    before = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def _need(condition: object, what: str) -> None:
    if not condition:
        raise AssertionError(what)


def _fails(work: Callable[[], object], what: str) -> LinkError:
    """The LinkError of ``work``. Raises AssertionError where there is none."""
    try:
        work()
    except LinkError as error:
        return error
    except InstrumentError as error:
        came = f"not a LinkError but {type(error).__name__}: {error}"
        raise AssertionError(f"{what}: {came}") from error
    raise AssertionError(f"{what}: no error")


def says_who_it_is_and_measures(subject: Subject) -> None:
    """It has an identity, and reads the same while nothing happens."""
    _need(subject.identify(), "its identity is empty")
    _need(subject.read() == subject.read(), "two readings differ though nothing happened")


def reads_what_the_device_shows_now(subject: Subject) -> None:
    """What changes is read, also what changed while the link was lost."""
    subject.identify()
    subject.read()
    shown = subject.change()
    _need((read := subject.read()) == shown, f"it reads {read} where the device shows {shown}")
    subject.cut()
    _fails(subject.read, "reading over a cut link")
    try:
        shown = subject.change()
    except LinkError:
        shown = None
    subject.mend()
    subject.recover()
    shown = shown or subject.change()
    _need(
        (read := subject.read()) == shown, f"{read} where the device shows {shown}, on a new link"
    )


def lost_link_is_an_error_and_comes_back(subject: Subject) -> None:
    """A link that breaks is a LinkError, also on the way back, until it is mended."""
    who, seen = subject.identify(), subject.read()
    subject.cut()
    lost = _fails(subject.read, "reading over a cut link")
    _need(lost.who.strip(), "the error says nothing of who it is")
    _fails(subject.recover, "coming back over a cut link")
    subject.mend()
    subject.recover()
    _need(subject.read() == seen, "it reads something else than before the link was lost")
    _need(subject.identify() == who, "it identifies itself otherwise than before the link was lost")


def safe_twice_is_safe_and_usable(subject: Subject) -> None:
    """What it works at ends, as the device reports, and it can be used again."""
    subject.identify()
    subject.work()
    for time in ("once", "twice"):
        subject.safe()
        _need(subject.is_safe(), f"it is not safe after it was made safe {time}")
    _need(subject.identify(), "its identity is empty after it was made safe")
    _need(subject.read() is not None, "it reads nothing after it was made safe")


def safe_over_a_link_lost_is_safe(subject: Subject) -> None:
    """What it works at ends over another link, whether or not the driver noticed the loss."""
    subject.identify()
    for noticed in (True, False):
        subject.work()
        subject.cut()
        if noticed:
            _fails(subject.read, "reading over a cut link")
        subject.mend()
        subject.safe()
        _need(subject.is_safe(), "it is not safe after it was made safe over a new link")
        subject.recover()


def closes_twice_and_opens_again(subject: Subject) -> None:
    """Closing twice is no error and frees its port, and it opens again as the same device."""
    who = subject.identify()
    subject.close()
    subject.close()
    _need(subject.is_closed(), "its port is open though it was closed")
    subject.open()
    _need(subject.identify() == who, "it identifies itself otherwise after it was opened again")


def abort_leaves_it_able_to_be_safe(subject: Subject) -> None:
    """Ctrl-C amid a question; then it can be made safe, and answers again."""
    who, seen = subject.identify(), subject.read()
    try:
        subject.read_interrupted()
    except KeyboardInterrupt:
        pass
    else:
        raise AssertionError("Ctrl-C amid a question was swallowed")
    subject.safe()
    _need(subject.is_safe(), "it is not safe after an abort")
    subject.recover()
    _need(subject.identify() == who, "it identifies itself otherwise after an abort")
    _need(subject.read() == seen, "it reads something else than before an abort")


Check = Callable[[Subject], None]
CHECKS: tuple[Check, ...] = (
    says_who_it_is_and_measures,
    reads_what_the_device_shows_now,
    lost_link_is_an_error_and_comes_back,
    safe_twice_is_safe_and_usable,
    safe_over_a_link_lost_is_safe,
    closes_twice_and_opens_again,
    abort_leaves_it_able_to_be_safe,
)
Outcome = Literal["passed", "failed", "not checked"]


@dataclass(frozen=True, slots=True)
class Finding:
    """What came of one check; ``why`` of one that failed or wasn't done."""

    check: str
    outcome: Outcome
    why: str = ""


def conform(make: Callable[[], Subject], checks: tuple[Check, ...] = CHECKS) -> Iterator[Finding]:
    """Each check on a subject of its own, which is made safe and closed behind it. A cause is said
    once: a check that the fault of an earlier one ended names that one.
    """
    said: dict[str, str] = {}  # the fault, whatever its port, and the check that it failed
    for check in checks:
        name = check.__name__.replace("_", " ")
        subject = None
        try:
            subject = make()
            subject.open()
            check(subject)
            _need(not (why := subject.forgiven()), why)
        except NotCheckedError as reason:
            yield Finding(name, "not checked", str(reason))
        except (AssertionError, InstrumentError) as error:
            own = subject.cable.fault if isinstance(subject, Wired) else ""
            fault = type(error), getattr(error, "what", name), getattr(error, "asked", None)
            first = said.setdefault(own or re.sub(r"\d+", "", f"{fault}"), name)
            why = own or (f"{error}" if subject else f"it can't be opened: {error}")
            yield Finding(name, "failed", why if first == name else f"cause as of: {first}")
        else:
            yield Finding(name, "passed")
        finally:
            for leave in ("safe", "close", "end") if subject else ():
                with suppress(InstrumentError, AttributeError):  # not opened, or lost
                    getattr(subject, leave)()
