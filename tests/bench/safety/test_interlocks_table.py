"""The table of interlocks, walked: each row trips, is latched whatever the bath does then, and
resets when its condition holds; and what else keeps a run from starting.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path

import pytest

from bench.cli.main import main
from bench.config import ConfigError
from bench.rig.loading import RIGS, LoadedRig, find_rig, load_rig
from bench.rig.model import SafetyLimits
from bench.safety.bath_monitor import BathMonitor
from bench.safety.interlocks import RULES, Interlocks, InterlockTrip, rule_named
from bench.safety.latch import (
    LatchedError,
    acknowledge,
    latch_path,
    read_latch,
    refuse_latched,
    refuse_unknown_unit,
    refuse_untested_cut_out,
    set_latch,
)
from bench.safety.liveness import Liveness
from bench.safety.stability import StabilityGate
from bench.script.model import load_script
from instruments.bath.profile import load_profile
from instruments.bath.reading import BathReading
from instruments.clock import VirtualClock
from instruments.errors import LinkError
from tests.bench.safety.calm import CALM
from tests.conftest import ROOT

COLD = replace(CALM, power_percent=0.0)
PRESTO = load_profile("julabo-presto")
FROM_S, TO_S = 200.0, 900.0  # the trouble comes and goes


@dataclass(frozen=True)
class Walk:
    """How a row is tripped (``trouble`` at a time, or what ``also`` finds), what keeps it from
    being reset, and what doesn't.
    """

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
    "implausible reading": Walk(
        lambda t: replace(CALM, temp_c=-20.0), 0.0, replace(COLD, temp_c=-20.0)
    ),
    "frozen reading": Walk(
        lambda t: replace(CALM, temp_c=32.8, power_percent=30.0),
        121.0,
        replace(CALM, power_percent=30.0),
    ),
    "lifeless reading": Walk(lambda t: replace(CALM, temp_c=32.99), 602.0, CALM),
    "rate": Walk(lambda t: replace(CALM, temp_c=33.0 - (t - FROM_S) * 4.5 / 60), 32.0, CALM),
    "loop break": Walk(
        lambda t: replace(CALM, temp_c=33.0 - (t - FROM_S) * 1e-4, power_percent=95.0), 121.0, CALM
    ),
    "sensor disagreement": Walk(
        lambda t: replace(CALM, temp_c=33.0 + 0.01 * (t % 2), external_c=30.9), 11.0, CALM
    ),
    "controller alarm": Walk(lambda t: replace(CALM, alarm=3), 0.0, replace(COLD, alarm=3)),
    "changed at the controller": Walk(lambda t: replace(CALM, running=False), 0.0, CALM),
    "communications lost": Walk(silence, 6.0, resets=CALM),
    "guardian lost": Walk(lambda t: CALM, 1.0, resets=CALM, also=True),
}


def test_every_row_is_walked() -> None:
    assert list(WALKS) == [rule.name for rule in RULES]


def written(folder: Path, change: Callable[[str], str] = str) -> LoadedRig:
    """A lab's rig in ``folder``, its text changed."""
    (folder / "calibration.toml").write_bytes((RIGS / "calibration.toml").read_bytes())
    path = folder / "lab.example.toml"
    path.write_text(change((RIGS / path.name).read_text(encoding="utf-8")), encoding="utf-8")
    return load_rig(path)


@pytest.fixture
def lab(tmp_path: Path) -> LoadedRig:
    return written(tmp_path)


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
    assert path == lab.path.with_name("lab.example.tripped.json")
    set_latch(path, trip, "runs/one")
    set_latch(path, InterlockTrip("later", "later", "Other."), "runs/two")
    with pytest.raises(LatchedError) as caught:
        refuse_latched(lab)
    assert f"interlock {name}" in str(caught.value), "the first one stays"
    assert f"{trip.then} Then: teatbench bath acknowledge" in str(caught.value)
    latch = read_latch(path)
    assert latch is not None
    assert latch.content["values"], "with what led to it"
    if walk.stays is not None:
        with pytest.raises(LatchedError, match="not yet") as refused:
            acknowledge(lab, latch, walk.stays)
        assert f"It resets with: {rule_named(name).resets}." in str(refused.value)
        assert path.exists()
    acknowledge(lab, latch, walk.resets)
    assert read_latch(path) is None
    refuse_latched(lab)


def walked(walk: Walk) -> list[tuple[float, Exception]]:
    """What tripped and when, of a bath whose trouble comes and goes; a trip outlasts it."""
    clock, acts = VirtualClock(), list[tuple[float, Exception]]()
    interlocks = Interlocks(SafetyLimits(), PRESTO)

    def act(trip: Exception) -> bool:
        acts.append((clock.now(), trip))
        return True

    def read() -> BathReading:
        t = clock.now()
        calm = replace(CALM, temp_c=33.0 + 0.01 * (t % 3))
        reading = walk.trouble(t) if FROM_S <= t < TO_S else calm
        return replace(reading, t_s=t, raw=(round(reading.temp_c * 1e4),))

    def also() -> InterlockTrip | None:
        lost = walk.also and clock.now() >= FROM_S
        return (
            InterlockTrip(
                "guardian lost", "it ended", rule_named("guardian lost").then, interlocks.values
            )
            if lost
            else None
        )

    gate = StabilityGate(33.0)
    watch = BathMonitor(
        read, clock, gate, interlocks, lambda _: None, act, also=also, moving=Liveness(PRESTO)
    )
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


@pytest.mark.parametrize(
    ("family", "alive"), [("julabo-presto", False), ("eurotherm-2400", False), ("omega-cn7", True)]
)
def test_only_a_coarse_temperature_may_stand_while_the_output_moves(
    family: str, alive: bool
) -> None:
    moving = Liveness(load_profile(family))
    gate = StabilityGate(33.0)
    states = set()
    for t in range(1500):
        reading = replace(CALM, t_s=float(t), power_percent=float(t % 5))
        states.add(gate.add(reading.t_s, reading.temp_c, raw=moving(reading)).value)
    assert ("stable" in states) is alive


@pytest.mark.parametrize(("step_k", "alive"), [(0.05, False), (0.0501, True)])
def test_a_temperature_is_coarse_above_steps_of_a_twentieth_of_a_kelvin(
    step_k: float, alive: bool
) -> None:
    rows = tuple(
        row.model_copy(update={"type": "i16", "scale": step_k})
        if row.name == "temperature"
        else row
        for row in PRESTO.rows
    )
    moving = Liveness(PRESTO.model_copy(update={"rows": rows}))
    signs = [moving(replace(CALM, power_percent=power)) for power in (2.0, 3.0, 2.0, 3.0)]
    assert (signs[0] != signs[3]) is alive


LIMITS = {
    "set_point_c": "[22.0, 33.0]",
    "bath_max_c": "34.5",
    "bath_plausible_c": "[12.0, 38.0]",
    "bath_rate_k_per_min": "1.875",
    "bath_silence_s": "9.0",
    "sensors_differ_k": "0.75",
}
LOW_TOP = {"bath_plausible_c": "[12.0, 34.0]"}
SET_C, TINY = 30.0, 2**-20  # exact in floating point, as all figures here: 1.875 K/min is 2**-5 K/s


def with_limits(folder: Path, **changed: str) -> LoadedRig:
    """A rig file in ``folder`` none of whose limits is the default."""
    keys = "\n".join(f"{key} = {value}" for key, value in (LIMITS | changed).items())
    limits = f"[limits]\n{keys}\n"
    return written(folder, lambda text: f"{text[: text.index('[limits]')]}{limits}")


def first_trip(rig: LoadedRig, at: Callable[[int], BathReading]) -> tuple[str, int] | None:
    """The rule and the second of the first trip of a bath that was started at SET_C."""
    interlocks = Interlocks(rig.rig.limits, rig.profile)
    interlocks.heating(SET_C)
    for t in range(400):
        trip = interlocks.add(replace(at(t), t_s=float(t), raw=(t,)))
        if trip:
            return trip.rule, t
    return None


def always(temp_c: float = SET_C, **more: float) -> Callable[[int], BathReading]:
    return lambda _: replace(CALM, temp_c=temp_c, **more)  # type: ignore[arg-type]


def changing(from_c: float, k_per_s: float) -> Callable[[int], BathReading]:
    return lambda t: replace(CALM, temp_c=from_c + k_per_s * t)


@pytest.fixture(scope="module")
def limited(tmp_path_factory: pytest.TempPathFactory) -> LoadedRig:
    return with_limits(tmp_path_factory.mktemp("limited"))


@pytest.mark.parametrize(
    ("at", "expected"),
    [
        (always(34.5), None),
        (always(34.5 + TINY), ("over-temperature", 0)),
        (always(safety_c=34.5), ("sensor disagreement", 129)),
        (always(safety_c=34.5 + TINY), ("over-temperature", 0)),
        (always(external_c=34.5), ("sensor disagreement", 129)),
        (always(external_c=34.5 + TINY), ("over-temperature", 0)),
        (always(12.0), None),
        (always(12.0 - TINY), ("implausible reading", 0)),
        (changing(20.0, 2**-5), None),
        (changing(20.0, 2**-5 + TINY), ("rate", 30)),
        (changing(32.0, -(2**-5)), None),
        (changing(32.0, -(2**-5) - TINY), ("rate", 30)),
        (always(external_c=SET_C - 0.75), None),
        (always(external_c=SET_C - 0.75 - TINY), ("sensor disagreement", 129)),
        (always(safety_c=SET_C + 0.75), None),
        (always(safety_c=SET_C + 0.75 + TINY), ("sensor disagreement", 129)),
    ],
)
def test_each_limit_of_a_rig_file_holds_on_both_sides(
    at: Callable[[int], BathReading], expected: tuple[str, int] | None, limited: LoadedRig
) -> None:
    assert first_trip(limited, at) == expected


def test_the_highest_plausible_temperature_holds_on_both_sides(tmp_path: Path) -> None:
    rig = with_limits(tmp_path, **LOW_TOP)
    assert first_trip(rig, always(34.0)) is None
    assert first_trip(rig, always(34.0 + TINY)) == ("implausible reading", 0)


@pytest.mark.parametrize("answered", [False, True])
def test_the_silence_of_a_rig_file_holds_on_both_sides(answered: bool, limited: LoadedRig) -> None:
    gone, interlocks = LinkError("bath", "no answer"), Interlocks(limited.rig.limits, PRESTO)
    assert interlocks.silent(9.0 - TINY, gone, answered=answered) is None
    trip = interlocks.silent(9.0, gone, answered=answered)
    assert trip is not None
    assert trip.rule == ("implausible reading" if answered else "communications lost")
    assert answered or "may have heated" in str(trip)
    assert ("no usable reading" in str(trip)) is answered


HOT, DISAGREE, BROKEN = "over-temperature", "sensor disagreement", "implausible reading"


@pytest.mark.parametrize(
    ("rule", "reading", "resets"),
    [
        (HOT, replace(COLD, temp_c=33.5 - TINY), True),
        (HOT, replace(COLD, temp_c=33.5), False),
        (HOT, replace(COLD, safety_c=33.5), False),
        (HOT, replace(COLD, external_c=33.5), False),
        (BROKEN, replace(COLD, temp_c=12.0), True),
        (BROKEN, replace(COLD, temp_c=12.0 - TINY), False),
        (BROKEN, replace(COLD, temp_c=38.0), True),
        (BROKEN, replace(COLD, temp_c=38.0 + TINY), False),
        ("rate", replace(COLD, temp_c=38.0 + TINY), False),
        ("loop break", replace(COLD, temp_c=12.0 - TINY), False),
        (DISAGREE, replace(COLD, temp_c=12.0 - TINY), False),
        ("changed at the controller", replace(COLD, temp_c=38.0 + TINY), False),
        ("frozen reading", replace(CALM, power_percent=20.0), True),
        ("frozen reading", replace(CALM, power_percent=20.0 + TINY), False),
        ("frozen reading", replace(CALM, power_percent=None), True),
        ("heat without pump or level", COLD, True),
        ("heat without pump or level", replace(CALM, power_percent=TINY), False),
        ("rate", replace(CALM, power_percent=TINY), False),
        ("rate", replace(CALM, power_percent=None), True),
    ],
)
def test_what_a_rig_file_allows_to_reset(
    rule: str, reading: BathReading, resets: bool, limited: LoadedRig
) -> None:
    path = latch_path(limited)
    assert path is not None
    path.unlink(missing_ok=True)
    set_latch(path, InterlockTrip(rule, "", ""), "runs/one")
    latch = read_latch(path)
    assert latch is not None
    if resets:
        acknowledge(limited, latch, reading)
    else:
        with pytest.raises(LatchedError, match="not yet"):
            acknowledge(limited, latch, reading)
    assert path.exists() is not resets


@pytest.mark.parametrize(
    ("changed", "fault"),
    [
        ({"bath_max_c": "40.0"}, ""),
        ({"bath_max_c": "40.000001"}, "less than or equal to 40"),
        ({"set_point_c": "[22.0, 34.499999]"}, ""),
        ({"set_point_c": "[22.0, 34.5]"}, "which bath_max_c = 34.5 would trip on"),
        ({"bath_plausible_c": "[12.0, 12.000001]"}, ""),
        ({"bath_plausible_c": "[12.0, 12.0]"}, "the first number must be the smaller one"),
        ({"bath_rate_k_per_min": "0.0"}, "greater than 0"),
        ({"bath_silence_s": "0.0"}, "greater than 0"),
        ({"sensors_differ_k": "0.0"}, "greater than 0"),
        ({"detection_timeout_s": "0.0"}, "greater than 0"),
        ({"away_s": "0.0"}, ""),
        ({"away_s": "-0.000001"}, "greater than or equal to 0"),
        ({"away_s": "86400.0"}, ""),
        ({"away_s": "86400.000001"}, "less than or equal to 86400"),
    ],
)
def test_which_limits_a_rig_file_may_have(
    changed: dict[str, str], fault: str, tmp_path: Path
) -> None:
    if not fault:
        with_limits(tmp_path, **changed)
        return
    with pytest.raises(ConfigError, match=re.escape(fault)):
        with_limits(tmp_path, **changed)


def test_a_script_may_ask_for_what_the_rig_file_allows(
    short_script: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text, rig = short_script.read_text(encoding="utf-8"), with_limits(tmp_path)
    script, out = tmp_path / "script.toml", str(tmp_path / "runs")
    for set_point_c, allowed in {22.0: 1, 21.999999: 0, 33.0: 1, 33.000001: 0}.items():
        line = f"set_point_c = {set_point_c}"
        script.write_text(re.sub("(?m)^set_point_c = .*$", line, text), encoding="utf-8")
        if allowed:
            load_script(script, rig.rig.limits.set_point_c)
        else:
            assert main(["run", str(script), "--rig", str(rig.path), "--out", out]) == 2
            assert "outside what the rig allows (22 to 33 degC)" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["", "{", "[]", '{"rule": "of another bench"}'])
def test_a_latch_that_cannot_be_understood_latches_all_the_same(lab: LoadedRig, text: str) -> None:
    path = latch_path(lab)
    assert path is not None
    path.write_text(text, encoding="utf-8")
    with pytest.raises(LatchedError):
        refuse_latched(lab)
    latch = read_latch(path)
    assert latch is not None
    acknowledge(lab, latch, CALM)
    refuse_latched(lab)


def test_a_mistake_of_the_bench_latches_too(lab: LoadedRig) -> None:
    path = latch_path(lab)
    assert path is not None
    set_latch(path, ZeroDivisionError("division by zero"), "runs/one")
    with pytest.raises(LatchedError, match="ZeroDivisionError"):
        refuse_latched(lab)


def test_an_emulated_rig_has_no_latch() -> None:
    assert latch_path(load_rig(find_rig(None))) is None


TODAY = date(2026, 11, 22)


def with_bath(folder: Path, profile: str, tested: str) -> LoadedRig:
    """A lab's rig with another bath."""

    def change(text: str) -> str:
        text = text.replace('"julabo-presto"', f'"{profile}"')
        return text.replace('cut_out_tested = ""', f'cut_out_tested = "{tested}"')

    return written(folder, change)


@pytest.mark.parametrize(("profile", "loss"), [("julabo-presto", "hold"), ("omega-cn7", "unknown")])
def test_a_bath_that_may_stay_hot_needs_a_tested_cut_out(
    profile: str, loss: str, lab: LoadedRig, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError) as caught:
        refuse_untested_cut_out(with_bath(tmp_path, profile, ""), TODAY)
    said = str(caught.value)
    assert f'comms_loss = "{loss}"' in said
    assert said.startswith(f"{lab.path}: 1 fault\n{lab.path}:")
    assert 'write the day: cut_out_tested = "2026-11-22"' in said
    refuse_untested_cut_out(with_bath(tmp_path, profile, "2026-11-22"), TODAY)


@pytest.mark.parametrize("loss", ["stop", "safe_setpoint"])
def test_a_bath_that_stops_by_itself_needs_none(loss: str, lab: LoadedRig, tmp_path: Path) -> None:
    shipped = ROOT / "instruments" / "bath" / "profiles" / "julabo-presto.toml"
    text = shipped.read_text(encoding="utf-8").replace(
        'comms_loss = "hold"', f'comms_loss = "{loss}"'
    )
    (tmp_path / "own.toml").write_text(text, encoding="utf-8")
    refuse_untested_cut_out(with_bath(tmp_path, "own.toml", ""), TODAY)


def test_an_emulated_rig_has_no_cut_out() -> None:
    refuse_untested_cut_out(load_rig(find_rig(None)), TODAY)


@pytest.mark.parametrize("profile", ["haake", "lauda-ascii", "watlow-pm-map2"])
def test_a_bath_that_does_not_tell_its_unit_needs_a_person(profile: str, tmp_path: Path) -> None:
    rig = with_bath(tmp_path, profile, "2026-11-22")
    with pytest.raises(ConfigError, match='write the day: unit_confirmed = "2026-11-22"'):
        refuse_unknown_unit(rig, TODAY)
    text = rig.path.read_text(encoding="utf-8")
    rig.path.write_text(
        text.replace('unit_confirmed = ""', 'unit_confirmed = "2026-11-22"'), encoding="utf-8"
    )
    refuse_unknown_unit(load_rig(rig.path), TODAY)


def test_one_that_tells_it_needs_none(lab: LoadedRig) -> None:
    refuse_unknown_unit(lab, TODAY)
    refuse_unknown_unit(load_rig(find_rig(None)), TODAY)


HANDS, FAR_HANDS = "emulator://127.0.0.1:5001", "emulator://192.168.0.9:5001"


@pytest.mark.parametrize(
    ("bath", "operator", "emulated"),
    [
        ("tcp://127.0.0.1:1502", HANDS, True),  # as `emulate --write-rig` writes it
        ("rtu+tcp://127.0.0.1:1502?unit=3", HANDS, True),
        ("tcp://[::1]:1502", HANDS, True),
        ("tcp://localhost:1502", HANDS, True),
        ("/dev/pts/7", HANDS, True),
        ("tcp://192.168.0.40:502", HANDS, False),
        ("rtu+tcp://bath.lab:4001", HANDS, False),
        ("tcp://127.0.0.1.example.org:502", HANDS, False),
        ("tcp://0.0.0.0:1502", HANDS, False),
        ("/dev/ttyUSB0", HANDS, False),
        ("COM5", HANDS, False),
        ("tcp://127.0.0.1:1502", FAR_HANDS, False),
        ("tcp://127.0.0.1:1502", "console:", False),  # may be a tunnel to a real bath
        ("/dev/pts/7", "console:", False),
    ],
)
def test_a_real_bath_is_not_emulated_by_its_operator(
    bath: str, operator: str, emulated: bool, lab: LoadedRig, tmp_path: Path
) -> None:
    text = lab.text.replace('"tcp://192.168.0.40:502"', f'"{bath}"')
    text = text.replace('url = "console:"', f'url = "{operator}"')
    (tmp_path / "other.toml").write_text(text, encoding="utf-8")
    rig = load_rig(tmp_path / "other.toml")
    assert (rig.rig.bath.url, rig.rig.operator.url) == (bath, operator)
    if emulated:
        refuse_untested_cut_out(rig, TODAY)
    else:
        with pytest.raises(ConfigError, match="nothing is heated before"):
            refuse_untested_cut_out(rig, TODAY)


def test_a_day_that_is_still_to_come_is_no_test(lab: LoadedRig, tmp_path: Path) -> None:
    refuse_untested_cut_out(with_bath(tmp_path, "julabo-presto", "2026-11-23"), TODAY)
    with pytest.raises(ConfigError, match="still to come"):
        refuse_untested_cut_out(with_bath(tmp_path, "julabo-presto", "2026-11-24"), TODAY)
    with pytest.raises(ConfigError, match=r'cut_out_tested: .*write it as "2026-11-20"'):
        with_bath(tmp_path, "julabo-presto", "yesterday")


def test_a_run_on_a_real_rig_is_refused_before_anything_is_opened(
    lab: LoadedRig, short_script: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["run", str(short_script), "--rig", str(lab.path), "--out", str(tmp_path / "runs")]
    assert main(arguments) == 2
    assert "bath.cut_out_tested: missing: nothing is heated" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()
