"""The other end of a MicroScribe's wire: firmware, encoders, pedals, cable and adapter, with their
faults.

What no document states is a choice of `Firmware`. The emulator never waits. Changes from outside
(``power_cycle``, ``faults``, ``buttons``) need the world's lock.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from instruments.clock import Clock
from instruments.listener import Connection
from instruments.microscribe import configuration as conf
from instruments.microscribe import protocol as wire
from instruments.microscribe.configuration import StreamRequest
from instruments.microscribe.faults import Fault, Faults
from instruments.microscribe.kinematics import COUNT_MODULUS, Floats, OutOfReachError
from instruments.microscribe.mechanics import Contacts, Hand, Mechanics
from instruments.microscribe.protocol import Code, Event, Packet, State
from instruments.microscribe.unit import ArmIdentity, shipped_unit

ACCURACY_MM = 0.23  # the maker's figure for a 3DX
TREMOR_MM = 0.05
# a stream makes up for ticks that came late, but not for an emulator that stood still
CATCH_UP_S = 0.1
FASTEST_BAUD = 115200  # no stream is faster than this carries it
_BITS_PER_BYTE = 10


class Look(NamedTuple):
    """What the arm sees of itself at one moment."""

    buttons: int
    counts: Sequence[int]


class Trigger:
    """Whether a stream by differences sends. A delta or mask bit of 0 leaves its encoder or pedal
    out; the analog channels are not connected and never differ. A pedal that comes up triggers too,
    and an encoder's difference is measured from the last packet.
    """

    def __init__(self, request: StreamRequest, first: Look) -> None:
        self._mask = request.button_mask
        self._deltas = request.encoder_deltas
        self._before = first.buttons
        self._from = first.counts

    def fires(self, now: Look) -> bool:
        """Whether a pedal changed since the last look, or an encoder by its delta."""
        changed = bool((now.buttons ^ self._before) & self._mask)
        self._before = now.buttons
        steps = [(a - b) % COUNT_MODULUS for a, b in zip(now.counts, self._from, strict=True)]
        fires = changed or any(
            delta and delta <= min(step, COUNT_MODULUS - step)  # the shorter way round
            for delta, step in zip(self._deltas, steps, strict=False)
        )
        if fires:
            self._from = now.counts
        return fires


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """A running stream of ``command``: packets, or with ``trigger`` looks, every ``period_s``."""

    command: int
    period_s: float
    trigger: Trigger | None


class Firmware:
    """The arm's side of the conversation: each byte received, and the answer to it.

    In a live session bit 7 of a command is ignored, so letters are commands; unsupported commands
    get no answer. ``rate`` is the arm's own, None while any will do.
    """

    def __init__(self, arm: ArmEmulator) -> None:
        self.state = State.FINDING_BAUD
        self.rate: int | None = None
        self.stream: Stream | None = None
        self.eeprom_attempts = 0
        self.packets = 0
        self._arm = arm
        self._button_mask = arm.unit.maxima.button_mask
        self._replies = arm.unit.replies()
        self._heard = b""
        self._syncs = 0
        self._command = bytearray()

    def enter(self, state: State) -> None:
        """A state anew: nothing received, no stream, and outside a session no rate."""
        self.state = state
        self.stream = None
        self._heard = b""
        self._syncs = 0
        self._command.clear()
        if state not in wire.LIVE:
            self.rate = None

    def take(self, byte: int, rate: int | None) -> bytes:
        """The answer to a byte at ``rate`` (None: unknown); empty while a command is cut."""
        if self.state not in wire.LIVE:
            return self._listen(byte, rate)
        self._command.append(byte)
        if len(self._command) <= _arguments(self._command):
            return b""
        command = bytes(self._command)
        self._command.clear()
        return self._obey(command)

    def packet(self, command: int, look: Look) -> bytes:
        """The answer to a data command; nothing for what isn't one."""
        if command & (wire.MARK | wire.CONFIGURE | wire.UNUSED):
            return b""
        self.packets += 1
        ticks = self._arm.ticks() if command & wire.TIME_STAMP else None
        analogs = (0,) * wire.analog_count(command)  # nothing is plugged in
        counts = (*look.counts, 0)[: wire.encoder_count(command)]
        buttons = look.buttons & self._button_mask
        return wire.encode_packet(Packet(command, buttons, counts, ticks, analogs))

    def _listen(self, byte: int, rate: int | None) -> bytes:
        """Outside a session: words, and the end byte."""
        self._heard = (self._heard + bytes([byte]))[-len(wire.BEGIN) :]
        faults = self._arm.faults
        if byte == Code.END:
            self.state = wire.next_state(self.state, Event.END)
        elif self._heard.endswith(wire.SYNC):
            self._syncs += 1
            if faults.on(Fault.LATE_ECHO) and self._syncs < faults.amount(Fault.LATE_ECHO):
                return b""
            self.state = wire.next_state(self.state, Event.SYNC)
            self.rate = rate
            return wire.SYNC * (3 if faults.strikes(Fault.SURPLUS_ECHOES) else 1)
        elif self._heard == wire.BEGIN and self.state is State.SYNCED:
            self.enter(wire.next_state(self.state, Event.BEGIN))
            box = faults.strikes(Fault.INTERFACE_BOX)
            return (wire.INTERFACE_BOX if box else wire.PRODUCT_ID) + b"\0"
        return b""

    def _obey(self, command: bytes) -> bytes:
        """In a session: one whole command. Whatever it is, it ends a stream, but for the marker."""
        event = wire.event_of(command[0])
        state = wire.next_state(self.state, event)
        if event is Event.MARKER:
            return bytes([Code.MARKER]) + command[1:]
        self.enter(state)
        if event is Event.POLL:
            return self.packet(command[0] & ~wire.MARK, self._arm.look())
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
            self._arm.load_home()
            return bytes([code])
        if code == Code.SET_BAUD:
            rates = [rate for rate, number in wire.BAUD_CODES.items() if number == command[1]]
            # from the next byte on: the echo comes at the old rate
            self.rate = rates[0] if rates else self.rate
            return bytes([code]) if rates else b""
        reply = self._replies.get(code, b"")
        if code == Code.PARAMETERS and self._arm.faults.strikes(Fault.BLOCK_LENGTH):
            return reply[:1] + bytes([conf.PARAMETER_BYTES - 2]) + reply[2:-2]
        return reply

    def _start(self, request: StreamRequest) -> bytes:
        """Echo; what follows is for whoever keeps the time to ask for."""
        command = request.command & ~wire.MARK
        wire_s = (1 + wire.payload_length(command)) * _BITS_PER_BYTE / FASTEST_BAUD
        trigger = None if request.fixed_rate else Trigger(request, self._arm.look())
        self.stream = Stream(command, max(request.delay_ms / 1000.0, wire_s), trigger)
        return bytes([Code.STREAM])


def _arguments(command: bytearray) -> int:
    """How many bytes follow the first; a stream's depends on the command within it."""
    if not command[0] & wire.CONFIGURE:
        return 0
    code = command[0] | wire.MARK
    sevenfold = code == Code.STREAM and len(command) > 3 and wire.encoder_count(command[3]) == 7
    return wire.ARGUMENTS.get(code, 0) + (2 if sevenfold else 0)


class ArmEmulator:
    """An arm in a hand, switched on with its stylus on the peg.

    ``unreachable``: why it hung up on an impossible pose. Raises ValueError for a ``unit`` whose
    tip never comes above the table.
    """

    def __init__(
        self,
        hand: Hand,
        clock: Clock,
        *,
        unit: ArmIdentity | None = None,
        seed: int = 0,
        accuracy_mm: float = ACCURACY_MM,
        tremor_mm: float = TREMOR_MM,
    ) -> None:
        self.unit = unit or shipped_unit("40937")
        self.faults = Faults(seed, self._fault_changed)
        self.unreachable: OutOfReachError | None = None
        home = self.unit.home
        self._firmware = Firmware(self)
        geometry = self.unit.geometry()
        self._mechanics = Mechanics(
            geometry, home, hand, seed=seed, accuracy_mm=accuracy_mm, tremor_mm=tremor_mm
        )
        self._contacts = Contacts(seed)
        self._clock = clock
        self._looks = 0
        self._runs = 0
        self._offset = [0] * len(home)
        self._powered = True
        self._sent_until_s = 0.0

    @property
    def state(self) -> State:
        """Where the arm's side of the conversation stands."""
        return self._firmware.state

    @property
    def packets(self) -> int:
        """How many were sent."""
        return self._firmware.packets

    @property
    def eeprom_attempts(self) -> int:
        """How often a write to the EEPROM was asked for: no driver ever should."""
        return self._firmware.eeprom_attempts

    @property
    def buttons(self) -> int:
        """The pedals that are pressed: bit 0 the single or right one, bit 1 the left one."""
        return self._contacts.meant

    @buttons.setter
    def buttons(self, pressed: int) -> None:
        bounce_s = self.faults.amount_now(Fault.PEDAL_BOUNCE)
        self._contacts.move(pressed, self._clock.now(), bounce_s)

    def check_reach(self, point_mm: Floats, direction: Floats | None) -> None:
        """Raise OutOfReachError unless the arm can hold its tip there."""
        self._mechanics.solve(point_mm, direction)

    def power_off(self) -> None:
        """Cut the power: the session is gone."""
        self._powered = False
        self._firmware.enter(wire.next_state(self.state, Event.POWER_LOST))

    def power_on(self) -> None:
        """Start with the home counts, wherever the stylus is. Raises OutOfReachError."""
        self._powered = True
        self.load_home()
        self._displace()

    def power_cycle(self) -> None:
        """Off and on. Raises OutOfReachError for an impossible hand."""
        self.power_off()
        self.power_on()

    def _fault_changed(self, fault: Fault, on: bool) -> None:
        if fault is Fault.POWER_LOSS:
            (self.power_off if on else self.power_on)()
        elif fault is Fault.NEVER_HOMED:
            self._displace()

    # The body behind the firmware

    def look(self) -> Look:
        """Pedals and encoders at this moment. Raises OutOfReachError for an impossible hand."""
        self._looks += 1
        counts = zip(self._mechanics.counts(self._looks), self._offset, strict=True)
        return Look(
            self._contacts.at(self._clock.now(), self._looks),
            [(count + offset) % COUNT_MODULUS for count, offset in counts],
        )

    def load_home(self) -> None:
        """Show the home counts, wherever the stylus is. Raises OutOfReachError."""
        counts = self._mechanics.counts(self._looks)
        self._offset = [home - count for home, count in zip(self.unit.home, counts, strict=True)]

    def ticks(self) -> int:
        """The time stamp of this moment."""
        return int(self._clock.now() / wire.TICK_S) % wire.TICK_MODULUS

    def _displace(self) -> None:
        """The arm wakes with its stylus off the peg, where that is its fault."""
        if self.faults.strikes(Fault.NEVER_HOMED):
            displaced = self.faults.displacement(len(self._offset))
            self._offset = [a + b for a, b in zip(self._offset, displaced, strict=True)]

    # The device behind the listener

    def connect(self, connection: Connection) -> None:
        """A host plugs in. The arm doesn't notice; what another host left behind is still there."""
        self._sent_until_s = 0.0
        if self._powered and self.faults.strikes(Fault.OLD_SESSION):
            self._firmware.enter(State.SESSION)
        known = connection.baud() is not None
        if self._powered and known and self.faults.strikes(Fault.WRONG_BAUD):
            self._firmware.enter(State.SESSION)
            self._firmware.rate = int(self.faults.amount(Fault.WRONG_BAUD))
        if self._firmware.stream:
            self._run(self._firmware.stream, connection)

    def disconnect(self, connection: Connection) -> None:
        """The host's cable is out; the arm doesn't notice, and its session lives on."""

    def receive(self, connection: Connection, data: bytes) -> None:
        """Take bytes, cut anywhere, and answer."""
        if not self._powered or self.faults.strikes(Fault.SILENT):
            return
        rate = connection.baud()
        if (
            self.faults.strikes(Fault.WRONG_BAUD)  # where the host's rate is unknown
            if rate is None
            else self._firmware.rate not in (None, rate)
        ):
            self._put(connection, self.faults.noise(len(data)))
            return
        before = self._firmware.stream
        data = self.faults.mislay(data)
        take, damage = self._firmware.take, self.faults.damage
        self._send(connection, lambda: b"".join([damage(take(byte, rate)) for byte in data]))
        stream = self._firmware.stream
        if stream is not None and stream is not before:
            self._run(stream, connection)

    def _run(self, stream: Stream, connection: Connection) -> None:
        """Send the stream by absolute times, no faster than the line, until another command or
        host.
        """
        self._runs += 1
        run, due_s = self._runs, self._clock.now() + stream.period_s

        def tick() -> None:
            nonlocal due_s
            if self._firmware.stream is not stream or self._runs != run:
                return
            self._send(connection, lambda: self._streamed(stream))
            now = self._clock.now()
            due_s = max(due_s + stream.period_s, now - CATCH_UP_S)
            connection.after(max(0.0, due_s - now, connection.busy_s() - stream.period_s), tick)

        connection.after(stream.period_s, tick)

    def _streamed(self, stream: Stream) -> bytes:
        look = self.look()
        fires = stream.trigger is None or stream.trigger.fires(look)
        return self.faults.damage(self._firmware.packet(stream.command, look)) if fires else b""

    # Adapter and cable

    def _send(self, connection: Connection, answer: Callable[[], bytes]) -> None:
        try:
            self._put(connection, answer())
        except OutOfReachError as error:  # no position is better than a wrong one
            self.unreachable = error
            connection.hang_up()

    def _put(self, connection: Connection, data: bytes) -> None:
        """As late as the adapter is slow, in order, and up to where the cable breaks."""
        data, broken = self.faults.cut(data)
        if not data and not broken:
            return

        def arrive() -> None:
            connection.send(data)
            if broken:
                connection.hang_up()

        now = self._clock.now()
        late_s = self.faults.amount_now(Fault.SLOW_ADAPTER)
        self._sent_until_s = max(self._sent_until_s, now + late_s)
        if self._sent_until_s > now:
            connection.after(self._sent_until_s - now, arrive)
        else:
            arrive()
