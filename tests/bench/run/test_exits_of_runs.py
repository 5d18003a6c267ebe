"""Every way out of a whole run in real time passes through safe, and takes no longer than it may:
what the bath and the record say.

SIGTERM and SIGHUP in each step are `test_guardian_kills`.
"""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import pytest

from bench.record.reader import RunRecord, read_run
from bench.results.status import read_status
from instruments.listener import Listener
from tests.bench.commands import teatbench
from tests.bench.real_rig import RealRig, real_rig
from tests.bench.safety.guards import guardian_record
from tests.examples import few
from tests.plain_text import plain_text

if sys.platform == "win32":
    pytest.skip("sends POSIX signals to the bench", allow_module_level=True)

from tests.bench.marked_bench import CLOSED_CODE, MARK, MarkedBench, marked_bench
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.slow

AT_ONCE = 2  # an arm in real time that waits for a busy processor counts as lost
# standby takes milliseconds; the rest is the arm's and the links' ending, on a machine that is busy
BOUND_S = 15.0


@dataclass(frozen=True)
class Outcome:
    """``standby_s`` and ``gone_s`` are from the moment that ended it."""

    way: str
    standby_s: float
    gone_s: float
    code: int | None
    run: RunRecord
    said: str


def leave(way: str, folder: Path, recording: Path) -> Outcome:
    step = {"Ctrl-C": "settling", "Ctrl-C twice": "going to safe"}.get(way, way)
    with (
        real_rig(folder, recording, window_s=2.0 if way in ("normal", "mistaken") else 60.0) as rig,
        marked_bench(rig, step) as running,
    ):
        running.wait_for("on its peg")
        running.enter()
        plant, start = rig.twin.world.plant, WAYS[way][0](rig, running) or time.monotonic()
        while plant.running and time.monotonic() - start < 60.0:
            time.sleep(0.002)
        standby_s = time.monotonic() - start
        running.process.join(PATIENCE_S)
        return Outcome(
            way,
            standby_s,
            time.monotonic() - start,
            running.process.exitcode,
            read_run(rig.run_folder()),
            running.said,
        )


def to_the_end(rig: RealRig, running: MarkedBench) -> float:
    """When the last end was touched."""
    plant = rig.twin.world.plant
    running.wait_for("Enter when it stands")
    return running.attended(lambda: not plant.running)


def to_the_mistake(_: RealRig, running: MarkedBench) -> None:
    running.wait_for("Enter when it stands")
    running.enter()


def interrupt(_: RealRig, running: MarkedBench) -> None:
    running.wait_for(f"{MARK}settling")
    time.sleep(1.2)
    running.signal("SIGINT")


def interrupt_twice(rig: RealRig, running: MarkedBench) -> None:
    """The second comes while the bench is on its way to safe, and has not got there."""
    running.until(lambda: rig.twin.world.plant.running, "heated")
    time.sleep(1.2)
    running.signal("SIGINT")
    running.wait_for(f"{MARK}going to safe")
    assert rig.twin.world.plant.running
    running.signal("SIGINT")


def close(_: RealRig, running: MarkedBench) -> None:
    running.wait_for(f"{MARK}closing")


# how it is brought about, the run's ending, the exit code
WAYS: dict[str, tuple[Callable[[RealRig, MarkedBench], float | None], str, int]] = {
    "normal": (to_the_end, "finished", 0),
    "mistaken": (to_the_mistake, "faulted", 3),
    "Ctrl-C": (interrupt, "aborted", 3),
    "Ctrl-C twice": (interrupt_twice, "aborted", 3),
    "closing": (close, "interrupted", CLOSED_CODE),
}


def test_every_way_out_of_a_run_leaves_standby_in_bounded_time(
    recording: Path, tmp_path: Path
) -> None:
    with ThreadPoolExecutor(AT_ONCE) as pool:
        jobs = [pool.submit(leave, way, tmp_path / way, recording) for way in WAYS]
        outcomes = [job.result() for job in jobs]
    for outcome in outcomes:
        texts = [event["text"] for event in outcome.run.events]
        assert outcome.standby_s < BOUND_S, outcome.way
        assert outcome.gone_s < BOUND_S, outcome.way
        ended = (outcome.run.ending, outcome.code)
        assert ended == WAYS[outcome.way][1:], f"{outcome.way}: {outcome.said}"
        if outcome.way == "closing":
            continue  # Windows ends the process behind the handler: there is no time for the record
        assert "bath is safe" in texts, outcome.way
        if outcome.way == "normal":
            facts, folder = outcome.run.facts, outcome.run.folder
            assert facts["guardian"] == "beside the bench"
            assert facts["cut-out tested"] == "2024-03-01"
            assert not (folder / "guardian.log").exists()
            assert teatbench("report {}", folder) == 0
            page = plain_text(folder / "report" / "index.html")
            assert re.search(r"independent cut-out tested on.{0,80}2024-03-01", page)
        assert outcome.run.guardian is None, f"{outcome.way}: it was told that all is safe"
        if outcome.way == "mistaken":
            assert any("a mistake of the bench: ZeroDivisionError" in text for text in texts)
            kept = outcome.run.folder / "mistake.txt"
            assert kept.read_text(encoding="utf-8").startswith("Traceback")
        if outcome.way.startswith("Ctrl-C"):
            assert any("Ctrl-C" in text for text in texts)


def test_what_drops_out_while_the_bath_settles_is_said_then_and_when_it_is_back(
    recording: Path, tmp_path: Path
) -> None:
    with (
        real_rig(tmp_path / "rig", recording, stage=True, window_s=3600.0) as rig,
        marked_bench(rig, "settling") as running,
    ):
        running.wait_for("on its peg")
        running.enter()
        running.wait_for(f"{MARK}settling")
        for name in ("stage", "arm"):
            rig.twin.listeners[name].pull(out=True)
            running.wait_for("The run is paused")
            rig.twin.listeners[name].pull(out=False)
            if name == "arm":
                running.wait_for("on its peg")
                running.enter()
            running.wait_for(f"The {name} is back after")
            running.wait_for("homed again")
        running.signal("SIGINT")
        running.process.join(PATIENCE_S)
        assert read_status(rig.run_folder()).why.endswith("All instruments are safe.")


@pytest.mark.parametrize(
    ("bath_too", "asked"),
    few([(True, "SIGTERM"), (False, "SIGINT")], 2),
    ids=["stage and bath", "the stage"],
)
def test_instruments_that_are_gone_do_not_keep_the_others_from_safe(
    bath_too: bool, asked: str, recording: Path, tmp_path: Path
) -> None:
    """The run is ended while it waits for a stage whose connection is lost."""
    with (
        real_rig(tmp_path / "rig", recording, stage=True) as rig,
        marked_bench(rig, "settling") as running,
    ):
        running.wait_for("on its peg")
        running.enter()
        running.wait_for(f"{MARK}settling")
        rig.twin.listeners["stage"].close()
        running.wait_for("The run is paused")
        bath = rig.twin.listeners["bath"]
        assert isinstance(bath, Listener)
        if bath_too:
            bath.close()
        running.signal(asked)
        running.wait_for("NOT SAFE")
        running.process.join(PATIENCE_S)
        assert running.process.exitcode == 3, running.said
        said = " ".join(running.said.split())
        assert f"NOT SAFE: {'bath, ' * bath_too}stage. " in said
        orders = ["SWITCH OFF THE BATH AT ITS MAINS:"] * bath_too + ["CUT THE POWER OF THE STAGE:"]
        places = [said.index(order) for order in ["NOT SAFE:", *orders]]
        assert places == sorted(places), "heat first"
        if bath_too:  # the guardian goes on trying until somebody has plugged the bath in again
            assert rig.twin.world.plant.running
            clock, lock = rig.twin._clock, rig.twin.world.lock
            rig.twin.listeners["bath"] = Listener(
                rig.twin.bath, clock, lock=lock, name="bath", port=bath.port
            )
            guardian_record(rig.run_folder(), lambda written: written["standby"] is True)
        assert not rig.twin.world.plant.running
        run = read_run(rig.run_folder())
    texts = [event["text"] for event in run.events]
    assert (run.ending, texts[-1]) == ("aborted", "aborted")
    assert ("bath is safe" in texts) is not bath_too
    assert any(text.startswith("bath could not be made safe: bath") for text in texts) is bath_too
    assert any(text.startswith("stage could not be made safe: stage at socket:") for text in texts)
    assert "arm is safe" in texts
    assert (run.guardian is not None and run.guardian["cause"] == "gave up") is bath_too
