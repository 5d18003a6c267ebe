"""A new rig, which has no calibration yet: checked and calibrated, but not run."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.cli import main
from tests.bench.real_rig import real_rig, record_one

Capture = pytest.CaptureFixture[str]


def test_a_rig_without_a_calibration_is_checked_and_not_run(tmp_path: Path, capsys: Capture) -> None:
    with real_rig(tmp_path / "lab", record_one(tmp_path / "recording", 1)) as rig:
        calibration = rig.folder / "calibration.toml"
        calibration.unlink()
        assert main(["check", str(rig.rig_path)]) == 0
        said = capsys.readouterr().out
        assert f"calibration: not made yet ({calibration})" in said
        assert "bath: ok" in said
        assert "cameras: ok" in said
        given = ["run", str(rig.script_path), "--rig", str(rig.rig_path), "--out", str(rig.out)]
        for more in ([], ["--dry-run"], ["--record", str(tmp_path / "recorded")]):
            assert main([*given, *more]) == 2
            refused = capsys.readouterr().err
            assert f"{rig.rig_path}:3: calibration: no such file beside the rig file" in refused
            assert "teatbench calibrate" in refused
    assert not rig.out.exists()
    assert not (tmp_path / "recorded").exists()
