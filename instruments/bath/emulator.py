"""The emulated controller: a Modbus TCP server whose registers are the plant's state, laid out by a profile.

Asked for a register, it moves the plant on to the clock's time and looks; told a value, it acts on the plant. What
no document says was chosen: addresses between a table's rows read as 0, a broken sensor reads as not-a-number, the
pump's stage is a quarter of the full flow each. It never waits, and may not know who is asking or why.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from instruments.bath import protocol
from instruments.bath.profile import Profile
from instruments.bath.protocol import Frame, FrameReader, Read, Refused, Write
from instruments.bath.registers import Order
from instruments.bath.rows import Row, Table
from instruments.clock import Clock
from instruments.listener import Connection
from instruments.world.plant import Plant

FIRMWARE = 10400
WIRE_FAULTS = ("silence", "busy", "wrong length", "late answer", "gaps refused")
SETTING_FAULTS = ("fahrenheit", "word order", "manual mode")
PLANT_FAULTS = {
    "sensor break": "broken_sensor",
    "stuck heater": "stuck_heater",
    "dead heater": "dead_heater",
    "pump stopped": "stopped_pump",
    "low level": "",
}
FAULTS = (*WIRE_FAULTS, *SETTING_FAULTS, *PLANT_FAULTS)


class BathEmulator:
    """Serves ``plant`` as a controller of ``profile``'s family. Other unit ids get no answer.

    ``late_s`` is how long an answer takes under the fault "late answer".
    """

    def __init__(self, plant: Plant, profile: Profile, clock: Clock, *, unit_id: int | None = None) -> None:
        self.plant = plant
        self.profile = profile
        self.late_s = 1.5
        self.unit_id = unit_id or profile.unit_id
        self._clock = clock
        self._faults: set[str] = set()
        self._actuating = 0.0
        self._limit = plant.output_max
        self._readers: dict[Connection, FrameReader] = {}
        self._rows = {(row.table, address): row for row in profile.rows for address in range(row.address, row.end)}
        self._reads = _reads(self)
        self._writes = _writes(self)

    @property
    def faults(self) -> frozenset[str]:
        """What is broken at the moment."""
        return frozenset(self._faults)

    def fault(self, name: str, *, on: bool = True) -> None:
        """Break something, or mend it. Raises ValueError for a name that is not in ``FAULTS``."""
        if name not in FAULTS:
            raise ValueError(f"no fault '{name}'; there are {', '.join(FAULTS)}")
        (self._faults.add if on else self._faults.discard)(name)
        if name == "low level":
            k = self.plant.constants
            self.plant.fill(k.volume_min_l - 0.5 if on else k.volume_l)
        elif name in PLANT_FAULTS:
            setattr(self.plant, PLANT_FAULTS[name], on)

    def connect(self, connection: Connection) -> None:
        """A host has connected; Modbus says nothing unasked."""
        self._readers[connection] = FrameReader()

    def disconnect(self, connection: Connection) -> None:
        """The host has gone; the bath carries on as it is."""
        self._readers.pop(connection, None)

    def receive(self, connection: Connection, data: bytes) -> None:
        """Answer every request that ``data`` completes; hang up on what is no Modbus TCP."""
        try:
            for frame in self._readers[connection].feed(data):
                self._serve(connection, frame)
        except protocol.UnframedError:
            connection.hang_up()

    def _serve(self, connection: Connection, frame: Frame) -> None:
        if frame.unit != self.unit_id or "silence" in self._faults:
            return
        self.plant.advance_to(self._clock.now())
        answer = frame.answer(self._answer(frame.pdu))
        if "late answer" in self._faults:
            connection.after(self.late_s, lambda: connection.send(answer))
        else:
            connection.send(answer)

    def _answer(self, pdu: bytes) -> bytes:
        try:
            if "busy" in self._faults:
                raise Refused(protocol.BUSY)
            request = protocol.parse(pdu)
            if isinstance(request, Read):
                return protocol.answer_read(request, self._registers(request))
            self._write(request)
            return protocol.answer_write(request)
        except Refused as refused:
            return protocol.answer_refusal(pdu[0], refused.code)

    def _registers(self, request: Read) -> list[int]:
        table: Table = "holding" if request.function == protocol.READ_HOLDING else "input"
        end = request.address + request.count
        if (table, request.address) not in self._rows or (table, end - 1) not in self._rows:
            raise Refused(protocol.ILLEGAL_ADDRESS)
        registers: list[int] = []
        order = self._order()
        address = request.address
        while address < end:
            row = self._rows.get((table, address))
            if row is None and "gaps refused" in self._faults:
                raise Refused(protocol.ILLEGAL_ADDRESS)
            words = row.encode(self._reads[row.name](), order)[address - row.address :] if row else (0,)
            registers += words
            address += len(words)
        return registers[: request.count - ("wrong length" in self._faults)]

    def _write(self, request: Write) -> None:
        """All of the request or nothing, and whole rows only."""
        wanted: list[tuple[Row, float]] = []
        address, end = request.address, request.address + len(request.registers)
        while address < end:
            row = self._rows.get(("holding", address))
            if row is None or row.access != "rw" or row.address != address or row.end > end:
                raise Refused(protocol.ILLEGAL_ADDRESS)
            if row.words > 1 and request.function == protocol.WRITE_ONE:
                raise Refused(protocol.ILLEGAL_ADDRESS)
            value = row.decode(request.registers[address - request.address :][: row.words], self._order())
            if not math.isfinite(value) or row.refusal(self._celsius(value) if row.unit == "degC" else value):
                raise Refused(protocol.ILLEGAL_VALUE)
            wanted.append((row, value))
            address = row.end
        if "manual mode" not in self._faults:
            for row, value in wanted:
                self._writes[row.name](value)

    def _order(self) -> Order:
        turned = "word order" in self._faults
        return self.profile.order_for(3 if turned else 0) or self.profile.order

    def _shown(self, celsius: float) -> float:
        return celsius * 1.8 + 32.0 if "fahrenheit" in self._faults else celsius

    def _celsius(self, shown: float) -> float:
        return (shown - 32.0) / 1.8 if "fahrenheit" in self._faults else shown

    def _alarm(self) -> float:
        return next((float(alarm.code) for alarm in self.profile.alarms if alarm.cause == self.plant.alarm), 0.0)


def _reads(bath: BathEmulator) -> dict[str, Callable[[], float]]:
    """Where each row's value comes from."""
    plant, faults, shown = bath.plant, bath._faults, bath._shown

    def code(row: str, label: str) -> float:
        return float(bath.profile.row(row).values[label])

    return {
        "run": lambda: code("run", "started" if plant.running else "standby"),
        "actuating": lambda: bath._actuating,
        "set_point": lambda: shown(plant.set_point_c),
        "heating_limit": lambda: bath._limit * 100.0,
        "pump_stage": lambda: 4.0 * plant.flow_l_per_min / plant.constants.flow_l_per_min,
        "unit": lambda: code("unit", "f" if "fahrenheit" in faults else "c"),
        "encoding": lambda: 3.0 if "word order" in faults else 0.0,
        "firmware": lambda: float(FIRMWARE),
        "remote": lambda: code("remote", "manual" if "manual mode" in faults else "modbus"),
        "alarm": bath._alarm,
        "warning": lambda: 0.0,
        "temperature": lambda: shown(math.nan if plant.broken_sensor else plant.pv_c),
        "external": lambda: shown(float(plant.teat_c.mean())),
        "power": lambda: plant.power_percent,
        "safety": lambda: shown(plant.bath_c),
        "cut_out": lambda: shown(plant.constants.cut_out_c),
    }


def _writes(bath: BathEmulator) -> dict[str, Callable[[float], None]]:
    """What each row's value does."""
    plant = bath.plant
    started = bath.profile.row("run").values["started"]

    def run(value: float) -> None:
        if value == started:
            plant.run(plant.set_point_c)
        else:
            plant.standby()

    def limit() -> None:  # "digital" heats with a power of its own, which is 0 until somebody sets it: no row here does
        plant.output_max = bath._limit if bath._actuating == 0 else 0.0

    def actuating(value: float) -> None:
        bath._actuating = value
        limit()

    def set_point(value: float) -> None:
        plant.set_point_c = bath._celsius(value)

    def heating_limit(value: float) -> None:
        bath._limit = value / 100.0
        limit()

    def pump_stage(value: float) -> None:
        plant.set_flow(plant.constants.flow_l_per_min * value / 4.0)

    return {"run": run, "actuating": actuating, "set_point": set_point, "heating_limit": heating_limit, "pump_stage": pump_stage}
