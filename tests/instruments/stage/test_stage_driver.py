"""The driver against the emulator over a loopback link, under virtual time, both dialects; and against odd devices."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping

import numpy as np
import pytest

from instruments.clock import VirtualClock
from instruments.errors import DeviceError, InstrumentError, LimitError, LinkError, ProtocolError
from instruments.link import Link
from instruments.listener import Connection, Device, Listener
from instruments.stage.driver import Stage
from instruments.stage.emulator import CLASSIC, GRBL_HAL, Dialect, Fault, StageEmulator


class Bench:
    """A driver, its emulator, and their clock."""

    def __init__(self, settings: Mapping[int, float] | None, dialect: Dialect, fresh_eeprom: bool) -> None:
        self.clock = VirtualClock()
        self.emulator = StageEmulator(self.clock, settings=settings, dialect=dialect, fresh_eeprom=fresh_eeprom)
        self.listener = Listener(self.emulator, self.clock, lock=threading.RLock(), name="stage")
        self.stage = self.plug_in()

    def plug_in(self) -> Stage:
        return Stage(Link(self.listener.url, self.clock, who="stage"), self.clock)

    def homed(self) -> Stage:
        self.stage.connect()
        self.stage.home()
        return self.stage

    def close(self) -> None:
        self.stage.close()
        self.listener.close()


Make = Callable[..., Bench]


@pytest.fixture
def make() -> Iterator[Make]:
    benches: list[Bench] = []

    def one(settings: Mapping[int, float] | None = None, *, dialect: Dialect = CLASSIC, fresh_eeprom: bool = False) -> Bench:
        benches.append(Bench(settings, dialect, fresh_eeprom))
        return benches[-1]

    yield one
    for bench in benches:
        bench.close()


@pytest.fixture(params=[CLASSIC, GRBL_HAL], ids=["grbl", "grblHAL"])
def bench(make: Make, request: pytest.FixtureRequest) -> Bench:
    return make(dialect=request.param)


def test_connecting_tells_who_it_is_and_what_it_can_do(bench: Bench) -> None:
    identity = bench.stage.connect()
    assert (identity.dialect, identity.version) in {("Grbl", "1.1h"), ("grblHAL", "1.1f")}
    assert identity.build.startswith(identity.version)
    assert bench.stage.identity == identity
    assert str(identity).startswith(f"{identity.dialect} {identity.version} (build ")
    settings = bench.stage.settings
    assert (settings.travel_mm, settings.soft_limits, settings.homing) == ((300.0, 275.0, 50.0), True, True)
    assert bench.stage.limits["Y"].low_mm == -275.0
    assert not bench.stage.homed


def test_a_fresh_eeprom_is_no_obstacle(make: Make) -> None:
    assert make(fresh_eeprom=True).stage.connect().version == "1.1h"


def test_nothing_works_before_connecting(bench: Bench) -> None:
    for call in (lambda: bench.stage.identity, lambda: bench.stage.limits, bench.stage.home, lambda: bench.stage.move_to(-1, -1)):
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
    "place", [(0.001, -1.0), (-300.001, -1.0), (-1.0, -275.01), (-1.0, 1e6), (float("nan"), -1.0), (-1.0, float("inf"))]
)
def test_a_target_beyond_the_travel_is_refused_before_sending(make: Make, place: tuple[float, float]) -> None:
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
    with pytest.raises(LimitError, match=r"X = 5\.000 mm is outside the travel, -300 to 0 mm \(asked G21G90G94G53G1X5Y-5F3000\)"):
        make().homed().move_to(5, -5)


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
    stage.resume()
    stage.finish_move()
    assert bench.emulator.position_mm() == pytest.approx([-200, -1, -1])
    assert stage.homed


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


def test_an_alarm_in_a_move_is_a_sentence_and_asks_for_recovery_and_homing(bench: Bench) -> None:
    stage = bench.homed()
    bench.emulator.inject(Fault.LIMIT_HIT, 0.7)
    start = bench.clock.now()
    with pytest.raises(DeviceError, match=r"alarm 1: a limit switch was hit .*recover\(\) and home\(\)"):
        stage.move_to(-200, -200)
    assert bench.clock.now() - start == pytest.approx(0.7)
    assert not stage.homed
    with pytest.raises(LimitError, match="no move before homing"):
        stage.move_to(-5, -5)
    with pytest.raises(DeviceError, match="alarm 1"):
        stage.home()
    stage.stop()
    stage.recover()
    with pytest.raises(LimitError, match="no move before homing"):
        stage.move_to(-5, -5)
    stage.home()
    stage.move_to(-5, -5)
    assert bench.emulator.position_mm() == pytest.approx([-5, -5, -1])


@pytest.mark.parametrize(("fault", "alarm"), [(Fault.NO_SWITCH, 9), (Fault.STUCK_SWITCH, 8)])
def test_failed_homing(bench: Bench, fault: Fault, alarm: int) -> None:
    bench.stage.connect()
    bench.emulator.inject(fault)
    with pytest.raises(DeviceError, match=f"alarm {alarm}: "):
        bench.stage.home()
    assert not bench.stage.homed
    bench.emulator.cure(fault)
    with pytest.raises(DeviceError, match=f"alarm {alarm}: "):
        bench.stage.home()
    bench.stage.recover()
    bench.stage.home()
    assert bench.stage.homed


def test_the_controllers_own_soft_limit_is_an_alarm_too(make: Make) -> None:
    bench = make()
    stage = bench.homed()
    bench.emulator._controller.settings.write(130, 100)  # the driver has read 300
    with pytest.raises(DeviceError, match="alarm 2"):
        stage.move_to(-200, -5)
    stage.stop()
    stage.recover()
    assert not stage.homed


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


def test_a_restart_out_of_the_blue_asks_for_homing(bench: Bench) -> None:
    stage = bench.homed()
    bench.emulator.inject(Fault.RESTART, 0.5)
    with pytest.raises(DeviceError, match="restarted by itself"):
        stage.move_to(-100, -100)
    assert not stage.homed
    with pytest.raises(LimitError, match="no move before homing"):
        stage.move_to(-5, -5)
    stage.stop()
    stage.recover()
    stage.home()
    stage.move_to(-5, -5)


def test_unplugged_in_a_move(bench: Bench) -> None:
    stage = bench.homed()
    bench.emulator.inject(Fault.DISCONNECT, 0.5)
    with pytest.raises(LinkError):
        stage.move_to(-250, -250)
    assert not stage.homed
    with pytest.raises(LinkError, match="can't be stopped"):
        stage.stop()
    bench.clock.sleep(0.1)
    stage.close()
    again = bench.stage = bench.plug_in()
    again.connect()
    again.home()
    again.move_to(-5, -5)
    assert bench.emulator.position_mm() == pytest.approx([-5, -5, -1])


def test_a_lost_answer_is_a_time_out_and_keeps_the_conversation_closed(bench: Bench) -> None:
    stage = bench.homed()
    bench.emulator.inject(Fault.LOST_OK)
    with pytest.raises(LinkError, match=r"no answer \(asked G21.*after 2 s\)"):
        stage.move_to(-250, -250)
    with pytest.raises(LinkError, match="is still owed"):
        stage.home()
    stage.stop()
    stage.recover()
    stage.home()
    stage.move_to(-5, -5)


def test_a_late_answer_is_not_taken_for_another_lines(bench: Bench) -> None:
    stage = bench.homed()
    bench.emulator.inject(Fault.LATE_OK, 3.0)
    with pytest.raises(LinkError, match="no answer"):
        stage.move_to(-100, -100)
    bench.clock.sleep(5.0)
    stage.move_to(-50, -50)
    assert bench.emulator.position_mm() == pytest.approx([-50, -50, -1])


def test_noise_is_a_protocol_error(bench: Bench) -> None:
    stage = bench.homed()
    bench.emulator.inject(Fault.GARBAGE)
    with pytest.raises(ProtocolError, match=r"nonsense: .*FF 00 3C 52 75 7C 1B"):
        stage.move_to(-100, -100)
    stage.stop()
    stage.recover()
    stage.home()


def test_silence_in_a_move(bench: Bench) -> None:
    stage = bench.homed()
    stage.begin_move(-200, -200)
    bench.emulator.inject(Fault.SILENT)
    with pytest.raises(LinkError, match="no status report"):
        stage.finish_move()
    start = bench.clock.now()
    with pytest.raises(LinkError, match="can't be stopped"):
        stage.stop()
    assert bench.clock.now() - start < 15
    assert not stage.homed


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
    "state", [_idle, _unhomed, _moving, _move_over_but_not_finished, _held, _braking, _door, _homing, _alarm, _alarm_unseen, _asleep]
)
def test_safe_stops_from_every_state_and_may_be_called_again(bench: Bench, state: Callable[[Bench], None]) -> None:
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


class Parrot:
    """A device that answers every byte stream with the same words, after a greeting."""

    def __init__(self, greeting: bytes, answers: Mapping[bytes, bytes]) -> None:
        self.greeting = greeting
        self.answers = answers

    def connect(self, connection: Connection) -> None:
        connection.send(self.greeting)

    def receive(self, connection: Connection, data: bytes) -> None:
        connection.send(self.answers.get(data, b""))

    def disconnect(self, connection: Connection) -> None: ...


GREETING = b"\r\nGrbl 1.1h ['$' for help]\r\n"


def _meet(device: Device) -> None:
    clock = VirtualClock()
    listener = Listener(device, clock, lock=threading.RLock(), name="stage")
    link = Link(listener.url, clock, who="stage")
    try:
        Stage(link, clock).connect()
    finally:
        link.close()
        listener.close()


@pytest.mark.parametrize(
    ("greeting", "answers", "error", "sentence"),
    [
        (b"", {}, LinkError, "no welcome after a reset"),
        (b"", {b"\x18": b"\x06\x00\x15"}, ProtocolError, r"this is not GRBL.*06 00 15"),
        (b"START\r\nDONE\r\n", {}, ProtocolError, "this is not GRBL"),
        (b"\r\nGrbl 0.9j ['$' for help]\r\n", {}, DeviceError, "speaks another protocol"),
        (GREETING, {}, LinkError, r"no answer \(asked \$I"),
        (GREETING, {b"$I\n": b"error:3\r\n"}, DeviceError, "error 3"),
        (GREETING, {b"$I\n": b"ok\r\n", b"$$\n": b"ok\r\n"}, ProtocolError, r"setting \$\d+ is not usable"),
        (GREETING, {b"$I\n": b"ok\r\nok\r\n", b"$$\n": b"ok\r\n"}, ProtocolError, "nothing was asked for"),
        (GREETING, {b"$I\n": b"[MSG:x]\r\n" + GREETING}, DeviceError, "restarted by itself"),
        (GREETING, {b"$I\n": b"ALARM:77\r\n"}, DeviceError, "alarm 77: an alarm that this program does not know"),
    ],
)
def test_other_devices_are_refused(greeting: bytes, answers: Mapping[bytes, bytes], error: type[InstrumentError], sentence: str) -> None:
    with pytest.raises(error, match=sentence) as caught:
        _meet(Parrot(greeting, answers))
    assert str(caught.value).startswith("stage at socket://")


def test_a_stale_boot_message_before_the_welcome_is_no_obstacle(make: Make) -> None:
    settings = b"".join(b"$%d=%s\r\n" % (n, b"100.000") for n in (*range(100, 103), *range(110, 113), *range(120, 123), *range(130, 133)))
    flags = b"$13=0\r\n$20=1\r\n$21=0\r\n$22=1\r\n$24=25.000\r\n$25=500.000\r\n$27=1.000\r\n$74=my network\r\nok\r\n"
    _meet(Parrot(b"\xf0\xe0boot\r\nok\r\n" + GREETING, {b"$I\n": b"ok\r\n", b"$$\n": settings + flags}))
