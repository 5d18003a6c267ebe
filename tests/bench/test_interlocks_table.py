"""The table of interlocks, walked: each row trips, stays tripped whatever the bath does then, and resets when its condition holds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from bench.rig import RIGS, LoadedRig, load_rig
from bench.rig_tables import Limits
from bench.running.stability import StabilityGate
from bench.running.watch import Watch
from bench.safety.interlock_rules import RULES, rule_named
from bench.safety.interlocks import Interlocks, InterlockTrip, bath_of, moving_of
from bench.safety.latch import LatchedError, acknowledge, latch_path, read_latch, refuse_latched, set_latch
from instruments.bath.profile import load_profile
from instruments.bath.reading import BathReading
from instruments.clock import VirtualClock
from instruments.errors import LinkError

CALM = BathReading(t_s=0.0, temp_c=33.0, raw=(1, 2), external_c=None, power_percent=2.0, safety_c=None, alarm=0, warning=0, remote=True)
COLD = replace(CALM, power_percent=0.0)
FROM_S, TO_S = 200.0, 800.0  # the trouble comes and goes


@dataclass(frozen=True)
class Walk:
    """How a row is tripped (``trouble`` at a time, or what ``also`` finds), what keeps it from being reset, and what doesn't."""

    trouble: Callable[[float], BathReading]
    within_s: float
    stays: BathReading | None = None
    resets: BathReading = COLD
    also: bool = False


def silence(_: float) -> BathReading:
    raise LinkError("bath", "no answer", seconds=1.0)


WALKS = {
    "over-temperature": Walk(lambda t: replace(CALM, temp_c=37.1), 0.0, replace(COLD, temp_c=36.5)),
    "heat without pump or level": Walk(lambda t: replace(CALM, alarm=1), 0.0, CALM),
    "implausible reading": Walk(lambda t: replace(CALM, temp_c=-20.0), 0.0, replace(COLD, temp_c=-20.0)),
    "frozen reading": Walk(lambda t: replace(CALM, temp_c=32.8, power_percent=30.0), 121.0, replace(CALM, power_percent=30.0)),
    "rate": Walk(lambda t: replace(CALM, temp_c=33.0 - (t - FROM_S) * 4.5 / 60), 32.0, CALM),
    "loop break": Walk(lambda t: replace(CALM, temp_c=33.0 - (t - FROM_S) * 1e-4, power_percent=95.0), 121.0, CALM),
    "sensor disagreement": Walk(lambda t: replace(CALM, temp_c=33.0 + 0.01 * (t % 2), external_c=30.9), 11.0, CALM),
    "controller alarm": Walk(lambda t: replace(CALM, alarm=3), 0.0, replace(COLD, alarm=3)),
    "changed at the controller": Walk(lambda t: replace(CALM, running=False), 0.0, CALM),
    "communications lost": Walk(silence, 6.0, resets=CALM),
    "guardian lost": Walk(lambda t: CALM, 1.0, resets=CALM, also=True),
}


def test_every_row_is_walked() -> None:
    assert list(WALKS) == [rule.name for rule in RULES]


@pytest.fixture
def lab(tmp_path: Path) -> LoadedRig:
    for name in ("lab.example.toml", "calibration.toml"):
        (tmp_path / name).write_text((RIGS / name).read_text(encoding="utf-8"), encoding="utf-8")
    return load_rig(tmp_path / "lab.example.toml")


@pytest.mark.parametrize("name", WALKS)
def test_a_row_trips_latches_and_resets(name: str, lab: LoadedRig) -> None:
    walk = WALKS[name]
    trips = walked(walk)
    assert len(trips) == 1, "once, and it stays"
    at_s, trip = trips[0]
    assert isinstance(trip, InterlockTrip)
    assert (trip.rule, trip.then) == (name, rule_named(name).then)
    assert FROM_S <= at_s <= FROM_S + walk.within_s
    path = latch_path(lab)
    assert path is not None
    set_latch(path, trip, "runs/one")
    with pytest.raises(LatchedError, match=name):
        refuse_latched(lab)
    latch = read_latch(path)
    assert latch is not None
    assert latch.told["values"], "with what led to it"
    if walk.stays is not None:
        with pytest.raises(LatchedError, match="not yet"):
            acknowledge(lab, latch, walk.stays)
        assert path.exists()
    acknowledge(lab, latch, walk.resets)
    refuse_latched(lab)


def walked(walk: Walk) -> list[tuple[float, Exception]]:
    """What tripped and when, in a watched bath whose trouble comes and goes; a trip has to outlast it."""
    clock, acts = VirtualClock(), list[tuple[float, Exception]]()
    profile = load_profile("julabo-presto")
    interlocks = Interlocks(Limits(), bath_of(profile))

    def act(trip: Exception) -> bool:
        acts.append((clock.now(), trip))
        return True

    class Bath:
        def read(self) -> BathReading:
            t = clock.now()
            calm = replace(CALM, temp_c=33.0 + 0.01 * (t % 3))
            reading = walk.trouble(t) if FROM_S <= t < TO_S else calm
            return replace(reading, t_s=t, raw=(round(reading.temp_c * 1e4),))

    def also() -> InterlockTrip | None:
        lost = walk.also and clock.now() >= FROM_S
        return InterlockTrip("guardian lost", "it ended", rule_named("guardian lost").then, interlocks.values) if lost else None

    gate = StabilityGate(33.0)
    watch = Watch(Bath(), clock, gate, interlocks, lambda _: None, act, also=also, moving=moving_of(profile))
    watch.start()
    watch.heating()
    clock.sleep(TO_S + 300.0)
    with pytest.raises(InterlockTrip):
        watch.check()
    watch.stop()
    return acts


def test_what_a_rule_compared_with_is_among_its_values() -> None:
    (trip,) = [trip for _, trip in walked(WALKS["loop break"])]
    assert isinstance(trip, InterlockTrip)
    times = [float(str(row["t_s"])) for row in trip.values]
    assert times == sorted(times)
    assert FROM_S - 2.0 <= times[0] <= FROM_S, "the reading from which it has not risen"
    assert times[-1] - times[0] >= 120.0
    (stopped,) = [trip for _, trip in walked(WALKS["changed at the controller"])]
    assert isinstance(stopped, InterlockTrip)
    assert stopped.values[-1]["running"] is False


@pytest.mark.parametrize(("family", "alive"), [("julabo-presto", False), ("eurotherm-2400", False), ("omega-cn7", True)])
def test_only_a_coarse_temperature_may_stand_while_the_output_moves(family: str, alive: bool) -> None:
    moving = moving_of(load_profile(family))
    gate = StabilityGate(33.0)
    states = set()
    for t in range(1500):
        reading = replace(CALM, t_s=float(t), power_percent=float(t % 5))
        states.add(gate.add(reading.t_s, reading.temp_c, raw=moving(reading)).value)
    assert ("stable" in states) is alive
