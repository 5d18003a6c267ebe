"""`run --dry-run` on emulated and real rigs: words, exit codes, nothing left behind."""

from __future__ import annotations

import json
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from bench.cli.dry_run import _gone_through
from bench.rig.emulated_rig import EmulatedRig
from bench.rig.loading import load_rig
from bench.rig.model import EmulatedStage
from bench.run import estimate
from instruments.clock import RealClock
from tests.bench.campaign.small_campaign import write_small_rig
from tests.bench.commands import Said, lab_rig

pytestmark = pytest.mark.slow

DRY = "run {} --dry-run --out {}"


def test_a_clean_script_exits_with_0(two_trials: Path, tmp_path: Path, said: Said) -> None:
    given = two_trials, tmp_path / "runs", write_small_rig(tmp_path)
    seen = said(0, f"{DRY} --rig {{}}", *given)
    gone_through, first, time, room = seen.out.splitlines()
    assert gone_through.startswith(
        "gone through on emulators, in virtual time: 2 of 2 trials; frames of 2 were rendered and"
        " checked"
    )
    assert first == "2 trials at 2 poses: nothing wrong. Nothing was moved."
    assert time.startswith("about 12 min of the bench's time: preparing 20 s, settling 12 min, ")
    asked = "17 prompts: 1 homing, 6 arm check, 2 set-ups, 8 teat ends (3 touches each)"
    assert room.endswith(f" MB and the report, {asked}")
    assert seen.err == "", "a bar is for a terminal: test_terminal_screen"
    some: Any = SimpleNamespace(trials=5, rendered=4, recovered={"a fault": 2})
    *_, met, left = _gone_through(some, 4)
    assert met == "met and got over: a fault (2 times)"
    assert left == "not gone through: 1 trial, for what is said above"
    assert not (tmp_path / "runs").exists()


PYTHON = """
SCRIPT = {"title": "One", "detectors": ["thesis"], "bath": {"set_point_c": 33.0, "window_s": 60.0}}
SCRIPT["requirements"] = [{"kind": "bath_in_band", "name": "bath", "band_k": 0.5}]


def trials():
    yield {"name": "one", "situation": "ideal", "layout": "single", "set_up": "One teat."POSE}
"""
NO_STAGE = "/dev/tty-there-is-none"
ELSEWHERE = {"/dev/ttyACM0": NO_STAGE, 'cut_out_tested = ""': 'cut_out_tested = "2026-11-20"'}


def one(folder: Path, pose: str = "") -> tuple[Path, Path]:
    """A script in Python, and where its runs would go."""
    (folder / "one.py").write_text(PYTHON.replace("POSE", pose), encoding="utf-8")
    return folder / "one.py", folder / "runs"


def test_what_a_run_is_refused_for_is_reported_by_its_dry_run(tmp_path: Path, said: Said) -> None:
    rig = lab_rig(tmp_path, ELSEWHERE)
    (tmp_path / "lab.tripped.json").write_text(
        '{"rule": "bath too hot", "why": "38 degC"}', encoding="utf-8"
    )
    seen = said(2, f"{DRY} --rig {{}}", *one(tmp_path), rig).out
    assert "the rig: latched: interlock bath too hot at an unknown time: 38 degC" in seen
    assert "not checked: the stage's travel: its controller doesn't answer" in seen
    text = rig.read_text(encoding="utf-8")
    rig.write_text(
        text[: text.index("[stage]")] + text[text.index("[cameras]") :], encoding="utf-8"
    )
    assert "needs a stage" in said(2, "run plane-map --dry-run --rig {}", rig).err
    rig = lab_rig(tmp_path, ELSEWHERE)  # and is not asked while a run has it: most boards reset
    (tmp_path / "lab.tripped.json").unlink()
    held = {"host": "another machine", "pid": 1, "since": "2026-11-01T12:00:00", "run": "runs/o"}
    (tmp_path / "lab.lock.json").write_text(json.dumps(held), encoding="utf-8")
    seen = said(0, f"{DRY} --rig {{}}", *one(tmp_path), rig).out
    assert "not checked: the stage's travel: another bench has the rig" in seen
    assert "1 trial at 1 pose: nothing wrong." in seen
    assert "; the operator's by assumed times, see 'teatbench trials show'" in seen


@pytest.mark.weekly
def test_what_a_person_has_to_confirm_is_said_by_check_and_dry_run_as_by_a_run(
    tmp_path: Path, said: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    unknown = {"/dev/ttyACM0": NO_STAGE, '"julabo-presto"': '"lauda-ascii"'}
    rig = lab_rig(tmp_path, unknown)
    script, runs = one(tmp_path)
    cut_out = "bath.cut_out_tested: missing: nothing is heated before the bath's independent cut-"
    unit = "bath.unit_confirmed: missing: nothing tells whether the numbers of a "
    monkeypatch.setattr("bench.check_rig", lambda *_: iter(()))  # takes seconds
    checked = said(0, "check {}", rig).out.splitlines()
    dry = said(2, f"{DRY} --rig {{}}", script, runs, rig).out.splitlines()
    for sentence in (cut_out, unit):
        assert any(line.startswith(sentence) for line in checked)
        assert any(line.startswith(f"the rig: refused: {sentence}") for line in dry)
    assert cut_out in said(2, "run {} --rig {} --out {}", script, rig, runs).err
    lab_rig(tmp_path, ELSEWHERE | unknown)
    assert unit in said(2, "run {} --rig {} --out {}", script, rig, runs).err
    assert not runs.exists()


def test_a_run_without_room_is_refused_before_it_starts_in_the_words_of_its_dry_run(
    tmp_path: Path, said: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig, out = write_small_rig(tmp_path), tmp_path / "there" / "runs"
    wanted_mb = estimate.disk_mb(load_rig(rig), 1)
    monkeypatch.setattr(estimate, "disk_usage", lambda _: SimpleNamespace(free=1e6 * wanted_mb - 1))
    sentence = f"NOT ENOUGH ROOM: {wanted_mb:.0f} MB are free in {tmp_path.resolve()}, and up to"
    assert sentence in said(2, "run {} --out {} --rig {}", one(tmp_path)[0], out, rig).err
    assert sentence in said(2, f"{DRY} --rig {{}}", one(tmp_path)[0], out, rig).out
    # there is room for the run, and none for the recording beside it, or elsewhere
    monkeypatch.setattr(estimate, "disk_usage", lambda _: SimpleNamespace(free=1.4e6 * wanted_mb))
    command, recording = "run {} --out {} --rig {} --record {}", tmp_path / "recording"
    beside = said(2, command, one(tmp_path)[0], out, rig, recording).err
    assert f"up to {1.5 * wanted_mb:.0f} MB are needed" in beside
    (elsewhere := tmp_path / "elsewhere").mkdir()
    free = {tmp_path: 1.1e6 * wanted_mb, elsewhere: 0.4e6 * wanted_mb}
    monkeypatch.setattr(estimate, "disk_usage", lambda at: SimpleNamespace(free=free[at]))
    monkeypatch.setattr(estimate, "_disk", lambda folder: folder == elsewhere)
    other = said(2, command, one(tmp_path)[0], out, rig, elsewhere).err
    assert f"MB are free in {elsewhere}, and up to {0.5 * wanted_mb:.0f} MB" in other
    assert not out.parent.exists()
    assert not recording.exists()


FAR = ', "pose": {"x_mm": 170.0}'


def test_a_script_of_which_no_trial_is_within_the_travel(tmp_path: Path, said: Said) -> None:
    script, runs = one(tmp_path, FAR)
    given = runs, write_small_rig(tmp_path)
    seen = said(2, f"{DRY} --rig {{}}", [script, script], *given).out
    assert seen.count(f"{script.stem}: One\n") == 2
    why = "limits: x +170 mm, y +0 mm needs the stage's X axis at 20, which goes from -300 to 0"
    for note in (f"one: {why}", "1 trial at 1 pose: 1 problem. Nothing was moved."):
        assert seen.count(note) == 2, seen
    assert "not checked: the script as a whole: no trial is within the stage's travel" in seen
    assert "--json is for --dry-run" in said(2, "run --json --out {}", runs).err
    both = json.loads(said(2, f"{DRY} --rig {{}} --json", [script, script], *given).out)
    assert both["schema_version"] == 1
    assert [seen["trials"] for seen in both["scripts"]] == [1, 1]
    keys = "script trials poses gone_through frame_sets_rendered findings recovered not_checked"
    assert list(both["scripts"][0]) == [*keys.split(), "needs"]


def test_a_controllers_own_settings_are_asked_for_and_rehearsed_with(
    tmp_path: Path, said: Said
) -> None:
    rig = load_rig(write_small_rig(tmp_path))
    wide = rig.rig.emulation.model_copy(update={"stage": EmulatedStage(settings={130: 640.0})})
    twin = replace(rig, rig=rig.rig.model_copy(update={"emulation": wide}))
    with closing(RealClock()) as clock, EmulatedRig(twin, clock, 1) as there:
        elsewhere = ELSEWHERE | {
            "/dev/ttyACM0": there.urls["stage"],
            "[-150.0, -137.5]": "[-320.0, -137.5]",
        }
        path = lab_rig(tmp_path, elsewhere)
        seen = said(0, f"{DRY} --rig {{}}", *one(tmp_path, FAR), path).out
    assert "limits" not in seen
    assert "the stage's travel" not in seen
    assert "1 of 1 trial" in seen
