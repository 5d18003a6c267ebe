"""A stage of another package as the bench's own: travel is checked before, the place read back
behind every move, and a stop that doesn't stop it is an error.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from instruments.clock import Clock
from instruments.drivers.border import Plugged, PluginBoundary
from instruments.drivers.entry_points import Plugin, one_line
from instruments.drivers.plugin import StageDriver, StageState
from instruments.errors import DeviceError, InstrumentError, LimitError
from instruments.stage.calls import Stage
from instruments.stage.protocol import AXES, Status
from instruments.stage.settings import (
    DECLARABLE,
    StageIdentity,
    StageSettings,
    Target,
    check_within,
)

POLL_S = 0.2
STOP_S, HOMING_S, SLACK_S = 10.0, 300.0, 10.0
TOLERANCE_MM = 0.02


class _Move(NamedTuple):
    target: Target
    deadline_s: float
    jog: bool


class PluggedStage(Plugged, Stage):
    """As `instruments.stage.driver.OwnStage`."""

    safe_state = "at a stand, as it reads back itself"

    def __init__(self, plugged: Plugin, clock: Clock, axes: str) -> None:
        super().__init__(plugged.url, f"stage {plugged.name}", axes)
        self._clock = clock
        self._border: PluginBoundary[StageDriver] = PluginBoundary(plugged, self.who, clock)
        self._homed_at = 0  # of the opening
        self._move: _Move | None = None

    def connect(self) -> StageIdentity:
        """Ask who it is and how far it goes. Raises LimitError for other axes than the rig's."""
        border = self._border
        who = border.call("identity", lambda stage: border.texts(stage.identity))
        axes = border.call("axes", lambda stage: str(stage.axes))
        if axes not in DECLARABLE:
            raise border.broken(f"its axes are none of {', '.join(DECLARABLE)}", axes)
        if not set(self.axes) <= set(axes):
            what = f"it has the axes {axes}, the rig file declares {self.axes}"
            raise LimitError(self.who, what, hint="Correct axes under [stage].")
        feed = border.call("feed", lambda stage: border.number(stage.feed_mm_min, "feed"))
        if feed <= 0.0:
            raise border.broken("its feed is not above 0 mm/min", feed)
        lows, highs = border.call("limits", lambda stage: self._ends(stage.limits))
        version, plugged = ", ".join(f"{key} {value}" for key, value in who.items()), border.plugged
        identity = StageIdentity(plugged.name, version, plugged.source, "")
        settings = StageSettings(
            travel_mm=tuple(np.subtract(highs, lows).tolist()),
            rate_mm_min=(feed,) * len(self._letters),
            accel_mm_s2=tuple(math.inf for _ in self._letters),
            steps_per_mm=tuple(1000.0 for _ in self._letters),
            homing_seek_mm_min=feed,
            homing_feed_mm_min=feed,
            low_mm=lows,
        )
        self._identified = identity, settings
        return identity

    def _ends(self, limits: Mapping[str, tuple[float, float]]) -> tuple[tuple[float, ...], ...]:
        """Lowest and highest places. Raises ProtocolError."""
        spans = [tuple(limits.get(a, () if a in self.axes else (0.0, 0.0))) for a in self._letters]
        if not all(len(span) == 2 and -math.inf < span[0] <= span[1] < math.inf for span in spans):
            raise self._border.broken("its limits are no pairs of numbers by axis", limits)
        lows, highs = zip(*((float(low), float(high)) for low, high in spans), strict=True)
        return lows, highs

    @property
    def homed(self) -> bool:
        """Whether it was homed, without a broken link or a fault since."""
        return bool(self._homed_at) and self._homed_at == self._border.link

    def status(self) -> Status:
        """Its own report, now. Raises DeviceError for a fault."""
        state = self._state()
        name = "Run" if state.moving else "Idle" if state.homed else "Alarm"
        return Status(name, None, tuple(self._places(state).values()), None, None, {})

    def position(self) -> NDArray[np.float64]:
        """(3,) mm or (4,) with degrees of A; not-a-number for an axis that it hasn't."""
        return np.array(list(self._places(self._state()).values()), dtype=np.float64)

    def home(self) -> None:
        """Home all axes and wait. Raises DeviceError where it isn't homed then."""
        _ = self.settings
        self._move, self._homed_at = None, 0
        self._begin_moving()
        self._border.call("home", lambda stage: stage.home(), HOMING_S)
        state = self._until_still(self._clock.now() + HOMING_S, "homing takes too long")
        if not state.homed:
            raise DeviceError(self.who, "it is not homed after homing", hint=self._border.look)
        self._homed_at, self.moves = self._border.link, False

    def cancel_jog(self) -> None:
        """End a jog early and wait for a stand. Nothing without a jog."""
        if self._move and self._move.jog:
            self.stop()

    def finish_move(self) -> None:
        """Wait for a move or jog. Raises DeviceError when too slow, or it ends elsewhere."""
        move = self._move
        if move is None:
            raise LimitError(self.who, "no move is under way", hint="Call begin_move().")
        state = self._until_still(move.deadline_s, "the move takes too long")
        self._move, self.moves = None, False
        if not self.homed:
            what = "the move was interrupted: it is not homed any more"
            raise DeviceError(self.who, what, hint=f"Home it again. {self._border.look}")
        here = self._places(state)
        for axis, wanted in move.target.items():
            if not abs(here[axis] - wanted) <= TOLERANCE_MM:
                what = f"the stage is not at its target, {axis} = {wanted:.3f}"
                seen, hint = f"{axis} = {here[axis]:.3f}", self._border.look
                raise DeviceError(self.who, what, seen=seen, hint=hint)

    def brake(self) -> None:
        """Stop without waiting, from any thread."""
        self._border.aside("stop", lambda stage: stage.stop())

    def stands(self) -> Status | None:
        """Its report once it stands, from any thread. Raises DeviceError if it doesn't."""
        self._until_still(self._clock.now() + STOP_S, "the stage does not stop", aside=True)
        return Status("Idle", None, (), None, None, {})

    def stop(self) -> None:
        """Bring it to a stand from any state, and read that back. Raises InstrumentError where it
        goes on, or doesn't answer.
        """
        try:
            self.brake()
            self.stands()
        except InstrumentError:
            self._border.forget()  # another link may answer
            self.brake()
            self.stands()
        self._move, self.moves = None, False

    def reconnect(self) -> StageIdentity:
        """Open it again; it has to be homed then."""
        self._move, self._homed_at = None, 0
        self._border.forget()
        return self.connect()

    def recover(self) -> None:
        """As `reconnect`, of a stage that stands."""
        self.reconnect()
        self.stands()
        self.moves = False

    def _begin_move(self, target: Target, feed_mm_min: float | None) -> None:
        self._go(target, feed_mm_min, jog=False)

    def _begin_jog(self, way: Target, feed_mm_min: float | None) -> None:
        here = self._places(self._state())
        self._go({axis: here[axis] + by for axis, by in way.items()}, feed_mm_min, jog=True)

    def _go(self, target: Target, feed_mm_min: float | None, *, jog: bool) -> None:
        asked = ", ".join(f"{axis} {value:g}" for axis, value in target.items())
        check_within(target, self.settings, asked, who=self.who)
        state = self._state()
        if not self.homed:  # as it says now
            raise LimitError(self.who, "no move before homing", asked=asked, hint="Home it first.")
        if state.moving or self._move:
            what, hint = "a move is still under way", "Call finish_move(), or stop()."
            raise LimitError(self.who, what, asked=asked, hint=hint)
        here, feed = self._places(state), min(feed_mm_min or math.inf, *self.settings.rate_mm_min)
        way = math.hypot(*(value - here[axis] for axis, value in target.items()))
        allowed_s = SLACK_S + 2 * 60 * way / feed
        self._begin_moving()
        self._border.call("move", lambda stage: stage.move(dict(target), feed), allowed_s)
        self._move = _Move(target, self._clock.now() + allowed_s, jog)

    def _until_still(self, deadline_s: float, late: str, *, aside: bool = False) -> StageState:
        while (state := self._state(aside=aside)).moving:
            hint = f"Cut its power. {self._border.look}"
            if self._clock.now() > deadline_s:
                raise DeviceError(self.who, late, seen="moving", hint=hint)
            self._clock.sleep(POLL_S)
        return state

    def _places(self, state: StageState) -> Target:
        return {axis: state.place[axis] for axis in self._letters}

    def _state(self, *, aside: bool = False) -> StageState:
        ask = self._border.aside if aside else self._border.call
        state = ask("read", lambda stage: self._checked(stage.read()))
        if state.fault or not state.homed:
            self._homed_at = 0
        if state.fault and not aside:
            hint = f"Cure it; a run then homes it. {self._border.look}"
            raise DeviceError(self.who, state.fault, hint=hint)
        return state

    def _checked(self, given: object) -> StageState:
        border = self._border
        if not isinstance(given, StageState):
            raise border.broken("its state is no StageState", given)
        if not isinstance(given.place, Mapping):
            raise border.broken("its place is no mapping by axis", given.place)
        moving, homed = border.flag(given.moving, "moving"), border.flag(given.homed, "homed")
        place = {axis: given.place.get(axis, None if axis in self.axes else 0.0) for axis in AXES}
        numbers = {axis: border.number(at, f"place of axis {axis}") for axis, at in place.items()}
        return StageState(numbers, moving, homed, one_line(str(given.fault or "")))
