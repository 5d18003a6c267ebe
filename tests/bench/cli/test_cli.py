"""The commands with good and bad input: one sentence, the right exit code, never a traceback."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from bench.rig.loading import RIGS
from tests.bench.commands import NO_CAMERA, Said, lab_rig, teatbench
from tests.conftest import ROOT
from tests.waiting import PATIENCE_S


def damaged_recording(folder: Path) -> None:
    """One frame set, a byte of whose left picture is another."""
    (folder / "frames" / "0000").mkdir(parents=True)
    (folder / "calibration.toml").write_bytes((RIGS / "calibration.toml").read_bytes())
    whole = cv2.imencode(".png", np.tile(np.arange(256, dtype=np.uint8), (200, 1)))[1].tobytes()
    for name in ("left", "right", "thermal"):
        (folder / "frames" / "0000" / f"{name}.png").write_bytes(whole)
    at = len(whole) // 2
    (folder / "frames" / "0000" / "left.png").write_bytes(
        whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :]
    )


NOISY = {  # the library that would write, what it is made to do, and what we say of it
    "libpng": ("detect recording", "the checksum of its chunk b'IDAT' from byte "),
    "OpenCV": ("camera show opencv:97", "camera at 97: can't be opened"),
    "FFmpeg": (
        "camera show opencv:http://127.0.0.1:9/video",
        "camera at http://127.0.0.1:9/video: can't be opened",
    ),
}


@pytest.mark.slow
def test_what_a_library_would_write_to_the_terminal_is_reported_in_our_words(
    tmp_path: Path,
) -> None:
    """In a process of its own, for they are told to be quiet before they are loaded."""
    damaged_recording(tmp_path / "recording")
    commands = [command.split() for command, _ in NOISY.values()]
    program = f"from bench.cli.main import main\nfor one in {commands}:\n    main(one)"
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith("OPENCV_")
    }
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**environment, "PYTHONPATH": str(ROOT)},
        check=True,
    )
    for library, (_, message) in NOISY.items():
        assert message in done.stdout + done.stderr, library
    assert [
        line for line in done.stderr.splitlines() if not line.startswith(("teatbench: ", "  "))
    ] == []


def test_runs_that_cannot_be_kept_are_reported(tmp_path: Path, said: Said) -> None:
    (tmp_path / "file").write_text("in the way", encoding="utf-8")
    assert "--out" in said(2, "run --out {}", tmp_path / "file").err


def test_a_recording_is_not_written_over(tmp_path: Path, said: Said) -> None:
    (tmp_path / "rec").mkdir()
    (tmp_path / "rec" / "mine.txt").write_text("precious", encoding="utf-8")
    assert (
        "not empty" in said(2, "run --out {} --record {}", tmp_path / "runs", tmp_path / "rec").err
    )
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
def test_check_names_every_instrument_that_does_not_answer(tmp_path: Path, said: Said) -> None:
    dead = {
        '"/dev/ttyUSB0"            #': '"/dev/no-such-port" #',
        '"tcp://192.168.0.40:502"': '"tcp://127.0.0.1:1"',
        '"/dev/ttyACM0"            #': '"socket://127.0.0.1:1" #',
    }
    seen = said(3, "check {}", lab_rig(tmp_path, dead | NO_CAMERA)).out
    for name in ("arm", "bath", "stage", "cameras"):
        assert f"{name}: FAULT" in seen
    assert "Traceback" not in seen


INTERRUPTED = "teatbench: interrupted: nothing was begun.\n"


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="sends POSIX signals")
@pytest.mark.parametrize(
    ("when", "code", "text"), [("import", 3, INTERRUPTED), ("exit", 2, ""), ("_exit", 2, "")]
)
def test_ctrl_c_while_a_command_loads_or_after_it_ended(when: str, code: int, text: str) -> None:
    program = """
import atexit, os, signal, sys
from bench.cli.process import main
interrupt = lambda: os.kill(os.getpid(), signal.SIGINT)
class Loading:
    def find_spec(self, name, *_):
        if name == "bench.cli.commands":
            interrupt()
if sys.argv[1] == "import":
    sys.meta_path.insert(0, Loading())
elif sys.argv[1] == "exit":
    atexit.register(interrupt)
else:
    atexit.register(lambda: os._exit(0))  # as some libraries of devices do
sys.argv[1:] = ["help", "no-such-page"]
sys.exit(main())
"""
    ended = subprocess.run(
        [sys.executable, "-c", program, when], capture_output=True, text=True, cwd=ROOT, check=False
    )
    assert ended.returncode == code, ended.stderr
    assert ended.stderr.endswith(text)
    assert "Traceback" not in ended.stderr


@pytest.mark.slow
@pytest.mark.parametrize(("seconds", "says"), [(0.5, ""), (3600.0, "left running: reader")])
def test_a_thread_that_a_driver_left_keeps_no_command_from_its_end(
    seconds: float, says: str
) -> None:
    program = f"""
import sys, threading, time
import bench.cli.process as command
threading.Thread(target=time.sleep, args=({seconds},), name="reader").start()
sys.argv[1:] = ["help", "no-such-page"]
sys.exit(command.main())
"""
    ended = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
        timeout=PATIENCE_S,
    )
    assert ended.returncode == 2, ended.stderr
    assert ("left running" in ended.stderr) is bool(says)
    assert says in ended.stderr


# descriptors that a driver has closed, and the streams themselves
GONE = ("sys.__stdout__.close(); sys.__stderr__.close()", "os.close(1); os.close(2)")


@pytest.mark.parametrize("gone", GONE)
def test_a_command_that_can_say_nothing_more_is_no_requirement_that_is_not_met(gone: str) -> None:
    code = f"import os, sys, bench.cli.main as main, bench.cli.process as it\ndef _run(_):\n {gone}\n 1 / 0\n"
    code += "main._run, sys.argv = _run, ['teatbench', 'rigs']\nsys.exit(it.main())"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, cwd=ROOT, check=False)
    assert ended.returncode == 3


def test_rigs_lists_what_can_be_run_and_says_what_to_copy(said: Said) -> None:
    *runs, copy = said(0, "rigs").out.splitlines()
    assert runs == ["emulated", "emulated-browser", "emulated-depth"]
    assert copy.startswith("for a real rig: copy ")
    assert Path(copy.removeprefix("for a real rig: copy ").partition(",")[0]).is_file()


@pytest.mark.slow
def test_a_mistake_of_the_bench_is_no_requirement_that_is_not_met(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def mistaken(*_: object) -> None:
        raise ZeroDivisionError("a mistake")

    monkeypatch.setattr("bench.load_rig", mistaken)
    assert teatbench("check") == 3
    seen = capsys.readouterr().err
    assert "ZeroDivisionError: a mistake" in seen
    assert seen.endswith("teatbench: internal error; please report the traceback above\n")
    monkeypatch.setattr(cv2, "__version__", "4.11.0")
    assert teatbench("check") == 3
    seen = " ".join(capsys.readouterr().err.split())
    assert "teatbench: internal error. Python's cv2 is 4.11.0, another package's (pip: " in seen


@pytest.mark.parametrize("raised", [ZeroDivisionError(), SystemExit(), GeneratorExit()], ids=repr)
def test_after_a_run_has_begun_a_mistake_leaves_it_and_says_what_writes_its_report(
    raised: BaseException, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def mistaken(*_: object, begun: Callable[[str], None], **__: object) -> None:
        begun("Run folder: runs/one")
        raise raised

    monkeypatch.setattr("bench.run_queue", mistaken)
    assert teatbench("run") == 3
    said = " ".join(capsys.readouterr().err.split())
    assert type(raised).__name__ in said
    assert "internal error; please report the traceback above; the run is kept" in said
    assert said.endswith("'teatbench report latest' writes it")
