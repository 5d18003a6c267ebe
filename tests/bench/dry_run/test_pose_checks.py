"""The look at each pose before a run: what ships is clean, each kind of trouble is found and named,
and nothing moves.
"""

from __future__ import annotations

from dataclasses import replace

import pytest

from bench.dry_run import pose_checks
from bench.dry_run.pose_checks import dry_run
from bench.rig.loading import LoadedRig, find_rig, load_rig
from bench.run.estimate import carry_touches
from bench.script.model import LoadedScript, find_script, load_script
from bench.script.phantom import Layout, PhantomFile, find_layout, load_layout
from bench.script.planned_trials import Trial, plan
from instruments.stage.settings import AxisLimits

TRAVEL = {"X": AxisLimits(-300.0, 0.0), "Y": AxisLimits(-275.0, 0.0), "Z": AxisLimits(-50.0, 0.0)}
HEAD = {"name": "t", "situation": "s", "layout": "table-5-1", "set_up": "Teats as in table 5.1."}


@pytest.fixture(scope="module")
def rig() -> LoadedRig:
    return load_rig(find_rig(None))


def script(**table: object) -> LoadedScript:
    """The six situations' script with this one trial in place of its own."""
    loaded = load_script(find_script(None))
    trial = Trial.model_validate({**HEAD, **table})
    changed = loaded.script.model_copy(update={"trials": (trial,)})
    layouts = {trial.layout: load_layout(find_layout(trial.layout))}
    planned = plan((trial,), layouts, repeats=1, seed=1, shuffled=False)
    return replace(loaded, script=changed, planned=planned)


def kinds(rig: LoadedRig, loaded: LoadedScript) -> dict[str, str]:
    return {
        finding.kind: f"{finding.trial}: {finding.text}"
        for finding in dry_run(rig, loaded, TRAVEL)[0]
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", ["six-situations", "plane-map", "repeatability", "random-udder"])
def test_what_ships_is_clean(rig: LoadedRig, name: str) -> None:
    assert dry_run(rig, load_script(find_script(name)), TRAVEL) == ((), ())


def test_an_arm_that_reaches_all_ends_is_asked_for_no_pose_alone(
    rig: LoadedRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which takes some milliseconds for each end."""
    monkeypatch.delattr(pose_checks, "inverse")
    assert dry_run(rig, load_script(find_script("plane-map")), TRAVEL) == ((), ())


ROD = ({"kind": "rod", "x_mm": -150.0, "y_mm": 284.0},)


@pytest.mark.parametrize(
    ("kind", "table", "text"),
    [
        (
            "limits",
            {"pose": {"x_mm": -160.0, "y_mm": 0.0}},
            "x -160 mm, y +0 mm needs the stage's X axis at -310, which goes from -300 to 0",
        ),
        (
            "reach",
            {"layout": "single", "pose": {"x_mm": -120.0, "y_mm": 130.0}},
            "the arm doesn't reach the end of right front (RF) at [-235, 492, 135] mm",
        ),
        (
            "collision",
            {"objects": ROD, "pose": {"x_mm": -35.0}},
            "right front (RF)'s flange stands 21.2 mm inside object 1 (rod)",
        ),
    ],
)
def test_trouble_is_named(rig: LoadedRig, kind: str, table: dict[str, object], text: str) -> None:
    assert kinds(rig, script(**table))[kind] == f"t: {text}"
    table.pop("pose")
    assert kind not in kinds(rig, script(**table)), "it is the pose that is wrong"


def test_an_approach_beyond_the_travel_though_the_pose_is_not(rig: LoadedRig) -> None:
    assert "limits" not in kinds(rig, script(pose={"y_mm": 135.0}, layout="single"))
    found = kinds(rig, script(pose={"y_mm": 135.0}, layout="single", approach=("-y", "+y")))
    assert "Y axis at 7.5" in found["limits"]


def test_a_registration_that_goes_beyond_the_travel(rig: LoadedRig) -> None:
    loaded = load_script(find_script("repeatability"))
    truth = loaded.script.truth.model_copy(
        update={"registration_at_mm": ((-150.0, 0.0), (151.0, 0.0), (0.0, 90.0))}
    )
    wide = replace(loaded, script=loaded.script.model_copy(update={"truth": truth}))
    found = [finding for finding in dry_run(rig, wide, TRAVEL)[0] if finding.kind == "limits"]
    assert [finding.trial for finding in found] == ["registration at x +151 mm, y +0 mm"]


def test_a_teat_that_leaves_the_thermal_picture(rig: LoadedRig) -> None:
    found = kinds(rig, script(pose={"x_mm": -40.0}))
    assert found["view"].startswith(
        "t: the end of left front (LF) isn't whole in the thermal picture: it lacks "
    )
    assert "view" not in kinds(rig, script())


def test_teats_that_stand_in_each_other_are_found_even_where_no_file_says_so(
    rig: LoadedRig,
) -> None:
    loaded = script()
    first = loaded.planned[0]
    near = replace(first.phantom.teats[1], base_mm=(-120.0, 284.2))
    crowded = replace(first, phantom=replace(first.phantom, teats=(first.phantom.teats[0], near)))
    found = kinds(rig, replace(loaded, planned=(crowded,)))
    assert (
        found["collision"]
        == "t: right front (RF) and right rear (RR) stand 12.2 mm inside each other"
    )


def test_what_cannot_be_checked_is_said(rig: LoadedRig) -> None:
    blind = replace(rig, made_calibration=replace(rig.calibration, thermal_from_left=None))
    findings, unchecked = dry_run(blind, script(pose={"x_mm": -160.0, "y_mm": 0.0}), None)
    assert [text.split(":")[0] for text in unchecked] == [
        "the stage's travel",
        "the thermal picture",
    ]
    assert "limits" not in {finding.kind for finding in findings}


def test_a_real_arm_may_be_held_at_a_slant(rig: LoadedRig) -> None:
    """At 462 mm the upright stylus is beyond the wrist's reach, and a person would lean it."""
    console = rig.rig.operator.model_copy(update={"url": "console:"})
    by_hand = replace(rig, rig=rig.rig.model_copy(update={"operator": console}))
    far = script(layout="single", pose={"x_mm": -145.0, "y_mm": 100.0})
    assert "reach" in kinds(rig, far)
    assert "reach" not in kinds(by_hand, far)


def test_a_carried_truth_is_touched_at_the_start_at_checks_and_at_the_end() -> None:
    layouts = {
        "single": Layout("single", PhantomFile.model_validate(SINGLE)),
        "other": Layout("other", PhantomFile.model_validate(OTHER)),
    }
    grid = {"x_mm": (0.0, 90.0), "y_mm": (0.0, 0.0), "step_mm": (10.0, 10.0)}
    row = Trial.model_validate({**HEAD, "layout": "single", "grid": grid})
    other = row.model_copy(update={"name": "u", "layout": "other"})
    planned = plan((row,), layouts, repeats=1, seed=1, shuffled=False)
    assert carry_touches(planned, "XY", 0) == [0, 9]
    assert carry_touches(planned, "XY", 4) == [0, 4, 8, 9]
    assert carry_touches(planned, "", 4) == list(range(10)), "moved by hand, nothing is carried"
    both = plan((row, other), layouts, repeats=1, seed=1, shuffled=False)
    assert carry_touches(both, "XY", 0) == [0, 9, 10, 19]


SINGLE = {"about": "x", "teats": [{"name": "LF", "base_mm": (-115.0, 300.0)}]}
OTHER = {"about": "x", "teats": [{"name": "RF", "base_mm": (-100.0, 300.0)}]}
