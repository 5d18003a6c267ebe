"""A byte link to an instrument, by URL. Under virtual time it waits by moving the clock.

``/dev/ttyUSB0``, ``COM5`` and ``rfc2217://host:port`` are opened by pyserial, each also with
``?dtr=off&rts=off``. socket://, tcp:// and rtu+tcp:// with host:port are opened here: pyserial's
own handler reads one byte a call and sleeps 0.3 s when it closes.
"""

from __future__ import annotations

import contextlib
import re
import select
import socket
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from time import monotonic, sleep
from typing import Any
from urllib.parse import urlsplit

import serial
from serial.tools import list_ports

from instruments.clock import Clock, HostPort, VirtualClock
from instruments.errors import LinkError, ProtocolError
from instruments.port_settings import PortSettings, with_lines

SLICE_S = 1.0
LOOK_S = 0.002
EIGHT_N_ONE = PortSettings()
SOCKETS = ("socket://", "tcp://", "rtu+tcp://")
# in one wait: at 115200 baud so much takes a minute and a half, longer than any wait for an answer
MOST_BYTES = 1 << 20
LATE_S = 1.0  # what came in time on a busy machine is read until so long after the deadline
SEEN_BYTES = 60  # of what came, in an error

SYSFS = Path("/sys")
FTDI_DEVICES = r"SYSTEM\CurrentControlSet\Enum\FTDIBUS"  # in the registry
WANTED_MS = 1  # of an adapter's latency timer


class Tap:
    """Gets every byte of a link in order and changes none; this one drops them."""

    def opened(self, url: str) -> None:
        """The link was opened, or opened again."""

    def sent(self, data: bytes) -> None:
        """The host sent these bytes."""

    def received(self, data: bytes) -> None:
        """These bytes came from the instrument."""

    def closed(self, why: str = "") -> None:
        """The host closed the link, or it broke because of ``why``. Called once a link."""


class Reception:
    """One wait for what a peer sends: until ``until_s``. What has come by then is taken for LATE_S
    more; a peer that sends more than ``MOST_BYTES`` bytes is none of our instruments.
    """

    def __init__(self, who: str, clock: Clock, until_s: float) -> None:
        self.until_s = until_s
        self._who, self._clock, self._start_s, self._count = who, clock, clock.now(), 0

    @property
    def left_s(self) -> float:
        """Until the deadline; 0 behind it."""
        return max(0.0, self.until_s - self._clock.now())

    @property
    def over(self) -> bool:
        """Whether bytes that have come are no longer taken; the first ones always are."""
        return self._count > 0 and self._clock.now() > self.until_s + LATE_S

    def took(self, data: bytes) -> None:
        """Count ``data``. Raises ProtocolError for a peer that sends without pause."""
        self._count += len(data)
        if self._count > MOST_BYTES:
            raise ProtocolError(
                self._who,
                f"it sends without pause: {self._count >> 10} KB, and no answer among them",
                seen=data[:SEEN_BYTES],
                seconds=self._clock.now() - self._start_s,
                hint="Is this the instrument's port, and at its rate?",
            )


class Link:
    """One open link, for one thread; ``tap`` gets all bytes. Raises LinkError."""

    def __init__(
        self,
        url: str,
        clock: Clock,
        *,
        who: str,
        baud: int = 115200,
        port: PortSettings = EIGHT_N_ONE,
        connect_timeout_s: float = 5.0,
        tap: Tap | None = None,
    ) -> None:
        self.url = url
        self.who = f"{who} at {url}"
        self.clock = clock
        self.baud = baud
        self.connected = False  # until a break is noticed, or ``close``
        self._settings = port
        self._connect_timeout_s = connect_timeout_s
        self._tap = tap or Tap()
        self._open()

    def reopen(self) -> None:
        """Open again and forget what came before. Raises LinkError while the port is not back."""
        self.close()
        self._open()

    def set_baud(self, baud: int) -> None:
        """Change the rate, of a serial port only. Raises LinkError where the port can't."""
        self._refuse_closed()
        try:
            self._port.set_baud(baud)
        except (OSError, ValueError) as error:
            what = f"the port can't speak at {baud} baud: {error}"
            raise LinkError(self.who, what, hint=f"Stay at {self.baud} baud.") from error
        self.baud = baud

    def _open(self) -> None:
        self._buffer = b""
        self._port: HostPort
        if self.url.startswith(SOCKETS):
            self._port = _socket(self.url, self.who, self._connect_timeout_s, self.clock)
        else:
            try:
                place, settings = with_lines(self.url, self._settings)
            except ValueError as error:
                raise LinkError(self.who, str(error), hint="Correct the port's URL.") from error
            self._port = _SerialPort(place, self.who, self.baud, settings)
        if isinstance(self.clock, VirtualClock) and isinstance(self._port, _TcpPort | _SerialPort):
            self._port.close()
            what, hint = "virtual time can't wait for a device", "Give it a RealClock()."
            raise LinkError(self.who, what, hint=hint)
        self._is_open = self.connected = True
        self._tap.opened(self.url)

    def write(self, data: bytes) -> None:
        """Send all of ``data``. Raises LinkError when the link is broken or closed."""
        self._refuse_closed()
        self._tap.sent(data)
        try:
            self._port.write(data)
        except OSError as error:
            raise self._broke("sending", error, asked=data) from error

    def receive(self, timeout_s: float) -> bytes:
        """What has come, after ``timeout_s`` at most; empty for nothing. Raises LinkError."""
        self._refuse_closed()
        if self._buffer:
            data, self._buffer = self._buffer, b""
            return data
        if isinstance(self.clock, VirtualClock):  # an emulator's port moves the time itself
            return self._receive(timeout_s)
        # a second at a time: each look at the clock is a sign of life, and Windows takes Ctrl-C
        # only between two waits
        deadline = self.clock.now() + timeout_s
        while True:
            left_s = max(0.0, deadline - self.clock.now())
            data = self._receive(min(left_s, SLICE_S))
            if data or left_s <= SLICE_S:
                return data

    def reception(self, until_s: float) -> Reception:
        """A wait until ``until_s`` on the clock, for `incoming`."""
        return Reception(self.who, self.clock, until_s)

    def incoming(self, wait: Reception) -> Iterator[bytes]:
        """What comes within ``wait``, piece by piece; the first also when its time is over. Ends
        where nothing comes. Raises LinkError, ProtocolError.
        """
        while data := self.receive(wait.left_s):
            wait.took(data)
            yield data
            if wait.over:
                return

    def read(self, count: int, timeout_s: float) -> bytes:
        """``count`` bytes, or fewer after ``timeout_s``. Raises LinkError, ProtocolError."""
        return self._collect(lambda data: count if len(data) >= count else None, timeout_s)

    def read_until(self, terminator: bytes, timeout_s: float) -> bytes:
        """All up to ``terminator``, or what came within ``timeout_s``. Raises LinkError, and
        ProtocolError after `MOST_BYTES`.
        """

        def end(data: bytes) -> int | None:
            return len(terminator) + at if (at := data.find(terminator)) >= 0 else None

        return self._collect(end, timeout_s)

    def drain(self, silence_s: float, *, at_most_s: float = 5.0) -> bytes:
        """Read all until ``silence_s`` without a byte, or ``at_most_s`` have passed. Raises
        LinkError; ProtocolError for a peer that sends without pause.
        """
        got: list[bytes] = []
        wait = self.reception(self.clock.now() + at_most_s)
        while wait.left_s and (data := self.receive(min(silence_s, wait.left_s))):
            wait.took(data)
            got.append(data)
        return b"".join(got)

    def close(self) -> None:
        """May be repeated. Until ``reopen`` all other calls raise LinkError."""
        self._is_open = False
        self._disconnected()
        self._port.close()

    def _disconnected(self, why: str = "") -> None:
        if self.connected:
            self.connected = False
            self._tap.closed(why)

    def _broke(self, at: str, error: OSError, asked: bytes | None = None) -> LinkError:
        self._disconnected(str(error))
        what = f"the link broke while {at}: {error.strerror or error}"
        return LinkError(self.who, what, asked=asked, hint="Check cable and power.")

    def _refuse_closed(self) -> None:
        if not self._is_open:
            hint = "Open it again; outside of its with block an instrument is closed."
            raise LinkError(self.who, "the link is closed", hint=hint)

    def _collect(self, end: Callable[[bytes], int | None], timeout_s: float) -> bytes:
        """What comes, up to the place that ``end`` gives (None: go on); all at the timeout."""
        data = b""
        for more in self.incoming(self.reception(self.clock.now() + timeout_s)):
            data += more
            if (at := end(data)) is not None:
                self._buffer = data[at:] + self._buffer
                return data[:at]
        return data

    def _receive(self, timeout_s: float) -> bytes:
        try:
            data = self._port.read_some(timeout_s)
        except OSError as error:
            raise self._broke("reading", error) from error
        if data:
            self._tap.received(data)
        return data


def _socket(url: str, who: str, connect_timeout_s: float, clock: Clock) -> HostPort:
    """The port at a socket's URL: under virtual time that of an emulator in this process."""
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
        if not host or not port:
            raise ValueError("host or port is missing")
    except ValueError as error:
        what, hint = f"not a link: {error}", "Write socket://host:port."
        raise LinkError(who, what, hint=hint) from error
    if isinstance(clock, VirtualClock) and port in clock.emulators:
        return clock.emulators[port]()
    try:
        return _TcpPort(host, port, connect_timeout_s)
    except OSError as error:
        what = f"nothing takes the connection: {error.strerror or error}"
        raise LinkError(who, what, hint="Is the device on, and the address right?") from error


class _TcpPort:
    def __init__(self, host: str, port: int, connect_timeout_s: float) -> None:
        self._socket = socket.create_connection((host, port), timeout=connect_timeout_s)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def read_some(self, timeout_s: float) -> bytes:
        if not select.select([self._socket], [], [], timeout_s)[0]:
            return b""
        data = self._socket.recv(65536)
        if not data:
            raise ConnectionResetError("the other end hung up")
        return data

    def write(self, data: bytes) -> None:
        self._socket.sendall(data)

    def set_baud(self, baud: int) -> None:
        """A socket has no rate; what is at its other end keeps its own."""

    def close(self) -> None:
        with contextlib.suppress(OSError):  # the other end may be gone already
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()


if sys.platform == "win32":
    _HANG_UPS: tuple[type[Exception], ...] = ()
else:
    import termios

    _HANG_UPS = (termios.error,)


@contextlib.contextmanager
def _hang_up_is_os_error() -> Iterator[None]:
    """pyserial lets a terminal's own kind of error through when it hangs up."""
    try:
        yield
    except _HANG_UPS as error:
        raise OSError(*error.args) from error


class _SerialPort:
    def __init__(self, url: str, who: str, baud: int, settings: PortSettings) -> None:
        self._settings = settings
        # pyserial's client of RFC 2217 refuses a write timeout, and sets the far port again, with
        # a wait, for each change of the timeout
        self._far = url.startswith("rfc2217://")
        try:
            with _hang_up_is_os_error():
                self._serial = serial.serial_for_url(
                    url,
                    do_not_open=True,
                    baudrate=baud,
                    bytesize=settings.bytesize,
                    parity=settings.parity,
                    stopbits=settings.stopbits,
                    rtscts=settings.handshake == "rtscts",
                    xonxoff=settings.handshake == "xonxoff",
                    timeout=0,
                    write_timeout=None if self._far else 2.0,
                    exclusive=True,
                )
                # before it is open: a board resets when DTR goes up
                if settings.dtr is not None:
                    self._serial.dtr = settings.dtr
                if settings.rts is not None:
                    self._serial.rts = settings.rts
                if settings.rs485:
                    self._serial.rts = False  # listening
                self._serial.open()
                self._serial.timeout = 0.0  # sets all again: what a port lacks fails only then
        except (serial.SerialException, ValueError, OSError) as error:
            what = f"the port can't be opened: {error}"
            raise LinkError(who, what, hint=_port_hint(url, error)) from error

    def read_some(self, timeout_s: float) -> bytes:
        until_s = monotonic() + timeout_s
        with _hang_up_is_os_error():
            if not self._far:
                self._serial.timeout = timeout_s
            while not (first := bytes(self._serial.read(1))):
                if not self._far or monotonic() >= until_s:
                    return b""
                sleep(LOOK_S)
            return first + bytes(self._serial.read(self._serial.in_waiting))

    def write(self, data: bytes) -> None:
        with _hang_up_is_os_error():
            if not self._settings.rs485:
                self._serial.write(data)
                self._serial.flush()
                return
            self._serial.rts = True
            try:
                # an adapter says that it has sent when it has only taken the bytes
                character_s = self._settings.character_bits / float(self._serial.baudrate)
                sent_s = monotonic() + len(data) * character_s
                self._serial.write(data)
                self._serial.flush()
                sleep(max(0.0, sent_s - monotonic()))
            finally:
                self._serial.rts = False

    def set_baud(self, baud: int) -> None:
        with _hang_up_is_os_error():
            self._serial.baudrate = baud

    def close(self) -> None:
        self._serial.close()


def _port_hint(url: str, error: Exception) -> str:
    text = str(error).lower()
    if "exclusively lock" in text or "busy" in text or "access is denied" in text:
        return f"Another program has the port open: close it. On Linux 'fuser -v {url}' names it."
    if "permission" in text:
        group = _group(url)
        return (
            f"You may not use the port: it belongs to the group '{group}'. 'sudo usermod -aG"
            f" {group} $USER', then log in again."
        )
    if "no such file" in text or "filenotfound" in text.replace(" ", ""):
        here = ", ".join(sorted(port.device for port in list_ports.comports())) or "none"
        return (
            "Is the adapter plugged in, and the port's name right? Serial ports on this machine:"
            f" {here}."
        )
    return "Check the port's name and that no other program uses it."


def _group(url: str) -> str:
    try:
        return Path(url).group()
    # no such file any more, a group without a name, or Windows
    except (OSError, KeyError, NotImplementedError):
        return "dialout"


def latency_warning(port: str, sysfs: Path = SYSFS) -> str | None:
    """Advice about a slow adapter behind a port's path, link or name; None when fine or unknown."""
    if re.fullmatch(r"COM\d+", port):
        latency_ms, name = _windows_latency_ms(port), port
        how = (
            f"in Device Manager, Ports, {port}, Port Settings, Advanced: Latency Timer {WANTED_MS}"
        )
    elif port.startswith("/"):
        name = Path(port).resolve().name
        timer = sysfs / "bus" / "usb-serial" / "devices" / name / "latency_timer"
        try:
            latency_ms = int(timer.read_text(encoding="ascii"))
        except (OSError, ValueError):  # no USB adapter, one without a timer, or no Linux
            return None
        how = f"with: echo {WANTED_MS} | sudo tee {timer.as_posix()} (until it is plugged in again)"
    else:
        return None
    if latency_ms is None or latency_ms <= WANTED_MS:
        return None
    return (
        f"the USB adapter {name} holds bytes back for {latency_ms} ms, which every poll waits for."
        f" Set it {how}, or stream instead of polling"
    )


def _windows_latency_ms(port: str) -> int | None:
    """What FTDI's driver keeps in the registry for ``port``; None for another adapter."""
    try:
        registry: Any = import_module("winreg")
    except ImportError:
        return None
    with contextlib.suppress(OSError):
        for device in _subkeys(registry, FTDI_DEVICES):
            for instance in _subkeys(registry, f"{FTDI_DEVICES}\\{device}"):
                path = f"{FTDI_DEVICES}\\{device}\\{instance}\\Device Parameters"
                with (
                    contextlib.suppress(OSError),
                    registry.OpenKey(registry.HKEY_LOCAL_MACHINE, path) as key,
                ):
                    if registry.QueryValueEx(key, "PortName")[0] == port:
                        return int(registry.QueryValueEx(key, "LatencyTimer")[0])
    return None


def _subkeys(registry: Any, path: str) -> list[str]:
    with registry.OpenKey(registry.HKEY_LOCAL_MACHINE, path) as key:
        return [registry.EnumKey(key, at) for at in range(registry.QueryInfoKey(key)[0])]
