"""A console window that is closed on Windows: the system tells of it on a thread of its own, and ends the program when that returns.

What it tells and what is done about it is plain logic, and tested everywhere; only `windows_register` needs Windows. Elsewhere
a terminal that closes sends SIGHUP, and nothing here is used. May not know what safe is.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

CTRL_C_EVENT, CTRL_BREAK_EVENT, CTRL_CLOSE_EVENT, CTRL_LOGOFF_EVENT, CTRL_SHUTDOWN_EVENT = 0, 1, 2, 5, 6  # wincon.h
ENDINGS = {CTRL_CLOSE_EVENT: "console closed", CTRL_LOGOFF_EVENT: "log-off", CTRL_SHUTDOWN_EVENT: "shutdown"}

Handler = Callable[[int], bool]
Register = Callable[[Handler, bool], None]


def handler_for(ends: Callable[[str], None]) -> Handler:
    """What Windows calls: ``ends`` is told what ends the program, and has made safe when it returns.

    True says that the event is dealt with. Ctrl-C and Ctrl-Break are not: Python makes signals of them.
    """

    def handler(event: int) -> bool:
        word = ENDINGS.get(event)
        if word is None:
            return False
        ends(word)
        return True

    return handler


@contextmanager
def console_heard(ends: Callable[[str], None], register: Register | None) -> Iterator[None]:
    """Hear of a closed console while this lasts; ``register`` adds (True) or removes (False) a handler, None where nothing does."""
    if register is None:
        yield
        return
    handler = handler_for(ends)
    register(handler, True)
    try:
        yield
    finally:
        register(handler, False)


if sys.platform == "win32":
    import ctypes
    from ctypes import wintypes

    def windows_register() -> Register | None:
        """SetConsoleCtrlHandler of kernel32. What it gives back raises OSError where Windows refuses."""
        make = ctypes.WINFUNCTYPE(wintypes.BOOL, wintypes.DWORD)
        kernel32 = ctypes.WinDLL("kernel32", use_last_error=True)
        kept: dict[Handler, object] = {}  # Windows calls it at any time: it must not be collected

        def register(handler: Handler, add: bool) -> None:
            native = kept.setdefault(handler, make(handler))
            if not kernel32.SetConsoleCtrlHandler(native, add):
                raise ctypes.WinError(ctypes.get_last_error())
            if not add:
                del kept[handler]

        return register

else:

    def windows_register() -> Register | None:
        """There is none: a terminal that closes sends SIGHUP."""
        return None
