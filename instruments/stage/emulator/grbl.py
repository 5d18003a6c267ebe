"""Emulated GRBL, grblHAL and FluidNC: states, resets, alarms, real-time bytes, the receive buffer,
``$`` lines and status reports. The G-code is in `gcode`.

While a line waits for planner, dwell or homing, further bytes stay in the receive buffer; real-time
bytes act at once. Start-up lines set modes only. Sources: the firmware's interface and command
documents, and its behaviour recorded in a simulator.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from enum import Enum

from instruments.clock import Clock
from instruments.stage import protocol
from instruments.stage.emulator.carriage import Carriage
from instruments.stage.emulator.controller import Controller, Work
from instruments.stage.emulator.gcode import (
    AXES,
    INCH_MM,
    Action,
    Dwell,
    Flow,
    GCode,
    GcodeError,
    Probing,
    StraightMove,
)
from instruments.stage.emulator.motion import SOON_S, Vector
from instruments.stage.emulator.store import Store

PASS_S = 0.001  # one pass of the main loop: reports that are asked for in it are sent first
RESTART_S = 0.02
LINE_PLACES = 79
OVERFLOW = "\n"  # stands for a line that was too long; no line can hold it
_REALTIME = re.compile(rb"([?!~\x18\x80-\xff])")
_LINE_END = re.compile(rb"[\r\n]")
_DROPPED = re.compile(r"\([^)]*\)?|;.*|[\0- ]")  # comments and blanks
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)")
# reports from one slow field to the next
_IDLE_EVERY = 10
_BUSY_WCO_EVERY = 30
_BUSY_OV_EVERY = 20


class Mode(Enum):
    """The firmware's states, each by its names at rest and while moving."""

    READY = "Idle", "Run"
    LOCKED = "Alarm", "Alarm"
    CRITICAL = "Alarm", "Alarm", "all input is ignored until a reset"
    HOMING = "Home", "Home"
    HOLD = "Hold:0", "Hold:1"
    DOOR = "Door:0", "Door:2"
    SLEEP = "Sleep", "Sleep"
    CHECK = "Check", "Check"


LINES_WAIT = frozenset({Mode.CRITICAL, Mode.HOLD, Mode.DOOR, Mode.SLEEP})
# holds, resumes and overrides
CONTROLS_IGNORED = frozenset({Mode.LOCKED, Mode.CRITICAL, Mode.HOMING, Mode.SLEEP, Mode.CHECK})


class GrblController(Controller):
    """One board; X, Y, Z, and A where it has it."""

    def __init__(
        self, clock: Clock, settings: Store, carriage: Carriage, answer: Callable[[str], None]
    ) -> None:
        self.gcode = GCode(AXES[: settings.axes], settings.dialect.most_line_number)
        self._startup, self._info = ["", ""], ""
        self._afterwards: Callable[[], None] | None = None  # what is done after a line's answer
        super().__init__(clock, settings, carriage, answer)

    def power_up(self) -> None:
        super().power_up()
        self._clear()
        self.mode = Mode.LOCKED if self.settings[22] else Mode.READY
        self._greet()

    def restart(self, *, answered: bool = False) -> None:
        """What every soft reset ends in. The count stays; an alarm stays an alarm."""
        locked = self.mode in (Mode.LOCKED, Mode.CRITICAL, Mode.SLEEP)
        if self._work and not answered:
            self.say("ok")  # a reset answers the line that is under way
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
        self.gcode.reset()
        self.gcode.at_mm = self.target_mm()
        self._probed = (0.0,) * self.settings.axes, 0  # where a probing ended, and whether well
        self._until_wco = self._until_ov = 0  # reports until the next with this field
        self._asked_while_homing = self._jogged = False
        self._pressed = set(self.carriage.pressed(self.now))  # an alarm is for those that close

    def _greet(self) -> None:
        self.say("")
        self.say(self.dialect.welcome)
        if self.mode is Mode.LOCKED:
            self._message("'$H'|'$X' to unlock")
        else:
            self._start_up()

    def _start_up(self) -> None:
        for line in filter(None, self._startup):
            try:
                self.gcode.take(line)
                self.say(f">{line}:ok")
            except GcodeError as error:
                self.say(f">{line}:error:{error}")

    def _message(self, text: str) -> None:
        self.say(f"[MSG:{self.dialect.info}{text}]")

    @property
    def next_s(self) -> float:
        return min(
            self._due_s, self._resume_s, self._restart_s, self.carriage.motion.next_end_s(self.now)
        )

    def check_limit_switches(self) -> None:
        """A limit switch that the carriage has run into is an alarm, where $21 says so."""
        pressed = set(self.carriage.pressed(self.now))
        if pressed - self._pressed and self.settings[21] and self.mode is not Mode.CRITICAL:
            self.alarm(1, critical=True)
        self._pressed = pressed

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
        self.check_limit_switches()
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
            if self.dialect.always_reports or self.mode not in (Mode.HOMING, Mode.CRITICAL):
                self.say(self.status())
            elif self.mode is Mode.HOMING:
                self._asked_while_homing = True
        elif byte == protocol.DOOR and self.mode is Mode.HOMING:
            self.alarm(7)
            self.restart()
        elif self.mode not in CONTROLS_IGNORED:
            self._control(byte)

    def _control(self, byte: bytes) -> None:
        """Holds, resumes and overrides."""
        if byte in (protocol.HOLD, protocol.DOOR):
            self._hold(byte == protocol.DOOR)
        elif byte == protocol.RESUME:
            # while it still brakes, the byte is lost
            if self.mode in (Mode.HOLD, Mode.DOOR) and not self.moving:
                self._resume_s = self.now + PASS_S
        elif byte == protocol.JOG_CANCEL:
            if self._jogging:
                self.carriage.follow(self.now).cancel(self.now)
        else:
            self._override(byte)

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
            self._until_ov = 0
            self.carriage.follow(self.now).override(feed, rapid, self.now)
            self.pump()

    def _numbers(self, place: Vector) -> str:
        """The axes' numbers as reports write them; the rotation A is in degrees."""
        inches = bool(self.settings[13])
        return ",".join(
            f"{v / INCH_MM + 0.0:.4f}" if inches and axis < 3 else f"{v + 0.0:.3f}"
            for axis, v in enumerate(place)
        )

    def _rate(self, mm_min: float) -> str:
        if self.settings[13]:
            return f"{mm_min / INCH_MM:.1f}"
        return f"{math.floor(mm_min + 0.5)}"  # a half is rounded up

    def status(self) -> str:
        """A status report, as ``?`` gets it."""
        now, moving, motion = self.now, self.moving, self.carriage.motion
        bits, offset = int(self.settings[10]), self.gcode.offset_mm()
        place = self.settings.whole_steps(self.place_mm())
        jog = self.mode is Mode.READY and self._jogging
        parts = ["Jog" if jog else self.mode.value[moving]]
        if bits & 1:
            parts.append(f"MPos:{self._numbers(place)}")
        else:
            work = [at - zero for at, zero in zip(place, offset, strict=True)]
            parts.append(f"WPos:{self._numbers(tuple(work))}")
        if bits & 2:
            parts.append(f"Bf:{self.dialect.planner_blocks - len(motion.left(now))},{self._room}")
        parts.append(f"FS:{self._rate(motion.speed(now) * 60)},0")
        if pins := self._pins():
            parts.append(f"Pn:{pins}")
        busy = moving or self.mode in (Mode.HOLD, Mode.DOOR)
        if self.gcode.offset_changed:
            self.gcode.offset_changed, self._until_wco = False, 0
        if self._until_wco == 0:
            self._until_wco = _BUSY_WCO_EVERY if busy else _IDLE_EVERY
            self._until_ov = max(self._until_ov, 1)
            parts.append(f"WCO:{self._numbers(offset)}")
        elif self._until_ov == 0:
            parts.append("Ov:{},{},100".format(*motion.percent))
            self._until_ov = _BUSY_OV_EVERY if busy else _IDLE_EVERY
        self._until_wco -= 1
        self._until_ov -= 1
        if self.dialect.more_fields:
            parts += [f"H:{int(bool(self.homed))}", "TLR:0"]
        return f"<{'|'.join(parts)}>"

    def _pins(self) -> str:
        """The input pins that are active: the probe's, and the limit switches'."""
        pressed, inverted = self.carriage.pressed(self.now), self.settings.limits_inverted
        limits = [
            axis for at, axis in enumerate(self.gcode.axes) if (at in pressed) is not inverted
        ]
        return "P" * (self.probe_closed is not bool(self.settings[6])) + "".join(limits)

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
        return self.mode in LINES_WAIT or self._restart_s < math.inf

    def work(self, text: str) -> Work:
        try:
            if text == OVERFLOW:
                raise GcodeError(11)
            if text.startswith("$"):
                yield from self._system(text[1:])
            elif text:
                if self.mode is Mode.LOCKED or self._jogging:
                    raise GcodeError(9)
                yield from self._run(text)
        except GcodeError as error:
            return f"error:{error}"
        afterwards, self._afterwards = self._afterwards, None
        if afterwards is None:
            return "ok"
        self._answer("ok")
        afterwards()
        return None

    # "$" lines

    def _system(self, text: str) -> Iterator[float]:
        """Those taken beyond idle and alarm; the order of faults is the firmware's."""
        first = text[:1]
        if not text:
            self.say("[HLP:$$ $# $G $I $N $x=val $Nx=line $J=line $SLP $C $X $H ~ ! ? ctrl-x]")
        elif first == "J":
            yield from self._jog(text[1:])
        elif first in "$GCX":
            if len(text) > 1:
                raise GcodeError(3)
            self._state_line(first)
        elif first == "/" and self.dialect.configured:
            key = text.lower()
            said = self.settings.configuration(key)
            if said is None:
                raise GcodeError(3)
            self.say(f"${key}={said}")
        elif self.moving or self.mode not in (Mode.READY, Mode.LOCKED):
            raise GcodeError(8)
        elif first == "H":
            yield from self._home(text)
        elif first == "N" and len(text) > 1:
            yield from self._store_startup(text[1:])
        else:
            self._stored(text)

    def _state_line(self, text: str) -> None:
        if text == "$":
            if self.moving and not self._jogging:
                raise GcodeError(8)
            for line in self.settings.lines():
                self.say(line)
        elif text == "G":
            modes = self.gcode.modes
            self.say(f"[GC:{modes} F{self._rate(modes.feed)} S{math.floor(modes.speed + 0.5)}]")
        elif text == "X" and self.mode is Mode.LOCKED:
            self.mode = Mode.READY
            self._message("Caution: Unlocked")
        elif text == "C" and self.mode is Mode.CHECK:
            self._message("Disabled")
            self._afterwards = lambda: self.restart(answered=True)
        elif text == "C":
            if self.moving or self.mode is not Mode.READY:
                raise GcodeError(8)
            self.mode = Mode.CHECK
            self._message("Enabled")

    def _stored(self, text: str) -> None:
        """Parameters, settings and build: reported or written."""
        head, equals, value = text.partition("=")
        if text == "SLP":
            self.mode = Mode.SLEEP
            self._afterwards = lambda: self._message("Sleeping")
        elif head == "RST" and value in ("$", "#", "*"):
            self._restore(value)
        elif head == "I" and equals:
            self._info = value
        elif text in ("#", "N", "I"):
            self._report(text)
        elif text[0] in "#ISR":
            raise GcodeError(3)
        else:
            number, value = _setting(text)
            found = _NUMBER.match(value)
            if found is None:
                raise GcodeError(2)
            if found.end() < len(value) or number > 255:
                raise GcodeError(3)
            if code := self.settings.write(int(number), float(found[0])):
                raise GcodeError(code)
            self.gcode.offset_changed |= number == 13

    def _report(self, text: str) -> None:
        if text == "#":
            for code, place in self.gcode.stored.items():
                self.say(f"[G{code:g}:{self._numbers(place)}]")
            self.say(f"[G92:{self._numbers(self.gcode.g92_mm)}]")
            self.say(f"[TLO:{self._numbers((self.gcode.modes.tool_mm,))}]")
            self._report_probe()
        elif text == "I":
            for line in self.dialect.identity(self._info):
                self.say(line)
        else:
            for at, line in enumerate(self._startup):
                self.say(f"$N{at}={line}")

    def _report_probe(self) -> None:
        place, well = self._probed
        self.say(f"[PRB:{self._numbers(place)}:{well}]")

    def _restore(self, what: str) -> None:
        if what != "#":
            self.settings.restore()
        if what != "$":
            self.gcode.restore()
        if what == "*":
            self._startup, self._info = ["", ""], ""
        self._message("Restoring defaults")
        self._afterwards = lambda: self.restart(answered=True)

    def _store_startup(self, text: str) -> Iterator[float]:
        if self.mode is not Mode.READY:
            raise GcodeError(8)
        number, line = _setting(text)
        yield from self._run(line)
        if int(number) in (0, 1):
            self._startup[int(number)] = line

    def _home(self, text: str) -> Iterator[float]:
        if not self.settings[22]:
            raise GcodeError(5)
        if text != "H":
            raise GcodeError(3)
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
        self._start_up()

    # G-code

    def _run(self, text: str) -> Iterator[float]:
        self._follow_count()
        for action in self.gcode.take(text):
            yield from self._act(action)

    def _follow_count(self) -> None:
        """Something else than a line of G-code may have ended a motion."""
        end_mm = self.target_mm()
        if self.mode is not Mode.CHECK and self.settings.whole_steps(self.gcode.at_mm) != end_mm:
            self.gcode.at_mm = end_mm

    def _act(self, action: Action) -> Iterator[float]:
        if isinstance(action, StraightMove | Probing):
            if self.settings[20] and self.settings.beyond_travel(action.target_mm):
                yield from self._soft_limit()
            if self.mode is Mode.CHECK:
                return
            if isinstance(action, StraightMove):
                yield from self._straight(action)
            else:
                yield from self._probe(action)
            return
        checking = self.mode is Mode.CHECK
        if not checking:
            yield from self.until_still()
        if isinstance(action, Dwell) and not checking:
            end_s = self.now + action.seconds
            while self.now < end_s - SOON_S:
                yield end_s
        elif isinstance(action, Flow) and action.end:
            self._message("Pgm End")
        elif isinstance(action, Flow) and not checking:
            self.mode = Mode.HOLD
            yield math.inf

    def _straight(self, move: StraightMove) -> Iterator[float]:
        feed = None if move.feed_mm_min is None else move.feed_mm_min / 60
        yield from self.plan(move.target_mm, feed)
        self._jogged = False

    def _soft_limit(self) -> Iterator[float]:
        """To a stand without losing steps, then no line is taken until a reset."""
        self.carriage.follow(self.now).cancel(self.now)
        yield from self.until_still()
        self.alarm(2, critical=True)
        while True:
            yield math.inf

    def _probe(self, way: Probing) -> Iterator[float]:
        """To the end of the way, for nothing ever touches this board's probe."""
        yield from self.until_still()
        self._probed = self._probed[0], 0
        if self.probe_closed is not way.away:
            self.alarm(4)
            return
        yield from self._straight(StraightMove(way.target_mm, way.feed_mm_min))
        yield from self.until_still()
        if way.strict:
            self.alarm(5)
        else:
            self._probed = self.target_mm(), 0
        self._report_probe()

    def _jog(self, text: str) -> Iterator[float]:
        if self.mode is not Mode.READY or (self.moving and not self._jogged):
            raise GcodeError(8)
        if not text.startswith("="):
            raise GcodeError(3)
        self._follow_count()
        move = self.gcode.jog(text[1:])
        if move:
            if self.settings[20] and self.settings.beyond_travel(move.target_mm):
                raise GcodeError(15)
            self.gcode.at_mm = move.target_mm
            yield from self._straight(move)
            self._jogged = True


def _setting(text: str) -> tuple[float, str]:
    """``number=value``. Raises GcodeError."""
    found = _NUMBER.match(text)
    if found is None:
        raise GcodeError(2)
    if text[found.end() : found.end() + 1] != "=":
        raise GcodeError(3)
    return float(found[0]), text[found.end() + 1 :]
