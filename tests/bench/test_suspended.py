"""A trial is suspended while the bath is out of its band: it waits, settles again and goes on, and the time is kept out of figures."""

from __future__ import annotations

from pathlib import Path

from bench.detecting.latency import latency_of
from bench.running.run_state import EVENT
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
    assert all(trial.head["bath_state"] == "stable" for trial in record.trials), "nothing was taken while it was out"
    states = [event["text"] for event in record.events if event["kind"] == EVENT]
    assert states[2:5] == ["running", "settling", "running"]
    assert latency_of(record, "thesis").median_s is not None
    assert max(latency_of(record, "thesis").seconds) < 60.0 <= late[0].head["ended_s"] - late[0].head["started_s"]
