"""Stages with a Z and a rotation A, as declared; what the controller must have for it; and reports
with more in them than we know.
"""

from __future__ import annotations

import re
from collections.abc import Callable

import pytest

from instruments.errors import DeviceError, LimitError, ProtocolError
from instruments.listener import Connection
from instruments.stage.driver import OwnStage
from instruments.stage.emulator.store import GRBL_HAL
from tests.instruments.stage.board import Bench

Make = Callable[..., Bench]


def test_a_stage_moves_the_axes_that_it_is_declared_with(make: Make) -> None:
    bench = make(dialect=GRBL_HAL, axes="XYZA")
    stage = bench.homed()
    assert stage.position() == pytest.approx([-1, -1, -1, -1])
    assert list(stage.limits) == ["X", "Y", "Z", "A"]
    assert stage.limits["A"].low_mm == -360.0
    stage.move_to(-100, -50, z_mm=-20, a_deg=-90, feed_mm_min=1500)
    assert stage.position() == pytest.approx([-100, -50, -20, -90])
    assert bench.emulator.position_mm() == pytest.approx([-100, -50, -20, -90])
    stage.move_to(-100, -60)
    assert bench.emulator.position_mm() == pytest.approx([-100, -60, -20, -90])
    stage = bench.again(axes="XYA").homed()
    stage.move_to(-100, -50, a_deg=-200)
    assert stage.position() == pytest.approx([-100, -50, -1, -200])
    assert list(stage.limits) == ["X", "Y", "A"]
    with pytest.raises(LimitError, match=r"A = -361\.000 deg is outside the travel, -360 to 0 deg"):
        stage.move_to(-100, -50, a_deg=-361)
    stage = bench.again(axes="XY").homed()
    stage.move_to(-100, -50)
    assert stage.position() == pytest.approx([-100, -50, -1])


@pytest.mark.parametrize(
    ("axes", "more"), [("XY", {"z_mm": -5.0}), ("XYZ", {"a_deg": -5.0}), ("XYA", {"z_mm": -5.0})]
)
def test_an_axis_that_is_not_declared_is_refused(
    make: Make, axes: str, more: dict[str, float]
) -> None:
    stage = make(dialect=GRBL_HAL, axes=axes).homed()
    with pytest.raises(
        LimitError,
        match=f"this stage has no axis {'Z' if 'z_mm' in more else 'A'}.*declared with {axes}",
    ):
        stage.move_to(-10, -10, **more)
    with pytest.raises(LimitError, match="this stage has no axis"):
        stage.jog(**more)


def test_axes_that_no_stage_or_this_controller_has_not(make: Make) -> None:
    bench = make()
    with pytest.raises(LimitError, match=r"a stage has no axes 'XB'\. Declare XY, XYZ, XYA, XYZA"):
        OwnStage(bench.stage._link, bench.clock, "XB")
    missing = r"no axis A: setting \$103 is missing.*grblHAL build with four axes"
    with pytest.raises(DeviceError, match=missing):
        bench.again(axes="XYA").stage.connect()


def spoil(bench: Bench, what: bytes, instead: bytes) -> Bench:
    """Plug the driver in again, with something else in the board's reports."""
    board = bench.emulator

    class Spoiled:
        receive, disconnect = board.receive, board.disconnect

        def connect(self, connection: Connection) -> None:
            honest = connection.send
            connection.send = lambda data: honest(re.sub(what, instead, data))  # type: ignore[method-assign]
            board.connect(connection)

    return bench.again(device=Spoiled())


@pytest.mark.parametrize("text", [b"-100.020", b"-99.980", b"-1.000"])
def test_a_move_that_is_read_back_elsewhere_is_not_finished_and_asks_for_homing(
    make: Make, text: bytes
) -> None:
    stage = spoil(make(), rb"<Idle\|MPos:-100\.000", b"<Idle|MPos:" + text).homed()
    with pytest.raises(
        DeviceError, match=rf"not at its target, X = -100\.000 \(got X = {float(text):.3f}"
    ):
        stage.move_to(-100, -50)
    assert not stage.homed
    with pytest.raises(LimitError, match="no move before homing"):
        stage.move_to(-5, -5)


def test_a_report_with_too_few_numbers_for_the_declared_axes(make: Make) -> None:
    bench = make(dialect=GRBL_HAL, axes="XYA")
    spoil(bench, rb"(MPos:[^,]+,[^,]+,[^,]+),[^|>]+", rb"\1")
    with pytest.raises(ProtocolError, match="3 numbers in a position, 4 are needed"):
        bench.homed().move_to(-5, -5)
