"""Modbus from the server's side: bytes to requests, answers to bytes, and the framing of Modbus TCP
and RTU. No I/O.

Written from the public specifications (Modbus application protocol 1.1b3, messaging on TCP/IP 1.0b,
serial line 1.02) and not from the library that the driver uses, so that the two ends can't be wrong
together. RTU marks the end of a frame by 3.5 characters of silence, which neither a TCP connection
nor an operating system's serial driver keeps. So a request ends where its content says; silence
only ends what can't be understood.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

HEADER = struct.Struct(">HHHB")  # transaction, protocol (0 is Modbus), bytes that follow it, unit
LONGEST = 254  # unit and PDU
MOST_READ, MOST_WRITTEN, MOST_EXCHANGED = 125, 123, 121
MOST_BITS_READ, MOST_BITS_WRITTEN = 2000, 1968

READ_COILS, READ_DISCRETE, READ_HOLDING, READ_INPUT = 1, 2, 3, 4
WRITE_COIL, WRITE_ONE, STATUS, LOOPBACK, WRITE_COILS, WRITE_MANY, EXCHANGE = 5, 6, 7, 8, 15, 16, 23
ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE, BUSY = 1, 2, 3, 6

READS = {READ_COILS: MOST_BITS_READ, READ_DISCRETE: MOST_BITS_READ}  # the most that each takes
READS |= {READ_HOLDING: MOST_READ, READ_INPUT: MOST_READ}
BITS = (READ_COILS, READ_DISCRETE, WRITE_COIL, WRITE_COILS)


# a request's bytes come closer together; 3.5 characters are 4 ms at 9600 baud, but a busy PC stalls
# for longer
GAP_S = 0.05
LONGEST_RTU = 256
SHORTEST = 4
BROADCAST = 0

LENGTHS = {1: 8, 2: 8, 3: 8, 4: 8, 5: 8, 6: 8, 7: 4, 8: 8, 11: 4, 12: 4, 17: 4, 22: 10, 24: 6}
# where the count of data bytes stands, and how many bytes there are beside them
COUNTED = {15: (6, 9), 16: (6, 9), 23: (10, 13)}


@dataclass(frozen=True, slots=True)
class Frame:
    """One request: the unit, its function code with what follows, and over TCP its transaction."""

    unit: int
    pdu: bytes
    transaction: int | None = None

    def answer(self, pdu: bytes) -> bytes:
        """The bytes that carry ``pdu`` back."""
        if self.transaction is None:
            return framed(self.unit, pdu)
        return HEADER.pack(self.transaction, 0, len(pdu) + 1, self.unit) + pdu


@dataclass(frozen=True, slots=True)
class Read:
    """Functions 1 to 4: ``count`` bits or registers from ``address``."""

    function: int
    address: int
    count: int


@dataclass(frozen=True, slots=True)
class Write:
    """Functions 5, 6, 15, 16: ``values`` (bits as 0 and 1, or registers) from ``address`` up."""

    function: int
    address: int
    values: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class ReadWrite:
    """Function 23: ``write`` first, then ``read``, in one go."""

    read: Read
    write: Write


@dataclass(frozen=True, slots=True)
class RawRequest:
    """Functions 7 (status byte) and 8 (loopback): what follows the function code, as it came."""

    function: int
    body: bytes


Request = Read | Write | ReadWrite | RawRequest


class ModbusException(Exception):  # noqa: N818 - it is an answer, not a fault
    """The request gets the exception ``code`` for an answer."""

    def __init__(self, code: int) -> None:
        self.code = code
        super().__init__(f"Modbus exception {code}")


class UnframedError(ValueError):
    """These bytes are no Modbus TCP; a server can only hang up."""


def parse(pdu: bytes) -> Request:
    """The request. Raises ModbusException with the code of the specification's state diagrams."""
    function, body = pdu[0], pdu[1:]
    if function in (STATUS, LOOPBACK):
        return RawRequest(function, body)
    if function not in (*READS, WRITE_COIL, WRITE_ONE, WRITE_COILS, WRITE_MANY, EXCHANGE):
        raise ModbusException(ILLEGAL_FUNCTION)
    numbers, head = (4, 8) if function == EXCHANGE else (2, 4)
    data = body[head:]
    _demand(len(body) >= head and (function in COUNTED or not data))
    address, value, *written = struct.unpack_from(f">{numbers}H", body)
    if function in READS:
        _demand(1 <= value <= READS[function])
        return Read(function, address, value)
    if function == WRITE_COIL:
        _demand(value in (0x0000, 0xFF00))
        return Write(function, address, (value >> 15,))
    if function == WRITE_ONE:
        return Write(function, address, (value,))
    if function == WRITE_COILS:
        _demand(1 <= value <= MOST_BITS_WRITTEN)
        bits = int.from_bytes(_counted(data, -(-value // 8)), "little")
        return Write(function, address, tuple(bits >> at & 1 for at in range(value)))
    if function == WRITE_MANY:
        return Write(function, address, _registers(data, value, MOST_WRITTEN))
    _demand(1 <= value <= MOST_READ)
    target, count = written
    write = Write(function, target, _registers(data, count, MOST_EXCHANGED))
    return ReadWrite(Read(function, address, value), write)


def answer_read(request: Read, values: Sequence[int]) -> bytes:
    """The PDU that carries ``values``, of any number; bits fill bytes from the lowest place."""
    if request.function in BITS:
        whole = sum(bit << at for at, bit in enumerate(values))
        data = whole.to_bytes(-(-len(values) // 8), "little")
    else:
        data = struct.pack(f">{len(values)}H", *values)
    return bytes((request.function, len(data))) + data


def answer_write(request: Write) -> bytes:
    single = {WRITE_ONE: request.values[0], WRITE_COIL: request.values[0] * 0xFF00}
    value = single.get(request.function, len(request.values))
    return struct.pack(">BHH", request.function, request.address, value)


def answer_refusal(function: int, code: int) -> bytes:
    return bytes((function | 0x80, code))


def _registers(counted: bytes, count: int, most: int) -> tuple[int, ...]:
    _demand(1 <= count <= most)
    return struct.unpack(f">{count}H", _counted(counted, 2 * count))


def _counted(counted: bytes, length: int) -> bytes:
    """What follows a count of bytes, which must be ``length``."""
    _demand(len(counted) == length + 1 and counted[0] == length)
    return counted[1:]


def _demand(condition: bool) -> None:
    if not condition:
        raise ModbusException(ILLEGAL_VALUE)


class FrameReader:
    """Takes bytes cut anywhere, gives whole frames of Modbus TCP."""

    def __init__(self) -> None:
        self._buffer = b""

    def feed(self, data: bytes, now_s: float) -> Iterator[Frame]:  # noqa: ARG002 - as `RtuReader.feed`
        """The frames that ``data`` completes. Raises UnframedError for what is no Modbus TCP."""
        self._buffer += data
        while len(self._buffer) >= HEADER.size:
            transaction, protocol, length, unit = HEADER.unpack_from(self._buffer)
            if protocol != 0 or not 2 <= length <= LONGEST:
                raise UnframedError(f"protocol {protocol}, length {length}")
            end = HEADER.size + length - 1
            if len(self._buffer) < end:
                return
            pdu, self._buffer = self._buffer[HEADER.size : end], self._buffer[end:]
            yield Frame(unit, pdu, transaction)


class RtuReader:
    """Bytes, cut anywhere, to RTU frames; a broken frame drops all until ``GAP_S`` of silence."""

    def __init__(self) -> None:
        self._buffer = b""
        self._broken = False
        self._last_s = 0.0

    def feed(self, data: bytes, now_s: float) -> Iterator[Frame]:
        """The frames that ``data``, come at ``now_s``, completes."""
        if now_s - self._last_s > GAP_S:
            self._buffer, self._broken = b"", False
        self._last_s = now_s
        self._buffer += data
        while self._buffer and not self._broken:
            end = _end(self._buffer)
            if end is None or len(self._buffer) < end <= LONGEST_RTU:
                self._broken = len(self._buffer) > LONGEST_RTU
                return
            frame, self._buffer = self._buffer[:end], self._buffer[end:]
            if end > LONGEST_RTU or crc(frame):
                self._broken = True
                return
            yield Frame(frame[0], frame[1:-2])


def framed(unit: int, pdu: bytes) -> bytes:
    """An RTU frame: unit, PDU and check sum, low byte first."""
    body = bytes((unit,)) + pdu
    return body + crc(body).to_bytes(2, "little")


def _end(data: bytes) -> int | None:
    """Where the first request in ``data`` ends, or None as long as that is unknown."""
    if len(data) < 2:
        return None
    if data[1] in LENGTHS:
        return LENGTHS[data[1]]
    if data[1] in COUNTED:
        at, beside = COUNTED[data[1]]
        return beside + data[at] if len(data) > at else None
    # no such function: only the check sum can tell
    return len(data) if len(data) >= SHORTEST and crc(data) == 0 else None


def crc(data: bytes) -> int:
    """The check sum (polynomial 0xA001, start 0xFFFF); 0 over a whole frame with its own."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ 0xA001 if value & 1 else value >> 1
    return value
