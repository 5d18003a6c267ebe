"""An instrument that drops out pauses the run, which goes on when it is back, a trial in flight
whole; and what a person requests of a run under way, by a file or typed.
"""

from __future__ import annotations

import os
import shutil
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from bench.cli.run import typed_lines
from bench.config import ConfigError
from bench.record.reader import RunRecord, read_run
from bench.results.verdicts import latency_of
from bench.rig.frame_capture import FrameTaker
from bench.rig.guardian_client import Heartbeat
from bench.rig.model import EmulatedFault
from bench.rig.reconnecting import GARBLED, GONE, POLICIES, REFUSES, diagnosis
from bench.run.context import RunContext
from bench.run.events import EVENT, Events
from bench.run.interruptions import (
    FILE,
    Recovery,
    Requests,
    leave_request,
    parse_request,
    was_taken,
)
from bench.run.start import RunOptions
from bench.run.trial import TrialRun
from bench.script.planned_trials import PlannedTrial
from bench.truth.touching import ExpectedScene, TipReader, TouchedTruth
from instruments.camera.cameras import CAN_GIVE, CameraSet
from instruments.camera.closing import CLOSE_S
from instruments.camera.frame import FrameSet
from instruments.camera.opencv import LONGEST_WAIT_S, OPEN_S
from instruments.clock import VirtualClock
from instruments.errors import DeviceError, InstrumentError, LimitError, LinkError, ProtocolError
from instruments.microscribe.driver import MicroScribe, Reading
from instruments.microscribe.errors import AnotherArmError, SilentArmError
from instruments.operators.operator import OperatorAbort, OperatorRepeat, OperatorSkip
from instruments.stage.driver import OwnStage
from tests.bench.calibrate.arm_terminal import at_terminal
from tests.bench.commands import Said
from tests.bench.fault_catalogue import Bringer, known_to
from tests.bench.killed_runs import Person, Silent, only_run, start
from tests.bench.operated_runs import (
    CHECK_POINT,
    ONE,
    SCRIPT,
    STAGE,
    files,
    record_of,
    run_of,
    texts,
)
from tests.bench.small_run import KEPT
from tests.examples import few

pytestmark = pytest.mark.slow

TRIALS = ["001-place-1-1", "002-place-2-1", "003-place-3-1"]


def fault(instrument: str, name: str, at_s: float, for_s: float | None = None) -> str:
    """The emulation with prompts of 5 s and this fault."""
    lasts = "" if for_s is None else f"for_s = {for_s}\n"
    whose = f'instrument = "{instrument}"\nname = "{name}"'
    return f"prompt_s = 5.0\n[[emulation.faults]]\n{whose}\nat_s = {at_s}\n{lasts}"


def ended(folder: Path, bringer: Bringer) -> RunRecord:
    with known_to(bringer):
        return read_run(start(folder, progress=bringer)[0])


def given(words: str, folder: Path, emulation: str) -> RunRecord:
    """A run whose operator types ``words`` while an instrument is away."""
    person = Person("The run is paused", [words])
    return record_of(folder, person, stage=STAGE, check_point=CHECK_POINT, emulation=emulation)


@pytest.mark.weekly
def test_who_skips_the_trial_that_waits_finds_the_next_one_waiting_too(tmp_path: Path) -> None:
    """The stage comes back without its place: no trial may move it before it has homed."""
    record = given("skip it is gone", tmp_path, fault("stage", "silent", 55.0, 60.0))
    assert record.ending == "finished", texts(record, "fault")
    (skipped,) = record.skipped
    assert skipped["reason"] == "it is gone"
    assert [trial.id for trial in record.trials] == [t for t in TRIALS if t != skipped["trial"]]
    assert [text.endswith("(still away)") for text in texts(record, "dropped out")] == [False, True]
    assert len(texts(record, "back")) == 1


@pytest.mark.weekly
def test_a_stage_that_drops_out_while_ends_are_touched_is_noticed_and_costs_no_touch(
    tmp_path: Path,
) -> None:
    files(tmp_path, stage=STAGE, emulation="prompt_s = 5.0")
    silent = EmulatedFault(instrument="stage", name="silent", for_s=15.0)
    bringer = When("taking the truth", 12.0, silent)
    record = ended(tmp_path, bringer)
    assert record.ending == "finished", texts(record, "fault")
    (lost_s,) = [one["t_s"] for one in record.events if one["kind"] == "dropped out"]
    assert 0.0 < lost_s - bringer.at_s < 4.0, "at once"
    assert texts(record, "touches") == [f"{TRIALS[0]}: 2 so far are kept"]
    touches = record.trials[0].touches
    assert [touch["teat"] for touch in touches] == ["1", "1", "2", "3", "4"]
    assert sum(touch["t_s"] < lost_s for touch in touches) == 2


def test_an_abort_is_taken_while_preparing_waits_for_an_instrument(tmp_path: Path) -> None:
    record = given("abort", tmp_path, fault("arm", "silent", 0.1))
    assert (record.ending, len(record.trials)) == ("aborted", 0)
    assert texts(record, EVENT) == ["preparing", "paused", "safing", "aborted"]


class When(Bringer):
    """Brings the fault once ``words`` are shown, ``after_s`` later."""

    def __init__(self, words: str, after_s: float, fault: EmulatedFault) -> None:
        super().__init__("", fault)
        self.words, self.after_s, self.at_s = words, after_s, 0.0

    def state(self, text: str) -> None:
        if self.words in text and self.twin and not self.at_s:
            self.at_s = self.twin._clock.now() + self.after_s
            self.twin._clock.call_at(self.at_s, self.bring)


@pytest.mark.parametrize(("blocked", "noticed"), few([(2, 2), (1, 3)], 2))
def test_a_move_that_is_blocked_is_noticed_by_touched_ends(
    blocked: int, noticed: int, tmp_path: Path
) -> None:
    """Blocked before the first trial it shows once the stage has homed for another reason."""
    shifts = "{ x_mm = 30.0 }, { x_mm = -10.0, y_mm = 20.0 }, { y_mm = 30.0 }"
    script = SCRIPT.split("poses = ")[0] + f"poses = [{shifts}]\n"
    homes = fault("stage", "silent", 95.0, 15.0) if blocked == 1 else "prompt_s = 5.0"
    files(tmp_path, stage=STAGE, script=script, emulation=homes)
    lost = EmulatedFault(instrument="stage", name="lost step", amount=25.0, for_s=3.0)
    record = ended(tmp_path, When(f"moving the phantom: place-{blocked}", 0.0, lost))
    assert (record.ending, len(record.trials)) == ("finished", 3), texts(record, "fault")
    trial, before = TRIALS[noticed - 1], TRIALS[noticed - 2]
    dropped = texts(record, "dropped out")[-1]
    assert dropped.startswith(f"trial {trial}: stage")
    assert f"the ends are 25 mm from where the stage's move since {before} should" in dropped
    doubts = [str(trial.head["note"]) for trial in record.trials if trial.head["note"]]
    assert texts(record, "stage") == [f"{trial}: {doubt}" for doubt in doubts]
    assert len(doubts) == (1 if blocked == 1 else 0)
    assert all(doubt.endswith(f"stood in {TRIALS[0]}, {TRIALS[1]}") for doubt in doubts)


def test_an_arm_that_drops_out_in_its_last_check_is_waited_for_too(tmp_path: Path) -> None:
    """What comes behind the last trial is done again like a trial is."""
    files(tmp_path, check_point=CHECK_POINT, emulation="prompt_s = 2.0")
    loss = EmulatedFault(instrument="arm", name="power loss", for_s=15.0)
    bringer = When("checking the arm after", 0.0, loss)
    record = ended(tmp_path, bringer)
    assert record.ending == "finished", texts(record, "fault")
    again = "done again from its start: the arm check after the trials"
    assert texts(record, "back")[0].endswith(again)
    assert "arm check after" in record.facts


def touched_by(homed_alike: bool, folder: Path, monkeypatch: pytest.MonkeyPatch) -> RunRecord:
    """A run whose arm is homed anew amid the touches of its first trial, as before or 3 mm off."""
    files(folder, check_point=CHECK_POINT, emulation="prompt_s = 5.0")
    loss = EmulatedFault(instrument="arm", name="power loss", for_s=15.0)
    bringer, homings, read = When("taking the truth", 12.0, loss), list[float](), TipReader.read

    def homed(arm: MicroScribe) -> None:
        homings.append(0.0 if homed_alike else 3.0)
        home(arm)

    def off(tip: TipReader) -> Reading:
        seen = read(tip)
        return replace(seen, tip_mm=seen.tip_mm + sum(homings))

    home = MicroScribe.home
    monkeypatch.setattr(MicroScribe, "home", homed)
    monkeypatch.setattr(TipReader, "read", off)
    record = ended(folder, bringer)
    assert record.ending == "finished", texts(record, "fault")
    assert len(homings) == 1
    return record


def test_touches_count_where_an_arm_that_was_homed_again_finds_its_check_point(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = touched_by(True, tmp_path, monkeypatch)
    (lost_s,) = [one["t_s"] for one in record.events if one["kind"] == "dropped out"]
    first = record.trials[0].touches
    kept = sum(touch["t_s"] < lost_s for touch in first)
    assert kept > 0
    assert texts(record, "touches") == [f"{TRIALS[0]}: {kept} so far are kept"]
    assert len(first) == 5, "one more of an end shows that nothing has moved"
    before, amid, _ = texts(record, "arm")
    assert before.startswith("arm check before")
    assert "(1 new: nothing has moved since the others)" in amid


def test_touches_go_where_an_arm_that_was_homed_again_misses_its_check_point(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = touched_by(False, tmp_path, monkeypatch)
    (lost_s,) = [one["t_s"] for one in record.events if one["kind"] == "dropped out"]
    assert all(touch["t_s"] > lost_s for touch in record.trials[0].touches)
    _, dropped = texts(record, "touches")
    assert "are dropped: the check point is 5.2" in dropped


def test_touches_go_where_a_rig_without_a_check_point_homes_its_arm_again(tmp_path: Path) -> None:
    files(tmp_path, emulation="prompt_s = 5.0")
    loss = EmulatedFault(instrument="arm", name="power loss", for_s=15.0)
    record = ended(tmp_path, When("taking the truth", 12.0, loss))
    assert record.ending == "finished", texts(record, "fault")
    (lost_s,) = [one["t_s"] for one in record.events if one["kind"] == "dropped out"]
    assert all(touch["t_s"] > lost_s for touch in record.trials[0].touches)
    assert texts(record, "touches")[1].endswith("and the rig has no check point (docs/rig.md)")


def test_a_stage_that_an_interlock_has_braked_does_not_home_when_it_is_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The trip comes while the stage is connected anew: nothing may move from then on."""
    files(tmp_path, stage=STAGE, emulation=fault("stage", "silent", 45.0, 30.0))
    low_level = Bringer("", EmulatedFault(instrument="bath", name="low level", for_s=600.0))
    reconnect, home, wait = OwnStage.reconnect, OwnStage.home, RunContext.wait
    contexts, homings = list[RunContext](), list[bool]()

    def noted(ctx: RunContext, seconds: float) -> None:
        contexts.append(ctx)
        wait(ctx, seconds)

    def slow(stage: OwnStage) -> None:
        reconnect(stage)
        low_level.bring()
        while contexts[-1].watch.tripped is None:
            contexts[-1].clock.sleep(1.0)

    def homed(stage: OwnStage) -> None:
        homings.append(bool(contexts) and contexts[-1].watch.tripped is not None)
        home(stage)

    monkeypatch.setattr(RunContext, "wait", noted)
    monkeypatch.setattr(OwnStage, "reconnect", slow)
    monkeypatch.setattr(OwnStage, "home", homed)
    record = ended(tmp_path, low_level)
    assert (record.ending, record.facts["trip"]["rule"]) == ("faulted", "controller alarm")
    assert homings == [False], "once, to prepare"


def test_nothing_moves_in_a_trial_once_an_interlock_has_tripped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A trip between two trials, of a bath whose last reading was a stable one."""
    files(tmp_path, stage=STAGE, emulation="prompt_s = 5.0")
    refusing = Bringer("", EmulatedFault(instrument="bath", name="gaps refused", for_s=600.0))
    before, move, moved = TouchedTruth.before, OwnStage.move_to, list[bool]()

    def trips(truth: TouchedTruth, shown: ExpectedScene) -> None:
        before(truth, shown)
        moved.append(False)
        if len(moved) == 2:
            refusing.bring()
            truth.toucher.clock.sleep(30.0)

    def noted(stage: OwnStage, **where: float | None) -> None:
        moved[-1] = True
        move(stage, **where)  # type: ignore[arg-type]

    monkeypatch.setattr(TouchedTruth, "before", trips)
    monkeypatch.setattr(OwnStage, "move_to", noted)
    record = ended(tmp_path, refusing)
    assert (record.ending, record.facts["trip"]["rule"]) == ("faulted", "implausible reading")
    assert moved == [True, False]


def test_one_that_fails_again_each_time_it_is_back_ends_the_run_after_the_tables_tries(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    raised, kind = DeviceError("stage at COM4", "alarm 1"), ("stage", REFUSES)
    tries: list[str] = []

    def fails(_: TrialRun, trial: PlannedTrial) -> None:
        tries.append(trial.id)
        raise raised

    files(tmp_path, stage=STAGE)
    monkeypatch.setattr(TrialRun, "run", fails)
    record = read_run(start(tmp_path)[0])
    assert (record.ending, texts(record, "fault")) == ("faulted", [str(raised)])
    times = POLICIES[kind].times
    assert tries == [TRIALS[0]] * (1 + times)
    assert len(texts(record, "dropped out")) == len(texts(record, "back")) == times
    assert record.facts["retries"] == {" ".join(kind): times}, (
        "how often it was tried is in the record"
    )


def test_what_a_fault_is_and_whose() -> None:
    cases: list[tuple[InstrumentError, tuple[str, str] | None]] = [
        (LinkError("arm at COM5", "gone"), ("arm", GONE)),
        (SilentArmError("arm at COM5", "silent"), ("arm", GONE)),
        (ProtocolError("stage at /dev/ttyUSB0", "nonsense"), ("stage", GARBLED)),
        (DeviceError("stage at /dev/ttyUSB0", "alarm 1"), ("stage", REFUSES)),
        (LinkError("bath at tcp://1.2.3.4:502", "gone"), ("bath", GONE)),
        (LinkError("pump at tcp://1.2.3.4:502", "gone"), ("bath", GONE)),
        (DeviceError("cameras", "no usable frame set"), ("cameras", REFUSES)),
        (LinkError("left camera at 0", "gone"), ("cameras", GONE)),
        (DeviceError("bath", "not stable within 7200 s"), None),
        (DeviceError("arm at COM5", "says no"), None),
        (AnotherArmError("arm at COM5", "another"), None),
        (LimitError("stage at COM1", "refused before sending"), None),
        (ProtocolError("answers.txt", "an answer out of place"), None),
        (DeviceError("truth", "no"), None),
    ]
    for case, key in cases:
        assert POLICIES.get(diagnosis(case)) is (None if key is None else POLICIES[key]), case
    assert diagnosis(LinkError("guardian", "gone")) == ("", GONE)


# a bath that leaves its band at once when its heater is dead for a while
NARROW = SCRIPT.replace("window_s = 2.0", "window_s = 60.0\nleave_k = 0.03\nmean_k = 0.03")


@pytest.mark.weekly
def test_what_stands_there_waits_until_the_bath_is_stable_again(tmp_path: Path) -> None:
    dead = fault("bath", "dead heater", 855.0, 105.0).replace("prompt_s = 5.0", "prompt_s = 120.0")
    record = record_of(tmp_path, script=NARROW, emulation=dead)
    assert (record.ending, len(record.trials)) == ("finished", 3)
    note = texts(record, "suspended")[0]
    assert "the bath left its band" in note
    (late,) = [trial for trial in record.trials if trial.head["note"]]
    assert late.id == note.split(":")[0]
    assert str(late.head["note"]).startswith("suspended for ")
    assert all(trial.head["bath_state"] == "stable" for trial in record.trials), (
        "nothing was taken while it was out"
    )
    assert texts(record, EVENT)[2:5] == ["running", "settling", "running"]
    latency = latency_of(record, "thesis")
    assert latency.percentile_s(50) is not None
    assert max(latency.seconds) < 60.0 <= late.head["ended_s"] - late.head["started_s"]


def test_a_bath_that_leaves_its_band_while_a_camera_is_late_costs_the_frames_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was in its band when the cameras were asked: what they gave later is of a bath that
    wasn't, and no detector's fault.
    """
    take, wait = FrameTaker.take, RunContext.wait
    waiting, taken = list[RunContext](), list[FrameSet]()

    def late(taker: FrameTaker) -> FrameSet:
        if not taken:
            wait(waiting[-1], 120.0)
        taken.append(take(taker))
        return taken[-1]

    def noted(ctx: RunContext, seconds: float) -> None:
        waiting.append(ctx)
        wait(ctx, seconds)

    monkeypatch.setattr(FrameTaker, "take", late)
    monkeypatch.setattr(RunContext, "wait", noted)
    dead = fault("bath", "dead heater", 100.0, 105.0).removeprefix("prompt_s = 5.0\n")
    record = record_of(tmp_path, script=NARROW, emulation=dead)
    assert record.ending == "finished"
    assert [text.split(":")[0] for text in texts(record, "suspended")] == [TRIALS[0]]
    assert [trial.head["bath_state"] for trial in record.trials] == ["stable"] * 3
    assert len(taken) == 4, "the first trial's are taken again"
    assert len(record.trials[0].frames) == len(record.trials[1].frames)


def run_with(person: Person, folder: Path) -> RunRecord:
    return record_of(folder, person, emulation="prompt_s = 5.0")


def test_a_pause_lasts_until_somebody_says_to_go_on_and_has_no_trial_to_skip(
    tmp_path: Path,
) -> None:
    lines = ["p", "", "skip it leaks", "repeat it moved", *[""] * 30, "go on"]
    run = run_with(person := Person("place-2", lines), tmp_path)
    assert (run.ending, len(run.trials), len(run.skipped)) == ("finished", 3, 0)
    states = [(event["text"], event["t_s"]) for event in run.events if event["kind"] == EVENT]
    (at,) = [index for index, (name, _) in enumerate(states) if name == "paused"]
    assert states[at + 1][0] == "running"
    assert states[at + 1][1] - states[at][1] >= 14.0, "the bath is watched for as long as it takes"
    assert any("paused, as asked" in text for text in person.states)
    none = "No trial is in flight just now, so nothing is done about: "
    said = ("The run pauses before its next trial.", f"{none}skip it leaks", f"{none}repeat it mov")
    for words in (*said, "teatbench control"):
        assert any(words in text for text in person.warned), words


def test_a_trial_is_repeated_whole_and_another_skipped_each_with_its_reason(tmp_path: Path) -> None:
    lines = ["", "repeat the plate was touched", *[""] * 5, "skip it leaks"]
    run = run_with(Person("place-2", lines), tmp_path)
    assert run.ending == "finished"
    again = "the operator asked for it again from its set-up: the plate was touched"
    assert texts(run, "repeated")[-1].endswith(again)
    assert [row["reason"] for row in run.skipped] == ["it leaks"]
    assert len(run.trials) == 2


def test_ctrl_c_before_there_are_instruments_is_an_abort(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    files(tmp_path)
    monkeypatch.setattr("bench.run.start.open_instruments", interrupted)
    run, _ = start(tmp_path)
    assert read_run(run).ending == "aborted"


def test_a_request_left_in_the_folder_is_taken_once(tmp_path: Path) -> None:
    requests = Requests(tmp_path, lambda: None, lambda _: None)
    states = []
    for words in ("p", "go on"):
        leave_request(tmp_path, words)
        requests.look()
        states.append(requests.paused)
        assert not (tmp_path / FILE).exists()
    assert states == [True, False]
    for words, raised in (
        ("skip a b", OperatorSkip),
        ("r because", OperatorRepeat),
        ("abort", OperatorAbort),
    ):
        leave_request(tmp_path, words)
        with pytest.raises(raised):
            requests.look()
        requests.look()


def test_words() -> None:
    meant = [("pause", ""), ("go on", ""), ("skip", "a b"), ("abort", "")]
    assert [parse_request(words) for words in ("P", "go", "s  a  b", "a")] == meant


def test_words_that_mean_nothing_are_reported_and_change_nothing(
    tmp_path: Path, said: Said
) -> None:
    note: list[str] = []
    lines = ["hallo", "skip"]
    requests = Requests(tmp_path, lambda: lines.pop(0), note.append)
    requests.look()
    requests.look()
    assert note[0].startswith("not understood: 'hallo'. There are: pause, go on")
    assert note[1].startswith("skip needs a reason")
    with pytest.raises(ConfigError, match="repeat needs a reason"):
        leave_request(tmp_path, "repeat")
    kept = shutil.copytree(KEPT, tmp_path / "kept")
    assert "has ended (finished)" in said(2, "tell {} pause", kept).err


TERMINAL = pytest.mark.skipif(
    sys.platform == "win32", reason="needs a pseudo-terminal, which Windows has not"
)


@TERMINAL
def test_a_run_that_waits_at_a_prompt_takes_requests_of_another_terminal(
    tmp_path: Path, said: Said
) -> None:
    with at_terminal(files(tmp_path, operator="console:")) as terminal:
        terminal.expect("on its peg")
        terminal.expect("abort the run): ")
        terminal.type("")
        terminal.expect("[trial 1 of 3")
        terminal.expect("abort the run): ")
        run = only_run(tmp_path, "runs")
        assert "request accepted" in said(0, "control {} skip the hose leaks", run).out
        terminal.expect("Request accepted: skip the hose leaks")
        terminal.expect("[trial 2 of 3")
        terminal.expect("abort the run): ")
        said(0, "tell {} abort", run)
        assert terminal.code() == 3
    record = run_of(tmp_path)
    assert record.ending == "aborted"
    assert [row["reason"] for row in record.skipped] == ["the hose leaks"]


@TERMINAL
def test_a_bench_in_the_background_reads_nothing_of_what_is_typed_to_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The system stops whoever does, and a bench that stands still is taken for dead."""
    import pty

    person, terminal = pty.openpty()
    with (
        os.fdopen(terminal, encoding="utf-8") as stream,
        os.fdopen(person, "wb", buffering=0) as keys,
    ):
        monkeypatch.setattr("sys.stdin", stream)
        typed = typed_lines(by_person=False)
        keys.write(b"abort\n")
        monkeypatch.setattr("os.tcgetpgrp", lambda _: os.getpgrp() + 1)
        assert typed() is None
        monkeypatch.setattr("os.tcgetpgrp", lambda _: os.getpgrp())
        assert typed() == "abort\n"


def test_a_request_to_a_bench_that_has_died_is_not_accepted_and_says_so(tmp_path: Path) -> None:
    leave_request(tmp_path, "pause")
    clock = VirtualClock()
    assert not was_taken(tmp_path, clock, 10.0)
    assert clock.now() == pytest.approx(10.0, abs=0.2)
    Requests(tmp_path, lambda: None, lambda _: None).look()
    assert was_taken(tmp_path, clock, 10.0)


class Unplugging(Bringer):
    """Pulls a camera while the bath settles and while ends are touched; ends the run then."""

    def __init__(self) -> None:
        super().__init__("", EmulatedFault(instrument="cameras", name="dropped"))
        self.said: list[tuple[str, str]] = []

    def state(self, text: str) -> None:
        if self.twin and "waiting for the bath" in text and not self.warned:
            self.twin.cameras.pull("right", True)

    def warn(self, text: str) -> None:
        super().warn(text)
        if self.twin and "The run is paused" in text:
            self.twin.cameras.pull("right", False)

    def look(self, context: RunContext) -> None:
        if self.twin and context._touching and len(self.warned) == 2:
            self.twin.cameras.pull("right", True)
        if len(self.warned) == 3 and not self.said:
            status = context.status()
            (cameras,) = (one for one in status.instruments if one.name == "cameras")
            self.said.append((cameras.link, status.next[-1]))
            raise KeyboardInterrupt


def test_a_camera_that_drops_out_while_the_bench_waits_is_noticed_then(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In real time, ten times as fast: settling pauses, touches go on with a word."""
    shown, look = Unplugging(), RunContext.look

    def looked(context: RunContext) -> None:
        look(context)
        shown.look(context)

    monkeypatch.setattr(RunContext, "look", looked)
    script = SCRIPT.replace("window_s = 2.0", "window_s = 30.0")
    files(tmp_path, emulation="prompt_s = 5.0", script=script)
    with known_to(shown):
        fast = RunOptions(realtime=True, speed=10.0)
        folder, _ = start(tmp_path, progress=Events(shown), how=fast)
    paused, back, gone = shown.warned[:3]
    assert "right camera, emulated" in paused
    assert "The cameras are back after" in back
    assert "The trial has its frames and goes on" in gone
    assert shown.said == [
        ("silent", "Check the cameras' power and cables, before the next frames.")
    ]
    states = [one["text"] for one in read_run(folder).events if one["kind"] == EVENT]
    assert states[:5] == ["preparing", "settling", "paused", "settling", "running"]


def test_water_that_is_cold_is_said_once_and_sends_nobody_to_the_cameras(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The bath holds a set point at which no teat stands out from the room."""
    shown, seen, look = Silent(), set[tuple[str, str]](), RunContext.look

    def looked(context: RunContext) -> None:
        look(context)
        if context.away:
            status = context.status()
            (cameras,) = (one for one in status.instruments if one.name == "cameras")
            seen.add((cameras.how, status.next[-1]))

    monkeypatch.setattr(RunContext, "look", looked)
    files(tmp_path, start_c=20.0, script=ONE.replace("set_point_c = 33.0", "set_point_c = 20.5"))
    _, ending = start(tmp_path, progress=shown)
    assert ending == "faulted"
    (said,) = (text for text in shown.warned if "no contrast" in text)  # its figures differ
    goes_on = "It goes on by itself when the cameras' pictures are usable."
    fault, _, paused = said.partition("\n")
    assert "See that the bath is warm" in fault
    assert paused == f"The run is paused. {goes_on}"
    ((how, to_do),) = seen
    assert how == "no usable pictures"
    assert to_do.startswith("See that the bath is warm")
    assert to_do.endswith(goes_on)


def test_cameras_that_hang_while_they_are_opened_again_are_no_hung_bench(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now_s, heartbeat = [0.0], Heartbeat()
    monkeypatch.setattr("bench.rig.guardian_client.stopwatch_s", lambda: now_s[0])

    def hang(seconds: float) -> None:
        now_s[0] += seconds
        assert heartbeat.overdue() is None

    def opened() -> Any:
        hang(OPEN_S)
        return SimpleNamespace(close=lambda: hang(CLOSE_S / len(CAN_GIVE)))

    cameras = CameraSet(dict.fromkeys(CAN_GIVE, opened), {})
    ctx: Any = SimpleNamespace(
        heartbeat=heartbeat,
        devices=SimpleNamespace(cameras=cameras, answered_s={}),
        clock=VirtualClock(5.0),
        events=SimpleNamespace(state=print),
        rig=SimpleNamespace(rig=SimpleNamespace(limits=SimpleNamespace(away_s=600.0))),
        wait=hang,
    )
    ctx.long = partial(RunContext.long, ctx)
    look_s = len(CAN_GIVE) * (CLOSE_S + OPEN_S + LONGEST_WAIT_S)
    Recovery(ctx, lambda: hang(look_s))._attempt("cameras")
    assert ctx.devices.answered_s == {"cameras": 5.0}
