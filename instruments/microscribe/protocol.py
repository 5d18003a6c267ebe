"""The MicroScribe's data packets as values and bytes, and the session's states.

Source: the maker's SDK manual, chapter 4. A packet is a header with bit 7 set, then 7-bit bytes,
without length or checksum.
"""

from __future__ import annotations

from enum import IntEnum, StrEnum
from typing import NamedTuple

MARK = 0x80  # bit 7: ignored in a command, set in its echo
CONFIGURE = 0x40  # bit 6: a configuration command
TIME_STAMP = 0x20
UNUSED = 0x10  # no meaning in a data command
POLL = 0x03  # six encoders, no analogs, no time stamp: the usual question
SYNC = b"IMMC"
BEGIN = b"BEGIN"  # answered with the product id and a NUL
PRODUCT_ID = b"MSCR"
INTERFACE_BOX = b"IBOX"
ENCODERS = (0, 5, 7, 6)  # by bits 1-0 of a command, on an arm
ANALOGS = (0, 2, 4, 8)  # by bits 3-2
TICK_S = 0.001111
TICK_MODULUS = 1 << 14


class WireError(ValueError):
    """Bytes or an event that the protocol does not allow."""


class Code(IntEnum):
    """Configuration commands."""

    HOME = 0xC2
    SET_BAUD = 0xC4
    END = 0xC5
    PARAMETERS = 0xC0
    MAXIMA = 0xC6
    PRODUCT_NAME = 0xC8
    PRODUCT_ID = 0xC9
    MODEL = 0xCA
    SERIAL_NUMBER = 0xCB
    COMMENT = 0xCC
    FORMAT = 0xCD
    VERSION = 0xCE
    STREAM = 0xCF
    MARKER = 0xD2
    EXTENDED = 0xD3


FORBIDDEN = frozenset({0xC3, 0xC7, 0xD0, 0xD1})  # EEPROM writes behind a password
# bytes that the host adds; 2 more with seven encoders
ARGUMENTS: dict[int, int] = {Code.SET_BAUD: 1, Code.MARKER: 1, Code.STREAM: 24}
BAUD_CODES = {115200: 0, 57600: 1, 28800: 2, 14400: 3, 38400: 0x10, 19200: 0x11, 9600: 0x12}


class State(StrEnum):
    """Where the arm's side of the conversation stands."""

    FINDING_BAUD = "finding the baud rate"
    SYNCED = "synced"
    SESSION = "in session"
    STREAMING = "streaming"


class Event(StrEnum):
    """What moves it."""

    SYNC = "IMMC"
    BEGIN = "BEGIN"
    POLL = "poll"
    CONFIGURE = "configuration command"
    STREAM = "stream command"
    MARKER = "marker"
    END = "end"
    POWER_LOST = "power loss"


LIVE = (State.SESSION, State.STREAMING)
_ALWAYS = {Event.END: State.FINDING_BAUD, Event.POWER_LOST: State.FINDING_BAUD}
_IN_SESSION = _ALWAYS | {
    Event.POLL: State.SESSION,
    Event.CONFIGURE: State.SESSION,
    Event.STREAM: State.STREAMING,
}
TABLE: dict[State, dict[Event, State]] = {
    State.FINDING_BAUD: _ALWAYS | {Event.SYNC: State.SYNCED},
    State.SYNCED: _ALWAYS | {Event.SYNC: State.SYNCED, Event.BEGIN: State.SESSION},
    State.SESSION: _IN_SESSION | {Event.MARKER: State.SESSION},
    State.STREAMING: _IN_SESSION | {Event.MARKER: State.STREAMING},
}


def next_state(state: State, event: Event) -> State:
    """The state after ``event``. Raises WireError where the table has none."""
    try:
        return TABLE[state][event]
    except KeyError:
        raise WireError(f"{event.value} is not allowed while {state.value}") from None


_SPECIAL: dict[int, Event] = {
    Code.END: Event.END,
    Code.STREAM: Event.STREAM,
    Code.MARKER: Event.MARKER,
}


def event_of(command: int) -> Event:
    """What a command byte is in a live session, bit 7 or not."""
    if not command & CONFIGURE:
        return Event.POLL
    return _SPECIAL.get(command | MARK, Event.CONFIGURE)


def refuse_forbidden(data: bytes, state: State) -> None:
    """Raise WireError where ``data`` starts an EEPROM write, or has an argument that would
    configure the arm if its command were lost.
    """
    live = state in LIVE
    for at, byte in enumerate(data):
        if (byte | MARK if live else byte) in FORBIDDEN:
            raise WireError(f"byte {byte:02X} would start a write to the arm's EEPROM")
        if live and at and byte & CONFIGURE:
            raise WireError(
                f"byte {byte:02X} would configure the arm if the byte before it were lost"
            )


class Packet(NamedTuple):
    """One data packet: raw counts 0 to 16383; ticks of 1.111 ms where a stamp was asked for."""

    command: int
    buttons: int
    counts: tuple[int, ...]
    ticks: int | None = None
    analogs: tuple[int, ...] = ()


def encoder_count(command: int) -> int:
    """How many encoders a data command asks for."""
    return ENCODERS[command & 0x03]


def analog_count(command: int) -> int:
    """How many analog channels a data command asks for."""
    return ANALOGS[command >> 2 & 0x03]


def payload_length(command: int) -> int:
    """Bytes after the header of the packet that answers ``command``."""
    analogs = analog_count(command)
    stamp = 2 if command & TIME_STAMP else 0
    return 1 + stamp + analogs + bool(analogs) + 2 * encoder_count(command)


_LENGTHS = tuple(map(payload_length, range(64)))
# counts and analogs, and whether there is a time stamp, of each data command
PARTS = tuple(
    (encoder_count(command), analog_count(command), bool(command & TIME_STAMP))
    for command in range(64)
)


def encode_packet(packet: Packet) -> bytes:
    """Header and payload. Raises WireError when the packet doesn't fit its command."""
    command, buttons, counts, ticks, analogs = packet
    wanted = PARTS[command & 0x3F]
    if (len(counts), len(analogs), ticks is not None) != wanted:
        raise WireError(
            f"a packet for command {command:02X} has {wanted[0]} counts, {wanted[1]} analogs, time"
            f" stamp {wanted[2]}"
        )
    data = [command | MARK, buttons & 0x7F]
    if ticks is not None:
        data += ticks >> 7 & 0x7F, ticks & 0x7F
    if analogs:
        data += [value >> 1 for value in analogs]
        data.append(sum((value & 1) << 6 >> channel for channel, value in enumerate(analogs)))
    for value in counts:
        data += value >> 7 & 0x7F, value & 0x7F
    return bytes(data)


class PacketDecoder:
    """Finds packets of ``command`` (None: any) in a stream cut anywhere. Bit 7 inside a packet, or
    a byte without it behind one, is damage. ``damaged`` counts packets dropped, ``withdrawn`` those
    among them that had been returned before.
    """

    def __init__(self, command: int | None = None) -> None:
        self.damaged = self.withdrawn = 0
        self.expect(command)

    def expect(self, command: int | None) -> None:
        """From now on packets of ``command``, and nothing of one that had begun."""
        self.command = command
        self._wanted = None if command is None else command | MARK
        self._behind_packet = False
        self._buffer = b""

    @property
    def pending(self) -> int:
        """Bytes of an unfinished packet."""
        return len(self._buffer)

    def reset(self) -> None:
        """Forget an unfinished packet; it counts as damaged."""
        self.damaged += bool(self._buffer)
        self._buffer = b""
        self._behind_packet = False

    def feed(self, data: bytes) -> list[Packet]:
        """The packets that ``data`` completes, in order."""
        buffer, at, given_to = self._buffer + data, 0, -1
        if self._behind_packet and buffer and not buffer[0] & MARK:
            self.damaged += 1
            self.withdrawn += 1
        packets: list[Packet] = []
        while at < len(buffer):
            header = buffer[at]
            is_packet = header & (MARK | CONFIGURE | UNUSED) == MARK
            if not is_packet if self._wanted is None else header != self._wanted:
                at = _next_marked(buffer, at)
                continue
            end = at + 1 + _LENGTHS[header & 0x3F]
            payload = buffer[at + 1 : end]
            if not payload.isascii():
                self.damaged += 1
                at = _next_marked(buffer, at)
            elif end > len(buffer):
                break
            elif end < len(buffer) and not buffer[end] & MARK:
                self.damaged += 1
                at = _next_marked(buffer, end)
            else:
                packets.append(_packet(header & 0x7F, payload))
                at = given_to = end
        self._behind_packet = given_to == len(buffer) if buffer else self._behind_packet
        self._buffer = buffer[at:]
        return packets


def _next_marked(buffer: bytes, at: int) -> int:
    return next((i for i in range(at + 1, len(buffer)) if buffer[i] & MARK), len(buffer))


def _packet(command: int, payload: bytes) -> Packet:
    at, ticks, analogs = 1, None, ()  # type: int, int | None, tuple[int, ...]
    if command & TIME_STAMP:
        at, ticks = 3, payload[1] << 7 | payload[2]
    if channels := analog_count(command):
        low_bits = payload[at + channels] << 1
        analogs = tuple(payload[at + i] << 1 | low_bits >> 7 - i & 1 for i in range(channels))
        at += channels + 1
    words = zip(payload[at::2], payload[at + 1 :: 2], strict=True)
    counts = tuple([high << 7 | low for high, low in words])
    return Packet(command, payload[0], counts, ticks, analogs)


class ArmTime:
    """Seconds since the first stamp by the arm's clock: 14-bit ticks that wrap after 18 s. The
    host's clock only counts the wraps: right while two delays in a row differ by less than 9 s.
    """

    def __init__(self) -> None:
        self._ticks = 0
        self._last: tuple[int, float] | None = None

    def seconds(self, ticks: int, host_s: float) -> float:
        """Time of a packet stamped ``ticks`` (0 to 16383) that the host got at ``host_s``."""
        if self._last is not None:
            step = (ticks - self._last[0]) % TICK_MODULUS
            wraps = max(0, round(((host_s - self._last[1]) / TICK_S - step) / TICK_MODULUS))
            self._ticks += step + wraps * TICK_MODULUS
        self._last = ticks, host_s
        return self._ticks * TICK_S
