"""A disk that is full: whoever writes says what could not be written and that room is needed, and
leaves nothing by halves.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from tests.bench.commands import Said
from tests.bench.small_run import KEPT

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
    "a detector": "detectors new python --name mine --out {there}/detectors",
    "a rig": "init --yes --port socket://127.0.0.1:1 --out {there}/rig.toml",
}


SETS = ("tables", "a recording", "a comparison")
SOME = 1200  # bytes that a file may have: small ones of a set are written, then a large one isn't


def full(bytes_of_a_file: int) -> None:
    """No file may grow beyond this: the system refuses each write as on a full disk."""
    import resource

    resource.setrlimit(resource.RLIMIT_FSIZE, (bytes_of_a_file, bytes_of_a_file))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no limit of a process's files")
@pytest.mark.parametrize(
    ("what", "room"), [*((what, 0) for what in COMMANDS), *((what, SOME) for what in SETS)]
)
def test_a_command_on_a_full_disk_says_so_and_leaves_nothing(
    what: str, room: int, tmp_path: Path
) -> None:
    (there := tmp_path / "there").mkdir()
    places = {"run": KEPT, "recording": KEPT, "calibration": CALIBRATION, "there": there}
    words = shlex.split(COMMANDS[what].format(**places))
    command = [sys.executable, "-m", "bench.cli", *words]
    # else a part of a compiled module would be left for all others
    how: dict[str, Any] = {
        "env": {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
        "preexec_fn": partial(full, room),
    }
    done = subprocess.run(command, capture_output=True, text=True, check=False, **how)
    assert done.returncode == 3, done
    assert "written:" not in done.stdout
    assert "Make room." in done.stderr, done.stderr
    left = [one for one in there.rglob("*") if one.is_dir() or one.stat().st_size]
    assert not left


def test_a_report_that_cannot_be_written_says_that_the_run_is_kept(
    tmp_path: Path, said: Said
) -> None:
    run = Path(shutil.copytree(KEPT, tmp_path / "a run"))
    shutil.rmtree(run / "report", ignore_errors=True)
    (run / "report").touch()
    err = said(3, "report {} --no-pdf", run).err
    then = f'The run is kept. Remove the cause, then: teatbench report "{run}"'
    assert err == f"teatbench: {run / 'report'}: File exists. {then}\n"
