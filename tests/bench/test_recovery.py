"""An instrument that drops out pauses the run; it goes on when the instrument is back, and a trial in flight is done again whole."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.record import RunRecord
from bench.running.retries import GARBLED, GONE, POLICIES, REFUSES, instrument_of, policy_for
from bench.running.run_state import EVENT
from instruments.errors import DeviceError, InstrumentError, LimitError, LinkError, ProtocolError
from instruments.microscribe.refusals import AnotherArmError, SilentArmError
from tests.bench.operated_runs import STAGE, files, run

TRIALS = ["001-place-1-1", "002-place-2-1", "003-place-3-1"]


def faulty(folder: Path, fault: str, *, more: str = "", prompt_s: float = 5.0) -> tuple[int, RunRecord]:
    emulation = f"prompt_s = {prompt_s}\n[[emulation.faults]]\n{fault}\n{more}"
    return run(files(folder, stage=STAGE, emulation=emulation), folder)


def texts(record: RunRecord, kind: str) -> list[str]:
    return [event["text"] for event in record.events if event["kind"] == kind]


@pytest.mark.parametrize(
    ("fault", "instrument"),
    [
        ('instrument = "arm"\nname = "power loss"\nat_s = 60.0\nfor_s = 40.0', "arm"),
        ('instrument = "arm"\nname = "silent"\nat_s = 60.0\nfor_s = 20.0', "arm"),
        ('instrument = "stage"\nname = "silent"\nat_s = 45.0\nfor_s = 30.0', "stage"),
        ('instrument = "stage"\nname = "disconnect"\nat_s = 45.0\nfor_s = 30.0', "stage"),
        ('instrument = "cameras"\nname = "dropped"\nat_s = 30.0\nfor_s = 30.0', "cameras"),
    ],
    ids=["arm without power", "arm silent", "stage silent", "stage unplugged", "camera without frames"],
)
def test_it_goes_on_when_the_instrument_is_back(fault: str, instrument: str, tmp_path: Path) -> None:
    _, record = faulty(tmp_path, fault)
    assert record.ending == "finished", texts(record, "fault")
    assert [trial.id for trial in record.trials] == TRIALS
    assert any(f"the {instrument} is back after" in text for text in texts(record, "back"))
    states = texts(record, EVENT)
    assert states[states.index("paused") + 1] == "running"
    assert sum(record.facts["retries"].values()) >= 1
    assert all(len(trial.touches) == 4 for trial in record.trials), "a trial done again has one set of touches"


def test_one_that_stays_away_ends_the_run_after_the_rigs_patience(tmp_path: Path) -> None:
    code, record = faulty(tmp_path, 'instrument = "arm"\nname = "power loss"\nat_s = 60.0', more="[limits]\naway_s = 90.0")
    assert (code, record.ending) == (3, "faulted")
    (paused,) = [event for event in record.events if (event["kind"], event["text"]) == (EVENT, "paused")]
    (given_up,) = [event for event in record.events if event["kind"] == "given up"]
    assert 90.0 <= given_up["t_s"] - paused["t_s"] <= 110.0
    assert texts(record, EVENT)[-2:] == ["safing", "faulted"]


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
