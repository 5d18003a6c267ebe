"""A Modbus device that can be told to misbehave: registers in a dictionary, answers early, late,
damaged or never.

Written from the Modbus documents for these tests alone; it shares no code with the driver nor with
the emulator.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import RLock

from instruments.bath.connection import parse_line
from instruments.bath.driver import OwnBath
from instruments.bath.transactions import Transactions
from instruments.clock import Clock, VirtualClock
from instruments.listener import Connection, Listener
from tests.instruments.bath.devices import load_register_profile

LATEST_S = 9.9  # after its question, an answer that has not come never comes
Spoil = Callable[[bytes], bytes]


def crc(data: bytes) -> bytes:
    """The check sum of RTU, low byte first."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ 0xA001 if value & 1 else value >> 1
    return struct.pack("<H", value)


def rtu(text: str) -> bytes:
    """Hex of unit and PDU to a whole RTU frame."""
    body = bytes.fromhex(text)
    return body + crc(body)


class FarEnd:
    """Answers functions 1 to 6 and 16, unit 1, in order, as a slow device does: the next answer
    waits for the one before.

    ``delays_s`` are how long each next answer takes (None: it never comes); when they are used up,
    answers come at once. ``spoils`` are what becomes of each next frame. ``asked`` are the PDUs as
    they came; ``memory`` holds bits and registers. With ``gateway``, late answers go to whoever is
    connected then, as a serial server sends them on.
    """

    def __init__(self, clock: Clock, *, framing: str = "rtu", gateway: bool = False) -> None:
        self.clock = clock
        self.framing = framing
        self.gateway = gateway
        self.memory: dict[int, int] = {}
        self.delays_s: list[float | None] = []
        self.spoils: list[Spoil] = []
        self.asked: list[bytes] = []
        self.hosts: list[Connection] = []
        self._free_s = 0.0
        self._buffer = b""

    def connect(self, connection: Connection) -> None:
        self._buffer = b""
        self.hosts.append(connection)

    def disconnect(self, connection: Connection) -> None:
        self.hosts.remove(connection)

    def receive(self, connection: Connection, data: bytes) -> None:
        self._buffer += data
        while (frame := self._cut()) is not None:
            head, pdu = frame
            self.asked.append(pdu)
            answer = self.answer_of(head[-1], pdu)
            whole = head + answer + crc(head + answer)
            if self.framing == "tcp":
                whole = head[:4] + struct.pack(">HB", len(answer) + 1, head[6]) + answer
            self._send(connection, self.spoils.pop(0)(whole) if self.spoils else whole)

    def answer(self, pdu: bytes) -> bytes:
        """The right answer to a PDU."""
        function, address, value = struct.unpack_from(">BHH", pdu)
        if function in (1, 2):
            bits = sum(self.memory.get(address + at, 0) << at for at in range(value))
            return bytes((function, -(-value // 8))) + bits.to_bytes(-(-value // 8), "little")
        if function in (3, 4):
            words = [self.memory.get(address + at, 0) for at in range(value)]
            return struct.pack(f">BB{value}H", function, 2 * value, *words)
        if function == 16:
            self.memory |= dict(enumerate(struct.unpack_from(f">{value}H", pdu, 6), address))
        elif function in (5, 6):
            self.memory[address] = value >> 15 if function == 5 else value
        return pdu[:5]

    def answer_of(self, unit: int, pdu: bytes) -> bytes:
        """The right answer of one unit."""
        return self.answer(pdu)

    def send_all(self, data: bytes) -> None:
        """Send to whoever is connected."""
        for host in self.hosts:
            host.send(data)

    def _cut(self) -> tuple[bytes, bytes] | None:
        """Unit (and the header of TCP) and PDU of the next whole request."""
        data = self._buffer
        if self.framing == "tcp":
            if len(data) < 8 or len(data) < (end := 6 + struct.unpack_from(">H", data, 4)[0]):
                return None
            self._buffer = data[end:]
            return data[:7], data[7:end]
        end = 8 if len(data) < 2 or data[1] != 16 else 9 + data[6] if len(data) > 6 else 9
        if len(data) < end:
            return None
        self._buffer = data[end:]
        assert crc(data[: end - 2]) == data[end - 2 : end], "the driver's check sum is wrong"
        return data[:1], data[1 : end - 2]

    def _send(self, connection: Connection, data: bytes) -> None:
        delay_s = self.delays_s.pop(0) if self.delays_s else 0.0
        if delay_s is None:
            return
        now = self.clock.now()
        self._free_s = max(self._free_s, min(max(self._free_s, now) + delay_s, now + LATEST_S))
        if self._free_s > now and self.gateway:
            self.clock.call_at(self._free_s, lambda: self.send_all(data))
        elif self._free_s > now:
            connection.after(self._free_s - now, lambda: connection.send(data))
        else:
            connection.send(data)


@contextmanager
def served(far_end: FarEnd) -> Iterator[str]:
    """The far end on loopback; its URL."""
    listener = Listener(far_end, far_end.clock, lock=RLock(), name="far end")
    try:
        yield f"{'rtu+tcp' if far_end.framing == 'rtu' else 'tcp'}://127.0.0.1:{listener.port}"
    finally:
        listener.close()


@contextmanager
def virtual(framing: str = "rtu", *, gateway: bool = False) -> Iterator[tuple[FarEnd, str]]:
    """A far end under virtual time, and its URL."""
    far_end = FarEnd(VirtualClock(), framing=framing, gateway=gateway)
    with served(far_end) as url:
        yield far_end, url


@contextmanager
def shown_by(memory: dict[int, int]) -> Iterator[tuple[FarEnd, str]]:
    """An RTU device that holds ``memory``, and its URL."""
    with virtual() as (far_end, url):
        far_end.memory = dict(memory)
        yield far_end, url


@contextmanager
def bath_on(
    name: str, memory: dict[int, int], *, identify: bool = True
) -> Iterator[tuple[FarEnd, OwnBath]]:
    """A driver with the profile ``name`` on a device that holds ``memory``."""
    with shown_by(memory) as (far_end, url):
        family = load_register_profile(name)
        bath = OwnBath(url, family, far_end.clock, identify=identify, unit_confirmed=True)
        try:
            yield far_end, bath
        finally:
            bath.close()


MARKERS = ((3, 0, 2), (4, 0, 1), (3, 0, 3))


@contextmanager
def linked(framing: str = "rtu", *, gateway: bool = False) -> Iterator[tuple[FarEnd, Transactions]]:
    """Transactions with a far end that holds 100 at register 0, 200 at 1 and so on: a value at the
    wrong address is a wrong value.
    """
    with virtual(framing, gateway=gateway) as (far_end, url):
        far_end.memory = {address: 100 * (address + 1) for address in range(16)}
        link = Transactions(parse_line(url), far_end.clock, who="bath", markers=MARKERS)
        link.connect()
        try:
            yield far_end, link
        finally:
            link.close()


def right(address: int, count: int = 1) -> list[int]:
    return [100 * (address + at + 1) for at in range(count)]
