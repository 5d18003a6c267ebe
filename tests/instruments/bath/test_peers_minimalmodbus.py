"""minimalmodbus, a client with a framing of its own, on the serial port of emulated controllers;
addresses as in the fact sheet.
"""

from __future__ import annotations

import importlib.util
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import pytest

from instruments.bath.emulator import BathEmulator
from instruments.bath.profile import load_profile
from instruments.clock import RealClock
from instruments.pty_listener import PtyListener
from instruments.world.plant import Plant, PlantConstants
from tests.instruments.bath.peers import absent


@dataclass
class Instrument:
    """An emulated controller in real time, and a minimalmodbus instrument on its port."""

    client: Any
    library: Any
    plant: Plant
    emulator: BathEmulator


@contextmanager
def instrument(profile: str, *, baud: int | None = None) -> Iterator[Instrument]:
    if importlib.util.find_spec("minimalmodbus") is None:
        absent("needs minimalmodbus: pip install minimalmodbus")
    library: Any = importlib.import_module("minimalmodbus")
    clock, plant = RealClock(), Plant(1, constants=PlantConstants(sensor_noise_k=0.0))
    emulator = BathEmulator(plant, load_profile(profile), clock, framing="rtu")
    listener = PtyListener(emulator, clock, lock=threading.RLock(), name="bath", baud=baud)
    client = library.Instrument(listener.url, 1)
    client.serial.baudrate = baud or 19200
    client.serial.timeout = 0.5
    try:
        yield Instrument(client, library, plant, emulator)
    finally:
        client.serial.close()
        listener.close()
        clock.close()


@pytest.mark.parametrize("profile", ["eurotherm-2400", "eurotherm-3200"])
def test_eurotherm(profile: str) -> None:
    with instrument(profile) as on:
        assert on.client.read_float(0x8002) == 20.0
        assert on.client.read_register(1, number_of_decimals=1, signed=True) == 20.0
        on.client.write_float(0x8004, 33.25)
        assert on.client.read_float(0x8004) == on.plant.set_point_c == 33.25
        on.client.write_register(199, 0, functioncode=6)
        assert on.plant.running
        with pytest.raises(on.library.IllegalRequestError, match="address"):
            on.client.write_register(1, 7, functioncode=6)
        with pytest.raises(on.library.NoResponseError):
            on.client.write_bits(0, [1, 0])  # function 15: an unsupported one gets no reply


@pytest.mark.parametrize(
    ("profile", "set_point"), [("watlow-pm-map1", 2160), ("watlow-pm-map2", 2640)]
)
def test_watlow(profile: str, set_point: int) -> None:
    with instrument(profile) as on:
        low_first = on.library.BYTEORDER_LITTLE_SWAP
        assert on.client.read_float(360, byteorder=low_first) == 20.0
        on.client.write_float(set_point, 31.5, byteorder=low_first)
        assert on.plant.set_point_c == 31.5


def test_omega() -> None:
    with instrument("omega-cn7") as on:
        assert on.client.read_register(0x1000, number_of_decimals=1, signed=True) == 20.0
        on.client.write_register(0x1001, 33.0, number_of_decimals=1, functioncode=6, signed=True)
        on.client.write_bit(0x0814, 1)
        assert on.client.read_bit(0x0814, functioncode=2) == 1
        assert (on.plant.running, on.plant.set_point_c) == (True, 33.0)
        with pytest.raises(on.library.IllegalRequestError, match="function"):
            on.client.read_bit(0x0814, functioncode=1)


def test_julabo_over_rtu_and_paced_as_a_serial_line() -> None:
    with instrument("julabo-magio", baud=9600) as on:
        assert on.client.read_float(10, functioncode=4) == 20.0
        on.client.write_registers(0, [1, 0, 0x4204, 0x0000])
        assert on.client.read_registers(0, 4) == [1, 0, 0x4204, 0x0000]
        assert on.plant.running


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        ("silence", "NoResponseError"),
        ("bad CRC", "InvalidResponseError"),
        ("wrong length", "InvalidResponseError"),
        ("busy", "SlaveDeviceBusyError"),
    ],
)
def test_faults_look_to_it_as_they_should(fault: str, error: str) -> None:
    with instrument("watlow-pm-map1") as on:
        on.emulator.fault(fault)
        with pytest.raises(getattr(on.library, error)):
            on.client.read_register(1880)
        on.emulator.fault(fault, on=False)
        assert on.client.read_register(1880) == 62
