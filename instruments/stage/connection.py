"""The connection to a controller: one line out, one answer back, and what is pushed between.

Nothing is sent while an answer is outstanding. An alarm is kept until a restart; each alarm, locked
report, restart, broken link or answer that makes no sense counts as an upset, by which the driver
knows that homing is lost. `Dialogue` is the conversation with Grbl, grblHAL and FluidNC; those
with other firmwares are its subclasses. What none of them reports is in docs/rig.md.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import wraps
from typing import Any, ClassVar, ParamSpec, TypeVar

from instruments.clock import Clock
from instruments.errors import DeviceError, InstrumentError, LinkError, ProtocolError
from instruments.link import Link, Reception
from instruments.stage.protocol import (
    HOLD,
    HOME_AGAIN,
    JOG_CANCEL,
    SOFT_RESET,
    STATUS_QUERY,
    Alarm,
    Decoder,
    ErrorReply,
    MalformedLine,
    Message,
    Ok,
    Position,
    Response,
    Setting,
    Status,
    Welcome,
    encode,
    jog_line,
    meaning,
    move_line,
    parse,
)
from instruments.stage.settings import (
    FLUIDNC_KEYS,
    MUST_HOME,
    StageIdentity,
    StageSettings,
    Target,
    read_fluidnc,
    read_settings,
)

ANSWER_S = 2.0  # classic boards answer within milliseconds, but writing a setting takes longer
STATUS_S = 1.0
START_S = 2.5  # a board's boot loader waits 1 to 2 s after the port has been opened
BOOT_S = 15.0  # FluidNC reports its network for so long before its welcome
QUIET_S = 0.25
ASK_AGAIN_S = 0.25
LOCKED = frozenset({"Alarm", "Sleep"})

P = ParamSpec("P")
R = TypeVar("R")


def atomic(question: Callable[P, R]) -> Callable[P, R]:
    """A method of `Dialogue` that waits for other threads' questions, and lets none in between."""

    @wraps(question)
    def asked(*given: P.args, **more: P.kwargs) -> R:
        dialogue: Any = given[0]
        with dialogue.turns.taken():
            return question(*given, **more)

    return asked


class TurnLock:
    """A lock for one question at a time. Reentrant; an interrupt leaves none taken, since only
    `with` takes it.
    """

    def __init__(self) -> None:
        self._asking = threading.RLock()
        self._next = threading.RLock()  # held by a thread that waits: locks are not fair
        self._speaker: int | None = None

    @contextmanager
    def taken(self) -> Iterator[None]:
        """Wait for the lock, and hold it."""
        with self._next:
            pass
        with self._asking:
            before, self._speaker = self._speaker, threading.get_ident()
            try:
                yield
            finally:
                self._speaker = before

    def between(self, ask: Callable[[], R], timeout_s: float) -> R | None:
        """``ask`` between two questions of others; None where there is no such moment in time, as
        amid this thread's own question (an event of virtual time).
        """
        if self._speaker == threading.get_ident() or not self._next.acquire(timeout=timeout_s):
            return None
        try:
            if not self._asking.acquire(timeout=timeout_s):
                return None
        finally:
            self._next.release()
        try:
            return ask()
        finally:
            self._asking.release()


class Dialogue:
    """The conversation on one link. Raises LinkError, ProtocolError, DeviceError."""

    firmware: str = "Grbl"  # which answered last
    jogs: ClassVar[bool] = True  # whether it has relative moves that can be cancelled
    brakes_freely: ClassVar[bool] = True  # whether a brake at rest costs nothing
    safe: ClassVar[str] = (
        "at a stand and holding its position; after an alarm, locked until it is homed"
    )
    _parse: Callable[[bytes], Response] = staticmethod(parse)

    def __init__(self, link: Link, clock: Clock) -> None:
        self.who = link.who
        self.upsets = 0
        self.alarm: int | str | None = None
        self.outstanding: str | None = None  # the line whose answer hasn't come
        self.turns = TurnLock()
        self._link = link
        self._clock = clock
        self._decoder = Decoder(self._parse)
        self._inbox: deque[Response] = deque()
        self._offset: Position | None = None

    @atomic
    def command(self, text: str, timeout_s: float = ANSWER_S) -> list[Response]:
        """Send a line and wait for its ``ok``; what was pushed meanwhile."""
        data = encode(text, who=self.who)
        self._check(text)
        self.outstanding = text
        self.write(data)
        pushed: list[Response] = []
        wait = self._link.reception(self._clock.now() + timeout_s)
        while True:
            in_time = self._clock.now() <= wait.until_s
            answer = self._next(wait) if in_time else None
            if answer is None:
                hint = f"Check power and cable. {HOME_AGAIN}"
                raise LinkError(self.who, "no answer", asked=text, seconds=timeout_s, hint=hint)
            if isinstance(answer, Ok):
                return pushed
            if isinstance(answer, ErrorReply):
                what, hint = meaning(answer, self.firmware)
                raise DeviceError(self.who, what, asked=text, hint=hint)
            pushed.append(answer)

    @atomic
    def status(self) -> Status:
        """A fresh status report; asked for again after an alarm, as a restarting board loses it."""
        self.wait(0.0)
        end_s = self._clock.now() + STATUS_S
        while self._clock.now() < end_s:
            self.write(STATUS_QUERY)
            until_s = end_s if self.alarm is None else min(end_s, self._clock.now() + ASK_AGAIN_S)
            wait = self._link.reception(until_s)
            while (answer := self._next(wait)) is not None:
                if isinstance(answer, Status):
                    return answer
        what, hint = "no status report", "Check power and cable."
        raise LinkError(self.who, what, asked="?", seconds=STATUS_S, hint=hint)

    def machine_mm(self, status: Status) -> Position:
        """The machine position of a report of either kind. Raises ProtocolError."""
        if status.mpos_mm is not None:
            return status.mpos_mm
        work, offset = status.wpos_mm, self._offset
        if work is None or offset is None or len(work) != len(offset):
            what = "no machine position: the work offset has not come yet"
            raise ProtocolError(self.who, what, seen=status.name, hint="Set $10=1.")
        return tuple(at + zero for at, zero in zip(work, offset, strict=True))

    def identify(self, axes: str) -> tuple[StageIdentity, StageSettings]:
        """Connect: identity and settings. Raises DeviceError where ``axes`` can't be driven."""
        welcome = self.start()
        if not welcome.version.startswith("1.1") and welcome.dialect != "FluidNC":
            what = f"firmware {welcome.dialect} {welcome.version} speaks another protocol"
            raise DeviceError(self.who, what, hint="Load Grbl 1.1, grblHAL or FluidNC.")
        info = {said.kind: said.text for said in self.command("$I") if isinstance(said, Message)}
        identity = StageIdentity(
            welcome.dialect, welcome.version, info.get("VER", "").strip(":"), info.get("OPT", "")
        )
        if welcome.dialect == "FluidNC":
            letters = "xyza" if "A" in axes else "xyz"
            keys = [MUST_HOME] + [f"/axes/{axis}/{key}" for axis in letters for key in FLUIDNC_KEYS]
            answers = [said for key in keys for said in self.command(f"${key}")]
            found = {said.kind: said.text for said in answers if isinstance(said, Message)}
            return identity, read_fluidnc(found, who=self.who, axes=axes)
        pushed = self.command("$$")
        values = {said.number: said.value for said in pushed if isinstance(said, Setting)}
        return identity, read_settings(values, who=self.who, axes=axes)

    def identify_first(self, axes: str) -> None:
        """What has to be known before a report is asked for: nothing. Raises as `identify`."""

    # What the driver wants done, in this firmware's lines

    @property
    def homing(self) -> bool:
        """Whether it homes, as far as its answers show."""
        return self.outstanding == "$H"

    def home(self, axes: str, bound_s: float) -> None:  # noqa: ARG002 - its settings say which
        """Home ``axes`` and wait for the end, ``bound_s`` at most."""
        self.command("$H", bound_s)

    def move_lines(self, target: Target, feed_mm_min: float) -> list[str]:
        """The lines of a straight move to machine coordinates. Raises LimitError."""
        return [move_line(target, feed_mm_min, who=self.who)]

    def jog_lines(self, way: Target, target: Target, feed_mm_min: float) -> list[str]:
        """The lines of a relative move by ``way``, which ends at ``target``. Raises LimitError."""
        if self.jogs:
            return [jog_line(way, feed_mm_min, who=self.who)]
        return self.move_lines(target, feed_mm_min)

    def send(self, lines: Iterable[str]) -> None:
        """Each line in turn, once the one before was taken."""
        for line in lines:
            self.command(line)

    def finish(self, timeout_s: float) -> None:
        """Wait until all motion is over: an idle report may come before the move has begun."""
        self.command("G4P0", timeout_s)

    def brake(self) -> None:
        """Send what brakes at once, and wait for nothing: any thread may call it."""
        self.write(HOLD)

    def cancel_jog(self) -> None:
        """Brake, and drop the rest of a jog."""
        self.write(JOG_CANCEL)

    def abort(self) -> None:
        """Stop whatever it does, homing too; the position is lost. Raises LinkError."""
        self.restart()

    @atomic
    def wait(self, seconds: float) -> None:
        """Let time pass. Raises at once for an alarm, a restart or a malformed answer."""
        wait = self._link.reception(self._clock.now() + seconds)
        while self._next(wait) is not None:
            pass

    @atomic
    def start(self) -> Welcome:
        """On a new link: wait for the welcome after the port's reset, or reset the board."""
        self.upsets += 1
        return self._welcome() or self.restart()

    @atomic
    def restart(self) -> Welcome:
        """Soft reset: drop outstanding answer, alarm and input. Raises LinkError, ProtocolError."""
        self.upsets += 1
        self._link.drain(0.0)
        self.write(SOFT_RESET)
        welcome = self._welcome()
        if welcome is None:
            what, hint = "no welcome after a reset", "Check power, cable and baud rate."
            raise LinkError(self.who, what, asked=SOFT_RESET, seconds=START_S, hint=hint)
        return welcome

    def check_link(self) -> None:
        """Raise LinkError where the link has gone, whatever was said on it before."""
        with suppress(DeviceError, ProtocolError):
            try:
                self.status()
            except LinkError:  # in an alarm some answer nothing
                if not self._link.connected:
                    raise
        wait = self._link.reception(self._clock.now())
        self._inbox.extend(self._decoder.feed(next(self._incoming(wait), b"")))

    def between(self, ask: Callable[[], R]) -> R | None:
        """``ask``, from any thread, where no other question is under way; else None."""
        return self.turns.between(ask, STATUS_S)

    def _welcome(self) -> Welcome | None:
        """The welcome and what comes with it; None if nothing came. Raises ProtocolError."""
        self._forget()
        welcome, seen = None, b""
        start_s = self._clock.now()
        wait = self._link.reception(start_s + START_S)
        for data in self._incoming(wait):
            seen += data
            if welcome := _last_welcome(self._decoder, data):
                break
            if b"\n" in data:  # a board that starts sends lines
                wait.until_s = min(start_s + BOOT_S, self._clock.now() + START_S)
        if welcome is None and seen:
            what, hint = "this is not GRBL: no welcome", "Is this the stage's port, at 115200 baud?"
            took_s = self._clock.now() - start_s
            raise ProtocolError(self.who, what, seen=seen[:60], seconds=took_s, hint=hint)
        if welcome:
            more = self._link.drain(QUIET_S, at_most_s=START_S)
            welcome = _last_welcome(self._decoder, more) or welcome
            self.firmware = welcome.dialect
        return welcome

    def _forget(self) -> None:
        """Drop what is outstanding, kept or half received."""
        self._decoder, self._offset = Decoder(self._parse), None
        self.alarm = self.outstanding = None
        self._inbox.clear()

    def _check(self, text: str) -> None:
        """Raise where an alarm or an open question forbids a further line."""
        if self.alarm is None:
            self.wait(0.0)
        if self.alarm is not None:
            raise self._alarmed(asked=text)
        if self.outstanding is not None:
            what = f"the answer to {self.outstanding!r} is still outstanding"
            raise LinkError(self.who, what, asked=text, hint=HOME_AGAIN)

    def _next(self, wait: Reception) -> Response | None:
        """The next good answer or push; None after the deadline. Raises for bad ones."""
        while not self._inbox:
            data = b"" if wait.over else next(self._incoming(wait), b"")
            if not data:
                return None
            self._inbox.extend(self._decoder.feed(data))
        return self._judge(self._inbox.popleft())

    def _judge(self, answer: Response) -> Response:
        if isinstance(answer, MalformedLine):
            self.upsets += 1
            what, asked, seen = f"malformed answer: {answer.why}", self.outstanding, answer.raw[:60]
            hint = "Check cable and earthing."
            raise ProtocolError(self.who, what, asked=asked, seen=seen, hint=hint)
        if isinstance(answer, Ok | ErrorReply):
            if self.outstanding is None:
                self.upsets += 1
                what = "an answer that nothing was asked for"
                raise ProtocolError(self.who, what, seen=str(answer), hint=HOME_AGAIN)
            self.outstanding = None
        elif isinstance(answer, Alarm):
            self.upsets += 1
            self.alarm = answer.code
            raise self._alarmed(asked=self.outstanding)
        elif isinstance(answer, Welcome):
            started, self.outstanding = self.upsets > 0, None  # else it is of the opened port
            self.upsets += 1
            if started and self.alarm is None:  # a failed homing ends in a restart
                what = "the controller has restarted by itself: position lost"
                raise DeviceError(self.who, what, hint=f"Check its power. {HOME_AGAIN}")
        elif isinstance(answer, Status):
            self._offset = answer.wco_mm or self._offset
            if answer.state in LOCKED:  # whether or not we have seen why: its position is lost
                self.upsets += 1
        return answer

    def _alarmed(self, asked: str | None) -> DeviceError:
        what, hint = meaning(Alarm(self.alarm or 0), self.firmware)
        return DeviceError(self.who, what, asked=asked, hint=hint)

    def _incoming(self, wait: Reception) -> Iterator[bytes]:
        try:
            yield from self._link.incoming(wait)
        except InstrumentError:
            self.upsets += 1
            raise

    def write(self, data: bytes) -> None:
        """Send bytes as they are: a line, or a byte that acts at once and is never answered."""
        try:
            self._link.write(data)
        except LinkError:
            self.upsets += 1
            raise


def _last_welcome(decoder: Decoder, data: bytes) -> Welcome | None:
    """The last welcome; boards print other text around it, as from the boot loader."""
    welcomes = [answer for answer in decoder.feed(data) if isinstance(answer, Welcome)]
    return welcomes[-1] if welcomes else None
