"""Driver against emulators, every shipped profile, through faults in any order; a family without a pump has
a relay's.

Never a wrong value, never a set point that nobody asked for, never a start against an alarm or
without a pump, and safe in the end."""

from __future__ import annotations

import threading
from contextlib import suppress

import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from instruments.bath.driver import OwnBath, PumpAt
from instruments.bath.emulator import FAULTS, POWER_CUT, RELAY_FAULTS, RelayEmulator
from instruments.bath.profile import load_relay
from instruments.bath.reading import BathReading
from instruments.errors import InstrumentError
from instruments.listener import Listener
from tests.examples import examples
from tests.instruments.bath.devices import (
    REGISTER_FAMILIES,
    MovingClock,
    Stand,
    Watched,
    calm_plant,
    load_register_profile,
    url_of,
)

SET_POINTS = [20.0, 25.5, 33.0]
FASTEST_K_PER_S = 1.9 / 60.0  # full power; a stuck heater is no faster
SEES_NO_SENSOR_BREAK = {"watlow-pm-map1"}  # where it tells is only inferred, and so not polled


class BathInAnyOrder(RuleBasedStateMachine):
    """A bench that wants to heat, an operator who fills and mends, and everything that breaks."""

    profile = "julabo-presto"

    def __init__(self) -> None:
        super().__init__()
        self.clock = MovingClock()
        self.plant = calm_plant()
        self.emulator = Watched(self.plant, load_register_profile(self.profile), self.clock)
        self.faults = [
            fault for fault in FAULTS if fault != "bad CRC" or self.emulator.framing == "rtu"
        ]
        self.lock = threading.RLock()
        self.listener = Listener(self.emulator, self.clock, lock=self.lock, name="bath")
        url = url_of(self.emulator, self.listener)
        self.relay, self.relay_listener, pump = self.with_relay()
        self.relay_was_cut = False
        self.bath = OwnBath(url, self.emulator.profile, self.clock, pump=pump, unit_confirmed=True)

    def with_relay(self) -> tuple[RelayEmulator | None, Listener | None, PumpAt | None]:
        """A relay beside a controller without a pump."""
        if self.emulator.profile.capabilities.pump != "none":
            return None, None, None
        profile = load_relay("modbus-relay")
        relay = RelayEmulator(self.plant, profile, self.clock, framing=self.emulator.framing)
        listener = Listener(relay, self.clock, lock=self.lock, name="pump")
        return (relay, listener, PumpAt(url_of(relay, listener), profile))

    @rule(data=st.data(), on=st.booleans())
    def break_or_mend(self, data: st.DataObject, on: bool) -> None:
        fault = data.draw(st.sampled_from(self.faults))
        with self.lock:
            self.emulator.fault(fault, on=on)

    @precondition(lambda self: self.relay)
    @rule(data=st.data(), on=st.booleans())
    def break_or_mend_the_relay(self, data: st.DataObject, on: bool) -> None:
        relay = self.relay
        assert relay
        fault = data.draw(
            st.sampled_from([f for f in RELAY_FAULTS if f != "bad CRC" or relay.framing == "rtu"])
        )
        with self.lock:
            relay.fault(fault, on=on)
        self.relay_was_cut |= on and fault == POWER_CUT

    @precondition(lambda self: self.relay)
    @rule(label=st.sampled_from(["on", "off"]))
    def switch_the_pump(self, label: str) -> None:
        try:
            self.bath.set("pump", label)
        except InstrumentError:
            return
        assert self.plant.pump == label

    @precondition(lambda self: self.relay)
    @rule()
    def look_at_the_pump(self) -> None:
        try:
            shown = self.bath.get("pump")
        except InstrumentError:
            return
        assert shown == float(self.plant.pump == "on")

    @rule(late_s=st.sampled_from([0.3, 0.9, 1.1, 1.5, 2.2, 3.8, 6.0]))
    def late(self, late_s: float) -> None:
        self.emulator.late_s = late_s
        self.emulator.fault("late answer")

    @precondition(lambda self: self.emulator.faults or (self.relay and self.relay.faults))
    @rule()
    def mend_all(self) -> None:
        with self.lock:
            for fault in self.emulator.faults:
                self.emulator.fault(fault, on=False)
            if self.relay:
                for fault in self.relay.faults:
                    self.relay.fault(fault, on=False)
            self.plant.acknowledge()

    @rule()
    def pull_the_cable(self) -> None:
        with self.lock:
            self.emulator.pull_the_cable()

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
        # some controllers go on showing the last value: they have to tell, which is asked below
        if not self.plant.broken_sensor:
            # 0.1 K is what 16 bits resolve
            assert reading.temp_c == pytest.approx(before_c, abs=0.051 + FASTEST_K_PER_S * took_s)
        assert reading.set_point_c == pytest.approx(self.plant.set_point_c, abs=0.051)
        if self.plant.broken_sensor and self.profile not in SEES_NO_SENSOR_BREAK:
            assert reading.alarm

    @rule()
    def get_run(self) -> None:
        try:
            shown = self.bath.get("run")
        except InstrumentError:
            return
        codes = self.bath.profile.row("run")
        assert (shown == codes.values["standby"]) != self.plant.running

    @rule()
    def get(self) -> None:
        try:
            shown_c = self.bath.get("set_point")
        except InstrumentError:
            return
        # a row alone shows nothing to doubt it by
        if not {"fahrenheit", "word order"} & self.emulator.faults:
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
        assert self.relay is None or self.plant.pump == "on"
        self.relay_was_cut = False
        assert self.plant.set_point_c == pytest.approx(wanted_c, abs=0.051)
        assert self.plant.manual_output is None or "manual mode" in self.emulator.faults
        if self.emulator.profile.capabilities.level == "alarm":
            assert alarm == ""
            # a level that fell just now is told a step later
            assert self.plant.pump_on or self.plant.stopped_pump or self.plant.level_low
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
        other = OwnBath(self.bath.url, self.emulator.profile, self.clock, identify=False)
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

    @invariant()
    def no_heat_without_a_pump_but_by_a_power_cut(self) -> None:
        if self.relay and self.plant.running and not self.relay_was_cut:
            assert self.plant.pump == "on"

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
            if self.relay_listener:
                self.relay_listener.close()


@pytest.mark.slow
@pytest.mark.parametrize("name", REGISTER_FAMILIES)
def test_any_order(name: str) -> None:
    machine = type("Machine", (BathInAnyOrder,), {"profile": name})
    run_state_machine_as_test(
        machine,
        settings=settings(
            max_examples=examples(8),
            stateful_step_count=20,
            deadline=None,
            # as found: to shrink a run that hangs takes minutes
            phases=[Phase.explicit, Phase.reuse, Phase.generate],
            suppress_health_check=list(HealthCheck),
        ),
    )


def test_a_serial_device_answers_in_order() -> None:
    """A later answer can't overtake: the emulator let it, and a wrong set point was read."""
    machine = type("Machine", (BathInAnyOrder,), {"profile": "omega-cn7"})()
    try:
        for late_s, times in ((6.0, 3), (0.3, 1), (1.1, 1), (3.8, 1), (6.0, 3), (1.1, 1), (1.1, 1)):
            machine.late(late_s=late_s)
            for _ in range(times):
                machine.get()
    finally:
        machine.teardown()


@pytest.mark.parametrize("start_s", [26.60000000000002, 28.600000000000012, 62.300000000000054])
def test_a_late_answer_stops_no_clock_whatever_the_rounding(start_s: float) -> None:
    """Times that the rule machine found: deadline and late answer, one rounding step apart."""
    clock = MovingClock()
    with Stand(clock) as stand:
        bath = stand.bath()
        clock.sleep(start_s - clock.now())
        stand.emulator.late_s = 1.1
        stand.emulator.fault("late answer")
        for _ in range(3):
            with suppress(InstrumentError):
                bath.get("set_point")
        assert clock.now() > start_s + 3.0


@pytest.mark.parametrize("name", ["watlow-pm-map1", "watlow-pm-map2"])
@pytest.mark.parametrize("temp_c", [20.01, 20.03, 25.07, 33.03])
def test_words_turned_behind_our_back_are_never_a_value(name: str, temp_c: float) -> None:
    """20.03 degC with its words swapped is 0.06 degC, which a bath may have."""
    with Stand(MovingClock(), profile=load_register_profile(name)) as stand:
        bath = stand.bath()
        bath.set_point(25.5)
        stand.plant.pv_c = temp_c
        assert bath.read().temp_c == pytest.approx(temp_c)
        stand.emulator.fault("word order")
        with pytest.raises(InstrumentError):
            bath.read()
