"""Emulated GRBL, grblHAL and FluidNC: states, resets, alarms, real-time bytes, the receive buffer,
G-code, and status reports.

While a line waits for planner, dwell or homing, further bytes stay in the receive buffer; real-time
bytes act at once. Straight moves, dwell, units, distance mode, machine coordinates, G92, jogs and
probing; spindle, coolant and program words do nothing. Arcs, tool offsets and more work coordinates
are error 20. Sources: the firmware's interface and command documents, and its behaviour recorded in
a simulator.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import Enum

from instruments.stage import protocol
from instruments.stage.emulator.controller import Controller, Work
from instruments.stage.emulator.motion import SOON_S, Vector

PASS_S = 0.001  # one pass of the main loop: reports that are asked for in it are sent first
RESTART_S = 0.02
LINE_PLACES = 79
OVERFLOW = "\n"  # stands for a line that was too long; no line can hold it
_REALTIME = re.compile(rb"([?!~\x18\x80-\xff])")
_LINE_END = re.compile(rb"[\r\n]")
_DROPPED = re.compile(r"\([^)]*\)?|;.*|[\0- ]")  # comments and blanks
_WORD = re.compile(r"([A-Z])([-+]?(?:\d+\.?\d*|\.\d+))?")
# reports from one slow field to the next
_IDLE_EVERY = 10
_BUSY_WCO_EVERY = 30
_BUSY_OV_EVERY = 20
_INCH_MM = 25.4
_AXES = "XYZA"
_GROUPS = {
    "G": {
        "motion": {0.0, 1.0, 38.2, 38.3, 38.4, 38.5, 80.0},
        "other": {4.0, 53.0, 92.0, 92.1},
        "plane": {17.0},
        "units": {20.0, 21.0},
        "distance": {90.0, 91.0},
        "feed mode": {94.0},
        "coordinates": {54.0},
        "tool": {40.0, 49.0},
        "path": {61.0},
        "arc distance": {91.1},
    },
    "M": {
        "program": {0.0, 1.0, 2.0, 30.0},
        "spindle": {3.0, 4.0, 5.0},
        "coolant": {7.0, 8.0, 9.0},
    },
}
_JOG_GROUPS = {"units", "distance", "other"}


class Mode(Enum):
    """What the firmware is in, by its names at rest and while moving."""

    READY = "Idle", "Run"
    LOCKED = "Alarm", "Alarm"
    CRITICAL = "Alarm", "Alarm", "all input is ignored until a reset"
    HOMING = "Home", "Home"
    HOLD = "Hold:0", "Hold:1"
    DOOR = "Door:0", "Door:2"
    SLEEP = "Sleep", "Sleep"


DEAF = frozenset({Mode.CRITICAL, Mode.HOLD, Mode.DOOR, Mode.SLEEP})  # lines wait
# holds, resumes and overrides are ignored
STUBBORN = frozenset({Mode.LOCKED, Mode.CRITICAL, Mode.HOMING, Mode.SLEEP})


class RefusedError(Exception):
    """The line is refused with this error number."""


@dataclass(frozen=True, slots=True)
class Modes:
    """What stays for later lines. ``offset_mm``: work zero in machine coordinates."""

    offset_mm: Vector
    motion: float = 0.0
    inches: bool = False
    relative: bool = False
    feed_mm_min: float = 0.0


@dataclass(frozen=True, slots=True)
class Words:
    """A line taken apart: G and M numbers by modal group, and the other letters' values."""

    groups: dict[str, float]
    values: dict[str, float]


def words(text: str, axes: int, most_line_number: float) -> Words:
    """Take a line apart (capitals, no blanks) for a board of so many axes. Raises RefusedError."""
    line, at = Words({}, {}), 0
    while at < len(text):
        found = _WORD.match(text, at)
        if found is None:
            raise RefusedError(1)
        letter, number, at = found[1], found[2], found.end()
        if number is None:
            raise RefusedError(2)
        value = float(number)
        if letter in _GROUPS:
            groups = _GROUPS[letter].items()
            group = next((name for name, members in groups if value in members), None)
            if group is None or group in line.groups:
                raise RefusedError(21 if group else 20)
            line.groups[group] = value
        elif letter not in _AXES[:axes] + "FPNST":
            raise RefusedError(20)
        elif letter in line.values:
            raise RefusedError(25)
        elif letter in "FNPST" and value < 0:
            raise RefusedError(4)
        else:
            line.values[letter] = value
    if int(line.values.get("N", 0)) > most_line_number:
        raise RefusedError(27)
    return line


def axis_numbers(place: Vector, inches: bool) -> str:
    """The axes' numbers as reports write them; the rotation A is in degrees whatever the units."""
    return ",".join(
        f"{v / _INCH_MM + 0.0:.4f}" if inches and axis < 3 else f"{v + 0.0:.3f}"
        for axis, v in enumerate(place)
    )


class GrblController(Controller):
    """One board; X, Y, Z, and A where it has it."""

    def power_up(self) -> None:
        super().power_up()
        self._clear()
        self.mode = Mode.LOCKED if self.settings[22] else Mode.READY
        self._greet()

    def restart(self) -> None:
        """What every soft reset ends in. The count stays; an alarm stays an alarm."""
        locked = self.mode in (Mode.LOCKED, Mode.CRITICAL, Mode.SLEEP)
        if self._work:
            self.say("ok")  # the line that was in the works is answered on the way out
        self.carriage.halt(self.now)
        self.carriage.follow(self.now).override(100, 100, self.now)
        self._clear()
        self.mode = Mode.LOCKED if locked else Mode.READY
        self._greet()

    def alarm(self, code: int, *, critical: bool = False) -> None:
        """Stop dead and lock; a critical alarm ignores all input until a reset."""
        self.carriage.halt(self.now)
        self.homed.clear()
        self.mode = Mode.CRITICAL if critical else Mode.LOCKED
        self.say(f"ALARM:{code}")
        if critical:
            self._message("Reset to continue")

    def _clear(self) -> None:
        self.drop()
        self._half = b""
        self._waiting = bytearray()  # in the receive buffer
        self._resume_s = self._restart_s = math.inf  # when it goes on after a hold; has restarted
        self._modes = Modes((0.0,) * self.settings.axes)
        self._until_wco = self._until_ov = 0  # reports until the next with this field
        self._asked_while_homing = self._jogged = False

    def _greet(self) -> None:
        self.say("")
        self.say(self.dialect.welcome)
        if self.mode is Mode.LOCKED:
            self._message("'$H'|'$X' to unlock")

    def _message(self, text: str) -> None:
        self.say(f"[MSG:{self.dialect.info}{text}]")

    @property
    def next_s(self) -> float:
        due_s = min(self._due_s, self._resume_s, self._restart_s)
        return min(due_s, self.carriage.switch_due_s(self.now)) if self._hard_limits else due_s

    def check_limit_switches(self) -> None:
        """A limit switch that the carriage has run into is an alarm, where $21 says so."""
        pressed = self._hard_limits and self.carriage.take_pressed(self.now)
        if pressed and self.mode is not Mode.CRITICAL:
            self.alarm(1, critical=True)

    @property
    def _hard_limits(self) -> bool:
        return bool(int(self.settings[21]) & 1)

    @property
    def _jogging(self) -> bool:
        return self._jogged and self.moving

    # The receive buffer

    @property
    def _room(self) -> int:
        """Bytes that can be taken before the main loop reads again."""
        return self.dialect.receive_bytes - len(self._waiting)

    def take(self, data: bytes) -> None:
        """Bytes from the host, cut anywhere. While the board restarts they are lost."""
        if self._restart_s < math.inf:
            return
        for at, part in enumerate(_REALTIME.split(data)):
            if at % 2:
                self._realtime(part)
                continue
            while part and (room := self._room):  # what finds no room is lost
                self._waiting += part[:room]
                part = part[room:]
                self.pump()

    def next_line(self) -> str | None:
        """The next whole line in capitals, without blanks and comments."""
        end = _LINE_END.search(self._waiting)
        self._half += self._waiting[: end.start() if end else None]
        del self._waiting[: end.end() if end else None]
        if end is None:
            return None
        line, self._half = self._half.decode("ascii"), b""
        text = _DROPPED.sub("", line).upper().lstrip("/")
        if not (self.dialect.configured and text.startswith("$")):
            text = text.replace("/", "")
        return text if len(text) <= LINE_PLACES else OVERFLOW

    # Real-time bytes

    def _realtime(self, byte: bytes) -> None:
        if byte == protocol.SOFT_RESET:
            if self.moving:
                self.alarm(6 if self.carriage.homing else 3)
            self.restart()
        elif byte == protocol.STATUS_QUERY:
            self._query()
        elif byte == protocol.DOOR and self.mode is Mode.HOMING:
            self.alarm(7)
            self.restart()
        elif self.mode in STUBBORN:
            return
        elif byte in (protocol.HOLD, protocol.DOOR):
            self._hold(byte == protocol.DOOR)
        elif byte == protocol.RESUME:
            self._resume()
        elif byte == protocol.JOG_CANCEL:
            if self._jogging:
                self.carriage.follow(self.now).cancel(self.now)
        else:
            self._override(byte)

    def _query(self) -> None:
        if self.dialect.always_reports or self.mode not in (Mode.HOMING, Mode.CRITICAL):
            self.say(self.status())
        elif self.mode is Mode.HOMING:
            self._asked_while_homing = True

    def _resume(self) -> None:
        # while it still brakes, the byte is lost
        if self.mode in (Mode.HOLD, Mode.DOOR) and not self.moving:
            self._resume_s = self.now + PASS_S

    def _hold(self, door: bool) -> None:
        self._resume_s = math.inf
        jogging = self._jogging
        if door:
            self._message("Check Door")
        if jogging:
            self.carriage.follow(self.now).cancel(self.now)
        elif self.mode is Mode.READY and self.moving:
            self.carriage.follow(self.now).hold(self.now)
        if door or (self.mode is Mode.READY and not jogging):
            self.mode = Mode.DOOR if door else Mode.HOLD

    def _override(self, byte: bytes) -> None:
        feed, rapid = self.carriage.motion.percent
        if byte in protocol.FEED_OVERRIDES:
            change = protocol.FEED_OVERRIDES[byte]
            feed = 100 if change is None else min(200, max(10, feed + change))
        rapid = protocol.RAPID_OVERRIDES.get(byte, rapid)
        if (feed, rapid) != self.carriage.motion.percent:
            self.carriage.follow(self.now).override(feed, rapid, self.now)
            self.pump()

    def status(self) -> str:
        """A status report, as ``?`` gets it."""
        now, moving, motion = self.now, self.moving, self.carriage.motion
        bits, inches, offset = (
            int(self.settings[10]),
            bool(self.settings[13]),
            self._modes.offset_mm,
        )
        place = self.settings.whole_steps(motion.position(now))
        work = tuple([at - zero for at, zero in zip(place, offset, strict=True)])
        jog = self.mode is Mode.READY and self._jogging
        parts = ["Jog" if jog else self.mode.value[moving]]
        mpos, wpos = axis_numbers(place, inches), axis_numbers(work, inches)
        parts.append(f"MPos:{mpos}" if bits & 1 else f"WPos:{wpos}")
        if bits & 2:
            free = self.dialect.planner_blocks - len(motion.blocks(now))
            parts.append(f"Bf:{free},{self._room}")
        parts.append(f"FS:{motion.speed(now) * 60:.0f},0")
        busy = moving or self.mode in (Mode.HOLD, Mode.DOOR)
        if self._until_wco == 0:
            self._until_wco = _BUSY_WCO_EVERY if busy else _IDLE_EVERY
            self._until_ov = max(self._until_ov, 1)
            parts.append(f"WCO:{axis_numbers(offset, inches)}")
        elif self._until_ov == 0:
            parts.append("Ov:{},{},100".format(*motion.percent))
            self._until_ov = _BUSY_OV_EVERY if busy else _IDLE_EVERY
        self._until_wco -= 1
        self._until_ov -= 1
        if self.dialect.more_fields:
            parts += [f"H:{int(bool(self.homed))}", "TLR:0"]
        return f"<{'|'.join(parts)}>"

    # The main loop

    def pump(self) -> None:
        if self.now >= self._restart_s - SOON_S:
            self.restart()
        if self.now >= self._resume_s - SOON_S:
            self._resume_s = math.inf
            if self.mode in (Mode.HOLD, Mode.DOOR):
                self.mode = Mode.READY
                self.carriage.follow(self.now).resume(self.now)
        super().pump()

    @property
    def ignores_input(self) -> bool:
        return self.mode in DEAF or self._restart_s < math.inf

    def work(self, text: str) -> Work:
        try:
            if text == OVERFLOW:
                raise RefusedError(11)
            if text.startswith("$J="):
                yield from self._jog(text[3:])
            elif text.startswith("$"):
                yield from self._system(text[1:])
            elif text:
                yield from self._gcode(text)
        except RefusedError as error:
            return f"error:{error}"
        if self.mode is not Mode.SLEEP:
            return "ok"
        self._answer("ok")
        self._message("Sleeping")
        return None

    # "$" lines

    def _system(self, text: str) -> Iterator[float]:
        if text == "X":
            if self.mode is Mode.LOCKED:
                self.mode = Mode.READY
                self._message("Caution: Unlocked")
        elif text == "":
            self.say("[HLP:$$ $G $I $x=val $J=line $SLP $X $H ~ ! ? ctrl-x]")
        elif text == "G":
            modes = self._modes
            units, distance = 20 if modes.inches else 21, 91 if modes.relative else 90
            self.say(
                f"[GC:G{modes.motion:g} G54 G17 G{units} G{distance} G94 M5 M9 T0"
                f" F{modes.feed_mm_min:.0f} S0]"
            )
        elif self.dialect.configured and text.startswith("/"):
            key = text.lower()
            said = self.settings.configuration(key)
            if said is None:
                raise RefusedError(3)
            self.say(f"${key}={said}")
        elif self.moving:
            raise RefusedError(8)
        elif text == "H":
            yield from self._home()
        elif text == "SLP":
            self.mode = Mode.SLEEP
        else:
            self._stored(text)

    def _stored(self, text: str) -> None:
        """Settings and build: reported, or a setting written."""
        if text in ("$", "I"):
            for line in self.settings.lines() if text == "$" else self.dialect.identity():
                self.say(line)
            return
        number, equals, value = text.partition("=")
        code = 2
        if number[:1].isdigit():
            with suppress(ValueError):
                code = self.settings.write(float(number), float(value)) if equals else 3
        if code:
            raise RefusedError(code)

    def _home(self) -> Iterator[float]:
        if not self.settings[22]:
            raise RefusedError(5)
        self.mode = Mode.HOMING
        yield from self.run_home(range(self.settings.axes))
        if not self.homed:  # an alarm has ended it, and it restarts
            self._restart_s = self.now + RESTART_S
            while True:
                yield math.inf
        if self._asked_while_homing:
            self._asked_while_homing = False
            self.say(self.status())
        self.mode = Mode.READY

    # G-code

    def _words(self, text: str) -> Words:
        return words(text, self.settings.axes, self.dialect.most_line_number)

    def _gcode(self, text: str) -> Iterator[float]:
        if self.mode is Mode.LOCKED or self._jogging:
            raise RefusedError(9)
        line, at_mm = self._words(text), self.target_mm()
        modes = self._modes_after(line)
        axes = _axes(line, modes.inches)
        other = line.groups.get("other")
        if other == 4.0:
            if "P" not in line.values:
                raise RefusedError(28)
            self._modes = modes
            yield from self._dwell(line.values["P"])
        elif other in (92.0, 92.1):
            self._set_work_zero(modes, axes if other == 92.0 else None)
        else:
            target, probing = _target(line, modes, axes, at_mm), 38.0 < modes.motion < 39.0
            if probing and target is None and "motion" in line.groups:
                raise RefusedError(26)
            if probing and target == at_mm:
                raise RefusedError(33)
            self._modes = modes
            if target:
                yield from self._probe(target) if probing else self._move(target)

    def _set_work_zero(self, modes: Modes, axes: dict[int, float] | None) -> None:
        """From now on ``axes`` have these values here; None: machine coordinates again."""
        if axes == {}:
            raise RefusedError(26)
        offset = [0.0] * self.settings.axes if axes is None else list(modes.offset_mm)
        at_mm = self.target_mm()
        for axis, value in (axes or {}).items():
            offset[axis] = at_mm[axis] - value
        if tuple(offset) != modes.offset_mm:
            self._until_wco = 0
        self._modes = replace(modes, offset_mm=tuple(offset))

    def _modes_after(self, line: Words) -> Modes:
        modes, groups = self._modes, line.groups
        inches = groups.get("units", 20.0 if modes.inches else 21.0) == 20.0
        relative = groups.get("distance", 91.0 if modes.relative else 90.0) == 91.0
        feed = modes.feed_mm_min
        if "F" in line.values:
            feed = line.values["F"] * (_INCH_MM if inches else 1.0)
        motion = groups.get("motion", modes.motion)
        return replace(modes, motion=motion, inches=inches, relative=relative, feed_mm_min=feed)

    def _dwell(self, seconds: float) -> Iterator[float]:
        yield from self.until_still()
        end = self.now + seconds
        while self.now < end - SOON_S:
            yield end

    def _move(self, target_mm: Vector) -> Iterator[float]:
        if self._beyond_soft_limits(target_mm):
            # to a stand without losing steps, then no line is taken until a reset
            self.carriage.follow(self.now).cancel(self.now)
            yield from self.until_still()
            self.alarm(2, critical=True)
            while True:
                yield math.inf
        modes = self._modes
        yield from self.plan(target_mm, modes.feed_mm_min / 60 if modes.motion != 0.0 else None)
        self._jogged = False

    def _probe(self, target_mm: Vector) -> Iterator[float]:
        """To the end of the way, for nothing ever touches this board's probe."""
        kind = self._modes.motion
        yield from self.until_still()
        if self.probe_closed is not (kind in (38.4, 38.5)):  # those move away
            self.alarm(4)
            return
        yield from self._move(target_mm)
        yield from self.until_still()
        if kind in (38.2, 38.4):  # those must find a change
            self.alarm(5)
        place = self.carriage.motion.position(self.now)
        self.say(f"[PRB:{axis_numbers(place, inches=False)}:0]")

    def _jog(self, text: str) -> Iterator[float]:
        """It leaves no mode behind."""
        if self.mode is Mode.LOCKED or (self.moving and not self._jogged):
            raise RefusedError(8)
        line = self._words(text)
        if "F" not in line.values:
            raise RefusedError(22)
        modes = replace(self._modes_after(line), motion=1.0)
        target = _target(line, modes, _axes(line, modes.inches), self.target_mm())
        if set(line.groups) - _JOG_GROUPS or line.groups.get("other", 53.0) != 53.0:
            raise RefusedError(16)
        if target:
            if self._beyond_soft_limits(target):
                raise RefusedError(15)
            yield from self.plan(target, modes.feed_mm_min / 60)
            self._jogged = True

    def _beyond_soft_limits(self, target_mm: Vector) -> bool:
        return bool(self.settings[20]) and self.settings.beyond_travel(target_mm)


def _axes(line: Words, inches: bool) -> dict[int, float]:
    """By number; the rotation A is in degrees whatever the units."""
    return {
        axis: line.values[word] * (_INCH_MM if inches and axis < 3 else 1.0)
        for axis, word in enumerate(_AXES)
        if word in line.values
    }


def _target(
    line: Words, modes: Modes, axes: dict[int, float], at_mm: Sequence[float]
) -> Vector | None:
    """Where a line's axis words lead to, machine coordinates; None without. Raises RefusedError."""
    machine = line.groups.get("other") == 53.0
    if machine and modes.motion not in (0.0, 1.0):
        raise RefusedError(30)
    if not axes:
        return None
    if modes.motion == 80.0:
        raise RefusedError(31)
    if modes.motion != 0.0 and modes.feed_mm_min == 0:
        raise RefusedError(22)
    target = list(at_mm)
    for axis, value in axes.items():
        if machine:
            target[axis] = value
        elif modes.relative:
            target[axis] += value
        else:
            target[axis] = value + modes.offset_mm[axis]
    return tuple(target)
