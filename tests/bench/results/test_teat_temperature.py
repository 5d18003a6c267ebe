"""The estimate of the teats' surface, against the figures of the bath's fact sheet (sections 4.3
and 5) and against the plant.
"""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.results.teat_temperature import TemperatureInputs, below_water_k, hose_drop_k, surface
from instruments.world.plant import Plant


@pytest.mark.parametrize(("film", "below_k"), [(300.0, 0.61), (600.0, 0.31), (1500.0, 0.13)])
def test_a_teat_sits_as_far_below_the_water_as_the_fact_sheet_says(
    film: float, below_k: float
) -> None:
    assert below_water_k(33.0, 20.0, film) == pytest.approx(below_k, abs=0.011)


def test_the_hose_takes_what_the_fact_sheet_says() -> None:
    # foamed, 6 L/min: 10 mK
    assert 1000.0 * hose_drop_k(33.0, 20.0) == pytest.approx(10.0, abs=0.5)


def test_the_estimate_is_the_teats_of_a_plant_at_rest() -> None:
    plant = Plant(1)
    plant.run(33.0)
    plant.advance_to(4000.0)
    found = surface([plant.pv_c], [], TemperatureInputs())
    assert found is not None
    assert found.how == "plant model"
    assert found.temp_c == pytest.approx(float(plant.teat_c.mean()), abs=0.02)


def test_its_uncertainty_is_the_film_first() -> None:
    found = surface([32.99, 33.01], [], TemperatureInputs())
    assert found is not None
    parts = {c.name: c.u_k for c in found.components}
    # half of 0.61 - 0.13, rectangular
    assert parts["film inside the teat"] == pytest.approx(0.24 / 3**0.5, abs=0.01)
    assert parts["change during the capture"] == pytest.approx(0.01 / 3**0.5)
    assert found.u_k == pytest.approx(sum(u**2 for u in parts.values()) ** 0.5)
    assert max(parts, key=lambda name: parts[name]) == "film inside the teat"


def test_a_sensor_at_the_phantom_is_believed_before_the_model() -> None:
    found = surface([33.0], [32.5, 32.7], TemperatureInputs(external_accuracy_k=0.05))
    assert found is not None
    assert found.temp_c == pytest.approx(32.6)
    assert found.how == "external sensor at the phantom"
    modelled = surface([33.0], [], TemperatureInputs())
    assert modelled is not None
    assert found.u_k < modelled.u_k


def test_without_a_reading_there_is_no_estimate() -> None:
    assert surface([], [], TemperatureInputs()) is None


@given(st.floats(min_value=-5.0, max_value=60.0), st.floats(min_value=-10.0, max_value=40.0))
def test_a_surface_lies_between_water_and_room(water_c: float, room_c: float) -> None:
    found = surface([water_c], [], TemperatureInputs(room_c=room_c))
    assert found is not None
    low, high = sorted((water_c, room_c))
    assert low - 1e-9 <= found.temp_c <= high + 1e-9
