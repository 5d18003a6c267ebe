"""`--capture FILE`, and `replay-wire`, which plays it to the same drivers again."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

import bench
from bench.cli.main import parser
from instruments.captures.capture import read_capture
from instruments.clock import RealClock
from instruments.link import Link
from tests.bench.commands import NO_CAMERA, Said, lab_rig, teatbench
from tests.bench.forked import Running, begin
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.slow

HEAD = (
    '{"format": "teatbench capture", "version": 1, "wall_time": "w", "teatbench": "0", "command":'
    ' "c", "machine": "m"}\n'
)
TALK = """{"t_s": 0, "link": "arm", "event": "opened", "url": "COM5"}
{"t_s": 0, "link": "arm", "event": "sent", "data": "03"}
{"t_s": 0.1, "link": "arm", "event": "received", "data": "8300"}
{"t_s": 0.2, "link": "arm", "event": "closed"}
"""
posix = pytest.mark.skipif(sys.platform == "win32", reason="sends a POSIX signal to a child")


@pytest.fixture(scope="module")
def check_capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The capture of a check of the emulated rig."""
    path = tmp_path_factory.mktemp("capture") / "check.jsonl"
    assert teatbench("check --capture {}", path) == 0
    return path


@contextmanager
def playing(*arguments: str) -> Iterator[tuple[Running, dict[str, str]]]:
    """`replay-wire` as another process, and what it listens at."""
    links = arguments.count("--link") or len(read_capture(Path(arguments[0])).links)
    with begin(["replay-wire", *arguments]) as child:
        try:
            assert child.stdout is not None
            lines = (line for line in child.stdout if "://" in line)
            yield child, dict(next(lines).split() for _ in range(links))
        finally:
            child.kill()  # where the test has failed before its end


def test_a_whole_check_is_replayed_to_a_check(
    check_capture: Path, tmp_path: Path, said: Said
) -> None:
    """A far end that a busy machine holds up is asked once more, which no capture has: then again."""
    for _ in range(5):
        with bench.replay_wire(check_capture, fast=True, again=False) as replay:
            urls = replay.urls
            far_ends = {
                '"/dev/ttyUSB0"            #': f'"{urls["arm"]}" #',
                '"tcp://192.168.0.40:502"': f'"{urls["bath"]}"',
                '"/dev/ttyACM0"            #': f'"{urls["stage"]}" #',
            }
            seen = said(3, "check {}", lab_rig(tmp_path, far_ends | NO_CAMERA)).out
        if not (wrong := replay.mismatches or replay.unplayed):
            break
    arm, bath = ("arm: ok", "serial_number: 40937"), ("bath: ok", "temperature: 20.0")
    for text in (*arm, *bath, "stage: ok", "1.1h", "cameras: FAULT"):
        assert text in seen, text
    assert not wrong


def test_a_mismatch_gives_1_and_its_place(tmp_path: Path) -> None:
    path = tmp_path / "bug.jsonl"
    path.write_text(HEAD + TALK, encoding="utf-8")
    with playing(str(path), "--once") as (child, urls):
        with closing(Link(urls["arm"], RealClock(), who="arm")) as link:
            link.write(b"\xc2")
            assert link.receive(0.3) == b""
        output, _ = child.communicate(timeout=PATIENCE_S)
    assert child.returncode == 1
    why = "byte 0 of it is another than recorded (expected 03, got C2)"
    assert f"{path}:3: arm: connection 1, request 1: {why}" in output
    assert "arm: connection 1: 0 of 1 requests as recorded, then a mismatch" in output


@posix
def test_it_plays_again_and_again_until_ctrl_c(tmp_path: Path) -> None:
    path = tmp_path / "bug.jsonl"
    second = TALK.replace("arm", "stage").replace('"t_s": 0', '"t_s": 1')
    path.write_text(HEAD + TALK + second + '{"t_s": 2, "li', encoding="utf-8")
    with playing(str(path), "--link", "arm") as (child, urls):
        assert list(urls) == ["arm"]
        for _ in range(3):
            with closing(Link(urls["arm"], RealClock(), who="arm")) as link:
                link.write(b"\x03")
                assert link.read(2, 5.0) == b"\x83\x00"
            time.sleep(0.2)  # for the other process to see that we have gone
        child.send_signal(signal.SIGINT)
        output, _ = child.communicate(timeout=PATIENCE_S)
    assert child.returncode == 0
    assert "Traceback" not in output


@pytest.mark.parametrize(
    ("text", "more", "message"),
    [
        ("", [], "1: Invalid JSON"),
        ("hello\n", [], "1: Invalid JSON"),
        (HEAD, [], "no link was opened in it"),
        (HEAD + TALK + "x\n", [], "6: Invalid JSON"),
        (HEAD + TALK, ["--link", "arn"], 'no link "arn"; did you mean "arm"? It has: arm.'),
        (HEAD + TALK, ["--listen", "203.0.113.7"], "can't listen on 203.0.113.7"),
        (HEAD + TALK, ["--listen", "no such host"], "can't listen on no such host"),
        (None, [], "can't be read"),
    ],
)
def test_a_wrong_file_gives_2_and_a_sentence(
    text: str | None, more: list[str], message: str, tmp_path: Path, said: Said
) -> None:
    path = tmp_path / "bug.jsonl"
    if text is not None:
        path.write_text(text, encoding="utf-8")
    threads = threading.active_count()
    assert message in said(2, "replay-wire {} {}", path, more).err
    assert threading.active_count() == threads


# each alone, or a group and which of it
WITHOUT_A_LINK = {
    f"{group} {name}".strip()
    for group, names in {
        "": "console replay-wire control tell report score compare init plan detect rigs emulate runs"
        " help",
        "calibrate": "merge board export import",
        "camera": "list show focus grab",
        "campaign": "run chunk query compare show keep",
        "detectors": "new try",
        "plugin": "check",
        "recording": "pack",
        "scene": "sheet record boards",
        "store": "check export",
        "trials": "show",
    }.items()
    for name in names.split()
}


def commands_of(
    one: argparse.ArgumentParser, name: str = ""
) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Every command with its parser, those of a group by both names."""
    groups = [action for action in one._actions if isinstance(action, argparse._SubParsersAction)]
    if not groups:
        yield name, one
    for group in groups:
        for word, sub in group.choices.items():
            yield from commands_of(sub, f"{name} {word}".strip())


def test_every_command_that_opens_a_link_can_be_captured_and_no_other() -> None:
    commands = dict(commands_of(parser()))
    assert {"run", "check", "arm read"} | WITHOUT_A_LINK <= commands.keys()
    for name, one in commands.items():
        assert ("--capture FILE" in one.format_help()) != (name in WITHOUT_A_LINK), name


@pytest.mark.parametrize("name", ["bug.jsonl", "no/such/folder/bug.jsonl"])
def test_where_a_capture_cannot_be_written_nothing_is_begun(
    name: str, tmp_path: Path, said: Said
) -> None:
    (tmp_path / "bug.jsonl").write_text("precious", encoding="utf-8")
    why = said(2, "run --capture {} --out {}", tmp_path / name, tmp_path / "runs").err
    assert ("never written over" if name == "bug.jsonl" else "can't be written") in why
    assert [path.name for path in tmp_path.iterdir()] == ["bug.jsonl"]
    assert (tmp_path / "bug.jsonl").read_text(encoding="utf-8") == "precious"


def test_wrong_use_leaves_no_capture_behind(tmp_path: Path, said: Said) -> None:
    why = said(2, "check emulatd --capture {}", tmp_path / "bug.jsonl").err
    assert "was not written: no link was opened" in why
    assert list(tmp_path.iterdir()) == []
