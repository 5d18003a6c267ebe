"""The bench's own way with a bath (order of start and stop, watch, interlocks) through faults in
any order, every shipped profile.

Three things hold whatever happens. No reading that the bench takes is a wrong one. The heater is
not asked for heat for longer than the interlocks need where the bench knows that the pump stands or
the level is low, and can speak to the controller. And at the end, mended or not, the bath stands by
as soon as it answers.
"""

from __future__ import annotations

from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path

import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from bench.rig.emulated_rig import EmulatedRig
from bench.rig.loading import LoadedRig, load_rig
from bench.rig.opening import open_instruments
from bench.safety.bath_monitor import BathMonitor
from bench.safety.interlocks import Interlocks
from bench.safety.stability import StabilityGate
from instruments.bath.emulator import FAULTS, RELAY_FAULTS
from instruments.bath.sequence import heater_off, pump_on, start_bath
from instruments.clock import VirtualClock
from instruments.errors import InstrumentError
from tests.bench.rig.test_bath_profiles import rig_of
from tests.instruments.bath.devices import REGISTER_FAMILIES

NOT_TOLD = {"frozen sensor"}  # nobody can tell at once; its interlock takes two minutes
HEARD_S = 10.0  # a reading a second, a slow answer, and standby
FASTEST_K_PER_S = 1.9 / 60.0
DEAF = {"silence", "busy", "wrong length", "surplus", "late answer", "garbage", "bad CRC"}
DEAF |= {"gaps refused", "controller reset", "manual mode"}


def loaded(folder: Path, profile: str) -> LoadedRig:
    warm = "\n[emulation]\nbath_start_c = 30.0\n"
    return load_rig(rig_of(folder, profile, warm, relay="julabo" not in profile))


class WatchedBath(RuleBasedStateMachine):
    """A bench that heats, and everything that breaks."""

    rig: LoadedRig

    @initialize()
    def connect(self) -> None:
        rig = self.rig
        self.clock = VirtualClock()
        self.twin = EmulatedRig(rig, self.clock, seed=1)
        self.plant = self.twin.world.plant
        self.open = ExitStack()
        opened = open_instruments(rig, ("bath",), self.clock, twin=self.twin)
        self.bath = self.open.enter_context(opened).bath
        self.tripped = False
        self.wrong: list[str] = []
        self.dry_since_s: float | None = None
        gate = StabilityGate(set_point_c=33.0, window_s=60.0)
        interlocks = Interlocks(rig.rig.limits, rig.profile)
        acts = (self.clock, gate, interlocks, self.noted, self.made_safe)
        turns = partial(pump_on, self.bath)
        self.watch = BathMonitor(self.bath.read, *acts, pump_on=turns)
        self.watch.start()

    def noted(self, row: object) -> None:
        """What the bench takes for the bath's temperature is what the bath's sensor shows: a broken
        one shows nothing, for which a Eurotherm or a Watlow has its last value.
        """
        assert isinstance(row, dict)
        if "sensor break" in self.twin.bath.faults:
            return
        self.plant.advance_to(self.clock.now())
        late_s = self.clock.now() - row["t_s"]
        if abs(row["temp_c"] - self.plant.pv_c) > 0.08 + FASTEST_K_PER_S * late_s:
            self.wrong.append(f"{row['temp_c']} instead of {self.plant.pv_c}")

    def made_safe(self, trip: Exception) -> bool:
        self.tripped = True
        try:
            heater_off(self.bath)
        except InstrumentError:
            return False
        return True

    @rule(data=st.data(), on=st.booleans())
    def break_or_mend(self, data: st.DataObject, on: bool) -> None:
        no_sum = set() if self.twin.bath.framing == "rtu" else {"bad CRC"}
        fault = data.draw(st.sampled_from([f for f in FAULTS if f not in NOT_TOLD | no_sum]))
        with self.twin.world.lock:
            self.twin.bath.fault(fault, on=on)

    @precondition(lambda self: self.twin.pump)
    @rule(data=st.data(), on=st.booleans())
    def break_or_mend_the_relay(self, data: st.DataObject, on: bool) -> None:
        relay = self.twin.pump
        assert relay
        fault = data.draw(
            st.sampled_from([f for f in RELAY_FAULTS if f != "bad CRC" or relay.framing == "rtu"])
        )
        with self.twin.world.lock:
            relay.fault(fault, on=on)

    @precondition(lambda self: not self.tripped)
    @rule()
    def heat(self) -> None:
        with suppress(InstrumentError):
            start_bath(self.bath, 33.0, self.wait)
            self.watch.heating()

    @rule(seconds=st.sampled_from([0.3, 2.0, 15.0, 90.0]))
    def let_time_pass(self, seconds: float) -> None:
        self.wait(seconds)

    @rule()
    def stop(self) -> None:
        with suppress(InstrumentError):
            heater_off(self.bath)
            assert not self.plant.running

    def wait(self, seconds: float) -> None:
        """Second by second, looking at the plant in each."""
        end_s = self.clock.now() + seconds
        while self.clock.now() < end_s:
            self.clock.sleep(min(1.0, end_s - self.clock.now()))
            self.look()

    def look(self) -> None:
        self.plant.advance_to(self.clock.now())
        pump_stands = (
            not self.plant.pump_on and not self.plant.stopped_pump and not self.plant.level_low
        )
        level_told = self.plant.level_low and self.twin.bath.profile.capabilities.level == "alarm"
        asked_for_heat = self.plant.running and self.plant.output > 0.0
        broken = self.twin.bath.faults & DEAF or (self.twin.pump and self.twin.pump.faults)
        if not (asked_for_heat and (pump_stands or level_told)) or broken:
            self.dry_since_s = None
        elif self.dry_since_s is None:
            self.dry_since_s = self.clock.now()

    @invariant()
    def never_a_wrong_value(self) -> None:
        assert not getattr(self, "wrong", [])

    @invariant()
    def never_heat_without_pump_and_level(self) -> None:
        since_s = getattr(self, "dry_since_s", None)
        assert since_s is None or self.clock.now() - since_s < HEARD_S

    def teardown(self) -> None:
        if not hasattr(self, "watch"):
            return
        try:
            self.watch.stop()
            with self.twin.world.lock:
                for fault in self.twin.bath.faults & DEAF:
                    self.twin.bath.fault(fault, on=False)
                if self.twin.pump:
                    for fault in self.twin.pump.faults:
                        self.twin.pump.fault(fault, on=False)
            heater_off(self.bath)  # with whatever else is still broken
            assert not self.plant.running
            assert self.plant.output == 0.0
        finally:
            self.open.close()
            self.twin.close()


@pytest.mark.slow
@pytest.mark.parametrize("name", REGISTER_FAMILIES)
def test_any_order(name: str, tmp_path: Path) -> None:
    machine = type("Machine", (WatchedBath,), {"rig": loaded(tmp_path, name)})
    run_state_machine_as_test(
        machine,
        settings=settings(
            max_examples=3,
            stateful_step_count=12,
            deadline=None,
            phases=[Phase.explicit, Phase.reuse, Phase.generate],
            suppress_health_check=list(HealthCheck),
        ),
    )


@pytest.mark.slow
def test_the_machine_would_notice_heat_without_a_pump(tmp_path: Path) -> None:
    """The witness is one: interlocks without a pump miss a contact that falls off."""
    machine = WatchedBath()
    machine.rig = loaded(tmp_path, "eurotherm-3200")
    machine.connect()
    machine.watch.pump_on = lambda _: None
    machine.heat()
    assert machine.plant.running
    machine.plant.pump = "off"
    machine.wait(20.0)
    with pytest.raises(AssertionError):
        machine.never_heat_without_pump_and_level()
    machine.teardown()
