"""Driver against emulator in any order of calls and faults: what must never happen, whatever happens before."""

from __future__ import annotations

import threading

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from instruments.clock import VirtualClock
from instruments.errors import InstrumentError, LimitError, LinkError
from instruments.link import Link
from instruments.listener import Listener
from instruments.stage.driver import Stage
from instruments.stage.emulator import CLASSIC, GRBL_HAL, Dialect, Fault, StageEmulator

INSIDE = st.tuples(st.floats(-300, 0), st.floats(-275, 0))
PLACES = st.one_of(INSIDE, INSIDE, st.tuples(st.floats(-310, 10), st.floats(-285, 10)))
FAULTS = (
    Fault.LOST_OK,
    Fault.LATE_OK,
    Fault.GARBAGE,
    Fault.LIMIT_HIT,
    Fault.DISCONNECT,
    Fault.RESTART,
    Fault.NO_SWITCH,
    Fault.STUCK_SWITCH,
    Fault.SILENT,
)


class StageRules(RuleBasedStateMachine):
    """Never a move before homing, never beyond the travel, never "finished" away from the target, never moving after ``stop``."""

    @initialize(dialect=st.sampled_from([CLASSIC, GRBL_HAL]))
    def power_on(self, dialect: Dialect) -> None:
        self.clock = VirtualClock()
        self.emulator = StageEmulator(self.clock, dialect=dialect)
        self.listener = Listener(self.emulator, self.clock, lock=threading.RLock(), name="stage")
        self.plug_in()
        self.target = (-1.0, -1.0)
        self.stage.home()

    def plug_in(self) -> None:
        self.stage = Stage(Link(self.listener.url, self.clock, who="stage"), self.clock)
        self.stage.connect()

    def at(self, place: tuple[float, float]) -> bool:
        return bool(self.emulator.position_mm()[:2] == pytest.approx(place, abs=0.005))

    @rule()
    def home(self) -> None:
        try:
            self.stage.home()
        except InstrumentError:
            return
        assert self.stage.homed
        assert self.emulator.position_mm() == pytest.approx([-1, -1, -1])

    @rule(place=PLACES)
    def move(self, place: tuple[float, float]) -> None:
        homed = self.stage.homed
        try:
            self.stage.move_to(*place)
        except InstrumentError:
            return
        assert homed
        assert self.at(place)

    @rule(place=PLACES)
    def begin_a_move(self, place: tuple[float, float]) -> None:
        self.begin(place)

    def begin(self, place: tuple[float, float]) -> None:
        homed = self.stage.homed
        try:
            self.stage.begin_move(*place)
        except InstrumentError:
            return
        assert homed
        self.target = place

    @rule()
    def finish(self) -> None:
        try:
            self.stage.finish_move()
        except InstrumentError:
            return
        assert self.at(self.target)

    @rule(seconds=st.floats(0.01, 3))
    def let_time_pass(self, seconds: float) -> None:
        self.clock.sleep(seconds)

    @rule()
    def hold(self) -> None:
        try:
            self.stage.hold()
        except InstrumentError:
            return
        self.stands()

    @rule()
    def resume(self) -> None:
        try:
            self.stage.resume()
        except InstrumentError:
            return

    @rule()
    def stop_now(self) -> None:
        self.stop()

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
    def stop_on_the_way(self, place: tuple[float, float], seconds: float) -> None:
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

    @rule(fault=st.sampled_from(FAULTS), after=st.floats(0.01, 4))
    def go_wrong(self, fault: Fault, after: float) -> None:
        self.emulator.inject(fault, after)

    @rule()
    def repair_and_plug_in_again(self) -> None:
        for fault in FAULTS:
            self.emulator.cure(fault)
        self.stage.close()
        self.plug_in()
        assert not self.stage.homed

    @invariant()
    def within_the_travel(self) -> None:
        if hasattr(self, "emulator"):
            x, y, z = self.emulator.position_mm()
            assert -300 - 1e-6 <= x <= 1e-6
            assert -275 - 1e-6 <= y <= 1e-6
            assert -50 - 1e-6 <= z <= 1e-6

    def teardown(self) -> None:
        if hasattr(self, "stage"):
            self.stage.close()
            self.listener.close()


StageRules.TestCase.settings = settings(
    max_examples=40, stateful_step_count=30, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much]
)
TestStageRules = StageRules.TestCase
