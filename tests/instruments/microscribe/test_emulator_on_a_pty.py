"""Driver and emulated arm over pyserial and a pseudo-terminal, paced as a real line is: the nearest
to a real arm without one.
"""

from __future__ import annotations

import itertools
import os
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from instruments.clock import RealClock
from instruments.errors import LinkError
from instruments.link import Link
from instruments.microscribe.driver import MicroScribe
from instruments.microscribe.emulator import ArmEmulator
from instruments.microscribe.protocol import State
from instruments.microscribe.unit import UNIT_40937
from instruments.pty_listener import PtyListener
from tests.instruments.microscribe.bare_host import POINT, UP, Hand

pytestmark = pytest.mark.skipif(
    not hasattr(os, "openpty"), reason="needs pseudo-terminals: Linux and macOS have them"
)
POLL_S = 15 * 10 / 115200
STREAMED_S = 14 * 10 / 115200


class Rig:
    """An arm without errors of its own, at 115200 baud."""

    def __init__(self, latency_s: float = 0.0) -> None:
        self.clock = RealClock()
        self.hand = Hand()
        self.lock = threading.RLock()
        self.arm = ArmEmulator(self.hand, self.clock, accuracy_mm=0.0)
        self.listener = PtyListener(
            self.arm, self.clock, lock=self.lock, name="arm", baud=115200, latency_s=latency_s
        )
        self.drivers: list[MicroScribe] = []

    def driver(self, baud: int = 115200) -> MicroScribe:
        self.drivers.append(
            MicroScribe(Link(self.listener.url, self.clock, who="arm", baud=baud), self.clock)
        )
        return self.drivers[-1]

    def close(self) -> None:
        for driver in self.drivers:
            driver.close()
        self.listener.close()
        self.clock.close()


@pytest.fixture
def make() -> Iterator[Callable[..., Rig]]:
    rigs: list[Rig] = []

    def build(latency_s: float = 0.0) -> Rig:
        rigs.append(Rig(latency_s))
        return rigs[-1]

    yield build
    for rig in rigs:
        rig.close()
        assert rig.arm.eeprom_attempts == 0


def test_a_touch_over_a_real_port(make: Callable[..., Rig]) -> None:
    rig = make()
    driver = rig.driver()
    assert driver.sign_on() == UNIT_40937.names
    driver.confirm_homed()
    assert driver.poll().counts == UNIT_40937.home
    with rig.lock:
        rig.hand.point = POINT
    reading = driver.read()
    assert np.linalg.norm(reading.tip_mm - POINT) < 0.5
    assert reading.axis @ UP > 0.999

    start = time.monotonic()
    for _ in range(100):
        driver.poll()
    assert time.monotonic() - start >= 100 * POLL_S, "no faster than the wire"

    with driver.stream() as samples:
        next(samples)
        start = time.monotonic()
        assert len(list(itertools.islice(samples, 200))) == 200
        took_s = time.monotonic() - start
    assert took_s >= 150 * STREAMED_S, "what had come before the first look is there at once"
    assert driver.poll().counts != UNIT_40937.home


def test_an_adapter_of_one_millisecond_polls_as_the_sheet_says_at_best(
    make: Callable[..., Rig],
) -> None:
    rig = make(latency_s=0.001)
    driver = rig.driver()
    driver.sign_on()
    start = time.monotonic()
    for _ in range(100):
        driver.poll()
    rate_hz = 100 / (time.monotonic() - start)
    assert 20.0 < rate_hz <= 434.4, "a loaded machine is slower, the wire never faster"


def test_a_cable_that_breaks_within_a_packet_comes_back_elsewhere(make: Callable[..., Rig]) -> None:
    rig = make()
    driver = rig.driver()
    driver.sign_on()
    before = rig.listener.url
    with rig.lock:
        rig.arm.faults.inject("disconnect", amount=20)
    with pytest.raises(LinkError):  # noqa: PT012 - once so many bytes have passed
        for _ in range(100):
            driver.poll()
    driver.close()
    deadline = time.monotonic() + 60.0
    while rig.listener.url == before and time.monotonic() < deadline:
        time.sleep(0.005)
    again = rig.driver()
    again.sign_on()
    assert again.poll().counts == UNIT_40937.home


def test_a_session_at_another_rate_is_found_and_ended(make: Callable[..., Rig]) -> None:
    rig = make()
    with rig.lock:
        rig.arm.faults.inject("wrong baud", 1, amount=57600)
    driver = rig.driver()
    driver.sign_on()
    assert driver.poll().counts == UNIT_40937.home
    assert driver.baud == 57600


def test_the_arm_changes_its_rate_with_the_host_and_hears_no_other(
    make: Callable[..., Rig],
) -> None:
    rig = make()
    driver = rig.driver()
    driver.sign_on()
    driver.set_baud(38400)
    assert driver.poll().counts == UNIT_40937.home
    driver.close()  # the end of the session is heard: the arm finds its rate anew
    assert rig.arm.state is State.FINDING_BAUD
    with rig.lock:
        rig.arm.faults.inject("wrong baud", 1, amount=9600)
    link = Link(rig.listener.url, rig.clock, who="host", baud=38400)
    link.drain(0.1)
    made = rig.arm.packets
    link.write(b"\x03\xc5")
    assert len(link.read(2, 1.0)) == 2, "noise"
    assert (rig.arm.state, rig.arm.packets) == (State.SESSION, made)
    link.set_baud(9600)
    link.write(b"\x03")
    assert len(link.read(14, 1.0)) == 14
    assert rig.arm.packets == made + 1
    link.close()
