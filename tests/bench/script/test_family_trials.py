"""Trials that show families of situations: which members, what the operator is told, what is wrong,
and a run through the whole bench.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bench.config import ConfigError
from bench.rig.emulated_rig import EmulatedRig
from bench.rig.loading import find_rig, load_rig
from bench.script.model import LoadedScript, load_script
from bench.script.planned_trials import chosen
from instruments.clock import VirtualClock
from instruments.world.situations import situation

HEAD = """title = "Families"
detectors = ["thesis"]

[bath]
set_point_c = 33.0

[[requirements]]
kind = "false_teats"
name = "no false teat"

[[trials]]
name = "arms"
situation = "hot_body_at_ends"
"""


def script(tmp_path: Path, trial: str) -> LoadedScript:
    path = tmp_path / "families.toml"
    path.write_text(HEAD + trial, encoding="utf-8")
    return load_script(path)


def test_redrawn_trials_show_one_member_for_each_pose(tmp_path: Path) -> None:
    loaded = script(
        tmp_path,
        'family = "hot_body_at_ends"\nmember = 5\nredraw = true\nrepeats = 2\ndraw = { count ='
        " 3 }\n",
    )
    scenes = [one.scene for one in loaded.planned]
    assert scenes == [situation("hot_body_at_ends", seed) for seed in (5, 5, 6, 6, 7, 7)]
    assert [one.phantom for one in loaded.planned] == [scene.phantom for scene in scenes if scene]
    assert "family hot_body_at_ends, members from 5 on, one for each pose" in chosen(
        loaded.script.trials[0]
    )


def test_one_member_stands_at_every_pose(tmp_path: Path) -> None:
    loaded = script(
        tmp_path,
        'family = "hot_body_at_ends"\nmember = 2\nposes = [{ x_mm = 0.0 }, { x_mm = 5.0 }]\n',
    )
    assert {one.scene for one in loaded.planned} == {situation("hot_body_at_ends", 2)}
    assert "member 2" in chosen(loaded.script.trials[0])


def test_the_operator_is_told_what_stands_where(tmp_path: Path) -> None:
    (planned,) = script(tmp_path, 'family = "hot_body_at_ends"\n').planned
    asked = planned.arrangement("XY")
    found = situation("hot_body_at_ends", 0)
    assert asked.scene == found
    assert found.about in asked.instruction
    assert "warm arm at x" in asked.instruction
    assert f"length {found.phantom.teats[2].shape.length_mm:.1f} mm" in asked.instruction


def test_the_emulated_operator_sets_the_whole_scene_up(tmp_path: Path) -> None:
    (planned,) = script(tmp_path, 'family = "low_contrast"\nmember = 3\n').planned
    found = situation("low_contrast", 3)
    with EmulatedRig(load_rig(find_rig(None)), VirtualClock(), seed=5) as twin:
        placed = twin.operator.ask(planned.arrangement("XY"))
        seen = twin.world.scene()
    assert (seen.backdrop, seen.lighting, seen.teat_paint) == (
        found.backdrop,
        found.lighting,
        found.teat_paint,
    )
    assert len(placed.visible) == 4
    assert np.ptp([teat.base_mm[0] for teat in seen.phantom.teats]) > 0.0


@pytest.mark.parametrize(
    ("trial", "said"),
    [
        ('family = "overlaping"\n', 'did you mean "overlapping"'),
        ('family = "ideal"\nlayout = "table-5-1"\n', "both layout and family"),
        ('set_up = "x"\n', "has no layout, and no family"),
        ('layout = "table-5-1"\n', "set_up is missing"),
        ('family = "ideal"\nmember = -1\n', "greater than or equal to 0"),
    ],
)
def test_what_is_wrong_is_told_in_its_place(tmp_path: Path, trial: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        script(tmp_path, trial)
