"""What the driver makes of faults, alarms, and devices that are no stage."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import pytest

from instruments.errors import DeviceError, InstrumentError, LimitError, LinkError, ProtocolError
from instruments.stage.emulator import Fault
from tests.instruments.stage.stage_bench import GREETING, Bench, Parrot, meet

Make = Callable[..., Bench]


def test_an_alarm_in_a_move_is_a_sentence_and_asks_for_recovery_and_homing(bench: Bench) -> None:
    stage = bench.homed()
    bench.emulator.inject(Fault.LIMIT_HIT, 0.7)
    start = bench.clock.now()
    with pytest.raises(
        DeviceError, match=r"alarm 1: a limit switch was hit .*recover\(\) and home\(\)"
    ):
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
    assert bench.stage.status().state == "Alarm"  # asked while the board restarts
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


@pytest.mark.parametrize(
    ("greeting", "answers", "error", "sentence"),
    [
        (b"", {}, LinkError, "no welcome after a reset"),
        (b"", {b"\x18": b"\x06\x00\x15"}, ProtocolError, r"this is not GRBL.*06 00 15"),
        (b"START\r\nDONE\r\n", {}, ProtocolError, "this is not GRBL"),
        (b"\r\nGrbl 0.9j ['$' for help]\r\n", {}, DeviceError, "speaks another protocol"),
        (GREETING, {}, LinkError, r"no answer \(asked \$I"),
        (GREETING, {b"$I\n": b"error:3\r\n"}, DeviceError, "error 3"),
        (
            GREETING,
            {b"$I\n": b"ok\r\n", b"$$\n": b"ok\r\n"},
            ProtocolError,
            r"setting \$\d+ is not usable",
        ),
        (
            GREETING,
            {b"$I\n": b"ok\r\nok\r\n", b"$$\n": b"ok\r\n"},
            ProtocolError,
            "nothing was asked for",
        ),
        (GREETING, {b"$I\n": b"[MSG:x]\r\n" + GREETING}, DeviceError, "restarted by itself"),
        (
            GREETING,
            {b"$I\n": b"ALARM:77\r\n"},
            DeviceError,
            "alarm 77: an alarm that this program does not know",
        ),
    ],
)
def test_other_devices_are_refused(
    greeting: bytes, answers: Mapping[bytes, bytes], error: type[InstrumentError], sentence: str
) -> None:
    with pytest.raises(error, match=sentence) as caught:
        meet(Parrot(greeting, answers))
    assert str(caught.value).startswith("stage at socket://")


def test_a_stale_boot_message_before_the_welcome_is_no_obstacle(make: Make) -> None:
    settings = b"".join(
        b"$%d=%s\r\n" % (n, b"100.000")
        for n in (*range(100, 103), *range(110, 113), *range(120, 123), *range(130, 133))
    )
    flags = (
        b"$13=0\r\n$20=1\r\n$21=0\r\n$22=1\r\n$24=25.000\r\n$25=500.000\r\n$27=1.000\r\n$74=my"
        b" network\r\nok\r\n"
    )
    meet(
        Parrot(
            b"\xf0\xe0boot\r\nok\r\n" + GREETING, {b"$I\n": b"ok\r\n", b"$$\n": settings + flags}
        )
    )
