"""A queue of scripts on one rig: open and warm from one that finished to the next, and safe at the
end, whatever ends it.
"""

from __future__ import annotations

import errno
import json
import os
import platform
import re
import signal
import sqlite3
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from junitparser import JUnitXml

from bench.cli.main import main
from bench.record.reader import RunRecord, read_run
from bench.record.schema import Row
from bench.record.writer import Store
from bench.report.runs import list_runs
from bench.results.exports import HAS_VERDICT
from bench.results.queue import DIED, ENDED, QueueNote, QueueStatus, queues, read_queue
from bench.results.status import Safe, status_of
from bench.rig.emulated_rig import EmulatedRig
from bench.run import start
from bench.run.engine import STAYS_WARM, Engine
from bench.safety.bath_monitor import WATCHING
from instruments.clock import stopwatch_s, wall_time
from tests.bench.campaign.small_campaign import write_small_rig
from tests.bench.operated_runs import ONE
from tests.examples import few

pytestmark = pytest.mark.slow
NO_ROOM = "NOT ENOUGH ROOM"


@pytest.fixture
def scripts(tmp_path: Path) -> list[str]:
    """Three scripts; the last one heats to another temperature."""
    write_small_rig(tmp_path)
    paths = [tmp_path / f"{name}.toml" for name in ("a", "b", "c")]
    for path in paths:
        warmer = ONE.replace("set_point_c = 33.0", "set_point_c = 33.5")
        path.write_text(warmer if path.stem == "c" else ONE, encoding="utf-8")
    return [str(path) for path in paths]


def run(scripts: list[str], *more: str) -> tuple[int, QueueStatus, list[RunRecord]]:
    """The exit code of `run`, its queue, and the runs."""
    here = Path(scripts[0]).parent
    out = here / "runs"
    code = main(["run", *scripts, "--rig", str(here / "rig.toml"), "--out", str(out), *more])
    queue = next(queues(out))
    return code, queue, [read_run(out / one.run) for one in queue.scripts if one.run]


def stood_up(monkeypatch: pytest.MonkeyPatch) -> list[EmulatedRig]:
    """The emulated rigs, once they are opened."""
    rigs: list[EmulatedRig] = []
    stand_up = EmulatedRig.__init__

    def instead(self: EmulatedRig, *given: Any, **more: Any) -> None:
        rigs.append(self)
        stand_up(self, *given, **more)

    monkeypatch.setattr(EmulatedRig, "__init__", instead)
    return rigs


def kinds(run: RunRecord, kind: str) -> list[str]:
    return [event["text"] for event in run.events if event["kind"] == kind]


def bath_safe(run: RunRecord) -> Safe:
    (bath,) = (one for one in status_of(run).instruments if one.name == "bath")
    return bath.safe


def test_the_rig_stays_open_and_warm_and_is_safe_at_the_end(
    scripts: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    opened, left_s, settling_s = stood_up(monkeypatch), list[float](), list[float]()
    monkeypatch.setattr("bench.run.start.time_left", lambda seconds: left_s.append(seconds))
    monkeypatch.setattr(
        "bench.run.estimate.estimate_text", lambda of, _: settling_s.append(of.settling_s)
    )
    code, queue, (first, second, third) = run(scripts)
    assert left_s[1] < min(left_s[0], left_s[2]), "the bath settles once, and at another set point"
    assert [seconds > 0.0 for seconds in settling_s] == [True, False, True]
    assert code == 0
    assert len(opened) == 1
    assert queue.headline == "ended: 3 of 3 scripts finished"
    assert kinds(first, "safe") == kinds(second, "safe") == [STAYS_WARM]
    assert "bath is safe" in kinds(third, "safe")
    safe = [bath_safe(one) for one in (first, second, third)]
    assert safe == [Safe.IN_USE, Safe.IN_USE, Safe.READ_BACK]
    assert "settling" in kinds(first, "run state")
    assert "settling" not in kinds(second, "run state")  # the bath was stable, and stayed so
    assert "settling" in kinds(third, "run state")  # at another set point
    assert second.facts["asked"]["warm"]
    readings = [one.bath[:, 0] for one in (first, second, third)]
    for before, after in pairwise(readings):  # watched without a gap
        assert 0.0 <= after[0] - before[-1] <= 1.5
    said = capsys.readouterr().out
    page = Path(scripts[0]).parent / "runs" / f"{queue.name}.html"
    assert f"Page: {page}" in said
    assert "Queue of 3 scripts" in page.read_text(encoding="utf-8")
    assert json.loads(json.dumps(queue.as_dict()))["scripts"][0]["status"]["state"] == "finished"


def fails(error: BaseException) -> Callable[[Engine], None]:
    """An engine whose second run ends so, amid its work."""
    work, count = Engine._work, list[int]()

    def instead(self: Engine) -> None:
        count.append(1)
        if len(count) == 2:
            self._take_over()
            raise error
        work(self)

    return instead


@pytest.mark.parametrize(("third", "begin"), few([(NO_ROOM, 2), ("", 3)], 2))
def test_a_disk_that_is_full_amid_one_script_ends_it_alone_and_without_room_none_follows(
    scripts: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    third: str,
    begin: int,
) -> None:
    """The watch of the second script finds it full; then there is room again, or none."""
    bath = Store.bath

    def full(self: Store, reading: Row) -> None:
        if self.folder.name.endswith("-b"):
            raise sqlite3.OperationalError("database or disk is full")
        bath(self, reading)

    def no_space(*_: object, **__: object) -> Path:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Store, "bath", full)
    of = iter(["", "", third])  # of all, of the second, of the third
    monkeypatch.setattr("bench.run.estimate.no_room", lambda *_: next(of))
    if third:
        monkeypatch.setattr("bench.report.page.write_report", no_space)
        monkeypatch.setattr("bench.report.runs.write_runs", no_space)
    code, queue, runs = run(scripts)
    assert (code, [one.ending for one in runs]) == (3, ["finished", "faulted", "finished"][:begin])
    assert kinds(runs[1], "fault") == ["the record could not be written: the disk is full"]
    assert bath_safe(runs[-1]) is Safe.READ_BACK
    if not third:
        assert not runs[2].facts["asked"]["warm"], "it opened the rig anew"
        return
    assert queue.ended == NO_ROOM
    said = capsys.readouterr().out
    assert f"c and what follows are not begun. {NO_ROOM}" in said
    last = f"Queue: {queue.headline}\nPage: not written: No space left on device. Make room.\n"
    assert said.endswith(last)
    then = f"The run is kept. Make room, then: teatbench report {runs[0].folder}"
    assert f"{runs[0].folder / 'report'}: No space left on device. {then}" in said


@pytest.mark.weekly
def test_an_abort_ends_all(scripts: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Engine, "_work", fails(KeyboardInterrupt()))
    code, queue, (_, second) = run(scripts)
    assert code == 3
    assert queue.headline == "ended early, 1 of 3 scripts finished: a run was aborted"
    assert queue.scripts[2].text == "not begun"
    assert "bath is safe" in kinds(second, "safe")
    out = second.folder.parent
    (path,) = out.glob("queue-*/report/junit.xml")
    (case,) = [case for suite in JUnitXml.fromfile(str(path)) for case in suite]
    assert (case.classname, case.name) == ("c", HAS_VERDICT)
    assert case.result[0].message == f"not begun. The queue {queue.headline}."
    assert not list_runs(out).others


def test_a_queue_of_which_all_ran_has_no_errors_of_its_own(scripts: list[str]) -> None:
    run(scripts[:2])
    out = Path(scripts[0]).parent / "runs"
    assert len([*out.glob("*/report/junit.xml")]) == 2


@pytest.mark.weekly
def test_ctrl_c_between_two_scripts_ends_all(
    scripts: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    begun, count = start._begun, list[int]()

    def second(*given: Any, **more: Any) -> Store:
        count.append(1)
        if len(count) == 2:
            raise KeyboardInterrupt
        return begun(*given, **more)

    monkeypatch.setattr(start, "_begun", second)
    code, queue, (first,) = run(scripts, "--summary", summary := f"{scripts[0]}.md")
    assert code == 3
    assert queue.headline == f"ended early, 1 of 3 scripts finished: {start.INTERRUPTED}"
    assert Path(summary).read_text(encoding="utf-8").endswith(f"\nQueue: {queue.headline}\n")
    assert f"Queue: {queue.headline}" in capsys.readouterr().out
    assert bath_safe(first) is Safe.IN_USE  # as it left it; the rig was made safe after it


def test_a_queue_on_a_full_disk_still_says_how_it_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    note = QueueNote.begin(tmp_path, "emulated", ["a", "b"])
    monkeypatch.setattr("bench.results.queue.write_synced", full)
    note.runs(tmp_path / "run-of-a")
    note.ends(NO_ROOM)
    (queue,) = queues(tmp_path)
    assert (queue.scripts[0].run, queue.ended) == ("run-of-a", NO_ROOM)


@pytest.mark.parametrize(
    "amid", few([False, True], 2), ids=["between two scripts", "amid the second"]
)
def test_a_trip_ends_all(scripts: list[str], monkeypatch: pytest.MonkeyPatch, amid: bool) -> None:
    take_over = Engine._take_over

    def broken(self: Engine) -> None:
        if before := self.context.before:
            if amid:
                take_over(self)
            twin_of[0].bath.fault("sensor break")
            self.context.clock.sleep(60.0)
        if not (before and amid):
            take_over(self)
        self.context.watch.check()

    twin_of = stood_up(monkeypatch)
    monkeypatch.setattr(Engine, "_take_over", broken)
    code, queue, runs = run(scripts)
    assert code == 3
    assert queue.ended.startswith("tripped by interlock ")
    page = Path(scripts[0]).parent / "runs" / f"{queue.name}.html"
    assert ".." not in page.read_text(encoding="utf-8").partition("</header>")[0]
    assert [status_of(one).state for one in runs] == ["finished", "tripped"]
    assert [len(twin_of), twin_of[0].world.plant.running] == [1, False]
    assert bath_safe(runs[1]) is Safe.READ_BACK


def test_queues_of_one_second_have_a_file_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = wall_time()
    monkeypatch.setattr("bench.results.queue.wall_time", lambda: now)
    notes = [QueueNote.begin(tmp_path, "emulated", ["a", "b"]) for _ in range(3)]
    assert len({note.path for note in notes}) == len([*queues(tmp_path)]) == 3


def test_a_queue_whose_bench_died_says_so(tmp_path: Path) -> None:
    text = {"rig": "r", "scripts": ["a", "b"], "runs": ["gone"], "started": "2026-11-22T05:06:07"}
    path = tmp_path / "queue-1.json"
    path.write_text(json.dumps(text | {"ended": "", "host": platform.node(), "pid": 2**22 + 5}))
    queue = read_queue(path)
    assert queue.ended == DIED
    assert [one.text for one in queue.scripts] == ["not begun", "not begun"]


@pytest.mark.parametrize(
    "killed", few([False, True], 2), ids=["to the end", "killed amid the queue"]
)
def test_in_real_time_one_guardian_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, killed: bool
) -> None:
    take_over = Engine._take_over

    def bereft(self: Engine) -> None:
        """The second script begins, and its guardian is killed."""
        take_over(self)
        if killed and self.context.before:
            client = self.context.trips._guardian_client
            assert client
            os.kill(client.pid, signal.SIGKILL)
            self.context.wait(10.0)

    monkeypatch.setattr(Engine, "_take_over", bereft)
    rig = write_small_rig(tmp_path)
    warm = "\n[emulation]\nbath_start_c = 33.0\n"
    text = re.sub(r"\n\[stage\].*?(?=\n\[)", "", rig.read_text(encoding="utf-8"), flags=re.DOTALL)
    rig.write_text(text + warm, encoding="utf-8")
    path = tmp_path / "a.toml"
    path.write_text(ONE, encoding="utf-8")
    began_s = stopwatch_s()
    code, queue, (first, second) = run([str(path)] * (3 if killed else 2), "--realtime")
    assert stopwatch_s() - began_s > 2.0
    if killed:
        assert code == 3
        assert queue.headline.startswith("ended early, 1 of 3 scripts finished: tripped by")
        assert "guardian" in queue.ended
        assert queue.scripts[2].text == "not begun"
        assert (status_of(second).state, bath_safe(second)) == ("tripped", Safe.READ_BACK)
        return
    assert (code, queue.ended) == (0, ENDED)
    assert [one.facts["guardian"] for one in (first, second)] == [WATCHING] * 2
    assert kinds(first, "safe") == [STAYS_WARM]
    assert bath_safe(second) is Safe.READ_BACK
    assert not [*(tmp_path / "runs").glob("*/guardian-*")]  # it had nothing to do, and has ended
