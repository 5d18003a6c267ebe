"""A new rig: checked and calibrated before there is a calibration, and one of `emulate
--write-rig`.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from bench.cli.main import main
from bench.record.reader import read_run
from bench.rig.loading import find_rig, load_rig
from bench.script.phantom import shipped_phantom
from detector.calibration import load_part
from tests.bench.calibrate.small_rig import small_calibration, write_rig
from tests.bench.forked import begin
from tests.bench.real_rig import QUICK_HOMING, real_rig, record_one, script_of
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.slow

Capture = pytest.CaptureFixture[str]
posix = pytest.mark.skipif(sys.platform == "win32", reason="sends a POSIX signal to a child")


def test_a_rig_without_a_calibration_is_checked_and_not_run(
    tmp_path: Path, capsys: Capture
) -> None:
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


@pytest.fixture(scope="module")
def written_rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """What `emulate --write-rig` of another process wrote, in a folder of its own."""
    folder = tmp_path_factory.mktemp("elsewhere")
    emulation = ("[emulation]", "bath_start_c = 33.0", "hand_error_mm = 0.01", QUICK_HOMING)
    small = write_rig(folder, *emulation)
    (folder / "lab").mkdir()
    path = folder / "lab" / "written.toml"
    with begin(["emulate", str(small), "--write-rig", str(path)]) as child:
        try:
            assert child.stdout is not None
            said: list[str] = []
            while not (said and said[-1].startswith("written: ")):
                said.append(child.stdout.readline())
                assert said[-1], f"ended: {said}"
            yield path
        finally:
            child.send_signal(signal.SIGINT)
            child.communicate(timeout=PATIENCE_S)
        assert child.returncode == 0


@posix
def test_a_written_rig_runs_as_it_is(written_rig: Path, tmp_path: Path) -> None:
    (tmp_path / "short.toml").write_text(script_of(), encoding="utf-8")
    given = ["run", str(tmp_path / "short.toml"), "--rig", str(written_rig)]
    assert main([*given, "--out", str(tmp_path / "runs")]) == 0
    (folder,) = (tmp_path / "runs").iterdir()
    run = read_run(folder)
    assert run.facts["kind"] == "emulated"
    (trial,) = run.trials
    touched = np.array([[row[axis] for axis in ("x_mm", "y_mm", "z_mm")] for row in trial.truth])
    there = shipped_phantom("table-5-1").ends_mm + np.array([5.0, 0.0, 0.0])
    np.testing.assert_allclose(touched, there, atol=1.5)


@pytest.mark.weekly
@posix
def test_a_written_rig_is_calibrated_before_there_is_a_calibration(
    written_rig: Path, tmp_path: Path
) -> None:
    text = written_rig.read_text(encoding="utf-8")
    whole = load_rig(written_rig).calibration_path.as_posix()
    text = text.replace(whole, "calibration.toml")
    text = text.replace("[cameras]\n", "[cameras]\nsettle_s = 0.2\n")  # in real time, 24 views
    (tmp_path / "new.toml").write_text(text, encoding="utf-8")
    rig = ["--rig", str(tmp_path / "new.toml")]
    cameras = tmp_path / "cameras.toml"
    given = ["calibrate", "cameras", *rig, "--board", "chessboard-9x6-40", "--out", str(cameras)]
    assert main(given) in (0, 4)  # by how good it is
    part, put_in = load_part(cameras), small_calibration()
    assert part.left is not None
    assert part.right_from_left is not None
    np.testing.assert_allclose(part.left.fc, put_in.left.fc, rtol=0.01)
    np.testing.assert_allclose(part.right_from_left.T, put_in.right_from_left.T, atol=3.0)


def test_a_rig_file_that_is_there_is_not_written_over(tmp_path: Path, capsys: Capture) -> None:
    mine = tmp_path / "mine.toml"
    mine.write_text("precious", encoding="utf-8")
    assert main(["emulate", "--write-rig", str(mine)]) == 2
    assert f"--write-rig {mine} is there already" in capsys.readouterr().err
    assert mine.read_text(encoding="utf-8") == "precious"


def test_an_emulated_rig_without_a_calibration_says_where_one_is(
    tmp_path: Path, capsys: Capture
) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text(find_rig(None).read_text(encoding="utf-8"), encoding="utf-8")
    assert main(["check", str(rig)]) == 2
    refused = capsys.readouterr().err
    assert "copy the shipped one" in refused
    assert str(find_rig(None).with_name("calibration.toml")) in refused
