"""Modbus transactions as calls that block: over TCP, RTU over TCP, and RTU on a serial port.

Over RTU nothing says whose an answer is (fact sheet, 2.3). So after a request without a response
nothing else is asked until the late response has come or can't come any more, and until a request
whose response can't be confused with it was answered.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Sequence

from instruments.bath.connection import Line
from instruments.bath.requests import (
    EXCEPTION,
    Answers,
    Question,
    read_question,
    values_in,
    write_question,
)
from instruments.bath.session import BrokenError, RefusedError, Session
from instruments.clock import Clock
from instruments.errors import LinkError, ProtocolError
from instruments.link import Link, Tap

TIMEOUT_S, QUIET_S = 1.0, 0.5
ATTEMPTS = 2
FORGET_S = 10.0  # no device answers later than this
OUTSTANDING_S = 3.0  # how long a call waits where an answer of every shape is outstanding
SOON_S = 0.001
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


class Transactions(Session):
    """One connection to one unit. ``markers``: reads (function, address, count) that the device
    surely answers; without any, only time shows that no late answer is under way.
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
        super().__init__(line, clock, who=who, tap=tap)
        self.expected_protocol = f"Modbus {line.transport.upper()}"
        self._unit_id = line.unit_id or 1
        self._timeout_s = timeout_s
        self._quiet_s = quiet_s
        self._markers = markers
        self._unused = self._seen = b""  # since the last request: not yet matched; all
        self._answers = Answers(rtu=line.is_rtu)
        self._foreign_until_s = 0.0
        # or its complaints, which our errors carry, go to stderr
        if not logging.getLogger("pymodbus").handlers:
            logging.getLogger("pymodbus").addHandler(logging.NullHandler())

    def begin(self) -> None:
        self._unused = self._seen = b""
        # a response to another host may still be under way
        self._foreign_until_s = self.clock.now() + self._quiet_s

    def take(self, data: bytes) -> None:
        self._seen = (self._seen + data)[-MOST_SEEN:]
        self._unused += data
        if len(self._unused) > MOST_UNUSED:
            self._unused = b""
        self._unused = self._unused[self._answers.feed(self._unused) :]

    def read(
        self, function: int, address: int, count: int, *, unit_id: int | None = None
    ) -> list[int]:
        """``count`` registers or bits. Raises LinkError, ProtocolError, RefusedError."""
        question = read_question(function, address, count, unit_id or self._unit_id)
        answer = self._ask(question)
        values = values_in(answer)
        if len(answer) != question.length:
            kind = "bits" if function in (1, 2) else "registers"
            what = f"{len(values)} {kind} were answered where {count} were asked"
            raise self._unexpected(what, question)
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
        """Write ``values`` from ``address``, ``urgent`` whatever late answer is under way; the
        caller then reads back. Raises as ``read``.
        """
        question = write_question(function, address, values, unit_id or self._unit_id)
        if not question.fits(self._ask(question, urgent=urgent)):
            raise self._unexpected("the answer confirms another write", question)

    def close(self) -> None:
        """Drop the link. Over RTU answers stay outstanding: another link may reach the line."""
        self._answers.open = None
        super().close()

    # ---- one question

    def _ask(self, question: Question, *, urgent: bool = False) -> bytes:
        """The answer to the right function; that to the first attempt may come in the second."""
        start = self.clock.now()
        for _ in range(ATTEMPTS):
            self._finish_open()
            self._answers.forget(start - FORGET_S)
            if self.line.is_rtu and not urgent:
                self._await_outstanding(start)
            if question.answer is not None or self._put(question):  # the late one is as good
                break
            if self._answers.left and not self.line.is_rtu:
                error: LinkError | ProtocolError = self._unexpected(NO_ANSWER, question)
                if not self._seen[2:4].strip(b"\0"):  # the number of the protocol Modbus
                    what = "only a part of the answer came"
                    hint = "Check network and gateway if it happens often."
                    asked, seen = question.asked, self._seen
                    error = BrokenError(self.who, what, asked=asked, seen=seen, hint=hint)
                self.close()  # or what follows would be taken for the rest
                raise error
        answer = question.answer
        if answer is None:
            raise self._no_answer(question, start)
        if answer[1] == question.function | EXCEPTION:
            code = answer[2]
            what = f"refused: {EXCEPTIONS.get(code, 'a code that Modbus does not know')}"
            seen_code = f"Modbus exception {code}"
            refused = RefusedError(self.who, what, asked=question.asked, seen=seen_code)
            refused.code, refused.no_row = code, code == ILLEGAL_ADDRESS
            raise refused
        if answer[1] != question.function:
            what = f"function {answer[1]} was answered to function {question.function}"
            raise self._unexpected(what, question)
        return answer

    def _put(self, question: Question) -> bool:
        """Send ``question`` and wait for its answer; whether one came."""
        if self.line.character_s or self.line.gap_s:
            gap_s = max(GAP_CHARACTERS * self.line.character_s, LEAST_GAP_S)
            gap_s = gap_s if self.line.gap_s is None else self.line.gap_s
            self.clock.sleep(self.received_s + gap_s - self.clock.now())
        link = self.up()
        if self.line.is_rtu:
            self.drop_unasked(link)
        request = self._answers.put(question, self.clock.now())
        self._unused = self._seen = b""
        with contextlib.suppress(LinkError):  # a break is reported below
            link.write(request)
        self._wait(question, link)
        return question.answer is not None

    def _wait(self, question: Question, link: Link) -> None:
        if link.connected:
            self.receive_until(self._deadline_s(question), lambda: question.answer is not None)
        if question.answer is None and not link.connected:
            raise self.broken("the link broke", question.asked)

    def _deadline_s(self, question: Question) -> float:
        characters = len(question.request.encode()) + question.length + 6
        return question.sent_s + self._timeout_s + characters * self.line.character_s

    def _finish_open(self) -> None:
        """An event of virtual time may ask in the midst of another question: that comes first."""
        question = self._answers.open
        if question and question.answer is None and self.clock.now() < self._deadline_s(question):
            self._wait(question, self.up())

    # ---- outstanding answers

    def _await_outstanding(self, start_s: float) -> None:
        """See that no answer to an earlier question can be taken for the next one's."""
        answers = self._answers
        if self.clock.now() < self._foreign_until_s:
            self.receive_until(self._foreign_until_s, lambda: False)
        if not answers.outstanding:
            return
        self.receive_until(
            self._deadline_s(answers.outstanding[-1]) + self._quiet_s,
            lambda: not answers.outstanding,
        )
        if answers.outstanding and self._markers:
            self._ask_marker(start_s)
        answers.outstanding.clear()

    def _ask_marker(self, start_s: float) -> None:
        """Have a request answered that can't be confused with any outstanding. Raises LinkError."""
        answers, until_s = self._answers, start_s + OUTSTANDING_S
        questions = [read_question(*marker, self._unit_id) for marker in self._markers]
        while (marker := answers.distinguishable(questions)) is None:
            now_s = self.clock.now()
            if now_s >= until_s:
                left_s = answers.outstanding[-1].sent_s + FORGET_S - now_s
                what = f"no answer to {len(answers.outstanding)} questions"
                hint = f"Nothing is asked for {left_s:.0f} s at most: an answer may still come."
                raise LinkError(self.who, what, seconds=now_s - start_s, hint=hint)
            freed_s = min(until_s, answers.outstanding[0].sent_s + FORGET_S) + SOON_S
            self.receive_until(freed_s, lambda: answers.distinguishable(questions) is not None)
            answers.forget(self.clock.now() - FORGET_S)
        if not self._put(marker):
            raise self._no_answer(marker, start_s)

    def _no_answer(self, question: Question, start_s: float) -> LinkError | ProtocolError:
        if self._link and self._seen:
            return self._unexpected(NO_ANSWER, question)
        took_s = self.clock.now() - start_s
        hint = "Is the unit id right, and the controller still on?"
        return LinkError(self.who, "no answer", asked=question.asked, seconds=took_s, hint=hint)

    def _unexpected(self, what: str, question: Question) -> ProtocolError:
        hint = f"Is this a {self.expected_protocol} device of the right family?"
        return ProtocolError(self.who, what, asked=question.asked, seen=self._seen, hint=hint)
