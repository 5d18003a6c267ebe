"""A Zaber stage by its entry point, over its maker's library, on our emulated devices: as the bench
opens it, in virtual time but where a test says so. The library waits for an answer by its own clock."""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest

from bench.testing.conformance import CHECKS, Check, conform
from bench.testing.plugins import OnEmulator
from instruments.captures.capture import read_capture
from instruments.captures.replay import Replay
from instruments.clock import Clock, RealClock, VirtualClock
from instruments.drivers.entry_points import Plugin, PluginUrl, load
from instruments.drivers.stage import PluggedStage
from instruments.errors import DeviceError, InstrumentError, LimitError, LinkError
from instruments.listener import Listener
from instruments.stage.emulator import zaber as emulated
from instruments.stage.emulator.board import StageEmulator, StageFault
from instruments.stage.emulator.store import ZABER
from tests.instruments.bath.peers import foreign

foreign("zaber_motion", "zaber-motion")
from instruments.drivers import zaber  # noqa: E402 - which imports it

pytestmark = pytest.mark.slow

KEYS = {"devices": "1,2.1", "microsteps": "250,250"}
# 60 mm, homed quickly
QUICK = {24: 6000.0, 25: 12_000.0, 27: 1.0} | dict.fromkeys((110, 111, 112), 12_000.0)
QUICK |= dict.fromkeys((120, 121, 122), 2000.0) | dict.fromkeys((130, 131, 132), 60.0)


class Chain:
    """Emulated devices at a port, and the stage that is made of them."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.board = StageEmulator(clock, settings=QUICK, dialect=ZABER)
        self.listener = Listener(self.board, clock, lock=threading.RLock(), name="stage")
        plugged = Plugin("zaber", "here", zaber.ZaberStage, {**KEYS, "url": self.listener.url})
        self.stage = PluggedStage(plugged, clock, "XY")

    @property
    def controller(self) -> emulated.ZaberController:
        assert isinstance(self.board._controller, emulated.ZaberController)
        return self.board._controller

    def homed(self) -> PluggedStage:
        self.stage.connect()
        self.stage.home()
        return self.stage

    def close(self) -> None:
        self.stage.close()
        self.listener.close()


@pytest.fixture
def chain() -> Iterator[Chain]:
    with closing(Chain(VirtualClock())) as made:
        yield made


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_it_conforms_as_our_drivers_do(check: Check) -> None:
    with closing(RealClock()) as clock:
        plugged = Plugin("zaber", "here", zaber.ZaberStage, KEYS)

        def on_emulator() -> OnEmulator:
            board = StageEmulator(clock, settings=QUICK, dialect=ZABER)
            return OnEmulator("stage", plugged, clock, board)

        [found] = conform(on_emulator, (check,))
    assert found.outcome == "passed", found.why


def test_it_moves_within_its_travel_and_a_stop_keeps_its_place(chain: Chain) -> None:
    stage = chain.stage
    assert "firmware 7.38, 7.38" in str(stage.connect())
    assert (stage.limits["X"].low_mm, stage.limits["X"].high_mm) == (0.0, 59.0)
    with pytest.raises(LimitError, match="no move before homing"):
        stage.move_to(10.0, 20.0)
    stage.home()
    for beyond in (-0.01, 59.01):
        with pytest.raises(LimitError, match="outside the travel"):
            stage.move_to(beyond, 20.0)
    stage.move_to(10.0, 20.0, feed_mm_min=6000.0)
    assert chain.board.position_mm()[:2] == pytest.approx([10.0, 20.0], abs=0.003)
    begun_s = chain.clock.now()
    stage.begin_move(40.0, 20.0, feed_mm_min=600.0)
    chain.clock.sleep(1.0)
    stage.stop()
    assert chain.clock.now() - begun_s < 2.0
    x_mm = float(chain.board.position_mm()[0])
    assert 10.0 < x_mm < 40.0, "at 10 mm/s"
    chain.clock.sleep(10.0)
    assert stage.homed
    assert stage.position()[0] == pytest.approx(x_mm, abs=0.003)


@pytest.mark.parametrize(
    "flag", [*sorted({*zaber.FLAGS} & {*["FS", "FE", "FF", "FH", "WL", "WM", "WV", "WT"]}), "ZZ"]
)
def test_a_flag_that_is_not_harmless_costs_the_position(
    chain: Chain, monkeypatch: pytest.MonkeyPatch, flag: str
) -> None:
    stage = chain.homed()
    monkeypatch.setattr(emulated, "ORDER", (flag, *emulated.ORDER))
    chain.controller._flags[1].add(flag)
    with pytest.raises(DeviceError, match=rf"axis Y: .* \({flag}\)"):
        stage.move_to(50.0, 40.0)
    assert not stage.homed
    stage.recover()
    stage.home()
    stage.move_to(40.0, 50.0)
    assert stage.homed


def _restarts(chain: Chain) -> None:
    chain.controller.power_up()


def _limit(chain: Chain) -> None:
    chain.controller.alarm(1, critical=True)


@pytest.mark.parametrize("upset", [_restarts, _limit])
@pytest.mark.parametrize("moving", [False, True], ids=["at rest", "moving"])
def test_after_an_upset_it_is_believed_to_be_nowhere(
    chain: Chain, upset: Callable[[Chain], None], moving: bool
) -> None:
    stage = chain.homed()
    stage.move_to(10.0, 20.0)
    if moving:
        stage.begin_move(50.0, 20.0, feed_mm_min=600.0)
        chain.clock.sleep(1.0)
    upset(chain)
    with pytest.raises(InstrumentError):  # noqa: PT012 - whichever of them hears it first
        if moving:
            stage.finish_move()
        stage.move_to(11.0, 20.0)
    assert not stage.homed
    with pytest.raises(InstrumentError):
        stage.move_to(12.0, 20.0)
    stage.recover()
    stage.home()
    stage.move_to(10.0, 20.0)
    assert chain.board.position_mm()[:2] == pytest.approx([10.0, 20.0], abs=0.003)


@pytest.mark.parametrize("fault", [StageFault.LOST_OK, StageFault.DISCONNECT])
def test_after_a_lost_answer_it_is_homed_anew(
    chain: Chain, monkeypatch: pytest.MonkeyPatch, fault: StageFault
) -> None:
    stage = chain.homed()
    chain.board.inject(fault, 0.2)
    with pytest.raises(LinkError):
        stage.move_to(50.0, 20.0, feed_mm_min=600.0)
    assert not stage.homed
    chain.clock.sleep(10.0)
    stage.reconnect()
    with pytest.raises(LimitError, match="before homing"):
        stage.move_to(10.0, 20.0)
    stage.home()
    stage.move_to(10.0, 20.0)


def test_a_late_reply_is_not_taken_for_another_commands(chain: Chain) -> None:
    stage = chain.homed()
    chain.board._send(b"@01 1 98 OK IDLE -- 77777\r\n@01 1 OK IDLE -- 5\r\n!01 1 IDLE --\r\n")
    stage.move_to(50.0, 40.0)
    assert stage.position()[:2] == pytest.approx([50.0, 40.0], abs=0.003)


def test_homing_that_fails_is_told_and_one_that_goes_on_is_stopped(chain: Chain) -> None:
    chain.stage.connect()
    chain.board.inject(StageFault.NO_SWITCH)
    with pytest.raises(DeviceError):
        chain.stage.home()
    assert not chain.stage.homed
    chain.board.cure(StageFault.NO_SWITCH)

    def interrupt() -> None:
        raise KeyboardInterrupt

    chain.clock.call_at(chain.clock.now() + 0.1, interrupt)
    with pytest.raises(KeyboardInterrupt):
        chain.stage.home()
    for _ in range(3):
        chain.stage.safe()
    place = chain.board.position_mm()
    chain.clock.sleep(60.0)
    assert chain.board.position_mm() == pytest.approx(place)
    assert not chain.stage.homed


def test_a_parked_axis_is_refused_and_goes_on_after_homing(chain: Chain) -> None:
    stage = chain.homed()
    stage.move_to(40.0, 20.0)
    chain.controller._park(0, "park")
    chain.controller.power_up()
    assert chain.controller.place_mm()[0] == pytest.approx(40.0, abs=0.003)
    stage.recover()
    stage.home()
    chain.controller._park(0, "park")
    with pytest.raises(DeviceError, match=r"PARKED.* A parked axis is unparked by homing"):
        stage.move_to(50.0, 20.0)
    stage.home()
    stage.move_to(50.0, 20.0)


def test_a_move_of_older_firmware_has_its_speed_and_maxspeed_is_put_back(
    chain: Chain, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It refuses a move that has a speed of its own."""
    monkeypatch.setattr(emulated, "VERSION", "6.28")
    stage = chain.homed()
    stage.move_to(1.0, 1.0)
    found, begun_s = [*chain.controller._maxspeed], chain.clock.now()
    stage.begin_move(31.0, 1.0, feed_mm_min=600.0)
    assert chain.controller._maxspeed[0] == round(10.0 * 250 * 1.6384)
    stage.finish_move()
    assert 3.0 <= chain.clock.now() - begun_s < 4.0, "30 mm at 10 mm/s"
    assert chain.controller._maxspeed == found


def test_keys_that_do_not_fit_and_a_port_that_is_not_there_are_refused(chain: Chain) -> None:
    plugged = Plugin("zaber", "here", zaber.ZaberStage, {**KEYS, "url": chain.listener.url})
    for keys, kind, why in (
        ({"microsteps": "250"}, LimitError, "2 devices and 1 microsteps for the axes XY"),
        ({"microsteps": "250,0"}, LimitError, "Give one above 0"),
        ({"microsteps": "250,x"}, InstrumentError, "Correct the keys"),
        ({"url": "socket://127.0.0.1:9"}, LinkError, "connection"),
        ({"url": "/dev/no-such-port"}, LinkError, "no-such-port"),
    ):
        with pytest.raises(kind, match=why):
            PluggedStage(plugged.with_keys(**keys), chain.clock, "XY").connect()
    with pytest.raises(LinkError, match="not responded"):
        PluggedStage(plugged.with_keys(devices="1,9"), chain.clock, "XY").connect()


def test_two_stages_in_virtual_time_are_alike_to_the_last_bit() -> None:
    def moved() -> tuple[float, list[float]]:
        with closing(Chain(VirtualClock())) as chain:
            stage = chain.homed()
            for x_mm in (50.0, 1.0) * 3:
                stage.move_to(x_mm, 20.0, feed_mm_min=600.0)
            return chain.clock.now(), chain.board.position_mm().tolist()

    first, second = moved(), moved()
    assert first == second
    assert first[0] > 29.0, "six ways of 49 mm at 10 mm/s"


def test_without_the_makers_library_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [one for one in sys.modules if one.partition(".")[0] == "zaber_motion"]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.delitem(sys.modules, "instruments.drivers.zaber")
    with pytest.raises(LimitError, match=r"pip install 'teatbench\[zaber\]'"):
        load("stage", PluginUrl("zaber"))


def test_a_capture_of_our_former_driver_is_refused_by_what_was_asked_otherwise(
    tmp_path: Path,
) -> None:
    path = tmp_path / "capture.jsonl"
    lines: list[dict[str, object]] = [
        {"format": "teatbench capture", "version": 1, "wall_time": "2026-11-01"}
    ]
    asked = b"/01 0 01 get version:D8\n"
    for kind, data in (("sent", asked), ("received", b"@01 0 01 OK IDLE WR 7.38\r\n")):
        lines.append({"t_s": 0.1, "link": "stage", "event": kind, "data": data.hex()})
    lines.insert(1, {"t_s": 0.0, "link": "stage", "event": "opened", "url": "COM5"})
    path.write_text("".join(f"{json.dumps(line)}\n" for line in lines), encoding="utf-8")
    clock = VirtualClock()
    with Replay(read_capture(path), clock, fast=True) as replay:
        keys = {**KEYS, "url": replay.urls["stage"]}
        stage = PluggedStage(Plugin("zaber", "here", zaber.ZaberStage, keys), clock, "XY")
        with pytest.raises(LinkError):
            stage.connect()
        stage.close()
        assert "get version" in str(replay.mismatches[0])
