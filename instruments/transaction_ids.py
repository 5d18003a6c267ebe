"""The one thing in which a replayed Modbus TCP host may differ: each request's transaction id, which its answer repeats.

A host counts them as it likes. So the recorded id stands in for the host's own while bytes are compared, and the host's
own for the recorded one in the answer. All other bytes are left alone, and so is what is no Modbus TCP.

Source: Modbus messaging on TCP/IP, implementation guide 1.0b, section 3.1.3 (the header).
"""

from __future__ import annotations

import struct
from bisect import bisect_left
from collections.abc import Iterator

from instruments.capture_reader import Conversation

HEADER = struct.Struct(">HHH")  # transaction, protocol (0 is Modbus), bytes that follow
ID_BYTES = 2
LONGEST = 254


def is_modbus_tcp(url: str) -> bool:
    """Whether the link of this URL carries Modbus TCP: of all links, the bath's alone is ``tcp://``."""
    return url.startswith("tcp://")


class TransactionIds:
    """The ids of one connection, in both directions of its recorded streams."""

    def __init__(self, script: Conversation) -> None:
        self._asked = _Stream(b"".join(exchange.asked for exchange in script.exchanges))
        self._came = _Stream(b"".join(piece.data for exchange in script.exchanges for piece in exchange.came))
        self._own: dict[bytes, bytes] = {}  # the host's id for each recorded one
        self._half = b""

    def as_recorded(self, data: bytes) -> bytes:
        """The host's next bytes, with recorded ids in place of its own."""
        changed = bytearray(data)
        for at, place, recorded in self._asked.ids_in_next(len(data)):
            self._half = data[at : at + 1] if place == 0 else self._half + data[at : at + 1]
            if len(self._half) == ID_BYTES:
                self._own[recorded] = self._half
            changed[at] = recorded[place]
        return bytes(changed)

    def as_asked(self, data: bytes) -> bytes:
        """The next recorded bytes for the host, with its own ids in place of the recorded ones."""
        changed = bytearray(data)
        for at, place, recorded in self._came.ids_in_next(len(data)):
            changed[at] = self._own.get(recorded, recorded)[place]
        return bytes(changed)


class _Stream:
    """Where the ids stand in one direction's bytes."""

    def __init__(self, stream: bytes) -> None:
        self._starts = list(_starts(stream))
        self._ids = [stream[start : start + ID_BYTES] for start in self._starts]
        self._at = 0

    def ids_in_next(self, count: int) -> Iterator[tuple[int, int, bytes]]:
        """For each byte of an id within the next ``count``: where it is, which of the id's bytes, and the recorded id."""
        begin, end = self._at, self._at + count
        self._at = end
        number = bisect_left(self._starts, begin - ID_BYTES + 1)
        while number < len(self._starts) and self._starts[number] < end:
            for place in range(ID_BYTES):
                at = self._starts[number] + place - begin
                if 0 <= at < count:
                    yield at, place, self._ids[number]
            number += 1


def _starts(stream: bytes) -> Iterator[int]:
    """Where frames begin, up to what is no frame."""
    at = 0
    while at + HEADER.size <= len(stream):
        _, protocol, length = HEADER.unpack_from(stream, at)
        if protocol != 0 or not 2 <= length <= LONGEST:
            return
        yield at
        at += HEADER.size + length
