"""The emulated relay of a pump: a Modbus server of its own, whose row ``pump`` switches the plant's
pump.

It is another device than the controller, with another power supply: what happens to one tells
nothing of the other. It may not know which controller heats, nor whether there is water.
"""

from __future__ import annotations

import math

from instruments.bath.address_space import Cells
from instruments.bath.controller_behaviour import Manners
from instruments.bath.emulator import WIRE_FAULTS, Framing, Server, framing_of
from instruments.bath.profile import RelayProfile
from instruments.bath.registers import Order, Row
from instruments.clock import Clock
from instruments.listener import Connection
from instruments.world.plant import Plant

PUMP = "pump"
POWER_CUT = "power cut"
RELAY_FAULTS = (*WIRE_FAULTS, POWER_CUT)


class Contacts:
    """What the relay's rows hold: ``pump`` is the plant's switch, any other contact switches
    nothing here.
    """

    decimals = 0

    def __init__(self, plant: Plant, profile: RelayProfile) -> None:
        self.order: Order = profile.order
        self._plant = plant
        self._memory: dict[str, float] = {}

    def words(self, row: Row) -> tuple[int, ...]:
        """The registers, or the bit, that say the row's value."""
        return row.encode(self.number(row), self.order)

    def number(self, row: Row) -> float:
        """What the row shows."""
        if row.name == PUMP:
            return float(row.values["on" if self._plant.pump == "on" else "off"])
        return self._memory.get(row.name, 0.0)

    def refuses(self, row: Row, value: float) -> bool:
        """Whether the row does not take ``value``."""
        return row.refusal(value) is not None

    def take(self, row: Row, value: float) -> None:
        """Switch."""
        if row.name == PUMP:
            self._plant.pump = "on" if value == row.values["on"] else "off"
        else:
            self._memory[row.name] = value

    def fall(self) -> None:
        """Every contact opens: a relay holds by its coil."""
        self._memory.clear()
        self._plant.pump = "off"


class RelayEmulator:
    """Switches the pump of ``plant``, which stands at first. Other unit ids get no answer.

    ``framing`` as for the bath. The fault "power cut" opens the contact, and the relay is silent
    until it is mended; faults of the wire: `server`. ``late_s`` is how long a late answer takes.
    Raises ValueError for a framing that is none.
    """

    def __init__(
        self,
        plant: Plant,
        profile: RelayProfile,
        clock: Clock,
        *,
        unit_id: int | None = None,
        framing: Framing | None = None,
    ) -> None:
        self.plant = plant
        self.profile = profile
        self.framing = framing_of(profile, framing)
        self.unit_id = unit_id or profile.unit_id
        manners = Manners(alike=profile.alike)
        self._clock = clock
        self._contacts = Contacts(plant, profile)
        cells = Cells(profile, manners, self._contacts)
        self._server = Server(
            cells, manners, clock, unit_id=self.unit_id, framing=self.framing, before=self._catch_up
        )
        self._contacts.fall()

    @property
    def late_s(self) -> float:
        """How late a late answer is."""
        return self._server.late_s

    @late_s.setter
    def late_s(self, seconds: float) -> None:
        self._server.late_s = seconds

    @property
    def faults(self) -> frozenset[str]:
        """What is broken at the moment."""
        return frozenset(self._server.faults | ({POWER_CUT} if self._server.deaf else set()))

    def fault(self, name: str, *, on: bool = True) -> None:
        """Break something, or mend it. Raises ValueError as `check_fault` does."""
        self.check_fault(name)
        if name != POWER_CUT:
            self._server.fault(name, on=on)
            return
        self._server.deaf_until_s = math.inf if on else -math.inf
        if on:
            self._catch_up()
            self._contacts.fall()
            self._server.hang_up()

    def check_fault(self, name: str) -> None:
        """Raise ValueError for a fault that there is not, or that this framing can't have."""
        if name not in RELAY_FAULTS:
            raise ValueError(f"no fault '{name}'; there are {', '.join(RELAY_FAULTS)}")
        self._server.check_fault(name, "pump's relay")

    def connect(self, connection: Connection) -> None:
        """A host has connected; Modbus says nothing unasked."""
        self._server.connect(connection)

    def disconnect(self, connection: Connection) -> None:
        """The host has gone; the contact stays as it is."""
        self._server.disconnect(connection)

    def receive(self, connection: Connection, data: bytes) -> None:
        """Answer every request that ``data`` completes; hang up on what is no Modbus TCP."""
        self._server.receive(connection, data)

    def _catch_up(self) -> None:
        self.plant.advance_to(self._clock.now())
