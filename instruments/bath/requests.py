"""What is asked of a Modbus device, and how its answer has to begin: requests to bytes, answers to
values; the questions of one poll, as few as go; and whose answer has come. Pure, no I/O.

A fixed block of a fixed length is also the cheapest guard against stale answers: at worst one is
old, never another quantity. The requests are pymodbus's. What a right answer looks like is kept
with the question, for RTU has no number to tell whose an answer is: only function, length, and for
writes the echo. It has no mark for the beginning of a frame either, so every place is tried, and
garbage ahead of an answer costs nothing (fact sheet, 2.3, P6).

A device answers in order: an RTU answer that fits a question settles that one and all before it;
what fits several settles the first, and nothing is taken for the last question's that an earlier
one may have asked for.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection, Container, Iterator, Sequence
from dataclasses import dataclass

from pymodbus.framer import FramerRTU, FramerSocket
from pymodbus.pdu import DecodePDU, ModbusPDU
from pymodbus.pdu.bit_message import (
    ReadCoilsRequest,
    ReadDiscreteInputsRequest,
    WriteSingleCoilRequest,
)
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadInputRegistersRequest,
    WriteMultipleRegistersRequest,
    WriteSingleRegisterRequest,
)

from instruments.bath.profile import ModbusDevice, ReadFunction
from instruments.bath.rows import Row, Table

MOST_WORDS = 125  # a read answers no more (Modbus application protocol 1.1b3, section 6.3)
MOST_GAP = 8  # registers that are not wanted cost less than another question, up to about here


@dataclass(frozen=True, slots=True)
class Block:
    """Rows that one question fetches: ``count`` registers (or bits) from ``address``."""

    function: ReadFunction
    table: Table
    rows: tuple[Row, ...]

    @property
    def address(self) -> int:
        return self.rows[0].address

    @property
    def end(self) -> int:
        return self.rows[-1].end

    @property
    def count(self) -> int:
        return self.end - self.address

    def split_rows(self, answer: Sequence[int]) -> dict[str, Sequence[int]]:
        """The registers of each row."""
        return {row.name: answer[row.address - self.address :][: row.words] for row in self.rows}


def blocks(
    profile: ModbusDevice, *, gaps: bool, inferred: bool = False, without: Container[str] = ()
) -> tuple[Block, ...]:
    """The requests of one poll. ``gaps`` reads over addresses without a row, which a controller may
    refuse; ``inferred`` takes in rows whose evidence is INFERRED; ``without``: rows left out.
    """
    found: list[Block] = []
    polled = (row for row in profile.rows if row.poll and (inferred or row.evidence != "INFERRED"))
    asked = (row for row in polled if row.name not in without)
    for row in sorted(asked, key=lambda row: (row.table, row.address)):
        last = found[-1] if found and found[-1].table == row.table else None
        near = last is not None and row.address - last.end <= (MOST_GAP if gaps else 0)
        if last and near and row.end - last.address <= MOST_WORDS:
            found[-1] = Block(last.function, last.table, (*last.rows, row))
        else:
            found.append(Block(profile.read_function(row.table), row.table, (row,)))
    return tuple(found)


def markers(profile: ModbusDevice, *, inferred: bool = False) -> tuple[tuple[int, int, int], ...]:
    """Reads (function, address, count) that the device surely answers, one of each shape of answer;
    none where there are fewer than two shapes.
    """
    unsure = {row.name for row in profile.rows if row.optional}
    asked = blocks(profile, gaps=False, inferred=inferred, without=unsure)
    reads: list[tuple[int, int, int]] = [
        (block.function, row.address, row.words) for block in asked for row in block.rows
    ]
    reads += [(block.function, block.address, block.count) for block in asked]
    if profile.alike:
        reads += [(7 - function, at, count) for function, at, count in reads if function in (3, 4)]
    shapes = {
        (function, -(-count // 8) if function in (1, 2) else count): (function, address, count)
        for function, address, count in reads
    }
    return tuple(shapes.values()) if len(shapes) > 1 else ()


REQUESTS: dict[int, tuple[Callable[..., ModbusPDU], str]] = {
    1: (ReadCoilsRequest, "coils"),
    2: (ReadDiscreteInputsRequest, "discrete inputs"),
    3: (ReadHoldingRegistersRequest, "holding registers"),
    4: (ReadInputRegistersRequest, "input registers"),
}
WRITERS: dict[int, Callable[..., ModbusPDU]] = {
    5: WriteSingleCoilRequest,
    6: WriteSingleRegisterRequest,
    16: WriteMultipleRegistersRequest,
}
EXCEPTION = 0x80
EXCEPTION_LENGTH, CONFIRMATION_LENGTH = 5, 8


@dataclass(slots=True)
class Question:
    """One request until its answer (unit and PDU) has come: ``expects`` is how the right one
    begins, ``length`` its bytes, ``earlier`` its transaction numbers before this one.
    """

    request: ModbusPDU
    expects: bytes
    length: int
    asked: str
    sent_s: float = 0.0
    answer: bytes | None = None
    earlier: tuple[int, ...] = ()

    @property
    def function(self) -> int:
        return self.expects[1]

    @property
    def unit_id(self) -> int:
        return self.expects[0]

    def fits(self, answer: bytes) -> bool:
        """Whether ``answer`` may be its answer: the right one, or an exception."""
        if answer[1] & EXCEPTION:
            return answer[0] == self.unit_id and answer[1] & ~EXCEPTION == self.function
        return len(answer) == self.length and answer.startswith(self.expects)


def read_question(function: int, address: int, count: int, unit_id: int) -> Question:
    """``count`` bits (functions 1 and 2) or registers (3 and 4) from ``address``."""
    size = -(-count // 8) if function in (1, 2) else 2 * count
    make, name = REQUESTS[function]
    request = make(address=address, count=count, dev_id=unit_id)
    asked = f"{name.removesuffix('s') if count == 1 else name} {address}"
    asked += f" to {address + count - 1}" if count > 1 else ""
    return Question(request, bytes((unit_id, function, size)), 3 + size, asked)


def write_question(function: int, address: int, values: Sequence[int], unit_id: int) -> Question:
    """Write one bit (function 5), one register (6) or some (16); the right answer is an echo."""
    words, what = list(values), "coil" if function == 5 else "holding register"
    content = {"bits": [bool(words[0])]} if function == 5 else {"registers": words}
    request = WRITERS[function](address=address, dev_id=unit_id, **content)
    echo = (bytes((unit_id, function)) + request.encode())[:6]
    return Question(request, echo, 6, f"write {words} to {what} {address}")


def values_in(answer: bytes) -> list[int]:
    """The registers in an answer, or eight bits for each byte; none where they are not whole."""
    data = answer[3:]
    if answer[1] in (1, 2):
        return [byte >> place & 1 for byte in data for place in range(8)]
    return list(struct.unpack(f">{len(data) // 2}H", data)) if len(data) % 2 == 0 else []


def frames(data: bytes, asked: Collection[tuple[int, int]]) -> Iterator[tuple[int, int]]:
    """Start and end of each whole answer or exception to one of ``asked``, in order."""
    at = 0
    while at + EXCEPTION_LENGTH <= len(data):
        unit_id, function, size = data[at : at + 3]
        length = EXCEPTION_LENGTH
        if not function & EXCEPTION:
            length = length + size if function in REQUESTS else CONFIRMATION_LENGTH
        frame = data[at : at + length] if (unit_id, function & ~EXCEPTION) in asked else b""
        whole = len(frame) == length
        if whole and FramerRTU.compute_CRC(frame[:-2]) == frame[-2] << 8 | frame[-1]:
            yield at, at + length
            at += length
        else:
            at += 1


class Answers:
    """Requests on one line without an answer yet, oldest first; ``open`` is the latest one."""

    def __init__(self, *, rtu: bool) -> None:
        self.outstanding: list[Question] = []
        self.open: Question | None = None
        self.left = 0  # bytes that have come since and are no whole answer
        self._rtu = rtu
        self._framer = (FramerRTU if rtu else FramerSocket)(DecodePDU(False))
        self._number = 0

    def put(self, question: Question, now_s: float) -> bytes:
        """The bytes that ask ``question``, under a new number each time. It is outstanding then."""
        self._number = self._number % 0xFFFF + 1
        if question.request.transaction_id:
            question.earlier += (question.request.transaction_id,)
        question.request.transaction_id = self._number
        self.left = 0
        question.sent_s = now_s
        self.open = question
        self.outstanding.append(question)
        return self._framer.buildFrame(question.request)

    def forget(self, before_s: float) -> None:
        """Drop what was asked before ``before_s``, and what was answered."""
        self.outstanding = [
            q for q in self.outstanding if q.answer is None and q.sent_s >= before_s
        ]

    def feed(self, data: bytes) -> int:
        """Take the answers in ``data``; how many bytes are done with."""
        if not self._rtu:
            return self._feed_tcp(data)
        used, asked = 0, {(question.unit_id, question.function) for question in self.outstanding}
        for start, used in frames(data, asked):
            self._take(data[start : used - 2])
        return used

    def distinguishable(self, questions: Sequence[Question]) -> Question | None:
        """The one of ``questions`` whose answer is least like one that is outstanding, if any."""
        shapes = {question.expects for question in self.outstanding}
        kinds = {question.expects[:2] for question in self.outstanding}
        free = [question for question in questions if question.expects not in shapes]
        return min(free, key=lambda question: question.expects[:2] in kinds, default=None)

    def _feed_tcp(self, data: bytes) -> int:
        used, in_one_piece = 0, not self.left
        while True:
            size, unit_id, number, pdu = self._framer.decode(data[used:])
            if not size:
                self.left = len(data) - used
                return used
            used += size
            # A late answer has to come alone: the next one's bytes could complete a cut one.
            alone = in_one_piece and used == len(data)
            for question in self.outstanding if pdu else ():
                asked = question.request.transaction_id
                if question.unit_id == unit_id and (
                    asked == number or (alone and number in question.earlier)
                ):
                    question.answer = bytes((unit_id, *pdu))

    def _take(self, answer: bytes) -> None:
        current = self.open if self.outstanding and self.outstanding[-1] is self.open else None
        at = next(
            (at for at, question in enumerate(self.outstanding) if question.fits(answer)), None
        )
        if at is None:
            if current and len(self.outstanding) == 1:  # no other request waits for what came
                current.answer = answer
                self.outstanding.clear()
            return
        exception = answer[1] & EXCEPTION
        if current and (
            self.outstanding[at] is current or (current.fits(answer) and not exception)
        ):
            current.answer = answer
        del self.outstanding[: at + 1]
