"""The heated circuit: what its controller knows of, and what works without it."""

from __future__ import annotations

import numpy as np
import pytest

from instruments.world.plant import Plant, PlantConstants
from tests.instruments.world.plants import settled


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


def test_a_pump_that_nobody_switches_stands_and_the_teats_stay_cold() -> None:
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
    plant.advance_to(plant.t_s + 1800.0)
    assert (plant.heat_w, plant.pump_on, plant.alarm) == (0.0, False, "level")
    assert plant.power_percent > 0.0
    plant.fill(12.0)
    plant.advance_to(plant.t_s + 1.0)
    assert (plant.pump_on, plant.alarm) == (True, "")
    assert plant.heat_w > 0.0


@pytest.mark.parametrize("fault", ["level", "sensor"])
def test_the_cut_out_ends_a_stuck_heater_under_any_other_alarm(fault: str) -> None:
    plant = settled(constants=PlantConstants(cut_out_c=40.0))
    plant.stuck_heater = True
    plant.broken_sensor = fault == "sensor"
    if fault == "level":
        plant.fill(8.9)
    plant.advance_to(plant.t_s + 1200.0)
    assert plant.heat_w == 0.0
    assert plant.bath_c < 40.0


def test_a_controllers_broken_sensor_stops_the_heater_until_it_is_mended() -> None:
    plant = controlled()
    plant.set_point_c = 36.0
    plant.broken_sensor = True
    plant.advance_to(plant.t_s + 1.0)
    assert (plant.alarm, plant.heat_w) == ("sensor", 0.0)
    plant.broken_sensor = False
    plant.advance_to(plant.t_s + 1.0)
    assert (plant.alarm, plant.power_percent) == ("", 100.0)


def test_a_frozen_sensor_shows_what_it_showed_while_the_bath_goes_on() -> None:
    plant = controlled()
    plant.set_point_c = 36.0
    plant.advance_to(plant.t_s + 30.0)
    plant.frozen_sensor, shown_c, true_c = True, plant.pv_c, plant.bath_c
    plant.advance_to(plant.t_s + 60.0)
    assert plant.pv_c == shown_c
    assert plant.bath_c > true_c + 1.0
    assert plant.rate_k_per_min == 0.0
    plant.frozen_sensor = False
    plant.advance_to(plant.t_s + 30.0)
    assert plant.pv_c == pytest.approx(plant.bath_c, abs=0.3)


def test_a_loop_is_called_broken_when_full_output_does_nothing_for_2_minutes() -> None:
    plant, seen = controlled(), []
    plant.set_point_c = 36.0
    plant.dead_heater = True
    for seconds in (119.0, 2.0, 130.0):
        plant.advance_to(plant.t_s + seconds)
        seen.append(plant.loop_broken)
        plant.dead_heater = not plant.loop_broken
    assert seen == [False, True, False]


def test_heating_up_is_no_broken_loop() -> None:
    plant = Plant(1)
    plant.run(33.0)
    for _ in range(1200):
        plant.advance_to(plant.t_s + 0.5)
        assert not plant.loop_broken


def test_a_manual_output_is_held_and_capped() -> None:
    plant = controlled()
    plant.manual_output = 0.3
    plant.advance_to(plant.t_s + 1.0)
    assert plant.heat_w == pytest.approx(450.0)
    plant.output_max = 0.2
    plant.advance_to(plant.t_s + 1.0)
    assert plant.heat_w == pytest.approx(300.0)
    plant.standby()
    assert plant.heat_w == 0.0
