"""Modbus transactions as calls that block: over TCP, RTU over TCP, and RTU on a serial port.

Over RTU nothing says whose an answer is (fact sheet, 2.3). So after a request without a response
nothing else is asked until the late response has come or can't come any more, and until a request
whose response can't be confused with it was answered.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Sequence

from instruments.bath.connection import BAUD, Line
from instruments.bath.requests import (
    EXCEPTION,
    Answers,
    Question,
    read_question,
    values_in,
    write_question,
)
from instruments.clock import Clock, VirtualClock
from instruments.errors import DeviceError, LinkError, ProtocolError
from instruments.link import SLICE_S, Link
from instruments.tap import NoTap, Tap

TIMEOUT_S, QUIET_S = 1.0, 0.5
CONNECT_TIMEOUT_S = 1.0
ATTEMPTS = 2
FORGET_S = 10.0  # no device answers later than this
OWING_S = 3.0  # how long a call waits where every shape of an answer is owed
SOON_S = 0.001
CONNECT_PAUSES_S = (0.1, 0.2, 0.4, 0.8, 1.6)  # between attempts; then we give up
# of silence between frames (Modbus over serial line 1.02, section 2.5.1.1)
GAP_CHARACTERS, LEAST_GAP_S = 3.5, 0.00175
MOST_SEEN = 300  # bytes kept for messages: more than the longest response
MOST_UNUSED = 2048  # bytes without a whole response, then they are dropped

ILLEGAL_ADDRESS = 2
EXCEPTIONS = {
    1: "it does not know this function",
    2: "it has no register at this address",
    3: "it does not allow this value",
    4: "it failed while doing it",
    5: "it needs longer and will do it later",
    6: "it is busy",
    7: "it can't do this",
    8: "its memory has a parity error",
    10: "the gateway has no path to it",
    11: "the gateway got no answer from it",
}
NO_ANSWER = "what came is no answer to this"


class RefusedError(DeviceError):
    """The device answered with a Modbus exception, ``code``."""

    code = 0


class BrokenError(LinkError):
    """The link broke under a question, which may be asked again over a new one."""


class Transactions:
    """One connection to one unit, and its only owner. Calls come one at a time: whoever shares it
    holds a lock.

    ``markers`` are reads (function, address, count) that the device surely answers, as many shapes
    as there are; without any, time alone has to tell that no late answer is under way.
    """

    def __init__(
        self,
        line: Line,
        clock: Clock,
        *,
        who: str,
        tap: Tap | None = None,
        timeout_s: float = TIMEOUT_S,
        quiet_s: float = QUIET_S,
        markers: Sequence[tuple[int, int, int]] = (),
    ) -> None:
        self.who = who
        self._line = line
        self._unit_id = line.unit_id or 1
        self._clock = clock
        self._tap = tap or NoTap()
        self._timeout_s = timeout_s
        self._quiet_s = quiet_s
        self._markers = markers
        self._link: Link | None = None
        self._unused = self._seen = b""  # since the last request: not yet matched; all
        self._answers = Answers(rtu=line.is_rtu)
        self._strange_until_s = self._heard_s = 0.0
        # or its complaints, which our errors carry, go to stderr
        if not logging.getLogger("pymodbus").handlers:
            logging.getLogger("pymodbus").addHandler(logging.NullHandler())

    @property
    def connected(self) -> bool:
        """Whether the link is up, as far as anybody has noticed."""
        return self._link is not None and self._link.connected

    def connect(self) -> None:
        """Open the link, trying again with growing pauses. Raises LinkError when it is not taken in
        the end.
        """
        start, why, line = self._clock.now(), "", self._line
        for pause_s in (0.0, *CONNECT_PAUSES_S):
            if pause_s:
                self._clock.sleep(pause_s)
            self.close()
            try:
                self._link = Link(
                    line.url,
                    self._clock,
                    who=self.who,
                    baud=line.baud or BAUD,
                    parity=line.parity or "N",
                    stopbits=line.stopbits or 1,
                    connect_timeout_s=CONNECT_TIMEOUT_S,
                    tap=self._tap,
                )
            except LinkError as error:
                cause = error.__cause__
                why = "no answer" if isinstance(cause, TimeoutError) else str(cause or error.what)
                if isinstance(cause, ConnectionError) and cause.strerror:
                    why = cause.strerror
                continue
            self._unused = self._seen = b""
            # a response to another host may still be under way
            self._strange_until_s = self._clock.now() + self._quiet_s
            return
        what = "nothing took the connection"
        hint = f"Is the controller on, on this network, and set to Modbus {line.transport.upper()}?"
        if line.kind == "serial":
            what = "the port can't be opened"
            hint = (
                "Is the adapter plugged in, and is it yours to open? 'python -m"
                " serial.tools.list_ports' lists the ports."
            )
        what = f"{what} in {len(CONNECT_PAUSES_S) + 1} tries: {why}"
        raise LinkError(self.who, what, seconds=self._clock.now() - start, hint=hint)

    @property
    def place(self) -> str:
        """The line that it is on, whatever the unit."""
        return self._line.url

    def read(
        self, function: int, address: int, count: int, *, unit_id: int | None = None
    ) -> list[int]:
        """``count`` registers, or bits, from ``address``. Raises LinkError, ProtocolError,
        RefusedError.

        ``unit_id`` asks another unit on the same line.
        """
        question = read_question(function, address, count, unit_id or self._unit_id)
        answer = self._ask(question)
        values = values_in(answer)
        if len(answer) != question.length:
            kind = "bits" if function in (1, 2) else "registers"
            what = f"{len(values)} {kind} were answered where {count} were asked"
            raise self._nonsense(what, question)
        return values[:count]

    def write(
        self,
        function: int,
        address: int,
        values: Sequence[int],
        *,
        unit_id: int | None = None,
        urgent: bool = False,
    ) -> None:
        """Write ``values`` from ``address``. Raises as ``read`` does.

        ``urgent``: sent at once, whatever late answer is still under way; the caller has to look
        whether it stands.
        """
        question = write_question(function, address, values, unit_id or self._unit_id)
        answer = self._ask(question, urgent=urgent)
        if not question.fits(answer):
            raise self._nonsense("the answer confirms another write", question)

    def close(self) -> None:
        """Drop the link; once more is no error. What is owed over RTU stays owed: another link may
        lead to the same line.
        """
        self._answers.open = None
        if self._link is not None:
            self._link.close()
            self._link = None

    def _up(self) -> Link:
        if self._link is None or not self._link.connected:
            raise BrokenError(self.who, "the link is down", hint="Check cable and power.")
        return self._link

    # ---- bytes

    def _receive_until(self, until_s: float, done: Callable[[], bool]) -> None:
        """Take in what comes until ``done``, the clock shows ``until_s``, or the link breaks.

        Under virtual time an event may use this link, or close it, while time moves. An exception
        closes the link. Raises TimeoutError when an emulator's thread hangs.
        """
        link, clock = self._up(), self._clock
        virtual = clock if isinstance(clock, VirtualClock) else None
        moves_time = virtual is not None and not self._line.device
        try:
            while not done() and link.connected:
                left_s = max(0.0, until_s - clock.now())
                if self._receive(link, 0.0 if moves_time else min(left_s, SLICE_S)):
                    continue
                if clock.now() >= until_s or not link.connected:
                    return
                if virtual:
                    virtual.step(until_s)
        except BaseException:
            link.close()
            raise

    def _receive(self, link: Link, timeout_s: float) -> bool:
        """Match what has come; whether anything has."""
        try:
            data = link.receive(timeout_s)
        except LinkError as error:
            if link.connected:
                raise TimeoutError(error.what) from error
            return False
        if data:
            self._heard_s = self._clock.now()
            self._seen = (self._seen + data)[-MOST_SEEN:]
            self._unused += data
            if len(self._unused) > MOST_UNUSED:
                self._unused = b""
            self._unused = self._unused[self._answers.feed(self._unused) :]
        return bool(data)

    # ---- one question

    def _ask(self, question: Question, *, urgent: bool = False) -> bytes:
        """The answer to the right function; that to the first attempt may come in the second."""
        start = self._clock.now()
        for _ in range(ATTEMPTS):
            self._finish_open()
            self._answers.forget(start - FORGET_S)
            if self._line.is_rtu and not urgent:
                self._come_clean(start)
            if question.answer is not None or self._put(question):  # the late one is as good
                break
            if self._answers.left and not self._line.is_rtu:
                error: LinkError | ProtocolError = self._nonsense(NO_ANSWER, question)
                if not self._seen[2:4].strip(b"\0"):  # the number of the protocol Modbus
                    what = "only a part of the answer came"
                    hint = "Check network and gateway if it happens often."
                    asked, seen = question.asked, self._seen
                    error = BrokenError(self.who, what, asked=asked, seen=seen, hint=hint)
                self.close()  # or what follows would be taken for the rest
                raise error
        answer = question.answer
        if answer is None:
            raise self._silence(question, start)
        if answer[1] == question.function | EXCEPTION:
            what = f"refused: {EXCEPTIONS.get(answer[2], 'a code that Modbus does not know')}"
            seen_code = f"Modbus exception {answer[2]}"
            refused = RefusedError(self.who, what, asked=question.asked, seen=seen_code)
            refused.code = answer[2]
            raise refused
        if answer[1] != question.function:
            what = f"function {answer[1]} was answered to function {question.function}"
            raise self._nonsense(what, question)
        return answer

    def _put(self, question: Question) -> bool:
        """Send ``question`` and wait for its answer; whether one came."""
        if self._line.character_s:
            gap_s = max(GAP_CHARACTERS * self._line.character_s, LEAST_GAP_S)
            self._clock.sleep(self._heard_s + gap_s - self._clock.now())
        link = self._up()
        if self._line.is_rtu:
            while self._receive(link, 0.0):  # what lies there unasked answers no request
                pass
        request = self._answers.put(question, self._clock.now())
        self._unused = self._seen = b""
        with contextlib.suppress(LinkError):  # a break is reported below
            link.write(request)
        self._wait(question, link)
        return question.answer is not None

    def _wait(self, question: Question, link: Link) -> None:
        try:
            if link.connected:
                self._receive_until(self._deadline_s(question), lambda: question.answer is not None)
        except TimeoutError as error:
            raise LinkError(self.who, "the emulator hangs", asked=question.asked) from error
        if question.answer is None and not link.connected:
            what, hint = "the link broke", "Check cable and power."
            raise BrokenError(self.who, what, asked=question.asked, hint=hint)

    def _deadline_s(self, question: Question) -> float:
        characters = len(question.request.encode()) + question.length + 6
        return question.sent_s + self._timeout_s + characters * self._line.character_s

    def _finish_open(self) -> None:
        """An event of virtual time may ask in the midst of another question: that comes first."""
        question = self._answers.open
        if question and question.answer is None and self._clock.now() < self._deadline_s(question):
            self._wait(question, self._up())

    # ---- what is owed

    def _come_clean(self, start_s: float) -> None:
        """See that no answer to an earlier question can be taken for the next one's."""
        answers = self._answers
        if self._clock.now() < self._strange_until_s:
            self._receive_until(self._strange_until_s, lambda: False)
        if not answers.owed:
            return
        self._receive_until(
            self._deadline_s(answers.owed[-1]) + self._quiet_s, lambda: not answers.owed
        )
        if answers.owed and self._markers:
            self._prove(start_s)
        answers.owed.clear()

    def _prove(self, start_s: float) -> None:
        """Ask what can't be confused with anything owed, once there is such a question.

        Raises LinkError when there is none for OWING_S, or when it is not answered.
        """
        answers, until_s = self._answers, start_s + OWING_S
        questions = [read_question(*marker, self._unit_id) for marker in self._markers]
        while (marker := answers.unmistakable(questions)) is None:
            now_s = self._clock.now()
            if now_s >= until_s:
                left_s = answers.owed[-1].sent_s + FORGET_S - now_s
                what = f"no answer to {len(answers.owed)} questions"
                hint = f"Nothing is asked for {left_s:.0f} s at most: an answer may still come."
                raise LinkError(self.who, what, seconds=now_s - start_s, hint=hint)
            freed_s = min(until_s, answers.owed[0].sent_s + FORGET_S) + SOON_S
            self._receive_until(freed_s, lambda: answers.unmistakable(questions) is not None)
            answers.forget(self._clock.now() - FORGET_S)
        if not self._put(marker):
            raise self._silence(marker, start_s)

    def _silence(self, question: Question, start_s: float) -> LinkError | ProtocolError:
        if self._link and self._seen:
            return self._nonsense(NO_ANSWER, question)
        took_s, hint = (
            self._clock.now() - start_s,
            "Is the unit id right, and the controller still on?",
        )
        return LinkError(self.who, "no answer", asked=question.asked, seconds=took_s, hint=hint)

    def _nonsense(self, what: str, question: Question) -> ProtocolError:
        hint = f"Is this a Modbus {self._line.transport.upper()} device of the right family?"
        return ProtocolError(self.who, what, asked=question.asked, seen=self._seen, hint=hint)
