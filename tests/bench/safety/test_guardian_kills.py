"""The bench is killed in every step of a run in real time, in every way, and the bath is in standby
within three seconds.

The emulators live here, the bench and its guardian in processes of their own; what the bath does is
seen at the plant and asked by a second Modbus client. The times measured stand in the summary of
the tests, and in their JUnit file.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from datetime import datetime
from itertools import cycle
from pathlib import Path
from typing import Any

import pytest

from bench.record.reader import RunRecord, read_run
from bench.results.status import status_of
from instruments.bath.driver import OwnBath
from instruments.bath.profile import load_profile
from instruments.clock import RealClock, wall_time
from tests.bench.real_rig import RealRig, real_rig
from tests.bench.safety.guards import STANDBY_S, Measured, guardian_record, standby_after

if sys.platform == "win32":
    pytest.skip("sends POSIX signals to the bench", allow_module_level=True)

from tests.bench.marked_bench import MARK, MarkedBench, marked_bench
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.slow

AT_ONCE = 3  # an arm in real time that waits for a busy processor counts as lost


@dataclass(frozen=True)
class Step:
    """Where to kill: once ``words`` were said for the ``nth`` time and ``then_s`` are over."""

    words: str
    nth: int = 1
    then_s: float = 0.2
    more: tuple[tuple[str, Any], ...] = ()


STEPS = {
    "moving": Step(f"{MARK}moving", more=(("stage", True),)),  # first: what takes longest
    "homing": Step(f"{MARK}homing", more=(("stage", True),)),
    "checking the arm after": Step("1 of 1] Arm check"),
    "going to safe": Step(f"{MARK}going to safe"),
    "storing": Step(f"{MARK}storing"),
    "detecting": Step(f"{MARK}detecting"),
    "touching": Step("Touch the end of teat 2"),
    "capturing": Step(f"{MARK}capturing"),
    "setting up": Step("Enter when it stands"),
    "settling": Step(f"{MARK}settling", then_s=1.2, more=(("window_s", 60.0),)),
    "heating": Step("never said", more=(("start_c", 25.0),)),
    "checking the arm before": Step("1 of 2] Arm check"),
    "preparing": Step("on its peg"),
}
# a kill or a request in each step; both in all of them are the weekly run's
KILLED = (
    "moving",
    "checking the arm after",
    "storing",
    "touching",
    "settling",
    "homing",
    "preparing",
)
ASKED = (
    "going to safe",
    "detecting",
    "capturing",
    "setting up",
    "heating",
    "checking the arm before",
)
NOT_YET_HEATING = ("preparing", "checking the arm before", "homing")
PAST_ENDING = ("going to safe",)  # what is asked there is noted: the run has ended already


@dataclass(frozen=True)
class Outcome:
    """What became of one bench: the time to standby by the plant, and what the record says."""

    step: str
    kill: str
    seconds: float
    killed: datetime
    run_state: str
    code: int | None
    run: RunRecord
    said: str


def bring(rig: RealRig, running: MarkedBench, name: str) -> None:
    plant, step = rig.twin.world.plant, STEPS[name]
    running.attended(lambda: plant.running and name == "heating", step.words, step.nth)
    if name in NOT_YET_HEATING:
        with rig.twin.world.lock:
            plant.run(33.0)  # before the bench has heated anything: somebody has left the bath on
    time.sleep(step.then_s)


def kill_in(name: str, kill: str, folder: Path, recording: Path) -> Outcome:
    figures: dict[str, Any] = {"check_touches": 2, **dict(STEPS[name].more)}
    with real_rig(folder, recording, **figures) as rig, marked_bench(rig, name) as running:
        bring(rig, running, name)
        plant = rig.twin.world.plant
        assert plant.running, f"{name}: the bath was off before the kill:\n{running.said}"
        killed = wall_time()
        running.signal(kill)
        seconds = standby_after(plant)
        state = run_state(rig.twin.urls["bath"])
        running.process.join(PATIENCE_S)
        if kill == "SIGKILL":
            guardian_record(rig.run_folder())
        code, run = running.process.exitcode, read_run(rig.run_folder())
        return Outcome(name, kill, seconds, killed, state, code, run, running.said)


def run_state(url: str) -> str:
    """What a second client is told about the controller."""
    profile = load_profile("julabo-presto")
    with closing(RealClock()) as clock, closing(OwnBath(url, profile, clock)) as bath:
        return profile.row("run").label(bath.get("run"))


def killed_in_steps(
    steps: Iterable[str], kills: tuple[str, ...], folder: Path, recording: Path, measured: Measured
) -> list[Outcome]:
    """A bench killed in each of ``steps``, beside each other, by each of ``kills`` in turn; the
    test's record gets what was measured.
    """
    with ThreadPoolExecutor(AT_ONCE) as pool:
        turns = zip(steps, cycle(kills), strict=False)
        jobs = [pool.submit(kill_in, name, kill, folder / name, recording) for name, kill in turns]
        outcomes = [job.result() for job in jobs]
    for outcome in outcomes:
        how = f"{outcome.kill} while {outcome.step}"
        measured(how, outcome.seconds)
        assert outcome.seconds < STANDBY_S, how
        assert outcome.run_state == "standby", how
    return outcomes


ALL = pytest.param(tuple(STEPS), id="all", marks=pytest.mark.weekly)


def test_the_steps_are_all_there_are() -> None:
    assert {*KILLED, *ASKED} == set(STEPS)
    assert len(STEPS) == 13


@pytest.mark.parametrize("steps", [pytest.param(KILLED, id="some"), ALL])
def test_a_kill_in_any_step_leaves_standby_and_a_record_of_it(
    steps: tuple[str, ...], recording: Path, tmp_path: Path, measured: Measured
) -> None:
    for outcome in killed_in_steps(steps, ("SIGKILL",), tmp_path, recording, measured):
        note = outcome.run.guardian
        assert outcome.run.ending == "interrupted", outcome.step
        late = outcome.step in ("checking the arm after", "going to safe")
        assert not outcome.run.trials or late, "a trial is there whole or not at all"
        assert note is not None, outcome.step
        assert (note["cause"], note["standby"], note["tries"]) == ("died", True, 1), outcome.step
        noticed = datetime.fromisoformat(note["wall_noticed"])
        # between the kill and the standby that was seen, however long a busy machine took
        assert -0.01 <= (noticed - outcome.killed).total_seconds() < outcome.seconds + 1.0
        assert note["seconds"] < STANDBY_S
        sentence = (
            f"The bench died at {note['wall_noticed']}; the guardian had the bath in standby at"
            f" {note['wall_safe']}"
        )
        assert sentence in status_of(outcome.run).why


@pytest.mark.parametrize("steps", [pytest.param(ASKED, id="some"), ALL])
def test_a_bench_that_is_asked_to_end_in_any_step_makes_safe_itself(
    steps: tuple[str, ...], recording: Path, tmp_path: Path, measured: Measured
) -> None:
    """Both requests have one handler: they take turns."""
    for outcome in killed_in_steps(steps, ("SIGTERM", "SIGHUP"), tmp_path, recording, measured):
        texts = [event["text"] for event in outcome.run.events]
        assert outcome.run.guardian is None, f"{outcome.step}: nothing was left for the guardian"
        assert "bath is safe" in texts, outcome.step
        assert "Traceback" not in outcome.said, outcome.said
        if outcome.step in PAST_ENDING:
            assert (outcome.run.ending, outcome.code) == ("finished", 0)
        else:
            assert (outcome.run.ending, outcome.code) == ("aborted", 3), outcome.step
            assert any(outcome.kill in text for text in texts), outcome.step
