"""Modbus TCP as a server hears and answers it: bytes to requests, answers to bytes, no I/O.

Written from the public specification (Modbus application protocol 1.1b3, messaging on TCP/IP 1.0b) and not from
the library that the driver uses, so that the two ends can't be wrong together. Only register functions are here;
what registers mean is for somebody else to know.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

HEADER = struct.Struct(">HHHB")  # transaction, protocol (0 is Modbus), bytes that follow it, unit
LONGEST = 254  # unit and PDU
MOST_READ, MOST_WRITTEN = 125, 123

READ_HOLDING, READ_INPUT, WRITE_ONE, WRITE_MANY = 3, 4, 6, 16
ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE, FAILURE, BUSY = 1, 2, 3, 4, 6


@dataclass(frozen=True, slots=True)
class Frame:
    """One request as framed: whose it is, and its function code with what follows."""

    transaction: int
    unit: int
    pdu: bytes

    def answer(self, pdu: bytes) -> bytes:
        """The bytes that carry ``pdu`` back to who asked."""
        return HEADER.pack(self.transaction, 0, len(pdu) + 1, self.unit) + pdu


@dataclass(frozen=True, slots=True)
class Read:
    """Function 3 or 4: ``count`` registers from ``address``."""

    function: int
    address: int
    count: int


@dataclass(frozen=True, slots=True)
class Write:
    """Function 6 or 16: ``registers`` to ``address`` and up."""

    function: int
    address: int
    registers: tuple[int, ...]


class Refused(Exception):  # noqa: N818 - it is an answer, not a fault
    """The request gets the exception ``code`` for an answer."""

    def __init__(self, code: int) -> None:
        self.code = code
        super().__init__(f"Modbus exception {code}")


class UnframedError(ValueError):
    """These bytes are no Modbus TCP; a server can only hang up."""


class FrameReader:
    """Takes bytes cut anywhere, gives whole frames."""

    def __init__(self) -> None:
        self._buffer = b""

    def feed(self, data: bytes) -> Iterator[Frame]:
        """The frames that ``data`` completes. Raises UnframedError when the stream can't be Modbus TCP."""
        self._buffer += data
        while len(self._buffer) >= HEADER.size:
            transaction, protocol, length, unit = HEADER.unpack_from(self._buffer)
            if protocol != 0 or not 2 <= length <= LONGEST:
                raise UnframedError(f"protocol {protocol}, length {length}")
            end = HEADER.size + length - 1
            if len(self._buffer) < end:
                return
            pdu, self._buffer = self._buffer[HEADER.size : end], self._buffer[end:]
            yield Frame(transaction, unit, pdu)


def parse(pdu: bytes) -> Read | Write:
    """What is asked. Raises Refused, with the code that the specification's state diagrams give."""
    function, body = pdu[0], pdu[1:]
    if function in (READ_HOLDING, READ_INPUT):
        address, count = _two(body, exactly=True)
        if not 1 <= count <= MOST_READ:
            raise Refused(ILLEGAL_VALUE)
        return Read(function, address, count)
    if function == WRITE_ONE:
        address, register = _two(body, exactly=True)
        return Write(function, address, (register,))
    if function == WRITE_MANY:
        address, count = _two(body, exactly=False)
        if not 1 <= count <= MOST_WRITTEN or len(body) != 5 + 2 * count or body[4] != 2 * count:
            raise Refused(ILLEGAL_VALUE)
        return Write(function, address, struct.unpack(f">{count}H", body[5:]))
    raise Refused(ILLEGAL_FUNCTION)


def _two(body: bytes, *, exactly: bool) -> tuple[int, int]:
    if len(body) < 4 or (exactly and len(body) != 4):
        raise Refused(ILLEGAL_VALUE)
    first, second = struct.unpack_from(">HH", body)
    return first, second


def answer_read(request: Read, registers: Sequence[int]) -> bytes:
    """The PDU that carries ``registers``; as many as there are, so a wrong number can be sent on purpose."""
    return struct.pack(f">BB{len(registers)}H", request.function, 2 * len(registers), *registers)


def answer_write(request: Write) -> bytes:
    """The PDU that confirms a write."""
    said = request.registers[0] if request.function == WRITE_ONE else len(request.registers)
    return struct.pack(">BHH", request.function, request.address, said)


def answer_refusal(function: int, code: int) -> bytes:
    """The PDU that says no."""
    return bytes((function | 0x80, code))
