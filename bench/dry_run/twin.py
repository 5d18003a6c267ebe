"""The emulated twin of a rig: the same tables with emulators at every address, in a world that is
as far like the lab as anybody knows.

What is known: the stage's settings as its controller tells them, the table frame, how a
registration lies, the room's temperature, the bath's family. A rig that is emulated already is its
own twin. Pure; opens nothing.
"""

from __future__ import annotations

from dataclasses import replace
from math import atan2

import numpy as np

from bench.dry_run.pose_checks import USUAL_ARM, registered_at
from bench.rig.emulation_model import EmulatedStage, Emulation, Placed
from bench.rig.loading import LoadedRig
from bench.rig.model import Cameras, FocusTable, Stage
from bench.rig.urls import EMULATED
from bench.script.model import LoadedScript
from bench.script.planned_trials import shared
from instruments.microscribe.unit import ArmIdentity, shipped_unit
from instruments.stage.emulator.store import DEFAULTS, ROTARY_DEFAULTS
from instruments.stage.protocol import AXES
from instruments.stage.settings import StageSettings

ROOM_MM = 10.0  # beyond the furthest place, where nobody knows a stage's travel


def twin_of(rig: LoadedRig, script: LoadedScript, stage: StageSettings | None) -> LoadedRig:
    """``rig`` with an emulator at each address; ``stage`` is what its controller says, None where
    it has none or nobody could ask.
    """
    r = rig.rig
    cameras = Cameras(url=EMULATED).model_copy(
        update=r.cameras.model_dump(include={"settle_s", "max_skew_s", "retries", "retry_s"})
    )
    cameras = cameras.model_copy(update={"checks": r.cameras.checks})
    if r.emulated:
        return replace(
            rig,
            rig=r.model_copy(
                update={
                    "cameras": cameras,
                    "operator": r.operator.model_copy(update={"url": EMULATED}),
                }
            ),
        )
    # how sharp the real cameras are, the emulated ones can't tell
    checks = r.cameras.checks.model_copy(update={"focus_px": FocusTable()})
    tables = {
        "operator": r.operator.model_copy(update={"url": EMULATED}),
        "arm": r.arm.model_copy(update={"url": EMULATED}),
        "bath": r.bath.model_copy(
            update={"url": EMULATED, "pump_url": EMULATED if r.bath.pump_url else ""}
        ),
        "stage": r.stage.model_copy(update={"url": EMULATED}) if r.stage else None,
        "cameras": cameras.model_copy(update={"checks": checks}),
        "emulation": _world(rig, script, stage),
    }
    return replace(rig, rig=r.model_copy(update=tables), arm_unit=_arm(rig, script))


def _world(rig: LoadedRig, script: LoadedScript, stage: StageSettings | None) -> Emulation:
    """Without what is to go wrong: in the lab nobody plans that."""
    room_c = max(0.0, rig.rig.bath.room_c)
    update: dict[str, object] = {
        "ambient_c": room_c,
        "bath_start_c": room_c,
        "hand_error_mm": 0.0,
        "faults": (),
        "mistakes": (),
    }
    if rig.frame is not None:
        motion = rig.frame.world_from_arm
        update["arm_placed"] = Placed().model_copy(
            update={"om": tuple(motion.om.tolist()), "T": tuple(motion.T.tolist())}
        )
    if rig.rig.stage is not None:
        update["stage"] = _stage(rig, rig.rig.stage, script, stage)
    return rig.rig.emulation.model_copy(update=update)


def _stage(
    rig: LoadedRig, table: Stage, script: LoadedScript, told: StageSettings | None
) -> EmulatedStage:
    dialect = "grblHAL" if "A" in table.axes else "grbl"
    turned = script.registration.world_from_stage.R if script.registration else np.eye(3)
    settings = _far_enough(rig, table, script) if told is None else _as_told(told)
    yaw_rad = atan2(turned[1, 0], turned[0, 0])
    return EmulatedStage().model_copy(
        update={"dialect": dialect, "settings": settings, "yaw_rad": yaw_rad}
    )


def _as_told(told: StageSettings) -> dict[int, float]:
    each = {
        100: told.steps_per_mm,
        110: told.rate_mm_min,
        120: told.accel_mm_s2,
        130: told.travel_mm,
    }
    settings = {
        first + axis: value for first, values in each.items() for axis, value in enumerate(values)
    }
    return settings | {
        24: told.homing_feed_mm_min,
        25: told.homing_seek_mm_min,
        27: told.pull_off_mm,
    }


def _far_enough(rig: LoadedRig, table: Stage, script: LoadedScript) -> dict[int, float]:
    """Travel that no place of the script exceeds, so that what nobody knows isn't found wanting."""
    usual = DEFAULTS | ROTARY_DEFAULTS
    poses = [
        pose for one in script.planned for pose in (one.approach, one.pose) if pose is not None
    ]
    sent = [shared(pose, table.axes)[0] for pose in (*poses, *registered_at(rig, script))]
    places = [tuple(table.machine(pose).values()) for pose in sent]
    numbers = [130 + AXES.index(axis) for axis in table.axes]
    return {
        number: max(usual[number], ROOM_MM - min(values))
        for number, values in zip(numbers, zip(*places, strict=True), strict=True)
    }


def _arm(rig: LoadedRig, script: LoadedScript) -> ArmIdentity:
    """Of the usual size; under the serial number that frame and registration are of, or the twin
    would be another arm.
    """
    unit = rig.arm_unit or shipped_unit(USUAL_ARM)
    made_with = rig.frame or script.registration
    return (
        replace(unit, names=replace(unit.names, serial_number=made_with.serial_number))
        if made_with
        else unit
    )
