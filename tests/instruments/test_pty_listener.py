"""A device on a pseudo-terminal, opened as an adapter's port is: by pyserial, and by nothing but
the system.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator

import pytest
import serial

from instruments.clock import RealClock, VirtualClock
from instruments.errors import LinkError
from instruments.link import Link
from instruments.pty_listener import PtyListener
from tests.instruments.listening_in import Echo
from tests.waiting import within

pytestmark = pytest.mark.skipif(
    not hasattr(os, "openpty"), reason="needs pseudo-terminals: Linux and macOS have them"
)


@pytest.fixture
def echo() -> Echo:
    echo = Echo()
    echo.bye = b""  # whatever comes is echoed
    return echo


@pytest.fixture(params=[None, 115200], ids=["unpaced", "paced"])
def listener(request: pytest.FixtureRequest, echo: Echo, clock: RealClock) -> Iterator[PtyListener]:
    listener = PtyListener(echo, clock, lock=threading.RLock(), name="echo", baud=request.param)
    yield listener
    listener.close()


def test_a_link_opens_it_as_it_opens_an_adapter(
    listener: PtyListener, echo: Echo, clock: RealClock
) -> None:
    assert listener.url.startswith("/dev/")
    link = Link(listener.url, clock, who="echo")
    assert link.read_until(b"\n", 5.0) == b"hello\n"
    # nothing is echoed, turned into a line end, or taken for a command
    every = bytes(range(256)) * 4
    link.write(every)
    assert link.read(len(every), 5.0) == every.upper()
    link.close()
    within(lambda: echo.gone == 1, "noticed")


def test_a_host_that_closes_has_unplugged_and_may_plug_in_again(
    listener: PtyListener, echo: Echo, clock: RealClock
) -> None:
    url = listener.url
    link = Link(url, clock, who="echo")
    for turn in range(3):
        assert link.read_until(b"\n", 5.0) == b"hello\n"
        link.write(b"abc")
        assert link.read(3, 5.0) == b"ABC"
        link.close()
        within(lambda: echo.gone == turn + 1, "noticed")  # noqa: B023 - called within its turn
        link.reopen()
    assert link.read_until(b"\n", 5.0) == b"hello\n"
    assert not echo.connections[0].open
    assert listener.url == url
    link.close()


def test_a_host_that_opens_again_at_once_has_replugged(
    listener: PtyListener, echo: Echo, clock: RealClock
) -> None:
    link = Link(listener.url, clock, who="echo")
    for turn in range(10):
        assert link.read_until(b"\n", 5.0) == b"hello\n", f"turn {turn}"
        link.write(b"abc")
        assert link.read(3, 5.0) == b"ABC"
        link.reopen()
    link.close()


def test_a_host_that_sets_nothing_up_gets_raw_bytes_too(listener: PtyListener) -> None:
    end = os.open(listener.url, os.O_RDWR | os.O_NOCTTY)
    os.write(end, b"\x03\r\x04a")
    got = b""
    while len(got) < 10:
        got += os.read(end, 64)
    assert got == b"hello\n\x03\r\x04A"
    os.close(end)


def test_what_a_host_sends_before_it_is_noticed_is_received(
    listener: PtyListener, echo: Echo
) -> None:
    echo.bye = b"x"
    end = os.open(listener.url, os.O_RDWR | os.O_NOCTTY)
    os.write(end, b"x")  # the device hangs up, so that nothing is left to read but the end
    os.close(end)
    within(lambda: echo.gone == 1, "noticed")


def test_a_device_that_hangs_up_breaks_the_link_and_comes_back_elsewhere(
    listener: PtyListener, echo: Echo, clock: RealClock
) -> None:
    echo.bye, before = b"x", listener.url
    link = Link(before, clock, who="echo")
    link.read_until(b"\n", 5.0)
    with pytest.raises(LinkError, match="broke"):  # noqa: PT012 - amid the write, or behind what came before
        link.write(b"x")
        while True:
            link.receive(5.0)
    within(lambda: listener.url != before, "noticed")
    link.close()
    again = Link(listener.url, clock, who="echo")
    assert again.read_until(b"\n", 5.0) == b"hello\n"
    again.close()


def test_a_device_learns_the_rate_that_the_host_set(
    listener: PtyListener, echo: Echo, clock: RealClock
) -> None:
    for baud in (9600, 57600):
        link = Link(listener.url, clock, who="echo", baud=baud)
        link.read_until(b"\n", 5.0)
        assert echo.connections[-1].baud() == baud
        link.set_baud(19200)
        assert echo.connections[-1].baud() == 19200
        link.close()
        within(lambda: not echo.connections[-1].open, "noticed")


def test_a_paced_terminal_is_as_fast_as_its_wire(echo: Echo, clock: RealClock) -> None:
    listener = PtyListener(echo, clock, lock=threading.RLock(), name="echo", baud=9600)
    port = serial.Serial(listener.url, 9600, timeout=5.0)
    assert port.read(6) == b"hello\n"
    start = time.monotonic()
    port.write(bytes(95))
    assert len(port.read(95)) == 95
    assert time.monotonic() - start >= 0.1 - 0.001
    port.close()
    listener.close()


def test_closing_ends_the_thread_and_the_terminal(echo: Echo, clock: RealClock) -> None:
    listener = PtyListener(echo, clock, lock=threading.RLock(), name="echo")
    link = Link(listener.url, clock, who="echo")
    link.read_until(b"\n", 5.0)
    listener.close()
    with pytest.raises(LinkError, match="broke"):
        link.receive(5.0)
    link.close()
    assert echo.gone == 1
    assert not [thread for thread in threading.enumerate() if thread.name == "echo emulator"]
    listener.close()  # once more is no error


@pytest.mark.slow
def test_bytes_that_no_host_reads_are_lost_as_on_a_port(echo: Echo, clock: RealClock) -> None:
    listener = PtyListener(echo, clock, lock=threading.RLock(), name="echo")
    port = serial.Serial(listener.url, 115200, timeout=0.5)
    port.read(6)
    written = 0
    for _ in range(120):
        written += port.write(bytes(2500)) or 0
        time.sleep(0.001)
    got = 0
    while more := port.read(65536):
        got += len(more)
    assert 1000 < got < written == 300_000
    port.write(b"still there?")
    assert port.read(12) == b"STILL THERE?"
    port.close()
    listener.close()


def test_virtual_time_is_refused(echo: Echo) -> None:
    with pytest.raises(
        ValueError, match=r"arm: a pseudo-terminal keeps real time.*take a Listener"
    ):
        PtyListener(echo, VirtualClock(), lock=threading.RLock(), name="arm")


def test_a_system_without_terminals_says_so(
    echo: Echo, clock: RealClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(os, "openpty")
    with pytest.raises(OSError, match=r"arm: this system has no pseudo-terminals .*TCP"):
        PtyListener(echo, clock, lock=threading.RLock(), name="arm")


def test_a_terminal_that_hangs_up_amid_a_write_is_a_broken_link(
    listener: PtyListener, clock: RealClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    termios = pytest.importorskip("termios")

    def hang_up(_: int) -> None:
        raise termios.error(5, "Input/output error")

    link = Link(listener.url, clock, who="echo")
    monkeypatch.setattr(termios, "tcdrain", hang_up)
    with pytest.raises(LinkError, match="the link broke while sending"):
        link.write(b"x")
    link.close()
