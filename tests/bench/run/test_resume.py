"""`teatbench resume` after any death: the run goes on at its first trial without a result, and ends
as if nothing had been; on a rig whose world died with the bench or went on without it, with a truth
that is touched or carried, and with ``--record``.
"""

from __future__ import annotations

import errno
import os
import re
import shutil
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.cli.main import main
from bench.config import ConfigError
from bench.record.check import check_record
from bench.record.reader import RunRecord, read_run
from bench.record.recording import Recording, RecordingWriter
from bench.record.state import run_lock
from bench.record.writer import Store
from bench.report.page import write_run_report
from bench.results.status import LIVE, read_status
from bench.rig.lock import locked
from bench.rig.opening import open_instruments
from bench.run import trial as run_trial
from bench.run.events import EVENT, Events, RunState, read_events
from bench.run.interruptions import leave_request
from bench.run.recordings import Recorder
from bench.run.resume import what_is_left
from bench.run.start import RunOptions
from bench.truth.carrying import REFERENCE_FACT, CarriedTruth
from instruments.captures.capture import CaptureFile, read_capture
from instruments.errors import LinkError
from tests.bench.commands import Said
from tests.bench.forked import begin
from tests.bench.killed_runs import (
    Person,
    Silent,
    killed_at,
    killed_while,
    only_run,
    results,
    resume,
    start,
    steps_of,
)
from tests.bench.operated_runs import CHECK_POINT, SCRIPT, STAGE, files, texts
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.slow

if sys.platform == "win32":
    pytest.skip("forks benches, and kills them", allow_module_level=True)

HEADER = ("teatbench", "command", "machine")
KILLS = os.environ.get("TEATBENCH_KILLS")
TOUCHED_KILLS, CARRIED_KILLS = int(KILLS or 2), int(KILLS or 1)
FIRST, SECOND, THIRD = TRIALS = ["001-place-1-1", "002-place-2-1", "003-place-3-1"]


def carry(more: str = "") -> str:
    """The script with a truth that the stage carries, and ``more`` keys about that."""
    truth = f'[truth]\nmode = "carry"\nregistration = "first"\n{more}\n[[requirements]]'
    script = SCRIPT.replace(", z_mm = 6.0, yaw_deg = 4.0", "")
    return script.replace("[[requirements]]", truth, 1)


def equal_after_resuming(folder: Path, out: str, why: str = "") -> None:
    """As the undisturbed run in ``whole``."""
    assert resume(folder, out)[1] is RunState.FINISHED, why
    assert results(only_run(folder, out)) == results(only_run(folder, "whole")), why


def killed_at_random(folder: Path, steps: int, seed: int, kills: int) -> None:
    for number, step in enumerate(np.random.default_rng(seed).integers(1, steps, kills).tolist()):
        out = f"killed-{number}"
        assert killed_at(step, partial(start, folder, out)), step
        if (folder / out).is_dir():  # else killed before there was a run at all
            equal_after_resuming(folder, out, f"killed at step {step} of {steps}")


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int]:
    """The folder of a whole run in ``whole``, and how many steps its clock made."""
    folder = tmp_path_factory.mktemp("undisturbed")
    emulation = "placement_error_mm = 1.0\nprompt_s = 2.0"
    files(folder, stage=STAGE, check_point=CHECK_POINT, touches=2, emulation=emulation)
    return folder, steps_of(lambda: start(folder, "whole"))


@pytest.mark.timeout(max(120, 60 * TOUCHED_KILLS))
def test_killed_at_random_moments_and_resumed_equals_undisturbed(
    undisturbed: tuple[Path, int],
) -> None:
    folder, steps = undisturbed
    wanted = results(only_run(folder, "whole"))
    tables = ("trials", "frames", "touches", "truth", "detections", "scores", "bath")
    assert all(wanted[table] for table in tables)
    killed_at_random(folder, steps, 9, TOUCHED_KILLS)


@pytest.mark.weekly
@pytest.mark.timeout(max(120, 60 * CARRIED_KILLS))
def test_killed_at_random_moments_with_a_carried_truth_equals_undisturbed(tmp_path: Path) -> None:
    files(tmp_path, stage=STAGE, script=carry("check_every = 1\n"))
    steps = steps_of(lambda: start(tmp_path, "whole"))
    whole = read_run(only_run(tmp_path, "whole"))
    assert [trial.how for trial in whole.trials] == ["touched", "carried", "carried"]
    killed_at_random(tmp_path, steps, 14, CARRIED_KILLS)


def test_two_runs_with_one_seed_are_the_same_but_for_real_time_and_a_capture_changes_nothing(
    undisturbed: tuple[Path, int], tmp_path: Path
) -> None:
    folder, _ = undisturbed
    with CaptureFile(tmp_path / "twin.jsonl", dict.fromkeys(HEADER, "")) as capture:
        start(folder, "twin", how=RunOptions(capture=capture))
    links = read_capture(capture.path).links
    assert list(links) == ["arm", "bath", "stage"]
    for (conversation,) in links.values():
        assert (conversation.closed_s is None, conversation.broke) == (False, "")
        assert len(conversation.exchanges) > 50
    one, other = (read_run(only_run(folder, out)) for out in ("whole", "twin"))
    assert results(one.folder) == results(other.folder)
    first, second = ([(e["t_s"], e["kind"], e["text"]) for e in run.events] for run in (one, other))
    assert first == second
    for path in (frame["path"] for trial in one.trials for frame in trial.frames):
        assert (one.folder / path).read_bytes() == (other.folder / path).read_bytes()
    assert one.head is not None
    assert other.head is not None
    assert one.head.digest == other.head.digest, "the chain without real time"


def resumed_on_every_surface(folder: Path, out: str, progress: Person) -> list[int]:
    """Whose screen and status count from the first moment what is done; the JSON lines' counts."""
    events, heads, show = Events(progress), set[str](), progress.state

    def state(text: str) -> None:
        show(text)
        heads.add(status.headline if (status := events.status()) else "")

    progress.state = state  # type: ignore[method-assign]
    assert resume(folder, out, events)[1] is RunState.FINISHED
    assert heads - {"running: all 3 trials done", "running: going to safe"} == {
        "running: trial 3 of 3"
    }
    lines = list(read_events(only_run(folder, out)))
    begun = max(at for at, one in enumerate(lines) if "trials done before" in one.get("text", ""))
    return [line["done"] for line in lines[begun:] if line["what"] == "trial"]


@pytest.mark.weekly
def test_killed_twice_on_its_way_and_once_while_it_catches_up(
    undisturbed: tuple[Path, int],
) -> None:
    folder, steps = undisturbed
    assert killed_at(int(0.9 * steps), lambda: start(folder, "often"))
    page = write_run_report(only_run(folder, "often")).page
    assert killed_at(int(0.3 * steps), lambda: resume(folder, "often"))
    assert not page.exists(), "it would still say that the run ended before"
    assert not page.with_name("run.json").exists()
    progress = Person("", ())
    trials = resumed_on_every_surface(folder, "often", progress)
    again = "2 trials done before, gone through again"
    assert {text.split(":")[0] for text in progress.states if again in text} == {
        *(again, f"place-1; {again}", f"place-2; {again}")
    }
    run = read_run(only_run(folder, "often"))
    assert results(run.folder) == results(only_run(folder, "whole"))
    assert (progress.warned, progress.seen, trials) == ([], "place-3", [2, 3])
    assert len(run.facts["deaths"]) == 1, "the death amid catching up is no trial's"
    again = "gone through again on the emulated rig: 2 with the same touches"
    assert texts(run, "resumed") == [
        f"session 3 goes on after {len(run.trials) - 1} trials, {again}"
    ]


def test_a_trial_that_killed_the_bench_twice_is_skipped_and_reported(
    undisturbed: tuple[Path, int],
) -> None:
    folder, _ = undisturbed
    for go, deaths in ((start, 0), (resume, 1), (resume, 2)):
        work = partial(go, folder, "poison")
        assert killed_while(f"'{SECOND}'", "write_trial", run_trial, work) is (deaths < 2)
    run = read_run(only_run(folder, "poison"))
    assert run.ending == "finished"
    assert [trial.id for trial in run.trials] == [FIRST, THIRD]
    assert [(row["trial"], row["reason"]) for row in run.skipped] == [
        (SECOND, "the bench died in it 2 times, and doesn't try it again")
    ]
    assert main(["report", str(run.folder)]) in (0, 1, 4)
    page = (run.folder / "report" / "index.html").read_text(encoding="utf-8")
    assert "died in it 2 times" in page


def test_of_a_finished_run_a_report_may_be_left_and_its_states_are_in_its_record(
    undisturbed: tuple[Path, int], said: Said, capsys: pytest.CaptureFixture[str]
) -> None:
    run = read_run(only_run(undisturbed[0], "whole"))
    assert not (run.folder / "report").exists()
    assert main(["resume", str(run.folder)]) in (0, 1, 4)
    assert "the report was not written yet" in capsys.readouterr().out
    assert (run.folder / "report" / "index.html").is_file()
    assert "is finished: nothing is left to do" in said(2, "resume {}", run.folder).err
    assert texts(run, EVENT) == ["preparing", "settling", "running", "safing", "finished"]
    assert [trial.id for trial in run.trials] == TRIALS


def test_a_run_that_is_under_way_is_left_alone(undisturbed: tuple[Path, int]) -> None:
    folder, _ = undisturbed
    assert killed_at(200, lambda: start(folder, "busy"))
    run = only_run(folder, "busy")
    before = read_run(run)
    with locked(run_lock(run), "", print):
        refused = begin(["resume", run])
        said, _ = refused.communicate(timeout=PATIENCE_S)
    assert refused.returncode == 3
    assert re.search(r"run: another bench has it: pid \d+, host [^,]+, since [^,]+\. Wait", said)
    assert read_run(run).facts == before.facts


def test_a_rig_or_script_that_has_changed_is_refused(tmp_path: Path, said: Said) -> None:
    files(tmp_path)
    assert killed_at(10, lambda: start(tmp_path))
    run, script = only_run(tmp_path, "runs"), tmp_path / "script.toml"
    text = script.read_text(encoding="utf-8")
    script.write_text(text.replace("x_mm = 12.0", "x_mm = 11.0"), encoding="utf-8")
    assert "script.toml has changed since the run" in said(2, "resume {}", run).err
    script.unlink()
    assert f"a copy of it is {run / 'script.toml'}" in said(2, "resume {}", run).err
    with pytest.raises(ConfigError, match="is no run"):
        what_is_left(tmp_path, [])


def killed_in_the_last_trial(folder: Path, out: str) -> RunRecord:
    assert killed_while(f"'{THIRD}'", "write_trial", run_trial, lambda: start(folder, out))
    return read_run(only_run(folder, out))


@pytest.fixture
def nothing_is_gone_through_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bench.run.start.in_virtual_time", lambda *_, **__: False)


@pytest.mark.usefixtures("nothing_is_gone_through_again")
def test_a_world_that_went_on_is_prepared_anew_and_what_is_redone_is_kept_apart(
    tmp_path: Path,
) -> None:
    files(tmp_path, stage=STAGE, check_point=CHECK_POINT)
    before = killed_in_the_last_trial(tmp_path, "runs")
    kept = results(before.folder)
    assert resumed_on_every_surface(tmp_path, "runs", progress := Person("", ())) == [2, 3]
    assert progress.seen == "place-3"
    after, now = read_run(before.folder), results(before.folder)
    assert [trial.id for trial in after.trials] == TRIALS
    for table in ("trials", "frames", "touches", "truth", "detections", "found", "scores"):
        assert all(row in now[table] for row in kept[table]), (
            f"nothing finished is lost or changed: {table}"
        )
    assert after.facts["arm check before"] == before.facts["arm check before"]
    assert len(after.facts["arm check before, session 2"]["touches"]) in (2, 3)
    assert after.facts["identities, session 2"] == after.facts["identities"]
    assert texts(after, "resumed") == ["session 2 goes on after 2 trials"]


@pytest.mark.weekly
@pytest.mark.usefixtures("nothing_is_gone_through_again")
def test_a_carried_truth_goes_on_in_a_world_that_went_on(tmp_path: Path) -> None:
    files(tmp_path, stage=STAGE, script=carry())
    left = killed_in_the_last_trial(tmp_path, "runs")
    resume(tmp_path, "runs")
    after = read_run(left.folder)
    assert [trial.how for trial in after.trials] == ["touched", "carried", "carried"], (
        "the reference of the record is used further"
    )
    assert after.facts[REFERENCE_FACT]["trial"] == FIRST
    assert {check["held"] for check in after.checks} <= {0, 1}
    assert after.checks[-1]["after_trial"] == THIRD


@pytest.mark.weekly
def test_killed_just_after_a_check_of_the_carried_truth_that_fails(tmp_path: Path) -> None:
    """The check is in the record, the trial that it came before is not: gone through again, it is
    not written a second time.
    """
    files(tmp_path, stage=STAGE, script=carry("check_every = 1\ncheck_limit_mm = 0.01\n"))
    start(tmp_path, "whole")
    assert killed_while("'invalid'", "event", Store, lambda: start(tmp_path, "runs"))
    assert read_run(only_run(tmp_path, "runs")).checks
    equal_after_resuming(tmp_path, "runs")
    assert check_record(only_run(tmp_path, "runs")).whole


def test_a_run_that_somebody_ended_goes_on_too(tmp_path: Path) -> None:
    files(tmp_path)
    folder, ending = start(tmp_path, progress=Person("place-3", ["abort"]))
    assert (ending, len(read_run(folder).trials)) == (RunState.ABORTED, 2)
    assert read_status(folder).why.endswith(" All instruments are safe.")
    assert resume(tmp_path, "runs")[1] is RunState.FINISHED
    run = read_run(folder)
    assert len(run.trials) == 3
    assert run.facts["deaths"] == {}, "an end that was asked for is no death"


def test_a_run_that_ended_before_it_opened_anything_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: Any, **__: Any) -> Any:
        raise LinkError("arm", "nothing takes the connection")

    files(tmp_path)
    monkeypatch.setattr("bench.run.start.open_instruments", fails)
    status = read_status(start(tmp_path)[0])
    assert status.why.endswith(" nothing takes the connection. Nothing was switched on.")
    assert not any("Look whether" in line for line in status.next)


def test_what_a_dead_session_left_is_void_before_the_next_one_opens_anything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is left from then on is meant for the next one."""
    files(tmp_path)
    run = killed_in_the_last_trial(tmp_path, "runs").folder
    leave_request(run, "abort")
    (run / "console").mkdir(exist_ok=True)
    for name in (LIVE, "left.jpg"):
        (run / "console" / name).write_bytes(b"{}")
    opened, there = open_instruments, list[bool]()

    def opening(*given: Any, **more: Any) -> Any:
        there.append((run / "console").exists())
        leave_request(run, "abort")
        return opened(*given, **more)

    progress = Silent()
    with monkeypatch.context() as patched:
        patched.setattr("bench.run.start.open_instruments", opening)
        assert resume(tmp_path, "runs", progress)[1] is RunState.ABORTED
    assert there == [False]
    assert progress.warned == ["Left in the last session and not taken; it is void now: abort"]
    assert resume(tmp_path, "runs")[1] is RunState.FINISHED


TWO = SCRIPT.replace("}, {}]", "}]")


def recording(folder: Path, out: str) -> Path:
    return folder / f"recorded-{out}"


def record(folder: Path, out: str, progress: Silent | None = None) -> RunState:
    """The script in ``folder``, recorded beside its run."""
    how = RunOptions(record=recording(folder, out))
    return start(folder, out, progress, how)[1]


def content(path: Path) -> dict[str, bytes]:
    return {
        file.relative_to(path).as_posix(): file.read_bytes()
        for file in path.rglob("*")
        if file.is_file()
    }


def recorded_whole(folder: Path, script: str) -> Path:
    """Recorded without a disturbance, as ``whole``."""
    files(folder, stage=STAGE, script=script)
    assert record(folder, "whole") is RunState.FINISHED
    whole = Recording(recording(folder, "whole"))
    assert len(whole.truth) == len(whole.frames) > 1
    return folder


@pytest.fixture(scope="module")
def touched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded_whole(tmp_path_factory.mktemp("touched"), TWO)


@pytest.fixture(scope="module")
def carried(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A truth that is carried waits for its check."""
    return recorded_whole(tmp_path_factory.mktemp("carried"), carry("check_every = 1\n"))


def recording_equal_after_resuming(folder: Path, out: str) -> None:
    progress = Silent()
    assert resume(folder, out, progress)[1] is RunState.FINISHED
    assert not [text for text in progress.warned if "record" in text]
    assert results(only_run(folder, out)) == results(only_run(folder, "whole"))
    assert content(recording(folder, out)) == content(recording(folder, "whole"))


@pytest.mark.parametrize(
    ("truth", "words", "method", "kind"),
    [
        pytest.param("touched", f"'{SECOND}'", "trial", Recorder, marks=pytest.mark.weekly),
        pytest.param(
            "touched", f"'{SECOND}'", "add_truth", RecordingWriter, marks=pytest.mark.weekly
        ),
        pytest.param("touched", f"making {SECOND}", "replace", Path, marks=pytest.mark.weekly),
        ("carried", f"'{SECOND}'", "stored", CarriedTruth),
        pytest.param("carried", "'check touch'", "event", Store, marks=pytest.mark.weekly),
        pytest.param("carried", f"'{THIRD}'", "settled", Recorder, marks=pytest.mark.weekly),
    ],
    ids=[
        "finished but not recorded",
        "frames without their truth",
        "frames half written",
        "carried and not yet checked",
        "just checked",
        "checked but not recorded",
    ],
)
def test_killed_where_run_and_recording_are_apart(
    truth: str, words: str, method: str, kind: type, request: pytest.FixtureRequest
) -> None:
    folder, out = request.getfixturevalue(truth), f"{method}-{kind.__name__}"
    assert killed_while(words, method, kind, lambda: record(folder, out))
    assert content(recording(folder, out)) != content(recording(folder, "whole"))
    recording_equal_after_resuming(folder, out)


@pytest.mark.weekly
def test_a_recording_that_is_gone_is_made_anew_from_the_runs_folder(touched: Path) -> None:
    assert killed_while(f"'{SECOND}'", "trial", Recorder, lambda: record(touched, "gone"))
    shutil.rmtree(recording(touched, "gone"))
    recording_equal_after_resuming(touched, "gone")


@pytest.mark.weekly
def test_frames_of_another_run_are_left_alone_and_the_run_goes_on_without(touched: Path) -> None:
    assert killed_while(f"'{SECOND}'", "trial", Recorder, lambda: record(touched, "another"))
    path, progress = recording(touched, "another"), Silent()
    shutil.rmtree(path)
    (path / "frames" / "001-another-1").mkdir(parents=True)
    (path / "frames" / "001-another-1" / "left.png").write_bytes(b"precious")
    assert resume(touched, "another", progress)[1] is RunState.FINISHED
    note = "has frames of another run, 001-another-1 for one. The run goes on without a recording."
    assert [note in text for text in progress.warned] == [True]
    assert content(path) == {"frames/001-another-1/left.png": b"precious"}


def test_a_recording_that_cannot_be_written_is_reported_once_and_ends_no_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    files(tmp_path, script=TWO)
    monkeypatch.setattr(RecordingWriter, "add_truth", full)
    progress = Silent()
    assert record(tmp_path, "runs", progress) is RunState.FINISHED
    note = [text for text in progress.warned if "the recording in" in text]
    assert len(note) == 1
    assert "ends here: No space left on device. Make room. The run goes on" in note[0]
    assert len(read_run(only_run(tmp_path, "runs")).trials) == 2
    assert len(Recording(recording(tmp_path, "runs")).frames) == 1
