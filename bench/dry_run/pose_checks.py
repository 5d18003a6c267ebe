"""What would go wrong with a script on a rig, found without moving anything: reach, limits, views,
collisions.

Each pose is looked at once, however often it is repeated. Pure: the stage's travel comes as an
argument, from whoever asked the controller. What can't be checked is said, not passed over. The
emulated operator holds the stylus upright; a person may lean it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from bench.rig.loading import LoadedRig
from bench.rig.urls import EMULATED
from bench.run.estimate import carry_touches
from bench.script.model import FIRST, LoadedScript
from bench.script.planned_trials import PlannedTrial, shared, told
from bench.truth.stage_registration import around
from detector.calibration import Calibration
from detector.geometry import Camera, Motion
from instruments.microscribe.kinematics import OutOfReachError, inverse
from instruments.microscribe.unit import ArmIdentity, shipped_unit
from instruments.stage.settings import AxisLimits
from instruments.world.objects import make_object
from instruments.world.phantom import Phantom, PlatePose
from instruments.world.solids import clearance_mm


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One camera: its name, its lens, and where it stands."""

    name: str
    camera: Camera
    camera_from_world: Motion

    def room_px(self, points_mm: Floats, radii_mm: Floats) -> Floats:
        """(n,) px from the rim of balls at ``points_mm`` (n, 3), world frame, to the picture's
        nearest edge; negative where a rim is beyond it, not-a-number behind the camera.
        """
        seen = self.camera_from_world.apply(points_mm)
        pixels = self.camera.project(seen)
        rim = radii_mm * max(self.camera.fc) / seen[:, 2]
        sides = np.column_stack([pixels + 0.5, np.array(self.camera.image_size) - 0.5 - pixels])
        return np.asarray(sides.min(axis=1) - rim)


def _views_of(calibration: Calibration) -> tuple[View, ...]:
    """Left, right, and thermal where its lens and its place are calibrated."""
    c, right_from_world = calibration, calibration.world_from_right.inverse()
    left_from_world = c.right_from_left.inverse() @ right_from_world
    pair = (View("left", c.left, left_from_world), View("right", c.right, right_from_world))
    if c.thermal.lens is None or c.thermal_from_left is None:
        return pair
    return (*pair, View("thermal", c.thermal.lens, c.thermal_from_left @ left_from_world))


MARGIN_PX = 4.0  # between a teat's rounded end and the picture's edge
PLAY_MM = 0.01  # two teats may touch
USUAL_ARM = "40937"  # the one that ships
KEYS = {"x_mm": "X", "y_mm": "Y", "z_mm": "Z", "a_deg": "A"}
STYLUS_UP = np.array([0.0, 0.0, 1.0])

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is wrong with one pose: ``trial`` is its name."""

    trial: str
    kind: str
    text: str


@dataclass(frozen=True, slots=True)
class DryRun:
    """What was found, how many poses were looked at, and what couldn't be checked."""

    poses: int
    findings: tuple[Finding, ...]
    unchecked: tuple[str, ...]


def dry_run(
    rig: LoadedRig,
    script: LoadedScript,
    travel: Mapping[str, AxisLimits] | None,
    why_no_travel: str = "its controller doesn't answer",
) -> DryRun:
    """Look at each pose of ``script``. ``travel`` is the stage's, in machine coordinates, None
    where nobody could ask, and why.
    """
    distinct = list({(one.name, one.side): one for one in script.planned}.values())
    poses = list({one.name: one for one in distinct}.values())
    views, to_touch = _views_of(rig.calibration), _touched(rig, script)
    places = [(one.name, pose) for one in distinct for pose in (one.approach, one.pose) if pose]
    places += [(f"registration at {told(pose)}", pose) for pose in registered_at(rig, script)]
    findings = (
        *(found for name, pose in places for found in _beyond(rig, name, pose, travel)),
        *(found for one in poses for found in _unseen(one, views)),
        *(found for one in distinct for found in _collisions(one)),
        *(found for name, phantom in to_touch for found in _out_of_reach(rig, name, phantom)),
    )
    unchecked = _unchecked(rig, views, why_no_travel if travel is None else None)
    return DryRun(len(poses), findings, tuple(unchecked))


def _touched(rig: LoadedRig, script: LoadedScript) -> Iterator[tuple[str, Phantom]]:
    """The phantoms, as they stand, whose ends the arm has to reach, and what for."""
    planned, truth = script.planned, script.script.truth
    if truth.mode == "touch":
        yield from {one.name: (one.name, one.phantom.moved(one.pose)) for one in planned}.values()
        return
    axes, first = rig.rig.stage.axes if rig.rig.stage else "", planned[0]
    for pose in registered_at(rig, script):
        stands = first.phantom.moved(shared(first.pose, axes)[1].carried(pose))
        teat = stands.teats[truth.registration_teat - 1 :][:1]
        yield f"registration at {told(pose)}", replace(stands, teats=teat)
    for index in carry_touches(planned, axes, truth.check_every):
        yield planned[index].name, planned[index].phantom.moved(planned[index].pose)


def registered_at(rig: LoadedRig, script: LoadedScript) -> tuple[PlatePose, ...]:
    """Where the stage goes for the touches of a registration that the run makes itself."""
    truth, axes = script.script.truth, rig.rig.stage.axes if rig.rig.stage else ""
    if truth.mode != "carry" or truth.registration != FIRST:
        return ()
    named = tuple(PlatePose(x, y) for x, y in truth.registration_at_mm or ())
    return named or around(shared(one.pose, axes)[0] for one in script.planned)


def _unchecked(rig: LoadedRig, views: Sequence[View], why_no_travel: str | None) -> Iterator[str]:
    if rig.rig.stage and why_no_travel:
        yield f"the stage's travel: {why_no_travel}"
    if len(views) < 3:
        yield "the thermal picture: the calibration has no lens or place of the thermal camera"
    if rig.arm_unit is None and rig.rig.arm.url != EMULATED:
        yield "this very arm's reach: that of an arm of the usual size was taken"


def _beyond(
    rig: LoadedRig, name: str, pose: PlatePose, travel: Mapping[str, AxisLimits] | None
) -> Iterator[Finding]:
    """Axes of the stage that can't go where ``pose`` needs them."""
    stage = rig.rig.stage
    if stage is None or travel is None:
        return
    for key, value in stage.machine(shared(pose, stage.axes)[0]).items():
        limits = travel.get(KEYS[key])
        if limits is not None and not limits.hold(value):
            text = f"{told(pose)} needs the stage's {KEYS[key]} axis at {value:g}, which goes from"
            yield Finding(name, "limits", f"{text} {limits.low_mm:g} to {limits.high_mm:g}")


def _unseen(one: PlannedTrial, views: Sequence[View]) -> Iterator[Finding]:
    phantom = one.phantom.moved(one.pose)
    radii = np.array([teat.shape.radius_mm for teat in phantom.teats])
    for view in views:
        for teat, room_px in enumerate(view.room_px(phantom.ends_mm, radii)):
            if not room_px >= MARGIN_PX:
                text = f"the end of {_name(phantom, teat)} isn't whole in the {view.name} picture:"
                lack = f"it lacks {MARGIN_PX - room_px:.0f} px to the edge"
                lack = "behind the camera" if np.isnan(room_px) else lack
                yield Finding(one.name, "view", f"{text} {lack}")


def _collisions(one: PlannedTrial) -> Iterator[Finding]:
    for pose in dict.fromkeys((one.approach or one.pose, one.pose)):
        phantom = one.phantom.moved(pose)
        teats = phantom.teat_hulls()
        solids, names = (
            (*teats, *phantom.flange_hulls()),
            [_name(phantom, i) for i in range(len(teats))],
        )
        for i, j in combinations(range(len(teats)), 2):
            if (gap := clearance_mm(teats[i], teats[j])) < -PLAY_MM:
                text = f"{names[i]} and {names[j]} stand {-gap:.1f} mm inside each other"
                yield Finding(one.name, "collision", text)
        # objects don't move with the plate
        things = [make_object(**table) for table in one.trial.objects]
        for number, thing in enumerate((*things, *(one.scene.objects if one.scene else ())), 1):
            gaps = [
                min((clearance_mm(solid, hull) for hull in thing.hulls), default=np.inf)
                for solid in solids
            ]
            worst = int(np.argmin(gaps)) if gaps else 0
            if gaps and gaps[worst] < -PLAY_MM:
                part = (
                    names[worst] if worst < len(names) else f"{names[worst % len(names)]}'s flange"
                )
                text = f"{part} stands {-gaps[worst]:.1f} mm inside object {number} ({thing.name})"
                yield Finding(one.name, "collision", text)


def _out_of_reach(rig: LoadedRig, name: str, phantom: Phantom) -> Iterator[Finding]:
    """Teat ends that the arm can't reach where it has to."""
    unit, placed = rig.arm_unit or shipped_unit(USUAL_ARM), rig.rig.emulation.arm_placed
    frame = rig.frame.world_from_arm if rig.frame else Motion.from_vectors(placed.om, placed.T)
    arm_from_world, upright_only = frame.inverse(), rig.rig.operator.url == EMULATED
    up = arm_from_world.R @ STYLUS_UP
    for teat, end in enumerate(arm_from_world.apply(phantom.ends_mm)):
        if way_to(unit, end, up, upright_only=upright_only) is None:
            where = np.round(phantom.ends_mm[teat]).astype(int).tolist()
            text = f"the arm doesn't reach the end of {_name(phantom, teat)} at {where} mm"
            yield Finding(name, "reach", text)


def way_to(
    unit: ArmIdentity, point_mm: Floats, stylus: Floats, *, upright_only: bool
) -> Floats | None:
    """The stylus's direction (3,) in which the arm can hold its tip at ``point_mm`` (3,), arm's
    frame: ``stylus``, or any other unless ``upright_only``; None where it can't get there.
    """
    geometry = unit.geometry()
    for direction in (stylus,) if upright_only else (stylus, None):
        try:
            counts = inverse(geometry, point_mm, direction, start=unit.home)
        except OutOfReachError:
            continue
        return stylus if direction is not None else np.asarray(geometry.forward(counts)[1][0])
    return None


def _name(phantom: Phantom, teat: int) -> str:
    """``teat RF``, or by number (from 1) where it has no name."""
    return f"teat {phantom.teats[teat].name or teat + 1}"
