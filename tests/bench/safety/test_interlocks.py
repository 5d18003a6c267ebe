"""The table of interlocks, row by row: what trips, what doesn't, and what resets; figures typed from
the fact sheet, section 4.1. docs/safety.md says of the interlocks what the table does.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any, get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.rig.model import SafetyLimits
from bench.safety.interlocks import RULES, Interlocks, InterlockTrip
from instruments.bath.profile import CommsLoss, Profile, load_profile
from instruments.bath.reading import BathReading
from tests.bench.safety.calm import CALM
from tests.conftest import ROOT

Series = Callable[[int], BathReading]
PRESTO = load_profile("julabo-presto")


def without(*names: str) -> Profile:
    """A family that lacks these rows."""
    rows = tuple(row for row in PRESTO.rows if row.name not in names)
    return PRESTO.model_copy(update={"rows": rows})


def readings(at: Series, seconds: int, start_s: float = 0.0) -> list[BathReading]:
    """One a second; the raw value is the temperature's, as on a wire."""
    return [
        replace(reading, t_s=start_s + t, raw=(round(reading.temp_c * 1000),))
        for t in range(seconds)
        for reading in [at(t)]
    ]


def first_trip(
    at: Series,
    seconds: int = 600,
    *,
    bath: Profile = PRESTO,
    pump_on: bool | None = None,
    start_s: float = 0.0,
) -> InterlockTrip | None:
    interlocks = Interlocks(SafetyLimits(), bath)
    interlocks.heating(33.0)
    for reading in readings(at, seconds, start_s):
        trip = interlocks.add(reading, pump_on)
        if trip is not None:
            return trip
    return None


def wobbling(t: int) -> float:
    """A steady bath's last digit is never still."""
    return 0.01 * (t % 3)


def flat(**more: Any) -> Series:
    return lambda _: replace(CALM, **more)


def steady(temp_c: float = 33.0, **more: Any) -> Series:
    return lambda t: replace(CALM, temp_c=temp_c + wobbling(t), **more)


def at(second: int, **more: Any) -> Series:
    calm = steady()
    return lambda t: replace(calm(t), **(more if t == second else {}))


def at_power(temp_c: float, percent: float) -> BathReading:
    return replace(CALM, temp_c=temp_c, power_percent=percent)


def with_external(temp_c: float, external_c: float) -> BathReading:
    return replace(CALM, temp_c=temp_c, external_c=external_c)


HOT, DRY = "over-temperature", "heat without pump or level"
FROZEN, LOOP, DIFFER = "frozen reading", "loop break", "sensor disagreement"
ALARM, CHANGED = "controller alarm", "changed at the controller"
PATHS: dict[str, tuple[Series, tuple[str, float] | None]] = {
    "a calm bath": (steady(), None),
    "a steady bath that shows one value, hardly heated": (flat(), None),
    "heating at full power": (
        lambda t: at_power(min(33.0, 20.0 + t * 2.4 / 60), 100.0 if t < 320 else 3.0),
        None,
    ),
    "the safety sensor above 37 degC": (
        lambda t: replace(CALM, safety_c=33.0 if t < 9 else 37.5),
        (HOT, 9.0),
    ),
    "frozen at 21 % output": (flat(temp_c=25.0, power_percent=21.0), (FROZEN, 120.0)),
    "frozen just above 20 %": (flat(temp_c=25.0, power_percent=20.01), (FROZEN, 120.0)),
    "frozen at 20 % output": (flat(temp_c=25.0, power_percent=20.0), None),
    "frozen but for one reading in 119 s": (
        lambda t: at_power(25.0 + 0.01 * (t // 119), 50.0),
        None,
    ),
    "+3.9 K/min": (lambda t: replace(CALM, temp_c=25.0 + min(t, 100) * 3.9 / 60), None),
    "falling at 91 %": (
        lambda t: at_power(25.0 - t * 0.01 / 60 - wobbling(t), 91.0),
        (LOOP, 120.0),
    ),
    "falling at 90 %": (lambda t: at_power(25.0 - t * 0.01 / 60 - wobbling(t), 90.0), None),
    "falling just above 90 %": (lambda t: at_power(25.0 - t * 0.001, 90.01), (LOOP, 120.0)),
    "not rising at 100 %": (steady(20.0, power_percent=100.0), (LOOP, 120.0)),
    "not rising at 90 %": (steady(20.0, power_percent=90.0), None),
    "a heater that dies after five minutes of heating": (
        lambda t: at_power(20.0 + min(t, 300) * 2.4 / 60 - max(0, t - 300) * 0.001, 100.0),
        (LOOP, 420.0),
    ),
    "0.29 K/min, the weakest bath": (
        lambda t: at_power(20.0 + t * 0.29 / 60 + wobbling(t), 100.0),
        None,
    ),
    "risen by just 0.1 K at 91 %": (
        lambda t: at_power(0.0 if t < 60 else 0.1, 91.0),
        (LOOP, 120.0),
    ),
    "risen by 0.1 K after 100 s": (
        lambda t: at_power(20.0 + 0.1015 * (t >= 100) + 0.001 * (t % 2), 95.0),
        (LOOP, 220.0),
    ),
    "risen by less": (
        lambda t: at_power(20.0 + 0.0985 * (t >= 100) + 0.001 * (t % 2), 95.0),
        (LOOP, 120.0),
    ),
    "an external sensor 2.1 K away": (steady(external_c=30.9), (DIFFER, 129.0)),
    "a lagging sensor while heating": (lambda t: with_external(20.0 + t / 60, 17.0 + t / 60), None),
    "a pump that stops after settling, and a bath driven off its set point since": (
        lambda t: with_external(33.0 + wobbling(t) + (t > 310), 32.7 if t < 300 else 30.0),
        (DIFFER, 309.0),
    ),
    "settled half a kelvin away": (lambda t: with_external(33.5, 30.0), (DIFFER, 129.0)),
    "not settled beyond it": (lambda t: with_external(33.501, 30.0), None),
    "settled anew": (lambda t: with_external(33.6 if t == 60 else 33.0, 30.0), (DIFFER, 190.0)),
    "driven off just when it has settled": (
        lambda t: with_external(33.0 if t < 120 else 34.0, 33.0 if t < 120 else 30.0),
        (DIFFER, 129.0),
    ),
    "stopped by somebody else": (lambda t: replace(CALM, running=t < 60), (CHANGED, 60.0)),
    "another set point": (
        lambda t: replace(CALM, set_point_c=33.0 if t < 60 else 33.1),
        (CHANGED, 60.0),
    ),
    "a set point in tenths": (flat(set_point_c=33.04, running=True), None),
    "0.06 K from the set point": (flat(set_point_c=33.0595), None),
    "just above": (flat(set_point_c=33.0605), (CHANGED, 0.0)),
    "alarm 5": (at(60, alarm=5), (ALARM, 60.0)),
    "low level with the heater on": (at(60, alarm=1), (DRY, 60.0)),
    "low level with the heater off": (
        lambda t: replace(CALM, alarm=int(t == 60), power_percent=0.0),
        (ALARM, 60.0),
    ),
    "low level, hardly heated": (flat(alarm=1, power_percent=0.0005), (DRY, 0.0)),
    "low level while cooling": (flat(alarm=1, power_percent=-5.0), (ALARM, 0.0)),
    "low level, no output told": (flat(alarm=1, power_percent=None), (ALARM, 0.0)),
}


@pytest.mark.parametrize("what", PATHS)
@pytest.mark.parametrize("start_s", [0.0, 1000.0])
def test_when_each_rule_trips_and_when_not(what: str, start_s: float) -> None:
    path, expected = PATHS[what]
    trip = first_trip(path, start_s=start_s)
    seen = trip and (trip.rule, float(str(trip.values[-1]["t_s"])) - start_s)
    assert seen == expected


def test_a_bath_that_the_bench_has_not_started_may_stand_and_its_sensors_disagree() -> None:
    stands = replace(CALM, running=False, set_point_c=12.0, power_percent=0.0)
    for bath in (stands, with_external(33.0, 25.0)):
        interlocks = Interlocks(SafetyLimits(), PRESTO)
        for second in range(300):
            reading = replace(bath, t_s=float(second), raw=(33_000,))
            assert interlocks.add(reading) is None


@pytest.mark.parametrize(
    ("pump_on", "rule"), [(None, None), (True, None), (False, "heat without pump or level")]
)
def test_no_heat_while_the_pump_is_known_to_stand(pump_on: bool | None, rule: str | None) -> None:
    trip = first_trip(lambda t: replace(CALM, temp_c=33.0 + wobbling(t)), pump_on=pump_on)
    assert (trip.rule if trip else None) == rule
    assert first_trip(lambda t: replace(CALM, power_percent=0.0), pump_on=False) is None, (
        "a standing pump is no fault of a cold heater"
    )


def test_a_family_that_tells_no_output_has_rules_that_sleep_and_says_so() -> None:
    silent = Interlocks(SafetyLimits(), without("power", "external", "safety"))
    assert set(silent.inactive) == {
        "heat without pump or level",
        "frozen reading",
        "loop break",
        "sensor disagreement",
    }
    assert Interlocks(SafetyLimits(), PRESTO).inactive == ()


def test_a_trip_has_the_readings_that_led_to_it() -> None:
    trip = first_trip(lambda t: replace(CALM, temp_c=37.5 if t == 90 else 33.0 + wobbling(t)))
    assert trip is not None
    assert [row["t_s"] for row in trip.values] == [60.0, *(float(t) for t in range(81, 91))], (
        "and one of half a minute before"
    )
    untold = dict.fromkeys(("external_c", "safety_c", "running", "set_point_c"))
    seen = {"t_s": 90.0, "temp_c": 37.5, "power_percent": 2.0, "alarm": 0, "raw": [37500]}
    assert trip.values[-1] == seen | untold


@given(
    st.lists(st.floats(min_value=32.9, max_value=33.1), min_size=2, max_size=300),
    st.floats(min_value=0.0, max_value=20.0),
)
def test_a_bath_near_its_set_point_with_little_power_never_trips(
    temps: list[float], power: float
) -> None:
    interlocks = Interlocks(SafetyLimits(), PRESTO)
    for reading in readings(
        lambda t: replace(CALM, temp_c=temps[t], external_c=temps[t] - 0.3, power_percent=power),
        len(temps),
    ):
        assert interlocks.add(reading) is None


@pytest.mark.slow
@given(st.floats(min_value=37.01, max_value=1e4), st.integers(min_value=0, max_value=200))
def test_no_heat_above_the_limit_is_ever_missed(temp_c: float, after_s: int) -> None:
    trip = first_trip(
        lambda t: replace(CALM, temp_c=temp_c if t == after_s else 33.0 + wobbling(t)), after_s + 2
    )
    assert trip is not None
    assert trip.values[-1]["t_s"] == float(after_s)


def test_a_trip_says_how_long_it_lasted() -> None:
    """The heater dies after five minutes, and the rule compares with the last reading that rose."""
    trip = first_trip(
        lambda t: at_power(20.0 + min(t, 300) * 0.04 - max(0, t - 300) * 0.001, 100.0)
    )
    assert trip is not None
    assert trip.why == "the bath went from 32.00 to 31.88 degC in 120 s at 100 % output"


TEXT = (ROOT / "docs" / "safety.md").read_text(encoding="utf-8")


def rows(heading: str) -> list[tuple[str, ...]]:
    """The cells of the first table behind ``heading``."""
    part = TEXT[TEXT.index(heading) :]
    table = re.search(r"(?:^\|.*\n)+", part, re.MULTILINE)
    assert table is not None
    return [
        tuple(cell.strip() for cell in line.strip("|").split("|"))
        for line in table[0].strip().split("\n")[2:]
    ]


def plain(text: str) -> str:
    return (
        text.replace("`", "").replace("it", "bath_max_c")
        if text.endswith("below it")
        else text.replace("`", "")
    )


def test_the_table_is_the_program_s() -> None:
    assert [tuple(plain(cell) for cell in row) for row in rows("## Interlocks")] == [
        (r.name, r.trips, r.resets) for r in RULES
    ]
    assert all(rule.then.endswith(".") for rule in RULES), "what to do is a sentence"


def test_every_kind_of_lost_communication_is_explained() -> None:
    assert {row[0].strip("`") for row in rows("## When the computer dies")} == set(
        get_args(CommsLoss)
    )


def test_page_and_readme_say_plainly_what_it_is_not() -> None:
    readme = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
    assert "is no safety device" in " ".join(TEXT.split()[:40])
    assert "independent over-temperature cut-out" in TEXT
    assert "**A real Windows has not been tried.**" in TEXT
    assert re.search(r"The bench is no safety (device|function)", readme)
    assert re.search(r"independent, latching over-temperature cut-out", readme)
    assert "docs/safety.md" in readme
