"""Driver and emulated arm over pyserial and a pseudo-terminal, paced as a real line is, in real time:
what loopback can't show.
"""

from __future__ import annotations

import itertools
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from instruments.clock import RealClock
from instruments.errors import LinkError
from instruments.link import Link
from instruments.microscribe.driver import MicroScribe
from instruments.microscribe.emulator import ArmEmulator
from instruments.microscribe.faults import ArmFault
from instruments.microscribe.protocol import State
from instruments.pty_listener import PtyListener
from tests.instruments.microscribe.rigs import POINT, UNIT, UP, Hand

pytestmark = pytest.mark.skipif(
    not hasattr(os, "openpty"), reason="needs pseudo-terminals: Linux and macOS have them"
)


class Bench:
    """An arm without errors of its own, on a port whose name, as under /dev/serial/by-id, stays when
    the adapter comes back under another.
    """

    def __init__(self, folder: Path) -> None:
        self.clock = RealClock()
        self.lock = threading.RLock()
        self.hand = Hand(self.clock)
        self.arm = ArmEmulator(self.hand, self.clock, accuracy_mm=0.0)
        self.name = folder / "by-id"
        self.listener: PtyListener | None = None
        self.drivers: list[MicroScribe] = []
        self.plug_in()

    def plug_in(self) -> None:
        self.listener = PtyListener(
            self.arm, self.clock, lock=self.lock, name="arm", baud=115200, latency_s=0.0
        )
        self.name.symlink_to(self.listener.url)

    def unplug(self) -> None:
        if self.listener:
            self.name.unlink()
            self.listener.close()
        self.listener = None

    def signed_on(self) -> MicroScribe:
        link = Link(str(self.name), self.clock, who="arm", baud=115200)
        self.drivers.append(MicroScribe(link, self.clock))
        self.drivers[-1].sign_on()
        return self.drivers[-1]

    def close(self) -> None:
        for driver in self.drivers:
            driver.close()
        self.unplug()
        self.clock.close()


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    bench = Bench(tmp_path)
    yield bench
    bench.close()
    assert bench.arm.eeprom_attempts == 0


@pytest.mark.slow
def test_a_touch_over_a_real_port(bench: Bench) -> None:
    driver = bench.signed_on()
    assert driver.identity == UNIT.names
    assert driver.warnings == ()
    driver.confirm_homed()
    assert driver.poll().counts == UNIT.home
    with bench.lock:
        bench.hand.point = POINT
    reading = driver.read()
    assert np.linalg.norm(reading.tip_mm - POINT) < 0.5
    assert reading.axis @ UP > 0.999

    start = time.monotonic()
    for _ in range(100):
        driver.poll()
    assert time.monotonic() - start >= 100 * 15 * 10 / 115200, "no faster than the wire"

    start = time.monotonic()  # before the first can come: at load many are there at the first look
    with driver.stream() as samples:
        assert len(list(itertools.islice(samples, 200))) == 200
        took_s = time.monotonic() - start
    assert took_s >= 200 * 16 * 10 / 115200, "no faster than the wire"
    assert driver.poll().counts != UNIT.home
    assert driver.damaged == 0


def test_the_arm_changes_its_rate_with_the_host_and_takes_no_other(bench: Bench) -> None:
    bench.arm.faults.inject(ArmFault.WRONG_BAUD, 1, amount=9600)
    link = Link(str(bench.name), bench.clock, who="host", baud=38400)
    link.drain(0.1)
    link.write(b"\x03\xc5")
    assert len(link.read(2, 1.0)) == 2, "noise"
    assert (bench.arm.state, bench.arm.packets) == (State.SESSION, 0)
    link.set_baud(9600)
    link.write(b"\x03")
    assert len(link.read(14, 1.0)) == 14
    link.write(b"\xc4\x10")
    assert link.read(1, 1.0) == b"\xc4", "at the old rate"
    link.set_baud(38400)
    link.write(b"\x03")
    assert len(link.read(14, 1.0)) == 14
    assert bench.arm.packets == 2
    link.close()


@pytest.mark.slow
def test_a_port_that_another_program_has_open(bench: Bench) -> None:
    bench.signed_on()
    with pytest.raises(
        LinkError, match=r"can't be opened.*Another program has the port open: close it.*fuser"
    ):
        Link(str(bench.name), bench.clock, who="arm")


def test_a_port_that_one_may_not_use(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "could not open port: Permission denied")

    monkeypatch.setattr("serial.serial_for_url", refuse)
    with pytest.raises(LinkError, match=rf"belongs to the group '{bench.name.group()}'.*usermod"):
        Link(str(bench.name), bench.clock, who="arm")
