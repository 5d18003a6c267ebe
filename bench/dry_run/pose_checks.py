"""What would go wrong with a script on a rig, found without moving anything: reach, limits, views,
collisions.

Each pose is checked once, however often it is repeated. The stage's travel is an argument. What
can't be checked is reported. The emulated operator holds the stylus upright; a person may lean it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np

from bench.rig.loading import LoadedRig
from bench.rig.lock import RigInUseError, lock_path, locked
from bench.rig.opening import open_instruments
from bench.rig.urls import EMULATED
from bench.run.estimate import Forecast, carry_touches
from bench.scoring.errors import Floats
from bench.script.model import FIRST, LoadedScript
from bench.script.planned_trials import PlannedTrial, pose_text, shared
from bench.truth.stage_registration import around
from detector.geometry import Camera, Motion
from instruments.errors import InstrumentError
from instruments.microscribe.kinematics import OutOfReachError, inverse, surely_reached
from instruments.microscribe.unit import ArmIdentity, shipped_unit
from instruments.stage.settings import AxisLimits, StageSettings
from instruments.world.objects import make_object
from instruments.world.phantom import Phantom, PlatePose, spoken_name
from instruments.world.solids import clearance_mm

NamedCamera = tuple[str, Camera, Motion]  # name, lens, camera_from_world

MARGIN_PX = 4.0  # between a teat's rounded end and the picture's edge
PLAY_MM = 0.01  # two teats may touch
USUAL_ARM = "40937"  # the one that ships
KEYS = {"x_mm": "X", "y_mm": "Y", "z_mm": "Z", "a_deg": "A"}
STYLUS_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True)
class PoseFault:
    """One thing that is wrong with one pose: ``trial`` is its name."""

    trial: str
    kind: str
    text: str


@dataclass(frozen=True, slots=True)
class ScriptCheck:
    """What would go wrong in a run: ``findings`` by trial; ``gone_through``: trials that were done
    on emulators, with ``rendered`` frame sets and what the run ``recovered`` from, counted;
    ``unchecked``: what could not be looked at. ``needs``: time, disk and prompts, by what was
    ``measured`` of the rig (nothing: by what is assumed); ``room``: says that the disk is too full.
    """

    trials: int
    poses: int
    findings: tuple[PoseFault, ...]
    gone_through: int | None
    rendered: int
    recovered: Mapping[str, int]
    unchecked: tuple[str, ...]
    needs: Forecast | None
    measured: Mapping[str, float]
    room: str


def stage_settings(rig: LoadedRig) -> tuple[StageSettings | None, str]:
    """What the stage's controller says of itself; or None, and why it could not be asked."""
    if rig.rig.stage is None:
        return None, ""

    # opening its port resets most boards, which no running bench must see; a rig that never ran
    # gets no lock
    lock = lock_path(rig)
    try:
        with (
            locked(lock if lock and lock.exists() else None, "a dry run", lambda _: None),
            open_instruments(rig, ("stage",)) as opened,
        ):
            assert opened.stage  # noqa: S101 - it was asked for
            opened.stage.connect()
            return opened.stage.settings, ""
    except RigInUseError:
        return None, "another bench has the rig"
    except InstrumentError:
        return None, "its controller doesn't answer"


def dry_run(
    rig: LoadedRig,
    script: LoadedScript,
    travel: Mapping[str, AxisLimits] | None,
    why_no_travel: str = "its controller doesn't answer",
) -> tuple[tuple[PoseFault, ...], tuple[str, ...]]:
    """What is wrong with the poses, and what can't be checked (``travel`` None: unknown)."""
    distinct = {(one.name, one.side): one for one in script.planned}.values()
    # Left, right, and thermal where its lens and its place are calibrated
    c, right_from_world = rig.calibration, rig.calibration.world_from_right.inverse()
    left_from_world = c.right_from_left.inverse() @ right_from_world
    views = [("left", c.left, left_from_world), ("right", c.right, right_from_world)]
    if c.thermal.lens is not None and c.thermal_from_left is not None:
        views.append(("thermal", c.thermal.lens, c.thermal_from_left @ left_from_world))
    places = [(one.name, pose) for one in distinct for pose in (one.approach, one.pose) if pose]
    places += [(f"registration at {pose_text(pose)}", pose) for pose in registered_at(rig, script)]
    findings = (
        *(found for name, pose in places for found in _beyond(rig, name, pose, travel or {})),
        *(found for one in {o.name: o for o in distinct}.values() for found in _unseen(one, views)),
        *(found for one in distinct for found in _collisions(one)),
        *_out_of_reach(rig, script),
    )
    unchecked = {
        f"the stage's travel: {why_no_travel}": rig.rig.stage and travel is None,
        "the thermal picture: the calibration has no lens or place of the thermal camera": (
            len(views) < 3
        ),
        "this very arm's reach: that of an arm of the usual size was taken": (
            rig.arm_unit is None and rig.rig.arm.url != EMULATED
        ),
    }
    return findings, tuple(what for what, missing in unchecked.items() if missing)


def registered_at(rig: LoadedRig, script: LoadedScript) -> tuple[PlatePose, ...]:
    """Where the stage goes for the touches of a registration that the run makes itself."""
    truth, axes = script.script.truth, rig.rig.stage.axes if rig.rig.stage else ""
    if truth.mode != "carry" or truth.registration != FIRST:
        return ()
    named = tuple(PlatePose(x, y) for x, y in truth.registration_at_mm or ())
    return named or around(shared(one.pose, axes)[0] for one in script.planned)


def _beyond(
    rig: LoadedRig, name: str, pose: PlatePose, travel: Mapping[str, AxisLimits]
) -> Iterator[PoseFault]:
    """Axes of the stage that can't go where ``pose`` needs them."""
    stage = rig.rig.stage
    for key, value in stage.machine(shared(pose, stage.axes)[0]).items() if stage else ():
        limits = travel.get(KEYS[key])
        if limits is not None and not limits.hold(value):
            text = f"{pose_text(pose)} needs the stage's {KEYS[key]} axis at {value:g},"
            text += " which goes from"
            yield PoseFault(name, "limits", f"{text} {limits.low_mm:g} to {limits.high_mm:g}")


def _unseen(one: PlannedTrial, views: Sequence[NamedCamera]) -> Iterator[PoseFault]:
    """Teat ends whose rim, that of a ball, comes too near to the edge of a picture."""
    phantom = one.phantom.moved(one.pose)
    radii = np.array([teat.shape.radius_mm for teat in phantom.teats])
    for name, camera, camera_from_world in views:
        seen = camera_from_world.apply(phantom.ends_mm)
        pixels = camera.project(seen)
        sides = np.column_stack([pixels + 0.5, np.array(camera.image_size) - 0.5 - pixels])
        rooms_px = sides.min(axis=1) - radii * max(camera.fc) / seen[:, 2]  # nan: behind the camera
        for teat, room_px in enumerate(rooms_px):
            if not room_px >= MARGIN_PX:
                text = f"the end of {_name(phantom, teat)} isn't whole in the {name} picture:"
                lack = f"it lacks {MARGIN_PX - room_px:.0f} px to the edge"
                lack = "behind the camera" if np.isnan(room_px) else lack
                yield PoseFault(one.name, "view", f"{text} {lack}")


def _collisions(one: PlannedTrial) -> Iterator[PoseFault]:
    for pose in dict.fromkeys((one.approach or one.pose, one.pose)):
        phantom = one.phantom.moved(pose)
        teats = phantom.teat_hulls()
        names = [_name(phantom, teat) for teat in range(len(teats))]
        for i, j in combinations(range(len(teats)), 2):
            gap = min(clearance_mm(*pair) for pair in product(teats[i], teats[j]))
            if gap < -PLAY_MM:
                text = f"{names[i]} and {names[j]} stand {-gap:.1f} mm inside each other"
                yield PoseFault(one.name, "collision", text)
        solids = [(name, hull) for name, hulls in zip(names, teats, strict=True) for hull in hulls]
        # an udder has no flanges
        flanges = zip(names, phantom.flange_hulls(), strict=phantom.udder is None)
        solids += [(f"{name}'s flange", hull) for name, hull in flanges]
        solids += [("the udder", hull) for hull in phantom.udder_hulls()]
        # objects don't move with the plate
        things = [make_object(**table) for table in one.trial.objects]
        for number, thing in enumerate((*things, *(one.scene.objects if one.scene else ())), 1):
            gaps = [
                (clearance_mm(solid, hull), name) for name, solid in solids for hull in thing.hulls
            ]
            gap, part = min(gaps, default=(0.0, ""))
            if gap < -PLAY_MM:
                text = f"{part} stands {-gap:.1f} mm inside object {number} ({thing.name})"
                yield PoseFault(one.name, "collision", text)


def _out_of_reach(rig: LoadedRig, script: LoadedScript) -> Iterator[PoseFault]:
    """Teat ends that the arm can't reach where it has to."""
    planned, truth = script.planned, script.script.truth
    axes = rig.rig.stage.axes if rig.rig.stage else ""
    at: Sequence[int] = range(len(planned))
    to_touch: list[tuple[str, Phantom]] = []
    if truth.mode != "touch":
        at = carry_touches(planned, axes, truth.check_every)
        for pose in registered_at(rig, script):
            stands = planned[0].phantom.moved(shared(planned[0].pose, axes)[1].carried(pose))
            touched = replace(stands, teats=stands.teats[truth.registration_teat - 1 :][:1])
            to_touch.append((f"registration at {pose_text(pose)}", touched))
    distinct = {planned[index].name: planned[index] for index in at}
    to_touch += [(name, one.phantom.moved(one.pose)) for name, one in distinct.items()]
    unit, placed = rig.arm_unit or shipped_unit(USUAL_ARM), rig.rig.emulation.arm_placed
    frame = rig.frame.world_from_arm if rig.frame else Motion.from_vectors(placed.om, placed.T)
    arm_from_world, upright_only = frame.inverse(), rig.rig.operator.url == EMULATED
    up = arm_from_world.R @ STYLUS_UP
    ends = [arm_from_world.apply(phantom.ends_mm) for _, phantom in to_touch]
    sure = iter(surely_reached(unit.geometry(), np.vstack(ends), up, start=unit.home))
    for (name, phantom), there in zip(to_touch, ends, strict=True):
        for teat, end in enumerate(there):
            if not next(sure) and way_to(unit, end, up, upright_only=upright_only) is None:
                where = np.round(phantom.ends_mm[teat]).astype(int).tolist()
                text = f"the arm doesn't reach the end of {_name(phantom, teat)} at {where} mm"
                yield PoseFault(name, "reach", text)


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
    return spoken_name(teat + 1, phantom.teats[teat].name)
