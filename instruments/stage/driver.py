"""The motion stage: homing, moves in machine coordinates, jogs, hold and stop. The host's end.

Targets are checked before sending. A move is finished when a dwell behind it was answered, the
stage is idle, and the position read back is the target. An alarm, a restart, a broken link or an
answer that makes no sense asks for homing again, and only ``recover`` leaves an alarm. Lost steps
don't show here: only a touch finds them.

Machine frame: mm, as the controller counts after homing (Grbl: 0 at the switches, negative
elsewhere). What is sent about a rotation A is from grblHAL's source: try it with an empty
turntable.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from instruments.clock import Clock
from instruments.errors import DeviceError, InstrumentError, LimitError, LinkError, ProtocolError
from instruments.link import Link
from instruments.stage.calls import Stage
from instruments.stage.connection import ANSWER_S, Dialogue
from instruments.stage.marlin import MarlinDialogue
from instruments.stage.protocol import HOME_AGAIN, Position, Status, axis_words
from instruments.stage.settings import DECLARABLE, StageIdentity, Target, check_within

Spoken = Literal["grbl", "marlin"]  # "grbl": Grbl, grblHAL or FluidNC, as it says itself

POLL_S = 0.2  # the firmware asks for no more than 5 queries a second
STOP_S = 10.0  # braking takes a second at most; more means that the stage doesn't react
MOVING = frozenset({"Run", "Jog", "Home"})
# states, or states with a substate
STILL = frozenset({"Idle", "Alarm", "Sleep", "Check", "Hold:0", "Door:0", "Door:1"})


TOLERANCE_MM = 0.01
SLACK_S = 10.0  # on top of twice what a move should take


class Move(NamedTuple):
    """A move under way: axis letter to mm, when it must be over, and whether it is a jog."""

    target_mm: Target
    deadline_s: float
    allowed_s: float
    jog: bool


class OwnStage(Stage):
    """The stage of ``axes`` "XY", "XYZ", "XYA" or "XYZA" at ``link``, for one thread. Every call
    may raise LinkError, ProtocolError, DeviceError and LimitError (refused before sending).
    """

    def __init__(
        self,
        link: Link,
        clock: Clock,
        axes: str = "XY",
        *,
        dialect: Spoken = "grbl",
    ) -> None:
        if axes not in DECLARABLE:
            hint = f"Declare {', '.join(DECLARABLE)}."
            raise LimitError(link.who, f"a stage has no axes {axes!r}", hint=hint)
        super().__init__(link.url, link.who, axes)
        self._link = link
        self._clock = clock
        match dialect:
            case "grbl":
                self._dialogue = Dialogue(link, clock)
            case "marlin":
                self._dialogue = MarlinDialogue(link, clock)
        self._homed_at: int | None = None  # the count of upsets when homing succeeded
        self._move: Move | None = None

    def connect(self) -> StageIdentity:
        """Identify the controller and read its settings. Raises DeviceError for unusable ones."""
        self._identified = self._dialogue.identify(self.axes)
        return self.identity

    @property
    def safe_state(self) -> str:
        """What it is in once ``safe`` has returned."""
        return self._dialogue.safe

    @property
    def homed(self) -> bool:
        """Whether it was homed, without an alarm, restart or broken link since."""
        return self._homed_at == self._dialogue.upsets

    def status(self) -> Status:
        """The controller's own report, now."""
        return self._dialogue.status()

    def position(self) -> NDArray[np.float64]:
        """Machine position, (3,) mm or (4,) with degrees of A. Meaningless unless ``homed``."""
        return np.array(list(self._here(self._dialogue.status()).values()), dtype=np.float64)

    def home(self) -> None:
        """Run to the switches and set the position: a minute or more. Raises DeviceError."""
        settings = self.settings
        if not settings.homing:
            what = "homing is switched off in the controller"
            raise LimitError(self.who, what, hint="Fit the switches and set $22=1.")
        if self._under_way:
            hint = "Call finish_move(), or stop() and recover()."
            raise LimitError(self.who, "a move is under way", asked="home", hint=hint)
        self._move = self._homed_at = None
        self._begin_moving()
        self._dialogue.home(self.axes, settings.homing_bound_s)
        upsets = self._dialogue.upsets
        self._check_idle("not idle after homing", HOME_AGAIN, asked="home")
        self._homed_at = upsets
        self.moves = False

    def _begin_move(self, target: Target, feed_mm_min: float | None) -> None:
        feed = self._feed(target, feed_mm_min)
        lines = self._dialogue.move_lines(target, feed)
        self._check_homed(lines[-1])
        check_within(target, self.settings, lines[-1], who=self.who)
        here = self._ready_at(lines[-1])
        way = {axis: target[axis] - here[axis] for axis in target}
        self._send(lines, target, way, feed)

    def _begin_jog(self, way: Target, feed_mm_min: float | None) -> None:
        feed = self._feed(way, feed_mm_min)
        line = f"jog {axis_words(way, feed, who=self.who)}"
        self._check_homed(line)
        here = self._ready_at(line)
        target = {axis: here[axis] + way[axis] for axis in way}
        check_within(target, self.settings, line, who=self.who)
        self._send(self._dialogue.jog_lines(way, target, feed), target, way, feed, jog=True)

    def cancel_jog(self) -> None:
        """End a jog early and wait for a stand; the position is kept. Nothing without a jog."""
        if (move := self._under_way) and move.jog:
            self._dialogue.cancel_jog()
            self._until_still()
            self._move = None
            self.moves = False

    def finish_move(self) -> None:
        """Wait for a move or jog. Raises DeviceError when held, too slow, or it ends elsewhere."""
        move = self._under_way
        if move is None and self._move is not None:
            what = "the move was interrupted: position lost"
            raise DeviceError(self.who, what, hint=HOME_AGAIN)
        if move is None:
            raise LimitError(self.who, "no move is under way", hint="Call begin_move().")
        status = self._until_over(move)
        self._move = None
        self.moves = False
        here, steps = self._here(status), self._by_letter(self.settings.steps_per_mm)
        for axis, value in move.target_mm.items():
            if not abs(here[axis] - value) <= max(TOLERANCE_MM, 0.5 / steps[axis] + 0.001):
                what, hint = (
                    f"the stage is not at its target, {axis} = {value:.3f}",
                    "Home it again.",
                )
                if move.jog:
                    hint = "The jog was ended early, by a hold at the panel or by brake(); its"
                    hint += " position is kept."
                else:
                    self._homed_at = None
                raise DeviceError(self.who, what, seen=f"{axis} = {here[axis]:.3f}", hint=hint)

    def brake(self) -> None:
        """Brake without waiting, from any thread. The owner's move ends in a DeviceError. Classic
        Grbl ignores it while homing; Marlin's costs the position. Raises LinkError. That a byte was
        sent says nothing of the stage: see ``stands``.
        """
        self._dialogue.brake()

    def stands(self) -> Status | None:
        """The report, read now and from any thread, of a stage that brakes and stands; None where a
        question of its owner is under way. Raises DeviceError if it doesn't, else as ``status``.
        """
        return self._dialogue.between(self._until_still)

    def stop(self) -> None:
        """Bring the stage to a stand from any state, wait, and read it back. Keeps the position
        (but Marlin's); resets only a controller that homes or doesn't answer. An alarm stays for
        the next call. Raises LinkError.
        """
        self._stop()
        self.moves = False

    def safe(self) -> None:
        """As ``stop``; where the link has broken, once more on a new one: its cable may be back."""
        try:
            self.stop()
        except LinkError as broken:
            if self._link.connected:
                raise
            try:
                self.reconnect()
            except InstrumentError:
                raise broken from None
            self.stop()

    def _stop(self) -> None:
        if self._dialogue.alarm is not None:  # then some answer nothing until a reset
            self._dialogue.check_link()
            return
        if self._dialogue.homing:  # then classic firmware obeys only a reset, Marlin only M112
            self._dialogue.abort()
            return
        try:
            self._identify_first()
            if (move := self._under_way) and not move.jog and self._dialogue.brakes_freely:
                self._dialogue.brake()
            self.cancel_jog()
            if self._dialogue.status().state in MOVING:
                self._dialogue.brake()
            self._until_still()
            if not self._dialogue.brakes_freely:
                self._move = None
        except InstrumentError as error:
            if self._dialogue.alarm is None:  # an alarm has cut the steps already
                try:
                    self._dialogue.abort()
                except InstrumentError as worse:
                    what = f"can't be stopped: {worse.what}"
                    raise LinkError(self.who, what, hint="Cut its power.") from error

    def reconnect(self) -> StageIdentity:
        """Open the link again and identify the controller; it has to be homed then. Raises
        LinkError, else as ``connect``.
        """
        self._move = None
        self._link.reopen()
        return self.connect()

    def recover(self) -> None:
        """Leave an alarm, a hold or a broken conversation by a restart. Homing is needed then."""
        self._move = None
        self._dialogue.restart()
        status = self._dialogue.status()
        if status.state not in ("Idle", "Alarm"):
            what, hint = "neither idle nor locked after a reset", "Switch it off and on."
            raise DeviceError(self.who, what, seen=status.name, hint=hint)
        self.moves = False

    def close(self) -> None:
        """Close the link. Does not stop the stage: call ``stop`` before."""
        self._link.close()

    @property
    def _under_way(self) -> Move | None:
        """The move that was begun and not finished. Whatever costs the position ends it."""
        return self._move if self.homed else None

    def _here(self, status: Status) -> Target:
        """The axes' places in machine coordinates. Raises ProtocolError for too few numbers."""
        numbers = self._dialogue.machine_mm(status)
        if len(numbers) < len(self._letters):
            what = f"{len(numbers)} numbers in a position, {len(self._letters)} are needed"
            hint = "A rotation A needs a controller with four axes."
            raise ProtocolError(self.who, what, hint=hint)
        return self._by_letter(numbers)

    def _by_letter(self, numbers: Position) -> Target:
        return dict(zip(self._letters, numbers, strict=False))

    def _feed(self, axes: Target, wanted_mm_min: float | None) -> float:
        """The feed to send: the wanted one, or what the slowest of the axes can."""
        rates = self._by_letter(self.settings.rate_mm_min)
        return min(rates[axis] for axis in axes) if wanted_mm_min is None else wanted_mm_min

    def _check_homed(self, line: str) -> None:
        if not self.homed:
            raise LimitError(self.who, "no move before homing", asked=line, hint=HOME_AGAIN)

    def _check_idle(self, what: str, hint: str, asked: str | None = None) -> Status:
        status = self._dialogue.status()
        if status.state != "Idle":
            raise DeviceError(self.who, what, asked=asked, seen=status.name, hint=hint)
        return status

    def _ready_at(self, line: str) -> Target:
        """Where the stage stands, ready to move. Raises LimitError unless it is."""
        status = self._dialogue.status()
        self._check_homed(line)  # the report may have shown an alarm or a restart
        if status.state != "Idle" or self._under_way:
            what = "a move is still under way, or the stage is not idle"
            hint = "Call finish_move(), or stop()."
            if status.state == "Hold":
                hint = HOME_AGAIN
            raise LimitError(self.who, what, asked=line, seen=status.name, hint=hint)
        return self._here(status)

    def _send(
        self, lines: list[str], target: Target, way: Target, feed: float, *, jog: bool = False
    ) -> None:
        seconds = 60 * math.hypot(*way.values()) / min(feed, *self.settings.rate_mm_min)
        allowed = SLACK_S + 2 * seconds
        self._begin_moving()
        self._dialogue.send(lines)
        self._move = Move(target, self._clock.now() + allowed, allowed, jog)

    def _until_over(self, move: Move) -> Status:
        """The report of an idle stage after the move. Raises DeviceError: hold, lock, deadline."""
        while (status := self._dialogue.status()).state in MOVING:
            if self._clock.now() > move.deadline_s:
                hint, seconds = "Is a feed override set, or does an axis stick?", move.allowed_s
                what, seen = "the move takes too long", status.name
                raise DeviceError(self.who, what, seen=seen, seconds=seconds, hint=hint)
            self._dialogue.wait(POLL_S)
        if status.state != "Idle":
            hint = f"See the controller's panel. {HOME_AGAIN}"
            raise DeviceError(self.who, "the move was interrupted", seen=status.name, hint=hint)
        # Idle may be reported before the move has begun: only the dwell behind it shows that it is
        # over.
        self._dialogue.finish(max(ANSWER_S, move.deadline_s - self._clock.now()))
        return self._check_idle("not idle after the move", "Was the stage held at its own panel?")

    def _identify_first(self) -> None:
        """Identify a controller that is not connected yet, as where an interlock trips first."""
        if self._identified is None:
            self._dialogue.identify_first(self.axes)

    def _until_still(self) -> Status:
        """The first report of a stage that brakes and stands. Raises DeviceError if it doesn't."""
        self._identify_first()
        deadline = self._clock.now() + STOP_S
        while not {(status := self._dialogue.status()).state, status.name} & STILL:
            if self._clock.now() > deadline:
                what, seen = "the stage does not stop", status.name
                raise DeviceError(self.who, what, seen=seen, seconds=STOP_S, hint="Cut its power.")
            self._dialogue.wait(POLL_S)
        return status
