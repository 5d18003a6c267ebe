"""What runs took is compared with what was expected, and makes the next estimate better."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bench.cli import main
from bench.rig import find_rig, load_rig
from bench.running.learnt import FILE, figures, needs, read_learnt, told, took, write_learnt
from bench.running.trial_time import ASSUMED, estimate
from bench.script import find_script, load_script
from tests.bench.operated_runs import SCRIPT, files, run_of

SLOW = "bath_start_c = 28.0"


def test_the_second_estimate_is_nearer_than_the_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = files(tmp_path, emulation="prompt_s = 30.0", script=SCRIPT.replace("window_s = 2.0", "window_s = 60.0"))
    rig_file = tmp_path / "rig.toml"
    rig_file.write_text(rig_file.read_text(encoding="utf-8").replace("bath_start_c = 33.0", SLOW), encoding="utf-8")
    rig, script = load_rig(rig_file), load_script(tmp_path / "script.toml")
    assert main(arguments) in (0, 1, 4)
    assert "min of the bench's time" in capsys.readouterr().out
    run, folder = run_of(tmp_path), tmp_path / "runs"
    spent = took(run)
    first, second = needs(rig, script).time.total_s, needs(rig, script, read_learnt(folder, rig)).time.total_s
    assert abs(second - spent["total_s"]) < 0.5 * abs(first - spent["total_s"])
    learnt = figures(run, rig, script, spent)
    assert learnt["touch"] == pytest.approx(30.0, abs=2.0), "a prompt takes the emulated operator so long"
    assert read_learnt(folder, rig) == pytest.approx(learnt)


def test_the_newest_runs_count_most_and_rigs_are_kept_apart(tmp_path: Path) -> None:
    rig = load_rig(find_rig(None))
    expected = estimate(rig, load_script(find_script(None)))
    for name, new in {"1-first": {"touch": 10.0}, "2-second": {"touch": 20.0, "heating": 0.4}}.items():
        write_learnt(tmp_path / name, rig, expected, {"total_s": 5.0}, new)
    assert read_learnt(tmp_path, rig) == {"touch": 15.0, "heating": 0.4}
    for name, text in (("3-broken", "[1"), ("4-other", json.dumps({"rig": "another", "figures": {"touch": 99.0}})), ("5-odd", "{}")):
        (tmp_path / name).mkdir()
        (tmp_path / name / FILE).write_text(text, encoding="utf-8")
    assert read_learnt(tmp_path, rig) == {"touch": 15.0, "heating": 0.4}
    kept = json.loads((tmp_path / "1-first" / FILE).read_text(encoding="utf-8"))
    assert kept["rig"] == f"{rig.rig.name}, operator emulator:"
    assert kept["expected_s"]["total_s"] == expected.total_s


def test_needs_by_hand() -> None:
    rig, script = load_rig(find_rig(None)), load_script(find_script(None))
    assert needs(rig, script).time == estimate(rig, script)
    assert needs(rig, script, {"touch": 16.0}).time.touches_s == pytest.approx(2.0 * estimate(rig, script).touches_s)
    assert needs(rig, script).prompts == 1 + 2 * 5 + 18 * (1 + 4 * rig.rig.arm.touches)
    plane = load_script(find_script("plane-map"))
    assert needs(rig, plane).prompts < len(plane.planned), "carried: most trials ask nobody"
    assert needs(rig, plane).time.touches_s == pytest.approx(7 * 3 * 8.0), "the first, before every 26th further one, and the last"
    assert told(estimate(rig, script), {"total_s": 1200.0}) == "It took 20 min of the bench's time; 72 min were expected."
    assert set(ASSUMED) >= {"heating", "touch", "set-up", "placing"}
