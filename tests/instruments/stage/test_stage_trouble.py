"""What the driver makes of faults, alarms, and devices that are no stage. From each alarm there is one way out,
and somebody has to ask for it."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import pytest

from instruments.errors import DeviceError, InstrumentError, LimitError, LinkError, ProtocolError
from instruments.stage.emulator.board import StageFault
from instruments.stage.emulator.grbl import GrblController, Mode
from instruments.stage.emulator.store import CLASSIC, GRBL_HAL, Firmware
from instruments.stage.protocol import codes
from tests.instruments.stage.board import GREETING, Bench, Parrot, identify

Make = Callable[..., Bench]


@pytest.mark.parametrize(
    ("fault", "error", "what", "refusal"),
    [
        (StageFault.RESTART, DeviceError, "restarted by itself", "no move before homing"),
        (
            StageFault.LOST_OK,
            LinkError,
            r"no answer \(asked G21.*after 2 s\)",
            "is still outstanding",
        ),
        (
            StageFault.GARBAGE,
            ProtocolError,
            r"malformed answer: .*FF 00 3C 52 75 7C 1B",
            "no move before",
        ),
    ],
)
def test_a_fault_in_a_move_is_a_sentence_and_asks_for_recovery(
    make: Make, fault: StageFault, error: type[InstrumentError], what: str, refusal: str
) -> None:
    bench = make()
    stage = bench.homed()
    bench.emulator.inject(fault, 0.5)
    with pytest.raises(error, match=what):
        stage.move_to(-250, -250)
    assert stage.homed == (fault is StageFault.LOST_OK)
    with pytest.raises(InstrumentError, match=refusal):
        stage.home() if fault is StageFault.LOST_OK else stage.move_to(-5, -5)


def test_silence_in_a_move(bench: Bench) -> None:
    stage = bench.homed()
    stage.begin_move(-200, -200)
    bench.emulator.inject(StageFault.SILENT)
    with pytest.raises(LinkError, match="no status report"):
        stage.finish_move()
    start = bench.clock.now()
    with pytest.raises(LinkError, match="can't be stopped"):
        stage.stop()
    assert bench.clock.now() - start < 15
    assert not stage.homed


def test_a_cable_that_is_back_is_used_to_make_safe(bench: Bench) -> None:
    """It was out where nobody asked: the old link breaks when the stage is stopped."""
    stage = bench.homed()
    bench.emulator.inject(StageFault.DISCONNECT, 0.5)
    stage.begin_move(-200, -200)
    bench.clock.sleep(1.0)
    stage.safe()
    assert not stage.moves
    assert not stage.homed
    assert stage.status().name != "Run"


SETTINGS = b"".join(
    b"$%d=%s\r\n" % (n, b"100.000")
    for n in (24, 25, 27, *range(100, 103), *range(110, 113), *range(120, 123), *range(130, 133))
)
FLAGS = b"$13=0\r\n$20=1\r\n$21=0\r\n$22=1\r\n$74=my network\r\nok\r\n"
TOLD = {b"$I\n": b"ok\r\n", b"$$\n": SETTINGS + FLAGS}
HAL = b"\r\nGrblHAL 1.1f ['$' or '$HELP' for help]\r\n"


@pytest.mark.parametrize(
    ("greeting", "answers", "error", "sentence"),
    [
        (b"", {}, LinkError, "no welcome after a reset"),
        (b"", {b"\x18": b"\x06\x00\x15"}, ProtocolError, r"this is not GRBL.*06 00 15"),
        (b"START\r\nDONE\r\n", {}, ProtocolError, "this is not GRBL"),
        (b"\r\nGrbl 0.9j ['$' for help]\r\n", {}, DeviceError, "speaks another protocol"),
        (GREETING, {}, LinkError, r"no answer \(asked \$I"),
        (GREETING, {b"$I\n": b"error:3\r\n"}, DeviceError, "error 3"),
        (GREETING, TOLD | {b"$$\n": b"ok\r\n"}, ProtocolError, r"setting \$\d+ is not usable"),
        (GREETING, TOLD | {b"$I\n": b"ok\r\nok\r\n"}, ProtocolError, "nothing was asked for"),
        (GREETING, {b"$I\n": b"[MSG:x]\r\n" + GREETING}, DeviceError, "restarted by itself"),
        (
            GREETING,
            {b"$I\n": b"ALARM:77\r\n"},
            DeviceError,
            "77: an alarm that this program does not",
        ),
        (GREETING, {b"$I\n": b"ALARM:10\r\n"}, DeviceError, "10: .*two motors of one axis"),
        (HAL, {b"$I\n": b"ALARM:10\r\n"}, DeviceError, "10: .*emergency stop is pressed"),
    ],
)
def test_other_devices_are_refused(
    greeting: bytes, answers: Mapping[bytes, bytes], error: type[InstrumentError], sentence: str
) -> None:
    with pytest.raises(error, match=sentence) as caught:
        identify(Parrot(greeting, answers))
    assert str(caught.value).startswith("stage at socket://")


@pytest.mark.parametrize("said", [b"\xf0\xe0boot\r\nok\r\n", b"error:7\r\n$0=10\r\n$1=25\r\n"])
def test_what_a_board_says_before_its_welcome_is_no_obstacle(said: bytes) -> None:
    identify(Parrot(said + GREETING, TOLD))


def test_devices_that_speak_another_dialect_are_refused() -> None:
    with pytest.raises(InstrumentError, match=r"^stage at socket://"):
        identify(Parrot(b"nothing of the kind\r\n", {}), dialect="marlin")


@pytest.mark.parametrize(
    ("dialect", "code", "critical"),
    [
        *((CLASSIC, code, code % 2 == 0) for code in (1, 2)),
        *((GRBL_HAL, code, code % 2 == 1) for code in (*codes()["grblHAL alarms"], 2)),
    ],
)
def test_recovery_from_each_alarm_is_explicit(
    make: Make, dialect: Firmware, code: int, critical: bool
) -> None:
    bench = make(dialect=dialect)
    stage = bench.homed()
    controller = bench.emulator._controller
    assert isinstance(controller, GrblController)

    def strike() -> None:
        controller.alarm(code, critical=critical)
        bench.emulator._settle()

    at_s = bench.clock.now() + 1.0
    bench.clock.call_at(at_s, strike)
    with pytest.raises(DeviceError, match=rf"alarm {code}: .*A run homes it again"):
        stage.move_to(-250, -250)
    assert bench.clock.now() == pytest.approx(at_s)
    stage.stop()
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


def test_a_board_that_sleeps_has_to_be_homed(bench: Bench) -> None:
    stage = bench.homed()
    stage._dialogue.command("$SLP")
    with pytest.raises(LimitError, match="no move before homing"):
        stage.move_to(-60, -60)
    stage.recover()
    stage.home()
    stage.move_to(-60, -60)
