"""The other end of a MicroScribe's wire: firmware, encoders, pedals, cable and adapter, with their
faults.

It never waits. Changes from outside (``power_cycle``, ``faults``, ``buttons``) need the world's
lock.
"""

from __future__ import annotations

from collections.abc import Callable

from instruments.clock import Clock
from instruments.listener import Connection
from instruments.microscribe import protocol as wire
from instruments.microscribe.faults import Fault, Faults
from instruments.microscribe.firmware import Firmware, Look, Stream, UnspecifiedBehaviour
from instruments.microscribe.kinematics import COUNT_MODULUS, Floats, OutOfReachError
from instruments.microscribe.mechanics import Contacts, Hand, Mechanics
from instruments.microscribe.protocol import Event, State
from instruments.microscribe.unit import ArmIdentity, shipped_unit

ACCURACY_MM = 0.23  # the maker's figure for a 3DX
TREMOR_MM = 0.05
# a stream makes up for ticks that came late, but not for an emulator that stood still
CATCH_UP_S = 0.1


class ArmEmulator:
    """An arm in a hand, switched on with its stylus on the peg.

    ``echo_after``: how many IMMC it needs. ``unreachable``: why it hung up on an impossible pose.
    Raises ValueError for a ``unit`` whose tip never comes above the table.
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
        echo_after: int = 1,
        habits: UnspecifiedBehaviour | None = None,
    ) -> None:
        self.unit = unit or shipped_unit("40937")
        self.faults = Faults(seed, self._fault_came_or_went)
        self.unreachable: OutOfReachError | None = None
        home = self.unit.home
        self._firmware = Firmware(
            self.unit, self, self.faults, habits or UnspecifiedBehaviour(), echo_after
        )
        self._mechanics = Mechanics(
            self.unit.geometry(),
            home,
            hand,
            seed=seed,
            accuracy_mm=accuracy_mm,
            tremor_mm=tremor_mm,
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
        bounce_s = (
            self.faults.amount(Fault.PEDAL_BOUNCE)
            if self.faults.strikes(Fault.PEDAL_BOUNCE)
            else 0.0
        )
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

    def _fault_came_or_went(self, fault: Fault, came: bool) -> None:
        if fault is Fault.POWER_LOSS:
            (self.power_off if came else self.power_on)()
        elif fault is Fault.NEVER_HOMED:
            self._displace()

    # The body behind the firmware

    def look(self) -> Look:
        """Pedals and encoders at this moment. Raises OutOfReachError for an impossible hand."""
        self._looks += 1
        counts = self._mechanics.whole(self._looks)
        shown = tuple(
            [
                (count + offset) % COUNT_MODULUS
                for count, offset in zip(counts, self._offset, strict=True)
            ]
        )
        return Look(self._contacts.at(self._clock.now(), self._looks), shown)

    def load_home(self) -> None:
        """Show the home counts, wherever the stylus is. Raises OutOfReachError."""
        counts = self._mechanics.whole(self._looks)
        self._offset = [home - count for home, count in zip(self.unit.home, counts, strict=True)]

    def ticks(self) -> int:
        """The time stamp of this moment."""
        return int(self._clock.now() / wire.TICK_S) % wire.TICK_MODULUS

    def _displace(self) -> None:
        """The arm wakes with its stylus off the peg, where that is its fault."""
        if not self.faults.strikes(Fault.NEVER_HOMED):
            return
        displaced = self.faults.displacement(len(self._offset))
        self._offset = [offset + by for offset, by in zip(self._offset, displaced, strict=True)]

    # The device behind the listener

    def connect(self, connection: Connection) -> None:
        """A host plugs in. The arm doesn't notice; what another host left behind is still there."""
        self._sent_until_s = 0.0
        if self._powered and self.faults.strikes(Fault.OLD_SESSION):
            self._firmware.enter(State.SESSION)
        if (
            self._powered
            and connection.baud() is not None
            and self.faults.strikes(Fault.WRONG_BAUD)
        ):
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
        if self._garbled(rate):
            self._put(connection, self.faults.noise(len(data)))
            return
        before = self._firmware.stream
        heard = self.faults.mislay(data)
        self._send(
            connection,
            lambda: b"".join(
                [self.faults.damage(self._firmware.take(byte, rate)) for byte in heard]
            ),
        )
        stream = self._firmware.stream
        if stream is not None and stream is not before:
            self._run(stream, connection)

    def _garbled(self, rate: int | None) -> bool:
        """Whether rates differ; where the host's is unknown, a fault says so."""
        if rate is None:
            return self.faults.strikes(Fault.WRONG_BAUD)
        return self._firmware.rate not in (None, rate)

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

        def out() -> None:
            connection.send(data)
            if broken:
                connection.hang_up()

        now = self._clock.now()
        late_s = (
            self.faults.amount(Fault.SLOW_ADAPTER)
            if self.faults.strikes(Fault.SLOW_ADAPTER)
            else 0.0
        )
        self._sent_until_s = max(self._sent_until_s, now + late_s)
        if self._sent_until_s > now:
            connection.after(self._sent_until_s - now, out)
        else:
            out()
