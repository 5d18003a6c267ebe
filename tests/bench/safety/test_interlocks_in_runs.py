"""Trips and stability in whole runs, with emulated faults under virtual time; in real time:
`test_interlocks_everywhere`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from bench.cli.main import main
from bench.record.reader import RunRecord
from bench.record.schema import Row
from bench.rig.loading import load_rig
from bench.rig.opening import open_instruments
from bench.safety.bath_monitor import BathMonitor
from bench.safety.interlocks import Interlocks, InterlockTrip
from bench.safety.liveness import Liveness
from bench.safety.stability import StabilityGate
from instruments.bath.sequence import start_bath
from instruments.clock import VirtualClock
from tests.bench.operated_runs import ONE, SCRIPT, files, run, run_of
from tests.bench.test_config import rig_with
from tests.examples import few

pytestmark = pytest.mark.slow

FAULT = """
[[emulation.faults]]
instrument = "bath"
name = "{name}"
at_s = {at_s}
"""


def run_on(folder: Path, script: str, more: str = "", *, bath: str = "") -> tuple[int, RunRecord]:
    """The exit code of a run of ``script`` on the emulated rig with ``more`` in its file and
    another ``bath``, and its record.
    """
    profile = 'profile = "julabo-presto"'
    rig = rig_with(folder, {profile: bath or profile})
    rig.write_text(rig.read_text(encoding="utf-8") + more, encoding="utf-8")
    (folder / "script.toml").write_text(script, encoding="utf-8")
    given = ["run", str(folder / "script.toml"), "--rig", str(rig), "--out", str(folder / "runs")]
    return run(given, folder)


@pytest.fixture
def long_script(short_script: Path) -> str:
    """It is still settling when the latest fault comes."""
    text = short_script.read_text(encoding="utf-8")
    assert "window_s = 60.0" in text
    return text.replace("window_s = 60.0", "window_s = 3000.0")


COLD_C, WARM_C = 20.0, 33.0
SLACK_S = 5.0  # a look that began in time may end later


@contextmanager
def heated(
    folder: Path, fault: str, start_c: float, at_s: float
) -> Iterator[tuple[VirtualClock, list[Row], list[tuple[float, Exception]]]]:
    """The monitor beside a bath that heats and breaks at ``at_s``: what it records, its trips."""
    path = rig_with(folder, {})
    more = f"\n[emulation]\nbath_start_c = {start_c}\n{FAULT.format(name=fault, at_s=at_s)}"
    path.write_text(path.read_text(encoding="utf-8") + more, encoding="utf-8")
    rig, clock, rows = load_rig(path), VirtualClock(), list[Row]()
    trips: list[tuple[float, Exception]] = []

    def act(trip: Exception) -> bool:
        trips.append((clock.now(), trip))
        return True

    with open_instruments(rig, ("bath",), clock, seed=1) as devices:
        interlocks = Interlocks(rig.rig.limits, rig.profile)
        gate, moving = StabilityGate(33.0), Liveness(rig.profile)
        watch = BathMonitor(
            devices.bath.read, clock, gate, interlocks, rows.append, act, moving=moving
        )
        watch.start()
        start_bath(devices.bath, 33.0, clock.sleep)
        watch.heating()
        yield clock, rows, trips
        watch.stop()


@pytest.mark.parametrize(
    ("fault", "start_c", "at_s", "rule", "within_s"),
    few(
        [
            ("stuck heater", WARM_C, 300.0, "over-temperature", 240.0),
            ("dead heater", COLD_C, 100.0, "loop break", 150.0),
            ("frozen sensor", 28.0, 160.0, "frozen reading", 125.0),
            ("sensor break", WARM_C, 100.0, "implausible reading", 7.0),
            ("fahrenheit", WARM_C, 100.0, "implausible reading", 7.0),
            ("silence", WARM_C, 100.0, "communications lost", 20.0),
            ("controller reset", WARM_C, 100.0, "changed at the controller", 20.0),
            ("low level", WARM_C, 100.0, "controller alarm", 3.0),
            ("pump stopped", WARM_C, 300.0, "sensor disagreement", 300.0),
        ],
        2,
    ),
)
def test_each_fault_of_the_bath_trips_its_rule_in_time(
    fault: str, start_c: float, at_s: float, rule: str, within_s: float, tmp_path: Path
) -> None:
    with heated(tmp_path, fault, start_c, at_s) as (clock, _, trips):
        clock.sleep(at_s + within_s - clock.now() + SLACK_S)
    ((when_s, trip),) = trips
    assert isinstance(trip, InterlockTrip)
    assert trip.rule == rule
    assert at_s <= when_s <= at_s + within_s
    assert 1 <= len(trip.values) <= 12, "the last ten, and those that the rule compared with"


OWN_LIMITS = """
[limits]
set_point_c = [22.0, 33.2]
bath_max_c = 33.5
bath_silence_s = 20.0

[emulation]
bath_start_c = 33.0
[[emulation.faults]]
instrument = "bath"
name = "{fault}"
at_s = 30.0
"""


@pytest.mark.parametrize(
    ("fault", "rule"), [("stuck heater", "over-temperature"), ("silence", "communications lost")]
)
def test_a_run_trips_at_the_limits_of_its_rig_file(
    fault: str, rule: str, long_script: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, run = run_on(tmp_path, long_script, OWN_LIMITS.format(fault=fault))
    assert (code, run.ending, run.facts["trip"]["rule"]) == (3, "faulted", rule)
    kinds = [event["kind"] for event in run.events]
    assert kinds.index("trip") < kinds.index("fault") < kinds.index("end")
    said = capsys.readouterr().out.replace("\n", " ")
    assert f"interlock {rule}" in said, "shown to the operator"
    page = (run.folder / "report" / "index.html").read_text(encoding="utf-8")
    assert f"Readings that led to the trip: {rule}" in page
    assert not list(tmp_path.glob("*.tripped.json")), (
        "an emulated bath is a new one in each run: nothing is latched"
    )
    before, last = run.bath[:-1], run.bath[-1]
    if rule == "over-temperature":
        seen = run.facts["trip"]["values"][-1]
        assert before[:, 1].max() <= 33.5 < max(seen["temp_c"], seen["safety_c"])
    else:
        assert 20.0 <= run.facts["trip"]["t_s"] - last[0] <= 20.0 + SILENT_LOOK_S


def test_a_detection_may_take_what_the_rig_file_allows(tmp_path: Path) -> None:
    limit = "\n[limits]\ndetection_timeout_s = 1e-6"
    assert main(files(tmp_path, emulation=limit, script=ONE)) == 0
    answers = [row for trial in run_of(tmp_path).trials for row in trial.detections]
    assert len(answers) == 1
    assert {row["outcome"] for row in answers} == {"timeout"}


SILENT_LOOK_S = 8.0  # a look at a bath that does not answer takes up to seven seconds


def test_after_a_trip_a_pump_on_a_relay_runs_on_for_a_minute_behind_the_heater(
    short_script: Path, tmp_path: Path
) -> None:
    relay = 'profile = "eurotherm-2400"\npump_url = "emulator:"\npump_profile = "modbus-relay"'
    fault = FAULT.format(name="dead heater", at_s=300.0)
    code, run = run_on(tmp_path, short_script.read_text(encoding="utf-8"), fault, bath=relay)
    assert code == 3
    trip = run.facts["trip"]
    assert trip["rule"] == "loop break"
    assert trip["done"] == ["stage is held", "heater is in standby"]
    at_s = {event["text"]: event["t_s"] for event in run.events if event["kind"] == "safe"}
    ran_on = "the pump ran on for 60 s and is off"
    assert list(at_s) == ["bath is safe", "stage is safe", "arm is safe", ran_on]
    assert run.facts["pump"] == "switched by itself: 10 s before the heater, 60 s after it"
    assert run.events[-1]["t_s"] - trip["t_s"] >= 60.0


def test_a_bath_that_freezes_near_its_set_point_is_never_stable(tmp_path: Path) -> None:
    """Its controller goes on working, its output moves: no evidence of its temperature."""
    at_s = 400.0
    with heated(tmp_path, "frozen sensor", 28.0, at_s) as (clock, rows, _):
        clock.sleep(1200.0)
    after = [row for row in rows if float(str(row["t_s"])) > at_s]
    assert len(after) > 700
    assert "heating" not in {row["state"] for row in after[:60]}, "it is near its set point"
    assert "stable" not in {row["state"] for row in after}


def test_the_report_has_temperatures_stability_and_the_teats_surface_at_every_capture(
    tmp_path: Path,
) -> None:
    script = SCRIPT.replace("window_s = 2.0", "window_s = 60.0")
    _, record = run(files(tmp_path, script=script), tmp_path)
    page = (record.folder / "report" / "index.html").read_text(encoding="utf-8")
    assert len(record.trials) == 3
    rows = re.findall(r"<tr.*?</tr>", page, re.DOTALL)
    plain = [re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", row)) for row in rows]
    for trial in record.trials:
        of_trial = [row for row in plain if trial.id in row]
        assert any(
            re.search(r"(32\.99|33\.0\d) .* stable 32\.\d\d 0\.\d\d", row) for row in of_trial
        ), "bath, state, teats' surface and its uncertainty"
        assert any(
            re.search(r"6\d [+-]0\.0\d\d\d [+-]0\.0\d\d\d [+-]0\.0\d\d\d", row) for row in of_trial
        ), "mean, half range, slope"
    assert "Uniformity, from teat to teat and from root to tip, is not measured" in page
    assert "The 60 s before each capture" in page
