"""Transactions with a far end that holds 100 at register 0, 200 at 1 and so on: a value at the
wrong address is a wrong value.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from instruments.bath.connection import parse_line
from instruments.bath.transactions import Transactions
from tests.instruments.bath.far_end import FarEnd, virtual

MARKERS = ((3, 0, 2), (4, 0, 1), (3, 0, 3))


@contextmanager
def linked(framing: str = "rtu", *, gateway: bool = False) -> Iterator[tuple[FarEnd, Transactions]]:
    with virtual(framing, gateway=gateway) as (far_end, url):
        far_end.memory = {address: 100 * (address + 1) for address in range(16)}
        link = Transactions(parse_line(url), far_end.clock, who="bath", markers=MARKERS)
        link.connect()
        try:
            yield far_end, link
        finally:
            link.close()


def right(address: int, count: int = 1) -> list[int]:
    return [100 * (address + at + 1) for at in range(count)]
