"""The twin that a rehearsal is made on: as like the real rig as is known."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from bench.dry_run.rehearsal import NoTwinError, rehearse, to_render, twin_of
from bench.rig.arm_files import TableFrame, TouchedPoint
from bench.rig.emulated_rig import EmulatedRig
from bench.rig.loading import RIGS, LoadedRig, find_rig, load_rig
from bench.rig.opening import open_instruments
from bench.run.estimate import KINDS, spent_of
from bench.script.model import LoadedScript, find_script, load_script
from bench.truth.registration import Registration, StageAccuracy, Station
from detector.geometry import Motion
from instruments.bath.profile import load_profile
from instruments.clock import VirtualClock
from instruments.stage.settings import StageSettings
from tests.bench.operated_runs import SCRIPT

MADE = datetime.fromisoformat("2026-11-01T12:00:00")
SINGLE = SCRIPT.replace("table-5-1", "single")
CARRY = SINGLE.replace("[bath]", '[truth]\nmode = "carry"\nregistration = "first"\n\n[bath]')
TOLD = StageSettings(
    travel_mm=(620.0, 400.0, 90.0),
    rate_mm_min=(6000.0, 6000.0, 600.0),
    accel_mm_s2=(500.0, 400.0, 50.0),
    steps_per_mm=(80.0, 80.0, 400.0),
    soft_limits=True,
    hard_limits=True,
    homing=True,
    homing_seek_mm_min=2000.0,
    homing_feed_mm_min=120.0,
    pull_off_mm=2.0,
)


@pytest.fixture(scope="module")
def lab() -> LoadedRig:
    return load_rig(find_rig("lab.example"))


def script(folder: Path, text: str = SCRIPT) -> LoadedScript:
    (folder / "script.toml").write_text(text, encoding="utf-8")
    return load_script(folder / "script.toml")


def test_every_address_is_an_emulators_and_nothing_else_is_changed(
    lab: LoadedRig, tmp_path: Path
) -> None:
    bath = lab.rig.bath.model_copy(update={"pump_url": "COM9"})
    relay = replace(lab, rig=lab.rig.model_copy(update={"bath": bath}))
    twin = twin_of(relay, script(tmp_path), TOLD).rig
    assert set(twin.emulated) == {"arm", "bath", "stage", "cameras", "operator"}
    assert twin.bath.pump_url == "emulator:"
    assert twin.limits == lab.rig.limits
    assert twin.arm.model_copy(update={"url": lab.rig.arm.url}) == lab.rig.arm
    assert twin.cameras.settle_s == lab.rig.cameras.settle_s
    assert twin.emulation.ambient_c == twin.emulation.bath_start_c == lab.rig.bath.room_c


def test_a_bath_of_a_lab_s_own_lines_is_stood_in_for(lab: LoadedRig, tmp_path: Path) -> None:
    own = load_profile("huber-pb").model_copy(update={"family": "OUR OWN"})
    assert (
        twin_of(replace(lab, profile=own), script(tmp_path), TOLD).profile.family
        == "JULABO circulator"
    )
    shipped = load_profile("huber-pb")
    twin = twin_of(replace(lab, profile=shipped), script(tmp_path), TOLD)
    assert twin.profile == shipped


def test_the_emulated_stage_is_set_as_the_controller_reported(
    lab: LoadedRig, tmp_path: Path
) -> None:
    settings = twin_of(lab, script(tmp_path), TOLD).rig.emulation.stage.settings
    wanted = {130: 620.0, 131: 400.0, 132: 90.0, 24: 120.0, 25: 2000.0, 27: 2.0}
    wanted |= {100: 80.0, 111: 6000.0, 120: 500.0}
    assert {number: settings[number] for number in wanted} == wanted


@pytest.mark.slow
@pytest.mark.parametrize(
    ("dialect", "axes", "spoken"),
    [("grbl", "XY", "fluidnc"), ("grbl", "XYA", "fluidnc"), ("marlin", "XYZ", "marlin")],
)
def test_an_emulated_stage_has_the_machine_space_of_the_real_one(
    lab: LoadedRig, tmp_path: Path, dialect: str, axes: str, spoken: str
) -> None:
    n = 4 if "A" in axes else 3
    told = replace(
        TOLD,
        travel_mm=(620.0, 400.0, 90.0, 360.0)[:n],
        rate_mm_min=(6000.0, 6000.0, 600.0, 3600.0)[:n],
        accel_mm_s2=(500.0, 400.0, 50.0, 360.0)[:n],
        steps_per_mm=(80.0, 80.0, 400.0, 100.0)[:n],
        low_mm=(5.0, -20.0, 0.0, -180.0)[:n],
        pull_off_mm=0.0,
    )
    update = {"axes": axes, "dialect": dialect, "reference_mm": (150.0, 100.0)}
    table = lab.rig.stage and lab.rig.stage.model_copy(update=update)
    real = replace(lab, rig=lab.rig.model_copy(update={"stage": table}))
    twin = twin_of(real, script(tmp_path), told)
    clock = VirtualClock()
    with (
        EmulatedRig(twin, clock, seed=1) as emulated,
        open_instruments(twin, ("stage",), clock, twin=emulated) as devices,
    ):
        assert devices.stage
        devices.stage.connect()
        assert devices.stage.identity.dialect.lower() == spoken
        assert devices.stage.limits == {axis: told.limits[axis] for axis in devices.stage.limits}
        devices.stage.home()
        devices.stage.move_to(150.0, 100.0)


def test_an_unknown_travel_is_far_enough(lab: LoadedRig, tmp_path: Path) -> None:
    wide = script(tmp_path, SCRIPT.replace("x_mm = 12.0", "x_mm = -412.0"))
    settings = twin_of(lab, wide, None).rig.emulation.stage.settings
    assert settings == {130: 150.0 + 412.0 + 10.0, 131: 275.0}
    table = lab.rig.stage and lab.rig.stage.model_copy(update={"axes": "XYA"})
    turning = replace(lab, rig=lab.rig.model_copy(update={"stage": table}))
    stage = twin_of(turning, wide, None).rig.emulation.stage
    assert (stage.dialect, set(stage.settings)) == ("grblHAL", {130, 131, 133})


def test_the_arm_stands_where_the_frame_says_under_its_own_number(
    lab: LoadedRig, tmp_path: Path
) -> None:
    motion = Motion.from_vectors((0.0, 0.0, 0.3), (-40.0, 25.0, 5.0))
    touched = [
        tuple(motion.inverse().apply(np.array(at)).tolist())
        for at in ((0.0, 0.0, 0.0), (200.0, 0.0, 0.0), (0.0, 200.0, 0.0))
    ]
    frame = TableFrame.from_touches(
        MADE, "12345", [TouchedPoint(f"p{i}", at) for i, at in enumerate(touched)]
    )
    twin = twin_of(replace(lab, frame=frame), script(tmp_path), None)
    assert np.allclose(twin.rig.emulation.arm_placed.om, (0.0, 0.0, 0.3))
    assert np.allclose(twin.rig.emulation.arm_placed.T, (-40.0, 25.0, 5.0))
    assert twin.frame is frame, "the ends are touched through it"
    assert twin.arm_unit
    assert twin.arm_unit.names.serial_number == "12345"


@pytest.mark.weekly
def test_a_registration_of_a_turned_stage_holds_on_the_twin(lab: LoadedRig, tmp_path: Path) -> None:
    turned = Motion.from_vectors((0.0, 0.0, 0.02), (30.0, 500.0, 135.0))
    places = [(x, y, 0.0) for x in (-250.0, -50.0) for y in (-230.0, -40.0)]
    stations = [Station(at, tuple(turned.apply(np.array(at)).tolist()), 0.2) for at in places]
    registration = Registration(
        MADE,
        "40937",
        "Grbl",
        1,
        tuple(stations),
        StageAccuracy(scale_u=5e-4, squareness_u_rad=5e-4, repeatability_mm=0.02),
    )
    flat = script(tmp_path, CARRY.replace(", z_mm = 6.0, yaw_deg = 4.0", ""))
    rehearsal = rehearse(lab, replace(flat, registration=registration), ())
    assert rehearsal.findings == (), "check touches find the ends where the stage carried them"
    assert rehearsal.trials == 3


@pytest.mark.weekly
def test_a_person_leans_the_stylus_where_an_emulated_operator_would_not_get_to(
    lab: LoadedRig, tmp_path: Path
) -> None:
    far = SINGLE.replace("{ x_mm = 12.0, y_mm = -8.0 }", "{ x_mm = -145.0, y_mm = 100.0 }")
    assert rehearse(lab, script(tmp_path, far), ()).findings == ()
    upright = rehearse(load_rig(find_rig(None)), script(tmp_path, far), ())
    assert {(one.trial, one.kind) for one in upright.findings} == {("place-1", "reach")}


@pytest.mark.slow
def test_a_registration_beyond_the_travel_is_met_before_the_trials(
    lab: LoadedRig, tmp_path: Path
) -> None:
    text = CARRY.replace(
        'registration = "first"',
        'registration = "first"\nregistration_at_mm = [[-200.0, 0.0], [50.0, 0.0], [0.0, 80.0]]',
    )
    narrow = replace(TOLD, travel_mm=(300.0, 275.0, 50.0))
    rehearsal = rehearse(lab, script(tmp_path, text), (), stage=narrow)
    assert [(one.trial, one.kind) for one in rehearsal.findings] == [("before the trials", "fault")]
    assert "-350" in rehearsal.findings[0].text


def test_a_rig_that_nothing_can_be_made_like_is_said(lab: LoadedRig, tmp_path: Path) -> None:
    text = (RIGS / "calibration.toml").read_text(encoding="utf-8")
    (tmp_path / "flat.toml").write_text(text.replace("[world]", "[nowhere]"), encoding="utf-8")
    with pytest.raises(NoTwinError, match="world"):
        rehearse(replace(lab, calibration_path=tmp_path / "flat.toml"), script(tmp_path), ())


def test_which_trials_are_rendered() -> None:
    plane = load_script(find_script("plane-map")).planned
    chosen = to_render(plane)
    assert len(chosen) == 12
    assert plane[0].id in chosen
    numbers = sorted(one.number for one in plane if one.id in chosen)
    assert max(b - a for a, b in pairwise(numbers)) <= 2 * len(plane) / 12, "all over the plane"
    six = load_script(find_script(None)).planned
    assert to_render(six) == {one.id for one in six if one.repeat == 1}
    assert to_render(six, most=2) == {one.id for one in six[:6] if one.repeat == 1}


def test_every_second_is_one_kinds() -> None:
    steps = [
        ("event", "run state", "preparing"),
        ("asked", "check point", ""),
        ("asked", "", ""),
        ("asked", "release", ""),
        ("event", "run state", "settling"),
        ("event", "run state", "running"),
        ("asked", "set up", ""),
        ("asked", "", ""),
        ("event", "run state", "settling"),
        ("event", "run state", "running"),
        ("event", "run state", "safing"),
        ("doing", None, "nothing new"),
    ]
    lines = [
        {"t_s": float(t_s), "what": what, "kind": kind, "text": text}
        for t_s, (what, kind, text) in enumerate(steps, 1)
    ]
    assert spent_of(lines) == {
        **dict.fromkeys(KINDS, 0.0),
        "preparing": 3.0,
        "touches": 2.0,
        "settling": 2.0,
        "moves": 1.0,
        "set-ups": 1.0,
        "captures": 2.0,
        "going to safe": 1.0,
    }
    assert spent_of(lines, first_settling=True)["settling"] == 1.0
    assert sum(spent_of(lines).values()) == len(steps)
