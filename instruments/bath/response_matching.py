"""Answers in what came over a line, and whose they are. Pure.

RTU has no mark for the beginning of a frame. But unit and function that were asked give the length
of an answer, and the check sum tells the rest: every place is tried, so that garbage ahead of an
answer costs nothing (fact sheet, 2.3, P6).

Over TCP the number tells whose an answer is; over RTU only what is still owed. A device answers in
order: an answer that fits a question settles that one and all before it; what fits several settles
the first, and nothing is taken for the last question's that an earlier one may have asked for.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence

from pymodbus.framer import FramerRTU, FramerSocket
from pymodbus.pdu import DecodePDU

from instruments.bath.requests import EXCEPTION, Question

EXCEPTION_LENGTH = 5
CONFIRMATION_LENGTH = 8
READS = (1, 2, 3, 4)


def frames(data: bytes, asked: Collection[tuple[int, int]]) -> Iterator[tuple[int, int]]:
    """Start and end of each whole answer to one of ``asked``, units and functions, exceptions among
    them, in order.
    """
    at = 0
    while at + EXCEPTION_LENGTH <= len(data):
        end = at + _length(data, at) if (data[at], data[at + 1] & ~EXCEPTION) in asked else 0
        if at < end <= len(data) and is_whole(data[at:end]):
            yield at, end
            at = end
        else:
            at += 1


def is_whole(frame: bytes) -> bool:
    """Whether the check sum is right."""
    return FramerRTU.compute_CRC(frame[:-2]) == frame[-2] << 8 | frame[-1]


def _length(data: bytes, at: int) -> int:
    function = data[at + 1]
    if function & EXCEPTION:
        return EXCEPTION_LENGTH
    return EXCEPTION_LENGTH + data[at + 2] if function in READS else CONFIRMATION_LENGTH


class Answers:
    """The questions that were put on one line and not answered yet, oldest first in ``owed``;
    ``open`` is the latest one put.
    """

    def __init__(self, *, rtu: bool) -> None:
        self.owed: list[Question] = []
        self.open: Question | None = None
        self.left = 0  # bytes that have come since and are no whole answer
        self._rtu = rtu
        self._framer = (FramerRTU if rtu else FramerSocket)(DecodePDU(False))
        self._number = 0

    def put(self, question: Question, now_s: float) -> bytes:
        """The bytes that ask ``question``, under a new number each time. It is owed from now on."""
        self._number = self._number % 0xFFFF + 1
        if question.request.transaction_id:
            question.earlier += (question.request.transaction_id,)
        question.request.transaction_id = self._number
        self.left = 0
        question.sent_s = now_s
        self.open = question
        self.owed.append(question)
        return self._framer.buildFrame(question.request)

    def forget(self, before_s: float) -> None:
        """Drop what was asked before ``before_s``, and what was answered."""
        self.owed = [q for q in self.owed if q.answer is None and q.sent_s >= before_s]

    def hear(self, data: bytes) -> int:
        """Take the answers in ``data``; how many bytes are done with."""
        return self._hear_rtu(data) if self._rtu else self._hear_tcp(data)

    def unmistakable(self, questions: Sequence[Question]) -> Question | None:
        """The one of ``questions`` whose answer can least be confused with one that is owed; None
        where each can be.
        """
        shapes = {owed.expects for owed in self.owed}
        kinds = {owed.expects[:2] for owed in self.owed}
        free = [question for question in questions if question.expects not in shapes]
        return min(free, key=lambda question: question.expects[:2] in kinds, default=None)

    def _hear_tcp(self, data: bytes) -> int:
        used, in_one_piece = 0, not self.left
        while True:
            size, unit_id, number, pdu = self._framer.decode(data[used:])
            if not size:
                self.left = len(data) - used
                return used
            used += size
            # A late answer has to come alone: the next one's bytes could complete a cut one.
            alone = in_one_piece and used == len(data)
            for question in self.owed if pdu else ():
                asked = question.request.transaction_id
                if question.unit_id == unit_id and (
                    asked == number or (alone and number in question.earlier)
                ):
                    question.answer = bytes((unit_id, *pdu))

    def _hear_rtu(self, data: bytes) -> int:
        used, asked = 0, {(question.unit_id, question.function) for question in self.owed}
        for start, used in frames(data, asked):
            self._take(data[start : used - 2])
        return used

    def _take(self, answer: bytes) -> None:
        current = self.open if self.owed and self.owed[-1] is self.open else None
        at = next((at for at, question in enumerate(self.owed) if question.fits(answer)), None)
        if at is None:
            if current and len(self.owed) == 1:  # an answer that does not fit, and nobody else's
                current.answer = answer
                self.owed.clear()
            return
        exception = answer[1] & EXCEPTION
        if current and (self.owed[at] is current or (current.fits(answer) and not exception)):
            current.answer = answer
        del self.owed[: at + 1]
