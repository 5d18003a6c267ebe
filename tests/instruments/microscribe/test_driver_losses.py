"""Power that goes, cables that are pulled: noticed, told, and brought back without a position that
could be wrong.
"""

from __future__ import annotations

import numpy as np
import pytest

from instruments.errors import LinkError
from instruments.microscribe.emulator import ArmEmulator
from instruments.microscribe.errors import (
    AnotherArmError,
    InterfaceBoxError,
    NoSessionError,
    NotHomedError,
    SilentArmError,
)
from instruments.microscribe.protocol import State
from instruments.microscribe.unit import UNIT_40937
from tests.instruments.microscribe.driver_rig import POINT, Rig, renamed


def test_power_loss_is_noticed_and_costs_the_homing(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.hand.point = POINT
    driver.read()
    start = rig.clock.now()
    rig.arm.power_cycle()
    with pytest.raises(SilentArmError, match=r"fallen silent.*lost its power.*on its peg"):
        driver.read()
    assert rig.clock.now() - start < 1.0
    assert not driver.homed
    with pytest.raises(NoSessionError, match="no session"):
        driver.read()
    driver.sign_on()
    with pytest.raises(NotHomedError, match="the arm fell silent: it may have lost its power"):
        driver.read()


def test_recovering_waits_for_the_power(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.arm.power_off()
    with pytest.raises(SilentArmError):
        driver.poll()
    with rig.lock:
        rig.clock.call_at(rig.clock.now() + 8.0, rig.arm.power_on)
    back = rig.clock.now() + 8.0
    assert driver.recover(30.0) == driver.identity
    assert rig.clock.now() - back < 2.0
    assert driver.poll().counts == UNIT_40937.home
    assert not driver.homed
    driver.confirm_homed()
    driver.read()


def test_recovering_gives_up_in_time_and_can_be_asked_again(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.arm.power_off()
    with pytest.raises(SilentArmError):
        driver.poll()
    start = rig.clock.now()
    with pytest.raises(SilentArmError, match="nothing answers the sign-on"):
        driver.recover(5.0)
    assert rig.clock.now() - start == pytest.approx(5.0, abs=0.5)
    rig.arm.power_on()
    driver.recover(5.0)


def test_a_cable_that_is_pulled_is_noticed(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.unplug()
    with pytest.raises(LinkError, match="the link broke"):
        driver.poll()
    with pytest.raises(NoSessionError, match="no session"):
        driver.read()
    with pytest.raises(LinkError, match="nothing takes the connection"):
        driver.sign_on()


def test_plugged_in_again_it_is_back_within_two_seconds_and_homing_is_demanded(rig: Rig) -> None:
    driver = rig.signed_on()
    port = rig.unplug()
    with pytest.raises(LinkError):
        driver.poll()
    back = rig.clock.now() + 10.0
    rig.clock.call_at(back, lambda: rig.plug_in(port))
    driver.recover(60.0)
    assert 0.0 <= rig.clock.now() - back < 2.0
    assert rig.arm.state is State.SESSION
    with pytest.raises(
        NotHomedError, match="the link broke, and nobody can tell whether the arm kept its power"
    ):
        driver.read()
    driver.confirm_homed()
    driver.read()


def test_sign_on_opens_a_broken_link_again(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.ear.hosts[-1].hang_up()
    with pytest.raises(LinkError):
        driver.poll()
    driver.sign_on()
    assert driver.poll().counts == UNIT_40937.home


def test_nothing_read_before_counts_as_read_after(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.hand.point = POINT
    rig.ear.late_s = 0.01
    # a question is on its way: its answer is from the point
    rig.clock.call_at(rig.clock.now() + 0.005, rig.ear.hosts[-1].hang_up)
    with pytest.raises(LinkError):
        driver.read()
    rig.hand.point = None
    driver.recover()
    driver.confirm_homed()
    assert driver.poll().counts == UNIT_40937.home
    assert np.hypot(*driver.read().tip_mm[:2]) == pytest.approx(75, abs=0.1)


def test_another_arm_on_the_port_is_refused(rig: Rig) -> None:
    driver = rig.signed_on()
    port = rig.unplug()
    with pytest.raises(LinkError):
        driver.poll()
    rig.plug_in(port, ArmEmulator(rig.hand, rig.clock, unit=renamed(serial_number="51234"), seed=1))
    for _ in range(2):
        with pytest.raises(AnotherArmError, match="arm 40937 was lost, and arm 51234 answers"):
            driver.recover()
        assert not driver.live
    assert driver.sign_on().serial_number == "51234"


def test_what_is_refused_for_good_is_not_tried_again(rig: Rig) -> None:
    driver = rig.signed_on()
    rig.arm.power_cycle()
    with pytest.raises(SilentArmError):
        driver.poll()
    rig.arm.faults.inject("IBOX")
    start = rig.clock.now()
    with pytest.raises(InterfaceBoxError):
        driver.recover(60.0)
    assert rig.clock.now() - start < 2.0


def test_safe_ends_the_session_once(rig: Rig) -> None:
    driver = rig.signed_on()
    assert not driver.moves
    driver.safe()
    assert rig.arm.state is State.FINDING_BAUD
    heard = rig.ear.heard
    driver.safe()
    assert rig.ear.heard == heard
    assert heard.endswith(b"\xc5")
    with pytest.raises(NoSessionError, match="no session"):
        driver.poll()
    driver.sign_on()


def test_close_ends_the_session_and_may_be_called_twice(rig: Rig) -> None:
    driver = rig.signed_on()
    driver.close()
    driver.close()
    assert rig.arm.state is State.FINDING_BAUD
