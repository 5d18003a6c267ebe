"""Links and listeners: bytes over loopback, under real and virtual time."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import pytest

from instruments.clock import Clock, RealClock, VirtualClock
from instruments.errors import LinkError
from instruments.link import Link
from instruments.listener import Connection, Listener
from tests.instruments.listening_in import Heard


class Echo:
    """Greets, answers at once, and once more after ``later_s``; ``x`` hangs up."""

    def __init__(self, later_s: float = 12.0) -> None:
        self.later_s = later_s
        self.hosts = 0

    def connect(self, connection: Connection) -> None:
        self.hosts += 1
        connection.send(b"hello\n")

    def receive(self, connection: Connection, data: bytes) -> None:
        if data == b"x":
            connection.hang_up()
            return
        if data == b"silent":
            return
        connection.send(data.upper())
        connection.after(self.later_s, lambda: connection.send(b"done\n"))

    def disconnect(self, connection: Connection) -> None:
        self.hosts -= 1


@pytest.fixture
def virtual() -> Iterator[tuple[VirtualClock, Link, Echo]]:
    clock, device = VirtualClock(), Echo()
    listener = Listener(device, clock, lock=threading.RLock(), name="echo")
    link = Link(listener.url, clock, who="echo")
    yield clock, link, device
    link.close()
    listener.close()


def test_the_greeting_is_there_before_time_moves(virtual: tuple[VirtualClock, Link, Echo]) -> None:
    clock, link, _ = virtual
    assert link.read_until(b"\n", 1.0) == b"hello\n"
    assert clock.now() == 0.0


def test_a_later_answer_comes_at_its_time_exactly(virtual: tuple[VirtualClock, Link, Echo]) -> None:
    clock, link, _ = virtual
    for turn in range(50):
        start = clock.now()
        link.drain(0.1)
        assert clock.now() == pytest.approx(start + 0.1, abs=1e-9)
        link.write(b"move")
        assert link.read(4, 1.0) == b"MOVE"
        asked = clock.now()
        assert link.read_until(b"\n", 60.0) == b"done\n"
        assert clock.now() == pytest.approx(asked + 12.0, abs=1e-9), f"turn {turn}"


def test_silence_costs_virtual_time_only(virtual: tuple[VirtualClock, Link, Echo]) -> None:
    clock, link, _ = virtual
    link.read_until(b"\n", 1.0)
    link.write(b"silent")
    assert link.receive(3600.0) == b""
    assert clock.now() == 3600.0


def test_what_follows_the_terminator_is_kept(virtual: tuple[VirtualClock, Link, Echo]) -> None:
    _, link, _ = virtual
    link.read_until(b"\n", 1.0)
    link.write(b"one\ntwo\nthree")
    assert link.read_until(b"\n", 1.0) == b"ONE\n"
    assert link.read(5, 1.0) == b"TWO\nT"
    assert link.read(4, 1.0) == b"HREE"


@pytest.fixture(params=["virtual", "real"])
def served(request: pytest.FixtureRequest) -> Iterator[tuple[Clock, Listener, Link]]:
    clock = VirtualClock() if request.param == "virtual" else RealClock()
    listener = Listener(Echo(later_s=0.05), clock, lock=threading.RLock(), name="echo")
    link = Link(listener.url, clock, who="echo")
    assert link.read_until(b"\n", 1.0) == b"hello\n"
    yield clock, listener, link
    link.close()
    listener.close()
    if isinstance(clock, RealClock):
        clock.close()


def test_a_later_answer_is_waited_for(served: tuple[Clock, Listener, Link]) -> None:
    clock, _, link = served
    link.write(b"a")
    assert link.read_until(b"\n", 5.0) == b"Adone\n"
    assert clock.now() >= 0.05


def test_a_device_that_hangs_up_breaks_the_link(served: tuple[Clock, Listener, Link]) -> None:
    _, _, link = served
    link.write(b"x")
    with pytest.raises(LinkError, match="hung up"):
        link.receive(5.0)


def test_a_closed_link_says_so_to_every_call_until_it_is_opened_again(
    served: tuple[Clock, Listener, Link],
) -> None:
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
    listener = Listener(device, RealClock(), lock=threading.RLock(), name="echo")
    link = Link(listener.url, RealClock(), who="echo")
    link.read_until(b"\n", 1.0)
    listener.close()
    link.close()
    assert threading.active_count() == before
    assert device.hosts == 0


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("socket://127.0.0.1:1", "nothing takes the connection"),
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


def test_a_tap_hears_every_byte_once_and_in_order() -> None:
    clock, tap = VirtualClock(), Heard()
    listener = Listener(Echo(), clock, lock=threading.RLock(), name="echo")
    link = Link(listener.url, clock, who="echo", tap=tap)
    link.read_until(b"\n", 1.0)
    link.write(b"one\ntwo")
    link.read_until(b"\n", 1.0)
    link.read(3, 1.0)
    link.close()
    listener.close()
    assert tap.told == [
        ("opened", listener.url),
        ("received", b"hello\n"),
        ("sent", b"one\ntwo"),
        ("received", b"ONE\nTWO"),
        ("closed", ""),
    ]


def test_a_reopened_link_has_forgotten_what_came_before() -> None:
    clock = VirtualClock()
    listener = Listener(Echo(), clock, lock=threading.RLock(), name="echo")
    link = Link(listener.url, clock, who="echo")
    link.read_until(b"\n", 1.0)
    link.write(b"old\nolder")
    assert link.read_until(b"\n", 1.0) == b"OLD\n"
    link.reopen()
    assert link.drain(20.0) == b"hello\n"
    listener.close()
    with pytest.raises(LinkError, match="nothing takes the connection"):
        link.reopen()
    link.close()


def test_what_was_sent_is_taken_before_time_moves() -> None:
    class Slow(Echo):
        """Notes when it hears, after a while of real time."""

        def __init__(self, clock: VirtualClock) -> None:
            super().__init__()
            self.clock = clock
            self.heard_s: list[float] = []

        def receive(self, connection: Connection, data: bytes) -> None:
            time.sleep(0.02)
            self.heard_s.append(self.clock.now())

    clock = VirtualClock()
    device = Slow(clock)
    listener = Listener(device, clock, lock=threading.RLock(), name="slow")
    link = Link(listener.url, clock, who="slow")
    for _ in range(5):
        link.write(b"x")
        clock.sleep(1.0)
    link.close()
    listener.close()
    assert device.heard_s == [0.0, 1.0, 2.0, 3.0, 4.0]


def test_an_emulator_that_is_held_up_amid_sending_does_not_let_time_move(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """On a loaded machine its thread may stand still between counting bytes and writing them for
    longer than a host waits for them.
    """
    monkeypatch.setattr("instruments.link.COUNTED_S", 0.01)
    clock = VirtualClock()
    listener = Listener(Echo(), clock, lock=threading.RLock(), name="echo")
    write = Connection._write

    def held_up(connection: Connection, data: bytes) -> None:
        time.sleep(0.1)
        write(connection, data)

    monkeypatch.setattr(Connection, "_write", held_up)
    link = Link(listener.url, clock, who="echo")
    assert link.read_until(b"\n", 1.0) == b"hello\n"
    link.write(b"one\n")
    assert link.read_until(b"\n", 1.0) == b"ONE\n"
    assert clock.now() == 0.0
    link.close()
    listener.close()
