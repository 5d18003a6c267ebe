"""`teatbench arm …` with everything that can be wrong: ports, files, arguments."""

from __future__ import annotations

import re
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from bench.cli.main import main
from bench.rig.arm_files import load_frame
from bench.script.model import TRIALS
from instruments.clock import RealClock
from instruments.listener import Connection, Listener
from tests.bench.calibrate.arm_terminal import ENTER, answer, at_terminal


class Silent:
    """Takes everything, and says nothing."""

    def connect(self, connection: Connection) -> None: ...
    def receive(self, connection: Connection, data: bytes) -> None: ...
    def disconnect(self, connection: Connection) -> None: ...


class Chatter(Silent):
    """Something else: answers whatever it gets with a line of its own."""

    def receive(self, connection: Connection, data: bytes) -> None:
        connection.send(b"error: expected command letter\r\n")


@pytest.mark.parametrize(
    ("device", "words"), [(Silent, ("arm", "switched on")), (Chatter, ("arm", "not"))]
)
def test_who_does_not_answer_as_an_arm_is_told(
    device: Callable[[], Silent], words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    clock = RealClock()
    listener = Listener(device(), clock, lock=threading.RLock(), name="other")
    try:
        assert main(["arm", "read", "--port", listener.url, "--homed"]) == 3
    finally:
        listener.close()
        clock.close()
    said = capsys.readouterr().err
    assert said.startswith("teatbench: ")
    assert all(word in said for word in words), said
    assert "Traceback" not in said


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (
            ["read", "--port", "ttyUSB0", "--homed"],
            2,
            '--port ttyUSB0: not a link; allowed: "emulator:"',
        ),
        (["read", "--port", "/dev/no-such-port", "--homed"], 3, "Is the adapter plugged in"),
        (["read", "--port", "socket://127.0.0.1:1", "--homed"], 3, "nothing takes the connection"),
        (["read", "--port", "emulator:"], 2, "nobody is at a terminal to confirm it. Give --homed"),
        (["watch", "--port", "emulator:"], 2, "Give --homed"),
        (["frame", "--port", "emulator:", "--out", "new.toml"], 2, "Give --homed"),
        (["verify", "--port", "emulator:", "--out", "new.toml"], 2, "Give --homed"),
        (["home", "--port", "emulator:"], 2, "give --on-peg"),
        (["frame", "--port", "emulator:", "--homed", "--out", "there.toml"], 2, "is there already"),
        (
            ["verify", "--port", "emulator:", "--homed", "--out", "nowhere/new.toml"],
            2,
            "a folder that is there",
        ),
        (
            [
                "verify",
                "--port",
                "emulator:",
                "--homed",
                "--out",
                "new.toml",
                "--script",
                "bare.toml",
            ],
            2,
            "no requirement of the kind arm_verified",
        ),
        (["read", "--port", "emulator:", "--homed", "--frame", "none.toml"], 2, "can't be read"),
        (
            ["frame", "--port", "emulator:", "--homed", "--out", "new.toml"],
            3,
            "nobody is at the terminal any more; nothing was written",
        ),
        (
            ["frame", "--port", "emulator:", "--homed", "--out", "new.toml", "--check", "2000,0,0"],
            2,
            "the emulated arm can't do this: out of reach",
        ),
    ],
)
def test_bad_input_gives_a_sentence(
    arguments: list[str],
    code: int,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    import io

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n\n\n" if "--check" in arguments else ""))
    (tmp_path / "there.toml").write_text("precious", encoding="utf-8")
    script = (TRIALS / "six-situations.toml").read_text(encoding="utf-8")
    parts = re.split(r"(?=\[\[)", script)
    (tmp_path / "bare.toml").write_text(
        "".join(p for p in parts if '"arm_verified"' not in p), encoding="utf-8"
    )
    assert main(["arm", *arguments]) == code
    said = capsys.readouterr().err
    assert message in said, said
    assert "Traceback" not in said
    assert (tmp_path / "there.toml").read_text(encoding="utf-8") == "precious"
    assert not (tmp_path / "new.toml").exists()


@pytest.mark.parametrize(
    "arguments",
    [
        ["arm"],
        ["arm", "fly"],
        ["arm", "read"],
        ["arm", "read", "--port", "emulator:", "--packets", "0"],
        ["arm", "read", "--port", "emulator:", "--baud", "1200"],
        ["arm", "watch", "--port", "emulator:", "--seconds", "-1"],
        ["arm", "frame", "--port", "emulator:"],
        ["arm", "frame", "--port", "emulator:", "--out", "x", "--check", "1,2"],
        ["arm", "frame", "--port", "emulator:", "--out", "x", "--check", "1,2,inf"],
        ["arm", "verify", "--port", "emulator:", "--out", "x", "--distances", "4"],
        ["arm", "verify", "--port", "emulator:", "--out", "x", "--length-mm", "0"],
    ],
)
def test_wrong_arguments_give_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    assert "usage" in capsys.readouterr().err


def test_a_port_that_another_program_has_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    """A port without permission, as a user without the group sees it."""
    if sys.platform != "linux":
        pytest.skip("needs a device that nobody may open as a serial port")
    assert main(["arm", "read", "--port", "/dev/null", "--homed"]) == 3
    said = capsys.readouterr().err
    assert "the port can't be opened" in said
    assert "Traceback" not in said


def test_writing_over_has_to_be_asked_for(tmp_path: Path) -> None:
    out = tmp_path / "frame.toml"
    out.write_text("old", encoding="utf-8")
    with at_terminal(
        [
            "arm",
            "frame",
            "--port",
            "emulator:",
            "--out",
            str(out),
            "--homed",
            "--plane-checks",
            "0",
            "--replace",
        ]
    ) as terminal:
        for _ in range(3):
            answer(terminal, ENTER)
        assert terminal.code() == 0, terminal.text
    assert load_frame(out).residual_mm is None
    assert "No check point was touched" in terminal.text
