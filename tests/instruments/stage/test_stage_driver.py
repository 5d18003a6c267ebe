"""The driver against the emulator over a loopback link, under virtual time, both dialects: who it is, homing,
moves, limits, jogs, hold, resume, stop and safe from every state; golden lines typed from the fact sheet."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from instruments.errors import DeviceError, LimitError, LinkError
from instruments.stage.driver import OwnStage
from instruments.stage.emulator.board import StageFault
from tests.instruments.stage.board import Bench

Make = Callable[..., Bench]


def test_connecting_tells_who_it_is_and_what_it_can_do(bench: Bench) -> None:
    identity = bench.stage.connect()
    assert (identity.dialect, identity.version) in {("Grbl", "1.1h"), ("grblHAL", "1.1f")}
    assert identity.build.startswith(identity.version)
    assert bench.stage.identity == identity
    assert str(identity).startswith(f"{identity.dialect} {identity.version} (build ")
    settings = bench.stage.settings
    assert settings.travel_mm == (300.0, 275.0, 50.0)
    assert (settings.soft_limits, settings.homing) == (True, True)
    assert bench.stage.limits["Y"].low_mm == -275.0
    assert not bench.stage.homed


def test_nothing_works_before_connecting(bench: Bench) -> None:
    for call in (
        lambda: bench.stage.identity,
        lambda: bench.stage.limits,
        bench.stage.home,
        lambda: bench.stage.move_to(-1, -1),
    ):
        with pytest.raises(LimitError, match="not connected yet"):
            call()


REFUSED: list[tuple[dict[str, float], str]] = [
    ({"x_mm": 0.001}, "outside the travel"),
    ({"x_mm": -300.001}, "outside the travel"),
    ({"y_mm": -275.01}, "outside the travel"),
    ({"y_mm": 1e6}, "outside the travel"),
    ({"x_mm": math.nan}, "can.t be sent"),
    ({"y_mm": math.inf}, "can.t be sent"),
    ({"feed_mm_min": 0.0}, "a feed has to be"),
    ({"feed_mm_min": -1.0}, "a feed has to be"),
    ({"feed_mm_min": math.nan}, "a feed has to be"),
    ({"feed_mm_min": math.inf}, "can.t be sent"),
    (
        {"x_mm": 5.0},
        r"X = 5\.000 mm is outside the travel, -300 to 0 mm \(asked G21G90G94G53G1X5Y-1F3000\)",
    ),
]
JOGS_REFUSED: list[dict[str, float]] = [
    {"x_mm": 1.001},
    {"x_mm": -299.001},
    {"y_mm": math.nan},
    {"y_mm": math.inf},
    {"z_mm": 5.0},
    {},
]


def test_what_is_beyond_the_travel_or_no_feed_is_refused_before_sending(bench: Bench) -> None:
    stage = bench.homed()
    sent = Sent(bench)
    for change, why in REFUSED:
        with pytest.raises(LimitError, match=why):
            stage.move_to(**({"x_mm": -1.0, "y_mm": -1.0} | change))
    for way in JOGS_REFUSED:
        with pytest.raises(LimitError):
            stage.jog(**way)
    assert set(sent) <= {b"?"}
    assert stage.homed
    assert stage.status().state == "Idle"


def test_a_controller_without_homing_is_never_moved(make: Make) -> None:
    bench = make({22: 0, 20: 0})
    bench.stage.connect()
    with pytest.raises(LimitError, match=r"set \$22=1"):
        bench.stage.home()
    with pytest.raises(LimitError, match="no move before homing"):
        bench.stage.move_to(-5, -5)


def test_work_positions_are_turned_into_machine_positions(make: Make) -> None:
    bench = make({10: 0})
    stage = bench.homed()
    stage._dialogue.command("G92X100Y50")
    stage.move_to(-30, -40)
    assert stage.position() == pytest.approx([-30, -40, -1])
    assert stage.status().mpos_mm is None


def test_coarse_steps_are_not_taken_for_a_wrong_place(make: Make) -> None:
    stage = make({100: 13.33, 101: 13.33}).homed()
    stage.move_to(-100.03, -50.04)
    assert stage.position() == pytest.approx([-100.03, -50.04, -1], abs=0.04)


class Sent(list[bytes]):
    """What the driver of ``bench`` sends from now on."""

    def __init__(self, bench: Bench) -> None:
        super().__init__()
        write = bench.links[-1].write

        def noted(data: bytes) -> None:
            self.append(data)
            write(data)

        bench.links[-1].write = noted  # type: ignore[method-assign]


def test_what_homing_moves_jogs_stops_and_recovery_send(bench: Bench) -> None:
    bench.stage.connect()
    sent = Sent(bench)
    bench.stage.home()
    bench.stage.move_to(-1.5, -1, z_mm=-2.25, feed_mm_min=600)
    move = [b"G21G90G94G53G1X-1.5Y-1Z-2.25F600\n", b"?", b"?", b"G4P0\n", b"?"]
    assert sent == [b"$H\n", b"?", b"?", *move]
    bench.stage.move_to(-100, -100)
    sent.clear()
    bench.stage.jog(x_mm=50, y_mm=-0.5, feed_mm_min=600)
    bench.stage.cancel_jog()
    bench.stage.begin_move(-200, -100)
    bench.stage.stop()
    bench.stage.recover()
    assert [data for data in sent if data != b"?"] == [
        b"$J=G21G91X50Y-0.5F600\n",
        b"\x85",
        b"G21G90G94G53G1X-200Y-100F3000\n",
        b"!",
        b"\x18",
    ]


def test_a_jog_that_the_panel_ended_is_reported_and_keeps_the_position(bench: Bench) -> None:
    stage = bench.homed()
    stage.jog(x_mm=-200)
    bench.clock.sleep(1.0)
    stage.brake()
    with pytest.raises(
        DeviceError, match=r"not at its target, X = -201\.000.*its position is kept"
    ):
        stage.finish_move()
    assert stage.homed
    stage.move_to(-5, -5)


def test_the_controllers_own_refusal_is_a_sentence_and_no_alarm(bench: Bench) -> None:
    stage = bench.homed()
    bench.emulator._controller.settings.write(130, 100)  # the driver has read 300
    with pytest.raises(
        DeviceError, match="error 15: the jog goes beyond the travel; it was not started"
    ):
        stage.jog(x_mm=-150)
    assert stage.homed
    stage.jog(x_mm=-50)
    stage.finish_move()


def test_one_move_at_a_time_and_none_before_homing(bench: Bench) -> None:
    stage = bench.stage
    stage.connect()
    with pytest.raises(LimitError, match="no move before homing"):
        stage.jog(x_mm=-1)
    stage.home()
    with pytest.raises(LimitError, match="no move is under way"):
        stage.finish_move()
    starts: list[Callable[[], None]]
    starts = [lambda: stage.begin_move(-100, -1), lambda: stage.jog(x_mm=-100)]
    for start in starts:
        start()
        for call in (stage.home, lambda: stage.begin_move(-5, -5), lambda: stage.jog(y_mm=-1)):
            with pytest.raises(LimitError, match="under way"):
                call()
        stage.finish_move()


def test_a_hold_at_the_panel_interrupts_the_move(bench: Bench) -> None:
    stage = _moving(bench)
    stage._dialogue.write(b"!")
    with pytest.raises(DeviceError, match=r"the move was interrupted \(got Hold:[01]\)"):
        stage.finish_move()
    with pytest.raises(LimitError, match=r"not idle \(.*got Hold:[01]\)\. A run homes"):
        stage.move_to(-5, -5)


def test_a_feed_override_that_makes_the_move_too_slow(bench: Bench) -> None:
    stage = _moving(bench)
    stage._dialogue.write(b"\x92" * 9)
    with pytest.raises(DeviceError, match="takes too long"):
        stage.finish_move()
    stage.stop()
    assert stage.status().name == "Hold:0"


def _connected(bench: Bench) -> OwnStage:
    bench.stage.connect()
    return bench.stage


def _moving(bench: Bench, for_s: float = 1.0) -> OwnStage:
    bench.homed().begin_move(-200, -200)
    bench.clock.sleep(for_s)
    return bench.stage


def _jogging(bench: Bench) -> None:
    bench.homed().jog(x_mm=-200)
    bench.clock.sleep(1.0)


def _homing(bench: Bench) -> None:
    with pytest.raises(LinkError):
        _connected(bench)._dialogue.command("$H", 2.0)


def _alarm(bench: Bench) -> None:
    bench.emulator.inject(StageFault.LIMIT_HIT, 0.5)
    with pytest.raises(DeviceError):
        bench.homed().move_to(-200, -200)


def _alarm_unseen(bench: Bench) -> None:
    bench.emulator.inject(StageFault.LIMIT_HIT, 0.5)
    _moving(bench, 2.0)


STATES: dict[str, Callable[[Bench], object]] = {
    "idle": Bench.homed,
    "unhomed": _connected,
    "moving": _moving,
    "move over but not finished": lambda bench: _moving(bench, 61.0),
    "held": lambda bench: _moving(bench).stop(),
    "jogging": _jogging,
    "braking": lambda bench: _moving(bench)._dialogue.write(b"!"),
    "door": lambda bench: _moving(bench)._dialogue.write(b"\x84"),
    "homing": _homing,
    "alarm": _alarm,
    "alarm unseen": _alarm_unseen,
    "asleep": lambda bench: _connected(bench)._dialogue.command("$SLP"),
}


@pytest.mark.parametrize("state", STATES)
def test_safe_stops_from_every_state_and_may_be_called_again(bench: Bench, state: str) -> None:
    STATES[state](bench)
    start = bench.clock.now()
    for _ in range(3):
        bench.stage.safe()
    assert bench.clock.now() - start <= 10
    place = bench.emulator.position_mm()
    bench.clock.sleep(60)
    assert bench.emulator.position_mm() == pytest.approx(place)
    if state not in ("unhomed", "asleep"):
        bench.stage.recover()
        bench.stage.home()
        bench.stage.move_to(-7, -7)
