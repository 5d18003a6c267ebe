"""Driver against emulator through faults in any order: never a wrong position, and back in session when the arm is."""

from __future__ import annotations

import contextlib
import threading

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from instruments.clock import VirtualClock
from instruments.errors import InstrumentError, LimitError, LinkError
from instruments.link import Link
from instruments.listener import Listener
from instruments.microscribe.driver import MicroScribe
from instruments.microscribe.emulator import ArmEmulator
from instruments.microscribe.faults import Fault
from instruments.microscribe.kinematics import Floats
from instruments.microscribe.unit import UNIT_40937

UP = np.array([0.0, 0.0, 1.0])
PEG = UNIT_40937.geometry().forward(UNIT_40937.home)[0][0]
POINTS = [None, np.array([-180.0, 240.0, 130.0]), np.array([-120.0, 200.0, 140.0])]
PASSING = [Fault.FLIPPED_BIT, Fault.BIT_7, Fault.LOST_BYTE, Fault.GARBAGE, Fault.OLD_SESSION, Fault.SURPLUS_ECHOES]


class ArmInAnyOrder(RuleBasedStateMachine):
    """An honest operator, a bad cable, and power that comes and goes."""

    def __init__(self) -> None:
        super().__init__()
        self.point: Floats | None = None
        self.well_homed = True
        self.powered = True
        self.clock = VirtualClock()
        self.arm = ArmEmulator(self, self.clock, seed=3)
        self.listener = Listener(self.arm, self.clock, lock=threading.RLock(), name="arm")
        self.driver = self.plugged_in()

    def arm_target(self) -> tuple[Floats, Floats] | None:
        return None if self.point is None else (self.point, UP)

    def plugged_in(self) -> MicroScribe:
        return MicroScribe(Link(self.listener.url, self.clock, who="arm"), self.clock)

    @rule(point=st.sampled_from(POINTS))
    def hold(self, point: Floats | None) -> None:
        self.point = point

    @rule(fault=st.sampled_from(PASSING), times=st.integers(1, 5))
    def trouble(self, fault: Fault, times: int) -> None:
        self.arm.faults.inject(fault, times if fault is not Fault.FLIPPED_BIT else 1)

    @rule(questions=st.integers(1, 4))
    def deafness(self, questions: int) -> None:
        self.arm.faults.inject(Fault.SILENT, questions)

    @rule()
    def power_off(self) -> None:
        self.arm.power_off()
        self.powered = False

    @rule()
    def power_on(self) -> None:
        if not self.powered:
            self.arm.power_on()
            self.powered, self.well_homed = True, self.point is None

    @rule()
    def replug(self) -> None:
        self.driver.close()
        self.driver = self.plugged_in()

    @rule()
    def sign_on(self) -> None:
        with contextlib.suppress(InstrumentError):
            self.driver.sign_on()
            assert not self.driver.homed

    @precondition(lambda self: self.well_homed)
    @rule()
    def confirm_homed(self) -> None:
        with contextlib.suppress(LimitError):
            self.driver.confirm_homed()

    @precondition(lambda self: self.point is None)
    @rule()
    def home(self) -> None:
        with contextlib.suppress(InstrumentError):
            self.driver.home()
            self.well_homed = True

    @rule()
    def read(self) -> None:
        homed = self.driver.homed
        try:
            reading = self.driver.read()
        except LinkError:
            assert not self.driver.homed
        except InstrumentError:
            return
        else:
            assert homed
            assert self.powered
            assert np.linalg.norm(reading.tip_mm - (PEG if self.point is None else self.point)) < 1.0

    @rule()
    def recover(self) -> None:
        if not self.powered:
            self.power_on()
        for fault in Fault:
            self.arm.faults.clear(fault)
        self.point = None
        self.driver.sign_on()
        self.driver.home()
        self.well_homed = True
        assert self.driver.poll().counts == UNIT_40937.home

    @invariant()
    def no_byte_that_writes(self) -> None:
        assert self.arm.eeprom_attempts == 0

    def teardown(self) -> None:
        self.driver.close()
        self.listener.close()


TestArmInAnyOrder = ArmInAnyOrder.TestCase
TestArmInAnyOrder.settings = settings(max_examples=40, stateful_step_count=25, deadline=None)
