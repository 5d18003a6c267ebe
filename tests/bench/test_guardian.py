"""The bench is killed in every step of a run in real time, in every way, and the bath is in standby within three seconds.

The emulators live here, the bench and its guardian in processes of their own; what the bath does is seen at the plant and
asked by a second Modbus client.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest

from bench.record import RunRecord, read_run
from bench.summary import write_run_report
from bench.summary.wording import headline
from instruments.bath.driver import Bath
from instruments.bath.profile import load_profile
from instruments.clock import RealClock, wall_time
from tests.bench.real_rig import Bench, RealRig, bench, real_rig, record_one

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="sends POSIX signals to the bench")

AT_ONCE = 8  # benches beside each other: most of their time they wait
STANDBY_S = 3.0
HANG_S = 10.0


def preparing(rig: RealRig, running: Bench) -> None:
    """Before the bench has heated anything: somebody has left the bath on."""
    running.wait_for("on its peg")
    rig.twin.world.plant.run(33.0)


def heating(rig: RealRig, running: Bench) -> None:
    running.wait_for("on its peg")
    running.answer()
    running.wait_until(lambda: rig.twin.world.plant.running, "heated")


def settling(rig: RealRig, running: Bench) -> None:
    heating(rig, running)
    time.sleep(1.5)


def moving(rig: RealRig, running: Bench) -> None:
    heating(rig, running)
    before = rig.twin.world.stage_mm()
    running.wait_until(lambda: rig.twin.world.stage_mm() != before, "moved")
    time.sleep(0.5)


def capturing(rig: RealRig, running: Bench) -> None:
    heating(rig, running)
    running.wait_for("Enter when it stands")
    running.answer()
    time.sleep(0.5)


def touching(rig: RealRig, running: Bench) -> None:
    heating(rig, running)
    running.wait_for("Enter when it stands")
    running.answer()
    running.wait_for("Touch the end of teat 1")
    running.answer()
    running.wait_for("Touch the end of teat 2")


STEPS: dict[str, tuple[Callable[[RealRig, Bench], None], dict[str, Any]]] = {
    "moving": (moving, {"stage": True}),  # first: homing takes its time
    "preparing": (preparing, {}),
    "heating": (heating, {}),
    "settling": (settling, {"window_s": 60.0}),
    "capturing": (capturing, {"settle_s": 60.0}),
    "touching": (touching, {}),
}
KILLS = ("SIGKILL", "SIGTERM", "SIGHUP")
CASES = [("settling", "SIGSTOP"), *((step, kill) for step in STEPS for kill in KILLS)]


@dataclass(frozen=True)
class Outcome:
    """What became of one bench: the time to standby as the plant saw it, and what the record says."""

    seconds: float
    killed: datetime
    run_state: str
    code: int | None
    run: RunRecord
    said: str

    @property
    def report(self) -> str:
        """The page, written now."""
        return write_run_report(self.run.folder)[0].read_text(encoding="utf-8")


def kill_in(step: str, kill: str, folder: Path, recording: Path) -> Outcome:
    bring, figures = STEPS[step]
    with real_rig(folder, recording, **figures) as rig, bench(rig) as running:
        bring(rig, running)
        plant = rig.twin.world.plant
        assert plant.running
        killed, start = wall_time(), time.monotonic()
        running.process.send_signal(getattr(signal, kill))
        while plant.running and time.monotonic() - start < 30.0:
            time.sleep(0.002)
        seconds = time.monotonic() - start
        state = asked(rig.twin.urls["bath"])
        if kill == "SIGSTOP":
            running.process.send_signal(signal.SIGCONT)
        code = running.process.wait(20)
        guardian = rig.run_folder() / "guardian.json"
        deadline = time.monotonic() + 5.0
        while kill in ("SIGKILL", "SIGSTOP") and not guardian.is_file() and time.monotonic() < deadline:
            time.sleep(0.02)
        return Outcome(seconds, killed, state, code, read_run(rig.run_folder()), running.said)


def asked(url: str) -> str:
    """What a second client is told about the controller."""
    clock = RealClock()
    bath = Bath(url, load_profile("julabo-presto"), clock)
    row = bath.profile.row("run")
    told = row.label(bath.get("run"))
    bath.close()
    clock.close()
    return told


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, str], Outcome]:
    """All cases, some beside each other."""
    folder = tmp_path_factory.mktemp("killed")
    recording = record_one(folder / "recording")
    with ThreadPoolExecutor(AT_ONCE) as pool:
        jobs = {case: pool.submit(kill_in, *case, folder / "-".join(case), recording) for case in CASES}
        done = {case: job.result() for case, job in jobs.items()}
    if "TEATBENCH_SHOW_TIMES" in os.environ:
        print("\n" + "\n".join(f"{step:10} {kill:8} {outcome.seconds:6.3f} s" for (step, kill), outcome in sorted(done.items())))
    return done


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("kill", KILLS)
def test_the_bath_is_in_standby_within_three_seconds(step: str, kill: str, outcomes: dict[tuple[str, str], Outcome]) -> None:
    outcome = outcomes[step, kill]
    assert outcome.seconds < STANDBY_S
    assert outcome.run_state == "standby"


@pytest.mark.parametrize("step", STEPS)
def test_after_a_kill_the_record_says_when_the_bench_died_and_when_the_bath_was_safe(
    step: str, outcomes: dict[tuple[str, str], Outcome]
) -> None:
    outcome = outcomes[step, "SIGKILL"]
    told = outcome.run.guardian
    assert outcome.run.ending == "interrupted"
    assert told is not None
    assert (told["cause"], told["standby"], told["tries"]) == ("died", True, 1)
    assert abs((datetime.fromisoformat(told["wall_noticed"]) - outcome.killed).total_seconds()) < 1.0
    assert told["seconds"] < STANDBY_S
    sentence = f"The bench died at {told['wall_noticed']}; the guardian had the bath in standby at {told['wall_safe']}"
    assert sentence in headline(outcome.run, ())[1]
    if step == "touching":
        assert sentence in outcome.report


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("kill", ["SIGTERM", "SIGHUP"])
def test_a_bench_that_is_asked_to_end_does_so_itself(step: str, kill: str, outcomes: dict[tuple[str, str], Outcome]) -> None:
    outcome = outcomes[step, kill]
    assert outcome.run.guardian is None, "nothing was left for the guardian"
    assert outcome.run.ending == "aborted"
    assert outcome.code == 3
    texts = [event["text"] for event in outcome.run.events]
    assert "bath is safe" in texts
    assert any(kill in text for text in texts)
    assert "Traceback" not in outcome.said


def test_a_bench_that_hangs_is_taken_for_dead_after_ten_seconds(outcomes: dict[tuple[str, str], Outcome]) -> None:
    outcome = outcomes["settling", "SIGSTOP"]
    assert HANG_S - 1.5 < outcome.seconds < HANG_S + STANDBY_S
    told = outcome.run.guardian
    assert told is not None
    assert (told["cause"], told["standby"]) == ("hung", True)
    assert outcome.run.ending == "faulted", "once it goes on, it finds its guardian gone"
    assert outcome.run.facts["trip"]["rule"] == "guardian lost"
    assert "The bench hung (no sign of life for 10 s)" in outcome.report


def test_a_run_that_ends_well_leaves_no_guardian(tmp_path: Path) -> None:
    recording = record_one(tmp_path / "recording")
    with real_rig(tmp_path / "rig", recording) as rig, bench(rig) as running:
        heating(rig, running)
        running.wait_for("Enter when it stands")
        running.answer()
        for teat in range(1, 5):
            running.wait_for(f"Touch the end of teat {teat}")
            rig.twin.operator.touch(teat, 4)
            running.answer()
        assert running.process.wait(20) == 0, running.said
        assert not rig.twin.world.plant.running
        folder = rig.run_folder()
    run = read_run(folder)
    assert run.ending == "finished"
    assert run.guardian is None
    assert run.facts["guardian"] == "beside the bench"
    assert not (folder / "guardian.log").exists()
    assert json.loads((folder / "report" / "run.json").read_text(encoding="utf-8"))["ending"] == "finished"
