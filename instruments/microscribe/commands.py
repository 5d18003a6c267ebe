"""The commands that carry a byte or two: another rate, a marker; and which stream delays do no harm.

Facts: ../shared/instruments/microscribe.md, from the maker's SDK manual, chapter 4. Pure: it may not know of time,
links or threads, nor who speaks.
"""

from __future__ import annotations

from instruments.microscribe.protocol import BAUD_CODES, CONFIGURE, Code, Marker, WireError

LONGEST_DELAY_MS = 0x3FBF  # the longest that is harmless


def harmless_delay_ms(period_s: float) -> int:
    """The longest delay up to ``period_s`` whose bytes would configure nothing if the stream's first byte were lost.

    Bit 6 of either byte makes a command of it: 66 ms (42) would re-home the arm. So 64 to 127 ms become 63. At least 1.
    """
    delay = min(max(1, int(period_s * 1000 + 1e-6)), LONGEST_DELAY_MS)
    while delay & (CONFIGURE << 8 | CONFIGURE):
        delay -= 1
    return delay


def encode_set_baud(baud: int) -> bytes:
    """The command that changes the rate; its echo comes at the old one. Raises WireError for a rate that no arm has."""
    if baud not in BAUD_CODES:
        raise WireError(f"an arm has no rate {baud}; it has {', '.join(map(str, sorted(BAUD_CODES)))}")
    return bytes([Code.SET_BAUD, BAUD_CODES[baud]])


def decode_set_baud(data: bytes) -> int:
    """The rate that a whole command asks for. Raises WireError for another length, command or rate."""
    rates = [baud for baud, code in BAUD_CODES.items() if data == bytes([Code.SET_BAUD, code])]
    if not rates:
        raise WireError(f"a rate is C4 and one of {bytes(BAUD_CODES.values()).hex(' ').upper()}")
    return rates[0]


def encode_marker(marker: Marker) -> bytes:
    """A marker, as the host sends it and as the arm sends it back. Raises WireError when it is no byte."""
    if marker.value not in range(256):
        raise WireError(f"a marker is one byte, not {marker.value}")
    return bytes([Code.MARKER, marker.value])


def decode_marker(reply: bytes) -> Marker:
    """The marker in a reply of two bytes. Raises WireError for anything else."""
    if len(reply) != 2 or reply[0] != Code.MARKER:
        raise WireError("a marker is D2 and one byte")
    return Marker(reply[1])
