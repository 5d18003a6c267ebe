"""Modbus RTU as a server hears it: where a request ends, whether its check sum holds, and how an answer is framed. Pure.

RTU marks the end of a frame by 3.5 characters of silence, which neither a TCP connection nor an operating system's
serial driver keeps. So a request ends where its content says; silence only ends what can't be understood. Written from the
public specification (Modbus over serial line 1.02) and not from the library that the driver uses.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

GAP_S = 0.05  # a request's bytes come closer together; 3.5 characters are 4 ms at 9600 baud, but a busy PC stalls for longer
LONGEST = 256
SHORTEST = 4
BROADCAST = 0

LENGTHS = {1: 8, 2: 8, 3: 8, 4: 8, 5: 8, 6: 8, 7: 4, 8: 8, 11: 4, 12: 4, 17: 4, 22: 10, 24: 6}
COUNTED = {15: (6, 9), 16: (6, 9), 23: (10, 13)}  # where the count of data bytes stands, and how many bytes there are beside them


@dataclass(frozen=True, slots=True)
class RtuFrame:
    """One request as framed: whose it is, and its function code with what follows."""

    unit: int
    pdu: bytes

    def answer(self, pdu: bytes) -> bytes:
        """The bytes that carry ``pdu`` back."""
        return framed(self.unit, pdu)


class RtuReader:
    """Takes bytes cut anywhere, gives whole frames. After a broken frame it is deaf until the line has been quiet."""

    def __init__(self, gap_s: float = GAP_S) -> None:
        self._gap_s = gap_s
        self._buffer = b""
        self._deaf = False
        self._heard_s = 0.0

    def feed(self, data: bytes, now_s: float) -> Iterator[RtuFrame]:
        """The frames that ``data``, come at ``now_s``, completes."""
        if now_s - self._heard_s > self._gap_s:
            self._buffer, self._deaf = b"", False
        self._heard_s = now_s
        self._buffer += data
        while self._buffer and not self._deaf:
            end = _end(self._buffer)
            if end is None or len(self._buffer) < end <= LONGEST:
                self._deaf = len(self._buffer) > LONGEST
                return
            frame, self._buffer = self._buffer[:end], self._buffer[end:]
            if end > LONGEST or crc(frame):
                self._deaf = True
                return
            yield RtuFrame(frame[0], frame[1:-2])


def framed(unit: int, pdu: bytes) -> bytes:
    """Unit, PDU and check sum, low byte first."""
    body = bytes((unit,)) + pdu
    return body + crc(body).to_bytes(2, "little")


def _end(data: bytes) -> int | None:
    """Where the first request in ``data`` ends, or None as long as that can't be told."""
    if len(data) < 2:
        return None
    if data[1] in LENGTHS:
        return LENGTHS[data[1]]
    if data[1] in COUNTED:
        at, beside = COUNTED[data[1]]
        return beside + data[at] if len(data) > at else None
    return len(data) if len(data) >= SHORTEST and crc(data) == 0 else None  # no such function: only the check sum can tell


def crc(data: bytes) -> int:
    """The check sum (polynomial 0xA001, start 0xFFFF); 0 over a whole frame with its own."""
    value = 0xFFFF
    for byte in data:
        value = value >> 8 ^ _TABLE[(value ^ byte) & 0xFF]
    return value


def _table_entry(byte: int) -> int:
    for _ in range(8):
        byte = byte >> 1 ^ 0xA001 if byte & 1 else byte >> 1
    return byte


_TABLE = tuple(_table_entry(byte) for byte in range(256))
