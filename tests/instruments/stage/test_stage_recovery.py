"""From each alarm there is one way out, and somebody has to ask for it; and the whole driver on a
pseudo-terminal in real time.
"""

from __future__ import annotations

import contextlib
import sys
import threading

import pytest

from instruments.clock import RealClock
from instruments.errors import DeviceError, LimitError
from instruments.link import Link
from instruments.stage.alarm_texts import ALARMS, HAL_ALARMS
from instruments.stage.driver import Stage
from instruments.stage.emulator import CLASSIC, GRBL_HAL, Dialect, Fault, StageEmulator
from instruments.stage.emulator.gcode import Mode
from tests.instruments.stage.stage_bench import Bench

FAST = (
    {24: 6000, 25: 60000, 26: 1}
    | {110 + axis: 60000 for axis in range(3)}
    | {120 + axis: 20000 for axis in range(3)}
)


@pytest.mark.parametrize("critical", [False, True], ids=["heard", "deaf"])
@pytest.mark.parametrize("code", [*ALARMS, *HAL_ALARMS.keys() - ALARMS.keys()])
def test_recovery_from_each_alarm_is_explicit(bench: Bench, code: int, critical: bool) -> None:
    stage = bench.homed()
    controller = bench.emulator._controller

    def strike() -> None:
        controller.alarm(code, critical=critical)
        bench.emulator._settle()

    bench.clock.call_at(bench.clock.now() + 1.0, strike)
    with pytest.raises(DeviceError, match=f"alarm {code}: .*home"):
        stage.move_to(-250, -250)
    for refused in (stage.home, lambda: stage.move_to(-5, -5), lambda: stage.jog(x_mm=-1)):
        with pytest.raises((DeviceError, LimitError), match=f"alarm {code}|no move before homing"):
            refused()
    assert controller.mode is Mode.LOCKED or critical, "nothing unlocked it behind our back"
    stage.recover()
    with pytest.raises(LimitError, match="no move before homing"):
        stage.move_to(-5, -5)
    stage.home()
    stage.move_to(-5, -5)
    assert bench.emulator.position_mm() == pytest.approx([-5, -5, -1])


def test_every_alarm_of_grblhal_has_a_sentence_and_advice() -> None:
    for meaning in HAL_ALARMS.values():
        assert meaning.what
        assert meaning.do.endswith("recover() and home().") or meaning.do.endswith("then home().")


def test_lost_power_asks_for_homing_whenever_it_comes(bench: Bench) -> None:
    stage = bench.homed()
    stage.move_to(-50, -50)
    bench.emulator._controller.power_up()
    bench.emulator._settle()
    with pytest.raises(DeviceError, match="restarted by itself: position lost"):
        stage.move_to(-60, -60)
    with pytest.raises(LimitError, match="no move before homing"):
        stage.move_to(-60, -60)
    assert bench.emulator.position_mm() == pytest.approx([-50, -50, -1])
    stage.home()
    stage.move_to(-60, -60)


def test_a_board_that_sleeps_has_to_be_homed(bench: Bench) -> None:
    stage = bench.homed()
    stage._talk.command("$SLP")
    with pytest.raises(LimitError, match="no move before homing"):
        stage.move_to(-60, -60)
    stage.recover()
    stage.home()
    stage.move_to(-60, -60)


def test_a_stall_is_finished_for_the_controller_and_elsewhere_for_the_world(bench: Bench) -> None:
    """What no driver can find: it is the arm's check touches that do."""
    stage = bench.homed()
    bench.emulator.inject(Fault.STALL, 0.5)
    stage.move_to(-100, -1)
    assert stage.position() == pytest.approx([-100, -1, -1])
    assert bench.emulator.position_mm()[0] > -50


@pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals: POSIX only")
@pytest.mark.parametrize("dialect", [CLASSIC, GRBL_HAL], ids=["grbl", "grblHAL"])
def test_the_driver_works_on_a_pseudo_terminal(dialect: Dialect) -> None:
    from instruments.pty_listener import PtyListener

    with contextlib.closing(RealClock()) as clock:
        emulator = StageEmulator(clock, dialect=dialect, settings=FAST)
        with (
            contextlib.closing(
                PtyListener(emulator, clock, lock=threading.RLock(), name="stage", baud=115200)
            ) as listener,
            contextlib.closing(Stage(Link(listener.url, clock, who="stage"), clock)) as stage,
        ):
            assert stage.connect().dialect == dialect.name
            stage.home()
            stage.move_to(-20, -30)
            assert emulator.position_mm() == pytest.approx([-20, -30, -1])
            stage.begin_move(-290, -30, feed_mm_min=6000)
            stage.stop()
            assert stage.status().name == "Hold:0"
            stage.resume()
            stage.finish_move()
