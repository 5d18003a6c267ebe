"""A listener with the pace of a serial line: never faster than the wire, nothing lost, in order,
and closed whole.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import pytest

from instruments.clock import Clock, RealClock, VirtualClock
from instruments.errors import LinkError
from instruments.link import Link
from instruments.listener import Listener
from instruments.pacing import PacedDirection
from tests.instruments.listening_in import Echo, linked

Paced = Callable[..., tuple[Link, Echo]]


@pytest.fixture
def paced() -> Iterator[Paced]:
    """A link to a device, with the pace that is asked for."""
    clock = RealClock()
    with ExitStack() as stack:
        stack.callback(clock.close)

        def one(baud: int | None = None, latency_s: float = 0.0) -> tuple[Link, Echo]:
            echo = Echo(greeting=b"", farewell=b"farewell")
            link, _ = stack.enter_context(linked(echo, clock, baud=baud, latency_s=latency_s))
            link.write(b"0")
            assert link.read(1, 5.0) == b"0"
            echo.heard.clear()
            return link, echo

        yield one


@contextmanager
def lasts(least_s: float) -> Iterator[None]:
    """No faster than that: how much slower is the machine's load (`PacedDirection` holds the pace)."""
    start = time.monotonic()
    yield
    assert time.monotonic() - start >= least_s - 0.001


def test_a_thousand_late_wakes_do_not_add_up() -> None:
    line = PacedDirection(0.001)
    for k in range(1000):
        # every other byte is put on the line late
        line.carry(1, from_s=0.001 * k + 0.0004 * (k % 2))
    assert line.free_s == pytest.approx(1.0004)


@pytest.mark.parametrize(("baud", "count"), [(9600, 120), (115200, 1000)])
def test_a_paced_line_is_as_fast_as_its_wire(paced: Paced, baud: int, count: int) -> None:
    link, echo = paced(baud)
    asked = bytes(range(64)) * (count // 64) + bytes(count % 64)
    with lasts((count + 1) * 10 / baud):  # both directions at once; the answer is one byte behind
        link.write(asked)
        assert link.read(count, 10.0) == asked
    assert {len(piece) for piece in echo.heard} == {1}


@pytest.mark.parametrize(
    ("baud", "latency_s", "turns", "count", "least_s"),
    [
        (19200, 0.0, 40, 1, 40 * 20 / 19200),  # questions and answers take turns on the wire
        (115200, 0.05, 1, 576, 0.1),  # latency delays, and does not slow down
        (None, 0.016, 5, 1000, 0.08),  # an adapter's latency alone
    ],
)
def test_turns_on_the_wire(
    paced: Paced, baud: int | None, latency_s: float, turns: int, count: int, least_s: float
) -> None:
    link, _ = paced(baud, latency_s)
    with lasts(least_s):
        for _ in range(turns):
            link.write(bytes(count))
            assert len(link.read(count, 10.0)) == count


def test_what_a_device_says_unasked_keeps_the_pace(paced: Paced) -> None:
    link, echo = paced(9600)
    assert echo.connection.busy_s() == 0.0
    with lasts(0.11):
        echo.connection.after(0.01, lambda: echo.connection.send(bytes(96)))
        assert len(link.read(96, 5.0)) == 96


def test_a_device_learns_when_its_line_is_free(paced: Paced) -> None:
    _, echo = paced(9600)
    echo.connection.send(bytes(96_000))
    assert 10.0 < echo.connection.busy_s() <= 100.0
    assert echo.connection.baud() is None


def test_what_was_sent_before_a_hang_up_arrives(paced: Paced) -> None:
    link, _ = paced(9600)
    link.write(b"x")
    assert link.read(8, 5.0) == b"farewell"
    with pytest.raises(LinkError, match="hung up"):
        link.receive(5.0)


def test_closing_does_not_wait_for_the_line() -> None:
    clock = RealClock()
    with linked(Echo(greeting=b""), clock, baud=9600) as (link, _):
        link.write(bytes(96_000))
        link.read(10, 5.0)
        start = time.monotonic()
    clock.close()
    assert time.monotonic() - start < 60.0, "what is on the line would take 100 s"


def test_an_unpaced_line_has_no_wait(paced: Paced) -> None:
    link, echo = paced()
    link.write(bytes(100_000))
    assert len(link.read(100_000, 5.0)) == 100_000
    assert echo.connection.busy_s() == 0.0
    assert max(len(piece) for piece in echo.heard) > 1


VIRTUAL = "keeps real time and can't be had under virtual time"


@pytest.mark.parametrize(
    ("clock", "baud", "latency_s", "message"),
    [
        (VirtualClock(), 115200, 0.0, VIRTUAL),
        (VirtualClock(), None, 0.016, VIRTUAL),
        (RealClock(), 0, 0.0, "1 baud at least, not 0"),
        (RealClock(), 9600, -1.0, "0 s or more, not -1"),
    ],
)
def test_a_pace_that_cannot_be_is_refused(
    clock: Clock, baud: int | None, latency_s: float, message: str
) -> None:
    lock = threading.RLock()
    with pytest.raises(ValueError, match=message):
        Listener(Echo(), clock, lock=lock, name="echo", baud=baud, latency_s=latency_s)
