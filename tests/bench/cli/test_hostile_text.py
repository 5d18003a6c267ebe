"""Text that would steer a terminal, break XML or be a formula is shown, doing nothing."""

from __future__ import annotations

import csv
import io
import json
import re
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.text import Text

from bench.cli.terminal import Terminal
from bench.script.model import TRIALS
from instruments.listener import Connection
from reports.sanitize import csv_text, sanitized
from tests.bench.calibrate.arm_terminal import at_terminal
from tests.bench.campaign.small_campaign import write_small_rig
from tests.bench.commands import Said, served, teatbench
from tests.bench.small_recording import write_recording

HOSTILE = "\x1b[2J\x1b]0;owned\x07\x9b31m\x00\u202edlrow\u2066 [/red][link=http://evil]here"
UNSAFE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")
REPLACED = "\N{REPLACEMENT CHARACTER}"
# TOML has JSON's escapes, and this one holds neither surrogates nor DEL
TOML = json.dumps("=1+1" + HOSTILE.replace("\x00", ""))

PROGRAM = f"""
import json, sys
hostile = {HOSTILE!r}
sys.stderr.buffer.write(hostile.encode() + b"\\n")
sys.stderr.flush()
print(json.dumps({{"ready": True}}), flush=True)
for number, line in enumerate(sys.stdin):
    asked = json.loads(line)
    if number == 4:
        sys.exit(3)
    print(json.dumps({{"frame": asked["frame"], "teats": [], "reason": "@" + hostile}}), flush=True)
"""


def check_terminal(text: str) -> None:
    """Only what rich and our own progress write is left, and the hostile text is there as text."""
    assert f"{REPLACED}[2J{REPLACED}]0;owned" in text.replace("\r\n", "").replace(" ", "")
    # colours, and the cursor's moves of a progress bar
    own = re.sub("\x1b\\[[0-9;?]*[A-Zmhl]", "", text.replace("\x1b[2J", "HOSTILE"))
    assert "HOSTILE" not in own
    assert UNSAFE.findall(own.replace("\r", "")) == []


def check_files(run: Path) -> None:
    page = "".join(path.read_text(encoding="utf-8") for path in (run / "report").rglob("*.html"))
    assert UNSAFE.findall(page) == []
    assert f"{REPLACED}]0;owned" in page
    xml = (run / "report" / "junit.xml").read_text(encoding="utf-8")
    ET.fromstring(xml)
    assert UNSAFE.findall(xml) == []
    check_cells(run / "report" / "trials.csv")


def check_cells(table: Path) -> None:
    """No cell steers anything or begins a formula; a number may begin with its sign."""
    rows = csv.reader(io.StringIO(table.read_bytes().decode(), newline=""))
    cells = [cell for row in rows for cell in row]
    assert UNSAFE.findall("".join(cells)) == []
    formulas = (cell for cell in cells if cell.startswith(("=", "+", "@", "-")))
    assert [one for one in formulas if not re.fullmatch(r"[-+][\d.e+-]+", one)] == []


@pytest.mark.slow
def test_names_of_a_recording_and_words_of_a_detector(tmp_path: Path, said: Said) -> None:
    hostile = HOSTILE.replace("\x00", "")
    of_a_file = "" if sys.platform == "win32" else hostile.replace("/", "")
    recording = write_recording(tmp_path / f"five{of_a_file}")
    truth = recording / "truth.csv"
    named = truth.read_text(encoding="utf-8").replace(",calm,", f",=calm{hostile},")
    truth.write_text(named.replace(",windy,", ",-windy,"), encoding="utf-8")
    (tmp_path / "mine.py").write_text(PROGRAM, encoding="utf-8")
    declared = f"version = {TOML}\ncommand = [{json.dumps(sys.executable)}, 'mine.py']\n"
    (tmp_path / "mine.toml").write_text(declared, encoding="utf-8")
    arguments = [str(recording), "--detector", str(tmp_path / "mine.toml")]
    detected = said(0, "detect {}", arguments)
    scored = said(1, "score {} --out {}", arguments, tmp_path / "runs")
    seen = "".join((*detected, *scored))
    assert UNSAFE.findall(seen) == []
    assert f"@{REPLACED}[2J{REPLACED}]0;owned" in seen
    (run,) = (tmp_path / "runs").iterdir()
    check_files(run)
    assert teatbench("store export {} --format csv --out {}", run, tmp_path / "tables") == 0
    for table in (tmp_path / "tables").glob("*.csv"):
        check_cells(table)


@pytest.mark.slow
def test_a_script_and_a_rig_on_a_real_terminal(tmp_path: Path) -> None:
    script = (TRIALS / "six-situations.toml").read_text(encoding="utf-8")
    head, _, trials = script.partition("[[trials]]")
    for old, new in {
        'title = "Six situations"': f"title = {TOML}",
        'name = "reliability"': f"name = {TOML}",
        "repeats = 3": "repeats = 1",
        "about =": f"about = {TOML} #",
    }.items():
        head = head.replace(old, new)
    first = re.sub("set_up = .*", lambda _: f"set_up = {TOML}", trials.partition("[[trials]]")[0])
    (tmp_path / "script.toml").write_text(f"{head}[[trials]]{first}", encoding="utf-8")
    rig = write_small_rig(tmp_path)
    text = rig.read_text(encoding="utf-8").replace('"emulated rig"', TOML)
    rig.write_text(text.replace('"emulator:"', '"script:answers.txt"', 1), encoding="utf-8")
    kinds = ("homing", "check point", "set up", "touch")
    answers = "".join(f"otherwise {kind}: go\n" for kind in kinds)
    (tmp_path / "answers.txt").write_text(answers, encoding="utf-8")
    run = "run script.toml --rig rig.toml --out runs"
    for command, codes in ((run, (1, 4)), ("trials show script.toml", (0,))):
        with at_terminal(command.split(), 100, tmp_path) as terminal:
            assert terminal.code() in codes, terminal.text
        check_terminal(terminal.text)
    (folder,) = (tmp_path / "runs").iterdir()
    check_files(folder)


class Board:
    """Welcomes as Grbl does, and has a version that would clear the screen."""

    def connect(self, connection: Connection) -> None:
        connection.send(b"\r\nGrbl 1.1h ['$' for help]\r\n")

    def receive(self, connection: Connection, data: bytes) -> None:
        hostile = HOSTILE[:13]
        connection.send(f"$13={hostile}\r\n[VER:1.1h.20190825:{hostile}]\r\nok\r\n".encode())

    def disconnect(self, connection: Connection) -> None: ...


@pytest.mark.slow
def test_words_on_the_wire(said: Said) -> None:
    with served(lambda _: Board()) as (_, url):
        seen = "".join(said(3, "stage status --port {}", url))
    assert UNSAFE.findall(seen) == []
    assert "[2J" in seen


def test_the_console_shows_no_markup_and_no_controls_of_others(
    capsys: pytest.CaptureFixture[str],
) -> None:
    Terminal().print("x[/red]\x1b[2J", Text("\u202ey"))
    assert capsys.readouterr().out == f"x[/red]{REPLACED}[2J {REPLACED}y\n"


@pytest.mark.slow
@given(st.text(st.characters(exclude_categories=[])))
def test_any_text_is_xml_and_no_formula(text: str) -> None:
    kept = sanitized(text)
    assert UNSAFE.findall(kept.replace("\r\n", "\n")) == []
    ET.fromstring(f"<a>{kept.translate({ord(c): ' ' for c in '<>&'})}</a>")
    assert sanitized(kept) == kept
    ((cell, number),) = (
        csv.reader([csv_text([[text, -1.5]])], strict=True)
        if "\n" not in kept and "\r" not in kept
        else (("", "-1.5"),)
    )
    assert number == "-1.5"
    assert not cell.startswith(("=", "@"))


def test_text_in_other_scripts_stays() -> None:
    for text in (
        "Zitze 4 µm – ±0,1 °C",
        "乳头 🐄 👩\u200d🌾",
        "نوک پستان\u200cها",
        "a\tb\nc\r\nd",
        "no\u00a0break",
    ):
        assert sanitized(text) == text


@pytest.mark.parametrize(
    ("value", "cell"),
    [
        ("=1", "'=1"),
        ("-cmd", "'-cmd"),
        (" @x", "' @x"),
        ("＝1", "'＝1"),
        ("-5", "-5"),
        ("+1e3", "+1e3"),
        (-5.0, "-5.0"),
        (None, ""),
    ],
)
def test_formulas_are_text_and_numbers_are_numbers(value: object, cell: str) -> None:
    assert list(csv.reader([csv_text([[value, "x"]]).rstrip("\n")])) == [[cell, "x"]]
