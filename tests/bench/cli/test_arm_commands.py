"""`teatbench arm …`: by a person, for another program, and with all that can be wrong."""

from __future__ import annotations

import json
import math
import re
import signal
import tomllib
from collections.abc import Callable
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from bench.calibrate.simulated_arm import PLACED, SimulatedArm, TouchStep
from bench.rig.arm_files import load_frame, load_verification
from bench.rig.model import ArmTable
from bench.script.model import ArmRequirement, find_script, load_script
from instruments.clock import RealClock
from tests.bench.calibrate.arm_terminal import answer, at_terminal
from tests.bench.commands import Person, Said, full, teatbench, words
from tests.conftest import ROOT

HOMING = "Was the stylus on its peg"
OWN = "--port emulator: --out {}"
Patch = pytest.MonkeyPatch


@pytest.mark.slow
def test_a_new_user_sets_a_table_frame(tmp_path: Path) -> None:
    """At a terminal of its own."""
    out = tmp_path / "arm-frame.toml"
    with at_terminal(words(f"arm frame {OWN} --check 100,100,0", out)) as terminal:
        for prompt in (
            HOMING,
            "Touch the table's origin",
            "Touch a point on the x axis",
            "Touch a point of the table's plane on the side of positive y",
            "Check point 1 of 2: touch the point 100.0, 100.0, 0.0 mm (world)",
            "Check point 2 of 2: touch another point of the table's plane",
        ):
            answer(terminal, prompt)
        assert terminal.code() == 0, terminal.text
    assert 'frame = "arm-frame.toml"' in terminal.text
    frame = load_frame(out, serial_number="40937")
    assert np.allclose(frame.world_from_arm.T, PLACED.T, atol=1.0)
    assert np.allclose(frame.world_from_arm.R, PLACED.R, atol=0.01)
    assert list(frame.residuals_mm) == ["check 1", "check 2"]


@pytest.mark.slow
def test_a_new_user_verifies_the_arm(tmp_path: Path, monkeypatch: Patch) -> None:
    out = tmp_path / "arm-verification.toml"
    plan = "--distances 1 --touches 5 --length-mm 250 --directions 2 --length-u-mm 0.01"
    leaning = (f"leaning {way}" for way in ("left", "right", "towards you", "away from you"))
    prompts = [HOMING, "Fix the divot at half the arm's reach"]
    prompts += [
        f"touch {number} of 5: tip in the divot, the stylus {lean}"
        for number, lean in enumerate(("upright", *leaning), 1)
    ]
    for where in ("pointing away from the arm", "across in front of the arm"):
        prompts.append(f"Fix the calibrated length flat, {where}")
        prompts += ["touch its first end", "touch its second end"]
    person = Person(monkeypatch, *prompts)
    assert teatbench(f"arm verify {OWN} {plan}", out) == 0
    assert "limit 0.86 mm" in person.text
    assert "Largest error of the calibrated length" in person.text
    found = load_verification(out)
    assert [test.calibrated_mm for test in found.lengths] == [250.0, 250.0]
    assert {test.calibrated_u_mm for test in found.lengths} == {0.01}
    assert "lengths of the dated verification show an arm of u = 0." in person.text
    assert "--accuracy-mm 0.23 is not refuted" in person.text
    assert f"Articulated location error {found.location_mm:.2f} mm" in person.text


@pytest.mark.parametrize(
    ("command", "answers"),
    [("frame", [HOMING, "origin", "x axis", ("plane", "a")]), ("verify", [(HOMING, "a")])],
)
def test_an_abort_writes_nothing(
    tmp_path: Path,
    monkeypatch: Patch,
    capsys: pytest.CaptureFixture[str],
    command: str,
    answers: list[str],
) -> None:
    out = tmp_path / "arm.toml"
    Person(monkeypatch, *answers)
    assert teatbench(f"arm {command} {OWN}", out) == 3
    assert capsys.readouterr().err == "teatbench: the operator aborted; nothing was written\n"
    assert not out.exists()


@pytest.mark.parametrize(
    ("command", "prompts", "load"),
    [
        ("frame", ["origin", "x axis", "plane", "Check point"], load_frame),
        ("verify --distances 1 --touches 5", ["divot", *["tip in"] * 5], load_verification),
    ],
)
def test_what_was_touched_is_printed_where_its_file_cannot_be_written_any_more(
    tmp_path: Path,
    monkeypatch: Patch,
    said: Said,
    command: str,
    prompts: list[str],
    load: Callable[[Path], object],
) -> None:
    """The disk was filled while the arm was touched with."""
    pytest.importorskip("resource", reason="Windows limits no file's size")
    out, copied = tmp_path / "arm.toml", tmp_path / "copied.toml"
    with ExitStack() as filled:
        last = (prompts.pop(), lambda: filled.enter_context(full(0)))
        person = Person(monkeypatch, *prompts, last)
        why = said(3, f"arm {command} {OWN} --homed", out).err
    assert why == f"teatbench: {out}: can't be written: File too large. Make room.\n"
    assert not list(tmp_path.iterdir())
    _, heading, text = person.text.partition(f"What {out} was to hold follows.")
    assert heading
    copied.write_text(text.partition("\n\n")[2], encoding="utf-8")
    load(copied)


def test_a_bad_arm_is_not_verified(tmp_path: Path, monkeypatch: Patch, said: Said) -> None:
    out = tmp_path / "verification.toml"
    monkeypatch.setattr("bench.calibrate.arm.SimulatedArm", partial(SimulatedArm, accuracy_mm=3.0))
    Person(monkeypatch, "Fix the divot", *["tip in the divot"] * 5)
    why = said(1, f"arm verify {OWN} --homed --distances 1 --touches 5", out).err
    assert "not verified: middle: readings of one point lie up to" in why
    assert "not verified: no calibrated length was measured" in why
    assert "passed = false" in out.read_text(encoding="utf-8")


@pytest.mark.slow
def test_an_arm_without_a_calibrated_length_is_not_refuted_and_not_verified(
    tmp_path: Path, monkeypatch: Patch, said: Said
) -> None:
    out = tmp_path / "verification.toml"
    Person(monkeypatch, "Fix the divot", *["tip in the divot"] * 5)
    why = said(4, f"arm verify {OWN} --homed --distances 1 --touches 5", out).err
    assert why == "teatbench: not verified: no calibrated length was measured\n"
    assert "passed = false" in out.read_text(encoding="utf-8")


@pytest.mark.parametrize("limit", ["", "--residual-limit-mm 10"])
def test_a_frame_whose_check_point_is_off_is_not_written(
    tmp_path: Path, monkeypatch: Patch, said: Said, limit: str
) -> None:
    out, go = tmp_path / "frame.toml", SimulatedArm.go
    above = TouchStep("check", 0, "", (120.0, 90.0, 6.0))
    monkeypatch.setattr(
        SimulatedArm, "go", lambda arm, step: go(arm, above if step.what == "check" else step)
    )
    Person(monkeypatch, "origin", "x axis", "plane", "Check point")
    why = said(0 if limit else 1, f"arm frame {OWN} --homed {limit}", out).err
    assert out.exists() == bool(limit)
    assert limit or re.search(
        r"a check point is [56]\.\d\d mm off, limit 1.5 mm; nothing was written", why
    )


@pytest.mark.slow
def test_watch_shows_tip_pedals_and_rate_live_until_ctrl_c(monkeypatch: Patch) -> None:
    with closing(RealClock()) as clock, SimulatedArm(clock) as simulated:
        acts = {
            "left up, right up": lambda: setattr(simulated.emulator, "buttons", 1),
            "left up, right DOWN": lambda: setattr(simulated.emulator, "buttons", 2),
            "left DOWN, right up": lambda: simulated.go(TouchStep("origin", 0, "")),
        }
        there = PLACED.inverse().apply([0.0, 0.0, 0.0])
        tips: list[tuple[float, ...]] = []

        class Watching(Person):
            def write(self, text: str) -> int:
                written = super().write(text)
                if found := re.match(r"tip +(-?[\d.]+) +(-?[\d.]+) +(-?[\d.]+) mm", text):
                    tips.append(tuple(map(float, found.groups())))
                    for words in [one for one in acts if one in text]:
                        acts.pop(words)()
                    if math.dist(tips[-1], there) < 2.0:
                        signal.raise_signal(signal.SIGINT)
                return written

        person = Watching(monkeypatch)
        # the command waits for a processor, never for the arm
        assert teatbench("arm watch --homed --answer-s 60 --port {}", simulated.url) == 0
    assert not acts
    assert math.dist(tips[0], (54.2, -51.8, 212.2)) < 0.1
    assert person.text.count("\rtip") == len(tips) - 1, "one line, written over"
    assert max(float(v) for v in re.findall(r"([\d.]+) packets/s", person.text)) > 50.0


def test_home_asks_for_the_peg_first(monkeypatch: Patch) -> None:
    person = Person(monkeypatch, "Put the arm's stylus on its peg and let go of it.")
    assert teatbench("arm home --port emulator:") == 0
    assert "Homed. The tip stands at 54.20, -51.84, 212.20 mm" in person.text
    assert "abort" in person.text
    assert "the run" not in person.text


def test_read_gives_one_json_object(said: Said) -> None:
    """On its peg: 75 mm from the base axis, 212 mm up (the fact sheet, One real arm)."""
    (text,) = said(0, "arm read --port emulator: --homed --json").out.strip().split("\n")
    line = json.loads(text)
    keys = "schema_version serial_number tip_mm spread_mm axis packets counts"
    assert set(line) == set(keys.split())
    assert math.hypot(*line["tip_mm"][:2]) == pytest.approx(75.0, abs=0.05)
    assert line["tip_mm"][2] == pytest.approx(212.2005, abs=1e-3)
    assert line["counts"] == [13903, 6238, 6868, 4098, 3193, 8416]
    assert line["serial_number"] == "40937"


@pytest.mark.slow
def test_read_in_the_world_uses_the_frame_of_this_arm_only(
    tmp_path: Path, monkeypatch: Patch, said: Said
) -> None:
    out = tmp_path / "frame.toml"
    out.write_text("old", encoding="utf-8")
    with monkeypatch.context() as patch:
        person = Person(patch, "origin", "x axis", "plane")
        assert teatbench(f"arm frame {OWN} --homed --plane-checks 0 --replace", out) == 0
    assert "No check point was touched" in person.text
    line = json.loads(said(0, "arm read --port emulator: --homed --json --frame {}", out).out)
    assert line["world_mm"] == pytest.approx(PLACED.apply(line["tip_mm"]).tolist(), abs=1.5)
    out.write_text(out.read_text(encoding="utf-8").replace('"40937"', '"11111"'), encoding="utf-8")
    seen = said(2, "arm read --port emulator: --homed --frame {}", out).err
    why = "this file is of the arm 11111, but the arm that answers is 40937"
    assert f"{out}:5: serial_number: {why}" in seen


def test_the_pieces_of_files_in_the_labs_page_are_right() -> None:
    guide = (ROOT / "docs" / "rig.md").read_text(encoding="utf-8")
    blocks = [tomllib.loads(block) for block in re.findall(r"```toml\n(.*?)```", guide, re.DOTALL)]
    (script,) = (block for block in blocks if "requirements" in block)
    rigs = [block["arm"] for block in blocks if "arm" in block]
    assert [ArmTable.model_validate(rig).accuracy_mm for rig in rigs] == [0.03]
    (rule,) = script["requirements"]
    note = ArmRequirement.model_validate(rule)
    left_out = set(re.findall(r"^# (\w+_limit_mm) = ", guide, re.MULTILINE))
    assert len(left_out) == 3
    assert set(rule) | left_out | {"source"} == set(ArmRequirement.model_fields)
    requirements = load_script(find_script(None)).script.requirements
    (shipped,) = (one for one in requirements if isinstance(one, ArmRequirement))
    assert note.model_copy(update={"source": shipped.source}) == shipped
