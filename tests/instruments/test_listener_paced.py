"""A listener with the pace of a serial line: never faster than the wire, nothing lost, in order,
and closed whole.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import pytest

from instruments.clock import RealClock, VirtualClock
from instruments.errors import LinkError
from instruments.link import Link
from instruments.listener import Connection, Listener
from instruments.pacing import Line

LATE_S = 4.0  # what a loaded machine may add to any time here


class Echo:
    """Answers with what it hears; ``x`` is answered with a farewell, and the cable broken; notes
    the pieces.
    """

    def __init__(self) -> None:
        self.heard: list[bytes] = []
        self.connection: Connection | None = None

    def connect(self, connection: Connection) -> None:
        self.connection = connection

    def receive(self, connection: Connection, data: bytes) -> None:
        self.heard.append(data)
        connection.send(b"farewell" if data == b"x" else data)
        if data == b"x":
            connection.hang_up()

    def disconnect(self, connection: Connection) -> None:
        self.connection = None


class Bench:
    def __init__(self, baud: int | None, latency_s: float = 0.0) -> None:
        self.clock = RealClock()
        self.echo = Echo()
        self.listener = Listener(
            self.echo,
            self.clock,
            lock=threading.RLock(),
            name="echo",
            baud=baud,
            latency_s=latency_s,
        )
        self.link = Link(self.listener.url, self.clock, who="echo")

    def close(self) -> None:
        self.link.close()
        self.listener.close()
        self.clock.close()


@pytest.fixture
def benches() -> Iterator[list[Bench]]:
    made: list[Bench] = []
    yield made
    for bench in made:
        bench.close()


def test_bytes_follow_one_another_on_a_line() -> None:
    line = Line(0.001)
    assert line.carry(5, from_s=1.0) == pytest.approx(1.005)
    assert line.carry(2, from_s=1.001) == pytest.approx(1.007), "behind what is on the line already"
    assert line.carry(1, from_s=9.0) == pytest.approx(9.001), "a free line starts at once"


def test_a_thousand_late_wakes_do_not_add_up() -> None:
    line = Line(0.001)
    for k in range(1000):
        # every other byte is put on the line late
        line.carry(1, from_s=0.001 * k + 0.0004 * (k % 2))
    assert line.free_s == pytest.approx(1.0004)


@pytest.mark.parametrize(("baud", "count"), [(9600, 120), (115200, 1000)])
def test_a_paced_line_is_as_fast_as_its_wire(benches: list[Bench], baud: int, count: int) -> None:
    bench = Bench(baud)
    benches.append(bench)
    asked = bytes(range(100)) * (count // 100) + bytes(count % 100)
    start = time.monotonic()
    bench.link.write(asked)
    assert bench.link.read(count, 10.0) == asked
    took_s = time.monotonic() - start
    wire_s = (count + 1) * 10 / baud  # both directions at once; the answer is one byte behind
    assert wire_s - 0.001 <= took_s < wire_s + LATE_S
    assert {len(piece) for piece in bench.echo.heard} == {1}


def test_questions_and_answers_take_turns_on_the_wire(benches: list[Bench]) -> None:
    bench = Bench(19200)
    benches.append(bench)
    start = time.monotonic()
    for _ in range(40):
        bench.link.write(b"a")
        assert bench.link.read(1, 5.0) == b"a"
    assert 40 * 20 / 19200 - 0.001 <= time.monotonic() - start < 40 * 20 / 19200 + LATE_S


def test_latency_delays_and_does_not_slow_down(benches: list[Bench]) -> None:
    bench = Bench(115200, latency_s=0.05)
    benches.append(bench)
    start = time.monotonic()
    bench.link.write(bytes(576))
    assert len(bench.link.read(576, 10.0)) == 576
    assert 0.1 - 0.001 <= time.monotonic() - start < 0.1 + LATE_S


def test_an_adapters_latency_alone(benches: list[Bench]) -> None:
    bench = Bench(None, latency_s=0.016)
    benches.append(bench)
    start = time.monotonic()
    for _ in range(5):
        bench.link.write(bytes(1000))
        assert len(bench.link.read(1000, 5.0)) == 1000
    assert 0.08 - 0.001 <= time.monotonic() - start < 0.08 + LATE_S


def test_what_a_device_says_unasked_keeps_the_pace(benches: list[Bench]) -> None:
    bench = Bench(9600)
    benches.append(bench)
    bench.link.write(b"a")
    bench.link.read(1, 5.0)
    connection = bench.echo.connection
    assert connection is not None
    assert connection.busy_s() == 0.0
    start = time.monotonic()
    connection.after(0.01, lambda: connection.send(bytes(96)))
    assert len(bench.link.read(96, 5.0)) == 96
    assert 0.11 - 0.001 <= time.monotonic() - start < 0.11 + LATE_S


def test_a_device_learns_when_its_line_is_free(benches: list[Bench]) -> None:
    bench = Bench(9600)
    benches.append(bench)
    bench.link.write(b"a")
    bench.link.read(1, 5.0)
    connection = bench.echo.connection
    assert connection is not None
    connection.send(bytes(4800))
    assert 1.0 < connection.busy_s() <= 5.0
    assert connection.baud() is None


def test_what_was_sent_before_a_hang_up_arrives(benches: list[Bench]) -> None:
    bench = Bench(9600)
    benches.append(bench)
    bench.link.write(b"x")
    assert bench.link.read(8, 5.0) == b"farewell"
    with pytest.raises(LinkError, match="hung up"):
        bench.link.receive(5.0)


def test_closing_does_not_wait_for_the_line() -> None:
    bench = Bench(9600)
    bench.link.write(bytes(5000))
    bench.link.read(10, 5.0)
    start = time.monotonic()
    bench.close()
    assert time.monotonic() - start < LATE_S, "what is on the line would take five seconds"


def test_a_host_that_goes_is_noticed(benches: list[Bench]) -> None:
    bench = Bench(115200)
    benches.append(bench)
    bench.link.write(b"a")
    bench.link.read(1, 5.0)
    bench.link.close()
    deadline = time.monotonic() + 60.0
    while bench.echo.connection is not None and time.monotonic() < deadline:
        time.sleep(0.005)
    assert bench.echo.connection is None
    bench.link.reopen()
    bench.link.write(b"b")
    assert bench.link.read(1, 5.0) == b"b"


def test_an_unpaced_line_has_no_wait(benches: list[Bench]) -> None:
    bench = Bench(None)
    benches.append(bench)
    bench.link.write(bytes(100_000))
    assert len(bench.link.read(100_000, 5.0)) == 100_000
    connection = bench.echo.connection
    assert connection is not None
    assert connection.busy_s() == 0.0
    assert max(len(piece) for piece in bench.echo.heard) > 1


@pytest.mark.parametrize(("baud", "latency_s"), [(115200, 0.0), (None, 0.016)])
def test_a_pace_is_refused_under_virtual_time(baud: int | None, latency_s: float) -> None:
    with pytest.raises(ValueError, match="keeps real time and can't be had under virtual time"):
        Listener(
            Echo(),
            VirtualClock(),
            lock=threading.RLock(),
            name="echo",
            baud=baud,
            latency_s=latency_s,
        )


@pytest.mark.parametrize(
    ("baud", "latency_s", "message"),
    [(0, 0.0, "1 baud at least, not 0"), (9600, -1.0, "0 s or more, not -1")],
)
def test_a_pace_that_no_line_has_is_refused(baud: int, latency_s: float, message: str) -> None:
    clock = RealClock()
    with pytest.raises(ValueError, match=message):
        Listener(Echo(), clock, lock=threading.RLock(), name="echo", baud=baud, latency_s=latency_s)
