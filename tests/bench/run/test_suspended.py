"""A trial is suspended while the bath is out of its band: it waits, settles again and goes on, and
the time is kept out of figures.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.results.latency import latency_of
from bench.rig.frame_capture import FrameTaker
from bench.run.context import RunContext
from bench.run.states import EVENT
from instruments.camera.frame import FrameSet
from tests.bench.operated_runs import SCRIPT, files, run

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
