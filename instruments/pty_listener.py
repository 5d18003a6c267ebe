"""The emulators' end of a serial port: a pseudo-terminal (Linux, macOS), in real time.

A host that opens it has plugged in, one that closes it has unplugged; only closing is reported, so
the thread polls for a host. When the device hangs up, another terminal takes its place. Linux's
inotify (by ctypes) shows a close that is followed by an open at once; other systems miss that.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import select
import threading

from instruments.clock import Clock, VirtualClock
from instruments.listener import Device, ServedConnection
from instruments.pacing import check_pace

_CLOSE = 0x08 | 0x10  # inotify(7): IN_CLOSE_WRITE, IN_CLOSE_NOWRITE
_FLAGS = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0)


def _watch_closings(path: str) -> int:
    """A descriptor that is readable once the file was closed. Raises OSError without inotify."""
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        end = int(libc.inotify_init1(_FLAGS))
    except (AttributeError, TypeError) as error:
        raise OSError(f"no inotify: {error}") from error
    if end < 0:
        raise OSError(ctypes.get_errno(), "inotify_init1")
    if libc.inotify_add_watch(end, os.fsencode(path), _CLOSE) < 0:
        os.close(end)
        raise OSError(ctypes.get_errno(), "inotify_add_watch")
    return end


LOOK_S = 0.01
RATES = (9600, 14400, 19200, 28800, 38400, 57600, 115200)


class PtyListener:
    """Serves ``device`` at the terminal ``url`` until closed, as `Listener`. Raises OSError without
    pseudo-terminals, ValueError under virtual time.
    """

    def __init__(
        self,
        device: Device,
        clock: Clock,
        *,
        lock: threading.RLock,
        name: str,
        baud: int | None = None,
        latency_s: float = 0.0,
    ) -> None:
        if isinstance(clock, VirtualClock):
            what = "a pseudo-terminal keeps real time and can't be had under virtual time"
            raise ValueError(f"{name}: {what}; take a Listener")
        check_pace(clock, baud, latency_s)
        self.name = name
        self._device = device
        self._clock = clock
        self._lock = lock
        self._pace = baud, latency_s
        self._closing = threading.Event()
        self._connection: ServedConnection | None = None
        self.pulled = False
        self._terminal = _Terminal(name)
        self._thread = threading.Thread(target=self._run, name=f"{name} emulator", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Where the next host finds the device: another path after the device has hung up."""
        return self._terminal.path

    def pull(self, *, out: bool) -> None:
        """As `Listener.pull`: a host that opens the terminal while it is out gets nothing."""
        with self._lock:
            self.pulled = out
            if out and self._connection:
                self._connection.hang_up()

    def close(self) -> None:
        """Hang up and wait for the thread to end; the terminal is gone then."""
        self._closing.set()
        with self._lock:
            if self._connection:
                self._connection.abort()
        self._thread.join()

    def _run(self) -> None:
        try:
            while self._await_host():
                self._serve()
        finally:
            self._terminal.close()

    def _await_host(self) -> bool:
        """Wait until a host was seen twice: it has then set up and flushed its port. False where
        the listener closes.
        """
        seen = 0
        while seen < 2:
            if self._closing.wait(LOOK_S):
                return False
            seen = seen + 1 if self._terminal.has_host() and not self.pulled else 0
        return True

    def _serve(self) -> None:
        terminal = self._terminal
        with self._lock:
            if self._closing.is_set():
                return
            self._connection = ServedConnection(terminal, self._clock, self._lock, self._pace)
        self._connection.serve(self._device)
        with self._lock:
            self._connection = None
        if terminal.hung_up and not self._closing.is_set():
            # before the host notices, so that it finds the new one
            self._terminal = _Terminal(self.name)
            terminal.close()


class _Terminal:
    """The near end of one pseudo-terminal; only ``read`` blocks. A host that closes and reopens at
    once is noticed through `_watch_closings`, and so is a second program (``stty -F``).
    """

    def __init__(self, name: str) -> None:
        self._master, self.path = _open(name)
        self._wake_near, self._wake_far = os.pipe()
        self._closings: int | None = None
        self._either: select.epoll | None = None
        with contextlib.suppress(OSError):
            self._closings = _watch_closings(self.path)
            self._either = select.epoll()
            self._either.register(self._master, select.EPOLLIN)
            self._either.register(self._closings, select.EPOLLIN)
        self._lock = threading.Lock()
        self._early = b""
        self.hung_up = False

    def fileno(self) -> int:
        return self._either.fileno() if self._either else self._master

    def has_host(self) -> bool:
        """Whether the far end is open. What it has sent already is kept for ``read``."""
        try:
            data = os.read(self._master, 65536)
        except BlockingIOError:
            pass  # open, and nothing sent
        except OSError:
            return bool(self._early)
        else:
            self._early += data
            if not data:  # macOS says so
                return bool(self._early)
        _set_raw(self._master)
        self._was_closed()  # by hosts before this one
        return True

    def _was_closed(self) -> bool:
        """Whether a host has closed since the last call; equal events come only once."""
        some = False
        if self._closings is not None:
            with contextlib.suppress(BlockingIOError):
                while os.read(self._closings, 4096):
                    some = True
        return some

    def ready(self) -> bool:
        """As `Port.ready`."""
        return bool(self._early) or bool(select.select([self], [], [], 0)[0])

    def take(self, count: int) -> bytes:
        """As `Port.take`; a host that has gone leaves OSError on Linux, and nothing on macOS."""
        if self._early:
            data, self._early = self._early[:count], self._early[count:]
            return data
        try:
            return os.read(self._master, count)
        except BlockingIOError:
            if self._closings is not None and not self._was_closed():
                raise
            # there was something, and it wasn't bytes: a host closed, and one opened at once
            return b""

    def read(self, count: int) -> bytes:
        """As `Port.read`, and as ``take``."""
        while (
            self._early
            or self._wake_near not in select.select([self.fileno(), self._wake_near], [], [])[0]
        ):
            with contextlib.suppress(BlockingIOError):
                return self.take(count)
        return b""

    def write(self, data: bytes) -> None:
        """Bytes beyond the system's buffer are lost, as on a port without flow control."""
        with contextlib.suppress(BlockingIOError):
            while data:
                data = data[os.write(self._master, data) :]

    def hang_up(self) -> None:
        """As `Port.hang_up`: the terminal itself goes once its reader has noticed."""
        with self._lock:
            if not self.hung_up:
                self.hung_up = True
                os.write(self._wake_far, b"w")

    def baud(self) -> int | None:
        """The rate that the host has set; a terminal takes any."""
        import termios

        try:
            code = termios.tcgetattr(self._master)[5]
        except termios.error:
            return None
        return next((rate for rate in RATES if code == getattr(termios, f"B{rate}", None)), None)

    def close(self) -> None:
        """The terminal is gone, for its host too."""
        with self._lock:
            self.hung_up = True
            if self._either:
                self._either.close()
            for end in (self._master, self._wake_near, self._wake_far, self._closings):
                if end is not None:
                    os.close(end)


def _open(name: str) -> tuple[int, str]:
    """The near end of a new pseudo-terminal, and the path of its far end, which is open nowhere."""
    if not hasattr(os, "openpty"):
        raise OSError(
            f"{name}: this system has no pseudo-terminals (Linux and macOS have them); let the"
            " emulator listen on TCP"
        )
    master, slave = os.openpty()
    try:
        os.set_blocking(master, False)
        _set_raw(slave)
        return master, os.ttyname(slave)
    except OSError:
        os.close(master)
        raise
    finally:
        os.close(slave)


def _set_raw(end: int) -> None:
    """No translation, no echo. macOS forgets it when a host closes; a host's choice stays."""
    import termios
    import tty

    if termios.tcgetattr(end)[3] & (termios.ECHO | termios.ICANON):
        tty.setraw(end, termios.TCSANOW)
