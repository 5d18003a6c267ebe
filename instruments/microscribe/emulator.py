"""The other end of a MicroScribe's wire: firmware, joints, pedals, cable and adapter, with their
faults.

What no document states is a choice made here. The emulator never waits. Changes from outside
(``power_cycle``, ``faults``, ``buttons``) need the world's lock. Chance comes from the seed and the
packet's number.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import NamedTuple, Protocol

import numpy as np

from instruments.clock import Clock
from instruments.listener import Connection
from instruments.microscribe import configuration as conf
from instruments.microscribe import protocol as wire
from instruments.microscribe.configuration import StreamRequest
from instruments.microscribe.faults import ArmFault, Faults
from instruments.microscribe.kinematics import (
    COUNT_MODULUS,
    JOINTS,
    RANGES_RAD,
    ArmGeometry,
    Floats,
    OutOfReachError,
    inverse,
)
from instruments.microscribe.protocol import Code, Event, Packet, State
from instruments.microscribe.unit import ArmIdentity, shipped_unit

ACCURACY_MM = 0.23  # the maker's figure for a 3DX
TREMOR_MM = 0.05
# a stream makes up for ticks that came late, but not for an emulator that stood still
CATCH_UP_S = 0.1
FASTEST_BAUD = 115200  # no stream is faster than this carries it
_BITS_PER_BYTE = 10
_POSES = 4000
_BLOCK = 1024  # packets whose tremor is drawn at once
_AT_ONCE = 64  # of them, whose counts are worked out at once
_ON_PEG = (0,) * JOINTS  # no offset: the arm was switched on with its stylus there
_PARAMETERS, _TREMOR, _CONTACTS = 0, 1, 3  # streams of chance; 2 is that of the faults


class Hand(Protocol):
    """What holds the stylus."""

    def arm_target(self) -> tuple[Floats, Floats | None] | None:
        """Tip (3,) mm in the arm's frame and direction (3,) up the stylus; None: on the peg."""


class EncoderSample(NamedTuple):
    """Pedals and encoders at one moment."""

    buttons: int
    counts: Sequence[int]


class KinematicError:
    """The tip's distance from where the counts say, as a smooth function of the pose,
    ``accuracy_mm`` in the mean. Joint 0 stays true and the mean is removed, since both would be
    another frame.
    """

    def __init__(
        self, geometry: ArmGeometry, home_rad: Floats, *, seed: int, accuracy_mm: float
    ) -> None:
        chance = np.random.default_rng([seed, _PARAMETERS])
        later = np.arange(JOINTS) > 0
        self.stored = geometry
        self._real = dataclasses.replace(
            geometry,
            alpha_rad=geometry.alpha_rad + later * chance.normal(0.0, 3e-4, JOINTS),
            a_mm=geometry.a_mm + later * chance.normal(0.0, 0.1, JOINTS),
            d_mm=geometry.d_mm + later * chance.normal(0.0, 0.1, JOINTS),
        )
        self._zeros_rad = later * geometry.active * chance.normal(0.0, 5e-4, JOINTS)
        poses = workspace(geometry, home_rad, chance)
        if not len(poses):
            what = "this arm's tip never comes above the table that it stands on"
            raise ValueError(f"{what}: check its parameters and home counts")
        raw = self._raw(poses)
        self._mean = raw.mean(axis=0)
        self._scale = accuracy_mm / float(np.linalg.norm(raw - self._mean, axis=1).mean())

    def at(self, angles_rad: Floats) -> Floats:
        """Error of the tip (n, 3) mm at joint angles (n, 6) rad."""
        error: Floats = self._scale * (self._raw(angles_rad) - self._mean)
        return error

    def _raw(self, angles_rad: Floats) -> Floats:
        _, real = self._real.frames(angles_rad + self._zeros_rad)
        _, stored = self.stored.frames(angles_rad)
        return real[:, -1] - stored[:, -1]


_error_of = lru_cache(maxsize=8)(KinematicError)


def workspace(geometry: ArmGeometry, home_rad: Floats, chance: np.random.Generator) -> Floats:
    """Poses (n, 6) rad spread over the joint ranges whose tip is above the table."""
    turned = chance.uniform(RANGES_RAD[:, 0], RANGES_RAD[:, 1], (_POSES, JOINTS))
    poses = home_rad + turned * geometry.active
    tips, _ = geometry.forward_angles(poses)
    return poses[tips[:, 2] > 0.0]


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """Counts that are not rounded, and the least joint motion that moves the tip."""

    counts: Floats  # (6,)
    counts_per_mm: Floats  # (6, 3)


@lru_cache(maxsize=1024)  # a target is tried, then touched, and again in each cycle of a script
def _solved(error: KinematicError, home: tuple[int, ...], *at: float) -> Pose:
    geometry = error.stored
    counts = inverse(geometry, at[:3], at[3:] or None, start=home)
    goal = np.array(at[:3]) + error.at(geometry.angles(counts))[0]
    # a step of a fraction of a millimetre: Newton is exact to 1e-9 mm after three
    for _ in range(3):
        tip, counts_per_mm = _tip_at(geometry, counts)
        counts = counts + counts_per_mm @ (goal - tip)
    return Pose(counts, _tip_at(geometry, counts)[1])


def _tip_at(geometry: ArmGeometry, counts: Floats) -> tuple[Floats, Floats]:
    """The tip (3,) mm, and the least motion of the counts that moves it, (6, 3) by mm."""
    angles = geometry.angles(counts)
    _, origins = geometry.frames(angles)
    per_rad = geometry.turns / (2.0 * np.pi)
    return origins[0, -1], np.linalg.pinv(geometry.jacobian(angles)[0, :3]) * per_rad[:, None]


class Mechanics:
    """One arm's joints in a hand. ``home`` (6,): counts on the peg; ``accuracy_mm``: mean error;
    ``tremor_mm``: the tip's rms distance from its target.
    """

    def __init__(
        self,
        geometry: ArmGeometry,
        home: tuple[int, ...],
        hand: Hand,
        *,
        seed: int,
        accuracy_mm: float,
        tremor_mm: float,
    ) -> None:
        self._home = home
        self._hand = hand
        self._seed = seed
        self._tremor_mm = tremor_mm
        home_rad = tuple(geometry.angles(home)[0].tolist())
        self._error = _error_of(geometry, home_rad, seed=seed, accuracy_mm=accuracy_mm)
        self._held: tuple[bytes, Pose] | None = None
        self._part: tuple[Pose, int, tuple[int, ...], list[list[int]]] | None = None
        self._shaken: tuple[int, Floats] = -1, np.empty((0, 3))

    def counts(self, packet: int, offset: tuple[int, ...] = _ON_PEG) -> Sequence[int]:
        """Counts (6,) of a packet from ``offset`` on. Raises OutOfReachError."""
        target = self._hand.arm_target()
        if target is None:
            return [sum(both) % COUNT_MODULUS for both in zip(self._home, offset, strict=True)]
        point_mm, direction = target
        key = point_mm.tobytes() + (b"" if direction is None else direction.tobytes())
        if self._held is None or self._held[0] != key:
            self._held = key, self.solve(point_mm, direction)
        pose = self._held[1]
        part, row = divmod(packet, _AT_ONCE)
        if self._part is None or self._part[:3] != (pose, part, offset):
            block, first = divmod(part * _AT_ONCE, _BLOCK)
            if self._shaken[0] != block:
                self._shaken = block, self.tremor(block)
            off_mm = self._shaken[1][first : first + _AT_ONCE]
            counts = np.rint(pose.counts + off_mm @ pose.counts_per_mm.T)
            whole = (counts.astype(np.int64) + offset) % COUNT_MODULUS
            self._part = pose, part, offset, whole.tolist()
        return self._part[3][row]

    def solve(self, point_mm: Floats, direction: Floats | None) -> Pose:
        """The pose for this target, the arm's inaccuracy included. Raises OutOfReachError."""
        up = () if direction is None else direction.tolist()
        return _solved(self._error, tuple(self._home), *point_mm.tolist(), *up)

    def tremor(self, block: int) -> Floats:
        """How far the hand is off at each packet of a block, (n, 3) mm."""
        chance = np.random.default_rng([self._seed, _TREMOR, block])
        return chance.normal(0.0, self._tremor_mm / np.sqrt(3.0), (_BLOCK, 3))


class Stream:
    """A running stream: a packet every ``period_s``, by differences only when it `fires`. A delta
    or mask bit of 0 leaves its encoder or pedal out.
    """

    def __init__(self, request: StreamRequest, look: EncoderSample | None) -> None:
        self.command = request.command & ~wire.MARK
        wire_s = (1 + wire.payload_length(self.command)) * _BITS_PER_BYTE / FASTEST_BAUD
        self.period_s = max(request.delay_ms / 1000.0, wire_s)
        self._request = request
        self._last = look

    def fires(self, now: EncoderSample) -> bool:
        """Whether a pedal changed since the last look, or an encoder by its delta."""
        if self._last is None:
            return True
        before, counts = self._last
        steps = [(a - b) % COUNT_MODULUS for a, b in zip(now.counts, counts, strict=True)]
        fires = bool((now.buttons ^ before) & self._request.button_mask) or any(
            delta and delta <= min(step, COUNT_MODULUS - step)  # the shorter way round
            for delta, step in zip(self._request.encoder_deltas, steps, strict=False)
        )
        self._last = EncoderSample(now.buttons, now.counts if fires else counts)
        return fires


class ArmEmulator:
    """An arm in a hand, switched on with its stylus on the peg. ``eeprom_attempts``: writes that
    were asked for; ``unreachable``: why it hung up on an impossible pose. Raises ValueError for a
    ``unit`` whose tip never comes above the table.
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
        self.state = State.FINDING_BAUD
        self.packets = self.eeprom_attempts = 0
        self.unreachable: OutOfReachError | None = None
        self._button_mask = self.unit.maxima.button_mask
        self._replies = self.unit.replies()
        self._words = self._command = b""
        self._syncs = 0
        self._rate: int | None = None  # the arm's own; None while any will do
        self._stream: Stream | None = None
        geometry, home = self.unit.geometry(), self.unit.home
        self._mechanics = Mechanics(
            geometry, home, hand, seed=seed, accuracy_mm=accuracy_mm, tremor_mm=tremor_mm
        )
        self._clock = clock
        self._seed = seed
        self._pressed = self._pressed_before = self._presses = 0
        self._settled_s = 0.0
        self._looks = 0
        self._runs = 0
        self._offset = _ON_PEG
        self._powered = True
        self._sent_until_s = 0.0

    @property
    def buttons(self) -> int:
        """The pedals that are pressed: bit 0 the single or right one, bit 1 the left one."""
        return self._pressed

    @buttons.setter
    def buttons(self, pressed: int) -> None:
        self._pressed_before, self._pressed = self._pressed, pressed
        bounces_s = self.faults.amount_now(ArmFault.PEDAL_BOUNCE)
        self._settled_s = self._clock.now() + bounces_s if bounces_s else 0.0
        self._presses += 1

    def check_reach(self, point_mm: Floats, direction: Floats | None) -> None:
        """Raise OutOfReachError unless the arm can hold its tip there."""
        self._mechanics.solve(point_mm, direction)

    def power_off(self) -> None:
        """Cut the power: the session is gone."""
        self._powered = False
        self._enter(wire.next_state(self.state, Event.POWER_LOST))

    def power_on(self) -> None:
        """Start with the home counts, wherever the stylus is. Raises OutOfReachError."""
        self._powered = True
        self._load_home()
        self._start_off_peg()

    def power_cycle(self) -> None:
        """Off and on. Raises OutOfReachError for an impossible hand."""
        self.power_off()
        self.power_on()

    def _fault_changed(self, fault: ArmFault, on: bool) -> None:
        if fault is ArmFault.POWER_LOSS:
            (self.power_off if on else self.power_on)()
        elif fault is ArmFault.NEVER_HOMED:
            self._start_off_peg()

    # The firmware. In a live session bit 7 of a command is ignored, so letters are commands;
    # unsupported commands get no answer.

    def _enter(self, state: State) -> None:
        """A state anew: nothing received, no stream, and outside a session no rate."""
        self.state = state
        self._stream = None
        self._words = self._command = b""
        self._syncs = 0
        if state not in wire.LIVE:
            self._rate = None

    def _take(self, byte: int, rate: int | None) -> bytes:
        """The answer to a byte at ``rate`` (None: unknown); empty while a command is cut."""
        if self.state not in wire.LIVE:
            return self._outside_session(byte, rate)
        command = self._command + bytes([byte])
        if command[0] & wire.CONFIGURE:
            code = command[0] | wire.MARK
            sevenfold = len(command) > 3 and wire.encoder_count(command[3]) == 7
            more = 2 if code == Code.STREAM and sevenfold else 0
            if len(command) <= wire.ARGUMENTS.get(code, 0) + more:
                self._command = command
                return b""
        self._command = b""
        # In a session: one whole command. Whatever it is, it ends a stream, but for the marker.
        event = wire.event_of(command[0])
        state = wire.next_state(self.state, event)
        if event is Event.MARKER:
            return bytes([Code.MARKER]) + command[1:]
        self._enter(state)
        if event is Event.POLL:
            return self._packet(command[0] & ~wire.MARK, self._look())
        if event is Event.STREAM:
            request = conf.decode_stream(bytes([Code.STREAM]) + command[1:])
            self._stream = Stream(request, None if request.fixed_rate else self._look())
            return bytes([Code.STREAM])
        if event is Event.END:
            return bytes([Code.END])
        return self._configure(command)

    def _packet(self, command: int, look: EncoderSample) -> bytes:
        """The answer to a data command; nothing for what isn't one."""
        if command & (wire.MARK | wire.CONFIGURE | wire.UNUSED):
            return b""
        self.packets += 1
        encoders, channels, stamped = wire.PARTS[command]
        ticks = int(self._clock.now() / wire.TICK_S) % wire.TICK_MODULUS if stamped else None
        analogs = (0,) * channels  # nothing is plugged in
        counts = (*look.counts, 0)[:encoders]
        buttons = look.buttons & self._button_mask
        return wire.encode_packet(Packet(command, buttons, counts, ticks, analogs))

    def _outside_session(self, byte: int, rate: int | None) -> bytes:
        """Words, and the end byte."""
        self._words = (self._words + bytes([byte]))[-len(wire.BEGIN) :]
        faults = self.faults
        if byte == Code.END:
            self.state = wire.next_state(self.state, Event.END)
        elif self._words.endswith(wire.SYNC):
            self._syncs += 1
            if faults.on(ArmFault.LATE_ECHO) and self._syncs < faults.amount(ArmFault.LATE_ECHO):
                return b""
            self.state = wire.next_state(self.state, Event.SYNC)
            self._rate = rate
            return wire.SYNC * (3 if faults.strikes(ArmFault.SURPLUS_ECHOES) else 1)
        elif self._words == wire.BEGIN and self.state is State.SYNCED:
            self._enter(wire.next_state(self.state, Event.BEGIN))
            box = faults.strikes(ArmFault.INTERFACE_BOX)
            return (wire.INTERFACE_BOX if box else wire.PRODUCT_ID) + b"\0"
        return b""

    def _configure(self, command: bytes) -> bytes:
        """The reply to a configuration command; silence for what is not supported."""
        code = command[0] | wire.MARK
        self.eeprom_attempts += code in wire.FORBIDDEN
        if code == Code.HOME:
            self._load_home()
            return bytes([code])
        if code == Code.SET_BAUD:
            rates = [rate for rate, number in wire.BAUD_CODES.items() if number == command[1]]
            # from the next byte on: the echo comes at the old rate
            self._rate = rates[0] if rates else self._rate
            return bytes([code]) if rates else b""
        reply = self._replies.get(code, b"")
        if code == Code.PARAMETERS and self.faults.strikes(ArmFault.BLOCK_LENGTH):
            return reply[:1] + bytes([conf.PARAMETER_BYTES - 2]) + reply[2:-2]
        return reply

    # Pedals and encoders

    def _look(self) -> EncoderSample:
        """Pedals and encoders at this moment. Raises OutOfReachError for an impossible hand."""
        self._looks += 1
        buttons = self._pressed
        if self._settled_s and self._clock.now() < self._settled_s:  # bouncing, it shows either
            chance = np.random.default_rng([self._seed, _CONTACTS, self._presses, self._looks])
            buttons = self._pressed_before if chance.random() < 0.5 else buttons
        return EncoderSample(buttons, self._mechanics.counts(self._looks, self._offset))

    def _load_home(self) -> None:
        """Show the home counts, wherever the stylus is. Raises OutOfReachError."""
        counts = self._mechanics.counts(self._looks)
        self._offset = tuple(a - b for a, b in zip(self.unit.home, counts, strict=True))

    def _start_off_peg(self) -> None:
        """Count from a place off the peg, where that fault is on."""
        if self.faults.strikes(ArmFault.NEVER_HOMED):
            displaced = self.faults.displacement(len(self._offset))
            self._offset = tuple(a + b for a, b in zip(self._offset, displaced, strict=True))

    # The device behind the listener

    def connect(self, connection: Connection) -> None:
        """A host plugs in. The arm keeps the state in which another host left it."""
        self._sent_until_s = 0.0
        if self._powered and self.faults.strikes(ArmFault.OLD_SESSION):
            self._enter(State.SESSION)
        known = connection.baud() is not None
        if self._powered and known and self.faults.strikes(ArmFault.WRONG_BAUD):
            self._enter(State.SESSION)
            self._rate = int(self.faults.amount(ArmFault.WRONG_BAUD))
        if self._stream:
            self._run(self._stream, connection)

    def disconnect(self, connection: Connection) -> None:
        """The host has gone. The arm keeps its session."""

    def receive(self, connection: Connection, data: bytes) -> None:
        """Take bytes, cut anywhere, and answer."""
        faults = self.faults
        if not self._powered or (faults.left and faults.strikes(ArmFault.SILENT)):
            return
        rate = connection.baud()
        if (
            faults.left and faults.strikes(ArmFault.WRONG_BAUD)  # the host's rate is unknown
            if rate is None
            else self._rate not in (None, rate)
        ):
            self._put(connection, faults.noise(len(data)))
            return
        before = self._stream
        take, damage = self._take, faults.damage
        try:
            answer = b"".join([damage(take(byte, rate)) for byte in faults.lose_byte(data)])
        except OutOfReachError as error:
            self._hang_up(connection, error)
        else:
            self._put(connection, answer)
        stream = self._stream
        if stream is not None and stream is not before:
            self._run(stream, connection)

    def _run(self, stream: Stream, connection: Connection) -> None:
        """Send the stream by absolute times until another command or host."""
        self._runs += 1
        run, due_s = self._runs, self._clock.now() + stream.period_s

        def tick() -> None:
            nonlocal due_s
            if self._stream is not stream or self._runs != run:
                return
            try:
                look = self._look()
            except OutOfReachError as error:
                self._hang_up(connection, error)
            else:
                if stream.fires(look):
                    packet = self._packet(stream.command, look)
                    self._put(connection, self.faults.damage(packet))
            now = self._clock.now()
            due_s = max(due_s + stream.period_s, now - CATCH_UP_S)
            connection.after(max(0.0, due_s - now, connection.busy_s() - stream.period_s), tick)

        connection.after(stream.period_s, tick)

    # Adapter and cable

    def _hang_up(self, connection: Connection, error: OutOfReachError) -> None:
        """End the link of an arm whose hand is out of reach: it has no right position."""
        self.unreachable = error
        connection.hang_up()

    def _put(self, connection: Connection, data: bytes) -> None:
        """As late as the adapter is slow, in order, and up to where the cable breaks."""
        if not self.faults.left and not self._sent_until_s:
            connection.send(data)
            return
        data, broken = self.faults.cut(data)
        if not data and not broken:
            return
        late_s, now = self.faults.amount_now(ArmFault.SLOW_ADAPTER), self._clock.now()
        arrives_s = max(self._sent_until_s, now + late_s)
        if arrives_s <= now:
            self._arrive(connection, data, broken)
            return
        self._sent_until_s = arrives_s
        connection.after(arrives_s - now, partial(self._arrive, connection, data, broken))

    @staticmethod
    def _arrive(connection: Connection, data: bytes, broken: bool) -> None:
        connection.send(data)
        if broken:
            connection.hang_up()
