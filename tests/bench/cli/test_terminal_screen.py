"""What a person sees at a terminal: the screen as a terminal emulator shows it, not the bytes that
were written. What takes longer than two seconds shows a bar: on standard error, only where both
streams are terminals, and never in what the command writes.
"""

from __future__ import annotations

import io
import itertools
import re
import sys
import threading
from pathlib import Path

import pytest
from rich.console import Console
from rich.table import Table

from bench.cli.terminal import Terminal, TerminalProgress, print_table, print_wrapped
from bench.results.headline import AFTER_END, AFTER_FAULT, GO_ON
from tests.bench.calibrate.arm_terminal import Rendered, at_terminal
from tests.bench.campaign.small_campaign import write_small_rig
from tests.bench.commands import Said
from tests.bench.operated_runs import SCRIPT, files, run_of

NEEDED = "needs a pseudo-terminal, which Windows has not"
pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason=NEEDED)]

ONE = SCRIPT.replace("poses = [", "poses = [{ x_mm = 12.0 }]\n#")
IN_TRIAL = "s REASON = skip the trial, r = repeat it, "
FOLDER = "/home/technician/teatbench/runs/20261120-101500-six-situations"
LAST_WORDS = "? = explain, a = abort the run): "


def test_each_question_and_why_a_touch_was_refused_stay_on_the_screen(tmp_path: Path) -> None:
    """The sentences wrap, and their last row may be as good as full."""
    teats = [f"teat {teat} of 4," for teat in (1, 2, 3, 4)]
    asked = ["on its peg", "Situation ideal", *teats[:2], "Once", *teats[2:]]
    mistake = 'mistakes = ["wrong teat"]'
    with at_terminal(
        files(tmp_path, operator="console:", script=ONE, emulation=mistake), 37
    ) as terminal:
        for words in asked:
            terminal.expect(words)
            terminal.expect("run): ")
            terminal.type("")
        terminal.code()
    seen = " ".join(terminal.screen.text.split())
    (refused,) = (
        touch["refused"] for touch in run_of(tmp_path).trials[0].touches if touch["refused"]
    )
    assert f"{refused} Touch teat 2, right rear (RR)." in seen
    assert seen.count(f"Enter to go on ({LAST_WORDS}") == 1
    assert seen.count(f"Enter to go on ({IN_TRIAL}{LAST_WORDS}") == 5
    hidden = "first the numbers of hidden teat ends (1 to 4)"
    assert seen.count(f"{hidden} ({IN_TRIAL}{LAST_WORDS}") == 1
    assert all(f"teat {teat} of 4, {5 - teat} of 4 touches left; " in seen for teat in (1, 2, 3, 4))
    bars = [row for row in terminal.screen.rows if row.startswith("trials ")]
    assert len(bars) == 1, "the bar is there once, at the end"


def test_beside_a_refusal_there_is_no_bar(tmp_path: Path) -> None:
    with at_terminal(["score", "nosuch"], 40, tmp_path) as terminal:
        assert terminal.code() == 2
    rows = [row.rstrip() for row in terminal.screen.rows if row.strip()]
    assert rows
    assert rows[0].startswith("teatbench: ")
    assert {"recording", "folder", "images"} <= set(" ".join(rows).split()), "no word is broken"
    assert not any("━" in row or row.startswith("trials") for row in rows)


def test_a_terminal_has_a_bar_that_counts_and_a_pipe_has_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: Said
) -> None:
    rig = write_small_rig(tmp_path)
    record = f"scene record --rig {rig} --situation overlapping --seeds 1 --out {{}}"
    piped, nothing = said(0, record, tmp_path / "a")
    assert (piped.splitlines()[0], nothing) == ("overlapping-0000", "")
    monkeypatch.setenv("FORCE_COLOR", "1")  # rich takes it for a terminal
    written, shown = said(0, record, tmp_path / "b")
    assert written.splitlines()[0] == "overlapping-0000"
    assert "rendering the scenes" in shown
    assert "1/1" in shown
    screen = Rendered(80)
    screen.feed(shown.replace("\n", "\r\n").encode())
    assert not any("rendering" in row for row in screen.rows), "it is gone after it"
    assert "reading the runs" in said(0, "runs {}", tmp_path).err


class AtTerminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_lines_that_are_said_while_the_bar_grows_leave_no_second_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The bar is drawn anew on another thread, in as many rows as what is done takes."""
    monkeypatch.setenv("COLUMNS", "37")
    monkeypatch.setenv("TERM", "xterm")
    written, ended, often_s = AtTerminal(), threading.Event(), sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    with TerminalProgress(Terminal(written)) as progress:

        def grows() -> None:
            for rows in itertools.cycle((1, 3, 2)):  # one, three and four rows
                if ended.is_set():
                    return
                progress.state("waiting for the bath to settle, still " * rows)
                assert progress._live is not None
                progress._live.refresh()

        growing = threading.Thread(target=grows)
        growing.start()
        try:
            for number in range(40):
                progress.say(f"line {number}")
        finally:
            ended.set()
            growing.join()
            sys.setswitchinterval(often_s)
    screen = Rendered(37)
    screen.feed(written.getvalue().replace("\n", "\r\n").encode())
    assert [row.strip() for row in screen.rows if row.startswith("line ")] == [
        f"line {number}" for number in range(40)
    ]
    assert not [row for row in screen.rows if row.startswith("trials ")]


def test_an_enter_beside_the_bar_leaves_no_second_one(tmp_path: Path) -> None:
    """It would move the cursor, and the next bar would be drawn a row below."""
    with at_terminal(files(tmp_path), 100) as terminal:
        assert terminal.press_enter_to_the_end(unasked=True) == 0
    assert len([row for row in terminal.screen.rows if row.startswith("trials ")]) == 1


@pytest.mark.parametrize(
    "text",
    [
        AFTER_FAULT.format(rig="my-rig.toml", go_on=GO_ON.format(run=FOLDER)),
        AFTER_END.format(run=FOLDER),
        f"Paused, as asked. Type 'go on' here, or: teatbench resume {FOLDER}",
    ],
)
def test_a_command_to_paste_stays_on_one_line(text: str) -> None:
    written = io.StringIO()
    print_wrapped(Console(file=written, width=80, force_terminal=True, color_system=None), text)
    *wrapped, command = written.getvalue().splitlines()
    assert command == f"  teatbench resume {FOLDER}"
    assert wrapped[-1].endswith(":")
    assert all(len(line) <= 80 for line in wrapped)
    amid = "Position lost: 'teatbench stage recover', then 'teatbench stage home'; heater is off"
    plain = io.StringIO()
    print_wrapped(Console(file=plain, width=80, force_terminal=True, color_system=None), amid)
    assert " ".join(plain.getvalue().split()) == amid


@pytest.mark.parametrize("columns", [40, 80, 120])
def test_no_word_of_a_table_is_broken(columns: int) -> None:
    names = ("20261120-101500-six-situations", "inconclusive", "not measured", "largest error")
    table = Table(*names[:3], names[3], title="runs")
    table.add_row(*names)
    written = io.StringIO()
    print_table(Console(file=written, width=columns, force_terminal=True, color_system=None), table)
    said = written.getvalue()
    assert {word for name in names for word in name.split()} <= {*re.split(r"[\s:;]+", said)}
    assert all(len(line) <= columns for line in said.splitlines())


def test_no_word_is_broken_at_a_narrow_terminal(tmp_path: Path, said: Said) -> None:
    """What a rig lacks, and an arm that is verified."""
    init = "init --yes --port socket://127.0.0.1:1 --out {}"
    said(0, init, unfilled := tmp_path / "rig.toml")
    written = said(2, "check {}", unfilled).out
    with at_terminal(["check", str(unfilled)], 44, tmp_path) as terminal:
        assert terminal.code() == 2
    shown = [word for row in terminal.screen.rows for word in row.split()]
    long = [word for word in written.split() if len(word) < 44]
    assert [word for word in long if word not in shown] == []
    verify = [
        "arm",
        "verify",
        "--port",
        "emulator:",
        "--homed",
        "--distances",
        "1",
        "--touches",
        "5",
        "--out",
    ]
    with at_terminal([*verify, str(tmp_path / "arm.toml")], 44, tmp_path) as terminal:
        terminal.press_enter_to_the_end()
    seen = " ".join(word for row in terminal.screen.rows for word in row.split())
    assert "degrees of freedom); --accuracy-mm 0.23 is" in seen
    assert "no length is measured, and the arm can't be verified whole." in seen
