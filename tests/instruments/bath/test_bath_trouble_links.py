"""What clients of Modbus get wrong about links (fact sheet, section 2.3, P7 to P10): none at first,
one that breaks, one that is shared.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest

from instruments.bath.connection import parse_line
from instruments.bath.errors import BrokenError
from instruments.bath.transactions import Transactions
from instruments.clock import Clock, RealClock
from instruments.errors import LinkError
from instruments.listener import Listener
from tests.instruments.bath.far_end import FarEnd, crc, rtu, served, virtual
from tests.instruments.bath.linked import linked, right

# ---- P7, P8: links that are not there, or go


def test_p7_a_first_connect_that_fails_is_tried_again() -> None:
    with virtual() as (elsewhere, url):
        clock, port = elsewhere.clock, int(url.rpartition(":")[2])
    listeners: list[Listener] = []
    far_end = FarEnd(clock)
    clock.call_at(
        1.0,
        lambda: listeners.append(
            Listener(far_end, clock, lock=threading.RLock(), name="far end", port=port)
        ),
    )
    link = Transactions(parse_line(url), clock, who="bath")
    link.connect()
    assert clock.now() == pytest.approx(1.5)  # 0.1, 0.3, 0.7, 1.5 s: growing pauses
    assert link.read(3, 0, 1) == [0]
    link.close()
    listeners[0].close()


def test_p7_nobody_there_is_said_after_some_tries() -> None:
    with virtual() as (far_end, url):
        clock = far_end.clock
    link = Transactions(parse_line(url), clock, who="bath at X")
    with pytest.raises(
        LinkError, match=r"bath at X: nothing took the connection in 6 tries: .+ \(after 3\.1 s\)"
    ):
        link.connect()


def test_a_port_that_is_not_there_is_said_with_the_systems_words() -> None:
    with virtual() as (far_end, _):
        link = Transactions(parse_line("/dev/no-such-port"), far_end.clock, who="bath")
        with pytest.raises(
            LinkError, match=r"can't be opened in 6 tries: .*no-such-port.*list_ports"
        ):
            link.connect()


def test_p8_a_link_that_breaks_raises_and_opens_once_more() -> None:
    with linked() as (far_end, link):
        for _ in range(5):
            far_end.hosts[0].hang_up()
            with pytest.raises(BrokenError):
                link.read(3, 0, 1)
            link.connect()
            assert link.read(3, 1, 1) == right(1)
            assert len(far_end.hosts) == 1


# ---- P9, P10: real time


@contextmanager
def real(framing: str) -> Iterator[tuple[FarEnd, Transactions]]:
    with ExitStack() as stack:
        clock: Clock = RealClock()
        stack.callback(clock.close)  # type: ignore[attr-defined]
        far_end = FarEnd(clock, framing=framing)
        far_end.memory = {address: 100 * (address + 1) for address in range(16)}
        url = stack.enter_context(served(far_end))
        link = Transactions(parse_line(url), clock, who="bath", quiet_s=0.1)
        link.connect()
        stack.callback(link.close)
        yield far_end, link


@pytest.mark.parametrize("framing", ["rtu", "tcp"])
def test_p9_four_threads_with_a_lock_have_one_connection_and_no_wrong_value(framing: str) -> None:
    lock, wrong = threading.Lock(), []
    with real(framing) as (far_end, link):

        def ask(address: int) -> None:
            for _ in range(300):
                with lock:
                    if link.read(3, address, 1) != right(address):
                        wrong.append(address)

        threads = [threading.Thread(target=ask, args=(address,)) for address in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert not wrong
        assert len(far_end.hosts) == 1


@pytest.mark.parametrize("framing", ["rtu", "tcp"])
def test_p10_bytes_one_by_one_are_one_answer(framing: str) -> None:
    with real(framing) as (far_end, link):
        link.read(3, 0, 1)

        def drop(frame: bytes) -> bytes:
            for at, byte in enumerate(frame):
                far_end.clock.call_at(
                    far_end.clock.now() + 0.02 * at,
                    lambda byte=byte: far_end.hosts[0].send(bytes((byte,))),  # type: ignore[misc]
                )
            return b""

        far_end.spoils = [drop]
        start = time.perf_counter()
        assert link.read(3, 0, 4) == right(0, 4)
        assert time.perf_counter() - start > 0.02 * 10


def test_the_far_end_of_these_tests_speaks_rtu_as_printed() -> None:
    assert crc(bytes.fromhex("02 07")) == bytes.fromhex("41 12")  # Modbus over serial line 1.02
    assert rtu("11 03 00 6B 00 03") == bytes.fromhex("11 03 00 6B 00 03 76 87")
