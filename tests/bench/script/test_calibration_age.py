"""How old a calibration may be, and whose cameras it is of: refused before a run, judged after."""

from __future__ import annotations

import shutil
from contextlib import nullcontext
from dataclasses import replace
from datetime import date
from pathlib import Path

import pytest

from bench.config import ConfigError
from bench.rig.loading import RIGS, find_rig, load_rig
from bench.script.calibration_age import (
    CALIBRATION_FACT,
    calibration_fact,
    decide_calibration,
    not_fresh,
    refuse_old_calibration,
    refuse_other_cameras,
)
from bench.script.model import TRIALS, CalibrationRequirement, LoadedScript, load_script
from detector.calibration import Calibration, Record, dump_calibration, load_calibration
from instruments.errors import LimitError
from tests.bench.commands import Said, lab_rig

TODAY = date(2026, 11, 20)
RULE = CalibrationRequirement(kind="calibration_fresh", name="calibration fresh", max_age_days=30)


def made(day: str, **cameras: str) -> Calibration:
    record = Record(day, "A. Tester", "teatbench", cameras, {})
    return replace(load_calibration(RIGS / "calibration.toml"), record=record)


@pytest.fixture
def script(tmp_path: Path) -> LoadedScript:
    path = tmp_path / "fresh.toml"
    text = (TRIALS / "six-situations.toml").read_text(encoding="utf-8")
    path.write_text(
        text.replace("[bath]", "[calibration]\nmax_age_days = 30\n\n[bath]", 1), encoding="utf-8"
    )
    return load_script(path)


@pytest.mark.parametrize(
    ("day", "said"),
    [
        ("2026-10-20", r"made on 2026-10-20, 31 days ago; .*fresh.toml allows 30 days .*Calibrate"),
        ("2026-10-21", ""),
        ("2026-11-27", "is this machine's clock right"),
        (None, r"no \[record\] that says when it was made"),
    ],
)
def test_the_age_that_a_script_allows(day: str | None, said: str, script: LoadedScript) -> None:
    real = load_rig(find_rig("lab.example"))
    rig = replace(real, made_calibration=made(day)) if day else real
    with pytest.raises(ConfigError, match=said) if said else nullcontext():
        refuse_old_calibration(rig, script, TODAY)


@pytest.mark.parametrize("day", ["2026-10-20", "2026-11-27", "2026-10-21", None])
def test_what_a_requirement_will_say_is_said_before_the_run_in_the_same_words(
    day: str | None, script: LoadedScript
) -> None:
    rig = load_rig(find_rig("lab.example"))
    rig = replace(rig, made_calibration=made(day)) if day else rig
    facts = {CALIBRATION_FACT: calibration_fact(rig.calibration, TODAY, emulated=False)}
    decision = decide_calibration(RULE, facts)
    said = [*not_fresh(rig, script, TODAY)]
    assert bool(said) == (decision.verdict == "not met")
    for text in said:
        words = decision.sentence.removeprefix("The calibration ").partition(";")[0]
        assert words in text
        with pytest.raises(ConfigError, match=words.replace("?", "")):
            refuse_old_calibration(rig, script, TODAY)
    assert not [*not_fresh(load_rig(find_rig(None)), script, TODAY)]


def test_who_asks_for_nothing_gets_any_and_emulated_cameras_are_made_from_theirs(
    script: LoadedScript,
) -> None:
    any_age = load_script(TRIALS / "six-situations.toml")
    for rig, asked in (("lab.example", any_age), (None, script)):
        refuse_old_calibration(load_rig(find_rig(rig)), asked, TODAY)


def test_by_command_nothing_is_opened_and_the_exit_code_is_2(
    tmp_path: Path, script: LoadedScript, said: Said
) -> None:
    rig = lab_rig(tmp_path, {})
    old = dump_calibration(made("2020-01-01"))
    (tmp_path / "calibration.toml").write_text(old, encoding="utf-8")
    run = "run {} --rig {} --out {}"
    assert "was made on 2020-01-01" in said(2, run, script.path, rig, tmp_path / "runs").err
    assert not (tmp_path / "runs").exists()


SEEN = {
    "left": "Basler acA1300-60gm, serial 21876543",
    "right": "Basler acA1300-60gm, serial 21876544",
}


@pytest.mark.parametrize(
    "calibration",
    [
        made("2026-11-01", left="21876543", right="21876544"),
        load_calibration(RIGS / "calibration.toml"),
        made("2026-11-01", thermal="FLIR 7"),
    ],
    ids=["a serial number is enough", "no record", "a camera that is not there"],
)
def test_cameras_that_are_taken(calibration: Calibration) -> None:
    refuse_other_cameras(calibration.record, SEEN)


def test_cables_that_were_swapped() -> None:
    said = r"made for the left camera '21876544', but the one that answers is 'Basler .*543'"
    with pytest.raises(LimitError, match=said):
        refuse_other_cameras(made("2026-11-01", left="21876544", right="21876543").record, SEEN)


@pytest.mark.slow
def test_in_a_run_other_cameras_are_an_instruments_fault(
    tmp_path: Path, short_script: Path, said: Said
) -> None:
    text = dump_calibration(made("2026-11-01", left="emulated 640 x 480"))
    (tmp_path / "calibration.toml").write_text(text, encoding="utf-8")
    rig = shutil.copy(RIGS / "emulated.toml", tmp_path)
    seen = said(3, "run {} --rig {} --out {}", short_script, rig, tmp_path / "runs").out
    why = "'emulated 640 x 480', but the one that answers is 'emulated 1360 x 1024'"
    assert f"made for the left camera {why}" in " ".join(seen.split())  # a terminal breaks lines


@pytest.mark.parametrize(
    ("day", "emulated", "verdict"),
    [
        ("2026-10-21", False, "met"),
        ("2026-10-20", False, "not met"),
        ("2027-01-01", False, "not met"),
        (None, False, "not measured"),
        (None, True, "met"),
        ("2020-01-01", True, "met"),
    ],
)
def test_the_requirement(day: str | None, emulated: bool, verdict: str) -> None:
    calibration = made(day) if day else load_calibration(RIGS / "calibration.toml")
    facts = {CALIBRATION_FACT: calibration_fact(calibration, TODAY, emulated=emulated)}
    decision = decide_calibration(RULE, facts)
    assert decision.verdict == verdict
    assert decision.sentence.startswith("Not checked: ") == (verdict == "not measured")
    assert decide_calibration(RULE, {}).verdict == "not measured"
