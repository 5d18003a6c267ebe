"""The driver against the emulator over a loopback link, under virtual time, both dialects: who it
is, homing, moves, limits.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from instruments.errors import DeviceError, LimitError
from tests.instruments.stage.stage_bench import Bench

Make = Callable[..., Bench]


def test_connecting_tells_who_it_is_and_what_it_can_do(bench: Bench) -> None:
    identity = bench.stage.connect()
    assert (identity.dialect, identity.version) in {("Grbl", "1.1h"), ("grblHAL", "1.1f")}
    assert identity.build.startswith(identity.version)
    assert bench.stage.identity == identity
    assert str(identity).startswith(f"{identity.dialect} {identity.version} (build ")
    settings = bench.stage.settings
    assert (settings.travel_mm, settings.soft_limits, settings.homing) == (
        (300.0, 275.0, 50.0),
        True,
        True,
    )
    assert bench.stage.limits["Y"].low_mm == -275.0
    assert not bench.stage.homed


def test_a_fresh_eeprom_is_no_obstacle(make: Make) -> None:
    assert make(fresh_eeprom=True).stage.connect().version == "1.1h"


def test_nothing_works_before_connecting(bench: Bench) -> None:
    for call in (
        lambda: bench.stage.identity,
        lambda: bench.stage.limits,
        bench.stage.home,
        lambda: bench.stage.move_to(-1, -1),
    ):
        with pytest.raises(LimitError, match="not connected yet"):
            call()


def test_no_move_before_homing(bench: Bench) -> None:
    bench.stage.connect()
    with pytest.raises(LimitError, match="no move before homing"):
        bench.stage.move_to(-10, -10)
    assert bench.emulator.position_mm() == pytest.approx([-150, -137.5, -25])


def test_homing_then_moving_ends_at_the_target(bench: Bench) -> None:
    stage = bench.homed()
    assert stage.homed
    assert stage.position() == pytest.approx([-1, -1, -1])
    for x, y in ((-150.0, -100.0), (-300.0, -275.0), (0.0, 0.0), (-12.3456, -0.001)):
        stage.move_to(x, y, feed_mm_min=2500)
        assert stage.position() == pytest.approx([x, y, -1.0], abs=0.003)
        assert bench.emulator.position_mm() == pytest.approx(stage.position(), abs=0.001)
    stage.move_to(-20, -20, z_mm=-7.5)
    assert stage.position() == pytest.approx([-20, -20, -7.5])
    assert isinstance(stage.position(), np.ndarray)


def test_a_move_takes_its_trapezoid_and_at_most_one_poll_more(bench: Bench) -> None:
    stage = bench.homed()
    stage.move_to(-100, -1)
    start = bench.clock.now()
    stage.move_to(-200, -1)
    assert 2.25 <= bench.clock.now() - start <= 2.25 + 0.2 + 1e-9


@pytest.mark.parametrize(
    "place",
    [
        (0.001, -1.0),
        (-300.001, -1.0),
        (-1.0, -275.01),
        (-1.0, 1e6),
        (float("nan"), -1.0),
        (-1.0, float("inf")),
    ],
)
def test_a_target_beyond_the_travel_is_refused_before_sending(
    make: Make, place: tuple[float, float]
) -> None:
    bench = make()
    stage = bench.homed()
    with pytest.raises(LimitError):
        stage.move_to(*place)
    assert stage.homed
    assert stage.status().state == "Idle"


@pytest.mark.parametrize("feed", [0.0, -1.0, float("nan"), float("inf")])
def test_a_feed_that_is_no_feed_is_refused(make: Make, feed: float) -> None:
    with pytest.raises(LimitError):
        make().homed().move_to(-5, -5, feed_mm_min=feed)


def test_the_message_names_the_limit_and_the_line(make: Make) -> None:
    with pytest.raises(
        LimitError,
        match=(
            r"X = 5\.000 mm is outside the travel, -300 to 0 mm \(asked G21G90G94G53G1X5Y-5F3000\)"
        ),
    ):
        make().homed().move_to(5, -5)


def test_a_controller_without_homing_is_never_moved(make: Make) -> None:
    bench = make({22: 0, 20: 0})
    bench.stage.connect()
    with pytest.raises(LimitError, match=r"set \$22=1"):
        bench.stage.home()
    with pytest.raises(LimitError, match="no move before homing"):
        bench.stage.move_to(-5, -5)


def test_inches_are_refused(make: Make) -> None:
    with pytest.raises(DeviceError, match=r"Set \$13=0"):
        make({13: 1}).stage.connect()


def test_work_positions_are_turned_into_machine_positions(make: Make) -> None:
    bench = make({10: 0})
    stage = bench.homed()
    stage._talk.command("G92X100Y50")
    stage.move_to(-30, -40)
    assert stage.position() == pytest.approx([-30, -40, -1])
    assert stage.status().mpos_mm is None


def test_coarse_steps_are_not_taken_for_a_wrong_place(make: Make) -> None:
    bench = make({100: 13.33, 101: 13.33})
    stage = bench.homed()
    stage.move_to(-100.03, -50.04)
    assert stage.position() == pytest.approx([-100.03, -50.04, -1], abs=0.04)
