"""Where a Modbus device is: its URL, taken apart. Pure; the rig file's reader and the driver both
ask here.

``tcp://host[:502]`` is Modbus TCP, ``rtu+tcp://host:port`` RTU behind a serial server,
``/dev/ttyUSB0`` and ``COM5`` RTU on a serial port. ``?unit=3`` names the unit, ``baud``, ``parity``
and ``stopbits`` a serial port's settings; what a URL leaves open, the profile fills in.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal
from urllib.parse import parse_qsl, urlsplit

Kind = Literal["tcp", "rtu+tcp", "serial"]
Parity = Literal["N", "E", "O"]

ALLOWED = (
    '"tcp://host:port", "rtu+tcp://host:port", "/dev/ttyUSB0", "COM5"; each with "?unit=3", a'
    ' serial port also with "&baud=9600&parity=N"'
)
SCHEMES = ("tcp", "rtu+tcp")
OTHER_WORDS = dict.fromkeys(("socket", "rtu", "serial", "rfc2217"), "rtu+tcp") | {"modbus": "tcp"}
MODBUS_PORT = 502
BAUD = 9600  # where neither the URL nor a profile says
# 255 is "no unit" on TCP
MOST_UNIT: Mapping[Kind, int] = {"tcp": 255, "rtu+tcp": 254, "serial": 254}
ON_TCP = ("unit",)
ON_SERIAL = ("unit", "baud", "parity", "stopbits")


class LineError(ValueError):
    """Not a URL of a Modbus device; the message says why, and what is allowed or may be meant."""


@dataclass(frozen=True, slots=True)
class Line:
    """One device: ``host`` and ``port``, or ``device``. None: the URL leaves it open."""

    kind: Kind
    host: str = ""
    port: int = 0
    device: str = ""
    unit_id: int | None = None
    baud: int | None = None
    parity: Parity | None = None
    stopbits: int | None = None

    @property
    def is_rtu(self) -> bool:
        """Whether frames are RTU's, with no transaction number to tell a late answer by."""
        return self.kind != "tcp"

    @property
    def transport(self) -> Literal["tcp", "rtu"]:
        """What a family has to have for it."""
        return "rtu" if self.is_rtu else "tcp"

    @property
    def character_s(self) -> float:
        """How long one character takes on the wire: start, eight bits, parity, stop; 0 over TCP."""
        if self.kind != "serial":
            return 0.0
        return (9 + (self.parity in ("E", "O")) + (self.stopbits or 1)) / (self.baud or BAUD)

    @property
    def url(self) -> str:
        """The line without its settings."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return self.device or f"{self.kind}://{host}:{self.port}"


def parse_line(url: str) -> Line:
    """The line that ``url`` names. Raises LineError."""
    place, _, query = url.partition("?")
    if re.fullmatch(r"/dev/\S+|COM\d+", place):
        return Line("serial", device=place, **_settings(query, "serial"))  # type: ignore[arg-type]
    scheme, found, _ = place.partition("://")
    if not found:
        raise LineError(f"not a link to a Modbus device{_near(place, scheme)}; allowed: {ALLOWED}")
    if scheme not in SCHEMES:
        word = OTHER_WORDS.get(scheme.lower(), scheme.lower())
        meant = _nearest(word, SCHEMES, "://")
        raise LineError(f'"{scheme}://" is no link to a Modbus device{meant}; allowed: {ALLOWED}')
    kind: Kind = "tcp" if scheme == "tcp" else "rtu+tcp"
    host, port = _host_and_port(place, kind)
    return Line(kind, host, port, **_settings(query, kind))  # type: ignore[arg-type]


def _host_and_port(place: str, kind: Kind) -> tuple[str, int]:
    try:
        parts = urlsplit(place)
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise LineError(f"not a link: {error}; allowed: {ALLOWED}") from error
    if not host or parts.path or parts.username is not None:
        form = f'"{kind}://host:port" and nothing behind it but "?unit=3"'
        raise LineError(f"not a link: write {form}")
    if port is None and kind == "rtu+tcp":
        form = '"rtu+tcp://host:port" with the port that the serial server listens on'
        raise LineError(f"the port is missing: write {form}")
    return host, MODBUS_PORT if port is None else port


def _settings(query: str, kind: Kind) -> dict[str, int | str]:
    known = ON_SERIAL if kind == "serial" else ON_TCP
    try:
        pairs = parse_qsl(query, strict_parsing=bool(query), keep_blank_values=True)
    except ValueError as error:
        what = f'"?{query}" is no list of settings: write "?unit=3&baud=9600" ({error})'
        raise LineError(what) from error
    settings: dict[str, int | str] = {}
    for name, value in pairs:
        if name not in known:
            where = "a serial port" if kind == "serial" else f"{kind}://"
            meant, allowed = _nearest(name, known), ", ".join(known)
            raise LineError(f'"{name}" is no setting of {where}{meant} (allowed: {allowed})')
        settings["unit_id" if name == "unit" else name] = _setting(name, value, kind)
    return settings


def _setting(name: str, value: str, kind: Kind) -> int | str:
    if name == "parity":
        if value.upper() not in ("N", "E", "O"):
            raise LineError(f"parity={value}: allowed are N (none), E (even) and O (odd)")
        return value.upper()
    low, high = {"unit": (1, MOST_UNIT[kind]), "baud": (300, 921600), "stopbits": (1, 2)}[name]
    if not re.fullmatch(r"\d{1,7}", value) or not low <= int(value) <= high:
        raise LineError(f"{name}={value}: a whole number from {low} to {high} is needed")
    return int(value)


def _nearest(word: str, known: Sequence[str], end: str = "") -> str:
    near = difflib.get_close_matches(word, known, n=1)
    return f'; did you mean "{near[0]}{end}"?' if near else ""


def _near(place: str, word: str) -> str:
    if re.match(r"(tty|dev/|cu\.)", place):
        return f'; did you mean "/dev/{place.removeprefix("dev/")}"?'
    if re.fullmatch(r"com\d+:?", place, re.IGNORECASE):
        return f'; did you mean "{place.upper().rstrip(":")}"?'
    if re.fullmatch(r"[\w-]+(\.[\w.-]+|(\.[\w.-]+)?:\d+)", word):
        return f'; did you mean "tcp://{word}"?'
    return ""
