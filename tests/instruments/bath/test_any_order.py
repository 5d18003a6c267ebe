"""Driver against emulator, every shipped profile, through faults in any order.

Never a wrong value, never a set point that nobody asked for, never a start against an alarm, and safe in the end.
"""

from __future__ import annotations

import threading
from contextlib import closing, suppress

import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule, run_state_machine_as_test

from instruments.bath.driver import Bath
from instruments.bath.emulator import FAULTS, BathEmulator, Framing
from instruments.bath.profile import load_profile, profile_names
from instruments.bath.reading import BathReading
from instruments.clock import VirtualClock
from instruments.errors import InstrumentError
from instruments.listener import Connection, Listener
from instruments.world.plant import Plant, PlantConstants

SET_POINTS = [20.0, 25.5, 33.0]
FASTEST_K_PER_S = 1.9 / 60.0  # full power; a stuck heater is no faster
SEES_NO_SENSOR_BREAK = {"watlow-pm-map1"}  # where it tells is only inferred, and so not polled
MOST_LOOKS = 10_000  # at one moment of virtual time
SCHEMES: dict[Framing, str] = {"tcp": "tcp", "rtu": "rtu+tcp"}


class MovingClock(VirtualClock):
    """Virtual time that notices when somebody waits for it and does not let it move: a hang, told at once."""

    def __init__(self) -> None:
        super().__init__()
        self._seen_s, self._looks = -1.0, 0

    def now(self) -> float:
        now_s = super().now()
        self._looks = self._looks + 1 if now_s == self._seen_s else 0
        self._seen_s = now_s
        if self._looks > MOST_LOOKS:
            self._looks = 0
            raise AssertionError(f"virtual time stands still at {now_s!r}")
        return now_s


class Cable(BathEmulator):
    """Knows who is connected, to pull the cable."""

    def __init__(self, plant: Plant, name: str, clock: VirtualClock) -> None:
        super().__init__(plant, load_profile(name), clock)
        self.hosts: set[Connection] = set()

    def connect(self, connection: Connection) -> None:
        super().connect(connection)
        self.hosts.add(connection)

    def disconnect(self, connection: Connection) -> None:
        super().disconnect(connection)
        self.hosts.discard(connection)


class BathInAnyOrder(RuleBasedStateMachine):
    """A bench that wants to heat, an operator who fills and mends, and everything that breaks."""

    profile = "julabo-presto"

    def __init__(self) -> None:
        super().__init__()
        self.clock = MovingClock()
        self.plant = Plant(1, constants=PlantConstants(sensor_noise_k=0.0))
        self.emulator = Cable(self.plant, self.profile, self.clock)
        self.faults = [fault for fault in FAULTS if fault != "bad CRC" or self.emulator.framing == "rtu"]
        self.lock = threading.RLock()
        self.listener = Listener(self.emulator, self.clock, lock=self.lock, name="bath")
        url = f"{SCHEMES[self.emulator.framing]}://127.0.0.1:{self.listener.port}"
        self.bath = Bath(url, self.emulator.profile, self.clock)

    @rule(data=st.data(), on=st.booleans())
    def break_or_mend(self, data: st.DataObject, on: bool) -> None:
        fault = data.draw(st.sampled_from(self.faults))
        with self.lock:
            self.emulator.fault(fault, on=on)

    @rule(late_s=st.sampled_from([0.3, 0.9, 1.1, 1.5, 2.2, 3.8, 6.0]))
    def late(self, late_s: float) -> None:
        self.emulator.late_s = late_s
        self.emulator.fault("late answer")

    @precondition(lambda self: self.emulator.faults)
    @rule()
    def mend_all(self) -> None:
        with self.lock:
            for fault in self.emulator.faults:
                self.emulator.fault(fault, on=False)
            self.plant.acknowledge()

    @rule()
    def pull_the_cable(self) -> None:
        with self.lock:
            for connection in list(self.emulator.hosts):
                connection.hang_up()

    @rule(seconds=st.sampled_from([0.2, 1.0, 7.0, 60.0, 600.0]))
    def wait(self, seconds: float) -> None:
        self.clock.sleep(seconds)

    @rule()
    def read(self) -> None:
        before_c, before_s = self.now_c(), self.clock.now()
        try:
            reading = self.bath.read()
        except InstrumentError:
            return
        took_s = self.clock.now() - before_s
        assert reading.temp_c == pytest.approx(before_c, abs=0.051 + FASTEST_K_PER_S * took_s)  # 0.1 K is what 16 bits resolve
        if self.plant.broken_sensor and self.profile not in SEES_NO_SENSOR_BREAK:
            assert reading.alarm

    @rule()
    def get(self) -> None:
        try:
            shown_c = self.bath.get("set_point")
        except InstrumentError:
            return
        if not {"fahrenheit", "word order"} & self.emulator.faults:  # a row alone shows nothing to doubt it by
            assert shown_c == pytest.approx(self.plant.set_point_c, abs=0.051)

    @rule(wanted_c=st.sampled_from(SET_POINTS))
    def start(self, wanted_c: float) -> None:
        self.plant.advance_to(self.clock.now())
        alarm = self.plant.alarm
        try:
            self.bath.start(wanted_c)
        except InstrumentError:
            return
        assert self.plant.running
        assert self.plant.set_point_c == pytest.approx(wanted_c, abs=0.051)
        assert self.plant.manual_output is None or "manual mode" in self.emulator.faults
        if self.emulator.profile.capabilities.level == "alarm":
            assert alarm == ""
            assert self.plant.pump_on or self.plant.stopped_pump or self.plant.level_low  # a level that fell just now is told a step later
        elif self.profile not in SEES_NO_SENSOR_BREAK:
            assert alarm != "sensor"

    @rule(wanted_c=st.sampled_from(SET_POINTS))
    def change_the_set_point(self, wanted_c: float) -> None:
        try:
            self.bath.set_point(wanted_c)
        except InstrumentError:
            return
        assert self.plant.set_point_c == pytest.approx(wanted_c, abs=0.051)

    @rule()
    def safe(self) -> None:
        began_s = self.clock.now()
        try:
            self.bath.safe()
        except InstrumentError:
            return
        finally:
            assert self.clock.now() - began_s < 30.0
        self.is_safe()

    @rule()
    def another_bench_cleans_up(self) -> None:
        other = Bath(self.bath.url, self.emulator.profile, self.clock, identify=False)
        try:
            other.safe()
        except InstrumentError:
            return
        finally:
            other.close()
        self.is_safe()

    @invariant()
    def nobody_asked_for_another_set_point(self) -> None:
        assert min(abs(self.plant.set_point_c - known_c) for known_c in SET_POINTS) < 0.051

    @invariant()
    def no_heat_where_no_water_is(self) -> None:
        assert not (self.plant.level_low and self.plant.heat_w)

    def now_c(self) -> float:
        self.plant.advance_to(self.clock.now())
        return self.plant.pv_c

    def once_mended(self) -> BathReading:
        """The first reading that comes; the first tries may still tell of what was broken."""
        for _ in range(2):
            with suppress(InstrumentError):
                return self.bath.read()
        return self.bath.read()

    def is_safe(self) -> None:
        assert not self.plant.running
        assert self.plant.output == 0.0

    def teardown(self) -> None:
        try:
            self.mend_all()
            self.bath.safe()
            self.is_safe()
            assert self.once_mended().temp_c == pytest.approx(self.now_c(), abs=0.051)
            assert not self.plant.running
        finally:
            self.bath.close()
            self.listener.close()


@pytest.mark.parametrize("name", profile_names())
def test_any_order(name: str) -> None:
    machine = type("Machine", (BathInAnyOrder,), {"profile": name})
    run_state_machine_as_test(
        machine,
        settings=settings(
            max_examples=15,
            stateful_step_count=20,
            deadline=None,
            phases=[Phase.explicit, Phase.reuse, Phase.generate],  # as found: to shrink a run that hangs takes minutes
            suppress_health_check=list(HealthCheck),
        ),
    )


def connected(name: str, clock: VirtualClock) -> tuple[Cable, Listener, Bath]:
    emulator = Cable(Plant(1, constants=PlantConstants(sensor_noise_k=0.0)), name, clock)
    listener = Listener(emulator, clock, lock=threading.RLock(), name="bath")
    return emulator, listener, Bath(f"{SCHEMES[emulator.framing]}://127.0.0.1:{listener.port}", emulator.profile, clock)


@pytest.mark.parametrize("start_s", [26.60000000000002, 28.600000000000012, 62.300000000000054])
def test_a_late_answer_stops_no_clock_whatever_the_rounding(start_s: float) -> None:
    """Times that the rule machine found: a deadline and a late answer, one step of rounding apart."""
    clock = MovingClock()
    emulator, listener, bath = connected("julabo-presto", clock)
    with closing(listener), closing(bath):
        clock.sleep(start_s - clock.now())
        emulator.late_s = 1.1
        emulator.fault("late answer")
        for _ in range(3):
            with suppress(InstrumentError):
                bath.get("set_point")
        assert clock.now() > start_s + 3.0


@pytest.mark.parametrize("name", ["watlow-pm-map1", "watlow-pm-map2"])
@pytest.mark.parametrize("temp_c", [20.01, 20.03, 25.07, 33.03])
def test_words_turned_behind_our_back_are_never_a_value(name: str, temp_c: float) -> None:
    """20.03 degC with its words the other way round is 0.06 degC, which a bath may have; the set point tells."""
    clock = MovingClock()
    emulator, listener, bath = connected(name, clock)
    with closing(listener), closing(bath):
        bath.set_point(25.5)
        emulator.plant.pv_c = temp_c
        assert bath.read().temp_c == pytest.approx(temp_c)
        emulator.fault("word order")
        with pytest.raises(InstrumentError):
            bath.read()
