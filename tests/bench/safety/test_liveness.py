"""Signs of life of a bath's sensor: a sound bath of every profile that ships gives them, one whose
sensor stands does not, whatever its controller then does.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest

from bench.rig.model import SafetyLimits
from bench.safety.interlocks import LIFELESS_S, Interlocks
from bench.safety.liveness import TURNS_WITHIN_S, Liveness
from bench.safety.stability import BathState, StabilityGate
from instruments.bath.profile import RegisterProfile, load_profile, profile_names
from instruments.bath.reading import BathReading
from instruments.bath.rows import Row
from instruments.world.plant import Plant, PlantConstants
from tests.bench.safety.calm import CALM
from tests.examples import few

pytestmark = pytest.mark.slow

SP = 33.0
FAMILIES = tuple(profile_names())


def kind_of(family: str) -> tuple[object, ...]:
    """What of a profile its signs of life depend on."""
    profile = load_profile(family)
    told = frozenset(row.name for row in profile.rows if row.poll) & {"power", "external"}
    return isinstance(profile, RegisterProfile), profile.row("temperature").step, told


KINDS = {kind_of(family): family for family in FAMILIES}


def readings(
    family: str, *, frozen_s: float, until_s: int, step_k: float | None = None
) -> Iterator[BathReading]:
    """What the bench reads of a bath that starts at its set point, in steps of the profile."""
    profile = load_profile(family)
    row = profile.row("temperature")
    step_k = row.step if step_k is None else step_k
    plant = Plant(5, start_c=SP, constants=PlantConstants(sensor_step_k=0.0))
    plant.pump = "on"
    plant.run(SP)
    named = {one.name for one in profile.rows if one.poll}
    for t in range(1, until_s):
        plant.frozen_sensor = t >= frozen_s
        plant.advance_to(float(t))
        temp_c = round(plant.pv_c / (step_k or 0.01)) * (step_k or 0.01)
        raw: tuple[int, ...] = tuple(f"{temp_c:.2f}".encode())
        if isinstance(row, Row) and isinstance(profile, RegisterProfile):
            raw = row.encode(temp_c, profile.order)
        yield replace(
            CALM,
            t_s=float(t),
            temp_c=temp_c,
            raw=raw,
            power_percent=round(plant.power_percent, 1) if "power" in named else None,
            external_c=round(float(plant.teat_c.mean()), 2) if "external" in named else None,
        )


@pytest.mark.parametrize("family", few(FAMILIES, 3))
def test_a_sound_bath_of_every_family_is_never_accused(family: str) -> None:
    profile = load_profile(family)
    gate, moving, interlocks = (
        StabilityGate(SP),
        Liveness(profile),
        Interlocks(SafetyLimits(), profile),
    )
    interlocks.heating(SP)
    for one in readings(family, frozen_s=1e9, until_s=5400):
        gate.add(one.t_s, one.temp_c, raw=moving(one))
        assert not gate.frozen, one.t_s
        assert interlocks.add(one) is None
    assert gate.state is BathState.STABLE


@pytest.mark.parametrize("family", KINDS.values())
@pytest.mark.parametrize("frozen_s", [0.0, 900.0])
def test_a_sensor_that_stands_closes_the_gate_and_trips_within_minutes(
    family: str, frozen_s: float
) -> None:
    profile = load_profile(family)
    gate, moving, interlocks = (
        StabilityGate(SP),
        Liveness(profile),
        Interlocks(SafetyLimits(), profile),
    )
    interlocks.heating(SP)
    closed_s = tripped_s = None
    for one in readings(family, frozen_s=frozen_s, until_s=int(frozen_s) + 900):
        state = gate.add(one.t_s, one.temp_c, raw=moving(one))
        if closed_s is None and one.t_s > frozen_s and state is not BathState.STABLE:
            closed_s = one.t_s
        if closed_s is not None and one.t_s > frozen_s + gate.frozen_s:
            assert state is not BathState.STABLE
        trip = interlocks.add(one)
        if trip and tripped_s is None:
            tripped_s = one.t_s
            assert trip.rule in ("lifeless reading", "frozen reading")
    assert closed_s is not None
    assert closed_s <= frozen_s + gate.frozen_s + TURNS_WITHIN_S
    if tripped_s is None:  # a coarse one that gives no heat
        assert moving.coarse
        assert one.power_percent == 0.0
    else:
        assert tripped_s <= frozen_s + LIFELESS_S + TURNS_WITHIN_S


def test_tenths_of_a_fine_family_are_found_by_the_readings() -> None:
    """Some models show tenths: a bath that stands still at them is not accused as long as the
    sensor at the teats moves, and the sensor's steps are seen while it heats.
    """
    moving = Liveness(load_profile("haake"))
    way = [replace(CALM, t_s=float(k), temp_c=30 + k / 10, raw=(k,)) for k in range(31)]
    signs = [moving(replace(one, power_percent=None)) for one in way]
    assert len(set(signs)) == len(way)
    assert moving.coarse
    still = replace(way[-1], power_percent=None)
    assert moving(replace(still, external_c=32.6)) != moving(replace(still, external_c=32.7))
    before = moving(replace(still, external_c=32.7))
    assert moving(replace(still, external_c=32.7)) == before


def test_an_output_that_only_integrates_is_no_sign_of_life() -> None:
    moving = Liveness(load_profile("omega-cn7"))
    rising = [moving(replace(CALM, power_percent=2.0 + k / 10)) for k in range(50)]
    assert len(set(rising)) == 1
    once = moving(replace(CALM, t_s=1.0, power_percent=2.0))
    assert once == rising[0], "it turns once where the sensor stops"
    turning = [moving(replace(CALM, t_s=2.0 + k, power_percent=2.0 + k % 2)) for k in range(10)]
    assert len(set(turning)) > 5
    late = moving(replace(CALM, t_s=100.0, power_percent=5.0))
    assert moving(replace(CALM, t_s=161.0, power_percent=4.0)) == late
