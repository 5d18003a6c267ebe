"""Jogs, and the bytes that the driver sends: golden lines typed from the fact sheet."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from instruments.errors import DeviceError, LimitError
from instruments.stage import protocol
from instruments.stage.emulator import GRBL_HAL
from tests.instruments.stage.stage_bench import Bench

Make = Callable[..., Bench]


class Heard:
    """Listens in on a link."""

    def __init__(self) -> None:
        self.bytes: list[bytes] = []

    def opened(self, url: str) -> None: ...
    def sent(self, data: bytes) -> None:
        self.bytes.append(data)

    def received(self, data: bytes) -> None: ...
    def closed(self, why: str = "") -> None: ...


def heard(bench: Bench) -> list[bytes]:
    """What the driver sends from now on."""
    tap = Heard()
    bench.stage._link._tap = tap
    return tap.bytes


def test_what_a_move_sends(bench: Bench) -> None:
    bench.stage.connect()
    sent = heard(bench)
    bench.stage.home()
    bench.stage.move_to(-1.5, -1, z_mm=-2.25, feed_mm_min=600)
    assert sent == [
        b"$H\n",
        b"?",
        b"?",
        b"G21G90G94G53G1X-1.5Y-1Z-2.25F600\n",
        b"?",
        b"?",
        b"G4P0\n",
        b"?",
    ]


def test_what_connecting_sends(bench: Bench) -> None:
    sent = heard(bench)
    bench.stage.connect()
    assert sent == [b"$I\n", b"$$\n"]


def test_what_jogs_holds_and_recovery_send(bench: Bench) -> None:
    stage = bench.homed()
    stage.move_to(-100, -100)
    sent = heard(bench)
    stage.jog(x_mm=50, y_mm=-0.5, feed_mm_min=600)
    stage.cancel_jog()
    assert [data for data in sent if data != b"?"] == [b"$J=G21G91X50Y-0.5F600\n", b"\x85"]
    sent.clear()
    stage.begin_move(-200, -100)
    stage.hold()
    stage.resume()
    stage.recover()
    assert [data for data in sent if data != b"?"] == [
        b"G21G90G94G53G1X-200Y-100F3000\n",
        b"!",
        b"~",
        b"\x18",
    ]


def test_a_jog_ends_where_it_should(bench: Bench) -> None:
    stage = bench.homed()
    stage.move_to(-100, -100)
    stage.jog(x_mm=-12.5, y_mm=3)
    assert stage.status().state == "Jog"
    stage.finish_move()
    assert bench.emulator.position_mm() == pytest.approx([-112.5, -97, -1])
    stage.jog(z_mm=-3, feed_mm_min=300)
    stage.finish_move()
    assert stage.position() == pytest.approx([-112.5, -97, -4])


def test_a_rotation_jogs_too(make: Make) -> None:
    bench = make(dialect=GRBL_HAL, axes="XYA")
    stage = bench.homed()
    stage.jog(a_deg=-45)
    stage.finish_move()
    assert stage.position() == pytest.approx([-1, -1, -1, -46])


def test_a_cancelled_jog_stands_and_keeps_the_position(bench: Bench) -> None:
    stage = bench.homed()
    stage.jog(x_mm=-200)
    bench.clock.sleep(1.0)
    stage.cancel_jog()
    place = bench.emulator.position_mm()
    bench.clock.sleep(10.0)
    assert bench.emulator.position_mm() == pytest.approx(place)
    assert -80 < place[0] < -20
    assert stage.homed
    assert stage.position() == pytest.approx(place, abs=0.005)
    stage.cancel_jog()
    stage.move_to(-5, -5)


@pytest.mark.parametrize("end", ["hold", "stop"])
def test_hold_and_stop_end_a_jog(bench: Bench, end: str) -> None:
    stage = bench.homed()
    stage.jog(x_mm=-200)
    bench.clock.sleep(1.0)
    getattr(stage, end)()
    assert stage.status().state == "Idle"
    with pytest.raises(LimitError, match="nothing to resume"):
        stage.resume()
    stage.move_to(-5, -5)


def test_a_jog_that_the_panel_ended_is_told_and_keeps_the_position(bench: Bench) -> None:
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


@pytest.mark.parametrize(
    "way",
    [
        {"x_mm": 1.001},
        {"x_mm": -299.001},
        {"y_mm": float("nan")},
        {"y_mm": float("inf")},
        {"z_mm": 5.0},
        {},
    ],
)
def test_a_jog_beyond_the_travel_is_refused_before_sending(
    bench: Bench, way: dict[str, float]
) -> None:
    stage = bench.homed()
    sent = heard(bench)
    with pytest.raises(LimitError):
        stage.jog(**way)
    assert set(sent) <= {b"?"}
    assert stage.homed


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


def test_no_jog_before_homing_or_on_top_of_a_move(bench: Bench) -> None:
    stage = bench.stage
    stage.connect()
    with pytest.raises(LimitError, match="no move before homing"):
        stage.jog(x_mm=-1)
    stage.home()
    stage.begin_move(-100, -1)
    with pytest.raises(LimitError, match="still under way"):
        stage.jog(x_mm=-1)
    stage.finish_move()
    stage.jog(x_mm=-100)
    for call in (stage.home, lambda: stage.begin_move(-5, -5), lambda: stage.jog(y_mm=-1)):
        with pytest.raises(LimitError, match="under way"):
            call()


def test_jog_lines() -> None:
    assert protocol.jog_line({"X": 5}, 600) == "$J=G21G91X5F600"
    assert protocol.jog_line({"Y": -0.0004, "A": 12.5}, 99.95) == "$J=G21G91Y0A12.5F99.95"
    with pytest.raises(LimitError):
        protocol.jog_line({"B": 1.0}, 100)
