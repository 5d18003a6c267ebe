"""The guardian's way to stop a stage that another process moves: each firmware that it may be."""

from __future__ import annotations

import threading
import time
from contextlib import closing, suppress

import numpy as np
import pytest

from bench.rig.guardian_stage import StageStop, StageTarget
from instruments.clock import RealClock
from instruments.errors import InstrumentError
from instruments.link import Link
from instruments.listener import Listener
from instruments.stage.driver import OwnStage, Spoken
from instruments.stage.emulator.board import StageEmulator
from instruments.stage.emulator.store import CLASSIC, MARLIN, Firmware
from tests.waiting import PATIENCE_S, within

pytestmark = pytest.mark.slow

# 60 mm, quickly
FAST = {24: 6000.0, 25: 12_000.0} | dict.fromkeys((110, 111, 112), 12_000.0)
FAST |= dict.fromkeys((120, 121, 122), 2000.0) | dict.fromkeys((130, 131, 132), 60.0)


def stopped(target: StageTarget, clock: RealClock) -> dict[str, object]:
    stop = StageStop(target, clock)
    assert stop.result() is None
    stop.begin()
    return stop.result() or {}


@pytest.mark.parametrize(("dialect", "spoken"), [(CLASSIC, "grbl"), (MARLIN, "marlin")])
@pytest.mark.parametrize("homes", [False, True], ids=["in a move", "while it homes"])
def test_it_stops_a_stage_of_each_firmware(dialect: Firmware, spoken: Spoken, homes: bool) -> None:
    steps = {100: 250.0, 101: 250.0}
    with closing(RealClock()) as clock:
        device = StageEmulator(clock, settings=steps if homes else FAST | steps, dialect=dialect)
        lock = threading.RLock()
        with (
            closing(Listener(device, clock, lock=lock, name="stage")) as listener,
            closing(Link(listener.url, clock, who="stage")) as link,
        ):
            stage = OwnStage(link, clock, "XY", dialect=spoken)
            stage.connect()
            owner = threading.Thread(target=_homes if homes else _moves, args=(stage,))
            owner.start()
            within(lambda: _moving(device) and (homes or stage.homed), "moves")
            target = StageTarget(listener.url, 115200, spoken, "XY")
            found = stopped(target, clock)
            assert not _moving(device)
            assert found["stands"] is True
            owner.join(PATIENCE_S)


def _moving(device: StageEmulator) -> bool:
    before = device.position_mm()
    time.sleep(0.1)
    return not np.allclose(before, device.position_mm())


def _homes(stage: OwnStage) -> None:
    with suppress(InstrumentError):  # its link is taken from it
        stage.home()


def _moves(stage: OwnStage) -> None:
    with suppress(InstrumentError):
        stage.home()
        x_mm, y_mm = stage.position()[:2]
        low, high = stage.limits["X"].low_mm, stage.limits["X"].high_mm
        there = low + 1.0 if x_mm - low > high - x_mm else high - 1.0
        stage.move_to(there, y_mm, feed_mm_min=300.0)


def test_a_stage_that_is_not_there_is_no_stand(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bench.rig.guardian_stage.STAGE_S", 0.5)
    target = StageTarget("socket://127.0.0.1:9", 115200, "grbl", "XY")
    with closing(RealClock()) as clock:
        found = stopped(target, clock)
    assert found["stands"] is False
    assert "nothing takes the connection" in str(found["error"])
