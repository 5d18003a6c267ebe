"""A disk that is full: whoever writes says what could not be written and that room is needed, and
leaves nothing by halves.
"""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from bench.run import estimate
from tests.bench.commands import Said, full
from tests.bench.small_run import KEPT

pytestmark = pytest.mark.slow

CALIBRATION = KEPT / "calibration.toml"
COMMANDS = {
    "a run": "run six-situations --out {there}/runs",
    "a recording scored": "score {recording} --detector thesis --out {there}/runs",
    "a comparison": "compare {run} {run} --out {there}/compared",
    "a summary": "compare {run} {run} --summary {there}/summary.md",
    "tables": "store export {run} --format csv --out {there}/tables",
    "a recording": "recording pack {run} --out {there}/packed",
    "a picture": "scene sheet --situation ideal --out {there}/scene.png",
    "for OpenCV": "calibrate export {calibration} --format opencv --out {there}/of.yaml",
    "for Bouguet": "calibrate export {calibration} --format bouguet --out {there}/of.mat",
    "for ROS": "calibrate export {calibration} --format ros --camera left --out {there}/of.yaml",
    "a board": "calibrate board chessboard-9x6-40 --pdf {there}/board.pdf",
    "an arm's frame": "arm frame --port emulator: --homed --out {there}/frame.toml",
    "an arm's verification": "arm verify --port emulator: --homed --out {there}/arm.toml",
    "a stage's places": "calibrate stage --rig emulated --out {there}/stage.toml",
    "bytes": "bath learn --port tcp://127.0.0.1:1 --profile julabo-presto --capture {there}/b",
    "scenes": "scene record --situation ideal --seeds 2 --out {there}/a/scenes",
    "boards": "scene boards chessboard-9x6-40 --poses 2 --out {there}/a/boards",
    "frames": "camera grab --out {there}/a/frames",
    "a campaign": "campaign run --family ideal --scenes 1 --detector thesis --out {there}/a/b",
    "a detector": "detectors new python --name mine --out {there}/a/detectors",
    "a rig": "init --yes --port socket://127.0.0.1:1 --out {there}/rig.toml",
}


ALONE = "a run"  # in a process of its own, which loads on a full disk what it needs


CASES = [*((what, 0) for what in COMMANDS), ("a picture", 512), ("a detector", 512)]
# small files of a set are written, then a large one isn't
CASES += [(what, 1200) for what in ("tables", "a recording")]
CASES += [(what, 10_000) for what in ("a comparison", "scenes", "boards", "frames")]


@pytest.mark.parametrize(("what", "most"), CASES)
def test_a_command_on_a_full_disk_says_so_and_leaves_nothing(
    what: str, most: int, tmp_path: Path, said: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    (there := tmp_path / "there").mkdir()
    places = {"run": KEPT, "recording": KEPT, "calibration": CALIBRATION, "there": there}
    words = shlex.split(COMMANDS[what].format(**places))
    with full(most):
        if what == ALONE:
            command = [sys.executable, "-m", "bench.cli", *words]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            assert done.returncode == 3, done
            out, err = done.stdout, done.stderr
        else:
            out, err = said(3, "{}", words)
    assert "written:" not in out
    assert re.search(rf"{re.escape(str(there))}\S*: .*File too large\. Make room\.", err), err
    left = [one for one in there.rglob("*") if one.is_dir() or one.stat().st_size]
    assert not left


def test_a_recording_that_would_not_fit_is_refused_before_it_is_scored(
    tmp_path: Path, said: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures_mb = 1e-6 * sum(one.stat().st_size for one in (KEPT / "frames").rglob("*.png"))
    monkeypatch.setattr(estimate, "disk_usage", lambda _: SimpleNamespace(free=1.9e6 * pictures_mb))
    err = said(2, "score {} --detector thesis --out {}", KEPT, tmp_path / "runs").err
    assert f"MB are free in {tmp_path}, and up to {2.0 * pictures_mb:.0f} MB are needed" in err
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="only Linux has a full device")
def test_output_that_goes_to_a_full_disk_is_named() -> None:
    command = [sys.executable, "-m", "bench.cli", "rigs"]
    with Path("/dev/full").open("wb", buffering=0) as out:
        done = subprocess.run(command, stdout=out, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 3
    assert done.stderr == "teatbench: stdout: No space left on device. Make room.\n"


def test_a_report_that_cannot_be_written_says_that_the_run_is_kept(
    tmp_path: Path, said: Said
) -> None:
    run = Path(shutil.copytree(KEPT, tmp_path / "a run"))
    shutil.rmtree(run / "report", ignore_errors=True)
    (run / "report").touch()
    with pytest.raises(FileExistsError) as there:
        (run / "report").mkdir()
    err = said(3, "report {} --no-pdf", run).err
    then = f'The run is kept. Remove the cause, then: teatbench report "{run}"'
    assert err == f"teatbench: {run / 'report'}: {there.value.strerror}. {then}\n"
