"""The emulated arm's side of the conversation: each byte received, and the answer to it.

What no document states is a choice in `UnspecifiedBehaviour`. In a live session bit 7 of a command
is ignored, so letters are commands; unsupported commands get no answer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

from instruments.microscribe import configuration as conf
from instruments.microscribe import protocol as wire
from instruments.microscribe.configuration import StreamRequest
from instruments.microscribe.faults import Fault, Faults
from instruments.microscribe.kinematics import COUNT_MODULUS
from instruments.microscribe.protocol import Code, Event, Packet, State
from instruments.microscribe.unit import ArmIdentity


@dataclass(frozen=True, slots=True)
class UnspecifiedBehaviour:
    """``echoes_again``: an IMMC behind the echoed one is echoed too. ``release_triggers``: so does
    a pedal that comes up. ``deltas_from``: what an encoder's difference is measured from.
    """

    echoes_again: bool = True
    release_triggers: bool = True
    deltas_from: Literal["last packet", "last look"] = "last packet"


@dataclass(frozen=True, slots=True)
class Look:
    """What the arm sees of itself at one moment."""

    buttons: int
    counts: Sequence[int]


class Trigger:
    """Whether a stream by differences sends. A delta or mask bit of 0 leaves its encoder or pedal
    out; the analog channels are not connected and never differ.
    """

    def __init__(self, request: StreamRequest, habits: UnspecifiedBehaviour, first: Look) -> None:
        self._mask = request.button_mask
        self._deltas = request.encoder_deltas
        self._habits = habits
        self._before = first.buttons
        self._from = first.counts

    def fires(self, now: Look) -> bool:
        """Whether a pedal changed since the last look, or an encoder by its delta."""
        changed = (now.buttons ^ self._before) & self._mask
        if not self._habits.release_triggers:
            changed &= now.buttons
        moved = any(
            delta and _apart(a, b) >= delta
            for delta, a, b in zip(self._deltas, now.counts, self._from, strict=False)
        )
        fires = bool(changed) or moved
        self._before = now.buttons
        if fires or self._habits.deltas_from == "last look":
            self._from = now.counts
        return fires


def _apart(a: int, b: int) -> int:
    """Counts from one to the other, the shorter way round."""
    forward = (a - b) % COUNT_MODULUS
    return min(forward, COUNT_MODULUS - forward)


FASTEST_BAUD = 115200  # no stream is faster than this carries it
_BITS_PER_BYTE = 10


class Body(Protocol):
    """The rest of the arm."""

    def look(self) -> Look:
        """Pedals and encoders at this moment."""
        ...

    def load_home(self) -> None:
        """Have the encoders' counters show the home counts, wherever the stylus is."""
        ...

    def ticks(self) -> int:
        """The time stamp of this moment."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """A running stream of ``command``: packets, or with ``trigger`` looks, every ``period_s``."""

    command: int
    period_s: float
    trigger: Trigger | None


class Firmware:
    """One arm's conversation at ``rate``, where known; ``stream`` is None without one.

    ``echo_after``: how many IMMC it needs. Raises WireError for a unit that doesn't fit its own
    replies.
    """

    def __init__(
        self,
        unit: ArmIdentity,
        body: Body,
        faults: Faults,
        habits: UnspecifiedBehaviour,
        echo_after: int,
    ) -> None:
        self.state = State.FINDING_BAUD
        self.rate: int | None = None
        self.stream: Stream | None = None
        self.eeprom_attempts = 0
        self.packets = 0
        self._button_mask = unit.maxima.button_mask
        self._replies = unit.replies()
        self._body = body
        self._faults = faults
        self._habits = habits
        self._echo_after = echo_after
        self._heard = b""
        self._syncs = 0
        self._command = bytearray()

    def enter(self, state: State) -> None:
        """A state anew: nothing heard, no stream, and outside a session no rate."""
        self.state = state
        self.stream = None
        self._heard = b""
        self._syncs = 0
        self._command = bytearray()
        if state not in wire.LIVE:
            self.rate = None

    def take(self, byte: int, rate: int | None) -> bytes:
        """The answer to a byte at ``rate`` (None: unknown); empty while a command is cut."""
        if self.state not in wire.LIVE:
            return self._listen(byte, rate)
        self._command.append(byte)
        if len(self._command) <= _arguments(self._command):
            return b""
        command, self._command = bytes(self._command), bytearray()
        return self._obey(command)

    def packet(self, command: int, look: Look) -> bytes:
        """The answer to a data command; nothing for what isn't one."""
        if command not in range(wire.TIME_STAMP << 1) or command & wire.UNUSED:
            return b""
        self.packets += 1
        ticks = self._body.ticks() if command & wire.TIME_STAMP else None
        analogs = (0,) * wire.analog_count(command)  # nothing is plugged in
        counts = (*look.counts, 0)[: wire.encoder_count(command)]
        return wire.encode_packet(
            Packet(command, look.buttons & self._button_mask, counts, ticks, analogs)
        )

    def _listen(self, byte: int, rate: int | None) -> bytes:
        """Outside a session: words, and the end byte."""
        self._heard = (self._heard + bytes([byte]))[-len(wire.BEGIN) :]
        if byte == Code.END:
            self.state = wire.next_state(self.state, Event.END)
        elif self._heard.endswith(wire.SYNC):
            return self._echo(rate)
        elif self._heard == wire.BEGIN and self.state is State.SYNCED:
            self.enter(wire.next_state(self.state, Event.BEGIN))
            return (
                wire.INTERFACE_BOX if self._faults.strikes(Fault.INTERFACE_BOX) else wire.PRODUCT_ID
            ) + b"\0"
        return b""

    def _echo(self, rate: int | None) -> bytes:
        again = self.state is State.SYNCED
        self._syncs += 1
        wanted = (
            self._faults.amount(Fault.LATE_ECHO)
            if self._faults.on(Fault.LATE_ECHO)
            else self._echo_after
        )
        if self._syncs < wanted or (again and not self._habits.echoes_again):
            return b""
        self.state = wire.next_state(self.state, Event.SYNC)
        self.rate = rate
        return wire.SYNC * (3 if self._faults.strikes(Fault.SURPLUS_ECHOES) else 1)

    def _obey(self, command: bytes) -> bytes:
        """In a session: one whole command. Whatever it is, it ends a stream, but for the marker."""
        event = wire.event_of(command[0])
        state = wire.next_state(self.state, event)
        if event is Event.MARKER:
            return bytes([Code.MARKER]) + command[1:]
        self.enter(state)
        if event is Event.POLL:
            return self.packet(command[0] & ~wire.MARK, self._body.look())
        if event is Event.STREAM:
            return self._start(conf.decode_stream(bytes([Code.STREAM]) + command[1:]))
        if event is Event.END:
            return bytes([Code.END])
        return self._configure(command)

    def _configure(self, command: bytes) -> bytes:
        """The reply to a configuration command; silence for what is not supported."""
        code = command[0] | wire.MARK
        self.eeprom_attempts += code in wire.FORBIDDEN
        if code == Code.HOME:
            self._body.load_home()
            return bytes([code])
        if code == Code.SET_BAUD:
            rates = [rate for rate, number in wire.BAUD_CODES.items() if number == command[1]]
            # from the next byte on: the echo comes at the old rate
            self.rate = rates[0] if rates else self.rate
            return bytes([code]) if rates else b""
        reply = self._replies.get(code, b"")
        if code == Code.PARAMETERS and self._faults.strikes(Fault.BLOCK_LENGTH):
            return reply[:1] + bytes([conf.PARAMETER_BYTES - 2]) + reply[2:-2]
        return reply

    def _start(self, request: conf.StreamRequest) -> bytes:
        """Echo; what follows is for whoever keeps the time to ask for."""
        command = request.command & ~wire.MARK
        wire_s = (1 + wire.payload_length(command)) * _BITS_PER_BYTE / FASTEST_BAUD
        trigger = None if request.fixed_rate else Trigger(request, self._habits, self._body.look())
        self.stream = Stream(command, max(request.delay_ms / 1000.0, wire_s), trigger)
        return bytes([Code.STREAM])


def _arguments(command: bytearray) -> int:
    """How many bytes follow the first; a stream's depends on the command within it."""
    if not command[0] & wire.CONFIGURE:
        return 0
    code = command[0] | wire.MARK
    sevenfold = code == Code.STREAM and len(command) > 3 and wire.encoder_count(command[3]) == 7
    return wire.ARGUMENTS.get(code, 0) + (2 if sevenfold else 0)
