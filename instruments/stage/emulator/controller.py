"""The firmware: states, resets, alarms, real-time bytes, and the main loop over lines.

A line runs as a generator (``lines.execute``) that yields while it waits for planner, dwell or
homing; further bytes then stay in the receive buffer. Real-time bytes act at once. Output gathers
in ``out``. Sources: the firmware's interface and command documents, and its behaviour recorded in a
simulator.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from instruments.clock import Clock
from instruments.stage import protocol
from instruments.stage.emulator.carriage import Carriage
from instruments.stage.emulator.dialect import DEAF, STUBBORN, Dialect, Mode
from instruments.stage.emulator.gcode import Modes
from instruments.stage.emulator.homing import Switch
from instruments.stage.emulator.lines import Task, execute
from instruments.stage.emulator.motion import SOON_S
from instruments.stage.emulator.receiver import Receiver, split
from instruments.stage.emulator.report import SlowFields, status_report
from instruments.stage.emulator.store import Store

PASS_S = 0.001  # one pass of the main loop: reports that are asked for in it are sent first
RESTART_S = 0.02


class Controller:
    """One board's firmware and carriage. ``answer`` gets the one answer of each line."""

    def __init__(
        self,
        clock: Clock,
        settings: Store,
        dialect: Dialect,
        carriage: Carriage,
        answer: Callable[[str], None],
    ) -> None:
        self._clock = clock
        self.settings = settings
        self.dialect = dialect
        self.carriage = carriage
        self._answer = answer
        self._receiver = Receiver(dialect.receive_bytes)
        self.out = bytearray()
        self.broken_switches: dict[int, Switch] = {}
        self.probe_closed = False
        self.homed = False
        self._clear()
        self.mode = self._first_mode()

    @property
    def now(self) -> float:
        return self._clock.now()

    @property
    def moving(self) -> bool:
        return self.carriage.moving(self.now)

    @property
    def jogging(self) -> bool:
        return self.jogged and self.moving

    @property
    def room(self) -> int:
        """Bytes that the receive buffer still takes."""
        return self._receiver.room

    @property
    def locked(self) -> bool:
        return self.mode is Mode.LOCKED

    def unlock(self) -> None:
        """Leave the alarm without homing."""
        self.mode = Mode.READY

    def sleep(self) -> None:
        """Motors off until a reset."""
        self.mode = Mode.SLEEP

    def set_homing(self, on: bool) -> None:
        """A homing cycle begins, or has succeeded."""
        self.mode = Mode.HOMING if on else Mode.READY
        self.homed = not on

    def say(self, text: str) -> None:
        """Put a line out."""
        self.out += text.encode("ascii") + b"\r\n"

    def take(self, data: bytes) -> None:
        """Bytes from the host, cut anywhere. While the board restarts they are lost."""
        if self._restart_s < math.inf:
            return
        for realtime, part in split(data):
            if realtime:
                self._realtime(part)
                continue
            while part and self._receiver.room:  # what finds no room is lost
                room = self._receiver.room
                self._receiver.put(part[:room])
                part = part[room:]
                self.pump()

    # Resets and alarms

    def power_up(self, first_words: tuple[str, ...] = ()) -> None:
        """Power comes, or the host's opening of the port resets the board: the count is lost."""
        self.carriage.cut_power(self.now)
        self.homed = False
        self._clear()
        self.mode = self._first_mode()
        for line in first_words:
            self.say(line)
        self._greet()

    def restart(self) -> None:
        """What every soft reset ends in. The count stays; an alarm stays an alarm."""
        locked = self.mode in (Mode.LOCKED, Mode.CRITICAL, Mode.SLEEP)
        if self._task:
            self.say("ok")  # the line that was in the works is answered on the way out
        self.carriage.halt(self.now)
        self.carriage.override(100, 100, self.now)
        self._clear()
        self.mode = Mode.LOCKED if locked else Mode.READY
        self._greet()

    def alarm(self, code: int, *, critical: bool = False) -> None:
        """Stop dead and lock; a critical alarm makes deaf until a reset."""
        self.carriage.halt(self.now)
        self.homed = False
        self.mode = Mode.CRITICAL if critical else Mode.LOCKED
        self.say(f"ALARM:{code}")
        if critical:
            self.say("[MSG:Reset to continue]")

    @property
    def next_s(self) -> float:
        """When something happens by itself next."""
        due_s = min(self.due_s, self._resume_s, self._restart_s)
        return min(due_s, self.carriage.switch_due_s(self.now)) if self._hard_limits else due_s

    def check_limit_switches(self) -> None:
        """A limit switch that the carriage has run into is an alarm, where $21 says so."""
        if (
            self._hard_limits
            and self.carriage.take_pressed(self.now)
            and self.mode is not Mode.CRITICAL
        ):
            self.alarm(1, critical=True)

    @property
    def _hard_limits(self) -> bool:
        return bool(int(self.settings[21]) & 1)

    def _first_mode(self) -> Mode:
        return Mode.LOCKED if self.settings[22] else Mode.READY

    def _clear(self) -> None:
        self._receiver.clear()
        self._task: Task | None = None
        self.due_s = math.inf  # when the line in the works wants to be asked again
        self._resume_s = self._restart_s = math.inf  # when it goes on after a hold; has restarted
        self.modes = Modes(tuple(0.0 for _ in range(self.settings.axes)))
        self.slow = SlowFields()
        self.asked_while_homing = False
        self.jogged = False

    def _greet(self) -> None:
        self.say("")
        self.say(self.dialect.welcome)
        if self.mode is Mode.LOCKED:
            self.say("[MSG:'$H'|'$X' to unlock]")

    def _reset(self) -> None:
        if self.moving:
            self.alarm(6 if self.carriage.homing else 3)
        self.restart()

    # Real-time bytes

    def _realtime(self, byte: bytes) -> None:
        if byte == protocol.SOFT_RESET:
            self._reset()
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
            if self.jogging:
                self.carriage.cancel(self.now)
        else:
            self._override(byte)

    def _query(self) -> None:
        if self.dialect.always_reports or self.mode not in (Mode.HOMING, Mode.CRITICAL):
            self.say(self.status())
        elif self.mode is Mode.HOMING:
            self.asked_while_homing = True

    def _hold(self, door: bool) -> None:
        self._resume_s = math.inf
        if door:
            self.say("[MSG:Check Door]")
        if self.jogging:
            self.carriage.cancel(self.now)
        elif self.mode is Mode.READY and self.moving:
            self.carriage.hold(self.now)
        if door or (self.mode is Mode.READY and not self.jogged):
            self.mode = Mode.DOOR if door else Mode.HOLD

    def _resume(self) -> None:
        # while it still brakes, the byte is lost
        if self.mode in (Mode.HOLD, Mode.DOOR) and not self.moving:
            self._resume_s = self.now + PASS_S

    def _override(self, byte: bytes) -> None:
        feed, rapid = self.carriage.percent
        if byte in protocol.FEED_OVERRIDES:
            change = protocol.FEED_OVERRIDES[byte]
            feed = 100 if change is None else min(200, max(10, feed + change))
        rapid = protocol.RAPID_OVERRIDES.get(byte, rapid)
        if (feed, rapid) != self.carriage.percent:
            self.carriage.override(feed, rapid, self.now)
            self.pump()

    # The main loop

    def pump(self) -> None:
        """Take lines until one has to wait, or there are none."""
        if self.now >= self._restart_s - SOON_S:
            self.restart()
        if self.now >= self._resume_s - SOON_S:
            self._resume_s = math.inf
            if self.mode in (Mode.HOLD, Mode.DOOR):
                self.mode = Mode.READY
                self.carriage.resume(self.now)
        self.due_s = math.inf
        while self.mode not in DEAF and self._restart_s == math.inf:
            if self._task is None:
                line = next(self._receiver.lines(), None)
                if line is None:
                    return
                self._task = execute(self, line)
            try:
                self.due_s = next(self._task)
                return
            except StopIteration as end:
                self._finish(end.value)

    def _finish(self, code: int | None) -> None:
        if code is None:
            self._restart_s = self.now + RESTART_S
            return
        self._task = None
        self._answer("ok" if code == 0 else f"error:{code}")
        if self.mode is Mode.SLEEP:
            self.say("[MSG:Sleeping]")

    # Reports

    def status(self) -> str:
        """A status report, as ``?`` gets it."""
        return status_report(self)
