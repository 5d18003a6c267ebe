"""Stability in whole runs on the emulated rig: a frozen bath never opens the gate, and the report
says what was stable and how much.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from bench.cli.main import main
from bench.record.reader import RunRecord, read_run
from bench.rig.loading import RIGS

FAULT = """
[[emulation.faults]]
instrument = "bath"
name = "frozen sensor"
at_s = {at_s}
"""


def run_on(folder: Path, script: str, fault: str = "") -> tuple[int, RunRecord, str]:
    (folder / "calibration.toml").write_text(
        (RIGS / "calibration.toml").read_text(encoding="utf-8"), encoding="utf-8"
    )
    (folder / "rig.toml").write_text(
        (RIGS / "emulated.toml").read_text(encoding="utf-8") + fault, encoding="utf-8"
    )
    (folder / "script.toml").write_text(script, encoding="utf-8")
    code = main(
        [
            "run",
            str(folder / "script.toml"),
            "--rig",
            str(folder / "rig.toml"),
            "--out",
            str(folder / "runs"),
        ]
    )
    (run,) = (folder / "runs").iterdir()
    return code, read_run(run), (run / "report" / "index.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("at_s", [640.0, 700.0, 800.0])
def test_a_bath_that_freezes_near_its_set_point_is_never_stable(
    at_s: float, short_script: Path, tmp_path: Path
) -> None:
    """Its controller goes on working, and its output moves: that is no evidence of its
    temperature.
    """
    text = short_script.read_text(encoding="utf-8")
    assert "window_s = 60.0" in text
    script = text.replace("window_s = 60.0", "window_s = 600.0\ntimeout_s = 2500.0")
    code, run, _ = run_on(tmp_path, script, FAULT.format(at_s=at_s))
    assert code == 3
    assert run.ending == "faulted"
    assert not run.trials
    states = [
        state for t_s, state in zip(run.bath[:, 0], run.bath_states, strict=True) if t_s > at_s
    ]
    assert states
    assert "stable" not in states


def test_the_report_has_temperatures_stability_and_the_teats_surface_at_every_capture(
    short_script: Path, tmp_path: Path
) -> None:
    _, run, page = run_on(tmp_path, short_script.read_text(encoding="utf-8"))
    assert len(run.trials) >= 6
    rows = re.findall(r"<tr.*?</tr>", page, re.DOTALL)
    plain = [re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", row)) for row in rows]
    for trial in run.trials:
        of_trial = [row for row in plain if trial.id in row]
        assert any(re.search(r"33\.0\d .* stable 32\.\d\d 0\.\d\d", row) for row in of_trial), (
            "bath, state, teats' surface and its uncertainty"
        )
        assert any(
            re.search(r"6\d [+-]0\.0\d\d\d [+-]0\.0\d\d\d [+-]0\.0\d\d\d", row) for row in of_trial
        ), "mean, half range, slope"
    assert "Uniformity, from teat to teat and from root to tip, is not measured" in page
    assert "The 60 s before each capture" in page
