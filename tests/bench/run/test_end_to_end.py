"""The main job on the emulated rig: what a user gets, the same every time, and safe at every
end.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from bench.record.reader import RunRecord, read_run
from bench.safety.stability import State
from tests.bench.campaign.small_campaign import write_small_rig
from tests.bench.commands import Said, teatbench, words
from tests.conftest import first_trials

pytestmark = pytest.mark.slow


@dataclass(frozen=True)
class Done:
    code: int
    run: RunRecord
    recording: Path


def run_command(arguments: Sequence[str], out: Path) -> tuple[int, Path]:
    """Run a command that leaves one run in ``out``; its exit code and the run's folder."""
    code = teatbench("{} --out {}", arguments, out)
    (folder,) = out.iterdir()
    return code, folder


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With small pictures."""
    return write_small_rig(tmp_path_factory.mktemp("rig"))


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory, short_script: Path, rig: Path) -> Done:
    out = tmp_path_factory.mktemp("first")
    recording = tmp_path_factory.mktemp("recording") / "new"
    command = words("run {} --rig {} --record {}", short_script, rig, recording)
    code, folder = run_command(command, out)
    return Done(code, read_run(folder), recording)


def test_the_bench_does_its_work_and_the_exit_code_is_the_verdict(done: Done) -> None:
    table = json.loads((done.run.folder / "report" / "run.json").read_text(encoding="utf-8"))
    assert done.code == {"met": 0, "not met": 1, "inconclusive": 4}[table["verdict"]]
    assert done.run.ending == "finished"
    names = "non_vertical overlapping spurious_teat hot_body_at_base hot_body_at_ends cooler_bodies"
    assert [trial.head["situation"] for trial in done.run.trials] == names.split()


def test_every_capture_is_in_a_stable_bath(done: Done) -> None:
    assert {trial.head["bath_state"] for trial in done.run.trials} == {State.STABLE.value}
    assert all(abs(trial.head["bath_c"] - 33.0) <= 0.15 for trial in done.run.trials)
    assert done.run.bath[0, 1] == pytest.approx(20.0, abs=0.1)
    steps = np.diff(done.run.bath[:, 0])
    assert steps.max() <= 1.5, (
        "the bath is watched at least once a second or so, also while the arm reads and the stage"
        " moves"
    )


def test_the_touched_truth_is_as_near_to_the_exact_one_as_the_arm_is_good(done: Done) -> None:
    rows = [row for trial in done.run.trials for row in trial.truth]
    off = [
        np.array([r["x_mm"], r["y_mm"], r["z_mm"]]) - np.array(json.loads(r["exact_mm"]))
        for r in rows
    ]
    distances = np.linalg.norm(off, axis=1)
    assert len(rows) == 24
    assert 0.02 < distances.mean() < 0.6
    assert all(0.23 < row["u_mm"] < 0.5 for row in rows)


def test_trials_csv_has_a_line_a_trial(done: Done) -> None:
    with (done.run.folder / "report" / "trials.csv").open(encoding="utf-8", newline="") as file:
        lines = list(csv.DictReader(file))
    assert [line["trial"] for line in lines] == [trial.id for trial in done.run.trials]
    for line, trial in zip(lines, done.run.trials, strict=True):
        assert int(line["found"]) == trial.scores["thesis"].counts.matched
        assert int(line["found"]) + int(line["missed"]) == int(line["visible"])


def test_the_recording_scores_the_same(done: Done, tmp_path: Path) -> None:
    _, folder = run_command(["score", str(done.recording)], tmp_path)
    again = read_run(folder)
    assert len(again.trials) == len(done.run.trials)
    for one, other in zip(done.run.trials, again.trials, strict=True):
        first, second = (t.scores["thesis"].as_dict() for t in (one, other))
        for wall in ("seconds", "in_time", "success"):
            del first[wall], second[wall]
        assert first == second


@pytest.mark.weekly
def test_another_seed_gives_other_noise(
    done: Done, short_script: Path, rig: Path, tmp_path: Path
) -> None:
    command = words("run {} --rig {} --seed 2", first_trials(short_script, 1), rig)
    other = read_run(run_command(command, tmp_path)[1])
    assert repr(done.run.bath[: len(other.bath)]) != repr(other.bath)
    assert repr(done.run.trials[0].touches) != repr(other.trials[0].touches)
    one, two = ((run.folder / run.trials[0].frames[0]["path"]) for run in (done.run, other))
    assert one.read_bytes() != two.read_bytes()


def test_the_report_can_be_written_again(done: Done, said: Said) -> None:
    page = done.run.folder / "report" / "index.html"
    before = page.read_bytes()
    page.unlink()
    assert str(page) in said(done.code, "report {}", done.run.folder).out.replace("\n", "")
    assert page.read_bytes() == before


def test_the_report_names_the_digest_by_which_the_record_is_checked(done: Done) -> None:
    head = read_run(done.run.folder).head
    assert head is not None
    page = (done.run.folder / "report" / "index.html").read_text(encoding="utf-8")
    assert head.wall_digest in page
    assert teatbench("store check {} --digest {}", done.run.folder, head.wall_digest) == 0
