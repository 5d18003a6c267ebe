"""The emulated relay of a pump: a Modbus server of its own, whose row ``pump`` switches the plant's
pump. It has another power supply than the controller.
"""

from __future__ import annotations

import math
from typing import ClassVar

from instruments.bath.address_space import Values
from instruments.bath.controller_behaviour import Manners
from instruments.bath.emulator import WIRE_FAULTS, Framing, Server
from instruments.bath.profile import PUMP, RelayProfile
from instruments.bath.registers import Row
from instruments.clock import Clock
from instruments.world.plant import Plant

POWER_CUT = "power cut"
RELAY_FAULTS = (*WIRE_FAULTS, POWER_CUT)


class Contacts(Values):
    """The relay's rows: ``pump`` is the plant's switch, any other contact switches nothing here."""

    def __init__(self, plant: Plant, profile: RelayProfile) -> None:
        super().__init__(profile)
        self._plant = plant

    def number(self, row: Row) -> float:
        if row.name == PUMP:
            return float(row.values["on" if self._plant.pump == "on" else "off"])
        return super().number(row)

    def take(self, row: Row, value: float) -> None:
        super().take(row, value)
        if row.name == PUMP:
            self._plant.pump = "on" if value == row.values["on"] else "off"


class RelayEmulator(Server):
    """Switches the pump of ``plant``, which is off at first. As `Server`; the fault "power cut"
    opens the contact, and the relay is silent until the fault ends.
    """

    kind: ClassVar[str] = "pump's relay"
    known_faults: ClassVar[tuple[str, ...]] = RELAY_FAULTS
    outage: ClassVar[str] = POWER_CUT
    profile: RelayProfile

    def __init__(
        self,
        plant: Plant,
        profile: RelayProfile,
        clock: Clock,
        *,
        unit_id: int | None = None,
        framing: Framing | None = None,
    ) -> None:
        self._contacts = Contacts(plant, profile)
        manners = Manners(alike=profile.alike)
        super().__init__(
            plant, profile, clock, manners, self._contacts, unit_id=unit_id, framing=framing
        )
        plant.pump = "off"

    def cut_power(self, on: bool) -> None:
        self.silent_until_s = math.inf if on else -math.inf
        if on:
            self.plant.advance_to(self._clock.now())
            self._contacts.memory.clear()
            self.plant.pump = "off"  # a relay holds by its coil
            self.hang_up()
