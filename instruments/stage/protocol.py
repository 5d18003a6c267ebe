"""GRBL 1.1 on the wire, classic and grblHAL: lines to send, and bytes back to values.

Total: what makes no sense gives ``Nonsense`` with the reason. Report fields are found by name,
unknown ones kept as text. Source: the firmware's interface and command documents, version 1.1.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from instruments.errors import LimitError

MAX_LINE = 79  # the controller's line buffer has 80 places, one of them for its terminator
MAX_ANSWER = 1024  # longer than any answer of either dialect; more without a line end is not GRBL

STATUS_QUERY = b"?"
HOLD = b"!"
RESUME = b"~"
SOFT_RESET = b"\x18"
DOOR = b"\x84"
JOG_CANCEL = b"\x85"
# None: back to 100 %
_FEED_STEPS = (None, 10, -10, 1, -1)
FEED_OVERRIDES = {bytes([0x90 + at]): step for at, step in enumerate(_FEED_STEPS)}
RAPID_OVERRIDES: dict[bytes, int] = {b"\x95": 100, b"\x96": 50, b"\x97": 25}

# in the order of every list of numbers; A is a rotation in degrees, on boards with four axes
AXES = "XYZA"
Position = tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Ok:
    """A line was taken. Exactly one ``Ok`` or ``ErrorReply`` answers each line."""


@dataclass(frozen=True, slots=True)
class ErrorReply:
    """A line was refused."""

    code: int


@dataclass(frozen=True, slots=True)
class Alarm:
    """The controller has stopped by itself. Pushed, never counted as an answer."""

    code: int


@dataclass(frozen=True, slots=True)
class Status:
    """A status report; three axes or more in mm (inches if so set); None: not in this report."""

    state: str
    substate: int | None
    mpos_mm: Position | None
    wpos_mm: Position | None
    wco_mm: Position | None
    fields: Mapping[str, str]

    @property
    def name(self) -> str:
        """The state as the controller writes it: ``Idle``, ``Hold:0``."""
        return self.state if self.substate is None else f"{self.state}:{self.substate}"


@dataclass(frozen=True, slots=True)
class Setting:
    """One stored setting. The value stays text: grblHAL has settings that aren't numbers."""

    number: int
    value: str


@dataclass(frozen=True, slots=True)
class Welcome:
    """The start-up line after every reset. ``dialect`` is ``Grbl`` or ``grblHAL``."""

    version: str
    dialect: str


@dataclass(frozen=True, slots=True)
class Message:
    """Any other thing pushed: ``[MSG:...]``, ``[VER:...]``, ``$N0=...``, ``>line:ok``."""

    kind: str
    text: str


@dataclass(frozen=True, slots=True)
class Nonsense:
    """A line that GRBL doesn't say, and why we think so."""

    raw: bytes
    why: str


Response = Ok | ErrorReply | Alarm | Status | Setting | Welcome | Message | Nonsense

_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)")
_CODE = re.compile(r"(error|ALARM):(\d{1,4})")
_WELCOME = re.compile(r"Grbl(HAL)? (\d\S*)( \[.*\])?", re.IGNORECASE)
_SETTING = re.compile(r"\$(\d{1,4})=(.*)")
_STARTUP = re.compile(r"\$(N\d)=(.*)")
_MESSAGE = re.compile(r"\[([^:\]]+)(?::(.*))?\]")
_STATE = re.compile(r"([A-Za-z]+)(?::(\d{1,3}))?")


def parse(line: bytes) -> Response:
    """The value of one answer, without its line end. Never raises."""
    try:
        text = line.decode("ascii")
    except UnicodeDecodeError:
        return Nonsense(line, "bytes that are not ASCII")
    if text == "ok":
        return Ok()
    if text.startswith("<"):
        return _status(line, text)
    if found := _CODE.fullmatch(text):
        return (ErrorReply if found[1] == "error" else Alarm)(int(found[2]))
    if found := _SETTING.fullmatch(text):
        return Setting(int(found[1]), found[2])
    if found := _WELCOME.fullmatch(text):
        return Welcome(found[2], "grblHAL" if found[1] else "Grbl")
    if found := _MESSAGE.fullmatch(text) or _STARTUP.fullmatch(text):
        return Message(found[1], found[2] or "")
    if text.startswith(">"):
        return Message(">", text[1:])
    return Nonsense(line, "no answer of GRBL looks like this")


def _status(raw: bytes, text: str) -> Status | Nonsense:
    if not text.endswith(">"):
        return Nonsense(raw, "a status report without its end")
    head, *rest = text[1:-1].split("|")
    state = _STATE.fullmatch(head)
    if not state:
        return Nonsense(raw, "a status report without a state")
    fields = {name: value for name, _, value in (field.partition(":") for field in rest)}
    positions: dict[str, Position | None] = {}
    for name in ("MPos", "WPos", "WCO"):
        positions[name] = _position(fields[name]) if name in fields else None
        if name in fields and positions[name] is None:
            return Nonsense(raw, f"{name} is not three numbers or more")
    if positions["MPos"] is None and positions["WPos"] is None:
        return Nonsense(raw, "a status report without a position")
    mpos, wpos, wco = positions.values()
    return Status(state[1], int(state[2]) if state[2] else None, mpos, wpos, wco, fields)


def _position(text: str) -> Position | None:
    parts = text.split(",")
    if len(parts) < 3 or not all(_NUMBER.fullmatch(part) for part in parts):
        return None
    return tuple(float(part) for part in parts)


class Decoder:
    """Bytes, cut anywhere, to answers. Keeps an unfinished line until its end comes."""

    def __init__(self) -> None:
        self._pending = b""

    def feed(self, data: bytes) -> Iterator[Response]:
        """The answers that ``data`` completes, in order. Empty lines are dropped. Never raises."""
        *lines, self._pending = (self._pending + data).split(b"\n")
        answers = [parse(line) for line in (raw.rstrip(b"\r") for raw in lines) if line]
        if len(self._pending) > MAX_ANSWER:
            why = f"{len(self._pending)} bytes without a line end"
            answers.append(Nonsense(self._pending, why))
            self._pending = b""
        return iter(answers)


def encode(text: str, *, who: str = "stage") -> bytes:
    """The line's bytes. Raises LimitError: too long, not printable ASCII, real-time commands."""
    bad = next((sign for sign in text if not " " <= sign <= "~" or sign in "?!~"), None)
    if bad is not None:
        raise LimitError(who, f"the line can't hold {bad!r}", asked=text)
    if len(text) > MAX_LINE:
        what = f"the line has {len(text)} characters, the controller takes {MAX_LINE}"
        raise LimitError(who, what, asked=text)
    return text.encode("ascii") + b"\n"


def move_line(target_mm: Mapping[str, float], feed_mm_min: float, *, who: str = "stage") -> str:
    """A straight move to machine coordinates, every mode stated. Raises LimitError."""
    return f"G21G90G94G53G1{_words(target_mm, feed_mm_min, who)}"


def jog_line(way_mm: Mapping[str, float], feed_mm_min: float, *, who: str = "stage") -> str:
    """A relative jog, mm: it can be cancelled and leaves no mode behind. Raises LimitError."""
    return f"$J=G21G91{_words(way_mm, feed_mm_min, who)}"


def _words(axes: Mapping[str, float], feed_mm_min: float, who: str) -> str:
    if not axes or not set(axes) <= set(AXES):
        what = f"no such axes to move: {', '.join(axes) or 'none'}"
        raise LimitError(who, what, hint="Use X, Y, Z or A.")
    if not feed_mm_min >= 0.001:
        raise LimitError(who, f"a feed of {feed_mm_min} mm/min is no feed")
    numbers = [*axes.items(), ("F", feed_mm_min)]
    return "".join(f"{letter}{_decimal(value, who)}" for letter, value in numbers)


def _decimal(value: float, who: str) -> str:
    """Three decimals, as the controller prints; it reads no exponents."""
    if not math.isfinite(value) or abs(value) >= 1e7:
        raise LimitError(who, f"{value} can't be sent as a number")
    text = f"{value:.3f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text
