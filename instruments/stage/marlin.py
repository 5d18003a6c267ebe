"""The conversation with Marlin: a line out, ``ok`` back, and chatter between.

Marlin says neither whether it is homed nor what it does, and forgets its position without a word
when it restarts. So the position is read from the step counts (M114), a volatile setting that we
make unusual is asked back with each report (M113: another value means a restart), and whatever
stops it or makes no sense costs the position. Sources: Marlin's G-code documentation; its source
2.0 and 2.1 (M113, M114, M115, M211, language.h, e_parser).
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Mapping
from typing import ClassVar

from instruments.clock import Clock
from instruments.errors import DeviceError, InstrumentError, LimitError, LinkError, ProtocolError
from instruments.link import Link
from instruments.stage.connection import ANSWER_S, QUIET_S, START_S, STATUS_S, Dialogue
from instruments.stage.protocol import (
    Alarm,
    Counted,
    ErrorReply,
    Malformed,
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
_COUNTED = re.compile(
    rf"X:{_FIGURE} Y:{_FIGURE} Z:{_FIGURE} .*"
    rf"Count X:\s*{_FIGURE} Y:\s*{_FIGURE} Z:\s*{_FIGURE}(?: .*)?"
)
_OK = re.compile(r"ok( .*)?")
_REFUSED = re.compile(r"echo:Unknown command: .*|echo:Home .* First|Error:.*|Resend: ?\d+")
_STOPPED = re.compile(r"Error:.*(halted|stopped|[Kk]ill).*")
_CHATTER = ("echo:", "//", "Cap:", "FIRMWARE_NAME:", "area:", "T:", " T:", "wait", "Marlin")
_SETTING = re.compile(r"\b(M\d+|G2[01])\b([^;]*)")
_WORD = re.compile(rf"([A-Z]){_FIGURE}")
_ENDS = re.compile(
    rf"Soft endstops:\s*(\w+)\s+Min:\s*X{_FIGURE}\s+Y{_FIGURE}\s+Z{_FIGURE}"
    rf"\s+Max:\s*X{_FIGURE}\s+Y{_FIGURE}\s+Z{_FIGURE}",
    re.IGNORECASE,
)


def parse(line: bytes) -> Response:
    """The value of one line, without its end. Never raises."""
    try:
        text = line.decode("ascii")
    except UnicodeDecodeError:
        return Malformed(line, "bytes that are not ASCII")
    if _OK.fullmatch(text):
        return Ok()
    if text == "start":
        return Welcome("", "Marlin")
    if found := _COUNTED.fullmatch(text):
        numbers = tuple(map(float, found.groups()))
        return Counted(numbers[:3], numbers[3:])
    if _STOPPED.fullmatch(text):
        return Alarm(text)
    if _REFUSED.fullmatch(text):
        return ErrorReply(text)
    if text.startswith(_CHATTER):
        return Message("echo", text.removeprefix("echo:").strip())
    return Malformed(line, "no answer of Marlin looks like this")


def read_marlin(lines: list[str], axes: str, *, who: str) -> StageSettings:
    """The settings of a stage with ``axes`` from the answers to M503 and M211. Raises ProtocolError
    for a missing number, DeviceError for inches, home offsets or bed levelling.
    """
    found = {
        setting[1]: {letter: float(value) for letter, value in _WORD.findall(setting[2])}
        for line in lines
        for setting in _SETTING.finditer(line)
    }
    ends = next(filter(None, map(_ENDS.search, lines)), None)
    if "G20" in found:
        raise DeviceError(who, "the controller counts in inches", asked="M503", hint="Send G21.")
    if any(found.get("M206", {}).values()):
        hint = "Send M206 X0 Y0 Z0 and M500: places would otherwise be shifted."
        raise DeviceError(who, "the controller has home offsets", asked="M503", hint=hint)
    if found.get("M420", {}).get("S"):
        hint = "Send M420 S0 and M500: its Z would otherwise follow a measured bed."
        raise DeviceError(who, "bed levelling is on", asked="M503", hint=hint)
    steps, rates, accels = (_axis_figures(found, code, who) for code in ("M92", "M203", "M201"))
    if ends is None:
        hint = "Use a build with software endstops (M211 reports them)."
        raise ProtocolError(who, "the travel is not reported", asked="M211", hint=hint)
    low = tuple([float(ends[at]) for at in (2, 3, 4)])
    travel = tuple([float(ends[at + 3]) - low[at - 2] for at in (2, 3, 4)])
    if any(travel["XYZ".index(axis)] <= 0 for axis in axes):
        hint = "Set its bed size and travel in its configuration."
        raise DeviceError(who, "the travel is empty", asked="M211", seen=ends[0], hint=hint)
    return StageSettings(
        travel_mm=travel,
        rate_mm_min=tuple([60 * rate for rate in rates]),
        accel_mm_s2=accels,
        steps_per_mm=steps,
        soft_limits=ends[1].upper() == "ON",
        hard_limits=False,
        homing=True,
        homing_seek_mm_min=60 * HOMING_MM_S,
        homing_feed_mm_min=60 * HOMING_MM_S,
        pull_off_mm=0.0,
        low_mm=low,
    )


def _axis_figures(found: Mapping[str, Mapping[str, float]], code: str, who: str) -> Position:
    words = found.get(code, {})
    if not all(words.get(axis, 0.0) > 0 for axis in "XYZ"):
        hint = "Use a build that reports its settings in words (no DISABLE_M503)."
        raise ProtocolError(who, f"{code} is not usable", asked="M503", seen=str(words), hint=hint)
    return tuple([words[axis] for axis in "XYZ"])


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

    def identify(self, axes: str) -> tuple[StageIdentity, StageSettings]:
        if "A" in axes:
            raise LimitError(self.who, "Marlin is driven in X, Y and Z only", asked=axes)
        self.start()
        lines = self._told("M115")
        named = re.search(r"FIRMWARE_NAME:Marlin (\S*)(.*?)(?: SOURCE_CODE_URL|$)", " ".join(lines))
        if named is None:
            what, hint = "this is not Marlin", "Is this the stage's port, and its baud rate right?"
            raise ProtocolError(self.who, what, asked="M115", seen=lines[0][:60], hint=hint)
        if "Cap:EMERGENCY_PARSER:1" not in lines:
            hint = "Use a build with EMERGENCY_PARSER: only then M410 and M112 are obeyed at once."
            what = "this Marlin can't be stopped while it homes"
            raise DeviceError(self.who, what, asked="M115", hint=hint)
        settings = read_marlin(self._told("M503") + self._told("M211"), axes, who=self.who)
        self._axes, self._steps = axes, settings.steps_per_mm
        return StageIdentity("Marlin", named[1], named[2].strip(" ()"), ""), settings

    def _told(self, line: str) -> list[str]:
        return [said.text for said in self.command(line) if isinstance(said, Message)] or [""]

    def command(self, text: str, timeout_s: float = ANSWER_S) -> list[Response]:
        if self._stale:
            self._synchronize()
        try:
            return super().command(text, timeout_s)
        except DeviceError:
            self._stale = True  # an ``ok`` follows a refusal, too
            raise

    def status(self) -> Status:
        """A fresh report: "Run" while the step counts are not at the place that it was sent to."""
        if f"M113 S{BEAT_S}" not in self._told("M113"):
            self.upsets += 1
            what = "the controller has restarted unnoticed: position lost"
            raise DeviceError(self.who, what, asked="M113", hint="Call recover(), then home().")
        said = self.command("M114", STATUS_S)
        counted = next((one for one in said if isinstance(one, Counted)), None)
        if counted is None:
            self.upsets += 1
            hint = "A machine whose motors are not its axes (CoreXY, delta) can't be driven."
            raise ProtocolError(self.who, "no step counts", asked="M114", hint=hint)
        at = tuple([count / each for count, each in zip(counted.steps, self._steps, strict=True)])
        off = zip("XYZ", at, counted.sent_mm, self._steps, strict=True)
        moving = any(abs(a - b) > 0.5 / s + _COUNTED_MM for x, a, b, s in off if x in self._axes)
        return Status("Run" if moving else "Idle", None, at, None, None, {})

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

    def abort(self) -> None:
        """Stop it by M410; M112 halts a board that homes or doesn't obey, until it is
        switched off.
        """
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
        return super()._judge(answer)
