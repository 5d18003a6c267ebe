"""RTU frames in what came over a line, wherever they start: garbage ahead of a whole answer costs nothing. Pure.

RTU has no mark for the beginning of a frame. But whoever asked knows the unit, the function and so the length that an
answer has, and the check sum tells the rest: every place is tried. A client that takes the first byte for a header
loses the whole answer to one stray byte (fact sheet, 2.3, P6).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator

from pymodbus.framer import FramerRTU

EXCEPTION = 0x80
EXCEPTION_LENGTH = 5
CONFIRMATION_LENGTH = 8
READS = (1, 2, 3, 4)


def frames(data: bytes, asked: Collection[tuple[int, int]]) -> Iterator[tuple[int, int]]:
    """Start and end of each whole answer to one of ``asked``, units and functions, exceptions among them, in order."""
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
