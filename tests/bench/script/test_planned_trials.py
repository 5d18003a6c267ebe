"""Scripts to trials: counts, orders and names are fixed, the same script gives the same trials;
docs/trials.md names every key.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel

from bench.config import ConfigError
from bench.rig.emulated_rig import EmulatedRig
from bench.rig.loading import find_rig, load_rig
from bench.script.model import LoadedScript, find_script, load_script
from bench.script.phantom import (
    Envelope,
    PhantomFile,
    TeatTable,
    find_layout,
    layout_names,
    load_layout,
)
from bench.script.planned_trials import (
    POSE_KEYS,
    DrawnPoses,
    Grid,
    PlannedTrial,
    PoseTable,
    Trial,
    chosen,
    plan,
    pose_set,
    shared,
)
from instruments.clock import VirtualClock
from instruments.world.phantom import PlatePose
from instruments.world.situations import situation
from tests.conftest import ROOT

HEAD = {"name": "t", "situation": "s", "layout": "single", "set_up": "One teat."}
LAYOUTS = {name: load_layout(find_layout(name)) for name in ("single", "random-udder")}
FAR_MM = st.floats(-200, 200)


def planned(
    *, repeats: int = 1, seed: int = 1, shuffled: bool = False, **table: Any
) -> tuple[PlannedTrial, ...]:
    trial = Trial.model_validate({**HEAD, **table})
    return plan([trial], LAYOUTS, repeats=repeats, seed=seed, shuffled=shuffled)


def places(trials: tuple[PlannedTrial, ...]) -> list[tuple[float, float]]:
    return [(one.pose.x_mm, one.pose.y_mm) for one in trials]


def test_a_trial_without_poses_stands_at_its_reference_place() -> None:
    (one,) = planned()
    assert (one.id, one.name, one.pose, one.approach) == ("001-t-1", "t", PlatePose(), None)


def test_a_serpentine_by_hand() -> None:
    grid = {"x_mm": (-10.0, 10.0), "y_mm": (0.0, 5.0), "step_mm": (10.0, 5.0)}
    trials = planned(grid=grid)
    assert places(trials) == [(-10, 0), (0, 0), (10, 0), (10, 5), (0, 5), (-10, 5)]
    ids = "001-t-1-1 002-t-2-1 003-t-3-1 004-t-6-1 005-t-5-1 006-t-4-1"
    assert [one.id for one in trials] == ids.split()
    by_rows = places(planned(grid={**grid, "order": "rows"}))
    assert by_rows == [(-10, 0), (0, 0), (10, 0), (-10, 5), (0, 5), (10, 5)]
    along_y = planned(grid={**grid, "along": "y"})
    assert places(along_y) == [(-10, 0), (-10, 5), (0, 5), (0, 0), (10, 0), (10, 5)]
    where, there = ({one.name: one.pose for one in visited} for visited in (trials, along_y))
    assert where == there, "a name is a pose, whatever the order"


@given(
    columns=st.integers(1, 12),
    rows=st.integers(1, 12),
    dx=st.floats(0.5, 40),
    dy=st.floats(0.5, 40),
    along=st.sampled_from("xy"),
)
def test_a_serpentine_is_everywhere_once_in_single_steps(
    columns: int, rows: int, dx: float, dy: float, along: str
) -> None:
    spans = {"x_mm": (0.0, (columns - 1) * dx), "y_mm": (0.0, (rows - 1) * dy), "step_mm": (dx, dy)}
    grid = Grid.model_validate({**spans, "along": along})
    poses, visited = grid.poses(), grid.visited()
    assert sorted(visited) == list(range(columns * rows))
    at = np.array([(poses[i].x_mm / dx, poses[i].y_mm / dy) for i in visited])
    assert np.abs(np.diff(at, axis=0)).sum(axis=1) == pytest.approx(1.0)


def test_the_plane_map_is_the_plane_of_the_thesis() -> None:
    script = load_script(find_script("plane-map"))
    at = np.array(places(script.planned))
    assert len(at) == len({one.name for one in script.planned}) == 156
    assert np.ptp(at, axis=0).tolist() == [300.0, 275.0]
    assert sorted({*at[:, 0]}) == [-150.0 + 25.0 * k for k in range(13)]
    assert sorted({*at[:, 1]}) == [-137.5 + 25.0 * k for k in range(12)]
    assert len(script.planned[0].phantom.teats) == 1
    assert script.script.truth.mode == "carry"


def test_repeatability_is_five_poses_in_thirty_cycles_and_random_udders_differ() -> None:
    trials = load_script(find_script("repeatability")).planned
    assert [one.name for one in trials[:6]] == ["p-1", "p-2", "p-3", "p-4", "p-5", "p-1"]
    assert [(one.name, one.repeat) for one in trials[-2:]] == [("p-4", 30), ("p-5", 30)]
    assert len(trials) == 150
    udders = load_script(find_script("random-udder")).planned
    assert len({one.phantom for one in udders}) == len({one.pose for one in udders}) == 59
    assert len(udders) == 59
    at = np.array([(one.pose.x_mm, one.pose.y_mm, one.yaw_deg) for one in udders])
    assert (np.abs(at) <= (25.0, 30.0, 8.0)).all()
    assert [one.name for one in udders] != sorted(one.name for one in udders)


def test_repeats_cycles_and_sides_multiply_and_count_on() -> None:
    poses, sides = ({"x_mm": 1.0}, {"x_mm": 2.0}), ("+x", "-y")
    trials = planned(poses=poses, cycles=2, repeats=3, approach=sides, approach_mm=5.0)
    assert len(trials) == 2 * 2 * 3 * 2
    assert sorted(one.repeat for one in trials if one.name == "t-1") == list(range(1, 13))
    first = [("t-1", "+x")] * 3 + [("t-1", "-y")] * 3 + [("t-2", "+x")]
    assert [(one.name, one.side) for one in trials[:7]] == first
    assert trials[0].approach == PlatePose(6.0, 0.0)
    assert trials[3].approach == PlatePose(1.0, -5.0)
    assert len({one.id for one in trials}) == len(trials)


@pytest.mark.slow
@given(
    count=st.integers(1, 40),
    seed=st.integers(0, 2**40),
    low=FAR_MM,
    width=st.floats(0, 100),
    lift=st.floats(0, 100),
)
def test_draws_keep_to_their_envelope_and_to_their_seed(
    count: int, seed: int, low: float, width: float, lift: float
) -> None:
    draw = {"count": count, "x_mm": (low, low + width), "z_mm": (0.0, lift), "yaw_deg": (-5.0, 5.0)}
    trials = planned(draw=draw, seed=seed)
    assert trials == planned(draw=draw, seed=seed)
    if count > 3 and width > 1.0:
        others = planned(draw=draw, seed=seed + 1), planned(draw=draw, seed=seed, name="u")
        assert all(places(trials) != places(other) for other in others)
    assert all(
        low <= one.pose.x_mm <= low + width and 0.0 <= one.pose.z_mm <= lift for one in trials
    )
    assert all(one.pose.y_mm == 0.0 and abs(one.yaw_deg) <= 5.0 + 1e-12 for one in trials)


def test_shuffling_moves_trials_and_changes_none() -> None:
    grid = {"x_mm": (0.0, 90.0), "y_mm": (0.0, 0.0), "step_mm": (10.0, 10.0)}
    table: dict[str, Any] = {"grid": grid, "repeats": 2}
    plain, mixed = planned(**table), planned(**table, shuffled=True)
    assert [one.number for one in mixed] == list(range(1, 21))
    shown = [{(one.name, one.repeat, one.pose) for one in some} for some in (mixed, plain)]
    assert shown[0] == shown[1]
    assert [one.name for one in mixed] != [one.name for one in plain]
    assert mixed == planned(**table, shuffled=True)
    assert mixed != planned(**table, shuffled=True, seed=2)


def test_all_poses_share_one_phantom() -> None:
    trials = planned(draw={"count": 1000, "x_mm": (-10.0, 10.0)})
    assert len({id(one.phantom) for one in trials}) == 1
    assert trials[-1].id == "1000-t-1000-1"


@given(
    x=FAR_MM,
    y=FAR_MM,
    z=st.floats(0, 50),
    yaw=st.floats(-3, 3),
    axes=st.sampled_from(["", "XY", "XYZ", "XYA", "XYZA"]),
)
def test_what_the_stage_does_and_what_the_operator_does_is_the_pose(
    x: float, y: float, z: float, yaw: float, axes: str
) -> None:
    pose = PlatePose(x, y, z, yaw)
    by_stage, by_hand = shared(pose, axes)
    both = by_hand.carried(by_stage)
    assert (both.x_mm, both.y_mm, both.z_mm, both.yaw_rad) == pytest.approx((x, y, z, yaw))
    assert by_stage == (PlatePose() if not axes else shared(by_stage, axes)[0])


def test_the_prompt_says_what_no_motor_does() -> None:
    (one,) = planned(pose={"x_mm": 5.0, "yaw_deg": 10.0}, approach=("+x",))
    assert one.arrangement("XYA").instruction == "One teat."
    said = "One teat. Move the plate to x +0 mm, y +0 mm, yaw +10 deg from its reference place."
    assert one.arrangement("XY").instruction == said
    by_hand = one.arrangement("")
    for said in (
        "Move the plate to x +15 mm, y +0 mm, yaw +10 deg first, so that it comes from the +x side.",
        "Move the plate to x +5 mm, y +0 mm, yaw +10 deg from its reference place.",
    ):
        assert said in by_hand.instruction
    assert by_hand.pose == one.pose
    (udder,) = planned(layout="random-udder", redraw=True)
    assert "left front (LF): x " in udder.arrangement("XY").details


def test_the_record_tells_how_the_poses_were_chosen(tmp_path: Path) -> None:
    script = load_script(find_script("random-udder"))
    said = script.script
    kept = pose_set(said.trials, script.planned, seed=said.seed, order=said.order)
    assert kept["order"] == "shuffled"
    assert kept["chosen"][0] == (
        "udder: 59 poses drawn evenly within x -25 to 25 mm, y -30 to 30 mm, yaw -8 to 8 deg;"
        " layout random-udder, another udder for each pose."
    )
    still = script_of(tmp_path, f"{SINGLE}draw = {{ count = 3 }}")
    told = pose_set(still.script.trials, still.planned, seed=1, order="")["chosen"]
    assert told == ["one: 3 poses at the reference place; layout single."]
    first = dict(zip(POSE_KEYS, kept["poses"][0], strict=True))
    assert first["id"] == script.planned[0].id
    assert first["x_mm"] == script.planned[0].pose.x_mm


def script_of(tmp_path: Path, trial: str) -> LoadedScript:
    """A script of one trial."""
    path = tmp_path / "script.toml"
    path.write_text(f"{SCRIPT}{trial}\n", encoding="utf-8")
    return load_script(path)


GRID = "{ x_mm = [0, 10], y_mm = [0, 10], step_mm = [3, 1] }"
SCRIPT = """title = "t"
detectors = ["thesis"]
[bath]
set_point_c = 33.0
[[requirements]]
kind = "bath_in_band"
name = "bath"
band_k = 0.15
[[trials]]
name = "one"
situation = "s"
"""
SINGLE = 'layout = "single"\nset_up = "One teat."\n'
IDEAL = 'family = "ideal"\n'
AT_ENDS = 'family = "hot_body_at_ends"\n'


@pytest.mark.parametrize(
    ("trial", "message"),
    [
        (f"{SINGLE}pose = {{ x_mm = 1.0 }}\npose_deg = 3", "unknown key"),
        (f"{SINGLE}pose = {{ xmm = 1.0 }}", 'did you mean "x_mm"'),
        (f"{SINGLE}pose = {{ z_mm = -1.0 }}", "greater than or equal to 0"),
        (
            f"{SINGLE}pose = {{ x_mm = 1.0 }}\ndraw = {{ count = 3 }}",
            "has pose and draw; a trial has one of",
        ),
        (f"{SINGLE}grid = {GRID}", "spans 10 mm, which is no whole number of steps of 3"),
        (f"{SINGLE}grid = {GRID.replace('10', '1000').replace('3', '1')}", "at most 100000"),
        (f"{SINGLE}grid = {GRID.replace('0, 10', '10, 0', 1)}", "must be the smaller one"),
        (f'{SINGLE}approach = ["+x", "+x"]', "names a side twice"),
        (f'{SINGLE}approach = ["left"]', "is not allowed"),
        (f"{SINGLE}poses = []", "at least 1"),
        (f"{SINGLE}draw = {{ count = 0 }}", "greater than or equal to 1"),
        ('family = "overlaping"', 'did you mean "overlapping"'),
        (f'{IDEAL}layout = "table-5-1"', "both layout and family"),
        ('set_up = "x"', "has no layout, and no family"),
        ('layout = "table-5-1"', "set_up is missing"),
        (f"{IDEAL}member = -1", "greater than or equal to 0"),
    ],
)
def test_a_wrong_table_says_where(tmp_path: Path, trial: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        script_of(tmp_path, trial)
    assert message in str(caught.value)
    (fault,) = caught.value.faults
    assert 9 <= fault.line <= 15


def test_a_layout_may_lie_beside_the_script(tmp_path: Path) -> None:
    teat = '[[teats]]\nname = "LF"\nbase_mm = [1.0, 2.0]\n'
    (tmp_path / "mine.toml").write_text(f'about = "x"\n{teat}', encoding="utf-8")
    script = script_of(tmp_path, SINGLE.replace("single", "mine.toml"))
    assert script.planned[0].phantom.name == "mine"
    assert list(script.layout_files) == ["mine.toml"]
    (tmp_path / "bad.toml").write_text("about = 3\n", encoding="utf-8")
    for wrong, why in {
        "other.toml": "no such file",
        "../mine.toml": "of its own in the script's folder",
        "rig.toml": "of its own",
        "bad.toml": r"bad\.toml:1: about",
    }.items():
        with pytest.raises(ConfigError, match=why):
            script_of(tmp_path, SINGLE.replace("single", wrong))


def test_redrawn_trials_show_a_member_for_each_pose_and_others_one_for_all(tmp_path: Path) -> None:
    more = "member = 5\nredraw = true\nrepeats = 2\ndraw = { count = 3 }\n"
    loaded = script_of(tmp_path, f"{AT_ENDS}{more}")
    scenes = [one.scene for one in loaded.planned]
    assert scenes == [situation("hot_body_at_ends", seed) for seed in (5, 5, 6, 6, 7, 7)]
    assert [one.phantom for one in loaded.planned] == [scene.phantom for scene in scenes if scene]
    said = chosen(loaded.script.trials[0])
    assert "family hot_body_at_ends, members from 5 on, one for each pose" in said
    more = "member = 2\nposes = [{ x_mm = 0.0 }, { x_mm = 5.0 }]\n"
    same = script_of(tmp_path, f"{AT_ENDS}{more}")
    assert {one.scene for one in same.planned} == {situation("hot_body_at_ends", 2)}
    assert "member 2" in chosen(same.script.trials[0])


def test_the_operator_reads_what_stands_where(tmp_path: Path) -> None:
    (planned,) = script_of(tmp_path, AT_ENDS).planned
    asked = planned.arrangement("XY")
    found = situation("hot_body_at_ends", 0)
    assert asked.scene == found
    assert found.about in asked.instruction
    assert "warm arm at x" in asked.details
    assert f"length {found.phantom.teats[2].shape.length_mm:.1f} mm" in asked.details


@pytest.mark.slow
def test_the_emulated_operator_sets_the_whole_scene_up(tmp_path: Path) -> None:
    (planned,) = script_of(tmp_path, 'family = "low_contrast"\nmember = 3').planned
    found = situation("low_contrast", 3)
    with EmulatedRig(load_rig(find_rig(None)), VirtualClock(), seed=5) as twin:
        placed = twin.operator.ask(planned.arrangement("XY"))
        seen = twin.world.scene()
    for name in ("backdrop", "lighting", "teat_paint"):
        assert getattr(seen, name) == getattr(found, name)
    assert len(placed.visible) == 4
    assert np.ptp([teat.base_mm[0] for teat in seen.phantom.teats]) > 0.0


PAGE = (ROOT / "docs" / "trials.md").read_text(encoding="utf-8")
ELSEWHERE = {"title", "about", "source", "kind", "layout"}  # as in every script, or said in words


@pytest.mark.parametrize(
    "model", [Trial, PoseTable, Grid, DrawnPoses, PhantomFile, TeatTable, Envelope]
)
def test_every_key_is_there(model: type[BaseModel]) -> None:
    missing = [
        key
        for key in model.model_fields
        if key not in ELSEWHERE
        and not re.search(rf"[`\[ ,]{key}\b", PAGE)
        and f"\n{key} =" not in PAGE
    ]
    assert missing == []


def test_no_key_is_there_twice() -> None:
    keys = re.findall(r"^\| (`.+?`) \|", PAGE, re.MULTILINE)
    assert sorted(set(keys)) == sorted(keys)


def test_every_layout_that_ships_is_there() -> None:
    assert [name for name in layout_names() if f"`{name}`" not in PAGE] == []
