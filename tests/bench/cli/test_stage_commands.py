"""`stage status|home|move|jog|recover` on an emulated stage of another thread, with good and bad
input.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from dataclasses import dataclass

import pytest

from bench.rig.alone import step
from instruments.clock import RealClock
from instruments.listener import Listener
from instruments.stage.emulator import GRBL_HAL, MARLIN, Fault, StageEmulator
from tests.bench.commands import Said, teatbench

FAST = (
    {24: 6000, 25: 60000, 26: 1}
    | {110 + axis: 60000 for axis in range(3)}
    | {120 + axis: 20000 for axis in range(3)}
)


@dataclass
class Served:
    emulator: StageEmulator
    at: list[str]


@pytest.fixture
def stage() -> Iterator[Served]:
    """``at`` are the arguments that lead to it. Its axes are quick, so that real time is short."""
    clock = RealClock()
    emulator = StageEmulator(
        clock, dialect=GRBL_HAL, axes=4, settings=FAST | {113: 60000, 123: 20000}
    )
    listener = Listener(emulator, clock, lock=threading.RLock(), name="stage")
    try:
        yield Served(emulator, ["--port", listener.url, "--axes", "XYZA"])
    finally:
        listener.close()
        clock.close()


@pytest.mark.slow
def test_status_says_everything_with_units(stage: Served, said: Said) -> None:
    text = json.loads(said(0, "stage status {} --json", stage.at).out)
    known = {"dialect": "grblHAL", "version": "1.1f", "state": "Alarm", "homed": False}
    assert text | known == text
    assert text["travel_x_mm"] == [-300.0, 0.0]
    assert text["travel_a_deg"] == [-360.0, 0.0]
    assert {"x_mm", "y_mm", "z_mm", "a_deg", "soft_limits", "hard_limits", "homing"} <= text.keys()
    assert [
        line.split(": ")[0] for line in said(0, "stage status {}", stage.at).out.strip().split("\n")
    ] == list(text)


@pytest.mark.slow
def test_a_marlin_by_its_dialect(said: Said) -> None:
    clock = RealClock()
    emulator = StageEmulator(clock, dialect=MARLIN, settings=FAST)
    listener = Listener(emulator, clock, lock=threading.RLock(), name="stage")
    try:
        at = ["--port", listener.url, "--dialect", "marlin"]
        assert "moved: X 20.000 mm, Y 30.500 mm" in said(0, "stage move {} 20 30.5", at).out
    finally:
        listener.close()
        clock.close()
    assert "go with --port" in said(2, "stage home --rig emulated --dialect marlin").err


@pytest.mark.slow
def test_home_move_and_jog(stage: Served, said: Said) -> None:
    expected = "homed: X -1.000 mm, Y -1.000 mm, Z -1.000 mm, A -1.000 deg\n"
    assert said(0, "stage home {}", stage.at).out == expected
    assert said(0, "stage move {} -20 -30.5 --z -5 --a -90 --feed 60000", stage.at).out.endswith(
        "moved: X -20.000 mm, Y -30.500 mm, Z -5.000 mm, A -90.000 deg\n"
    )
    assert stage.emulator.position_mm() == pytest.approx([-20, -30.5, -5, -90])
    assert said(0, "stage jog {} X-5 x-2y-1.5 A-10", stage.at).out.endswith(
        "moved: X -8.000 mm, Y -2.500 mm, Z -1.000 mm, A -11.000 deg\n"
    )


@pytest.mark.slow
def test_beyond_the_travel_nothing_moves_at_all(stage: Served, said: Said) -> None:
    before = stage.emulator.position_mm()
    why = said(2, "stage move {} -20 5", stage.at).err
    assert "Y = 5.000 mm is outside the travel, -275 to 0 mm" in why
    assert stage.emulator.position_mm() == pytest.approx(before)
    assert "X = 1.000 mm is outside the travel" in said(2, "stage jog {} X2", stage.at).err


@pytest.mark.slow
def test_a_fault_ends_at_a_stand_with_what_to_do(stage: Served, said: Said) -> None:
    stage.emulator.inject(Fault.NO_SWITCH)
    assert "alarm 9: homing found no switch" in said(3, "stage home {}", stage.at).err
    stage.emulator.cure(Fault.NO_SWITCH)
    assert said(0, "stage recover {}", stage.at).out.startswith(
        "restarted, in state Alarm; its position is unknown"
    )
    assert teatbench("stage home {}", stage.at) == 0


def test_ways_to_go() -> None:
    assert step("X-5") == {"x_mm": -5.0}
    assert step("x.5Y+2A10.25") == {"x_mm": 0.5, "y_mm": 2.0, "a_deg": 10.25}
    for wrong in ("", "X", "5", "X5X6", "X5 Y6", "B5", "X5;", "X1e3"):
        with pytest.raises(ValueError, match="is no way to go"):
            step(wrong)
