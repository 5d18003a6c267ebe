"""The driver through pyserial, on a pseudo-terminal paced at 115200 baud, in real time: what
loopback can't show.
"""

from __future__ import annotations

import itertools
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from instruments.clock import RealClock
from instruments.errors import LinkError
from instruments.link import Link
from instruments.microscribe.driver import MicroScribe
from instruments.microscribe.emulator import ArmEmulator
from instruments.microscribe.errors import NotHomedError
from instruments.microscribe.faults import Fault
from instruments.microscribe.unit import shipped_unit

if sys.platform == "win32":
    pytest.skip("needs pseudo-terminals: Windows has none", allow_module_level=True)

from instruments.pty_listener import PtyListener

HOME = (13903, 6238, 6868, 4098, 3193, 8416)


class Peg:
    def arm_target(self) -> None:
        return None


class Bench:
    """An arm on a port whose name, as under /dev/serial/by-id, stays when the adapter comes back
    under another.
    """

    def __init__(self, folder: Path) -> None:
        self.clock = RealClock()
        self.lock = threading.RLock()
        self.arm = ArmEmulator(Peg(), self.clock, unit=shipped_unit("40937"))
        self.name = folder / "by-id"
        self.listener: PtyListener | None = None
        self.driver: MicroScribe | None = None
        self.plug_in()

    def plug_in(self, *, baud: int = 115200, latency_s: float = 0.0) -> None:
        self.listener = PtyListener(
            self.arm, self.clock, lock=self.lock, name="arm", baud=baud, latency_s=latency_s
        )
        self.name.symlink_to(self.listener.url)

    def unplug(self) -> None:
        assert self.listener is not None
        self.name.unlink()
        self.listener.close()
        self.listener = None

    def signed_on(self, baud: int = 115200) -> MicroScribe:
        self.driver = MicroScribe(
            Link(str(self.name), self.clock, who="arm", baud=baud), self.clock
        )
        self.driver.sign_on()
        return self.driver

    def close(self) -> None:
        if self.driver:
            self.driver.close()
        if self.listener:
            self.unplug()
        self.clock.close()


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    bench = Bench(tmp_path)
    yield bench
    bench.close()


def test_sign_on_poll_read_and_stream(bench: Bench) -> None:
    driver = bench.signed_on()
    assert driver.identity.serial_number == "40937"
    assert driver.warnings == ()
    assert driver.poll().counts == HOME
    driver.confirm_homed()
    assert driver.read(interval_s=0.002).spread_mm == pytest.approx(0.0, abs=1e-9)
    with driver.stream(200.0) as samples:
        got = list(itertools.islice(samples, 100))
    assert {sample.counts for sample in got} == {HOME}
    assert got[-1].t_s - got[0].t_s == pytest.approx(99 * 0.005, rel=0.05)
    assert driver.poll().counts == HOME
    assert driver.damaged == 0


def test_the_slowest_line_behind_the_slowest_adapter(bench: Bench) -> None:
    bench.unplug()
    bench.plug_in(baud=9600, latency_s=0.016)
    driver = bench.signed_on(9600)
    assert driver.baud == 9600
    driver.confirm_homed()
    assert driver.read().n == 8
    with driver.stream(stamped=False) as samples:
        assert {sample.counts for sample in itertools.islice(samples, 30)} == {HOME}
    assert driver.poll().counts == HOME
    assert driver.damaged == 0


def test_a_session_that_was_left_at_another_rate_is_found_on_a_serial_port(bench: Bench) -> None:
    bench.arm.faults.inject(Fault.WRONG_BAUD, 1, amount=38400)
    driver = bench.signed_on()
    assert driver.baud == 38400
    assert driver.poll().counts == HOME
    with pytest.raises(NotHomedError, match="another baud rate"):
        driver.confirm_homed()


def test_unplugged_and_plugged_in_again(bench: Bench) -> None:
    driver = bench.signed_on()
    driver.confirm_homed()
    bench.unplug()
    with pytest.raises(LinkError, match="the link broke"):
        driver.read()
    with pytest.raises(LinkError, match=r"can't be opened.*Serial ports on this machine"):
        driver.recover(0.5)
    back = bench.clock.now() + 1.0
    plugging = threading.Timer(1.0, bench.plug_in)
    plugging.start()
    driver.recover(10.0)
    plugging.join()
    assert bench.clock.now() - back < 2.0
    assert driver.poll().counts == HOME
    with pytest.raises(NotHomedError, match="nobody can tell whether the arm kept its power"):
        driver.read()


def test_a_port_that_another_program_has_open(bench: Bench) -> None:
    bench.signed_on()
    with pytest.raises(
        LinkError, match=r"can't be opened.*Another program has the port open: close it.*fuser"
    ):
        Link(str(bench.name), bench.clock, who="arm")


def test_a_port_that_is_not_there(bench: Bench) -> None:
    with pytest.raises(
        LinkError,
        match=(
            r"Is the adapter plugged in, and the port's name right\? Serial ports on this machine"
        ),
    ):
        Link(str(bench.name.with_name("ttyUSB9")), bench.clock, who="arm")


def test_a_port_that_one_may_not_use(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "could not open port: Permission denied")

    monkeypatch.setattr("serial.serial_for_url", refuse)
    with pytest.raises(LinkError, match=rf"belongs to the group '{bench.name.group()}'.*usermod"):
        Link(str(bench.name), bench.clock, who="arm")
