"""All commands with everything that can be wrong: one sentence, the exit code 2 for wrong use and 3
for an instrument that does not answer, no traceback, and nothing left behind.
"""

from __future__ import annotations

import io
import re
import sys
import threading
from pathlib import Path
from unittest.mock import Mock

import pytest

from bench.cli.commands import REMOVED
from bench.script.model import TRIALS
from tests.bench.commands import Said

EMULATED = "--port emulator:"
NO_BATH = "--port tcp://127.0.0.1:1 --profile julabo-presto"


WRONG_USE = {  # code 2
    "run no-such-script": 'no trial script "no-such-script"',
    "run six-situation": 'did you mean "six-situations"',
    "run --rig none.toml": "can't be read",
    "run --summary none/s.md": "--summary none/s.md: it can't be written",
    "run --detector thesys": 'did you mean "thesis"',
    "run --seed x": "'x' is not a whole number",
    "run --seed -1": "'-1' is not a whole number",
    "report nowhere": "is no run",
    "report lastest": 'did you mean "latest"?',
    "report latest": "there are no runs yet in ",
    "compare latest nowhere": ": teatbench run six-situations",
    "runs nowhere": "no such folder",
    "score nowhere": "no such folder",
    "detect nowhere": "no such folder",
    "check emulatd": 'did you mean "emulated"',
    "": "required: COMMAND",
    **{word: f"'{word}' went: {use}" for word, use in REMOVED.items()},
    "score r --detector thesis-no-refinement": "before refinement",
    "fly": "invalid choice: 'fly' ('teatbench --help' lists all",
    "runn": "invalid choice: 'runn' (did you mean 'run' or 'runs'?)",
    "run quick --dry-rn": 'unrecognized arguments: --dry-rn; did you mean "--dry-run"?',
    "arm vrify": "invalid choice: 'vrify' (did you mean 'verify'?)",
    "trials show": "arguments are required: SCRIPT",
    "trials show plain-map": 'did you mean "plane-map"',
    "plan --rate 1": "no number of poses shows 100 %",
    "plan --sd-mm 0": "not a length in mm above 0",
    "plan --trials many": "not a whole number",
    "plan --trials 9 --script six-situations": "give one of them",
    "plan --shift-mm 0.3": "--shift-mm needs --sd-mm",
    "plan --u-mm 0.2": "--limit-mm and --u-mm belong together",
    "compare a b --confidence 1": "'1' is not a number from 0.5 to below 1",
    "compare a b --margin-mm nan": "'nan' is not a length in mm of 0 or more",
    "scene record --situation overlaping": 'did you mean "overlapping"',
    "scene record --seeds 0": "'0' is not a whole number of 1 or more",
    "scene record --rig no-such-rig": "no-such-rig",
    "scene boards chessboard-9x6-40 --camera thermal --poses 1": "take a smaller board",
    "camera show nothing": 'no rig "nothing"',
    "camera show emulated lab.example": "one rig, or one to three cameras by URL",
    "camera show opencv:0 opencv:1 opencv:2 opencv:3": "at most 3 cameras",
    "camera show opencv:a.avi socket:1": "not a camera; allowed",
    "camera grab --out x --count 0": "'0' is not a whole number of 1 or more",
    "stage status": "one of the arguments --port --rig is required",
    f"stage status {EMULATED}": "lives in the bench",
    "stage status --port ftp://x": "is no stage: not a link",
    "stage status --rig emulated": "its stage is emulated; 'teatbench emulate' serves one",
    "stage status --rig emulated --axes XY": "a rig file says itself",
    "stage move --port COM5 1": "required: Y",
    "stage move --port COM5 1 much": "'much' is not a number",
    "stage jog --port COM5 five": "'five' is no way to go",
    "stage jog --port COM5": "required: STEP",
    "stage home --port COM5 --axes X": "invalid choice: 'X'",
    f"bath read {NO_BATH[:-1]}": 'did you mean "julabo-presto"',
    "bath read --port tcp://127.0.0.1:1 --profile none.toml": "can't be read",
    "bath acknowledge no-such-rig": 'no rig "no-such-rig"',
    "bath read --profile julabo-presto": "--port",
    f"bath read {EMULATED} --profile julabo-presto": "teatbench emulate",
    "bath read --port there --profile julabo-presto": "'there' is no bath",
    f"bath set {NO_BATH} warm": "'warm' is not a temperature",
    f"bath set {NO_BATH} nan": "'nan' is not a temperature",
    f"bath watch {NO_BATH} --seconds 0": "'0' is not a number of seconds",
    "arm": "required: COMMAND\n  teatbench arm read: ",
    "arm fly": "invalid choice: 'fly'",
    "arm read": "required: --port",
    f"arm read {EMULATED} --packets 0": "'0' is not a whole number from 1 to 1000",
    f"arm read {EMULATED} --baud 1200": "invalid choice: 1200",
    f"arm watch {EMULATED} --seconds -1": "'-1' is not a number of seconds above 0",
    f"arm frame {EMULATED}": "required: --out",
    f"arm frame {EMULATED} --out x --check 1,2": "write 3 numbers as 120,-80,0",
    f"arm frame {EMULATED} --out x --check 1,2,inf": "each within 10000 mm",
    f"arm verify {EMULATED} --out x --distances 4": "'4' is not a whole number from 1 to 3",
    f"arm verify {EMULATED} --out x --length-mm 0": "'0' is not a number above 0",
    "arm read --port ttyUSB0 --homed": 'ttyUSB0: not a link; allowed: "emulator:"',
    f"arm read {EMULATED}": "there is no terminal to confirm it at. Give --homed",
    f"arm watch {EMULATED}": "Give --homed",
    f"arm frame {EMULATED} --out new.toml": "Give --homed",
    f"arm verify {EMULATED} --out new.toml": "Give --homed",
    f"arm home {EMULATED}": "give --on-peg",
    f"arm frame {EMULATED} --homed --out there.toml": "is there already",
    f"arm verify {EMULATED} --homed --out nowhere/new.toml": "a folder that is there",
    f"arm verify {EMULATED} --homed --out new.toml --script bare.toml": "no requirement of the kind arm_verified",
    f"arm read {EMULATED} --homed --frame none.toml": "can't be read",
    f"arm frame {EMULATED} --homed --out new.toml --check 2000,0,0": "the emulated arm can't do this: out of reach",
    "calibrate cameras --board b --out x": "give either folders of pictures (FRAMES) or --rig RIG",
    "calibrate cameras some --rig emulated --board b --out x": "or --rig RIG, not both",
    "calibrate cameras some --board b --out x --max-views -1": "'-1' is not a whole number",
    "calibrate world --cameras c.toml --out x": "give either a table of points (CSV) or --rig",
    "calibrate world p.csv --cameras c --touch-sd nan --out x": "'nan' is not a number of 0",
    "calibrate thermal --rig emulated --out x": "--rig with --board and --cameras",
    "calibrate stage --out x --at 1,2,3": "write 2 numbers as 120,-80",
    "calibrate import f --format ros --image-size 640 --out x": "is no size such as 640x480",
}
NO_ANSWER = {  # code 3
    "camera show opencv:/no/file.avi": "single camera at /no/file.avi: can't be opened",
    f"bath read {NO_BATH}": "nothing took the connection",
    f"bath standby {NO_BATH}": "nothing took the connection",
    "arm read --port /dev/no-such-port --homed": "Is the adapter plugged in",
    "arm read --port socket://127.0.0.1:1 --homed": "nothing takes the connection",
    f"arm frame {EMULATED} --homed --out new.toml": "the terminal gives no more input; nothing was written",
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "code", "message"),
    [
        *((command, 2, message) for command, message in WRONG_USE.items()),
        *((command, 3, message) for command, message in NO_ANSWER.items()),
    ],
)
def test_wrong_use_gets_a_sentence_and_leaves_nothing_behind(
    command: str,
    code: int,
    message: str,
    said: Said,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n\n\n" if "--check 2000" in command else ""))
    (tmp_path / "there.toml").write_text("precious", encoding="utf-8")
    parts = re.split(r"(?=\[\[)", (TRIALS / "six-situations.toml").read_text(encoding="utf-8"))
    bare = "".join(part for part in parts if '"arm_verified"' not in part)
    (tmp_path / "bare.toml").write_text(bare, encoding="utf-8")
    before = threading.active_count()
    written = said(code, command)
    assert message in written.err
    if not command.startswith("arm"):
        assert written.out == "", "no empty bar beside a refusal"
    assert (tmp_path / "there.toml").read_text(encoding="utf-8") == "precious"
    assert {path.name for path in tmp_path.iterdir()} == {"there.toml", "bare.toml"}
    assert threading.active_count() == before


@pytest.mark.skipif(sys.platform != "linux", reason="needs a device that is no serial port")
def test_a_port_that_cannot_be_opened_is_named(said: Said) -> None:
    assert "the port can't be opened" in said(3, "arm read --port /dev/null --homed").err


NAMELESS = {"run": 'no trial script ""', "run --rig": 'no rig ""', "emulate": 'no rig ""'}
NAMELESS |= {"score": "frames: missing", "detect": "frames: missing", "report": ". is no run"}


@pytest.mark.parametrize("command", NAMELESS)
def test_a_name_that_is_too_long_or_empty_is_named(
    command: str, tmp_path: Path, said: Said
) -> None:
    assert "disk full" not in said(2, f"{command} {{}}", tmp_path / ("long" * 80)).err
    assert NAMELESS[command] in said(2, f"{command} {{}}", "").err


def test_what_may_not_be_read(tmp_path: Path, said: Said, monkeypatch: pytest.MonkeyPatch) -> None:
    denied = Mock(side_effect=PermissionError(13, "Permission denied", str(tmp_path)))
    monkeypatch.setattr("bench.cli.main.call", denied)
    monkeypatch.setattr("bench.files.os.access", lambda *_: False)
    assert said(2, "runs").err.endswith(f"{tmp_path} can't be read: Permission denied\n")


def caused(error: Exception, by: Exception) -> Exception:
    error.__context__ = by
    return error


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        ImportError("libcv2.so: failed to map segment from shared object"),
        OSError(12, "Cannot allocate memory"),
        RuntimeError("OpenCV: Insufficient memory"),
        RuntimeError("can't start new thread"),
        caused(RuntimeError("cannot join thread before it is started"), MemoryError()),
    ],
)
def test_a_limit_of_memory_ends_with_a_sentence(
    error: Exception, said: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: object) -> None:
        raise error

    monkeypatch.setattr("bench.cli.main.call", fail)
    assert "out of memory: give the machine" in said(3, "runs").err


@pytest.mark.skipif(sys.platform == "win32", reason="Windows limits no process's addresses")
def test_under_a_limit_in_which_no_library_loads_nothing_is_begun(
    said: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bench.cli.main.call", lambda _: pytest.fail("it was begun"))
    monkeypatch.setattr("resource.getrlimit", lambda _: (350_000 << 10, 350_000 << 10))
    refused = "341 MB of memory are allowed, 512 are needed: give the machine, or the limit"
    assert refused in said(3, "runs").err
