"""The other end of a MicroScribe's wire, byte for byte, with the hazards of the real one.

What is stated or recorded in ../shared/instruments/microscribe.md is done as stated; what is not known there is an
argument or a fault. In a live session bit 7 of a command is ignored, so that letters are commands; what is not
supported gets silence. It never waits: it answers at once. Methods that change it from outside (``power_cycle``,
``faults``) are to be called under the world's lock. It may not know its driver.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from instruments.clock import Clock
from instruments.listener import Connection
from instruments.microscribe import configuration as conf
from instruments.microscribe import protocol as wire
from instruments.microscribe.faults import Fault, Faults
from instruments.microscribe.kinematics import Counts, Floats, OutOfReachError, encoded
from instruments.microscribe.mechanics import Hand, Mechanics
from instruments.microscribe.protocol import Code, Event, Packet, State
from instruments.microscribe.unit import UNIT_40937, ArmIdentity

ACCURACY_MM = 0.23  # the maker's figure for a 3DX
TREMOR_MM = 0.05
FASTEST_STREAM_S = 1.0 / 823.0  # 115200 baud, six encoders

_LIVE = (State.SESSION, State.STREAMING)


class ArmEmulator:
    """An arm in a hand, switched on with its stylus on the peg.

    ``echo_after`` is how many IMMC it wants to hear. ``buttons`` are the pedals (bit 0 right, bit 1 left).
    ``unreachable`` tells why the connection was broken when the hand asked for what no arm can do.
    """

    def __init__(
        self,
        hand: Hand,
        clock: Clock,
        *,
        unit: ArmIdentity = UNIT_40937,
        seed: int = 0,
        accuracy_mm: float = ACCURACY_MM,
        tremor_mm: float = TREMOR_MM,
        echo_after: int = 1,
    ) -> None:
        self.unit = unit
        self.faults = Faults(seed)
        self.buttons = 0
        self.unreachable: OutOfReachError | None = None
        self.eeprom_attempts = 0
        self.packets = 0
        self._mechanics = Mechanics(unit.geometry(), unit.home, hand, seed=seed, accuracy_mm=accuracy_mm, tremor_mm=tremor_mm)
        self._clock = clock
        self._echo_after = echo_after
        self._home: Counts = np.array(unit.home, dtype=np.int64)
        self._offset: Counts = np.zeros_like(self._home)
        self._powered = True
        self._replies = unit.replies()
        self._state = State.FINDING_BAUD
        self._heard = b""
        self._syncs = 0
        self._command = bytearray()
        self._stream = 0

    @property
    def state(self) -> State:
        """Where the arm's side of the conversation stands."""
        return self._state

    def check_reach(self, point_mm: Floats, direction: Floats | None) -> None:
        """Raise OutOfReachError unless the arm can hold its tip there: for the hand to ask before it tries."""
        self._mechanics.solve(point_mm, direction)

    def power_off(self) -> None:
        """Cut the power: the session is gone."""
        self._powered = False
        self._enter(wire.next_state(self._state, Event.POWER_LOST))

    def power_on(self) -> None:
        """Wake with the home counts loaded, wherever the stylus is. Raises OutOfReachError for an impossible hand."""
        self._powered = True
        self._load_home()

    def power_cycle(self) -> None:
        """Off and on. Raises OutOfReachError for an impossible hand."""
        self.power_off()
        self.power_on()

    # The device behind the listener

    def connect(self, connection: Connection) -> None:  # noqa: ARG002 - the arm doesn't notice who plugs in
        """A host plugs in."""
        if self.faults.strikes(Fault.OLD_SESSION):
            self._enter(State.SESSION)

    def disconnect(self, connection: Connection) -> None:
        """The host's cable is out; the arm doesn't notice, and its session lives on."""

    def receive(self, connection: Connection, data: bytes) -> None:
        """Take bytes, cut anywhere, and answer."""
        if self._powered and not self.faults.strikes(Fault.SILENT):
            self._send(connection, lambda: b"".join([self._take(byte, connection) for byte in data]))

    def _send(self, connection: Connection, answer: Callable[[], bytes]) -> None:
        try:
            connection.send(answer())
        except OutOfReachError as error:  # no position is better than a wrong one
            self.unreachable = error
            connection.hang_up()

    # Bytes

    def _take(self, byte: int, connection: Connection) -> bytes:
        if self._state not in _LIVE:
            return self._listen(byte)
        self._command.append(byte)
        if len(self._command) <= _arguments(self._command):
            return b""
        command, self._command = bytes(self._command), bytearray()
        return self._obey(command, connection)

    def _listen(self, byte: int) -> bytes:
        """Outside a session: words, and the end byte."""
        self._heard = (self._heard + bytes([byte]))[-len(wire.BEGIN) :]
        if byte == Code.END:
            self._state = wire.next_state(self._state, Event.END)
        elif self._heard.endswith(wire.SYNC):
            self._syncs += 1
            if self._syncs >= self._echo_after:
                self._state = wire.next_state(self._state, Event.SYNC)
                return wire.SYNC * (3 if self.faults.strikes(Fault.SURPLUS_ECHOES) else 1)
        elif self._heard == wire.BEGIN and self._state is State.SYNCED:
            self._enter(wire.next_state(self._state, Event.BEGIN))
            return (wire.INTERFACE_BOX if self.faults.strikes(Fault.INTERFACE_BOX) else wire.PRODUCT_ID) + b"\0"
        return b""

    def _obey(self, command: bytes, connection: Connection) -> bytes:
        """In a session: one whole command. Whatever it is, it ends a stream, but for the marker."""
        event = wire.event_of(command[0])
        state = wire.next_state(self._state, event)
        if event is Event.MARKER:
            return bytes([Code.MARKER]) + command[1:]
        self._enter(state)
        if event is Event.POLL:
            return self._packet(command[0] & ~wire.MARK)
        if event is Event.STREAM:
            return self._start_stream(command, connection)
        if event is Event.END:
            return bytes([Code.END])
        return self._configure(command)

    def _configure(self, command: bytes) -> bytes:
        """The reply to a configuration command; silence for what is not supported."""
        code = command[0] | wire.MARK
        self.eeprom_attempts += code in wire.FORBIDDEN
        if code == Code.HOME:
            self._load_home()
            return bytes([code])
        if code == Code.SET_BAUD:
            return bytes([code]) if command[1] in wire.BAUD_CODES.values() else b""
        reply = self._replies.get(code, b"")
        if code == Code.PARAMETERS and self.faults.strikes(Fault.BLOCK_LENGTH):
            return reply[:1] + bytes([conf.PARAMETER_BYTES - 2]) + reply[2:-2]
        return reply

    # Counts

    def _load_home(self) -> None:
        self._offset = self._home - np.rint(self._mechanics.counts(self.packets)).astype(np.int64)

    def _packet(self, command: int) -> bytes:
        if command not in range(wire.TIME_STAMP << 1) or command & wire.UNUSED:
            return b""
        self.packets += 1
        counts = [int(v) for v in encoded(np.rint(self._mechanics.counts(self.packets)) + self._offset)]
        ticks = int(self._clock.now() / wire.TICK_S) % wire.TICK_MODULUS if command & wire.TIME_STAMP else None
        analogs = (0,) * wire.analog_count(command)  # nothing is plugged in
        packet = Packet(
            command, self.buttons & self.unit.maxima.button_mask, tuple([*counts, 0][: wire.encoder_count(command)]), ticks, analogs
        )
        return self.faults.damage(wire.encode_packet(packet), self.packets)

    def _start_stream(self, command: bytes, connection: Connection) -> bytes:
        """Echo, and send at a fixed rate. A stream by differences is not supported: silence, and back in the session."""
        request = conf.decode_stream(bytes([Code.STREAM]) + command[1:])
        if not request.fixed_rate:
            self._enter(State.SESSION)
            return b""
        turn, period_s = self._stream, max(request.delay_ms / 1000.0, FASTEST_STREAM_S)

        def tick() -> None:
            if turn == self._stream:
                self._send(connection, lambda: self._packet(request.command & ~wire.MARK))
                connection.after(period_s, tick)

        connection.after(period_s, tick)
        return bytes([Code.STREAM])

    def _enter(self, state: State) -> None:
        """A state anew: nothing heard, no stream."""
        self._state = state
        self._heard = b""
        self._syncs = 0
        self._command = bytearray()
        self._stream += 1


def _arguments(command: bytearray) -> int:
    """How many bytes follow the first one; known for a stream once the command within it has come."""
    if not command[0] & wire.CONFIGURE:
        return 0
    code = command[0] | wire.MARK
    sevenfold = code == Code.STREAM and len(command) > 3 and wire.encoder_count(command[3]) == 7
    return wire.ARGUMENTS.get(code, 0) + (2 if sevenfold else 0)
