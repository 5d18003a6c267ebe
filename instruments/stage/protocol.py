"""GRBL 1.1 on the wire, classic, grblHAL and FluidNC: lines to send, and bytes back to values.

Total: what is malformed gives ``Malformed`` with the reason. Report fields are found by name,
unknown ones kept as text. Source: the firmware's interface and command documents,
version 1.1; alarm numbers from 10 on as in the sources of grblHAL and FluidNC.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
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
class Malformed:
    """A line that the firmware doesn't say, and why we think so."""

    raw: bytes
    why: str


@dataclass(frozen=True, slots=True)
class Counted:
    """Marlin's answer to M114: the place it was last sent to, mm, and the steps that its motors
    have made, by letter.
    """

    sent_mm: Mapping[str, float]
    steps: Mapping[str, float]


class Reply(NamedTuple):
    """Zaber's answer: device, axis, id, ``OK`` or ``RJ``, ``IDLE`` or ``BUSY``, flag, data."""

    device: int
    axis: int
    number: int | None
    taken: bool
    busy: bool
    flag: str
    data: str


Response = (
    Ok | ErrorReply | Alarm | Status | Setting | Welcome | Message | Malformed | Counted | Reply
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
        return Malformed(line, "bytes that are not ASCII")
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
    return Malformed(line, "no answer of GRBL looks like this")


def _status(raw: bytes, text: str) -> Status | Malformed:
    if not text.endswith(">"):
        return Malformed(raw, "a status report without its end")
    head, *rest = text[1:-1].split("|")
    state = _STATE.fullmatch(head)
    if not state:
        return Malformed(raw, "a status report without a state")
    fields = {name: value for name, _, value in (field.partition(":") for field in rest)}
    if "<" in text[1:] or ">" in text[:-1] or len(fields) < len(rest):
        return Malformed(raw, "two status reports run together")
    positions: dict[str, Position | None] = {}
    for name in ("MPos", "WPos", "WCO"):
        parts = fields[name].split(",") if name in fields else []
        if name in fields and (len(parts) < 3 or not all(map(_NUMBER.fullmatch, parts))):
            return Malformed(raw, f"{name} is not three numbers or more")
        positions[name] = tuple(map(float, parts)) or None
    if positions["MPos"] is None and positions["WPos"] is None:
        return Malformed(raw, "a status report without a position")
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
            answers.append(Malformed(self._pending, why))
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


_REPORT = "The line that was sent is wrong: report it with the bench's log."


def _table(text: str, then: str = "") -> dict[int, Meaning]:
    """Entries "number what | do" in indented lines; "report" is `_REPORT`, ``then`` is added."""
    table = {}
    for entry in re.split(r"\n(?=\d)", text.strip()):
        number, words = re.sub(r"\s+", " ", entry).split(" ", 1)
        what, _, do = words.partition(" |")
        do = f"{do.strip()}, then {then}" if do and then else do.strip() or f"Call {then}"
        table[int(number)] = Meaning(what, _REPORT if do == "report" else do)
    return table


def _alarms(text: str) -> dict[int, Meaning]:
    return _table(text, "recover() and home().")


ERRORS = _table("""
1 a G-code word has no letter | report
2 a number is missing or badly written | report
3 the '$' command is not known | Check the firmware: some builds leave commands out ($I lists the
    options).
4 a setting can't be negative | Send a value of zero or more.
5 homing is switched off | Fit the switches and set $22=1.
6 the step pulse is too short | Set $0 to 3 or more.
7 the stored settings could not be read and were set to defaults | Load the stage's own settings
    again ($100 to $132).
8 the command is allowed only when the stage is idle | Wait until the move has finished, or end the
    hold.
9 G-code is locked out by an alarm, or while jogging | Home the stage; after an alarm recover it
    first.
10 soft limits need homing | Set $22=1 before $20=1.
11 the line is longer than the controller's line buffer | Keep lines below 80 characters.
12 the rate asks for more than 30000 steps a second | Lower the maximum rate or the steps per mm.
13 the safety door is open | Close it.
14 the build information or start-up line is too long | Shorten it.
15 the jog goes beyond the travel; it was not started | Jog less far.
16 the jog command is badly formed | report
17 laser mode needs a PWM output | Set $32=0.
20 the controller does not know this G-code word | Check the firmware's version and its build
    options.
21 two words of one modal group stand in a line | report
22 no feed rate has been given yet | Give a feed with the move.
23 a word needs a whole number | report
24 two commands of the line both need the axis words | report
25 a word is repeated in the line | report
26 the command needs axis words and has none | report
27 the line number is out of range | report
28 the command lacks a value | report
29 this work coordinate system does not exist | Use G54 to G59.
30 G53 goes with G0 and G1 only | report
31 axis words are left over | report
32 an arc has no axis word in its plane | report
33 the target of the move is invalid | Check target and limits.
34 the radius of an arc is impossible | report
35 an arc has no offset in its plane | report
36 words are left over | report
37 the tool length offset is not set up for this axis | report
38 the tool number is too large | report
""")

ALARMS = _alarms("""
1 a limit switch was hit and the position is probably lost | Clear the stage by hand with the power
    off
2 a target lay beyond the controller's soft limits; nothing moved there | Check $130 to $132
3 the controller was reset while moving and the position is lost
4 the probe was not in its initial state | Check the probe
5 the probe found no contact | Check the probe
6 homing was ended by a reset
7 homing was ended by the safety door | Close the door
8 a switch stayed closed after the pull-off | Look for a stuck or dirty switch, or raise $27
9 homing found no switch | Check the switches, their cables and $23, $5
10 the two motors of one axis found their switches too far apart | Square the gantry
""")

HAL_ALARMS = _alarms("""
10 the emergency stop is pressed | Release it when the cause is gone
11 the controller wants to be homed first
12 a limit switch is closed | Move the stage off it by hand with the power off
13 the probe's protection has stopped the stage | Check the probe
14 a spindle did not reach its speed; a stage has none | Switch the spindle off in its settings
15 of the two motors of one axis, one did not find its switch in time | Square the gantry
16 the controller's test of itself failed | Look at its own messages, switch it off and on
17 a motor driver reports a fault | Check the motor's driver, cable and load
""")

FLUIDNC_ERRORS = _table("""
18 no axis has a homing cycle | Give each axis that moves a homing cycle in the configuration file.
19 one axis can't be homed alone | Home all of them.
39 a parameter of this G-code word is too large | report
40 a control pin was active at the start | Look for a pressed button or a wrong pin, then restart.
120 another connection of the controller is busy | Close the other program, or its web page.
130 the jog was ended | Jog again.
151 the configuration has no such entry | Add the axis to the configuration file, with its homing.
152 the configuration is not valid | See the controller's own messages after its start.
""")

FLUIDNC_ALARMS = _alarms("""
10 a spindle did not reach its speed; a stage has none | Remove it from the configuration file
11 a control pin was active at the start | Look for a pressed button
12 both switches of an axis are closed | Check the switches and their pins
13 a hard stop was asked for | Release the button
14 the controller wants to be homed first
15 the controller's start failed | See its own messages
16 an expander board was reset | Check its cable and power
17 a G-code line was wrong | Report it with the bench's log
18 a limit switch was hit while probing
""")

_OWN = {"grblHAL": HAL_ALARMS, "FluidNC": FLUIDNC_ALARMS}


def meaning(answer: ErrorReply | Alarm, firmware: str = "Grbl") -> Meaning:
    """What it means in that firmware, unknown numbers included. A sentence stands for itself."""
    code, alarm = answer.code, isinstance(answer, Alarm)
    then = ", then recover() and home()."
    if isinstance(code, str):
        do = "Switch the controller off and on" if alarm else "See the firmware's documentation"
        return Meaning(code, do + then)
    kind = "alarm" if alarm else "error"
    unknown = Meaning(
        f"an {kind} that this program does not know",
        f"Look the number up in the firmware's list of {kind}s{then if alarm else '.'}",
    )
    own = _OWN.get(firmware, {}) if alarm else FLUIDNC_ERRORS if firmware == "FluidNC" else {}
    known = own.get(code) or (ALARMS if alarm else ERRORS).get(code, unknown)
    return known._replace(what=f"{kind} {code}: {known.what}")
