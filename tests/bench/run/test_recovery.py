"""An instrument that drops out pauses the run; it goes on when the instrument is back, and a trial
in flight is done again whole.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.record.reader import RunRecord, read_run
from bench.results.verdicts import latency_of
from bench.rig.emulation_model import EmulatedFault
from bench.rig.frame_capture import FrameTaker
from bench.rig.loading import load_rig
from bench.run.context import RunContext
from bench.run.recovery import GARBLED, GONE, POLICIES, REFUSES, instrument_of, policy_for
from bench.run.start import RunOptions, run_script
from bench.run.states import EVENT
from bench.run.trial import TrialRun
from bench.script.model import load_script
from bench.script.planned_trials import PlannedTrial
from bench.truth.touching import ExpectedScene, TouchedTruth
from instruments.camera.frame import FrameSet
from instruments.errors import DeviceError, InstrumentError, LimitError, LinkError, ProtocolError
from instruments.microscribe.errors import AnotherArmError, SilentArmError
from instruments.stage.driver import Stage
from tests.bench.fault_catalogue import Bringer, known_to
from tests.bench.killed_runs import Silent, start
from tests.bench.operated_runs import CHECK_POINT, SCRIPT, STAGE, files, run, run_of, texts

TRIALS = ["001-place-1-1", "002-place-2-1", "003-place-3-1"]


def fault(instrument: str, name: str, at_s: float, for_s: float | None = None) -> str:
    """The emulation with prompts of 5 s and this fault."""
    lasts = "" if for_s is None else f"for_s = {for_s}\n"
    whose = f'instrument = "{instrument}"\nname = "{name}"'
    return f"prompt_s = 5.0\n[[emulation.faults]]\n{whose}\nat_s = {at_s}\n{lasts}"


def faulty(folder: Path, emulation: str) -> tuple[int, RunRecord]:
    return run(files(folder, stage=STAGE, emulation=emulation), folder)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("instrument", "name", "at_s", "for_s"),
    [
        ("arm", "power loss", 60.0, 40.0),
        ("arm", "silent", 60.0, 20.0),
        ("stage", "silent", 45.0, 30.0),
        ("stage", "disconnect", 45.0, 30.0),
        ("cameras", "dropped", 30.0, 30.0),
    ],
)
def test_it_goes_on_when_the_instrument_is_back(
    instrument: str, name: str, at_s: float, for_s: float, tmp_path: Path
) -> None:
    _, record = faulty(tmp_path, fault(instrument, name, at_s, for_s))
    assert record.ending == "finished", texts(record, "fault")
    assert [trial.id for trial in record.trials] == TRIALS
    are = "are" if instrument == "cameras" else "is"
    assert any(f"the {instrument} {are} back after" in text for text in texts(record, "back"))
    states = texts(record, EVENT)
    assert states[states.index("paused") + 1] == "running"
    assert sum(record.facts["retries"].values()) >= 1
    assert all(len(trial.touches) == 4 for trial in record.trials), (
        "a trial done again has one set of touches"
    )


class Gives(Silent):
    """Types ``words`` once the run waits for an instrument."""

    def __init__(self, words: str) -> None:
        super().__init__()
        self._words: str | None = words

    def typed(self) -> str | None:
        if not any("The run is paused" in text for text in self.warned):
            return None
        words, self._words = self._words, None
        return words


def given(words: str, folder: Path, emulation: str) -> RunRecord:
    """A run whose operator types ``words`` while an instrument is away."""
    files(folder, stage=STAGE, check_point=CHECK_POINT, emulation=emulation)
    rig, script = load_rig(folder / "rig.toml"), load_script(folder / "script.toml")
    person = Gives(words)
    run_script(rig, script, folder / "runs", person, RunOptions(typed=person.typed))
    return run_of(folder)


@pytest.mark.slow
def test_who_skips_the_trial_that_waits_finds_the_next_one_waiting_too(tmp_path: Path) -> None:
    """The stage comes back without its place: no trial may move it before it has homed."""
    record = given("skip it is gone", tmp_path, fault("stage", "silent", 55.0, 60.0))
    assert record.ending == "finished", texts(record, "fault")
    (skipped,) = record.skipped
    assert skipped["reason"] == "it is gone"
    assert [trial.id for trial in record.trials] == [t for t in TRIALS if t != skipped["trial"]]
    assert [text.endswith("(still away)") for text in texts(record, "dropped out")] == [False, True]
    assert len(texts(record, "back")) == 1


def test_an_abort_is_heard_while_preparing_waits_for_an_instrument(tmp_path: Path) -> None:
    record = given("abort", tmp_path, fault("arm", "silent", 0.1))
    assert (record.ending, len(record.trials)) == ("aborted", 0)
    assert texts(record, EVENT) == ["preparing", "paused", "safing", "aborted"]


@pytest.mark.slow
def test_an_arm_that_drops_out_in_its_last_check_is_waited_for_too(tmp_path: Path) -> None:
    """What comes behind the last trial is done again like a trial is."""

    class AtTheEnd(Bringer):
        def state(self, text: str) -> None:
            if "checking the arm after" in text:
                self.bring()

    files(tmp_path, check_point=CHECK_POINT, emulation="prompt_s = 2.0")
    bringer = AtTheEnd("", EmulatedFault(instrument="arm", name="power loss", for_s=15.0))
    with known_to(bringer):
        record = read_run(start(tmp_path, progress=bringer)[0])
    assert record.ending == "finished", texts(record, "fault")
    again = "done again from its start: the arm check after the trials"
    assert texts(record, "back")[0].endswith(again)
    assert "arm check after" in record.facts


@pytest.mark.slow
def test_a_stage_that_an_interlock_has_braked_does_not_home_when_it_is_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The trip comes while the stage is connected anew: nothing may move from then on."""
    files(tmp_path, stage=STAGE, emulation=fault("stage", "silent", 45.0, 30.0))
    low_level = Bringer("", EmulatedFault(instrument="bath", name="low level", for_s=600.0))
    reconnect, home, wait = Stage.reconnect, Stage.home, RunContext.wait
    contexts, homings = list[RunContext](), list[bool]()

    def noted(ctx: RunContext, seconds: float) -> None:
        contexts.append(ctx)
        wait(ctx, seconds)

    def slow(stage: Stage) -> None:
        reconnect(stage)
        low_level.bring()
        while contexts[-1].watch.tripped is None:
            contexts[-1].clock.sleep(1.0)

    def homed(stage: Stage) -> None:
        homings.append(bool(contexts) and contexts[-1].watch.tripped is not None)
        home(stage)

    monkeypatch.setattr(RunContext, "wait", noted)
    monkeypatch.setattr(Stage, "reconnect", slow)
    monkeypatch.setattr(Stage, "home", homed)
    with known_to(low_level):
        record = read_run(start(tmp_path, progress=low_level)[0])
    assert (record.ending, record.facts["trip"]["rule"]) == ("faulted", "controller alarm")
    assert homings == [False], "once, to prepare"


@pytest.mark.slow
def test_nothing_moves_in_a_trial_once_an_interlock_has_tripped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A trip between two trials, where nobody waits for anything, of a bath whose last reading was
    a stable one.
    """
    files(tmp_path, stage=STAGE, emulation="prompt_s = 5.0")
    refusing = Bringer("", EmulatedFault(instrument="bath", name="gaps refused", for_s=600.0))
    before, move, moved = TouchedTruth.before, Stage.move_to, list[bool]()

    def trips(truth: TouchedTruth, shown: ExpectedScene) -> None:
        before(truth, shown)
        moved.append(False)
        if len(moved) == 2:
            refusing.bring()
            truth._toucher._clock.sleep(30.0)

    def noted(stage: Stage, **where: float | None) -> None:
        moved[-1] = True
        move(stage, **where)  # type: ignore[arg-type]

    monkeypatch.setattr(TouchedTruth, "before", trips)
    monkeypatch.setattr(Stage, "move_to", noted)
    with known_to(refusing):
        record = read_run(start(tmp_path, progress=refusing)[0])
    assert (record.ending, record.facts["trip"]["rule"]) == ("faulted", "implausible reading")
    assert moved == [True, False]


@pytest.mark.slow
def test_one_that_stays_away_ends_the_run_after_the_rigs_patience(tmp_path: Path) -> None:
    lost = fault("arm", "power loss", 60.0)
    code, record = faulty(tmp_path, f"{lost}[limits]\naway_s = 90.0")
    assert (code, record.ending) == (3, "faulted")
    (paused_s,) = [e["t_s"] for e in record.events if (e["kind"], e["text"]) == (EVENT, "paused")]
    (given_up_s,) = [event["t_s"] for event in record.events if event["kind"] == "given up"]
    assert 90.0 <= given_up_s - paused_s <= 110.0
    assert texts(record, EVENT)[-2:] == ["safing", "faulted"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("raised", "kind"),
    [
        (LinkError("arm at COM5", "gone"), ("arm", GONE)),
        (DeviceError("cameras", "no usable frame set"), ("cameras", REFUSES)),
        (DeviceError("stage at COM4", "alarm 1"), ("stage", REFUSES)),
    ],
    ids=str,
)
def test_one_that_fails_again_each_time_it_is_back_ends_the_run_after_the_tables_tries(
    raised: InstrumentError, kind: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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


@pytest.mark.slow
def test_a_rig_without_patience_ends_at_once(tmp_path: Path) -> None:
    lost = fault("arm", "power loss", 60.0, 40.0)
    code, record = faulty(tmp_path, f"{lost}[limits]\naway_s = 0")
    assert (code, record.ending) == (3, "faulted")
    assert not texts(record, "back")


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
        assert policy_for(case) is (None if key is None else POLICIES[key]), case
    assert instrument_of(LinkError("guardian", "gone")) is None


# a bath that leaves its band at once when its heater is dead for a while
NARROW = SCRIPT.replace("window_s = 2.0", "window_s = 60.0\nleave_k = 0.03\nmean_k = 0.03")


@pytest.mark.slow
def test_what_stands_there_waits_until_the_bath_is_stable_again(tmp_path: Path) -> None:
    dead = fault("bath", "dead heater", 855.0, 105.0).replace("prompt_s = 5.0", "prompt_s = 120.0")
    code, record = run(files(tmp_path, script=NARROW, emulation=dead), tmp_path)
    assert (code, record.ending, len(record.trials)) == (0, "finished", 3)
    told = texts(record, "suspended")[0]
    assert "the bath left its band" in told
    (late,) = [trial for trial in record.trials if trial.head["note"]]
    assert late.id == told.split(":")[0]
    assert str(late.head["note"]).startswith("suspended for ")
    assert all(trial.head["bath_state"] == "stable" for trial in record.trials), (
        "nothing was taken while it was out"
    )
    assert texts(record, EVENT)[2:5] == ["running", "settling", "running"]
    latency = latency_of(record, "thesis")
    assert latency.median_s is not None
    assert max(latency.seconds) < 60.0 <= late.head["ended_s"] - late.head["started_s"]


@pytest.mark.slow
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
    code, record = run(files(tmp_path, script=NARROW, emulation=dead), tmp_path)
    assert (code, record.ending) == (0, "finished")
    assert [text.split(":")[0] for text in texts(record, "suspended")] == [TRIALS[0]]
    assert [trial.head["bath_state"] for trial in record.trials] == ["stable"] * 3
    assert len(taken) == 4, "the first trial's are taken again"
    assert len(record.trials[0].frames) == len(record.trials[1].frames)
