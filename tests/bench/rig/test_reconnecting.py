"""An arm or a stage that is lost while a person touches: no touch before it is asked for again."""

from __future__ import annotations

import tomllib
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import bench
from bench.rig.arm_files import load_verification
from bench.truth.registration import load_registration
from instruments.errors import DeviceError, InstrumentError, LinkError
from instruments.microscribe.driver import MicroScribe, Reading
from instruments.stage.calls import Stage
from tests.bench.commands import Person, Said, teatbench
from tests.bench.operated_runs import shipped_rig
from tests.bench.truth.test_truth_runs import CARRY, done, script_in

pytestmark = pytest.mark.slow

AGAIN = "The arm was lost: put its stylus on its peg"
SAME = "It shows whether those before count."
BACK = "The arm is back, and homed again."
Patch = pytest.MonkeyPatch


def losing(
    monkeypatch: Patch, kind: type[Any], verb: str, at: dict[int, InstrumentError]
) -> Counter[str]:
    """Calls of ``verb`` that number ``at`` (from 1) end a session and raise; counts those that do
    not raise, as "done".
    """
    count, works = Counter[str](), getattr(kind, verb)

    def instead(self: Any, *given: Any, **more: Any) -> Any:
        count["all"] += 1
        if count["all"] in at:
            if kind is MicroScribe:
                self.safe()
            raise at[count["all"]]
        found = works(self, *given, **more)
        count["done"] += 1
        return found

    monkeypatch.setattr(kind, verb, instead)
    return count


def silent(who: str = "arm") -> LinkError:
    return LinkError(who, "no answer")


@pytest.mark.parametrize("verb", ["read", "buttons"])
@pytest.mark.parametrize(
    ("command", "prompts", "at"),
    [
        ("frame", ["origin", "x axis", "plane", AGAIN, "plane", SAME, "Check point"], 3),
        (
            "verify --distances 1 --touches 5",
            ["Fix the divot", *["tip in the"] * 4, AGAIN, "touch 4 of 5", "touch 5 of 5"],
            4,
        ),
    ],
)
def test_an_arm_that_is_lost_amid_its_own_commands_costs_the_touch_under_way(
    tmp_path: Path, monkeypatch: Patch, command: str, prompts: list[str], at: int, verb: str
) -> None:
    if verb == "buttons":  # the watch of the pedals asks while the prompt stands there
        prompts.remove(AGAIN)
        prompts[prompts.index("plane" if at == 3 else "touch 4 of 5")] = AGAIN
    person = Person(monkeypatch, *prompts)
    count = losing(monkeypatch, MicroScribe, verb, {at: silent()})
    code = teatbench(f"arm {command} --port emulator: --homed --out {{}}", tmp_path / "arm.toml")
    assert code == (0 if command == "frame" else 4), person.text
    assert BACK in person.text
    assert "What was touched so far is kept." in person.text
    assert person.text.count("  read ") == 5
    assert (tmp_path / "arm.toml").is_file()
    assert count["done"]


def test_a_frame_is_touched_anew_where_the_arm_homes_elsewhere(
    tmp_path: Path, monkeypatch: Patch
) -> None:
    """The points before and after would lie in two frames of the arm."""
    losing(monkeypatch, MicroScribe, "read", {3: silent()})
    homings, home, read = list[float](), MicroScribe.home, MicroScribe.read

    def homed(arm: MicroScribe) -> None:
        homings.append(3.0)
        home(arm)

    def off(arm: MicroScribe, *given: Any) -> Reading:
        seen = read(arm, *given)
        return replace(seen, tip_mm=seen.tip_mm + sum(homings))

    monkeypatch.setattr(MicroScribe, "home", homed)
    monkeypatch.setattr(MicroScribe, "read", off)
    anew = ["origin", "x axis", "plane", "Check point"]
    person = Person(monkeypatch, *anew[:3], AGAIN, "plane", SAME, *anew)
    assert teatbench("arm frame --port emulator: --homed --out {}", tmp_path / "arm.toml") == 0
    assert "The origin is 5.2" in person.text
    assert "All points are touched anew." in person.text
    points = tomllib.loads((tmp_path / "arm.toml").read_text(encoding="utf-8"))["points"]
    assert len(points) == 4
    assert person.text.count("  read ") == 8


def test_what_an_arms_command_had_is_kept_or_named_where_it_does_not_end(
    tmp_path: Path, monkeypatch: Patch, capsys: pytest.CaptureFixture[str]
) -> None:
    prompts = ["Fix the divot", *["tip in the"] * 5, "Fix the divot", *["tip in the"] * 2]
    person = Person(monkeypatch, *prompts, ("touch 3 of 5", "a"))
    out, kept = tmp_path / "arm.toml", tmp_path / "arm.unfinished.toml"
    verify = "arm verify --port emulator: --homed --distances 2 --touches 5 --out {}"
    assert teatbench(verify, out) == 3
    assert f"Not verified; kept in {kept}: 1 divot." in " ".join(person.text.split())
    assert "the operator aborted; nothing was written" not in capsys.readouterr().err
    assert not out.exists()
    found = tomllib.loads(kept.read_text(encoding="utf-8"))
    assert [(one["where"], len(one["tips_mm"])) for one in found["location"]] == [("near", 5)]
    with pytest.raises(bench.ConfigError, match="unfinished"):
        load_verification(kept)
    monkeypatch.undo()
    person = Person(monkeypatch, *prompts, *["tip in the"] * 3)
    assert teatbench(verify, out) == 4
    assert out.exists()
    assert not kept.exists()
    monkeypatch.undo()
    person = Person(monkeypatch, "origin", ("x axis", "a"))
    assert teatbench("arm frame --port emulator: --homed --out {}", tmp_path / "frame.toml") == 3
    assert "Touched so far, and lost: origin." in person.text


def test_a_registration_goes_on_where_arm_or_stage_were_lost(
    tmp_path: Path, monkeypatch: Patch, said: Said
) -> None:
    rig = shipped_rig(tmp_path)
    command = "calibrate stage --rig {} --readings 2 --out {}"
    whole = losing(monkeypatch, MicroScribe, "read", {})
    said(0, command, rig, tmp_path / "whole.toml")
    touched = whole["done"]
    monkeypatch.undo()
    reads = losing(monkeypatch, MicroScribe, "read", {4: silent(), 7: silent()})
    jam = DeviceError("stage", "alarm 1: hard limit")
    losing(monkeypatch, Stage, "move_to", {3: silent("stage"), 5: jam})
    shown = said(0, command, rig, tmp_path / "broken.toml").out
    assert reads["done"] == touched, "no touch is made twice"
    assert shown.count(BACK) == 2
    assert shown.count("The stage is back, and homed again.") == 2
    assert len(load_registration(tmp_path / "broken.toml").stations) == 5


def test_a_run_that_registers_its_stage_keeps_the_stations_that_it_has(
    tmp_path: Path, monkeypatch: Patch
) -> None:
    rig = shipped_rig(tmp_path)
    script = script_in(tmp_path, CARRY, "poses = [{ x_mm = -20.0 }, { x_mm = 20.0 }]")
    reads = losing(monkeypatch, MicroScribe, "read", {})
    assert done(rig, script, tmp_path / "whole").run.ending == "finished"
    touched = reads["done"]
    monkeypatch.undo()
    reads = losing(monkeypatch, MicroScribe, "read", {12: silent()})
    run = done(rig, script, tmp_path / "broken").run
    assert run.ending == "finished"
    assert reads["done"] == touched


def test_a_program_keeps_the_ends_that_were_touched(monkeypatch: Patch) -> None:
    reads, warned = losing(monkeypatch, MicroScribe, "read", {5: silent()}), list[str]()
    with bench.open_rig(instruments=("arm", "stage", "operator"), warn=warned.append) as rig:
        rig.home()
        rig.move()
        rig.set_up(bench.member("ideal", 3))
        ends = rig.touch()
    assert len(ends) == 4
    assert warned[-1] == BACK
    assert reads["done"]


@pytest.mark.parametrize(
    ("fault", "why"),
    [
        (DeviceError("arm", "another arm answers"), "another arm"),
        (LinkError("bath", "no answer"), "bath"),
    ],
)
def test_what_is_no_loss_of_the_arm_ends_the_command(
    tmp_path: Path, monkeypatch: Patch, said: Said, fault: InstrumentError, why: str
) -> None:
    Person(monkeypatch, "origin")
    losing(monkeypatch, MicroScribe, "read", {1: fault})
    assert why in said(3, "arm frame --port emulator: --homed --out {}", tmp_path / "f.toml").err
