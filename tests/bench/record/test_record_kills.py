"""Kill -9 at random moments of a writing process, its opening and going on included: the record
always opens and tells the truth.

A process that dies so leaves what it had handed to the system; what a power cut leaves is a matter
of the syncs (test_store_durable).
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import pytest

from bench.config import ConfigError
from bench.record.check import check_record
from bench.record.reader import opened, read_run
from bench.record.schema import DATABASE
from bench.record.writer import Store
from instruments.clock import wall_time
from tests.bench.record.test_record import facts, trial

RUNS = 10 if os.environ.get("TEATBENCH_WEEKLY") else 1
KILLS_A_RUN = 20 if os.environ.get("TEATBENCH_WEEKLY") else 12
MOST_TRIALS = 1  # that are done before a process is killed
AT_MOST_S = 0.05  # from there: a few trials on an idle machine, a part of one on a busy one
ROOT = Path(__file__).resolve().parents[3]

pytestmark = pytest.mark.skipif(
    not (hasattr(os, "fork") and hasattr(signal, "SIGKILL")),
    reason="this system has no fork or no SIGKILL",
)

NURSERY = """
import os, sys
from pathlib import Path
from tests.bench.record.test_record_kills import write_on
for line in sys.stdin:
    child = os.fork()
    if not child:
        write_on(Path(line.strip()))
    os.write(1, f"child {child}\\n".encode())
    os.write(1, f"gone {os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])}\\n".encode())
"""


def write_on(folder: Path) -> None:
    """Begin a run, or go on with it at the first trial that it doesn't have; say of each when it is
    done. Never returns.
    """
    try:
        store = Store(folder) if folder.exists() else Store.create(folder, {"script.toml": "x = 1"})
        facts(store)
        for number in range(trials_in(folder) + 1, 10_000):
            with store.step():
                store.event(float(number), "state", f"trial {number}", wall_time())
                store.event(float(number), "state", "capturing", wall_time())
            store.finished(trial(store, number))
            os.write(1, f"done {number}\n".encode())
    finally:
        os._exit(1)  # nobody killed it: it failed


def trials_in(folder: Path) -> int:
    with opened(folder) as db:
        return int(db.execute("SELECT count(*) FROM trials").fetchone()[0])


@dataclass(frozen=True, slots=True)
class Nursery:
    """A process that has loaded everything and bears writers."""

    process: subprocess.Popen[bytes]

    def born_and_killed(self, folder: Path, trials: int, after_s: float) -> int:
        """Have a writer at ``folder`` and kill it ``after_s`` after so many trials; gives back the
        last that it called done, or 0.
        """
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(f"{folder}\n".encode())
        self.process.stdin.flush()
        done = child = 0
        while line := self.process.stdout.readline().split():
            if line[0] == b"gone":
                assert int(line[1]) == -signal.SIGKILL, "the writer failed before it was killed"
                return done
            if line[0] == b"child":
                child = int(line[1])
            else:
                done, trials = int(line[1]), trials - 1
            if child and trials <= 0:
                time.sleep(after_s)
                os.kill(child, signal.SIGKILL)
                child = 0
        raise AssertionError("the nursery is gone")


@contextmanager
def nursery() -> Iterator[Nursery]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        [sys.executable, "-c", NURSERY],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        cwd=ROOT,
        env=environment,
    )
    with process:
        try:
            yield Nursery(process)
        finally:
            process.kill()


def look(folder: Path, done: int) -> int:
    """How many trials there are: all that were done, each whole, and at most one more."""
    checked = check_record(folder)
    assert checked.whole, checked.findings
    with opened(folder) as db:
        (begun,) = db.execute("SELECT count(*) FROM facts WHERE key = 'detectors'").fetchone()
    if not begun:
        with pytest.raises(ConfigError, match="never began"):
            read_run(folder)
        assert done == 0
        return 0
    run = read_run(folder)
    numbers = [int(one.head["number"]) for one in run.trials]
    assert numbers == list(range(1, len(numbers) + 1))
    assert done <= len(numbers)
    for one in run.trials:
        assert len(one.frames) == len(one.truth) == len(one.detections) == len(one.found) == 1
        image = cv2.imread(str(folder / one.frames[0]["path"]), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        assert (image == int(one.head["number"]) % 256).all()
    return len(numbers)


@pytest.mark.slow
def test_a_run_killed_at_random_moments_always_opens_and_loses_and_invents_nothing(
    tmp_path: Path,
) -> None:
    chance = random.Random(9)
    with nursery() as writers:
        for run in range(RUNS):
            folder, before = tmp_path / str(run), 0
            for _ in range(KILLS_A_RUN):
                done = writers.born_and_killed(
                    folder, chance.randint(0, MOST_TRIALS), chance.uniform(0.0, AT_MOST_S)
                )
                if not folder.exists():
                    assert done == before == 0
                    continue
                assert (folder / DATABASE).is_file(), "a run that is there has its database"
                there = look(folder, done)
                assert before <= there <= max(done, before) + 1
                before = there
            assert before > 0, "some writers are let finish a trial"
