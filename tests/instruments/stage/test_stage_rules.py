"""Driver against emulator in any order of calls and faults: what must never happen, whatever
happens before.

Two faults no controller can see: a stall and lost steps. Of those the driver knows nothing, and a
move is "finished" with the carriage elsewhere; what finds them is the next check touch of the arm.
Here the carriage's place is then no longer held against the driver, only its rails; homing heals
it, and everything counts again.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from instruments.errors import InstrumentError, LimitError, LinkError
from instruments.stage.driver import OwnStage
from instruments.stage.emulator.board import StageFault
from instruments.stage.emulator.grbl import GrblController
from instruments.stage.emulator.store import CLASSIC, FLUIDNC, GRBL_HAL, MARLIN, Firmware
from tests.examples import examples
from tests.instruments.stage.board import Bench

TRAVEL = (300.0, 275.0, 50.0, 360.0)
HOME = (-1.0, -1.0, -1.0, -1.0)
Place = tuple[float, float, float, float]
INSIDE = st.tuples(*(st.floats(-travel, 0) for travel in TRAVEL))
PLACES = st.one_of(INSIDE, INSIDE, st.tuples(*(st.floats(-travel - 10, 10) for travel in TRAVEL)))
WAYS = st.tuples(*(st.floats(-0.2 * travel, 0.2 * travel) for travel in TRAVEL))
UNSEEN = frozenset({StageFault.STALL, StageFault.LOST_STEP})
PLAY = (0.2, 0.1, 0.05, 0.5)
MOST_S = 4.0  # into a motion, or late
BOARDS = [
    *((CLASSIC, axes) for axes in ("XY", "XYZ")),
    *((GRBL_HAL, axes) for axes in ("XYZ", "XYZA", "XYA")),
    (FLUIDNC, "XYZA"),
    *((MARLIN, axes) for axes in ("XY", "XYZ")),
]


class StageRules(RuleBasedStateMachine):
    """Never a move before homing, never beyond the travel, never "finished" away from the target,
    never moving after ``stop``.
    """

    @initialize(board=st.sampled_from(BOARDS), play=st.booleans())
    def power_on(self, board: tuple[Firmware, str], play: bool) -> None:
        dialect, self.axes = board
        count = 4 if "A" in self.axes else 3
        self.play = PLAY if play else (0.0, 0.0, 0.0, 0.0)
        self.bench = Bench(dialect=dialect, axes=self.axes, play_mm=self.play[:count])
        self.clock, self.emulator = self.bench.clock, self.bench.emulator
        self.unseen, self.waiting, self.strikes_by_s = False, False, 0.0
        origin = (*self.emulator._origin_mm, 0.0)[:4]
        self.origin: Place = (origin[0], origin[1], origin[2], origin[3])
        self.from_low_end = dialect.from_low_end
        self.home_place = (0.0,) * 4 if self.from_low_end else HOME
        self.target: Place = self.home_place
        self.bench.homed()

    @property
    def stage(self) -> OwnStage:
        return self.bench.stage

    def machine(self, place: Place) -> Place:
        """Of a place on the rails, 0 at their high ends."""
        x, y, z, a = self.origin
        return place[0] + x, place[1] + y, place[2] + z, place[3] + a

    def more(self, place: Place) -> dict[str, float]:
        """The arguments beside X and Y for the axes that this stage has."""
        named = {"Z": ("z_mm", place[2]), "A": ("a_deg", place[3])}
        return dict(named[axis] for axis in self.axes[2:])

    def finished_at(self, place: Place) -> None:
        """A move to ``place`` is said to be finished: the count is there, and the carriage is, but
        for the play.
        """
        reported, there = self.stage.position(), self.emulator.position_mm()
        for axis in self.axes:
            at = "XYZA".index(axis)
            assert reported[at] == pytest.approx(place[at], abs=0.01)
            if not self.unseen:
                off = (there[at] - place[at]) * (-1.0 if self.from_low_end else 1.0)
                assert -self.play[at] - 0.01 <= off <= 0.01

    def look_for_strikes(self) -> bool:
        """Whether what nobody sees may still strike: it waits for a motion, or for its time, of
        MOST_S at most, in one that has begun.
        """
        waiting = bool(UNSEEN & self.emulator._faults.keys())
        if self.waiting and not waiting:
            self.strikes_by_s = self.clock.now() + MOST_S
        self.waiting = waiting
        return waiting or self.clock.now() <= self.strikes_by_s

    @rule()
    def home(self) -> None:
        try:
            self.stage.home()
        except InstrumentError:
            return
        assert self.stage.homed
        there = self.emulator.position_mm()
        axes = ["XYZA".index(axis) for axis in self.axes]
        at_home = bool(there[axes] == pytest.approx([self.home_place[axis] for axis in axes]))
        assert at_home or self.unseen  # a stall may strike while homing too
        self.unseen = not at_home or self.look_for_strikes()

    @rule(place=PLACES)
    def move(self, place: Place) -> None:
        homed, place = self.stage.homed, self.machine(place)
        try:
            self.stage.move_to(*place[:2], **self.more(place))
        except InstrumentError:
            return
        assert homed
        self.finished_at(place)

    @rule(place=PLACES)
    def begin(self, place: Place) -> None:
        homed, place = self.stage.homed, self.machine(place)
        try:
            self.stage.begin_move(*place[:2], **self.more(place))
        except InstrumentError:
            return
        assert homed
        self.target = place

    @rule(way=WAYS)
    def jog(self, way: Place) -> None:
        homed = self.stage.homed
        try:
            before = self.stage.position()
            self.stage.jog(x_mm=way[0], y_mm=way[1], **self.more(way))
        except InstrumentError:
            return
        assert homed
        there = [*(at + by for at, by in zip(before, way, strict=False)), 0.0]
        self.target = (there[0], there[1], there[2], there[3])

    @rule()
    def finish(self) -> None:
        try:
            self.stage.finish_move()
        except InstrumentError:
            return
        self.finished_at(self.target)

    @rule(seconds=st.floats(0.01, 3))
    def let_time_pass(self, seconds: float) -> None:
        self.clock.sleep(seconds)

    @rule(call=st.sampled_from([OwnStage.cancel_jog, OwnStage.brake]))
    def only_call(self, call: Callable[[OwnStage], None]) -> None:
        with suppress(InstrumentError):
            call(self.stage)

    @rule()
    def stop(self) -> None:
        start = self.clock.now()
        try:
            self.stage.stop()
        except LinkError:
            return
        finally:
            assert self.clock.now() - start < 15
        self.stands()

    @rule(place=INSIDE, seconds=st.floats(0.01, 1))
    def stop_on_the_way(self, place: Place, seconds: float) -> None:
        self.begin(place)
        self.clock.sleep(seconds)
        self.stop()

    def stands(self) -> None:
        before = self.emulator.position_mm()
        self.clock.sleep(1.0)
        assert self.emulator.position_mm() == pytest.approx(before, abs=1e-9)

    @rule()
    def recover(self) -> None:
        try:
            self.stage.recover()
        except InstrumentError:
            return
        assert not self.stage.homed
        with pytest.raises(LimitError, match="no move before homing"):
            self.stage.move_to(-5, -5)
        with pytest.raises(LimitError, match="no move before homing"):
            self.stage.jog(x_mm=-1)

    @rule(
        fault=st.sampled_from(list(StageFault)),
        after=st.floats(0.01, MOST_S),
        lost=st.floats(0.1, 20),
    )
    def go_wrong(self, fault: StageFault, after: float, lost: float) -> None:
        self.emulator.inject(fault, after, lost_mm=lost)
        self.unseen = self.unseen or fault in UNSEEN
        self.waiting = self.waiting or fault in UNSEEN

    @rule()
    def repair_and_plug_in_again(self) -> None:
        for fault in StageFault:
            self.emulator.cure(fault)
        self.bench.again().stage.connect()
        assert not self.stage.homed

    @invariant()
    def within_the_travel(self) -> None:
        """The carriage itself, whatever the controller counts; and all that was ever planned."""
        if hasattr(self, "bench"):
            board, places = self.emulator._controller, self.emulator.position_mm()
            planned = board.target_mm()
            for axis, (place, target) in enumerate(zip(places, planned, strict=True)):
                low, high = self.origin[axis] - TRAVEL[axis] - 1e-6, self.origin[axis] + 1e-6
                assert low <= place <= high
                # homing looks for a switch farther than the travel, and may find none; these
                # home an axis after the other
                one_by_one = isinstance(board, GrblController)
                if axis in board.homed if one_by_one else board.homed:
                    assert low <= target <= high

    @invariant()
    def strikes_are_looked_for(self) -> None:
        if hasattr(self, "bench"):
            self.look_for_strikes()

    @invariant()
    def no_move_before_homing(self) -> None:
        """As the board knows it, which it does not tell the driver (the classic one never does)."""
        if hasattr(self, "bench"):
            board = self.emulator._controller
            assert board.homed or board.carriage.homing or not board.moving

    def teardown(self) -> None:
        if hasattr(self, "bench"):
            self.bench.close()


StageRules.TestCase.settings = settings(
    max_examples=examples(20),
    stateful_step_count=30,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
)
TestStageRules = pytest.mark.slow(StageRules.TestCase)
