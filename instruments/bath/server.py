"""One unit of a Modbus line as a server: frames in, frames out, and what can go wrong between, by name.

Which registers there are and what they hold is for the cells behind it, and a family's ways are `families`. It never waits,
and may not know what the numbers mean.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import cycle
from typing import Literal, get_args

from instruments.bath import protocol, rtu
from instruments.bath.cells import Cells
from instruments.bath.families import Manners
from instruments.bath.protocol import Frame, FrameReader, Plain, Read, Refused, Request, Write
from instruments.bath.rtu import RtuFrame, RtuReader
from instruments.bath.wiring import Wiring
from instruments.clock import Clock
from instruments.listener import Connection

Framing = Literal["tcp", "rtu"]

WIRE_FAULTS = ("silence", "busy", "wrong length", "surplus", "late answer", "garbage", "bad CRC")
GARBAGE = (0x00, 0xFF, 0x01, 0x03)  # ahead of an answer, one byte each time (fact sheet, P6)
LATE_S = 1.5


def framing_of(profile: Wiring, framing: Framing | None) -> Framing:
    """``framing``, or else what the device has, TCP first. Raises ValueError for one that is none."""
    if framing is not None and framing not in get_args(Framing):
        raise ValueError(f"no framing '{framing}'; there are tcp and rtu")
    return framing or ("tcp" if "tcp" in profile.transports else "rtu")


class Server:
    """Answers for ``unit_id`` alone; other units get no answer.

    ``faults`` are those of WIRE_FAULTS that it has at the moment: "wrong length" leaves a register (or eight bits) out of an
    answer, "surplus" adds one, a "late answer" takes ``late_s``. It is deaf until the clock shows ``deaf_until_s``.
    ``before`` is called before a request is looked at; ``plain`` answers the functions 7 and 8, where the family has them.
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
            raise ValueError(f"the {device} speaks Modbus TCP, which has no check sum: it can't have the fault 'bad CRC'")

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

    def hang_up(self) -> None:
        """Lose all hosts, as a device on a network does whose power goes; a serial line knows nothing of that."""
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
        to_all = self.framing == "rtu" and frame.unit == rtu.BROADCAST
        if "silence" in self.faults or self.deaf or (frame.unit != self.unit_id and not to_all):
            return
        self._before()
        pdu = self._answer(frame.pdu)
        if pdu and not to_all:
            self._send(connection, self._spoilt(frame.answer(pdu)))

    def _send(self, connection: Connection, answer: bytes) -> None:
        if "late answer" in self.faults:
            connection.after(self.late_s, lambda: connection.send(answer))
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
                return protocol.answer_refusal(function, protocol.BUSY) if self._manners.says_busy else b""
            if function not in self._manners.functions:
                raise Refused(protocol.ILLEGAL_FUNCTION)
            return self._done(protocol.parse(pdu))
        except Refused as refused:
            unheard_of = refused.code == protocol.ILLEGAL_FUNCTION and self._manners.unknown_function == "silence"
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
