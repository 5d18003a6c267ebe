"""The heated circuit against its physics and the fact sheet's own simulation (section 5)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from instruments.world.optics import Floats
from instruments.world.plant import Plant, PlantConstants

CW_12_L = 49_800.0  # J/K
NO_CUT_OUT = PlantConstants(cut_out_c=1000.0)


def settled(constants: PlantConstants = NO_CUT_OUT) -> Plant:
    """Held at 33 degC for an hour."""
    return deepcopy(_settled(constants))


@cache
def _settled(constants: PlantConstants) -> Plant:
    plant = Plant(1, start_c=33.0, constants=constants)
    plant.run(33.0)
    plant.advance_to(3600.0)
    return plant


def later(plant: Plant, seconds: float) -> None:
    plant.advance_to(plant.t_s + seconds)


def stepped(plant: Plant, count: int) -> Iterator[Plant]:
    """The plant after each of so many steps."""
    for _ in range(count):
        later(plant, plant.constants.step_s)
        yield plant


def seconds_until(plant: Plant, done: Callable[[Plant], bool], at_most_s: float = 3600.0) -> float:
    start = plant.t_s
    while not done(plant):
        later(plant, plant.constants.step_s)
        assert plant.t_s - start < at_most_s
    return plant.t_s - start


TUNED = ("band_k", "integral_s", "derivative_s")


def heated(plant: Plant, minutes: float) -> tuple[Floats, Floats, Floats]:
    """Heating from 20 to 33 degC: time in minutes, measured and true temperature."""
    plant.run(33.0)
    steps = int(minutes * 60.0 / plant.constants.step_s)
    rows = [(p.t_s / 60.0, p.pv_c, p.bath_c) for p in stepped(plant, steps)]
    time_min, pv_c, bath_c = np.array(rows).T
    return time_min, pv_c, bath_c


def in_band_from(time_min: Floats, pv_c: Floats, band_k: float) -> float:
    """When the ten minutes begin in which the measured value never leaves the band."""
    window = round(10.0 / (time_min[1] - time_min[0]))
    inside = np.convolve(np.abs(pv_c - 33.0) <= band_k + 1e-9, np.ones(window), "valid")
    return float(time_min[np.argmax(inside == window)])


def test_steady_heat_in_is_heat_out_within_1_percent() -> None:
    plant = settled()
    heat_j = lost_j = 0.0
    bath_before, k = plant.bath_c, plant.constants
    for _ in stepped(plant, 7200):
        hoses_w = k.hose_loss_w_per_k * (plant.bath_c - 20.0) * 2
        teats_w = k.teat_out_w_per_k * float((plant.teat_c - 20.0).sum())
        heat_j += (plant.heat_w + k.pump_w) * 0.5
        lost_j += (k.loss_w_per_k * (plant.bath_c - 20.0) + hoses_w + teats_w) * 0.5
    stored_j = (plant.bath_c - bath_before) * CW_12_L
    assert heat_j == pytest.approx(lost_j + stored_j, rel=0.01)


def test_no_heat_is_lost_or_made_on_the_way() -> None:
    """Without losses, all that heater and pump give is in water and metal."""
    losses = ("loss_w_per_k", "hose_loss_w_per_k", "teat_out_w_per_k", "evaporation_g_per_h")
    plant = Plant(1, constants=replace(NO_CUT_OUT, **dict.fromkeys(losses, 0.0)))
    plant.run(60.0)
    plant.advance_to(300.0)
    plant.dead_heater = True
    plant.set_point_c = 0.0
    plant.advance_to(900.0)  # all is at one temperature but for the pump's heat
    hoses_j_per_k = 2 * 0.1 * 4154.0
    capacity = CW_12_L + 800.0 + 4 * 30.0 + hoses_j_per_k
    given_j = 300.0 * 1500.0 + 900.0 * 12.0
    assert (plant.bath_c - 20.0) * capacity == pytest.approx(given_j, rel=0.005)


def test_full_power_rate_of_12_l_with_1500_w() -> None:
    """Section 4.3: 1.2 K/min a kilowatt, so 1.8; losses and the heater's heat take under 6 %."""
    plant = Plant(1, constants=NO_CUT_OUT)
    plant.run(60.0)
    plant.advance_to(60.0)
    start_c = plant.bath_c
    plant.advance_to(240.0)
    assert plant.power_percent == 100.0
    assert (plant.bath_c - start_c) / 3.0 == pytest.approx(1.8, rel=0.06)


def test_free_cooling_has_the_time_constant_of_bath_and_loss() -> None:
    still = PlantConstants(evaporation_g_per_h=0.0)
    plant = Plant(1, start_c=33.0, constants=still)
    tau_s = CW_12_L / 3.0  # 4.6 h
    plant.advance_to(tau_s)
    assert not plant.pump_on
    # the heater's 800 J/K slow it by 1.6 %
    assert plant.bath_c - 20.0 == pytest.approx(13.0 * math.exp(-1.0), rel=0.02)


# Fact sheet, section 5: band K, integral s, derivative s; overshoot K, in +-0.1 K from, in +-0.05 K
# from (minutes).
@pytest.mark.parametrize(
    ("tuning", "overshoot_k", "within_100_mk_min", "within_50_mk_min"),
    [
        ((4.0, 240.0, 40.0), 0.99, 35.0, 37.0),
        ((4.0, 900.0, 40.0), 0.38, 40.0, 48.0),
        ((2.0, 600.0, 30.0), 0.16, 22.0, 29.0),
        ((1.0, 600.0, 20.0), 0.05, 8.7, 20.0),
        ((1.0, 1200.0, 20.0), 0.02, 8.9, 9.2),
    ],
)
def test_the_table_of_tunings_within_20_percent(
    tuning: tuple[float, float, float],
    overshoot_k: float,
    within_100_mk_min: float,
    within_50_mk_min: float,
) -> None:
    constants = replace(PlantConstants(), **dict(zip(TUNED, tuning, strict=True)))
    time_min, pv_c, bath_c = heated(Plant(1, constants=constants), 80.0)
    assert bath_c.max() - 33.0 == pytest.approx(overshoot_k, rel=0.2)
    assert in_band_from(time_min, pv_c, 0.1) == pytest.approx(within_100_mk_min, rel=0.2)
    assert in_band_from(time_min, pv_c, 0.05) == pytest.approx(within_50_mk_min, rel=0.2)


def test_steady_state_is_as_simulated() -> None:
    """Section 5: water sd 0.3 to 3 mK, output 2.6 %, teats 320 mK below the water."""
    plant = settled()
    plant.advance_to(7200.0)  # the integral is slow: 20 min, and the pump's heat came as a surprise
    bath_c, power = np.array([(p.bath_c, p.power_percent) for p in stepped(plant, 3600)]).T
    assert 0.0003 <= np.std(bath_c) <= 0.003
    assert np.mean(power) == pytest.approx(2.6, rel=0.05)
    assert plant.teat_c.shape == (4,)
    np.testing.assert_allclose(plant.teat_c - plant.bath_c, -0.320, atol=0.010)


@pytest.mark.parametrize("other", ["none", "level", "sensor"])
def test_the_cut_out_ends_a_stuck_heater_under_any_other_alarm_and_latches(other: str) -> None:
    plant = settled(constants=PlantConstants(cut_out_c=40.0))
    plant.stuck_heater = True
    plant.broken_sensor = other == "sensor"
    if other == "level":
        plant.fill(8.9)
    later(plant, 1600.0)
    assert plant.heat_w == 0.0
    assert plant.bath_c < 40.0
    if other == "none":
        assert (plant.alarm, plant.bath_c > 38.5) == ("over-temperature", True)  # cooling, at 4 K/h
        plant.acknowledge()
        plant.stuck_heater = False
        later(plant, 1.0)
        assert plant.alarm == ""


@pytest.mark.parametrize(
    ("fault", "more", "done", "seconds"),
    [
        ("stuck_heater", {}, lambda plant: plant.bath_c >= 38.0, 180.0),
        ("stuck_heater", {}, lambda plant: plant.bath_c >= 45.0, 428.0),
        ("dead_heater", {}, lambda plant: plant.bath_c <= 32.9, 143.0),
        ("stopped_pump", {"teat_j_per_k": 30.0}, lambda plant: plant.teat_c[0] <= 31.68, 54.0),
        ("stopped_pump", {"teat_j_per_k": 76.0}, lambda plant: plant.teat_c[0] <= 31.68, 138.0),
    ],
)
def test_how_soon_a_fault_shows(
    fault: str, more: dict[str, float], done: Callable[[Plant], bool], seconds: float
) -> None:
    """The bath runs away or cools by 0.1 K; the teats lose 1 K, from 0.32 K below the water."""
    plant = settled(constants=replace(NO_CUT_OUT, **more))
    setattr(plant, fault, True)
    assert seconds_until(plant, done) == pytest.approx(seconds, rel=0.05)
    assert plant.pump_on is (fault != "stopped_pump")
    if fault == "stuck_heater":
        assert plant.power_percent == 0.0  # the controller does not know


def test_low_level_stops_heater_and_pump_until_filled_and_acknowledged() -> None:
    plant = settled()
    plant.fill(8.9)
    later(plant, 1.0)
    assert (plant.alarm, plant.pump_on, plant.power_percent) == ("level", False, 0.0)
    plant.fill(12.0)
    later(plant, 1.0)
    assert plant.alarm == "level"
    plant.acknowledge()
    later(plant, 1.0)
    assert (plant.alarm, plant.pump_on) == ("", True)


def test_water_evaporates_26_g_an_hour() -> None:
    plant = Plant(1)
    plant.advance_to(2 * 3600.0)
    assert 12.0 - plant.level_l == pytest.approx(2 * 26.0 / 994.0, rel=1e-6)


def test_a_broken_sensor_and_standby_stop_the_heater() -> None:
    plant = settled()
    plant.broken_sensor = True
    later(plant, 1.0)
    assert (plant.alarm, plant.heat_w) == ("sensor", 0.0)
    plant = settled()
    plant.standby()
    later(plant, 0.5)
    assert (plant.running, plant.pump_on) == (False, False)
    assert (plant.power_percent, plant.heat_w) == (0.0, 0.0)


def test_a_ramp_and_an_output_limit_are_kept() -> None:
    plant = Plant(1, constants=PlantConstants(ramp_k_per_min=0.5))
    plant.run(33.0)
    plant.advance_to(600.0)
    assert plant.controlled_c == pytest.approx(25.0, abs=0.05)
    assert plant.bath_c == pytest.approx(25.0, abs=0.5)
    plant = Plant(1, constants=PlantConstants(output_max=0.4))
    plant.run(33.0)
    plant.advance_to(60.0)
    assert plant.power_percent == pytest.approx(40.0)


def test_hoses_delay_by_their_transit_time() -> None:
    """2 m of 8 mm bore at 1 L/min take 6 s (section 4.3), so the teats stay cold for so long."""
    constants = PlantConstants(loss_w_per_k=0.0, hose_loss_w_per_k=0.0, pump_w=0.0)
    plant = Plant(1, constants=replace(constants, sensor_noise_k=0.0))
    plant.set_flow(1.0)
    plant.bath_c = 33.0
    plant.run(33.0)
    plant.advance_to(6.0)
    np.testing.assert_array_equal(plant.teat_c, 20.0)
    plant.advance_to(7.0)
    assert (plant.teat_c > 20.1).all()


@pytest.mark.parametrize(
    ("flow_l_per_min", "drop_mk"), [(1.0, 62.0), (3.0, 21.0), (6.0, 10.0), (10.0, 6.0)]
)
def test_hoses_cool_the_water_as_tabled(flow_l_per_min: float, drop_mk: float) -> None:
    """Section 4.3, foamed hose at 33/20 degC; teats with no loss have the supply's temperature."""
    plant = settled(constants=PlantConstants(teat_out_w_per_k=0.0, flow_l_per_min=flow_l_per_min))
    assert (plant.bath_c - plant.teat_c[0]) * 1000.0 == pytest.approx(drop_mk, rel=0.05, abs=0.6)


def test_the_sensor_has_steps_of_10_mk_and_noise_of_4_mk() -> None:
    seen = np.array([plant.pv_c for plant in stepped(Plant(3), 4000)])
    np.testing.assert_allclose(np.round(seen * 100.0), seen * 100.0, atol=1e-9)
    assert np.std(seen) == pytest.approx(math.hypot(0.004, 0.010 / math.sqrt(12.0)), rel=0.15)


@given(looks=st.lists(st.floats(0.0, 300.0), max_size=20))
def test_how_often_somebody_looks_changes_nothing(looks: list[float]) -> None:
    watched, alone = Plant(5), Plant(5)
    for plant in (watched, alone):
        plant.run(33.0)
    for t_s in sorted(looks):
        watched.advance_to(t_s)
        assert watched.t_s <= t_s + 1e-9
    for plant in (watched, alone):
        plant.advance_to(300.25)
        plant.advance_to(5.0)  # time does not go back
    one, other = ((plant.pv_c, plant.bath_c, *plant.teat_c) for plant in (watched, alone))
    assert one == other
    assert watched.t_s == 300.0


def test_the_seed_is_the_noise() -> None:
    one, same, other = ([p.pv_c for p in stepped(Plant(seed), 200)] for seed in (1, 1, 2))
    assert one == same != other


def test_the_step_hardly_matters() -> None:
    plants = [Plant(1, constants=PlantConstants(step_s=step_s)) for step_s in (0.25, 1.0)]
    fine, coarse = (heated(plant, 20.0)[2][-1] for plant in plants)
    assert fine == pytest.approx(coarse, abs=0.02)


def controlled() -> Plant:
    """As `settled`, but with a controller of its own beside a pump with its own switch."""
    plant = Plant(1, start_c=33.0, constants=PlantConstants(cut_out_c=40.0))
    plant.fit(circulator=False)
    plant.pump = "on"
    plant.run(33.0)
    plant.advance_to(600.0)
    return plant


def test_a_pump_with_a_switch_of_its_own_turns_through_standby() -> None:
    plant, seen = controlled(), []
    for switch in ("on", "off"):
        plant.pump = switch
        plant.standby()
        seen.append(plant.pump_on)
        plant.run(33.0)
        seen.append(plant.pump_on)
    assert seen == [True, True, False, False]


def test_a_pump_that_is_never_switched_on_stands_and_the_teats_stay_cold() -> None:
    plant = Plant(1)
    plant.fit(circulator=False)
    plant.run(33.0)
    plant.advance_to(1800.0)
    assert not plant.pump_on
    assert plant.bath_c == pytest.approx(33.0, abs=0.3)
    np.testing.assert_allclose(plant.teat_c, 20.0, atol=1e-9)


def test_the_float_switch_cuts_a_heater_that_its_controller_still_calls_for() -> None:
    plant = controlled()
    plant.fill(8.9)
    later(plant, 1800.0)
    assert (plant.heat_w, plant.pump_on, plant.alarm) == (0.0, False, "level")
    assert plant.power_percent > 0.0
    plant.fill(12.0)
    later(plant, 1.0)
    assert (plant.pump_on, plant.alarm) == (True, "")
    assert plant.heat_w > 0.0


def test_a_controllers_broken_sensor_stops_the_heater_until_it_is_mended() -> None:
    plant = controlled()
    plant.set_point_c = 36.0
    plant.broken_sensor = True
    later(plant, 1.0)
    assert (plant.alarm, plant.heat_w) == ("sensor", 0.0)
    plant.broken_sensor = False
    later(plant, 1.0)
    assert (plant.alarm, plant.power_percent) == ("", 100.0)


def test_a_frozen_sensor_shows_what_it_showed_while_the_bath_goes_on() -> None:
    plant = controlled()
    plant.set_point_c = 36.0
    later(plant, 30.0)
    plant.frozen_sensor, shown_c, true_c = True, plant.pv_c, plant.bath_c
    later(plant, 60.0)
    assert plant.pv_c == shown_c
    assert plant.bath_c > true_c + 1.0
    assert plant.rate_k_per_min == 0.0
    plant.frozen_sensor = False
    later(plant, 30.0)
    assert plant.pv_c == pytest.approx(plant.bath_c, abs=0.3)


def test_a_loop_is_called_broken_when_full_output_does_nothing_for_2_minutes() -> None:
    plant, seen = controlled(), []
    plant.set_point_c = 36.0
    plant.dead_heater = True
    for seconds in (119.0, 2.0, 130.0):
        later(plant, seconds)
        seen.append(plant.loop_broken)
        plant.dead_heater = not plant.loop_broken
    assert seen == [False, True, False]


def test_heating_up_is_no_broken_loop() -> None:
    plant = Plant(1)
    plant.run(33.0)
    assert not any(plant.loop_broken for plant in stepped(plant, 1200))


def test_a_manual_output_is_held_and_capped() -> None:
    plant = controlled()
    plant.manual_output = 0.3
    later(plant, 1.0)
    assert plant.heat_w == pytest.approx(450.0)
    plant.output_max = 0.2
    later(plant, 1.0)
    assert plant.heat_w == pytest.approx(300.0)
    plant.standby()
    assert plant.heat_w == 0.0
