"""All firmwares alike: each stage homes, moves and stops, and nothing that may have cost its position leaves
it believed to be there."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from instruments.errors import DeviceError, InstrumentError, LimitError, LinkError, ProtocolError
from instruments.listener import Connection
from instruments.stage.driver import OwnStage
from instruments.stage.emulator.board import StageFault
from instruments.stage.emulator.store import EMULATED, FLUIDNC, MARLIN, ZABER
from tests.instruments.stage.board import Bench

Make = Callable[..., Bench]


OURS = [one for one in EMULATED.values() if one is not ZABER]  # which is driven by its maker's


@pytest.fixture(params=OURS, ids=lambda dialect: dialect.name)
def each(make: Make, request: pytest.FixtureRequest) -> Bench:
    return make(dialect=request.param)


@pytest.fixture(params=[FLUIDNC, MARLIN], ids=lambda dialect: dialect.name)
def newer(make: Make, request: pytest.FixtureRequest) -> Bench:
    return make(dialect=request.param)


def test_the_docs_say_of_each_firmware_what_it_can_not_tell() -> None:
    text = (Path(__file__).parents[3] / "docs" / "rig.md").read_text(encoding="utf-8")
    assert all(re.search(rf"\| (\S+|a plug-in) \| {name} .*\|.*\w \|\n", text) for name in EMULATED)


def somewhere(stage: OwnStage) -> tuple[float, float]:
    low = {axis: limits.low_mm for axis, limits in stage.limits.items()}
    return low["X"] + 50.0, low["Y"] + 60.0


def test_each_stage_refuses_what_is_beyond_and_marlin_alone_is_lost_by_a_stop(each: Bench) -> None:
    stage = each.stage
    assert stage.connect().dialect == each.emulator.dialect.name
    x, y = somewhere(stage)
    stage.home()
    for beyond in (stage.limits["X"].low_mm - 0.01, stage.limits["X"].high_mm + 0.01):
        with pytest.raises(LimitError, match="outside the travel"):
            stage.move_to(beyond, y)
    stage.begin_move(x + 200, y)
    each.clock.sleep(1.0)
    stage.stop()
    assert stage.homed == (each.emulator.dialect is not MARLIN)
    assert stage.homed == ("its position lost if it moved" not in stage.safe_state)


def test_a_stage_that_is_not_identified_yet_stands(each: Bench) -> None:
    """An interlock may trip before the run comes to the stage, whose port is open: what its board
    says as it starts is no restart by itself, and no reason to halt it.
    """
    each.clock.sleep(1.0)
    assert each.stage.stands() is not None
    each.stage.stop()
    assert each.stage.connect().dialect == each.emulator.dialect.name
    each.stage.home()


def test_a_stage_that_is_not_identified_yet_is_stopped(each: Bench) -> None:
    """As at the end of a run that came no further."""
    each.clock.sleep(1.0)
    each.stage.safe()
    assert each.stage.stands() is not None
    each.stage.connect()
    each.stage.home()


def _restarts_unheard(bench: Bench) -> None:
    """The power dips at rest; nothing that the board says at its start arrives."""
    controller = bench.emulator._controller
    controller.power_up()
    controller.out.clear()


def _restarts(bench: Bench) -> None:
    bench.emulator._controller.power_up()
    bench.emulator._settle()


def _babbles(bench: Bench) -> None:
    bench.emulator._send(b"\x00?Hold#garbled\r\n")


def _limit(bench: Bench) -> None:
    bench.emulator._controller.alarm(1, critical=True)
    bench.emulator._settle()


@pytest.mark.parametrize("upset", [_restarts_unheard, _restarts, _babbles, _limit])
@pytest.mark.parametrize("moving", [False, True], ids=["at rest", "moving"])
def test_after_an_upset_it_is_believed_to_be_nowhere(
    each: Bench, upset: Callable[[Bench], None], moving: bool
) -> None:
    stage = each.homed()
    x, y = somewhere(stage)
    stage.move_to(x, y)
    if moving:
        stage.begin_move(x + 200, y)
        each.clock.sleep(1.0)
    upset(each)
    with pytest.raises(InstrumentError):  # noqa: PT012 - whichever of them hears it first
        if moving:
            stage.finish_move()
        stage.move_to(x + 1, y)
    assert not stage.homed
    with pytest.raises(InstrumentError):
        stage.move_to(x + 2, y)
    _restarts(each)  # a halted Marlin is switched off and on
    stage.recover()
    stage.home()
    stage.move_to(x, y)
    assert each.emulator.position_mm()[:2] == pytest.approx([x, y], abs=0.006)


@pytest.mark.parametrize(
    "fault", [StageFault.LOST_OK, StageFault.LATE_OK, StageFault.GARBAGE, StageFault.DISCONNECT]
)
def test_after_a_lost_or_late_answer_it_is_recovered(newer: Bench, fault: StageFault) -> None:
    stage = newer.homed()
    x, y = somewhere(stage)
    newer.emulator.inject(fault, 3.0 if fault is StageFault.LATE_OK else 0.2)
    with pytest.raises((LinkError, ProtocolError, DeviceError)):
        stage.move_to(x + 100, y)
    newer.clock.sleep(10.0)
    if fault is StageFault.DISCONNECT:
        stage.reconnect()
    with pytest.raises(InstrumentError):
        newer.again().stage.move_to(x, y)
    newer.homed().move_to(x, y)
    assert newer.emulator.position_mm()[:2] == pytest.approx([x, y], abs=0.006)


def test_homing_that_fails_is_told(each: Bench) -> None:
    each.stage.connect()
    each.emulator.inject(StageFault.NO_SWITCH)
    with pytest.raises(DeviceError):
        each.stage.home()
    assert not each.stage.homed
    each.stage.safe()


def test_a_stage_that_homes_is_stopped(each: Bench) -> None:
    stage = each.stage
    stage.connect()

    def interrupt() -> None:
        raise KeyboardInterrupt

    each.clock.call_at(each.clock.now() + 0.7, interrupt)
    with pytest.raises(KeyboardInterrupt):
        stage.home()
    start_s = each.clock.now()
    for _ in range(3):
        stage.safe()
    assert each.clock.now() - start_s < 10
    place = each.emulator.position_mm()
    each.clock.sleep(60)
    assert each.emulator.position_mm() == pytest.approx(place)
    assert not stage.homed


def test_a_brake_from_outside_ends_the_move_and_marlins_position(newer: Bench) -> None:
    stage = newer.homed()
    x, y = somewhere(stage)
    stage.begin_move(x + 200, y)
    newer.clock.sleep(1.0)
    stage.brake()
    with pytest.raises(DeviceError):
        stage.finish_move()
    newer.clock.sleep(1.0)
    assert newer.emulator.velocity() == pytest.approx(0.0, abs=1e-9)
    assert stage.homed is (newer.emulator.dialect is FLUIDNC)


def test_a_board_that_looks_for_its_network_first_is_waited_for(make: Make) -> None:
    bench = make(dialect=FLUIDNC)

    class Slow:
        receive, disconnect = bench.emulator.receive, bench.emulator.disconnect

        def connect(self, connection: Connection) -> None:
            words = b"[MSG:INFO: Connecting to STA:lab]\r\n"
            for at_s in (0.0, 2.0, 4.0, 6.0):
                connection.after(at_s, lambda: connection.send(words))
            connection.after(8.0, lambda: bench.emulator.connect(connection))

    assert bench.again(device=Slow()).stage.connect().dialect == "FluidNC"


def test_marlin_turns_nothing(make: Make) -> None:
    with pytest.raises(LimitError, match="X, Y and Z only"):
        make(dialect=MARLIN, axes="XY").again(axes="XYA").stage.connect()
