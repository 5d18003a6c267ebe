"""Whether anybody has closed a device file since one last asked, even if it was opened again at once.

Linux tells it through inotify, which Python has no module for; other systems don't, and there a file that is closed and
opened within a moment passes for one that stayed open. It may not know what the file is for.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import select

_CLOSE = 0x08 | 0x10  # inotify(7): IN_CLOSE_WRITE, IN_CLOSE_NOWRITE
_FLAGS = os.O_NONBLOCK | getattr(os, "O_CLOEXEC", 0)


def watch(path: str) -> Closings | None:
    """A watch over ``path``; None where the system has none to give."""
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        end = int(libc.inotify_init1(_FLAGS))
    except (AttributeError, OSError, TypeError):
        return None
    if end < 0:
        return None
    if libc.inotify_add_watch(end, os.fsencode(path), _CLOSE) < 0:
        os.close(end)
        return None
    return Closings(end)


def either(end: int, closings: Closings) -> select.epoll:
    """One thing to `select` for both: bytes at ``end``, and closings."""
    both = select.epoll()
    both.register(end, select.EPOLLIN)
    both.register(closings.fileno(), select.EPOLLIN)
    return both


class Closings:
    """``fileno`` is readable when somebody has closed the file."""

    def __init__(self, end: int) -> None:
        self._end = end

    def fileno(self) -> int:
        return self._end

    def any(self) -> bool:
        """Whether there was one since this was last asked. How many is not known: equal events are told once."""
        some = False
        with contextlib.suppress(BlockingIOError):
            while os.read(self._end, 4096):
                some = True
        return some

    def close(self) -> None:
        """Stop watching."""
        os.close(self._end)
