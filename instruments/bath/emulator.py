"""One unit of a Modbus line as a server: frames in, frames out, and what can go wrong between, by
name.

Which registers there are and what they hold is for the cells behind it, and a family's ways are
`families`. It never waits, and may not know what the numbers mean.

The emulated controller: a Modbus server whose registers are the plant's state, laid out by a
profile.

Asked for a register, it moves the plant on to the clock's time and looks; told a value, it acts on
the plant. It speaks Modbus TCP or RTU over whatever carries its bytes. It never waits, and may not
know who is asking or why. Frames: `server`; what registers mean: `meanings`; where they are:
`cells`; a family's ways: `families`. A pump that a relay switches is `relay_emulator`'s.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import cycle
from typing import Literal, get_args

from instruments.bath import protocol
from instruments.bath.address_space import Cells
from instruments.bath.controller_behaviour import Manners, manners_of
from instruments.bath.profile import Profile, Wiring
from instruments.bath.protocol import (
    Frame,
    FrameReader,
    Plain,
    Read,
    Refused,
    Request,
    RtuFrame,
    RtuReader,
    Write,
)
from instruments.bath.register_semantics import Controller, Meanings
from instruments.clock import Clock
from instruments.listener import Connection
from instruments.world.plant import Plant

Framing = Literal["tcp", "rtu"]

WIRE_FAULTS = ("silence", "busy", "wrong length", "surplus", "late answer", "garbage", "bad CRC")
GARBAGE = (0x00, 0xFF, 0x01, 0x03)  # ahead of an answer, one byte each time (fact sheet, P6)
LATE_S = 1.5


def framing_of(profile: Wiring, framing: Framing | None) -> Framing:
    """``framing``, or else what the device has, TCP first. Raises
    ValueError for one that is none.
    """
    if framing is not None and framing not in get_args(Framing):
        raise ValueError(f"no framing '{framing}'; there are tcp and rtu")
    return framing or ("tcp" if "tcp" in profile.transports else "rtu")


class Server:
    """Answers for ``unit_id`` alone; other units get no answer.

    ``faults`` are those of WIRE_FAULTS that it has at the moment: "wrong length" leaves a register
    (or eight bits) out of an answer, "surplus" adds one, a "late answer" takes ``late_s``. It is
    deaf until the clock shows ``deaf_until_s``. ``before`` is called before a request is looked at;
    ``plain`` answers the functions 7 and 8, where the family has them.
    """

    def __init__(
        self,
        cells: Cells,
        manners: Manners,
        clock: Clock,
        *,
        unit_id: int,
        framing: Framing,
        before: Callable[[], None],
        plain: Callable[[Plain], bytes] | None = None,
    ) -> None:
        self.unit_id = unit_id
        self.framing = framing
        self.faults: set[str] = set()
        self.late_s = LATE_S
        self._last_answer_s: dict[Connection, float] = {}
        self.deaf_until_s = -math.inf
        self._cells = cells
        self._manners = manners
        self._clock = clock
        self._before = before
        self._plain = plain
        self._garbage = cycle(GARBAGE)
        self._readers: dict[Connection, FrameReader | RtuReader] = {}

    def check_fault(self, name: str, device: str) -> None:
        """Raise ValueError for a fault of the wire that this framing can't have."""
        if name == "bad CRC" and self.framing == "tcp":
            raise ValueError(
                f"the {device} speaks Modbus TCP, which has no check sum: it can't have the fault"
                " 'bad CRC'"
            )

    def fault(self, name: str, *, on: bool) -> None:
        """Have a fault of the wire from now on, or no longer."""
        (self.faults.add if on else self.faults.discard)(name)

    @property
    def deaf(self) -> bool:
        """Whether it hears nothing just now, for want of power."""
        return self._clock.now() < self.deaf_until_s

    def connect(self, connection: Connection) -> None:
        """A host has connected; Modbus says nothing unasked."""
        self._readers[connection] = FrameReader() if self.framing == "tcp" else RtuReader()

    def disconnect(self, connection: Connection) -> None:
        """The host has gone; the device carries on as it is."""
        self._readers.pop(connection, None)
        self._last_answer_s.pop(connection, None)

    def hang_up(self) -> None:
        """Lose all hosts, as a device on a network does whose power goes; a serial line knows
        nothing of that.
        """
        if self.framing == "tcp":
            for connection in list(self._readers):
                connection.hang_up()

    def receive(self, connection: Connection, data: bytes) -> None:
        """Answer every request that ``data`` completes; hang up on what is no Modbus TCP."""
        try:
            for frame in self._readers[connection].feed(data, self._clock.now()):
                self._serve(connection, frame)
        except protocol.UnframedError:
            connection.hang_up()

    def _serve(self, connection: Connection, frame: Frame | RtuFrame) -> None:
        to_all = self.framing == "rtu" and frame.unit == protocol.BROADCAST
        if "silence" in self.faults or self.deaf or (frame.unit != self.unit_id and not to_all):
            return
        self._before()
        pdu = self._answer(frame.pdu)
        if pdu and not to_all:
            self._send(connection, self._spoilt(frame.answer(pdu)))

    def _send(self, connection: Connection, answer: bytes) -> None:
        """Late where that fault is on. A device on a serial line never answers out of order; behind
        TCP one may.
        """
        now_s = self._clock.now()
        at_s = now_s + (self.late_s if "late answer" in self.faults else 0.0)
        if self.framing == "rtu":
            at_s = self._last_answer_s[connection] = max(
                at_s, self._last_answer_s.get(connection, at_s)
            )
        if at_s > now_s:
            connection.after(at_s - now_s, lambda: connection.send(answer))
        else:
            connection.send(answer)

    def _spoilt(self, answer: bytes) -> bytes:
        if "bad CRC" in self.faults:
            answer = answer[:-1] + bytes((answer[-1] ^ 0xFF,))
        return bytes((next(self._garbage),)) + answer if "garbage" in self.faults else answer

    def _answer(self, pdu: bytes) -> bytes:
        """The PDU to answer with; empty for none."""
        function = pdu[0]
        try:
            if "busy" in self.faults:
                return (
                    protocol.answer_refusal(function, protocol.BUSY)
                    if self._manners.says_busy
                    else b""
                )
            if function not in self._manners.functions:
                raise Refused(protocol.ILLEGAL_FUNCTION)
            return self._done(protocol.parse(pdu))
        except Refused as refused:
            unheard_of = (
                refused.code == protocol.ILLEGAL_FUNCTION
                and self._manners.unknown_function == "silence"
            )
            return b"" if unheard_of else protocol.answer_refusal(function, refused.code)

    def _done(self, request: Request) -> bytes:
        if isinstance(request, Read):
            return protocol.answer_read(request, self._read(request))
        if isinstance(request, Write):
            self._cells.write(request)
            return protocol.answer_write(request)
        if isinstance(request, Plain):
            if self._plain is None:
                raise Refused(protocol.ILLEGAL_FUNCTION)
            return self._plain(request)
        self._cells.read(request.read)  # refused before anything is written
        self._cells.write(request.write)
        return protocol.answer_read(request.read, self._read(request.read))

    def _read(self, request: Read) -> list[int]:
        values = self._cells.read(request)
        byte_or_word = 8 if request.function in protocol.BITS else 1
        if "surplus" in self.faults:
            values += [0] * byte_or_word
        return values[:-byte_or_word] if "wrong length" in self.faults else values


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
    """Serves ``plant`` as a controller of ``profile``'s family. Other unit ids get no answer;
    faults of the wire: `server`.

    A family that turns its pump by itself turns the plant's; behind any other the pump stands until
    a relay switches it. ``framing``: "tcp" for Modbus TCP, "rtu" for RTU on a pty or over TCP; by
    default what the family has, TCP first. ``as_shipped``: in the factory's unit, which is degF for
    some. ``late_s`` is how long an answer takes under the fault "late answer". Raises ValueError
    for a framing that is none.
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
            self._cells,
            self._manners,
            clock,
            unit_id=unit_id,
            framing=self.framing,
            before=self._catch_up,
            plain=self._plain,
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
        settings = {
            name
            for name, attribute in SETTING_FAULTS.items()
            if getattr(self._controller, attribute)
        }
        resetting = {"controller reset"} if self._server.deaf else set()
        return frozenset(self._server.faults | settings | resetting)

    def fault(self, name: str, *, on: bool = True) -> None:
        """Break something, or mend it. Raises ValueError as `check_fault` does.

        "controller reset" happens once and mends itself; to mend it is to have it back at once. The
        settings may also be changed over the wire, where the family allows it.
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
