"""What runs took is compared with what was expected, and makes the next estimate better."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from bench.rig.loading import find_rig, load_rig
from bench.rig.model import OperatorTable
from bench.run.estimate import (
    ASSUMED,
    FILE,
    LOOKS_BACK,
    estimate,
    estimate_text,
    needs,
    read_durations,
    write_durations,
)
from bench.script.model import find_script, load_script


def test_the_newest_runs_count_most_and_rigs_are_kept_apart(tmp_path: Path) -> None:
    rig = load_rig(find_rig(None))
    expected = estimate(rig, load_script(find_script(None)))
    for name, new in (("1-first", {"touch": 10.0}), ("2-second", {"touch": 20.0, "heating": 0.4})):
        write_durations(tmp_path / name, rig, expected, {"total_s": 5.0}, new)
    assert read_durations(tmp_path, rig) == {"touch": 15.0, "heating": 0.4}
    for name, text in (
        ("3-broken", "[1"),
        ("4-other", json.dumps({"rig": "another", "figures": {"touch": 99.0}})),
        ("5-odd", "{}"),
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name / FILE).write_text(text, encoding="utf-8")
    assert read_durations(tmp_path, rig) == {"touch": 15.0, "heating": 0.4}
    for number in range(2 * LOOKS_BACK):  # however many runs of others came since
        shutil.copytree(tmp_path / "4-other", tmp_path / f"6-other-{number}")
    assert read_durations(tmp_path, rig) == {"touch": 15.0, "heating": 0.4}
    kept = json.loads((tmp_path / "1-first" / FILE).read_text(encoding="utf-8"))
    assert kept["rig"] == f"{rig.rig.name}, operator emulator:"
    assert kept["expected_s"]["total_s"] == expected.total_s


@pytest.mark.slow
def test_needs_by_hand() -> None:
    rig, script = load_rig(find_rig(None)), load_script(find_script(None))
    by_hand = replace(
        rig, rig=rig.rig.model_copy(update={"operator": OperatorTable(url="console:")})
    )
    first, by_then = (needs(by_hand, script, measured).time for measured in (None, {"touch": 16.0}))
    usual = estimate(rig, script)
    assert (first.set_ups_s, first.touches_s) == (usual.set_ups_s, usual.touches_s)
    assert (usual.preparing_s, usual.detecting_s) == (20.0 + (1 + 5 + 1) * 8.0, 18 * 2.0)
    twice_s = first.preparing_s + (1 + 5 + 1) * 8.0  # homing, and the checks of the arm
    assert by_then == replace(first, touches_s=2.0 * first.touches_s, preparing_s=twice_s)
    assert needs(rig, script).prompts == 1 + 5 + 1 + 18 * (1 + 4) == 97, "one request a teat end"
    plane = load_script(find_script("plane-map"))
    assert needs(rig, plane).prompts < len(plane.planned), "carried: most trials ask nobody"
    assert needs(by_hand, plane).time.touches_s == pytest.approx(7 * 3 * 8.0), (
        "the first, before every 26th further one, and the last"
    )
    took_20_min = "It took 20 min of the bench's time; 74 min had been expected."
    assert estimate_text(usual, {"total_s": 1200.0}) == took_20_min
    assert set(ASSUMED) >= {"heating", "touch", "set-up", "placing"}
