"""Where a bath's controller or a relay is: its URL, taken apart. Pure; the rig file's reader and
the driver both ask here.

``tcp://host[:port]`` is Modbus TCP, or lines of ASCII over TCP; ``rtu+tcp://host:port`` is RTU
behind a serial server; ``/dev/ttyUSB0``, ``COM5`` and ``rfc2217://host:port`` are serial ports.
``?unit=3`` names the unit, ``gap_ms`` the least silence between two frames; the other settings are
a serial port's. What a URL leaves open, the profile fills in.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from ipaddress import ip_address
from typing import Any, Literal
from urllib.parse import parse_qsl, urlsplit

from instruments.port_settings import LINES, PortSettings

Kind = Literal["tcp", "rtu+tcp", "serial", "rfc2217"]

ALLOWED = (
    '"tcp://host:port", "rtu+tcp://host:port", "rfc2217://host:port", "/dev/ttyUSB0", "COM5"; each'
    ' with "?unit=3", a serial port also with "&baud=9600&parity=N"'
)
SCHEMES: tuple[Kind, ...] = ("tcp", "rtu+tcp", "rfc2217")
OTHER_WORDS = dict.fromkeys(("socket", "rtu", "serial"), "rtu+tcp") | {"modbus": "tcp"}
MODBUS_PORT = 502
BAUD = 9600  # where neither the URL nor a profile says
MOST_UNIT, MOST_UNIT_TCP = 254, 255  # 255 is "no unit" on TCP
ON_TCP = ("unit", "gap_ms")
ON_SERIAL = (*ON_TCP, "baud", "parity", "stopbits", "bytesize", "handshake", "dtr", "rts", "rs485")
NUMBERS = {"gap_ms": (0, 1000), "baud": (300, 921600), "stopbits": (1, 2), "bytesize": (7, 8)}
WORDS: Mapping[str, Mapping[str, Any]] = {
    "parity": {"N": "N", "E": "E", "O": "O"},
    "handshake": {"none": "none", "rtscts": "rtscts", "xonxoff": "xonxoff"},
    **dict.fromkeys(("dtr", "rts", "rs485"), LINES),
}
ALLOWED_WORDS = {name: " and ".join(words) for name, words in WORDS.items()}
ALLOWED_WORDS |= {"parity": "N (none), E (even) and O (odd)"}


def is_loopback(host: str) -> bool:
    """Whether ``host`` is this machine, as an address that no other one can have."""
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


class LineError(ValueError):
    """Not a URL of a device; the message says why, and what is allowed or may be meant."""


@dataclass(frozen=True, slots=True)
class Line:
    """One device: ``host`` and ``port``, or ``device``. None: the URL leaves it open."""

    kind: Kind
    host: str = ""
    port: int = 0
    device: str = ""
    unit_id: int | None = None
    gap_s: float | None = None
    baud: int = BAUD
    serial: PortSettings = field(default_factory=PortSettings)

    @property
    def is_rtu(self) -> bool:
        """Whether frames are RTU's, with no transaction number to tell a late answer by."""
        return self.kind != "tcp"

    @property
    def transport(self) -> Literal["tcp", "rtu"]:
        """What a family that speaks Modbus has to have for it."""
        return "rtu" if self.is_rtu else "tcp"

    @property
    def is_port(self) -> bool:
        """Whether it is a serial port, here or behind a server that sets it for us."""
        return self.kind in ("serial", "rfc2217")

    @property
    def character_s(self) -> float:
        """How long one character takes on the wire; 0 over TCP."""
        return self.serial.character_bits / self.baud if self.is_port else 0.0

    @property
    def url(self) -> str:
        """The line without its settings."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return self.device or f"{self.kind}://{host}:{self.port}"


def parse_line(
    url: str,
    *,
    port: int | None = MODBUS_PORT,
    baud: int = BAUD,
    serial: PortSettings = PortSettings(),  # noqa: B008 - frozen
) -> Line:
    """The line that ``url`` names; the rest is for what it leaves open. Raises LineError."""
    place, _, query = url.partition("?")
    scheme, found, _ = place.partition("://")
    if re.fullmatch(r"/dev/\S+|COM\d+", place):
        line = Line("serial", device=place)
    elif not found:
        raise LineError(f"not a link to a device{_near(place, scheme)}; allowed: {ALLOWED}")
    elif scheme not in SCHEMES:
        word = OTHER_WORDS.get(scheme.lower(), scheme.lower())
        meant = _nearest(word, SCHEMES, "://")
        raise LineError(f'"{scheme}://" is no link to a device{meant}; allowed: {ALLOWED}')
    else:
        kind = next(known for known in SCHEMES if known == scheme)
        line = Line(kind, *_host_and_port(place, kind, port))
    settings = _settings(query, line)
    own = {name: settings.pop(name) for name in ("unit_id", "gap_s", "baud") if name in settings}
    return replace(line, **{"baud": baud, **own}, serial=replace(serial, **settings))


def _host_and_port(place: str, kind: Kind, usual: int | None) -> tuple[str, int]:
    try:
        parts = urlsplit(place)
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise LineError(f"not a link: {error}; allowed: {ALLOWED}") from error
    if not host or parts.path or parts.username is not None:
        form = f'"{kind}://host:port" and nothing behind it but "?unit=3"'
        raise LineError(f"not a link: write {form}")
    if port is None and (kind != "tcp" or usual is None):
        form = f'"{kind}://host:port" with the port that the serial server listens on'
        raise LineError(f"the port is missing: write {form}")
    return host, port or usual or 0


def _settings(query: str, line: Line) -> dict[str, Any]:
    known = ON_SERIAL if line.is_port else ON_TCP
    try:
        pairs = parse_qsl(query, strict_parsing=bool(query), keep_blank_values=True)
    except ValueError as error:
        what = f'"?{query}" is no list of settings: write "?unit=3&baud=9600" ({error})'
        raise LineError(what) from error
    settings: dict[str, Any] = {}
    for name, value in pairs:
        if name not in known:
            where = "a serial port" if line.is_port else f"{line.kind}://"
            meant, allowed = _nearest(name, known), ", ".join(known)
            raise LineError(f'"{name}" is no setting of {where}{meant} (allowed: {allowed})')
        if words := WORDS.get(name):
            word = value.upper() if name == "parity" else value.lower()
            if word not in words:
                raise LineError(f"{name}={value}: allowed are {ALLOWED_WORDS[name]}")
            settings[name] = words[word]
            continue
        units = (1, MOST_UNIT if line.is_rtu else MOST_UNIT_TCP)
        low, high = units if name == "unit" else NUMBERS[name]
        if not re.fullmatch(r"\d{1,7}", value) or not low <= int(value) <= high:
            raise LineError(f"{name}={value}: a whole number from {low} to {high} is needed")
        named = {"unit": ("unit_id", int(value)), "gap_ms": ("gap_s", int(value) / 1000.0)}
        key, number = named.get(name, (name, int(value)))
        settings[key] = number
    return settings


def _nearest(word: str, known: Iterable[str], end: str = "") -> str:
    near = difflib.get_close_matches(word, list(known), n=1)
    return f'; did you mean "{near[0]}{end}"?' if near else ""


def _near(place: str, word: str) -> str:
    if re.match(r"(tty|dev/|cu\.)", place):
        return f'; did you mean "/dev/{place.removeprefix("dev/")}"?'
    if re.fullmatch(r"com\d+:?", place, re.IGNORECASE):
        return f'; did you mean "{place.upper().rstrip(":")}"?'
    if re.fullmatch(r"[\w-]+(\.[\w.-]+|(\.[\w.-]+)?:\d+)", word):
        return f'; did you mean "tcp://{word}"?'
    return ""
