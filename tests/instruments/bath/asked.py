"""An emulated controller that is asked by the byte, with nothing between."""

from __future__ import annotations

import struct

from instruments.bath.emulator import BathEmulator
from instruments.bath.profile import load_profile
from instruments.bath.protocol import framed
from instruments.clock import VirtualClock
from instruments.listener import Connection
from instruments.world.plant import Plant, PlantConstants

EUROTHERMS = ["eurotherm-2400", "eurotherm-3200"]
WATLOWS = ["watlow-pm-map1", "watlow-pm-map2"]
OMEGA = "omega-cn7"


def request_of(function: int, address: int, count: int) -> bytes:
    return struct.pack(">BHH", function, address, count)


class Sink:
    """Takes what a device sends, and plans nothing."""

    def __init__(self) -> None:
        self.got = b""

    def send(self, data: bytes) -> None:
        self.got += data

    def hang_up(self) -> None:
        self.got += b"hung up"


class Asked:
    """An emulated controller on an RTU line, at 20 degC and without noise. ``ask`` gives the PDU
    answered, in hex; "" for silence.
    """

    def __init__(self, profile: str, *, as_shipped: bool = False) -> None:
        self.clock = VirtualClock()
        self.plant = Plant(1, constants=PlantConstants(sensor_noise_k=0.0))
        self.emulator = BathEmulator(
            self.plant,
            load_profile(profile),
            self.clock,
            unit_id=1,
            framing="rtu",
            as_shipped=as_shipped,
        )
        self.sink = Sink()
        self.connection: Connection = self.sink  # type: ignore[assignment]
        self.emulator.connect(self.connection)

    def ask(self, pdu: str) -> str:
        self.clock.sleep(0.1)
        self.sink.got = b""
        self.emulator.receive(self.connection, framed(1, bytes.fromhex(pdu)))
        answer = self.sink.got
        assert not answer or answer == framed(1, answer[1:-2])
        return answer[1:-2].hex(" ").upper()

    def word(self, address: int) -> int:
        """One holding register."""
        return int(self.ask(f"03 {address:04X} 0001")[6:].replace(" ", ""), 16)

    def float(self, address: int, *, low_first: bool = False) -> float:
        words = bytes.fromhex(self.ask(f"03 {address:04X} 0002")[6:])
        value: float = struct.unpack(">f", words[2:] + words[:2] if low_first else words)[0]
        return value
