"""The motion stage: homing, moves in machine coordinates, hold, stop. The host's end.

The controller's word is never taken alone: a target is checked against the travel before it is sent, and a
move counts as finished when a dwell behind it has been answered, the stage is idle, and the position that is
read back is the target. No move before homing; whatever could have cost the position (alarm, restart, broken
link) asks for homing again, and only an explicit ``recover`` leaves an alarm. It may not know the phantom, the
world, or other frames than the stage's own machine frame: mm, 0 at the switches, negative everywhere else.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from instruments.clock import Clock
from instruments.errors import DeviceError, InstrumentError, LimitError, LinkError
from instruments.link import Link
from instruments.stage.dialogue import ANSWER_S, Dialogue
from instruments.stage.protocol import HOLD, RESUME, Message, Setting, Status, Welcome, move_line
from instruments.stage.settings import AxisLimits, StageIdentity, StageSettings, read_settings

POLL_S = 0.2  # the firmware asks for no more than 5 queries a second
STOP_S = 10.0  # braking takes a second at most; more means that the stage doesn't obey
TOLERANCE_MM = 0.01
_STILL = frozenset({"Idle", "Alarm", "Sleep", "Check", "Hold:0", "Door:0", "Door:1"})  # states, or states with a substate
_MOVING = frozenset({"Run", "Jog", "Home"})


@dataclass(frozen=True, slots=True)
class _Move:
    """A move under way: axis letter to mm, and when it must be over."""

    target_mm: dict[str, float]
    deadline_s: float
    allowed_s: float


class Stage:
    """The stage at the end of ``link``. One owner: not for use by two threads.

    Every call may raise LinkError (silence, broken link), ProtocolError (nonsense), DeviceError (the controller
    refused, gave an alarm, or restarted by itself) and LimitError (we refused before sending).
    """

    safe_state: ClassVar[str] = "at a stand and holding its position; after an alarm, locked until it is homed"

    def __init__(self, link: Link, clock: Clock) -> None:
        self._link = link
        self._clock = clock
        self._talk = Dialogue(link, clock)
        self._identity: StageIdentity | None = None
        self._settings: StageSettings | None = None
        self._homed_at: int | None = None  # the count of upsets when homing succeeded
        self._move: _Move | None = None

    def connect(self) -> StageIdentity:
        """Meet the controller and read its settings. Raises DeviceError for firmware or settings that we can't work with."""
        welcome = self._talk.start()
        if not welcome.version.startswith("1.1"):
            hint = "Load Grbl 1.1 or grblHAL."
            raise DeviceError(self._talk.who, f"firmware {welcome.dialect} {welcome.version} speaks another protocol", hint=hint)
        identity = self._ask_identity(welcome)
        values = {answer.number: answer.value for answer in self._talk.command("$$") if isinstance(answer, Setting)}
        settings = read_settings(values, who=self._talk.who)
        if settings.reports_inches:
            raise DeviceError(self._talk.who, "the controller reports in inches", asked="$$", hint="Set $13=0.")
        self._identity, self._settings = identity, settings
        return identity

    @property
    def identity(self) -> StageIdentity:
        """Who answered ``connect``. Raises LimitError before."""
        if self._identity is None:
            raise LimitError(self._talk.who, "not connected yet", hint="Call connect().")
        return self._identity

    @property
    def settings(self) -> StageSettings:
        """The controller's settings as ``connect`` read them. Raises LimitError before."""
        if self._settings is None:
            raise LimitError(self._talk.who, "not connected yet", hint="Call connect().")
        return self._settings

    @property
    def limits(self) -> dict[str, AxisLimits]:
        """The travel by axis letter, mm in machine coordinates. Raises LimitError before ``connect``."""
        return self.settings.limits

    @property
    def homed(self) -> bool:
        """Whether the position can be trusted: homed, and no alarm, restart or broken link since."""
        return self._homed_at == self._talk.upsets

    def status(self) -> Status:
        """The controller's own report, now."""
        return self._talk.status()

    def position(self) -> NDArray[np.float64]:
        """Where the controller believes the stage is, (3,) mm in machine coordinates. Means nothing unless ``homed``."""
        return np.array(self._talk.machine_mm(self._talk.status())[:3], dtype=np.float64)

    def home(self) -> None:
        """Run to the switches and set the position. Takes up to a minute or more. Raises DeviceError when it fails."""
        settings = self.settings
        if not settings.homing:
            raise LimitError(self._talk.who, "homing is switched off in the controller", hint="Fit the switches and set $22=1.")
        if self._under_way:
            raise LimitError(self._talk.who, "a move is under way", asked="$H", hint="Call finish_move(), or stop() and recover().")
        self._move = self._homed_at = None
        self._talk.command("$H", settings.homing_bound_s)
        status = self._talk.status()
        if status.state != "Idle":
            raise DeviceError(self._talk.who, "not idle after homing", asked="$H", seen=status.name, hint="Call recover(), then home().")
        self._homed_at = self._talk.upsets

    def move_to(self, x_mm: float, y_mm: float, *, z_mm: float | None = None, feed_mm_min: float | None = None) -> None:
        """Move in a straight line and come back once the stage stands at the target, as read back from the controller.

        Machine coordinates. Without a feed, as fast as the slower of the axes allows. Raises LimitError before
        homing, outside the travel, or unless the stage is idle; DeviceError when it ends elsewhere.
        """
        self.begin_move(x_mm, y_mm, z_mm=z_mm, feed_mm_min=feed_mm_min)
        self.finish_move()

    def begin_move(self, x_mm: float, y_mm: float, *, z_mm: float | None = None, feed_mm_min: float | None = None) -> None:
        """Start what ``finish_move`` waits for. Raises as ``move_to``."""
        target = {"X": x_mm, "Y": y_mm} | ({} if z_mm is None else {"Z": z_mm})
        line = move_line(target, self._feed(target, feed_mm_min), who=self._talk.who)
        self._check_target(target, line)
        status = self._talk.status()
        self._check_ready(status, line)
        here = dict(zip("XYZ", self._talk.machine_mm(status), strict=False))
        way = math.dist([here[axis] for axis in target], list(target.values()))
        allowed = 10.0 + 2 * 60 * way / min(self._feed(target, feed_mm_min), *self.settings.rate_mm_min)
        self._talk.command(line)
        self._move = _Move(target, self._clock.now() + allowed, allowed)

    def finish_move(self) -> None:
        """Wait for the move that was begun, or resumed. Raises DeviceError when it is held, too slow, or ends elsewhere."""
        move = self._under_way
        if move is None:
            raise LimitError(self._talk.who, "no move is under way", hint="Call begin_move().")
        self._await_idle(move)
        # Idle may be reported before the move has begun: only the dwell behind it shows that it is over.
        self._talk.command("G4P0", max(ANSWER_S, move.deadline_s - self._clock.now()))
        status = self._talk.status()
        if status.state != "Idle":
            raise DeviceError(self._talk.who, "not idle after the move", seen=status.name, hint="Was the stage held at its own panel?")
        self._compare(move, status)
        self._move = None

    def hold(self) -> None:
        """Brake and come back when the stage stands. Leaves the move to ``resume``; an idle stage is left alone."""
        if self._talk.status().state in _MOVING:
            self._talk.realtime(HOLD)
        self._await_still()

    def brake(self) -> None:
        """Send the byte that brakes and don't wait: the one call that another thread than the owner's may make.

        The owner's move then ends in a DeviceError. While homing, classic firmware ignores it. Raises LinkError.
        """
        self._talk.realtime(HOLD)

    def resume(self) -> None:
        """Go on after a hold, once the stage stands: sooner, the controller would lose the command. Raises LimitError unless held."""
        status = self._await_still()
        if status.name != "Hold:0":
            raise LimitError(self._talk.who, "nothing to resume: the stage is not held", seen=status.name)
        if move := self._under_way:
            self._move = _Move(move.target_mm, self._clock.now() + move.allowed_s, move.allowed_s)
        self._talk.realtime(RESUME)
        status = self._talk.status()
        if status.state == "Hold":
            raise DeviceError(self._talk.who, "the controller did not resume", seen=status.name, hint="Call recover(), then home().")

    def stop(self) -> None:
        """Bring the stage to a stand from any state, and come back when it stands. Call it as often as you like.

        Brakes without losing the position; only a controller that homes or doesn't answer is reset. An alarm has
        already cut the steps: it stays for the next call to report. Raises LinkError when the stage can't be reached.
        """
        if self._talk.alarm is not None:
            return
        if self._talk.owed == "$H":  # while homing, classic firmware obeys only a reset
            self._talk.restart()
            return
        try:
            if self._under_way:
                self._talk.realtime(HOLD)
            self.hold()
        except InstrumentError as error:
            self._stop_hard(error)

    safe = stop

    def recover(self) -> None:
        """Leave an alarm, a hold, or a conversation out of step: restart the controller. The stage must be homed again after it."""
        self._move = None
        self._talk.restart()
        status = self._talk.status()
        if status.state not in ("Idle", "Alarm"):
            raise DeviceError(
                self._talk.who, "neither idle nor locked after a reset", seen=status.name, hint="Switch the controller off and on."
            )

    def close(self) -> None:
        """Close the link. Does not stop the stage: call ``stop`` before."""
        self._link.close()

    @property
    def _under_way(self) -> _Move | None:
        """The move that was begun and not finished. Whatever costs the position ends it."""
        return self._move if self.homed else None

    def _ask_identity(self, welcome: Welcome) -> StageIdentity:
        told = {answer.kind: answer.text for answer in self._talk.command("$I") if isinstance(answer, Message)}
        return StageIdentity(welcome.dialect, welcome.version, told.get("VER", "").strip(":"), told.get("OPT", ""))

    def _feed(self, target: dict[str, float], feed_mm_min: float | None) -> float:
        rates = dict(zip("XYZ", self.settings.rate_mm_min, strict=True))
        return min(rates[axis] for axis in target) if feed_mm_min is None else feed_mm_min

    def _check_target(self, target: dict[str, float], line: str) -> None:
        if not self.homed:
            raise LimitError(self._talk.who, "no move before homing", asked=line, hint="Call home(); after an alarm recover() first.")
        for axis, value in target.items():
            limits = self.limits[axis]
            if not limits.hold(round(value, 3)):  # as it is sent
                what = f"{axis} = {value:.3f} mm is outside the travel, {limits.low_mm:g} to {limits.high_mm:g} mm"
                raise LimitError(self._talk.who, what, asked=line, hint="Machine coordinates are negative, 0 is at the switch.")

    def _check_ready(self, status: Status, line: str) -> None:
        if not self.homed:  # the report may have brought bad news with it
            raise LimitError(self._talk.who, "no move before homing", asked=line, hint="Call home().")
        if status.state != "Idle" or self._under_way:
            hint = "Call resume() and finish_move(), or recover()." if status.state == "Hold" else "Call finish_move(), or stop()."
            raise LimitError(self._talk.who, "a move is still under way, or the stage is not idle", asked=line, seen=status.name, hint=hint)

    def _await_idle(self, move: _Move) -> None:
        while (status := self._talk.status()).state != "Idle":
            if status.state not in _MOVING:
                self._lost_if_locked(status)
                hint = "Call resume() and finish_move()." if status.state == "Hold" else "See the controller's panel; then recover()."
                raise DeviceError(self._talk.who, "the move was interrupted", seen=status.name, hint=hint)
            if self._clock.now() > move.deadline_s:
                hint = "Is a feed override set, or does an axis stick?"
                raise DeviceError(self._talk.who, "the move takes too long", seen=status.name, seconds=move.allowed_s, hint=hint)
            self._talk.wait(POLL_S)

    def _compare(self, move: _Move, status: Status) -> None:
        here = dict(zip("XYZ", self._talk.machine_mm(status), strict=False))
        steps = dict(zip("XYZ", self.settings.steps_per_mm, strict=True))
        for axis, value in move.target_mm.items():
            if not abs(here[axis] - value) <= max(TOLERANCE_MM, 0.5 / steps[axis] + 0.001):
                self._homed_at = None
                what, seen = f"the stage is not at its target, {axis} = {value:.3f} mm", f"{axis} = {here[axis]:.3f} mm"
                raise DeviceError(self._talk.who, what, seen=seen, hint="Home it again.")

    def _await_still(self) -> Status:
        deadline = self._clock.now() + STOP_S
        while not _STILL & {(status := self._talk.status()).state, status.name}:
            if self._clock.now() > deadline:
                hint = "Cut its power."
                raise DeviceError(self._talk.who, "the stage does not stop", seen=status.name, seconds=STOP_S, hint=hint)
            self._talk.wait(POLL_S)
        self._lost_if_locked(status)
        return status

    def _lost_if_locked(self, status: Status) -> None:
        """A controller that is locked without our having seen why has lost its position."""
        if status.state in ("Alarm", "Sleep"):
            self._homed_at = None

    def _stop_hard(self, error: InstrumentError) -> None:
        """What is left when braking gave ``error``: nothing where the steps are cut already, else a reset."""
        if self._talk.alarm is not None:
            return
        try:
            self._talk.restart()
        except InstrumentError as worse:
            raise LinkError(self._talk.who, f"can't be stopped: {worse.what}", hint="Cut its power.") from error
