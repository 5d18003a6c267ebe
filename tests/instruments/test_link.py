"""Links and listeners: bytes over loopback, under real and virtual time."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from typing import Any

import pytest

from bench.rig.urls import serial_url
from bench.safety.signals import no_lock_is_kept
from instruments.bath.connection import parse_line
from instruments.clock import Clock, RealClock, VirtualClock
from instruments.errors import LinkError, ProtocolError
from instruments.link import Link
from instruments.listener import Connection, Listener
from tests.instruments.interrupts import interrupts
from tests.instruments.listening_in import Echo, Heard, linked

Virtual = tuple[VirtualClock, Link]


@pytest.fixture
def virtual() -> Iterator[Virtual]:
    clock = VirtualClock()
    with linked(Echo(12.0), clock) as (link, _):
        yield clock, link


def test_the_greeting_is_there_before_time_moves(virtual: Virtual) -> None:
    clock, link = virtual
    assert link.read_until(b"\n", 1.0) == b"hello\n"
    assert clock.now() == 0.0


def test_a_later_answer_comes_at_its_time_exactly(virtual: Virtual) -> None:
    clock, link = virtual
    for turn in range(50):
        start = clock.now()
        link.drain(0.1)
        assert clock.now() == pytest.approx(start + 0.1, abs=1e-9)
        link.write(b"move")
        assert link.read(4, 1.0) == b"MOVE"
        asked = clock.now()
        assert link.read_until(b"\n", 60.0) == b"done\n"
        assert clock.now() == pytest.approx(asked + 12.0, abs=1e-9), f"turn {turn}"


def test_silence_costs_virtual_time_only(virtual: Virtual) -> None:
    clock, link = virtual
    link.read_until(b"\n", 1.0)
    link.write(b"silent")
    assert link.receive(3600.0) == b""
    assert clock.now() == 3600.0


def test_what_follows_the_terminator_is_kept(virtual: Virtual) -> None:
    _, link = virtual
    link.read_until(b"\n", 1.0)
    link.write(b"one\ntwo\nthree")
    assert link.read_until(b"\n", 1.0) == b"ONE\n"
    assert link.read(5, 1.0) == b"TWO\nT"
    assert link.read(4, 1.0) == b"HREE"


Served = tuple[Clock, Listener, Link]


@pytest.fixture(params=[VirtualClock, RealClock])
def served(request: pytest.FixtureRequest) -> Iterator[Served]:
    clock = request.param()
    with linked(Echo(0.05), clock) as (link, listener):
        assert link.read_until(b"\n", 1.0) == b"hello\n"
        yield clock, listener, link
    if isinstance(clock, RealClock):
        clock.close()


def test_a_later_answer_is_waited_for(served: Served) -> None:
    clock, _, link = served
    link.write(b"a")
    assert link.read_until(b"\n", 5.0) == b"Adone\n"
    assert clock.now() >= 0.05


def test_a_device_that_hangs_up_breaks_the_link(served: Served) -> None:
    _, _, link = served
    link.write(b"x")
    with pytest.raises(LinkError, match="hung up"):
        link.receive(5.0)


def test_a_closed_link_says_so_to_every_call_until_it_is_opened_again(served: Served) -> None:
    _, listener, link = served
    link.close()
    for call in (
        lambda: link.write(b"a"),
        lambda: link.receive(1.0),
        lambda: link.read(1, 1.0),
        lambda: link.read_until(b"\n", 1.0),
        lambda: link.drain(0.0),
        lambda: link.set_baud(9600),
    ):
        with pytest.raises(LinkError, match="the link is closed"):
            call()
    link.reopen()
    assert link.read_until(b"\n", 1.0) == b"hello\n"
    link.close()
    listener.close()
    with pytest.raises(LinkError, match="nothing takes the connection"):
        link.reopen()
    with pytest.raises(LinkError, match="the link is closed"):
        link.receive(1.0)


def test_closing_leaves_no_thread() -> None:
    before = threading.active_count()
    device = Echo()
    with linked(device, RealClock()) as (link, listener):
        link.read_until(b"\n", 1.0)
        listener.close()
    assert threading.active_count() == before
    assert (len(device.connections), device.gone) == (1, 1)


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("socket://127.0.0.1:1", r"nothing takes the connection: [^\[]"),
        ("socket://127.0.0.1", "host or port is missing"),
        ("socket://127.0.0.1:99999", "not a link"),
        ("/dev/no-such-port", "can't be opened"),
    ],
)
def test_a_link_that_cannot_be_opened_says_why(url: str, message: str) -> None:
    with pytest.raises(LinkError, match=message) as caught:
        Link(url, VirtualClock(), who="arm")
    assert str(caught.value).startswith(f"arm at {url}")


def test_planned_actions_run_in_order_of_time() -> None:
    clock = VirtualClock()
    seen: list[tuple[float, str]] = []
    clock.call_at(2.0, lambda: seen.append((clock.now(), "b")))
    clock.call_at(1.0, lambda: seen.append((clock.now(), "a")))
    clock.call_at(2.0, lambda: seen.append((clock.now(), "c")))
    clock.call_at(9.0, lambda: seen.append((clock.now(), "late")))
    clock.sleep(5.0)
    assert seen == [(1.0, "a"), (2.0, "b"), (2.0, "c")]
    assert clock.now() == 5.0


def test_a_tap_gets_every_byte_once_and_in_order() -> None:
    tap = Heard()
    with linked(Echo(12.0), VirtualClock(), tap=tap) as (link, listener):
        link.read_until(b"\n", 1.0)
        link.write(b"one\ntwo")
        link.read_until(b"\n", 1.0)
        link.read(3, 1.0)
    assert tap.text == [
        ("opened", listener.url),
        ("received", b"hello\n"),
        ("sent", b"one\ntwo"),
        ("received", b"ONE\nTWO"),
        ("closed", ""),
    ]


def test_a_reopened_link_has_forgotten_what_came_before(virtual: Virtual) -> None:
    _, link = virtual
    link.read_until(b"\n", 1.0)
    link.write(b"old\nolder")
    assert link.read_until(b"\n", 1.0) == b"OLD\n"
    link.reopen()
    assert link.drain(20.0) == b"hello\n"


def test_what_was_sent_is_taken_before_time_moves() -> None:
    clock, heard_s = VirtualClock(), []

    class Slow(Echo):
        """Notes when it hears, after a while of real time."""

        def receive(self, connection: Connection, data: bytes) -> None:
            time.sleep(0.02)
            heard_s.append(clock.now())

    with linked(Slow(), clock) as (link, _):
        for _ in range(5):
            link.write(b"x")
            clock.sleep(1.0)
    assert heard_s == [0.0, 1.0, 2.0, 3.0, 4.0]


# Ctrl-C at any instruction of a conversation: the link can go on, and nothing hangs

INTERRUPTS = 300


@pytest.mark.slow
def test_a_conversation_that_was_interrupted_anywhere_goes_on() -> None:
    linked_here = linked(Echo(0.5), VirtualClock())
    with no_lock_is_kept(), linked_here as (link, _), interrupts() as interrupt_in:
        for number in range(INTERRUPTS):
            with pytest.raises(KeyboardInterrupt):  # noqa: PT012 - wherever it strikes
                interrupt_in(0.0005 + (number % 37) * 0.00003)
                while True:
                    link.write(b"a\n")
                    link.read_until(b"done\n", 5.0)
        link.drain(2.0)
        link.write(b"still there\n")
        assert link.read_until(b"done\n", 5.0) == b"STILL THERE\ndone\n"


# ---- the lines of a serial port


class FakeSerial:
    """Notes what is done to it, in order."""

    done: list[Any]
    baudrate: int

    def __init__(self) -> None:
        self.__dict__["done"] = []
        self.__dict__["baudrate"] = 9600

    def __setattr__(self, name: str, value: object) -> None:
        self.done.append((name, value))

    def __getattr__(self, name: str) -> object:
        return lambda *given: self.done.append((name, *given))


def done_by(url: str, data: bytes, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What the URL's settings do to a port that is opened and written to."""
    port, given = FakeSerial(), {}

    def open_it(_: str, **settings: object) -> FakeSerial:
        given.update(settings)
        return port

    monkeypatch.setattr("serial.serial_for_url", open_it)
    line = parse_line(url)
    link = Link(line.url, RealClock(), who="bath", baud=line.baud, port=line.serial)
    link.write(data)
    return [("given", given), *port.done]


def test_dtr_and_rts_are_set_before_the_port_is_open(monkeypatch: pytest.MonkeyPatch) -> None:
    done = done_by("COM5?dtr=off&rts=off&baud=9600", b"x", monkeypatch)
    assert done[1:4] == [("dtr", False), ("rts", False), ("open",)]
    assert done[0][1]["do_not_open"] is True


def test_an_arms_or_stages_url_sets_the_lines_before_the_port_is_open(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    port = FakeSerial()

    def open_it(url: str, **_: object) -> FakeSerial:
        port.done.append(url)
        return port

    monkeypatch.setattr("serial.serial_for_url", open_it)
    Link("COM5?dtr=off&rts=on", RealClock(), who="stage").reopen()
    lines = ["COM5", ("dtr", False), ("rts", True), ("open",)]
    assert port.done[:4] == lines
    assert [step for step in port.done if step in lines] == 2 * lines


@pytest.mark.parametrize("query", ["", "dtr", "dtr=low", "drt=off", "dtr=on&dtr=off", "baud=9600"])
def test_a_key_that_a_port_does_not_have_is_refused(query: str) -> None:
    with pytest.raises(LinkError, match="is no setting of this port"):
        Link(f"COM5?{query}", RealClock(), who="stage")
    with pytest.raises(ValueError, match="is no setting of this port"):
        serial_url(f"COM5?{query}")


def test_keys_are_a_serial_ports_alone() -> None:
    for url in ("COM5?dtr=off", "/dev/ttyUSB0?rts=off", "rfc2217://h:4001?dtr=off&rts=off"):
        assert serial_url(url) == url
    with pytest.raises(ValueError, match="not a link"):
        serial_url("socket://h:4001?dtr=off")


def test_without_a_key_the_lines_are_the_systems(monkeypatch: pytest.MonkeyPatch) -> None:
    assert done_by("COM5?baud=9600", b"x", monkeypatch)[1] == ("open",)


def test_seven_even_one_and_eight_none_two(monkeypatch: pytest.MonkeyPatch) -> None:
    for url, frame in (
        ("COM5?bytesize=7&parity=E&handshake=rtscts", (7, "E", 1, True)),
        ("rfc2217://h:4001?bytesize=8&parity=n&stopbits=2", (8, "N", 2, False)),
    ):
        given = done_by(f"{url}&baud=4800", b"", monkeypatch)[0][1]
        keys = ("bytesize", "parity", "stopbits", "rtscts")
        assert tuple(given[key] for key in keys) == frame


def test_rts_turns_the_direction_and_stays_up_while_bytes_leave(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    naps: list[float] = []
    monkeypatch.setattr("instruments.link.sleep", naps.append)
    done = done_by("COM5?rs485=on&baud=9600", b"status\r", monkeypatch)
    assert done[1:3] == [("rts", False), ("open",)]
    assert done[-4:] == [("rts", True), ("write", b"status\r"), ("flush",), ("rts", False)]
    assert naps == [pytest.approx(7 * 10 / 9600, abs=0.003)]


class Flood(Echo):
    """Sends without end, and no line end."""

    def receive(self, connection: Connection, data: bytes) -> None:
        for _ in range(40):
            connection.send(b"\x83" * (1 << 15))


@pytest.mark.parametrize("kind", [RealClock, VirtualClock])
def test_a_far_end_that_sends_without_end_is_a_named_fault(kind: type[Clock]) -> None:
    clock = kind()
    with ExitStack() as stack:
        if isinstance(clock, RealClock):
            stack.enter_context(closing(clock))
        link, _ = stack.enter_context(linked(Flood(0.0), clock))
        assert link.read_until(b"\n", 60.0) == b"hello\n"
        link.write(b"?")
        with pytest.raises(ProtocolError, match="it sends without pause"):
            link.read_until(b"\n", 60.0)
        link.write(b"?")
        with pytest.raises(ProtocolError, match="it sends without pause"):
            link.drain(0.1, at_most_s=60.0)


def test_virtual_time_waits_for_no_device() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"socket://127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(LinkError, match=r"virtual time can't wait .*RealClock"):
            Link(url, VirtualClock(), who="arm")
