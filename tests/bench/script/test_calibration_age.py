"""How old a calibration may be, and whose cameras it is of:
refused before a run, judged after it.
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from datetime import date
from pathlib import Path

import pytest

from bench.cli.main import main
from bench.config import ConfigError
from bench.rig.loading import RIGS, LoadedRig, find_rig, load_rig
from bench.script.calibration_age import (
    CALIBRATION_FACT,
    calibration_fact,
    decide_calibration,
    refuse_old_calibration,
    refuse_other_cameras,
)
from bench.script.model import TRIALS, CalibrationRequirement, LoadedScript, load_script
from detector.calibration import Calibration, Record, dump_calibration, load_calibration
from instruments.errors import LimitError

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


@pytest.fixture
def real() -> LoadedRig:
    return load_rig(find_rig("lab.example"))


@pytest.mark.parametrize(
    ("day", "said"),
    [
        ("2026-10-20", r"made on 2026-10-20, 31 days ago; .*fresh.toml allows 30 days .*Calibrate"),
        ("2026-10-21", ""),
        ("2026-11-27", "is this machine's clock right"),
        (None, r"no \[record\] that says when it was made"),
    ],
)
def test_the_age_that_a_script_allows(
    day: str | None, said: str, real: LoadedRig, script: LoadedScript
) -> None:
    rig = replace(real, made_calibration=made(day)) if day else real
    with pytest.raises(ConfigError, match=said) if said else nullcontext():
        refuse_old_calibration(rig, script, TODAY)


class TestBeforeARun:
    def test_a_script_that_asks_for_nothing_gets_any(self, real: LoadedRig) -> None:
        refuse_old_calibration(real, load_script(TRIALS / "six-situations.toml"), TODAY)

    def test_emulated_cameras_are_made_from_theirs(self, script: LoadedScript) -> None:
        refuse_old_calibration(load_rig(find_rig(None)), script, TODAY)

    def test_by_command_nothing_is_opened_and_the_exit_code_is_2(
        self, tmp_path: Path, script: LoadedScript, capsys: pytest.CaptureFixture[str]
    ) -> None:
        (tmp_path / "calibration.toml").write_text(
            dump_calibration(made("2020-01-01")), encoding="utf-8"
        )
        text = (RIGS / "lab.example.toml").read_text(encoding="utf-8")
        (tmp_path / "lab.toml").write_text(text, encoding="utf-8")
        out = str(tmp_path / "runs")
        assert (
            main(["run", str(script.path), "--rig", str(tmp_path / "lab.toml"), "--out", out]) == 2
        )
        assert "was made on 2020-01-01" in capsys.readouterr().err
        assert not (tmp_path / "runs").exists()


SEEN = {
    "left": "Basler acA1300-60gm, serial 21876543",
    "right": "Basler acA1300-60gm, serial 21876544",
}


class TestCameras:
    @pytest.mark.parametrize(
        "calibration",
        [
            made("2026-11-01", left="21876543", right="21876544"),
            load_calibration(RIGS / "calibration.toml"),
            made("2026-11-01", thermal="FLIR 7"),
        ],
        ids=["a serial number is enough", "no record", "a camera that is not there"],
    )
    def test_cameras_that_are_taken(self, calibration: Calibration) -> None:
        refuse_other_cameras(calibration.record, SEEN)

    def test_cables_that_were_swapped(self) -> None:
        said = r"made for the left camera '21876544', but the one that answers is 'Basler .*543'"
        with pytest.raises(LimitError, match=said):
            refuse_other_cameras(made("2026-11-01", left="21876544", right="21876543").record, SEEN)

    @pytest.mark.slow
    def test_in_a_run_it_is_an_instruments_fault(
        self, tmp_path: Path, short_script: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        text = dump_calibration(made("2026-11-01", left="emulated 640 x 480"))
        (tmp_path / "calibration.toml").write_text(text, encoding="utf-8")
        (tmp_path / "rig.toml").write_text(
            (RIGS / "emulated.toml").read_text(encoding="utf-8"), encoding="utf-8"
        )
        rig, out = str(tmp_path / "rig.toml"), str(tmp_path / "runs")
        assert main(["run", str(short_script), "--rig", rig, "--out", out]) == 3
        said = " ".join(capsys.readouterr().out.split())  # the terminal breaks lines
        assert (
            "made for the left camera 'emulated 640 x 480', but the one that answers is 'emulated"
            " 1360 x 1024'" in said
        )


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
    assert decide_calibration(RULE, facts).verdict == verdict


def test_a_run_that_kept_nothing_of_it_is_not_measured() -> None:
    assert decide_calibration(RULE, {}).verdict == "not measured"
