"""Hold, resume, stop and safe, from every state."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from instruments.errors import DeviceError, LimitError, LinkError
from instruments.stage.emulator import Fault
from tests.instruments.stage.stage_bench import Bench

Make = Callable[..., Bench]


def test_hold_resume_and_finish(bench: Bench) -> None:
    stage = bench.homed()
    stage.begin_move(-200, -1)
    bench.clock.sleep(1.0)
    stage.hold()
    held = bench.emulator.position_mm()
    assert stage.status().name == "Hold:0"
    bench.clock.sleep(60)
    assert bench.emulator.position_mm() == pytest.approx(held)
    assert stage.position() == pytest.approx(held, abs=0.005)
    with pytest.raises(LimitError, match="still under way"):
        stage.move_to(-5, -5)
    stage.resume()  # the first report still says that it is held
    assert stage.status().state == "Run"
    stage.finish_move()
    assert bench.emulator.position_mm() == pytest.approx([-200, -1, -1])
    assert stage.homed


def test_a_resume_that_is_lost_is_told(bench: Bench) -> None:
    stage = bench.homed()
    stage.begin_move(-200, -1)
    bench.clock.sleep(1.0)
    stage.hold()
    start_s = bench.clock.now()
    bench.emulator._controller._resume = lambda: None  # type: ignore[method-assign]
    with pytest.raises(DeviceError, match=r"the controller did not resume \(got Hold:0\)"):
        stage.resume()
    assert bench.clock.now() - start_s == pytest.approx(0.3)


def test_resume_waits_until_the_stage_stands(bench: Bench) -> None:
    stage = bench.homed()
    stage.begin_move(-200, -1)
    bench.clock.sleep(1.0)
    stage._talk.realtime(b"!")
    assert stage.status().name == "Hold:1"
    stage.resume()
    assert stage.status().state == "Run"
    stage.finish_move()


def test_resume_without_a_hold_is_refused(bench: Bench) -> None:
    stage = bench.homed()
    with pytest.raises(LimitError, match="nothing to resume"):
        stage.resume()
    with pytest.raises(LimitError, match="no move is under way"):
        stage.finish_move()
    stage.begin_move(-5, -5)
    for call in (stage.home, lambda: stage.begin_move(-6, -6)):
        with pytest.raises(LimitError, match="under way"):
            call()


def test_a_hold_at_the_panel_interrupts_the_move(bench: Bench) -> None:
    stage = bench.homed()
    stage.begin_move(-200, -1)
    bench.clock.sleep(1.0)
    stage._talk.realtime(b"!")
    with pytest.raises(DeviceError, match=r"the move was interrupted \(got Hold:[01]\)"):
        stage.finish_move()
    stage.resume()
    stage.finish_move()


def test_a_feed_override_that_makes_the_move_too_slow(bench: Bench) -> None:
    stage = bench.homed()
    stage.begin_move(-299, -1)
    stage._talk.realtime(b"\x92" * 9)
    with pytest.raises(DeviceError, match="takes too long"):
        stage.finish_move()
    stage.stop()
    assert stage.status().name == "Hold:0"


def _idle(bench: Bench) -> None:
    bench.homed()


def _unhomed(bench: Bench) -> None:
    bench.stage.connect()


def _moving(bench: Bench) -> None:
    bench.homed().begin_move(-200, -200)
    bench.clock.sleep(1.0)


def _move_over_but_not_finished(bench: Bench) -> None:
    _moving(bench)
    bench.clock.sleep(60.0)


def _held(bench: Bench) -> None:
    _moving(bench)
    bench.stage.hold()


def _braking(bench: Bench) -> None:
    _moving(bench)
    bench.stage._talk.realtime(b"!")


def _door(bench: Bench) -> None:
    _moving(bench)
    bench.stage._talk.realtime(b"\x84")


def _homing(bench: Bench) -> None:
    bench.stage.connect()
    with pytest.raises(LinkError):
        bench.stage._talk.command("$H", 2.0)


def _alarm(bench: Bench) -> None:
    bench.emulator.inject(Fault.LIMIT_HIT, 0.5)
    with pytest.raises(DeviceError):
        bench.homed().move_to(-200, -200)


def _alarm_unseen(bench: Bench) -> None:
    bench.emulator.inject(Fault.LIMIT_HIT, 0.5)
    bench.homed().begin_move(-200, -200)
    bench.clock.sleep(2.0)


def _asleep(bench: Bench) -> None:
    bench.stage.connect()
    bench.stage._talk.command("$SLP")


@pytest.mark.parametrize(
    "state",
    [
        _idle,
        _unhomed,
        _moving,
        _move_over_but_not_finished,
        _held,
        _braking,
        _door,
        _homing,
        _alarm,
        _alarm_unseen,
        _asleep,
    ],
)
def test_safe_stops_from_every_state_and_may_be_called_again(
    bench: Bench, state: Callable[[Bench], None]
) -> None:
    state(bench)
    start = bench.clock.now()
    for _ in range(3):
        bench.stage.safe()
    assert bench.clock.now() - start <= 10
    place = bench.emulator.position_mm()
    bench.clock.sleep(60)
    assert bench.emulator.position_mm() == pytest.approx(place)
    if state not in (_unhomed, _asleep):
        bench.stage.recover()
        bench.stage.home()
        bench.stage.move_to(-7, -7)


def test_ctrl_c_in_a_move_ends_at_a_stand(bench: Bench) -> None:
    stage = bench.homed()

    def interrupt() -> None:
        raise KeyboardInterrupt

    bench.clock.call_at(bench.clock.now() + 1.3, interrupt)
    with pytest.raises(KeyboardInterrupt):
        stage.move_to(-250, -250)
    stage.safe()
    assert stage.status().name == "Hold:0"
    stage.resume()
    stage.finish_move()
    assert bench.emulator.position_mm() == pytest.approx([-250, -250, -1])


def test_ctrl_c_while_homing_ends_at_a_stand(bench: Bench) -> None:
    bench.stage.connect()

    def interrupt() -> None:
        raise KeyboardInterrupt

    bench.clock.call_at(bench.clock.now() + 3.0, interrupt)
    with pytest.raises(KeyboardInterrupt):
        bench.stage.home()
    bench.stage.safe()
    assert not bench.stage.homed
    assert bench.stage.status().state == "Alarm"
