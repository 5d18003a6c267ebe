"""libmodbus's own test programs against our two ends: its client asks our emulator, its server
answers our driver.

The server misbehaves on purpose: a request for two registers gets one, and four registers of it
answer with an exception, for another unit or transaction, late, or byte by byte. Whatever is asked
in whatever order, a value that is returned is the right one.
"""

from __future__ import annotations

import os
import random
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from instruments.bath.connection import parse_line
from instruments.bath.emulator import BathEmulator
from instruments.bath.errors import RefusedError
from instruments.bath.transactions import Transactions
from instruments.clock import RealClock
from instruments.errors import InstrumentError, LinkError, ProtocolError
from instruments.listener import Listener
from instruments.pty_listener import PtyListener
from instruments.world.plant import Plant
from tests.instruments.bath.peers import Bridge, built, free_port, memory_profile

UNIT = 17  # the examples' server id
ANY_TCP = 255  # the unit that libmodbus addresses over TCP

REGISTERS, INPUT = 0x160, 0x108
BUSY, OTHER, LATE, BYTEWISE = 0x170, 0x171, 0x172, 0x173
VALUES = [0x0101, 0x0202, 0x0303]
TIMEOUT_S = 2.0  # the late register naps for 5 s, so that its answer comes after both attempts
# how late an answer may come: as late as it does, or sooner, so that it takes us by surprise
AS_KNOWN_S, SLOWER_S = 4.0, 0.5


@pytest.fixture
def clock() -> Iterator[RealClock]:
    clock = RealClock()
    yield clock
    clock.close()


# ---- its client asks


def passes(client: Path, **address: str) -> bool:
    environment = {**os.environ, **address}
    said = subprocess.run(
        [client], capture_output=True, text=True, timeout=280, check=True, env=environment
    ).stdout
    return said.splitlines()[-1] == "Test: SUCCESS" and "ERROR" not in said


def test_its_random_client_passes_over_tcp(tmp_path: Path, clock: RealClock) -> None:
    client = built("random-test-client", tmp_path)
    emulator = BathEmulator(Plant(1), memory_profile(), clock, unit_id=ANY_TCP)
    listener = Listener(emulator, clock, lock=threading.RLock(), name="bath")
    try:
        assert passes(client, PEER_PORT=str(listener.port))
    finally:
        listener.close()


def test_its_random_client_passes_over_a_serial_port(tmp_path: Path, clock: RealClock) -> None:
    client = built("random-test-client", tmp_path, over_rtu=True)
    emulator = BathEmulator(Plant(1), memory_profile(), clock, unit_id=UNIT, framing="rtu")
    listener = PtyListener(emulator, clock, lock=threading.RLock(), name="bath")
    try:
        assert passes(client, PEER_DEVICE=listener.url)
    finally:
        listener.close()


def test_its_random_client_notices_an_emulator_that_errs(tmp_path: Path, clock: RealClock) -> None:
    """The witness is one: with a register that takes less than 16 bits, it does not pass."""
    client = built("random-test-client", tmp_path)
    profile = memory_profile()
    rows = tuple(
        row.model_copy(update={"range": (0.0, 99.0)}) if row.name == "r50" else row
        for row in profile.rows
    )
    emulator = BathEmulator(
        Plant(1), profile.model_copy(update={"rows": rows}), clock, unit_id=ANY_TCP
    )
    listener = Listener(emulator, clock, lock=threading.RLock(), name="bath")
    try:
        assert not passes(client, PEER_PORT=str(listener.port))
    finally:
        listener.close()


# ---- its server answers


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built("unit-test-server", tmp_path_factory.mktemp("libmodbus"))


@contextmanager
def running(server: Path, kind: str, **address: str) -> Iterator[None]:
    environment = {**os.environ, **address}
    with subprocess.Popen(
        [server, kind], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment
    ) as process:
        try:
            yield
        finally:
            process.kill()


@contextmanager
def tcp_server(server: Path) -> Iterator[str]:
    port = free_port()
    with running(server, "tcp", PEER_PORT=str(port)):
        yield f"tcp://127.0.0.1:{port}"


@contextmanager
def rtu_server(server: Path) -> Iterator[str]:
    clock, bridge = RealClock(), Bridge()
    listener = Listener(bridge, clock, lock=threading.RLock(), name="bridge")
    try:
        with running(server, "rtu", PEER_DEVICE=bridge.path):
            yield f"rtu+tcp://127.0.0.1:{listener.port}"
    finally:
        listener.close()
        bridge.close()
        clock.close()


@pytest.fixture(params=[("tcp", AS_KNOWN_S), ("rtu", AS_KNOWN_S), ("rtu", SLOWER_S)], ids=str)
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


def test_one_register_for_two_is_no_answer(link: Transactions) -> None:
    with pytest.raises(ProtocolError, match="1 registers were answered where 2 were asked"):
        link.read(3, REGISTERS, 2)
    assert link.read(3, REGISTERS, 3) == VALUES


def test_busy_is_told(link: Transactions) -> None:
    with pytest.raises(RefusedError, match="busy") as caught:
        link.read(3, BUSY, 1)
    assert caught.value.code == 6
    assert link.read(3, REGISTERS, 3) == VALUES


def test_an_answer_for_somebody_else_is_none(link: Transactions) -> None:
    with pytest.raises((LinkError, ProtocolError)):
        link.read(3, OTHER, 1)
    assert after_trouble(link) == VALUES


def test_a_late_answer_is_never_another_ones(link: Transactions) -> None:
    with suppress(InstrumentError):
        assert link.read(3, LATE, 1) == [0]
    # each as long as the late one
    for address, value in zip(range(REGISTERS, REGISTERS + 3), VALUES, strict=True):
        with suppress(InstrumentError):
            assert link.read(3, address, 1) == [value]
    assert after_trouble(link) == VALUES


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
        assert values == [known.get(address + at, 0) for at in range(count)]
        right += 1
    assert right >= 5


def until_it_answers(link: Transactions) -> None:
    deadline = time.monotonic() + 60.0
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
