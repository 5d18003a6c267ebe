"""Ports for programs that must be told theirs before they bind it."""

from __future__ import annotations

import os
import socket
from itertools import chain


def free_ports(count: int) -> int:
    """The first of so many that are free. Systems hand none of these out of their own accord, and
    each process begins elsewhere: nobody takes them before they are bound.
    """
    own = os.getpid() * count % 9_000
    for base in chain(range(21_000 + own, 30_000, count), range(21_000, 21_000 + own, count)):
        try:
            for port in range(base, base + count):
                socket.create_server(("127.0.0.1", port)).close()
        except OSError:
            continue
        return base
    raise AssertionError("no free ports")
