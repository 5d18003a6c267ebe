"""The conversation with Marlin: a line out, ``ok`` back, and other lines between.

Marlin reports neither whether it is homed nor what it does, and loses its position without a
message when it restarts. So the position is read from the step counts (M114); a volatile setting is
given an unusual value and read with each report (M113: another value means a restart); and an
answer that makes no sense, or a stop, costs the position. Sources: Marlin's G-code documentation;
its source 1.1, 2.0 and 2.1 (M113, M114, M115, M211, M503, language.h, e_parser); reports of its
users.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Mapping
from typing import ClassVar

from instruments.clock import Clock
from instruments.errors import DeviceError, InstrumentError, LimitError, LinkError, ProtocolError
from instruments.link import Link
from instruments.stage.connection import ANSWER_S, QUIET_S, START_S, STATUS_S, Dialogue, atomic
from instruments.stage.protocol import (
    HOME_AGAIN,
    Alarm,
    ErrorReply,
    MalformedLine,
    MarlinPosition,
    Message,
    Ok,
    Position,
    Response,
    Status,
    Welcome,
    axis_words,
)
from instruments.stage.settings import StageIdentity, StageSettings, Target

BEAT_S = 7  # the keepalive's seconds (M113) while we drive it; a restarted board has 2
BOOT_S = 10.0  # until a board with a card, a screen and stored settings has started
HALT_S = 5.0
ATTEMPTS = 3
HOMING_MM_S = 2.0  # slower than any axis homes; its homing speed is compiled in and not reported
_COUNTED_MM = 0.006  # positions come with two decimals


_FIGURE = r"(-?\d+(?:\.\d+)?)"
_COUNT = re.compile(rf"([A-Z]): *{_FIGURE} *")
_COUNTS = re.compile(r"(?:[A-Z]: *-?\d+(?:\.\d+)? *)+")
_OK = re.compile(r"ok(?! .*\bok)(?: .*)?")
_REFUSED = re.compile(r"Unknown command:.*|Error:.*|(?:Resend:|rs) ?\d+|Home .* First")
_STOPPED = re.compile(
    r"(?:Error:|!! ?).*(?:halted|stop|kill|runaway|heating failed|temp triggered).*", re.IGNORECASE
)
_WAITS = ("busy: paused for", "busy:paused for")
_SETTING = re.compile(r"\b(M\d+|G2[01])\b([^;]*)")
_WORD = re.compile(rf"([A-Z]) ?{_FIGURE}")
_SOFT = re.compile(r"\bM211 S1\b|Soft endstops: *ON\b", re.IGNORECASE)
_ENDS = re.compile(rf"\bMin:((?:\s*{_WORD.pattern})+)\s*Max:((?:\s*{_WORD.pattern})+)")
LACKING = {
    "M113": "Use a build with HOST_KEEPALIVE_FEATURE: without it a restart goes unnoticed.",
    "M211": "Use a build with software endstops (M211 reports them).",
    "M503": "Use a build that reports its settings in words (no DISABLE_M503).",
}
_NO_KINEMATICS = "Only machines whose motors are X, Y and Z (Cartesian) can be driven."


def parse(line: bytes) -> Response:
    """The value of one line, without its end. Never raises.

    Builds differ in blanks, in ``echo:`` and in what else they report: readable text that is no
    answer is a message. A damaged answer is malformed.
    """
    text = line.decode("ascii", "replace").strip()
    if not all(" " <= sign <= "~" or sign == "\t" for sign in text):
        return MalformedLine(line, "bytes that are not ASCII text")
    if _OK.fullmatch(text):
        return Ok()
    if text == "start":
        return Welcome("", "Marlin")
    if text.startswith("X:") and "Count" in text:
        sent, *counts = text.split("Count")
        parts = [_COUNT.findall(part) for part in (sent, *counts)]
        places = [{letter: float(number) for letter, number in part} for part in parts]
        whole = all(_COUNTS.fullmatch(part.strip()) for part in (sent, *counts))
        once = [len(part) for part in parts] == [len(place) for place in places]
        if len(counts) != 1 or not (whole and once):
            return MalformedLine(line, "places and counts that are not one number a letter")
        return MarlinPosition(*places)
    if text.startswith("ok"):
        return MalformedLine(line, "an ok with something else in it")
    while text.startswith("echo:"):  # some lines have it twice
        text = text.removeprefix("echo:").strip()
    if _STOPPED.fullmatch(text):
        return Alarm(text)
    if _REFUSED.fullmatch(text):
        return ErrorReply(text)
    return Message("echo", text)


def read_marlin(lines: list[str], axes: str, *, who: str) -> StageSettings:
    """The settings of a stage with ``axes`` from the answers to M503 and M211. Raises ProtocolError
    for a missing number, DeviceError for inches, home offsets, bed levelling or other kinematics.
    """
    found: dict[str, dict[str, float]] = {}
    for line in lines:
        for code, words in _SETTING.findall(line):  # a line an extruder in some builds
            figures = {letter: float(value) for letter, value in _WORD.findall(words)}
            found.setdefault(code, {}).update(figures)

    def refuse(what: str, hint: str) -> None:
        raise DeviceError(who, what, asked="M503", hint=hint)

    if "M665" in found:
        refuse("the kinematics (M665: delta, SCARA or polar) can't be driven", _NO_KINEMATICS)
    if "G20" in found:
        refuse("the controller counts in inches", "Send G21.")
    if any(found.get("M206", {}).values()):
        hint = "Send M206 X0 Y0 Z0 and M500: places would otherwise be shifted."
        refuse("the controller has home offsets", hint)
    if found.get("M420", {}).get("S"):
        hint = "Send M420 S0 and M500: its Z would otherwise follow a measured bed."
        refuse("bed levelling is on", hint)
    steps, rates, accels = (
        _axis_figures(found, code, axes, who) for code in ("M92", "M203", "M201")
    )
    text = "\n".join(lines)
    ends = _ENDS.search(text)
    if ends is None:
        what = "the travel is not reported"
        raise ProtocolError(who, what, asked="M211", hint=LACKING["M211"])
    low, high = (
        {letter: float(value) for letter, value in _WORD.findall(ends[group])} for group in (1, 4)
    )
    travel = {axis: high.get(axis, 0.0) - low.get(axis, 0.0) for axis in "XYZ"}
    if any(travel[axis] <= 0 for axis in axes):
        hint = "Set its bed size and travel in its configuration."
        raise DeviceError(who, "the travel is empty", asked="M211", seen=ends[0], hint=hint)
    return StageSettings(
        travel_mm=tuple(travel.values()),
        rate_mm_min=tuple([60 * rate for rate in rates]),
        accel_mm_s2=accels,
        steps_per_mm=steps,
        soft_limits=bool(_SOFT.search(text)),
        hard_limits=False,
        homing_seek_mm_min=60 * HOMING_MM_S,
        homing_feed_mm_min=60 * HOMING_MM_S,
        low_mm=tuple([low.get(axis, 0.0) for axis in "XYZ"]),
    )


def _axis_figures(
    found: Mapping[str, Mapping[str, float]], code: str, axes: str, who: str
) -> Position:
    """The words X, Y, Z of a setting; an axis that the build hasn't is 1 where it isn't needed."""
    words = found.get(code, {})
    if not all(words.get(axis, 0.0) > 0 for axis in axes):
        seen = str(dict(words)) if words else "nothing"
        what, hint = f"{code} is not usable", LACKING["M503"]
        raise ProtocolError(who, what, asked="M503", seen=seen, hint=hint)
    return tuple([words.get(axis) or 1.0 for axis in "XYZ"])


class MarlinDialogue(Dialogue):
    """The conversation on one link, for X, Y and Z."""

    firmware = "Marlin"
    jogs: ClassVar[bool] = False
    brakes_freely: ClassVar[bool] = False
    safe: ClassVar[str] = (
        "at a stand, its position lost if it moved; if it homed, halted until switched off and on"
    )
    _parse = staticmethod(parse)

    def __init__(self, link: Link, clock: Clock) -> None:
        super().__init__(link, clock)
        self._axes = "XY"
        self._steps: Position = (1.0, 1.0, 1.0)
        self._stale = False  # answers may come that belong to nothing
        self._marks = 0
        self._last_message = ""  # since the last line was sent: it says why a halt that follows is

    def identify(self, axes: str) -> tuple[StageIdentity, StageSettings]:
        if "A" in axes:
            raise LimitError(self.who, "Marlin is driven in X, Y and Z only", asked=axes)
        self.start()
        lines = self._messages("M115")
        said = " ".join(lines)
        named = re.search(
            r"FIRMWARE_NAME: ?Marlin (\S*)(.*?)(?: SOURCE_CODE_URL| [A-Z_]+:|$)", said
        )
        if named is None:
            what, hint = "this is not Marlin", "Is this the stage's port, and its baud rate right?"
            raise ProtocolError(self.who, what, asked="M115", seen=lines[0][:60], hint=hint)
        kinematics = re.search(r"KINEMATICS: ?(\S+)", said)
        if kinematics and kinematics[1] != "Cartesian":
            what = f"{kinematics[1]} kinematics can't be driven"
            raise DeviceError(self.who, what, asked="M115", hint=_NO_KINEMATICS)
        if "Cap:EMERGENCY_PARSER:1" not in lines:
            hint = "Use a build with EMERGENCY_PARSER: only then M410 and M112 are obeyed at once."
            what = "this Marlin can't be stopped while it homes"
            raise DeviceError(self.who, what, asked="M115", hint=hint)
        settings = read_marlin(self._messages("M503") + self._messages("M211"), axes, who=self.who)
        self._axes, self._steps = axes, settings.steps_per_mm
        self._counts()
        return StageIdentity("Marlin", named[1], named[2].strip(" ()"), ""), settings

    def identify_first(self, axes: str) -> None:
        """The steps, without which no place is known, and that a beat is ours."""
        self.identify(axes)

    def _messages(self, line: str) -> list[str]:
        return [said.text for said in self.command(line) if isinstance(said, Message)] or [""]

    @atomic
    def command(self, text: str, timeout_s: float = ANSWER_S) -> list[Response]:
        if self._stale:
            self._synchronize()
        self._last_message = ""
        try:
            return super().command(text, timeout_s)
        except DeviceError:
            self._stale = True  # an ``ok`` follows a refusal, too
            raise

    @atomic
    def status(self) -> Status:
        """A fresh report: "Run" while the step counts are not at the place that it was sent to."""
        if f"M113 S{BEAT_S}" not in self._messages("M113"):
            self.upsets += 1
            what = "the controller has restarted unnoticed: position lost"
            raise DeviceError(self.who, what, asked="M113", hint=HOME_AGAIN)
        counted = self._counts()
        at = tuple([counted.steps.get(x, 0.0) / n for x, n in zip("XYZ", self._steps, strict=True)])
        off = zip("XYZ", at, self._steps, strict=True)
        moving = any(
            abs(place - counted.sent_mm.get(axis, place)) > 0.5 / steps + _COUNTED_MM
            for axis, place, steps in off
            if axis in self._axes
        )
        return Status("Run" if moving else "Idle", None, at, None, None, {})

    def _counts(self) -> MarlinPosition:
        """The answer to M114. Raises ProtocolError without step counts, DeviceError for those of
        motors that are not the axes.
        """
        said = self.command("M114", STATUS_S)
        counted = next((one for one in said if isinstance(one, MarlinPosition)), None)
        if counted is None:
            self.upsets += 1
            hint = "Use a build of Marlin whose M114 reports them (Count X: Y: Z:)."
            raise ProtocolError(self.who, "no step counts", asked="M114", hint=hint)
        if not {*self._axes} <= {*counted.steps}:
            self.upsets += 1
            what = f"the counts are those of the motors {', '.join(counted.steps)}"
            if not {"A", "B", "C"} & {*counted.steps}:
                what = f"the controller has no axis {', '.join({*self._axes} - {*counted.steps})}"
            else:
                what += ": CoreXY, delta and other such kinematics can't be driven"
            raise DeviceError(self.who, what, asked="M114", hint=_NO_KINEMATICS)
        return counted

    def home(self, axes: str, bound_s: float) -> None:
        self.command(f"G28 {' '.join(axes)}", bound_s)
        self.finish(ANSWER_S)

    @property
    def homing(self) -> bool:
        return self.outstanding is not None and self.outstanding.startswith("G28")

    def move_lines(self, target: Target, feed_mm_min: float) -> list[str]:
        return ["G90", f"G1 {axis_words(target, feed_mm_min, who=self.who, between=' ')}"]

    def finish(self, timeout_s: float) -> None:
        self.command("M400", timeout_s)

    def brake(self) -> None:
        """Cut the steps, which costs the position."""
        self.write(b"M410\n")
        self.upsets += 1
        self._stale = True  # M410 is answered too, before or after what is outstanding

    cancel_jog = brake

    @atomic
    def abort(self) -> None:
        """Stop it by M410; M112 halts a board that homes or disobeys, until it is switched off."""
        self.upsets += 1
        if not self.homing:
            with contextlib.suppress(InstrumentError):
                self.brake()
                if self.status().state == "Idle":
                    return
        self.write(b"M112\n")
        wait = self._link.reception(self._clock.now() + HALT_S)
        while self.alarm is None:
            try:
                if self._next(wait) is None or wait.over:
                    what, hint = "it does not say that it has halted", "Cut its power."
                    raise LinkError(self.who, what, asked="M112", seconds=HALT_S, hint=hint)
            except (DeviceError, ProtocolError):
                continue

    @atomic
    def start(self) -> Welcome:
        """Wait for the board's start, if opening the port resets it, and for its attention."""
        self.upsets += 1
        if next(self._incoming(self._link.reception(self._clock.now() + START_S)), b""):
            self._link.drain(2 * QUIET_S, at_most_s=BOOT_S)
        for more in range(ATTEMPTS - 1, -1, -1):
            try:
                self._synchronize()
                break
            except InstrumentError:  # a board with a card or a screen starts slowly
                if not more:
                    raise
        return Welcome("", "Marlin")

    @atomic
    def restart(self) -> Welcome:
        """Synchronise: Marlin has no restart over the wire, and a halted one has to be switched off
        and on. Raises LinkError, ProtocolError, DeviceError.
        """
        self.upsets += 1
        halted = self.alarm
        try:
            self._synchronize()
        except InstrumentError:
            if halted is None:
                raise
            self.alarm = halted
            raise self._alarmed(asked="M118") from None
        return Welcome("", "Marlin")

    def _synchronize(self) -> None:
        """Have a line of ours echoed: what comes behind it answers our next lines. Motors stay on,
        and the keepalive becomes ours.
        """
        received = [*self._inbox, *self._decoder.feed(self._link.drain(QUIET_S))]
        last = [one for one in received if isinstance(one, Alarm | Welcome)][-1:]
        self._forget()
        if last and isinstance(last[0], Alarm):
            self.upsets += 1
            self.alarm = last[0].code
            raise self._alarmed(asked="M118")
        self._stale = False
        self.upsets += 1
        self._marks += 1
        mark = f"teatbench {self._marks}"
        wait = self._link.reception(self._clock.now() + ANSWER_S)
        self.write(b"\n" + f"M118 E1 {mark}\n".encode("ascii"))
        seen, marked, ended = b"", False, False
        for data in self._incoming(wait):
            seen += data
            for answer in self._decoder.feed(data):
                ended = ended or (marked and isinstance(answer, Ok))
                marked = marked or answer == Message("echo", mark)
            if ended:
                break
        if not ended:
            self._stale = True
            hint = "Check power, cable and baud rate; is this the stage's port?"
            if seen:
                what = "this is not Marlin, or it receives nothing"
                raise ProtocolError(self.who, what, asked="M118", seen=seen[:60], hint=hint)
            raise LinkError(self.who, "no answer", asked="M118", seconds=ANSWER_S, hint=hint)
        self.command("M84 S0")
        self.command(f"M113 S{BEAT_S}")

    def _judge(self, answer: Response) -> Response:
        if isinstance(answer, ErrorReply):
            self.upsets += 1
            lacking = LACKING.get((self.outstanding or "").split(" ")[0])
            if lacking and "Unknown command" in str(answer.code):
                what, asked = "the build doesn't know the command", self.outstanding
                self._stale = True
                raise DeviceError(self.who, what, asked=asked, seen=str(answer.code), hint=lacking)
        elif isinstance(answer, Alarm) and self._last_message:
            answer = Alarm(f"{answer.code} ({self._last_message})")
        elif isinstance(answer, Message) and answer.text.startswith(_WAITS):
            self.upsets += 1
            self._stale = True
            what, hint = "the controller waits for somebody at its panel", "Press its button."
            raise DeviceError(self.who, what, asked=self.outstanding, seen=answer.text, hint=hint)
        elif isinstance(answer, Message) and not answer.text.startswith(("busy", "T:", "//")):
            self._last_message = answer.text
        return super()._judge(answer)
