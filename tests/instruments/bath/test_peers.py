"""Independent Modbus programs against our two ends: libmodbus's own test programs, mbpoll and
minimalmodbus.

libmodbus's server misbehaves on purpose: a request for two registers gets one, and four registers of it
answer with an exception, for another unit or transaction, late, or byte by byte. Whatever is asked in
whatever order, a value that is returned is the right one. Addresses, codes and word orders for mbpoll
and minimalmodbus are typed from the fact sheet, section 1, and not taken from the profiles."""

from __future__ import annotations

import os
import random
import re
import socket
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import Any

import pytest

from instruments.bath.connection import parse_line
from instruments.bath.emulator import BathEmulator, RelayEmulator
from instruments.bath.profile import load_relay, relay_names
from instruments.bath.transactions import Transactions
from instruments.clock import RealClock
from instruments.errors import InstrumentError
from instruments.listener import Listener
from instruments.world.plant import Plant
from tests.instruments.bath.devices import REGISTER_FAMILIES, load_register_profile
from tests.instruments.bath.peers import (
    Bridge,
    Device,
    built,
    foreign,
    memory_profile,
    program,
    real_time,
)
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.slow

UNIT = 17  # the examples' server id
ANY_TCP = 255  # the unit that libmodbus addresses over TCP

REGISTERS, INPUT = 0x160, 0x108
BUSY, OTHER, LATE, BYTEWISE = 0x170, 0x171, 0x172, 0x173
VALUES = [0x0101, 0x0202, 0x0303]
TIMEOUT_S = 2.0  # the late register naps for 5 s, so that its answer comes after both attempts
# how late an answer may come: as late as it does, or sooner, so that it takes us by surprise
AS_KNOWN_S, SLOWER_S = 4.0, 0.5


# ---- its client asks


def passes(client: Path, **address: str) -> bool:
    environment = {**os.environ, **address}
    said = subprocess.run(
        [client], capture_output=True, text=True, timeout=PATIENCE_S, check=True, env=environment
    ).stdout
    return said.splitlines()[-1] == "Test: SUCCESS" and "ERROR" not in said


@pytest.mark.parametrize(("transport", "unit_id"), [("tcp", ANY_TCP), ("pty", UNIT)])
def test_its_random_client_passes(tmp_path: Path, transport: str, unit_id: int) -> None:
    client = built("random-test-client", tmp_path, over_rtu=transport == "pty")
    with real_time(memory_profile(), transport, unit_id=unit_id) as (_, listener):
        if isinstance(listener, Listener):
            assert passes(client, PEER_PORT=str(listener.port))
        else:
            assert passes(client, PEER_DEVICE=listener.url)


# ---- its server answers


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built("unit-test-server", tmp_path_factory.mktemp("libmodbus"))


@contextmanager
def running(server: Path, kind: str, sockets: Sequence[int] = (), **address: str) -> Iterator[None]:
    environment, quiet = {**os.environ, **address}, subprocess.DEVNULL
    with subprocess.Popen(
        [server, kind], stdout=quiet, stderr=quiet, env=environment, pass_fds=sockets
    ) as process:
        try:
            yield
        finally:
            process.kill()


@contextmanager
def tcp_server(server: Path) -> Iterator[str]:
    with socket.create_server(("127.0.0.1", 0)) as bound:
        number, port = bound.fileno(), bound.getsockname()[1]
        with running(server, "tcp", [number], PEER_SOCKET=str(number)):
            bound.close()  # once the server has ended nobody listens
            yield f"tcp://127.0.0.1:{port}"


@contextmanager
def rtu_server(server: Path) -> Iterator[str]:
    with closing(RealClock()) as clock, closing(Bridge()) as bridge:
        listener = Listener(bridge, clock, lock=threading.RLock(), name="bridge")
        with closing(listener), running(server, "rtu", PEER_DEVICE=bridge.path):
            yield f"rtu+tcp://127.0.0.1:{listener.port}"


@pytest.fixture(params=[("tcp", AS_KNOWN_S), ("rtu", SLOWER_S)], ids=str)
def link(request: pytest.FixtureRequest, server: Path, clock: RealClock) -> Iterator[Transactions]:
    kind, quiet_s = request.param
    with (tcp_server if kind == "tcp" else rtu_server)(server) as url:
        line, markers = parse_line(f"{url}?unit={UNIT}"), [(4, INPUT, 1), (3, REGISTERS, 3)]
        link = Transactions(
            line, clock, who="peer", markers=markers, timeout_s=TIMEOUT_S, quiet_s=quiet_s
        )
        link.connect()
        # it has no way to say that its port is open, and drops what came before
        until_it_answers(link)
        yield link
        link.close()


def test_what_is_written_is_read(link: Transactions) -> None:
    assert link.read(3, REGISTERS, 3) == VALUES
    link.write(6, REGISTERS + 1, [0xBEEF])
    assert link.read(3, REGISTERS, 3) == [0x0101, 0xBEEF, 0x0303]
    assert link.read(4, INPUT, 1) == [0x000A]


def test_whatever_is_asked_no_wrong_value_gets_through(link: Transactions) -> None:
    known = {REGISTERS + at: value for at, value in enumerate(VALUES)}
    chance, right = random.Random(1), 0
    plan = [*known] * 3 + [BUSY, OTHER, LATE, LATE, BYTEWISE]
    chance.shuffle(plan)
    for address in plan:
        count = chance.choice([1, 2, 3]) if address == REGISTERS else 1
        try:
            values = link.read(3, address, count)
        except InstrumentError:
            if not link.connected:
                link.connect()
            continue
        assert address not in (BUSY, OTHER)
        assert values == [known.get(address + at, 0) for at in range(count)]
        right += 1
    assert right >= 5
    assert after_trouble(link) == VALUES


def until_it_answers(link: Transactions) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            return link.write(16, REGISTERS, VALUES)
        except InstrumentError:
            assert time.monotonic() < deadline, "the server never answered"
            if not link.connected:
                link.connect()


def after_trouble(link: Transactions) -> list[int]:
    """What the registers hold, once the link answers again."""
    for _ in range(4):
        with suppress(InstrumentError):
            if not link.connected:
                link.connect()
            return link.read(3, REGISTERS, 3)
    raise AssertionError("the link stays dead")


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

TURNS = [*zip(SEEN, cycle(("tcp", "pty")), strict=False)]

RELAYS = {"modbus-relay": ("0", 0)}  # ``-t`` type and address of the contact


def test_every_shipped_profile_has_its_witness() -> None:
    assert set(SEEN) == set(REGISTER_FAMILIES)
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
        place = ["-0", "-a", str(unit), "-t", kind, "-r", str(address), "-o", "0.5"]
        order, once = ["-B"] if high else [], [] if values else ["-1"]
        return subprocess.run(
            [program("mbpoll"), *place, *order, *once, *self.where, *values],
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
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
    profile = load_relay(name) if name in RELAYS else load_register_profile(name)
    with real_time(profile, transport) as (emulator, listener):
        if isinstance(listener, Listener):
            where = ["-m", "tcp", "-p", str(listener.port), "127.0.0.1"]
        else:
            where = ["-m", "rtu", "-b", "19200", "-P", "none", listener.url]
        yield Polled(emulator.plant, emulator, where)


@pytest.mark.parametrize(("name", "transport"), TURNS)
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


@dataclass
class Instrument:
    """An emulated controller in real time, and a minimalmodbus instrument on its port."""

    client: Any
    library: Any
    plant: Plant
    emulator: Device


@contextmanager
def instrument(profile: str) -> Iterator[Instrument]:
    library = foreign("minimalmodbus", "minimalmodbus")
    with real_time(load_register_profile(profile), "pty") as (emulator, listener):
        client = library.Instrument(listener.url, 1)
        client.serial.baudrate = 19200
        client.serial.timeout = 5.0  # for a machine with too much to do
        with closing(client.serial):
            yield Instrument(client, library, emulator.plant, emulator)


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
        waited, on.client.serial.timeout = (
            on.client.serial.timeout,
            0.5 if fault == "silence" else 2.0,
        )
        with pytest.raises(getattr(on.library, error)):
            on.client.read_register(1880)
        on.client.serial.timeout = waited
        on.emulator.fault(fault, on=False)
        assert on.client.read_register(1880) == 62
