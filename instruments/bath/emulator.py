"""The emulated controller, and the relay of a pump: Modbus servers whose registers are the plant's
state, laid out by a profile.

A request first moves the plant on to the clock's time. Nothing here waits. Bytes: `protocol`; what
registers mean, where they are, and a family's rules: `register_semantics`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import cycle
from typing import ClassVar, Literal, get_args

from instruments.bath import protocol
from instruments.bath.line_dialects import Dialect
from instruments.bath.profile import PUMP, ModbusDevice, RegisterProfile, RelayProfile
from instruments.bath.protocol import Frame, ModbusException, RawRequest, Read, ReadWrite, Write
from instruments.bath.register_semantics import Behaviour, Cells, Panel, Values, behaviour_of
from instruments.bath.rows import Row
from instruments.bath.witness import device_of
from instruments.clock import Clock
from instruments.faults import Amounts
from instruments.listener import Connection
from instruments.world.plant import Plant

Framing = Literal["tcp", "rtu"]

GARBAGE = (0x00, 0xFF, 0x01, 0x03)  # ahead of an answer, one byte each time (fact sheet, P6)
LATE_S = 1.5
POWER_CUT, RESET = "power cut", "controller reset"
AMOUNTS: Amounts = {"late answer": (LATE_S, "s")}
WIRE_FAULTS = ("silence", "busy", "wrong length", "surplus", "late answer", "garbage", "bad CRC")
RELAY_FAULTS = (*WIRE_FAULTS, POWER_CUT)
SETTING_FAULTS = {
    "fahrenheit": "fahrenheit",
    "word order": "turned",
    "manual mode": "manual_mode",
    "external control": "external_control",
}
LOW_LEVEL = "low level"
PLANT_FAULTS = {
    "sensor break": "broken_sensor",
    "frozen sensor": "frozen_sensor",
    "stuck heater": "stuck_heater",
    "dead heater": "dead_heater",
    "pump stopped": "stopped_pump",
}
FAULTS = (*WIRE_FAULTS, "gaps refused", RESET, *SETTING_FAULTS, *PLANT_FAULTS, LOW_LEVEL)


class Emulator:
    """A device over ``plant`` with faults of its wire, the plant, the settings of its ``panel``,
    and an ``outage`` of ``reset_s`` without power. A serial device answers in order.
    """

    kind: ClassVar[str] = "bath"
    whose_faults: ClassVar[str] = ""
    known_faults: ClassVar[tuple[str, ...]]
    outage: ClassVar[str] = RESET
    settings: ClassVar[Mapping[str, str]] = {}
    framing: Literal["tcp", "rtu", "line"]

    def __init__(self, plant: Plant, clock: Clock, panel: Values | Dialect, reset_s: float) -> None:
        self.plant = plant
        self.panel = panel
        self.reset_s = reset_s
        self.late_s = LATE_S
        self.silent_until_s = -math.inf
        self._clock = clock
        self._faults: set[str] = set()
        self._hosts: list[Connection] = []
        self._last_answer_s: dict[Connection | None, float] = {}

    @property
    def faults(self) -> frozenset[str]:
        """What is broken at the moment."""
        outage = {self.outage} if self._without_power else set()
        settings = {name for name, at in self.settings.items() if getattr(self.panel, at)}
        return frozenset(self._faults | outage | settings)

    def fault(self, name: str, *, on: bool = True) -> None:
        """Break something, or mend it. Raises ValueError as `check_fault` does."""
        self.check_fault(name)
        if name == self.outage:
            self.cut_power(on)
        elif name in self.settings:
            setattr(self.panel, self.settings[name], on)
        else:
            (self._faults.add if on else self._faults.discard)(name)
        if name in PLANT_FAULTS:
            setattr(self.plant, PLANT_FAULTS[name], on)
        elif name == LOW_LEVEL:
            k = self.plant.constants
            self.plant.fill(k.volume_min_l - 0.5 if on else k.volume_l)

    def check_fault(self, name: str) -> None:
        """Raise ValueError for an unknown fault, or one that this framing can't have."""
        if name not in self.known_faults:
            there = ", ".join(self.known_faults)
            raise ValueError(f"no fault '{name}'{self.whose_faults}; there are {there}")
        if name == "bad CRC" and self.framing == "tcp":
            what = f"the {self.kind} speaks Modbus TCP, which has no check sum"
            raise ValueError(f"{what}: it can't have the fault 'bad CRC'")

    def cut_power(self, on: bool) -> None:
        """The fault ``outage`` begins, or ends."""
        self.silent_until_s = self._clock.now() + (self.reset_s if on else 0.0)
        if on:
            self.panel.reset()
            self.hang_up()

    def connect(self, connection: Connection) -> None:
        """A host has connected; nothing is sent without a question."""
        self._hosts.append(connection)

    def disconnect(self, connection: Connection) -> None:
        """The host has gone; the device carries on as it is."""
        if connection in self._hosts:
            self._hosts.remove(connection)
            self._last_answer_s.pop(connection, None)

    def hang_up(self) -> None:
        """Drop all hosts, as a device without power; RTU's line has no connections."""
        if self.framing != "rtu":
            for connection in list(self._hosts):
                connection.hang_up()

    @property
    def is_silent(self) -> bool:
        """Whether nothing is answered just now."""
        return "silence" in self._faults or self._without_power

    @property
    def _without_power(self) -> bool:
        return self._clock.now() < self.silent_until_s

    def send(self, connection: Connection, answer: bytes) -> None:
        """Send ``answer``; late where that fault is on."""
        now_s = self._clock.now()
        at_s = now_s + (self.late_s if "late answer" in self._faults else 0.0)
        if self.framing != "tcp":
            line = connection if self.framing == "rtu" else None
            at_s = self._last_answer_s[line] = max(at_s, self._last_answer_s.get(line, at_s))
        if at_s > now_s:
            connection.after(at_s - now_s, lambda: connection.send(answer))
        else:
            connection.send(answer)


class Server(Emulator):
    """A Modbus device that answers for ``unit_id`` alone. ``framing``: "tcp", or "rtu" on a pty or
    over TCP; by default the family's, TCP first. Raises ValueError for another.
    """

    framing: Framing
    panel: Values

    def __init__(
        self,
        plant: Plant,
        profile: ModbusDevice,
        clock: Clock,
        behaviour: Behaviour,
        values: Values,
        unit_id: int | None,
        framing: Framing | None,
    ) -> None:
        super().__init__(plant, clock, values, behaviour.reset_s)
        if framing is not None and framing not in get_args(Framing):
            raise ValueError(f"no framing '{framing}'; there are tcp and rtu")
        self.profile = profile
        self.framing = framing or ("tcp" if "tcp" in profile.transports else "rtu")
        self.unit_id = unit_id or profile.unit_id
        self._behaviour = behaviour
        self._cells = Cells(profile, behaviour, values, self._faults)
        self._garbage = cycle(GARBAGE)
        self._readers: dict[Connection, protocol.FrameReader | protocol.RtuReader] = {}

    def connect(self, connection: Connection) -> None:
        super().connect(connection)
        tcp = self.framing == "tcp"
        self._readers[connection] = protocol.FrameReader() if tcp else protocol.RtuReader()

    def disconnect(self, connection: Connection) -> None:
        super().disconnect(connection)
        self._readers.pop(connection, None)

    def receive(self, connection: Connection, data: bytes) -> None:
        """Answer every request that ``data`` completes; hang up on what is no Modbus TCP."""
        try:
            for frame in self._readers[connection].feed(data, self._clock.now()):
                self._serve(connection, frame)
        except protocol.UnframedError:
            connection.hang_up()

    def _serve(self, connection: Connection, frame: Frame) -> None:
        to_all = self.framing == "rtu" and frame.unit == protocol.BROADCAST
        if self.is_silent or (frame.unit != self.unit_id and not to_all):
            return
        self.plant.advance_to(self._clock.now())
        pdu = self._answer(frame.pdu)
        if not pdu or to_all:
            return
        answer = frame.answer(pdu)
        if "bad CRC" in self._faults:
            answer = answer[:-1] + bytes((answer[-1] ^ 0xFF,))
        if "garbage" in self._faults:
            answer = bytes((next(self._garbage),)) + answer
        self.send(connection, answer)

    def _answer(self, pdu: bytes) -> bytes:
        """The PDU to answer with; empty for none."""
        function, behaviour = pdu[0], self._behaviour
        if "busy" in self._faults:
            return protocol.answer_refusal(function, protocol.BUSY) if behaviour.says_busy else b""
        try:
            if function not in behaviour.functions:
                raise ModbusException(protocol.ILLEGAL_FUNCTION)
            return self._execute(pdu)
        except ModbusException as refused:
            if (
                refused.code == protocol.ILLEGAL_FUNCTION
                and behaviour.unknown_function == "silence"
            ):
                return b""
            return protocol.answer_refusal(function, refused.code)

    def _execute(self, pdu: bytes) -> bytes:
        match protocol.parse(pdu):
            case Read() as request:
                return protocol.answer_read(request, self._read(request))
            case Write() as request:
                self._cells.write(request)
                return protocol.answer_write(request)
            case ReadWrite(read, write):
                self._cells.read(read)  # refused before anything is written
                self._cells.write(write)
                return protocol.answer_read(read, self._read(read))
            case RawRequest() as request:
                return self._plain(request)

    def _plain(self, request: RawRequest) -> bytes:
        """The status byte, or the loopback's echo, for families that have these functions."""
        if request.function == protocol.LOOPBACK:
            if len(request.body) != 4 or request.body[:2] != b"\0\0":
                raise ModbusException(protocol.ILLEGAL_VALUE)
            return bytes((request.function,)) + request.body
        status = self.panel.device.find("status")
        return bytes((request.function, self.panel.words(status)[0] & 0xFF if status else 0))

    def _read(self, request: Read) -> list[int]:
        values = self._cells.read(request)
        byte_or_word = 8 if request.function in protocol.BITS else 1
        if "surplus" in self._faults:
            values += [0] * byte_or_word
        return values[:-byte_or_word] if "wrong length" in self._faults else values


class BathEmulator(Server):
    """Serves ``plant`` as a controller of ``profile``'s family, laid out as the family's witness
    has it; where the family has no pump, a relay switches the plant's. The fault "controller reset"
    ends by itself.
    """

    known_faults: ClassVar[tuple[str, ...]] = FAULTS
    settings: ClassVar[Mapping[str, str]] = SETTING_FAULTS
    profile: RegisterProfile
    panel: Panel

    def __init__(
        self,
        plant: Plant,
        profile: RegisterProfile,
        clock: Clock,
        *,
        unit_id: int | None = None,
        framing: Framing | None = None,
    ) -> None:
        behaviour, device = behaviour_of(profile), device_of(profile)
        panel = Panel(plant, device, behaviour, unit_id or profile.unit_id)
        super().__init__(plant, device, clock, behaviour, panel, unit_id, framing)
        self.profile = profile
        plant.fit(circulator=profile.capabilities.pump == "with run")


class Contacts(Values):
    """The relay's rows: ``pump`` is the plant's switch, any other contact switches nothing here."""

    def __init__(self, plant: Plant, profile: RelayProfile) -> None:
        super().__init__(profile)
        self._plant = plant
        self.reset()

    def number(self, row: Row) -> float:
        if row.name == PUMP:
            return float(row.values["on" if self._plant.pump == "on" else "off"])
        return super().number(row)

    def take(self, row: Row, value: float) -> None:
        super().take(row, value)
        if row.name == PUMP:
            self._plant.pump = "on" if value == row.values["on"] else "off"

    def reset(self) -> None:
        super().reset()
        self._plant.pump = "off"  # a relay holds by its coil


class RelayEmulator(Server):
    """The relay of a pump: its row ``pump`` switches the plant's. The fault "power cut" opens the
    contact, and the relay is silent until the fault ends.
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
        behaviour = Behaviour(alike=profile.alike, reset_s=math.inf)
        contacts = Contacts(plant, profile)
        super().__init__(plant, profile, clock, behaviour, contacts, unit_id, framing)

    def cut_power(self, on: bool) -> None:
        if on:
            self.plant.advance_to(self._clock.now())
        super().cut_power(on)
