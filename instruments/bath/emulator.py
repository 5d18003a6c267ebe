"""The emulated controller: a Modbus server whose registers are the plant's state, laid out by a profile.

Asked for a register, it moves the plant on to the clock's time and looks; told a value, it acts on the plant. It speaks
Modbus TCP or RTU over whatever carries its bytes. It never waits, and may not know who is asking or why. Frames: `server`; what
registers mean: `meanings`; where they are: `cells`; a family's ways: `families`. A pump that a relay switches is `relay_emulator`'s.
"""

from __future__ import annotations

from instruments.bath import protocol
from instruments.bath.cells import Cells
from instruments.bath.controller import Controller
from instruments.bath.families import manners_of
from instruments.bath.meanings import Meanings
from instruments.bath.profile import Profile
from instruments.bath.protocol import Plain, Refused
from instruments.bath.server import WIRE_FAULTS, Framing, Server, framing_of
from instruments.clock import Clock
from instruments.listener import Connection
from instruments.world.plant import Plant

__all__ = ["FAULTS", "BathEmulator", "Framing"]

OWN_FAULTS = ("gaps refused", "controller reset")
SETTING_FAULTS = {"fahrenheit": "fahrenheit", "word order": "turned", "manual mode": "manual_mode"}
PLANT_FAULTS = {
    "sensor break": "broken_sensor",
    "frozen sensor": "frozen_sensor",
    "stuck heater": "stuck_heater",
    "dead heater": "dead_heater",
    "pump stopped": "stopped_pump",
    "low level": "",
}
FAULTS = (*WIRE_FAULTS, *OWN_FAULTS, *SETTING_FAULTS, *PLANT_FAULTS)


class BathEmulator:
    """Serves ``plant`` as a controller of ``profile``'s family. Other unit ids get no answer; faults of the wire: `server`.

    A family that turns its pump by itself turns the plant's; behind any other the pump stands until a relay switches it.
    ``framing``: "tcp" for Modbus TCP, "rtu" for RTU on a pty or over TCP; by default what the family has, TCP first.
    ``as_shipped``: in the factory's unit, which is degF for some. ``late_s`` is how long an answer takes under the fault
    "late answer". Raises ValueError for a framing that is none.
    """

    def __init__(
        self,
        plant: Plant,
        profile: Profile,
        clock: Clock,
        *,
        unit_id: int | None = None,
        framing: Framing | None = None,
        as_shipped: bool = False,
    ) -> None:
        self.plant = plant
        self.profile = profile
        self.framing = framing_of(profile, framing)
        unit_id = unit_id or profile.unit_id
        self._clock = clock
        self._manners = manners_of(profile)
        self._controller = Controller(plant, profile, self._manners, unit_id)
        self._controller.fahrenheit = as_shipped and self._manners.fahrenheit_as_shipped
        self._meanings = Meanings(self._controller)
        self._cells = Cells(profile, self._manners, self._meanings)
        self._server = Server(
            self._cells, self._manners, clock, unit_id=unit_id, framing=self.framing, before=self._catch_up, plain=self._plain
        )
        plant.fit(circulator=profile.capabilities.pump == "with run")

    @property
    def unit_id(self) -> int:
        """Whom it answers for; may be changed at the panel."""
        return self._server.unit_id

    @unit_id.setter
    def unit_id(self, unit_id: int) -> None:
        self._server.unit_id = unit_id

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
        settings = {name for name, attribute in SETTING_FAULTS.items() if getattr(self._controller, attribute)}
        resetting = {"controller reset"} if self._server.deaf else set()
        return frozenset(self._server.faults | settings | resetting)

    def fault(self, name: str, *, on: bool = True) -> None:
        """Break something, or mend it. Raises ValueError as `check_fault` does.

        "controller reset" happens once and mends itself; to mend it is to have it back at once. The settings may also be
        changed over the wire, where the family allows it.
        """
        self.check_fault(name)
        if name == "controller reset":
            self._reset() if on else self._come_back()
        elif name in SETTING_FAULTS:
            setattr(self._controller, SETTING_FAULTS[name], on)
        else:
            self._server.fault(name, on=on)
        if name == "low level":
            k = self.plant.constants
            self.plant.fill(k.volume_min_l - 0.5 if on else k.volume_l)
        elif name in PLANT_FAULTS:
            setattr(self.plant, PLANT_FAULTS[name], on)
        self._cells.gaps_refused = "gaps refused" in self._server.faults

    def check_fault(self, name: str) -> None:
        """Raise ValueError for a fault that there is not, or that this framing can't have."""
        if name not in FAULTS:
            raise ValueError(f"no fault '{name}'; there are {', '.join(FAULTS)}")
        self._server.check_fault(name, "bath")

    def connect(self, connection: Connection) -> None:
        """A host has connected; Modbus says nothing unasked."""
        self._server.connect(connection)

    def disconnect(self, connection: Connection) -> None:
        """The host has gone; the bath carries on as it is."""
        self._server.disconnect(connection)

    def receive(self, connection: Connection, data: bytes) -> None:
        """Answer every request that ``data`` completes; hang up on what is no Modbus TCP."""
        self._server.receive(connection, data)

    def _catch_up(self) -> None:
        self.plant.advance_to(self._clock.now())

    def _plain(self, request: Plain) -> bytes:
        """The status byte, or the loopback's echo."""
        if request.function == protocol.LOOPBACK:
            if len(request.body) != 4 or request.body[:2] != b"\0\0":
                raise Refused(protocol.ILLEGAL_VALUE)
            return bytes((request.function,)) + request.body
        status = self.profile.find("status")
        return bytes((request.function, self._meanings.words(status)[0] & 0xFF if status else 0))

    def _reset(self) -> None:
        self._controller.reset()
        self._server.deaf_until_s = self._clock.now() + self._manners.reset_s
        self._server.hang_up()

    def _come_back(self) -> None:
        self._server.deaf_until_s = self._clock.now()
