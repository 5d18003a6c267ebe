"""GRBL 1.1 on the wire, classic, grblHAL and FluidNC: lines to send, and bytes back to values.

Every line gives a value: a malformed one `MalformedLine` with the reason. Report fields are found
by name, unknown ones kept as text. Source: the firmware's interface and command documents,
version 1.1; alarm numbers from 10 on as in the sources of grblHAL and FluidNC.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

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
PINS = {axis: f"limit {axis}" for axis in "XYZABC"} | {
    "P": "probe",
    "D": "door",
    "R": "reset",
    "H": "hold",
    "S": "cycle start",
    "E": "emergency stop",
    "M": "motor fault",
}


@dataclass(frozen=True, slots=True)
class Ok:
    """A line was taken. Exactly one ``Ok`` or ``ErrorReply`` answers each line."""


@dataclass(frozen=True, slots=True)
class ErrorReply:
    """A line was refused: a number, or the firmware's own sentence."""

    code: int | str


@dataclass(frozen=True, slots=True)
class Alarm:
    """The controller has stopped by itself. Pushed, never counted as an answer."""

    code: int | str


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

    @property
    def pins(self) -> list[str]:
        """The input pins that are active, by name; no field is no pin."""
        return [PINS.get(letter, f"pin {letter}") for letter in self.fields.get("Pn", "")]


@dataclass(frozen=True, slots=True)
class Setting:
    """One stored setting. The value stays text: grblHAL has settings that aren't numbers."""

    number: int
    value: str


@dataclass(frozen=True, slots=True)
class Welcome:
    """The start-up line after every reset; ``dialect`` is the firmware's name."""

    version: str
    dialect: str


@dataclass(frozen=True, slots=True)
class Message:
    """Any other thing pushed: ``[MSG:...]``, ``$N0=...``, ``$/axes/x/...=``, ``>line:ok``."""

    kind: str
    text: str


@dataclass(frozen=True, slots=True)
class MalformedLine:
    """A line that the firmware doesn't say, and why we think so."""

    raw: bytes
    why: str


@dataclass(frozen=True, slots=True)
class MarlinPosition:
    """Marlin's M114: the place it was last sent to, mm, and its motors' steps, by letter."""

    sent_mm: Mapping[str, float]
    steps: Mapping[str, float]


Response = (
    Ok | ErrorReply | Alarm | Status | Setting | Welcome | Message | MalformedLine | MarlinPosition
)

_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)")
_CODE = re.compile(r"(error|ALARM):(\d{1,4})")
_WELCOME = re.compile(r"Grbl(HAL)? (\d\S*)( \[.*\])?", re.IGNORECASE)
_SETTING = re.compile(r"\$(\d{1,4})=(.*)")
_STARTUP = re.compile(r"\$(N\d|/[\w/]+)=(.*)")
_MESSAGE = re.compile(r"\[([^:\]]+)(?::(.*))?\]")
_STATE = re.compile(r"([A-Za-z]+)(?::(\d{1,3}))?")


def parse(line: bytes) -> Response:
    """The value of one answer, without its line end. Never raises."""
    try:
        text = line.decode("ascii")
    except UnicodeDecodeError:
        return MalformedLine(line, "bytes that are not ASCII")
    if text == "ok":
        return Ok()
    if text.startswith("<"):
        return _status(line, text)
    if found := _CODE.fullmatch(text):
        return (ErrorReply if found[1] == "error" else Alarm)(int(found[2]))
    if found := _SETTING.fullmatch(text):
        return Setting(int(found[1]), found[2])
    if found := _WELCOME.fullmatch(text):
        fluid = "FluidNC" if "[FluidNC" in (found[3] or "") else "Grbl"
        return Welcome(found[2], "grblHAL" if found[1] else fluid)
    if found := _MESSAGE.fullmatch(text) or _STARTUP.fullmatch(text):
        return Message(found[1], found[2] or "")
    if text.startswith(">"):
        return Message(">", text[1:])
    return MalformedLine(line, "no answer of GRBL looks like this")


def _status(raw: bytes, text: str) -> Status | MalformedLine:
    if not text.endswith(">"):
        return MalformedLine(raw, "a status report without its end")
    head, *rest = text[1:-1].split("|")
    state = _STATE.fullmatch(head)
    if not state:
        return MalformedLine(raw, "a status report without a state")
    fields = {name: value for name, _, value in (field.partition(":") for field in rest)}
    if "<" in text[1:] or ">" in text[:-1] or len(fields) < len(rest):
        return MalformedLine(raw, "two status reports run together")
    positions: dict[str, Position | None] = {}
    for name in ("MPos", "WPos", "WCO"):
        parts = fields[name].split(",") if name in fields else []
        if name in fields and (len(parts) < 3 or not all(map(_NUMBER.fullmatch, parts))):
            return MalformedLine(raw, f"{name} is not three numbers or more")
        positions[name] = tuple(map(float, parts)) or None
    if positions["MPos"] is None and positions["WPos"] is None:
        return MalformedLine(raw, "a status report without a position")
    mpos, wpos, wco = positions.values()
    return Status(state[1], int(state[2]) if state[2] else None, mpos, wpos, wco, fields)


class Decoder:
    """Bytes, cut anywhere, to answers. Keeps an unfinished line until its end comes."""

    def __init__(self, parse: Callable[[bytes], Response] = parse) -> None:
        self._pending = b""
        self._parse = parse

    def feed(self, data: bytes) -> Iterator[Response]:
        """The answers that ``data`` completes, in order. Empty lines are dropped. Never raises."""
        *lines, self._pending = (self._pending + data).split(b"\n")
        answers = [self._parse(line) for line in (raw.rstrip(b"\r") for raw in lines) if line]
        if len(self._pending) > MAX_ANSWER:
            why = f"{len(self._pending)} bytes without a line end"
            answers.append(MalformedLine(self._pending, why))
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
    return f"G21G90G94G53G1{axis_words(target_mm, feed_mm_min, who=who)}"


def jog_line(way_mm: Mapping[str, float], feed_mm_min: float, *, who: str = "stage") -> str:
    """A relative jog, mm: it can be cancelled and leaves no mode behind. Raises LimitError."""
    return f"$J=G21G91{axis_words(way_mm, feed_mm_min, who=who)}"


def axis_words(
    axes: Mapping[str, float], feed_mm_min: float, *, who: str = "stage", between: str = ""
) -> str:
    """Axis words and feed, mm and mm/min. Raises LimitError."""
    if not axes or not set(axes) <= set(AXES):
        what = f"no such axes to move: {', '.join(axes) or 'none'}"
        raise LimitError(who, what, hint="Use X, Y, Z or A.")
    if not feed_mm_min >= 0.001:
        raise LimitError(who, f"a feed has to be at least 0.001 mm/min, is {feed_mm_min}")
    numbers = [*axes.items(), ("F", feed_mm_min)]
    return between.join(f"{letter}{_decimal(value, who)}" for letter, value in numbers)


def _decimal(value: float, who: str) -> str:
    """Three decimals, as the controller prints; it reads no exponents."""
    if not math.isfinite(value) or abs(value) >= 1e7:
        raise LimitError(who, f"{value} can't be sent as a number")
    text = f"{value:.3f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


class Meaning(NamedTuple):
    """What happened, and what a person should do now."""

    what: str
    do: str


HOME_AGAIN = (
    "A run homes it again by itself; else: 'teatbench stage recover', then 'teatbench stage home'."
)
_REPORT = "The line that was sent is wrong: report it with the bench's log."


@cache
def codes() -> Mapping[str, Mapping[int, Meaning]]:
    """What numbers mean, by the tables of ``codes.toml``."""
    text = Path(__file__).with_name("codes.toml").read_text(encoding="utf-8")
    return {
        name: {int(number): _read_meaning(name, *words) for number, words in table.items()}
        for name, table in tomllib.loads(text).items()
    }


def _read_meaning(table: str, what: str, do: str = "") -> Meaning:
    if table.endswith("errors"):
        return Meaning(what, _REPORT if do == "report" else do)
    return Meaning(what, f"{do}. {HOME_AGAIN}" if do else HOME_AGAIN)


def meaning(answer: ErrorReply | Alarm, firmware: str = "Grbl") -> Meaning:
    """What it means in that firmware, unknown numbers included. A sentence stands for itself."""
    code, alarm = answer.code, isinstance(answer, Alarm)
    if isinstance(code, str):
        do = "Switch the controller off and on" if alarm else "See the firmware's documentation"
        return Meaning(code, f"{do}. {HOME_AGAIN}")
    kind = "alarm" if alarm else "error"
    unknown = Meaning(
        f"an {kind} that this program does not know",
        f"Look the number up in the firmware's list of {kind}s.{f' {HOME_AGAIN}' if alarm else ''}",
    )
    own = codes().get(f"{firmware} {kind}s", {})
    known = own.get(code) or codes()[f"{kind}s"].get(code, unknown)
    return known._replace(what=f"{kind} {code}: {known.what}")
