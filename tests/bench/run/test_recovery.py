"""An instrument that drops out pauses the run; it goes on when the instrument is back, and a trial
in flight is done again whole.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.record.reader import RunRecord, read_run
from bench.results.latency import latency_of
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
from tests.bench.operated_runs import CHECK_POINT, SCRIPT, STAGE, files, run, texts

TRIALS = ["001-place-1-1", "002-place-2-1", "003-place-3-1"]


def faulty(
    folder: Path, fault: str, *, more: str = "", prompt_s: float = 5.0
) -> tuple[int, RunRecord]:
    emulation = f"prompt_s = {prompt_s}\n[[emulation.faults]]\n{fault}\n{more}"
    return run(files(folder, stage=STAGE, emulation=emulation), folder)


@pytest.mark.parametrize(
    ("fault", "instrument"),
    [
        ('instrument = "arm"\nname = "power loss"\nat_s = 60.0\nfor_s = 40.0', "arm"),
        ('instrument = "arm"\nname = "silent"\nat_s = 60.0\nfor_s = 20.0', "arm"),
        ('instrument = "stage"\nname = "silent"\nat_s = 45.0\nfor_s = 30.0', "stage"),
        ('instrument = "stage"\nname = "disconnect"\nat_s = 45.0\nfor_s = 30.0', "stage"),
        ('instrument = "cameras"\nname = "dropped"\nat_s = 30.0\nfor_s = 30.0', "cameras"),
    ],
    ids=[
        "arm without power",
        "arm silent",
        "stage silent",
        "stage unplugged",
        "camera without frames",
    ],
)
def test_it_goes_on_when_the_instrument_is_back(
    fault: str, instrument: str, tmp_path: Path
) -> None:
    _, record = faulty(tmp_path, fault)
    assert record.ending == "finished", texts(record, "fault")
    assert [trial.id for trial in record.trials] == TRIALS
    assert any(
        f"the {instrument} {'are' if instrument == 'cameras' else 'is'} back after" in text
        for text in texts(record, "back")
    )
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


def given(words: str, folder: Path, fault: str) -> RunRecord:
    """A run whose operator types ``words`` while an instrument is away."""
    files(
        folder,
        stage=STAGE,
        check_point=CHECK_POINT,
        emulation=f"prompt_s = 5.0\n[[emulation.faults]]\n{fault}",
    )
    rig, progress = load_rig(folder / "rig.toml"), Gives(words)
    return read_run(
        run_script(
            rig,
            load_script(folder / "script.toml"),
            folder / "runs",
            progress,
            RunOptions(typed=progress.typed),
        )[0]
    )


def test_who_skips_the_trial_that_waits_finds_the_next_one_waiting_too(tmp_path: Path) -> None:
    """The stage comes back without its place: no trial may move it before it has homed."""
    record = given(
        "skip it is gone",
        tmp_path,
        'instrument = "stage"\nname = "silent"\nat_s = 55.0\nfor_s = 60.0',
    )
    assert record.ending == "finished", texts(record, "fault")
    assert [row["reason"] for row in record.skipped] == ["it is gone"]
    assert [trial.id for trial in record.trials] == [
        name for name in TRIALS if name != record.skipped[0]["trial"]
    ]
    assert [text.endswith("(still away)") for text in texts(record, "dropped out")] == [False, True]
    assert len(texts(record, "back")) == 1


def test_an_abort_is_heard_while_preparing_waits_for_an_instrument(tmp_path: Path) -> None:
    record = given("abort", tmp_path, 'instrument = "arm"\nname = "silent"\nat_s = 0.1')
    assert (record.ending, len(record.trials)) == ("aborted", 0)
    assert texts(record, EVENT) == ["preparing", "paused", "safing", "aborted"]


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
    assert texts(record, "back")[0].endswith(
        "done again from its start: the arm check after the trials"
    )
    assert "arm check after" in record.facts


def test_a_stage_that_an_interlock_has_braked_does_not_home_when_it_is_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The trip comes while the stage is connected anew: nothing may move from then on."""
    fault = '[[emulation.faults]]\ninstrument = "stage"\nname = "silent"\nat_s = 45.0\nfor_s = 30.0'
    files(tmp_path, stage=STAGE, emulation=f"prompt_s = 5.0\n{fault}")
    low_level = Bringer("", EmulatedFault(instrument="bath", name="low level", for_s=600.0))
    reconnect, home, wait, contexts, homings = (
        Stage.reconnect,
        Stage.home,
        RunContext.wait,
        list[RunContext](),
        list[bool](),
    )

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


def test_one_that_stays_away_ends_the_run_after_the_rigs_patience(tmp_path: Path) -> None:
    code, record = faulty(
        tmp_path,
        'instrument = "arm"\nname = "power loss"\nat_s = 60.0',
        more="[limits]\naway_s = 90.0",
    )
    assert (code, record.ending) == (3, "faulted")
    (paused,) = [
        event for event in record.events if (event["kind"], event["text"]) == (EVENT, "paused")
    ]
    (given_up,) = [event for event in record.events if event["kind"] == "given up"]
    assert 90.0 <= given_up["t_s"] - paused["t_s"] <= 110.0
    assert texts(record, EVENT)[-2:] == ["safing", "faulted"]


@pytest.mark.parametrize(
    ("fault", "kind"),
    [
        (LinkError("arm at COM5", "gone"), ("arm", GONE)),
        (DeviceError("cameras", "no usable frame set"), ("cameras", REFUSES)),
        (DeviceError("stage at COM4", "alarm 1"), ("stage", REFUSES)),
    ],
    ids=str,
)
def test_one_that_fails_again_each_time_it_is_back_ends_the_run_after_the_tables_tries(
    fault: InstrumentError, kind: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries: list[str] = []

    def fails(_: TrialRun, trial: PlannedTrial) -> None:
        tries.append(trial.id)
        raise fault

    files(tmp_path, stage=STAGE)
    monkeypatch.setattr(TrialRun, "run", fails)
    record = read_run(start(tmp_path)[0])
    assert (record.ending, texts(record, "fault")) == ("faulted", [str(fault)])
    times = POLICIES[kind].times
    assert tries == [TRIALS[0]] * (1 + times)
    assert len(texts(record, "dropped out")) == len(texts(record, "back")) == times
    assert record.facts["retries"] == {" ".join(kind): times}, (
        "how often it was tried is in the record"
    )


def test_a_rig_without_patience_ends_at_once(tmp_path: Path) -> None:
    fault = 'instrument = "arm"\nname = "power loss"\nat_s = 60.0\nfor_s = 40.0'
    code, record = faulty(tmp_path, fault, more="[limits]\naway_s = 0")
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
    for fault, key in cases:
        assert policy_for(fault) is (None if key is None else POLICIES[key]), fault
    assert instrument_of(LinkError("guardian", "gone")) is None


FAULT = """prompt_s = 120.0
[[emulation.faults]]
instrument = "bath"
name = "dead heater"
at_s = 855.0
for_s = 105.0"""


def test_what_stands_there_waits_until_the_bath_is_stable_again(tmp_path: Path) -> None:
    script = SCRIPT.replace("window_s = 2.0", "window_s = 60.0\nleave_k = 0.03\nmean_k = 0.03")
    code, record = run(files(tmp_path, script=script, emulation=FAULT), tmp_path)
    assert (code, record.ending, len(record.trials)) == (0, "finished", 3)
    told = [event for event in record.events if event["kind"] == "suspended"]
    assert told, [(event["t_s"], event["kind"], event["text"]) for event in record.events]
    assert "the bath left its band" in told[0]["text"]
    late = [trial for trial in record.trials if trial.head["note"]]
    assert [trial.id for trial in late] == [told[0]["text"].split(":")[0]]
    assert str(late[0].head["note"]).startswith("suspended for ")
    assert all(trial.head["bath_state"] == "stable" for trial in record.trials), (
        "nothing was taken while it was out"
    )
    states = [event["text"] for event in record.events if event["kind"] == EVENT]
    assert states[2:5] == ["running", "settling", "running"]
    assert latency_of(record, "thesis").median_s is not None
    assert (
        max(latency_of(record, "thesis").seconds)
        < 60.0
        <= late[0].head["ended_s"] - late[0].head["started_s"]
    )


def test_a_bath_that_leaves_its_band_while_a_camera_is_late_costs_the_frames_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was in its band when the cameras were asked: what they gave later is of a bath that
    wasn't, and no detector's fault.
    """
    take, wait, waiting, taken = (
        FrameTaker.take,
        RunContext.wait,
        list[RunContext](),
        list[FrameSet](),
    )

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
    script = SCRIPT.replace("window_s = 2.0", "window_s = 60.0\nleave_k = 0.03\nmean_k = 0.03")
    fault = FAULT.replace("prompt_s = 120.0", "").replace("at_s = 855.0", "at_s = 100.0")
    code, record = run(files(tmp_path, script=script, emulation=fault), tmp_path)
    assert (code, record.ending) == (0, "finished")
    assert [
        event["text"].split(":")[0] for event in record.events if event["kind"] == "suspended"
    ] == ["001-place-1-1"]
    assert [trial.head["bath_state"] for trial in record.trials] == ["stable"] * 3
    assert len(taken) == 4, "the first trial's are taken again"
    assert len(record.trials[0].frames) == len(record.trials[1].frames)
