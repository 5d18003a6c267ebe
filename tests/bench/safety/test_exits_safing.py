"""The order of start and stop, whoever's the pump is; and what each driver says that safe is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import pytest

from bench.record.reader import read_run
from bench.rig.by_hand import not_safe_text
from bench.rig.emulated_rig import EmulatedRig
from bench.rig.loading import find_rig, load_rig
from bench.rig.opening import open_instruments
from instruments.bath.driver import OwnBath
from instruments.bath.profile import Profile, load_profile
from instruments.bath.reading import BathReading
from instruments.bath.rows import Row
from instruments.bath.sequence import heater_off, pump_on, pump_text, run_pump_on, start_bath
from instruments.clock import VirtualClock
from instruments.errors import DeviceError, LinkError
from instruments.stage.driver import OwnStage
from tests.bench.killed_runs import Silent, start
from tests.bench.operated_runs import STAGE, files
from tests.bench.safety.calm import CALM

COLD = replace(CALM, temp_c=20.0, power_percent=0.0)


def profile(pump: Literal["none", "with run", "own"]) -> Profile:
    """A family whose pump has its own switch, told as a user's own profile would."""
    base = load_profile("julabo-presto")
    values = {"off": 0, "on": 1}
    message: dict[str, Any] = {
        "type": "u16",
        "evidence": "CERTAIN",
        "access": "rw",
        "values": values,
    }
    row = Row(name="pump", table="holding", address=500, **message)
    capabilities = base.capabilities.model_copy(update={"pump": pump})
    return base.model_copy(update={"capabilities": capabilities, "rows": (*base.rows, row)})


class Noted(OwnBath):
    """A bath without a wire that notes what it is told, and when."""

    def __init__(self, pump: Literal["none", "with run", "own"], alarm: int = 0) -> None:
        self.who = "bath"
        self.profile = profile(pump)
        self.clock = VirtualClock()
        self.alarm = alarm
        self.message: list[tuple[float, str]] = []
        self.values: dict[str, float] = {}

    def check_start(self, set_point_c: float) -> None:
        pass

    def note(self, what: str) -> None:
        self.message.append((self.clock.now(), what))

    def read(self) -> BathReading:
        self.note("look at the level")
        return replace(COLD, alarm=self.alarm)

    def get(self, name: str) -> float:
        return self.values[name]

    def set(self, name: str, value: float | str) -> None:
        self.values[name] = self.profile.row(name).values[str(value)]
        self.note(f"{name} {value}")

    def start(self, set_point_c: float) -> None:
        self.note(f"run at {set_point_c:g}")

    def safe(self) -> None:
        self.note("heater off")


def test_start_is_level_pump_ten_seconds_of_flow_then_run() -> None:
    bath = Noted("own")
    start_bath(bath, 33.0, bath.clock.sleep)
    assert bath.message == [(0.0, "look at the level"), (0.0, "pump on"), (10.0, "run at 33")]
    assert pump_on(bath, COLD) is True


def test_a_low_level_starts_neither_pump_nor_heater() -> None:
    bath = Noted("own", alarm=1)
    with pytest.raises(DeviceError, match="low level"):
        start_bath(bath, 33.0, bath.clock.sleep)
    assert [what for _, what in bath.message] == ["look at the level"]


def test_stop_is_heater_off_then_a_minute_of_pump_then_pump_off() -> None:
    bath = Noted("own")
    heater_off(bath)
    assert "60 s" in run_pump_on(bath, bath.clock.sleep, lambda: False)
    assert bath.message == [(0.0, "heater off"), (0.0, "pump on"), (60.0, "pump off")]


def test_a_relay_that_is_dead_is_reported_and_the_heater_is_off_all_the_same() -> None:
    class DeadRelay(Noted):
        def set(self, name: str, value: float | str) -> None:
            raise LinkError("pump", "no answer", seconds=1.0)

    bath = DeadRelay("own")
    assert "the pump could not be switched on: pump: no answer" in heater_off(bath)
    assert bath.message == [(0.0, "heater off")]


def test_somebody_in_a_hurry_leaves_the_pump_running_and_never_the_heater() -> None:
    bath = Noted("own")
    heater_off(bath)
    assert "cut short" in run_pump_on(bath, bath.clock.sleep, lambda: bath.clock.now() >= 5.0)
    assert bath.message == [(0.0, "heater off"), (0.0, "pump on")]


@pytest.mark.parametrize(
    ("pump", "message"), [("with run", "can't run on alone"), ("none", "not fitted")]
)
def test_a_pump_without_a_switch_is_not_pretended(
    pump: Literal["none", "with run"], message: str
) -> None:
    bath = Noted(pump)
    start_bath(bath, 33.0, bath.clock.sleep)
    heater_off(bath)
    assert run_pump_on(bath, bath.clock.sleep, lambda: False) == ""
    assert bath.message == [(0.0, "run at 33"), (0.0, "heater off")]
    assert message in pump_text(bath)


def test_a_pump_that_turns_with_run_is_on_when_the_controller_runs() -> None:
    for running in (True, False, None):
        assert pump_on(Noted("with run"), replace(COLD, running=running)) is running
    assert pump_on(Noted("none"), replace(COLD, running=True)) is None


@pytest.mark.slow
def test_every_driver_declares_its_safe_state_and_gets_there() -> None:
    with open_instruments(load_rig(find_rig(None)), seed=1) as devices:
        assert set(devices.safe_states()) == {"bath", "stage", "arm", "cameras"}
        assert all(devices.safe_states().values())
        devices.bath.start(33.0)
        message: list[str] = []
        assert devices.make_safe(message.append) == {}
        assert {"bath is safe", "stage is safe", "arm is safe"} <= set(message)
        assert devices.bath.read().running is False


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["silence", "busy", "wrong length", "late answer", "manual mode"])
def test_going_to_safe_is_bounded_in_time_and_goes_on_to_the_others(fault: str) -> None:
    """The bath is never reached or never obeys; stage and arm are safe within half a minute."""
    rig, clock = load_rig(find_rig(None)), VirtualClock()
    with (
        EmulatedRig(rig, clock, 1) as twin,
        open_instruments(rig, clock=clock, twin=twin) as devices,
    ):
        devices.bath.start(33.0)
        twin.bath.late_s = 3.0
        twin.bath.fault(fault)
        start_s, message = clock.now(), list[str]()
        unsafe = devices.make_safe(message.append)
        assert clock.now() - start_s < 30.0
        assert {"stage is safe", "arm is safe"} <= set(message)
        assert list(unsafe) == ["bath"], message
        assert not_safe_text(unsafe).startswith(
            "NOT SAFE: bath.\nSWITCH OFF THE BATH AT ITS MAINS: "
        )
        assert any("bath could not be made safe" in text for text in message)


@pytest.mark.slow
@pytest.mark.parametrize(
    "raised",
    [ValueError("a bug"), KeyboardInterrupt(), SystemExit(1)],
    ids=lambda e: type(e).__name__,
)
def test_each_step_to_safe_is_tried_whatever_the_others_raise(
    raised: BaseException, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One step after the other fails in a way that no driver should; what failed is told."""
    with open_instruments(load_rig(find_rig(None)), seed=1) as devices:
        for name in ("bath", "stage", "arm"):

            def fails(_: object) -> None:
                raise raised

            devices.bath.start(33.0)
            message: list[str] = []
            with monkeypatch.context() as patched:
                patched.setattr(type(getattr(devices, name)), "safe", fails)
                unsafe = devices.make_safe(message.append)
                assert list(unsafe) == ([] if name == "arm" else [name]), "the arm has no motor"
            others = {"bath", "stage", "arm"} - {name}
            assert {f"{other} is safe" for other in others} <= set(message)
            failed = f"{name} could not be made safe"
            if name == "arm":
                failed = "arm: its session was not ended; it has no motor"
            why, place = f"{failed}: {type(raised).__name__}", Path(__file__).name
            if isinstance(raised, KeyboardInterrupt):  # no mistake of the code
                why, place = f"{failed}: interrupted by Ctrl-C", "of its driver"
            assert any(text.startswith(why) and place in text for text in message)
            assert (devices.bath.read().running is False) is (name != "bath")


@pytest.mark.slow
def test_a_trip_switches_the_heater_off_whatever_braking_the_stage_raises(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    low_level = '[[emulation.faults]]\ninstrument = "bath"\nname = "low level"\nat_s = 45.0'
    files(tmp_path, stage=STAGE, emulation=f"prompt_s = 5.0\n{low_level}")

    def fails(_: OwnStage) -> None:
        raise ValueError("a bug")

    monkeypatch.setattr(OwnStage, "brake", fails)
    progress = Silent()
    record = read_run(start(tmp_path, progress=progress)[0])
    assert (record.ending, record.facts["trip"]["rule"]) == ("faulted", "controller alarm")
    assert record.facts["trip"]["done"][0].startswith(
        "stage could not be made safe: ValueError: a bug (test_exits_safing.py:"
    )
    assert record.facts["trip"]["done"][1] == "heater is in standby"
    assert any("stage could not be made safe" in text for text in progress.warned)
