"""mbpoll (libmodbus's command line) reads and writes every emulated controller, over TCP and on a
serial port.

Addresses, codes and word orders are typed from the fact sheet, section 1, and not taken from the
profiles.
"""

from __future__ import annotations

import re
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import pytest

from instruments.bath.emulator import BathEmulator, Framing
from instruments.bath.profile import load_profile, load_relay, profile_names, relay_names
from instruments.bath.relay_emulator import RelayEmulator
from instruments.clock import RealClock
from instruments.listener import Listener
from instruments.pty_listener import PtyListener
from instruments.world.plant import Plant, PlantConstants
from tests.instruments.bath.peers import program


@dataclass(frozen=True)
class Seen:
    """How mbpoll is told a family: ``-t`` type and address of what is read and written, and codes
    and numbers as they are shown.
    """

    temperature: tuple[str, int]
    set_point: tuple[str, int]
    run: tuple[str, int]
    started: str
    standby: str
    high_word_first: bool = True
    scale: float = 1.0
    run_read: str = ""  # another type to read ``run`` by


EUROTHERM = Seen(("4:float", 0x8002), ("4:float", 0x8004), ("4", 199), "0", "1")
SEEN = {
    "julabo-presto": Seen(("3:float", 10), ("4:float", 2), ("4", 0), "1", "0"),
    "julabo-magio": Seen(("3:float", 10), ("4:float", 2), ("4", 0), "1", "0"),
    "eurotherm-2400": EUROTHERM,
    "eurotherm-3200": EUROTHERM,
    "watlow-pm-map1": Seen(
        ("4:float", 360), ("4:float", 2160), ("4", 1880), "10", "62", high_word_first=False
    ),
    "watlow-pm-map2": Seen(
        ("4:float", 360), ("4:float", 2640), ("4", 2360), "10", "62", high_word_first=False
    ),
    "omega-cn7": Seen(
        ("4", 0x1000), ("4", 0x1001), ("0", 0x0814), "1", "0", scale=0.1, run_read="1"
    ),
}

RELAYS = {"modbus-relay": ("0", 0)}  # ``-t`` type and address of the contact


def test_every_shipped_profile_has_its_witness() -> None:
    assert set(SEEN) == set(profile_names())
    assert set(RELAYS) == set(relay_names())


@dataclass
class Polled:
    """An emulated controller in real time, and mbpoll pointed at it."""

    plant: Plant
    emulator: BathEmulator | RelayEmulator
    where: list[str]

    def ask(
        self, kind: str, address: int, *values: str, unit: int = 1, high: bool = True
    ) -> subprocess.CompletedProcess[str]:
        order = ["-B"] if high else []
        reading = ["-1"] if not values else []
        options = [
            "-0",
            "-a",
            str(unit),
            "-t",
            kind,
            "-r",
            str(address),
            "-o",
            "0.5",
            *order,
            *reading,
        ]
        return subprocess.run(
            [program("mbpoll"), *options, *self.where, *values],
            capture_output=True,
            text=True,
            timeout=60,
        )

    def read(self, kind: str, address: int, *, high: bool = True) -> str:
        """The value as it is shown."""
        done = self.ask(kind, address, high=high)
        found = re.search(rf"^\[{address}\]:\s+(\S+)", done.stdout, re.MULTILINE)
        assert found, done.stdout + done.stderr
        return found[1]

    def write(self, kind: str, address: int, value: str, *, high: bool = True) -> None:
        done = self.ask(kind, address, value, high=high)
        assert "Written 1 references" in done.stdout, done.stdout + done.stderr


@contextmanager
def polled(name: str, transport: str) -> Iterator[Polled]:
    program("mbpoll")
    clock, plant = RealClock(), Plant(1, constants=PlantConstants(sensor_noise_k=0.0))
    framing: Framing = "tcp" if transport == "tcp" else "rtu"
    emulator: BathEmulator | RelayEmulator
    if name in RELAYS:
        emulator = RelayEmulator(plant, load_relay(name), clock, framing=framing)
    else:
        emulator = BathEmulator(plant, load_profile(name), clock, framing=framing)
    lock = threading.RLock()
    listener = (
        Listener(emulator, clock, lock=lock, name="bath")
        if transport == "tcp"
        else PtyListener(emulator, clock, lock=lock, name="bath")
    )
    port = (
        ["-m", "tcp", "-p", str(listener.port), "127.0.0.1"]
        if isinstance(listener, Listener)
        else serial(listener.url)
    )
    try:
        yield Polled(plant, emulator, port)
    finally:
        listener.close()
        clock.close()


def serial(path: str) -> list[str]:
    return ["-m", "rtu", "-b", "19200", "-P", "none", path]


@pytest.mark.parametrize("transport", ["tcp", "pty"])
@pytest.mark.parametrize("name", SEEN)
def test_mbpoll_reads_and_writes(name: str, transport: str) -> None:
    seen = SEEN[name]
    high = seen.high_word_first
    with polled(name, transport) as bath:
        assert float(bath.read(*seen.temperature, high=high)) * seen.scale == 20.0
        assert bath.read(seen.run_read or seen.run[0], seen.run[1]) == seen.standby
        bath.write(*seen.set_point, f"{33.5 / seen.scale:g}", high=high)
        assert bath.plant.set_point_c == 33.5
        assert float(bath.read(*seen.set_point, high=high)) * seen.scale == 33.5
        bath.write(*seen.run, seen.started)
        assert bath.plant.running
        assert bath.read(seen.run_read or seen.run[0], seen.run[1]) == seen.started
        bath.write(*seen.run, seen.standby)
        assert not bath.plant.running


@pytest.mark.parametrize("transport", ["tcp", "pty"])
@pytest.mark.parametrize("name", RELAYS)
def test_mbpoll_switches_the_pump(name: str, transport: str) -> None:
    kind, address = RELAYS[name]
    with polled(name, transport) as relay:
        for state in ("0", "1", "0"):
            if relay.plant.pump_on != (state == "1"):
                relay.write(kind, address, state)
            assert relay.read(kind, address) == state
            assert relay.plant.pump_on == (state == "1")
        assert "timed out" in relay.ask(kind, address, unit=2).stderr


@pytest.mark.parametrize("transport", ["tcp", "pty"])
def test_mbpoll_gets_no_answer_from_another_unit(transport: str) -> None:
    with polled("julabo-presto", transport) as bath:
        done = bath.ask("3:float", 10, unit=2)
        assert "timed out" in done.stderr
        assert bath.read("3:float", 10) == "20"


def test_mbpoll_notices_a_bad_check_sum() -> None:
    with polled("eurotherm-3200", "pty") as bath:
        bath.emulator.fault("bad CRC")
        assert "Invalid CRC" in bath.ask("4:float", 0x8002).stderr
        bath.emulator.fault("bad CRC", on=False)
        assert bath.read("4:float", 0x8002) == "20"


def test_mbpoll_sees_the_words_the_other_way_round() -> None:
    with polled("watlow-pm-map1", "tcp") as bath:
        bath.emulator.fault("word order")
        assert bath.read("4:float", 360, high=True) == "20"
