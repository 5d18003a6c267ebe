"""`teatbench run` at a pseudo-terminal, as a new user drives it: a rehearsal, in which emulated
hands follow each "go on".
"""

from __future__ import annotations

import re
import sys
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest

from tests.bench.calibrate.arm_terminal import Terminal, at_terminal
from tests.bench.operated_runs import CHECK_POINT, SCRIPT, files, run_of

NEEDED = "needs a pseudo-terminal, which Windows has not"
pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason=NEEDED)]

ENTER = ""
ABORT_KEY = "a = abort the run): "
TWO = SCRIPT.replace("poses = [", "poses = [{ x_mm = 12.0 }, { x_mm = -8.0 }]\n#")


def started(folder: Path, **more: Any) -> AbstractContextManager[Terminal]:
    return at_terminal(files(folder, operator="console:", script=TWO, **more))


def answer(terminal: Terminal, words: str, line: str = ENTER) -> str:
    """Read up to the end of the prompt that says ``words``, then type; gives back the prompt."""
    said = terminal.expect(words) + terminal.expect(ABORT_KEY)
    terminal.type(line)
    return said


def test_a_new_user_gets_through_a_run(tmp_path: Path) -> None:
    with started(tmp_path, touches=2, check_point=CHECK_POINT) as terminal:
        answer(terminal, "Put the arm's stylus on its peg", "what?")
        answer(terminal, "Not understood: 'what?'.", "?")
        answer(terminal, "from where they are when it is switched on")
        for touch in (1, 2):
            answer(terminal, f"[touch {touch} of 2] Arm check")
        said = answer(terminal, "Move the plate to x +12 mm", "2, 4")
        trial = "[trial 1 of 2; about 4 min left] Situation ideal, layout table-5-1:\nTeats as in"
        assert f"{trial} table 5.1." in said
        assert "teat 4, left front (LF): x -260.6, y 267.1, length 136.3 mm" in said
        (picture,) = re.findall(r"Picture: (\S+\.png)", said.replace("\r", ""))
        assert Path(picture).read_bytes().startswith(b"\x89PNG")
        assert "s REASON = skip the trial" in said
        for teat in (1, 2, 3, 4):
            left = 8 - 2 * (teat - 1)
            at = f"trial 1 of 2, teat {teat} of 4, {left} of 8 touches left; about 4 min left"
            answer(terminal, f"[{at}] Touch the end of teat {teat}, ")
            terminal.expect(f"[press 2 of 2, {left - 1} of 8 left] Lift the tip")
            terminal.expect("as before): ")
            terminal.type(ENTER)
        answer(terminal, "[trial 2 of 2; ", "s")
        terminal.expect("Why?")
        terminal.type("the hose came off")
        answer(terminal, "[touch 1 of 1] Arm check")
        terminal.code()
    record = run_of(tmp_path)
    assert record.ending == "finished", terminal.text
    assert [row["visible"] for row in record.trials[0].truth] == [1, 0, 1, 0]
    assert [row["reason"] for row in record.skipped] == ["the hose came off"]


def test_a_trip_ends_a_prompt_without_enter_and_reminders_come_before(tmp_path: Path) -> None:
    fault = '[[emulation.faults]]\ninstrument = "bath"\nname = "low level"\nat_s = 20.0'
    with started(tmp_path, operator_more="remind_s = 0.5", emulation=fault) as terminal:
        terminal.expect(ABORT_KEY)
        for _ in range(2):
            terminal.expect("Still waiting for you, ")
            terminal.expect(ABORT_KEY)
        terminal.expect("No answer is needed any more: interlock controller alarm")
        assert terminal.code() == 3
    record = run_of(tmp_path)
    assert record.ending == "faulted"
    assert record.facts["trip"]["rule"] == "controller alarm"
