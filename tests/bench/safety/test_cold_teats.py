"""Pump stopped, teats cold, sensor stopped: on every script that ships, with windows and slopes as
wide as a script may have them, no trial is captured and nothing is met.
"""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from bench.cli.main import main
from bench.record.reader import read_run
from bench.results.teats_seen import TEATS_FACT
from bench.results.verdicts import judge, run_verdict, stored_rules
from bench.scoring.decisions import Verdict
from bench.script.model import TRIALS
from tests.bench.operated_runs import ONE, STAGE, files
from tests.bench.safety.wide_scripts import RELAY, wide
from tests.examples import few

pytestmark = pytest.mark.slow

SCRIPTS = sorted(  # of a bath: one only computes
    path.stem for path in TRIALS.glob("*.toml") if "[bath]" in path.read_text(encoding="utf-8")
)
SENSED, UNSENSED = "julabo-presto", "watlow-pm-map1"
# fault, family, where the bath starts, and when it breaks: before any trial
CASES = [
    ("pump stopped", SENSED, 20.0, 30.0),
    ("pump stopped", UNSENSED, 20.0, 30.0),
    ("frozen sensor", SENSED, 33.0, 0.0),
    ("frozen sensor", SENSED, 33.0, 13.0),
    ("frozen sensor", UNSENSED, 33.0, 13.0),
    ("frozen sensor", "omega-cn7", 33.0, 13.0),
]


def bath_of(profile: str) -> str:
    """The lines of a rig's bath; whose pump a relay turns, where the family has none."""
    return f'profile = "{profile}"\n{RELAY * (profile in (UNSENSED, "omega-cn7"))}'


def broken(fault: str, at_s: float) -> str:
    return f'faults = [{{ instrument = "bath", name = "{fault}", at_s = {at_s} }}]'


def nothing_met(script: str, case: tuple[str, str, float, float], folder: Path) -> None:
    fault, profile, start_c, at_s = case
    text = wide((TRIALS / f"{script}.toml").read_text(encoding="utf-8"))
    given = files(
        folder,
        script=text,
        stage=STAGE,
        bath=bath_of(profile),
        start_c=start_c,
        emulation=broken(fault, at_s),
    )
    assert main(given) == 3
    (made,) = (folder / "runs").iterdir()
    run = read_run(made)
    assert run.trials == (), [event["text"] for event in run.events]
    assert run.ending == "faulted"
    judged = judge(run, stored_rules(made))
    assert run_verdict(judged) is not Verdict.MET
    met = {d.name for one in judged for d in one.decisions if d.verdict is Verdict.MET}
    assert met <= {"calibration fresh"}, "which was so before the run"
    assert "bath is safe" in [event["text"] for event in run.events]


@pytest.mark.parametrize(
    "case", few([(case,) for case in CASES[1::2]], 4), ids=lambda case: f"{case[0]}, {case[1]}"
)
def test_no_trial_is_captured(case: tuple[str, str, float, float], tmp_path: Path) -> None:
    nothing_met("six-situations", case, tmp_path)


@pytest.mark.weekly
@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case[0]}, {case[1]}, {case[3]:g} s")
@pytest.mark.parametrize("script", SCRIPTS)
def test_nor_in_any_script_that_ships(
    script: str, case: tuple[str, str, float, float], tmp_path: Path
) -> None:
    nothing_met(script, case, tmp_path)


def test_teats_that_cool_in_a_run_end_it(tmp_path: Path) -> None:
    """All is warm at first, and only the thermal camera shows the teats."""
    poses = ", ".join("{}" for _ in range(20))
    script = wide(ONE).replace("[{}]", f"[{poses}]")
    emulation = f"{broken('pump stopped', 0.0)}\nprompt_s = 5.0"
    given = files(tmp_path, script=script, stage=STAGE, bath=bath_of(UNSENSED), emulation=emulation)
    assert main(given) == 3
    (made,) = (tmp_path / "runs").iterdir()
    run = read_run(made)
    assert 0 < len(run.trials) < 20
    (fault,) = [event["text"] for event in run.events if event["kind"] == "fault"]
    assert "degC at first" in fault
    last_s = run.trials[-1].head["captured_s"]
    lost_k = 13.0 * (1.0 - math.exp(-last_s / 652.0))  # since the pump stopped
    assert lost_k < 1.0 + 2.0 + 0.5, "before the first look, since then, and in one trial"


@pytest.mark.parametrize("camera", [True, False])
def test_teats_that_nothing_shows_leave_the_bath_inconclusive(
    camera: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A controller without a sensor at the teats: the thermal camera tells, where it can."""
    # in a room as warm as the bath no camera tells one from the other
    room = "" if camera else "ambient_c = 30.0"
    given = files(tmp_path, script=ONE, stage=STAGE, bath=bath_of(UNSENSED), emulation=room)
    code = main(given)
    (made,) = (tmp_path / "runs").iterdir()
    run = read_run(made)
    said = " ".join(capsys.readouterr().out.split())
    assert len(run.trials) == 1
    assert (TEATS_FACT in run.facts) is not camera
    assert code == (0 if camera else 4)
    assert ("The temperature at the teats was not measured" in said) is not camera
