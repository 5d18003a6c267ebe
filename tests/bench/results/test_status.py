"""One word for how a run stands, the same on each surface at the same moment."""

from __future__ import annotations

import html
import json
import re
import shutil
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import asdict, replace
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from junitparser import JUnitXml

from bench.console.watching import listed
from bench.record.schema import GUARDIAN
from bench.record.state import State, run_lock, state_of
from bench.record.writer import Store
from bench.results.headline import AFTER_SILENCE, BEGIN_ANEW, MISTAKE, missing_text
from bench.results.queue import QueueNote, queues
from bench.results.status import (
    GOING_TO_SAFE,
    INSTRUMENTS_FACT,
    LIVE,
    InstrumentStatus,
    LinkState,
    OpenPrompt,
    RunStatus,
    Safe,
    read_status,
)
from bench.rig.lock import locked
from bench.run.events import ENDED
from bench.run.notify import text_of
from bench.scoring.decisions import decide_rate
from bench.scoring.rates import Rate
from instruments.clock import wall_time
from instruments.operators.mailbox import FOLDER
from tests.bench.commands import Said
from tests.bench.small_run import KEPT

# the record's ending, and the events before it
ENDINGS: dict[State, tuple[str, tuple[str, ...]]] = {
    State.RUNNING: ("interrupted", ()),
    State.FAULTED: ("faulted", ("fault",)),
    State.TRIPPED: ("faulted", ("trip", "fault")),
    State.ABORTED: ("aborted", ("aborted",)),
    State.INTERRUPTED: ("interrupted", ()),
}


def stopped(state: State, folder: Path) -> Path:
    """A run of 18 trials with the results of two."""
    run = Path(shutil.copytree(KEPT, folder / "runs" / "a-run"))
    ending, kinds = ENDINGS[state]
    store = Store(run)
    for kind in kinds:
        store.event(None, kind, "bath: no answer for 12 s", wall_time())
    store.fact("planned", 18)
    store.fact("ending", ending)
    store.close()
    return run


@pytest.mark.slow
@pytest.mark.parametrize("state", ENDINGS)
def test_every_surface_has_the_same_word(state: State, tmp_path: Path, said: Said) -> None:
    run = stopped(state, tmp_path)
    with ExitStack() as stack:
        if state is State.RUNNING:
            stack.enter_context(locked(run_lock(run), "a run", print, "run"))
        table = said(0, "runs {}", run.parent).out
        assert state in table
        others = set(ENDINGS) - {state}
        assert not any(other in table for other in others)
        found = json.loads(said(0, "runs {} --json", run.parent).out)["runs"][0]
        status, card = read_status(run), listed(run.parent)[0]
        shown = said(3, "report {} --no-pdf --summary {}", run, tmp_path / "summary.md").out
        QueueNote.begin(run.parent, "a rig", ["a", "b"]).runs(run)
        assert next(queues(run.parent)).scripts[0].text == status.headline
    assert status.headline.startswith(f"{state}: ")
    assert (text_of(ENDED, status) or ("", ""))[1].startswith(f"{status.headline}\n")
    summary = (tmp_path / "summary.md").read_text(encoding="utf-8")
    assert state in summary
    assert not {"✓", "✕"} & {*summary}, "JUnit skips each of them"
    index = (run.parent / "index.html").read_text(encoding="utf-8")
    assert f'verdict-{state}"' in index
    written = json.loads((run / "report" / "run.json").read_text(encoding="utf-8"))
    junit = (run / "report" / "junit.xml").read_text(encoding="utf-8")
    page = (run / "report" / "index.html").read_text(encoding="utf-8")
    assert (found["state"], found["ending"]) == (state, ENDINGS[state][0])
    assert {one["verdict"] for one in found["results"]} == {state}
    assert {d["verdict"] for d in written["judgements"][0]["requirements"]} == {"inconclusive"}
    as_json = json.loads(json.dumps(status.as_dict()))
    for one in (found["status"], card["status"], written["status"]):
        assert json.loads(json.dumps(one)) == as_json
    assert f'<span class="word-text">{state}</span>' in page
    noted = " ".join(table.split())
    unescaped = re.sub(r"\\(.)", r"\1", summary)  # Markdown
    for line in status.next:
        for where in (noted, " ".join(shown.split()), page, junit, unescaped, index):
            assert line in html.unescape(where), where
    if state is State.RUNNING:
        assert "running: trial 3 of 18" in shown
        assert "trial 3 of 18" in junit
        for text in (shown, junit, page):
            assert "The bench died" not in text
            assert "teatbench resume" not in text
    else:
        assert f"Verdict: {state}" in shown
        assert "2 of 18 trials" in junit


@pytest.mark.slow
def test_what_to_do_next_can_be_done(tmp_path: Path, said: Said) -> None:
    """On the run's own rig; neither a scored recording nor cameras that play one go on."""
    run = stopped(State.FAULTED, tmp_path)
    store, rig = Store(run), tmp_path / "my rig.toml"
    store.fact("asked", {"rig": str(rig)})
    assert f"'teatbench check \"{rig}\"'" in read_status(run).then[-1]
    store.fact("asked", {"rig": str(rig), "recorded": True})
    then = read_status(run).then[-1]
    assert f"'teatbench check \"{rig}\"'" in then
    assert then.endswith("then give its command again, as it can't be resumed.")
    store.fact("asked", None)  # nobody asked for a script on a rig
    assert read_status(run).then[-1] == BEGIN_ANEW
    store.close()
    assert "can't be resumed" in said(2, "resume {}", run).err


def test_a_mistake_of_the_bench_is_no_fault_of_an_instrument(tmp_path: Path) -> None:
    run = stopped(State.FAULTED, tmp_path)
    store = Store(run)
    store.event(None, "fault", f"{MISTAKE}: KeyError: 'left'", wall_time())
    store.close()
    *_, then = read_status(run).then
    assert then.startswith("Report it, with the run's folder")
    assert "teatbench check" not in then


def said_by(folder: Path, status: RunStatus, **more: object) -> None:
    """What a run's bench has written of itself."""
    place = folder / FOLDER / LIVE
    place.parent.mkdir(exist_ok=True)
    place.write_text(json.dumps({"status": status.as_dict(), **more}), encoding="utf-8")


HERE = " at its terminal for 1 min"
BATH = InstrumentStatus(
    "bath", LinkState.ANSWERS, Safe.IN_USE, last="33.00 degC, stable", age_s=1.0
)
LIVES = RunStatus("a-run", "Short", State.RUNNING, "running", instruments=(BATH,), left_s=60.0)


def test_what_is_missing_is_said_beside_the_requirement() -> None:
    within = partial(decide_rate, "within 5 mm", required=0.95, confidence=0.95)
    shown = "within 5 mm (54 more poses without a failure would show it)"
    assert missing_text(within(Rate(26, 26))) == shown
    assert missing_text(within(Rate(9, 59))) == "within 5 mm"


def test_trials_that_were_skipped_are_counted() -> None:
    ended = replace(LIVES, state=State.FINISHED, verdicts={"fused": "met"}, done=16, planned=18)
    assert ended.headline == "met: 16 of 18 trials"
    assert replace(LIVES, step=GOING_TO_SAFE).headline == "running: going to safe"
    assert replace(ended, skipped=2).headline == "met: 16 of 18 trials, 2 skipped"


def test_a_bench_that_hangs_has_its_last_words_with_their_age(tmp_path: Path) -> None:
    run = stopped(State.RUNNING, tmp_path)
    then = wall_time() - timedelta(seconds=40)
    asked = OpenPrompt("touch", waited_s=30.0)
    said_by(run, replace(LIVES, wall_time=then.isoformat(), asked=asked))
    with locked(run_lock(run), "a run", print, "run"):
        status = read_status(run)
    assert status.state is State.RUNNING
    assert status.waiting == ""
    assert status.asked is not None
    assert status.asked.waited_s >= 70.0
    assert status.left_s is None
    assert status.doing.startswith("the bench has said nothing for 4")
    assert status.next == (AFTER_SILENCE.format(run=run),), "its question is no longer asked"
    (bath,) = status.instruments
    assert bath.age_s is not None
    assert bath.age_s >= 40.0
    then = wall_time() - timedelta(hours=30)
    said_by(run, replace(LIVES, wall_time=then.isoformat()))
    with locked(run_lock(run), "a run", print, "run"):
        assert "nothing for 30.0 h; last: " in read_status(run).doing


@pytest.mark.parametrize(
    ("of", "words"),
    [
        (BATH, "bath 33.00 degC, stable"),
        (replace(BATH, age_s=12.0), "bath 33.00 degC, stable (12 s ago)"),
        (replace(BATH, name="arm", last="", age_s=1.0), "arm: answers"),
        (replace(BATH, name="arm", last="", age_s=36.0), "arm: answered 36 s ago"),
        (replace(BATH, name="arm", last="", age_s=2459.0), "arm: answered 41 min ago"),
        (
            replace(BATH, link=LinkState.SILENT, age_s=600.0),
            "bath: no answer for 10 min (last 33.00 degC, stable)",
        ),
        (replace(BATH, name="cameras", last="", age_s=None), "cameras: connected"),
    ],
)
def test_an_answer_that_is_old_shows_its_age(of: InstrumentStatus, words: str) -> None:
    assert of.text == words


def test_an_open_prompt_says_for_how_long() -> None:
    for number, waited_s, more in ((3, 59.0, ""), (3, 200.0, " for 3 min"), (None, 60.0, HERE)):
        asked = OpenPrompt("touch", number=number, waited_s=waited_s)
        status = replace(LIVES, asked=asked, doing="taking the truth")
        words = f"waiting for an answer{more}: touch"
        assert status.waiting == status.as_dict()["waiting"] == words
        assert status.line == f"{words}; bath 33.00 degC, stable; about 1 min left"


GUARDED = {"wall_noticed": "2026-11-26T22:01:30+00:00", "why": "", "cause": "died", "tries": 1}
GUARDED["wall_last_sign"] = "2026-11-26T22:01:29+00:00"
SAFED = {"standby": True, "wall_safe": "2026-11-26T22:01:31+00:00", "seconds": 1.0}
BY_HAND = "SWITCH OFF THE BATH AT ITS MAINS: not reached in 1 try"
UNREACHED = {"standby": False, "error": "no answer"}


@pytest.mark.parametrize(
    ("guardian", "safe", "then"),
    [
        (None, Safe.UNKNOWN, "Look whether the bath is in standby."),
        (GUARDED | SAFED, Safe.READ_BACK, "Look whether"),
        (GUARDED | UNREACHED, Safe.FAILED, BY_HAND),
    ],
    ids=["no word of it", "in standby", "not reached"],
)
def test_of_a_bench_that_has_died_its_guardian_says_how_the_bath_is(
    guardian: Mapping[str, Any] | None, safe: Safe, then: str, tmp_path: Path
) -> None:
    run = stopped(State.INTERRUPTED, tmp_path)
    store = Store(run)
    store.fact("guardian", "beside the bench")
    of_session = f"{GUARDIAN.format(store.session)}.json"
    store.close()
    said_by(run, replace(LIVES, wall_time=wall_time().isoformat()))
    if guardian:
        (run / of_session).write_text(json.dumps(guardian), encoding="utf-8")
    status = read_status(run)
    (bath,) = status.instruments
    assert (bath.link, bath.safe) == (LinkState.UNKNOWN, safe)
    assert bath.by_hand or "33.00" in bath.text
    if guardian and guardian["standby"]:
        assert then not in " ".join(status.next)
    else:
        assert status.next[0] == then


def test_what_its_guardian_made_safe_after_a_run_had_ended_is_safe(tmp_path: Path) -> None:
    run, failed = stopped(State.TRIPPED, tmp_path), replace(BATH, safe=Safe.FAILED, by_hand="OFF")
    store = Store(run)
    left = {"session": store.session, "instruments": [asdict(failed)]}
    store.fact(INSTRUMENTS_FACT, left)
    store.close()
    assert read_status(run).unsafe == ("OFF",)
    name = GUARDIAN.format(left["session"])
    (run / f"{name}.json").write_text(json.dumps(GUARDED | SAFED), encoding="utf-8")
    status = read_status(run)
    assert (status.unsafe, status.instruments[0].safe) == ((), Safe.READ_BACK)
    assert "the guardian had the bath in standby" in status.why
    assert status.why.endswith(" All instruments are safe.")


@pytest.mark.parametrize(
    ("found", "unsafe", "end"),
    [(UNREACHED, (BY_HAND,), "no answer)."), (SAFED, (), "All instruments are safe.")],
)
def test_a_run_that_took_over_a_hot_bath_and_opened_nothing_says_how_that_is(
    found: Mapping[str, Any], unsafe: tuple[str, ...], end: str, tmp_path: Path
) -> None:
    run = stopped(State.FAULTED, tmp_path)
    store = Store(run)
    store.fact(INSTRUMENTS_FACT, {"session": store.session, "instruments": []})
    name = GUARDIAN.format(store.session)
    store.close()
    assert read_status(run).why.endswith("Nothing was switched on.")
    (run / f"{name}.json").write_text(json.dumps({**GUARDED, **found}), encoding="utf-8")
    status = read_status(run)
    assert (status.unsafe, status.next[: len(unsafe)]) == (unsafe, unsafe)
    assert status.why.endswith(end)


def test_only_the_last_session_s_trip_counts(tmp_path: Path) -> None:
    run = stopped(State.TRIPPED, tmp_path)
    store = Store(run)
    store.fact("ending", "aborted")
    store.close()
    assert read_status(run).state is State.ABORTED
    store = Store(run)
    store.fact("ending", "faulted")
    store.close()
    assert read_status(run).state is State.FAULTED
    assert listed(run.parent)[0]["status"]["state"] == State.FAULTED


def test_an_ending_counts_though_the_bench_still_packs_and_an_unknown_one_has_a_word() -> None:
    assert state_of("finished", tripped=False, held=True) is State.FINISHED
    assert state_of("exploded", tripped=False, held=False) is State.INTERRUPTED


@pytest.mark.slow
def test_a_partly_emulated_rig_is_marked_on_every_surface(tmp_path: Path, said: Said) -> None:
    run = Path(shutil.copytree(KEPT, tmp_path / "runs" / "a-run"))
    store = Store(run)
    store.fact("kind", "mixed")
    store.fact("emulated", ["arm", "cameras"])
    store.fact("ending", "finished")
    store.close()
    mark = "SOME INSTRUMENTS EMULATED: arm, cameras. The figures are no measurement."
    summary = tmp_path / "summary.md"
    texts = {
        "terminal": said(0, "report {} --no-pdf --summary {}", run, summary).out,
        "list": said(0, "runs {}", run.parent).out,
        "Markdown": summary.read_text(encoding="utf-8"),
        "JUnit": (run / "report" / "junit.xml").read_text(encoding="utf-8"),
        "JSON": (run / "report" / "run.json").read_text(encoding="utf-8"),
        "phone": "\n".join(text_of(ENDED, read_status(run)) or ()),
    }
    assert [name for name, text in texts.items() if mark not in " ".join(text.split())] == []
    (suite,) = JUnitXml.fromfile(str(run / "report" / "junit.xml"))
    properties: list[Any] = [*suite.properties()]  # type: ignore[no-untyped-call]
    assert [one.value for one in properties] == [mark]
    assert suite.tests == len([*suite])
    page = (run / "report" / "index.html").read_text(encoding="utf-8")
    assert "SOME INSTRUMENTS EMULATED" in page
