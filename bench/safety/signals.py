"""The one place that takes requests to end the bench: Ctrl-C, SIGTERM, a dropped connection
(SIGHUP), a closed console window.

The first request is raised in the main thread as `Interrupted`, so that every `finally` runs and
the bench passes through safe; what comes while it is on its way there is only noted. Windows
reports a closed console window on a thread of its own, and ends the program when that returns.
"""

from __future__ import annotations

import _thread
import contextlib
import dis
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, TypeVar

from instruments.clock import UNBROKEN, stopwatch_s, unbroken

# wincon.h
CTRL_C_EVENT, CTRL_BREAK_EVENT, CTRL_CLOSE_EVENT = 0, 1, 2
CTRL_LOGOFF_EVENT, CTRL_SHUTDOWN_EVENT = 5, 6
ENDINGS = {
    CTRL_CLOSE_EVENT: "console closed",
    CTRL_LOGOFF_EVENT: "log-off",
    CTRL_SHUTDOWN_EVENT: "shutdown",
}

Handler = Callable[[int], bool]
Register = Callable[[Handler, bool], None]


if sys.platform == "win32":
    import ctypes
    from ctypes import wintypes

    def windows_register() -> Register | None:
        """kernel32's SetConsoleCtrlHandler; its result raises OSError where Windows refuses."""
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


ASKED_BY = {
    "SIGINT": "Ctrl-C",
    "SIGTERM": "SIGTERM: the program was ended",
    "SIGHUP": "SIGHUP: the terminal or its connection has gone",
    "SIGBREAK": "Ctrl-Break",
}
# a second Ctrl-C within this is the same request, a later one of who sees nothing happen
ON_THE_WAY_S = 5.0
AMID_A_LOCK = ("__enter__", "__exit__", "_release_save", "_acquire_restore", "notify", "notify_all")
# since Python 3.14 a signal comes between what `with` has entered and its block: what it takes
# would never be given back (python/cpython#148874)
ENTERS = dis.opmap.get("LOAD_SPECIAL")
CODE_UNIT_BYTES = 2
MOMENT_S = 0.001
LOOK_S = 0.1
CLOSE_S = 4.5  # Windows ends a program 5 s after its console was closed, whatever it does


T = TypeVar("T")


class Interrupted(KeyboardInterrupt):
    """The bench was asked to end; the text says by what."""


class Exits:
    """Handler of all signals that ask for an end. ``asked`` lists all that came."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.at_close: Callable[[], object] | None = None
        self._raised_s: float | None = None
        self._held = 0
        self._terminals = [number for number in (0, 1, 2) if _is_terminal(number)]

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if _must_go_on(frame):
            _send_again(number)
            return
        name = signal.Signals(number).name
        self.asked.append(name)
        if name == "SIGHUP":  # a write to a terminal that has gone would fail amid going to safe
            nowhere = os.open(os.devnull, os.O_RDWR)
            for terminal in self._terminals:
                os.dup2(nowhere, terminal)
            os.close(nowhere)
        now = stopwatch_s()
        if self._held or (self._raised_s is not None and now - self._raised_s < ON_THE_WAY_S):
            return
        self._raised_s = now
        raise _interrupted(name)

    def take_dropped(self, dropped: Any) -> bool:
        """Python drops what is raised in ``__del__`` or a weak reference's callback: once more."""
        if taken := isinstance(dropped.exc_value, Interrupted):
            self._raised_s = None
            _send_again(signal.Signals[self.asked.pop()])
        return taken

    def hold(self) -> None:
        """From now on requests are noted and not raised. Each call needs its ``let_go``."""
        self._held += 1

    def let_go(self) -> None:
        """Requests are raised again."""
        self._held -= 1

    def check_interrupts(self) -> None:
        """Raise what came while requests were held, where the bench has not ended for it."""
        if self.asked and self._raised_s is None:
            self._raised_s = stopwatch_s()
            raise _interrupted(self.asked[0])

    def console_event(self, event: int) -> bool:
        """Windows calls it on a thread of its own: makes safe there. False for Ctrl-C and
        Ctrl-Break, of which Python makes signals.
        """
        how = ENDINGS.get(event)
        if how is None:
            return False
        self.asked.append(how)
        if self.at_close is not None:
            work = threading.Thread(target=self.at_close, name="console closed", daemon=True)
            work.start()
            work.join(CLOSE_S)
        return True


@unbroken  # it may come back before this has returned, into what was interrupted
def _send_again(number: int) -> None:
    """The signal comes once more, in a moment; also out of a call that waits."""
    if sys.platform == "win32":
        later = threading.Timer(MOMENT_S, _thread.interrupt_main, (number,))
    else:
        main = threading.main_thread().ident or 0
        later = threading.Timer(MOMENT_S, signal.pthread_kill, (main, number))
    later.daemon = True
    later.start()


def _interrupted(name: str) -> Interrupted:
    return Interrupted(f"the run was interrupted ({ASKED_BY.get(name, name)})")


@contextmanager
def installed(register: Register | None = None) -> Iterator[Exits]:
    """Handle all requests to end while this lasts; what was ignored before (`nohup`) stays so."""
    exits = Exits()
    if threading.current_thread() is not threading.main_thread():
        yield exits
        return
    received = [number for number in _numbers() if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, exits) for number in received}
    register, handler = register or windows_register(), exits.console_event
    try:
        if register:
            register(handler, True)
        try:
            with _seeing_dropped(exits.take_dropped):
                yield exits
        finally:
            if register:
                register(handler, False)
    finally:
        for number, old in before.items():
            signal.signal(number, old)


@contextmanager
def _seeing_dropped(take: Callable[[Any], bool]) -> Iterator[None]:
    """``take`` gets what Python drops meanwhile, and says whether it was a request to end."""
    hook = sys.unraisablehook

    @unbroken
    def show_dropped(dropped: Any) -> None:
        if not take(dropped):
            hook(dropped)

    sys.unraisablehook = show_dropped
    try:
        yield
    finally:
        sys.unraisablehook = hook


def current() -> Exits:
    """The installed one; one that takes no signal where none is."""
    handlers = map(signal.getsignal, _numbers())
    return next((handler for handler in handlers if isinstance(handler, Exits)), Exits())


def _numbers() -> list[signal.Signals]:
    """The signals of this system that ask for an end."""
    return [getattr(signal, name) for name in ASKED_BY if hasattr(signal, name)]


@contextmanager
def undisturbed() -> Iterator[None]:
    """Requests to end are noted and not raised: going to safe is short, and must not be cut off."""
    exits = current()
    exits.hold()
    try:
        yield
    finally:
        exits.let_go()


def in_own_thread(work: Callable[[], T]) -> T:
    """``work`` in a thread of its own, for what has to be done although a thread of a driver goes
    on raising in this one. A request to end raises `Interrupted` here.
    """
    given, raised = list[T](), list[BaseException]()
    begins, working = threading.Lock(), threading.Lock()
    begins.acquire()
    working.acquire()

    def run() -> None:
        begins.acquire()
        try:
            given.append(work())
        except BaseException as error:
            raised.append(error)
        working.release()

    try:
        threading.Thread(target=run, name="the end of a run", daemon=True).start()
    except Exception:  # no more threads are to be had; what is raised here may break it off
        return work()
    while True:
        try:
            if given or raised:
                break
            if begins.locked():
                begins.release()
            working.acquire(timeout=LOOK_S)
        except Interrupted:
            raise
        except BaseException:  # noqa: S112 - its first one is in the record
            continue
    if raised:
        raise raised[0]
    return given[0]


@contextmanager
def no_lock_is_kept() -> Iterator[None]:
    """While this lasts, Python's own Ctrl-C waits for a lock that is being taken or given back, and
    comes again where Python drops it: for a program that uses the API, and handles no signals.
    """
    own = threading.current_thread() is threading.main_thread()
    if not own or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    signal.signal(signal.SIGINT, _raise_ctrl_c)
    try:
        with _seeing_dropped(_take_ctrl_c):
            yield
    finally:
        own = threading.current_thread() is threading.main_thread()
        if own and signal.getsignal(signal.SIGINT) is _raise_ctrl_c:
            signal.signal(signal.SIGINT, signal.default_int_handler)


def _raise_ctrl_c(number: int, frame: FrameType | None) -> None:
    if _must_go_on(frame):
        _send_again(number)
    else:
        signal.default_int_handler(number, frame)


def _take_ctrl_c(dropped: Any) -> bool:
    if taken := isinstance(dropped.exc_value, KeyboardInterrupt):
        _send_again(signal.SIGINT)
    return taken


def _must_go_on(frame: FrameType | None) -> bool:
    """Whether Python is taking or giving back a lock, or what is unbroken is at work here."""
    if frame is not None and frame.f_lasti >= CODE_UNIT_BYTES:
        before = frame.f_code.co_code[frame.f_lasti - CODE_UNIT_BYTES]
        if before == ENTERS:
            return True
    while frame is not None:
        code = frame.f_code
        locking = code.co_filename == threading.__file__ and code.co_name in AMID_A_LOCK
        if locking or code in UNBROKEN:
            return True
        frame = frame.f_back
    return False


def _is_terminal(number: int) -> bool:
    with contextlib.suppress(OSError):
        return os.isatty(number)
    return False
