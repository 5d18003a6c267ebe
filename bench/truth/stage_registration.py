"""Makes a stage's registration: has one teat end touched at several stage positions, as
read back.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from math import hypot

import numpy as np

from bench.rig.model import StageTable
from bench.truth.registration import Registration, StageAccuracy, Station
from bench.truth.touching import Ends, EndTouches, Toucher, end_u_mm
from bench.truth.uncertainty import Triple, triple
from instruments.clock import wall_time
from instruments.drivers.protocols import Stage
from instruments.errors import DeviceError
from instruments.operators.operator import OperatorAbort, OperatorRepeat, OperatorSkip
from instruments.stage.protocol import HOME_AGAIN
from instruments.world.phantom import Phantom, PlatePose


def ends_of(phantom: Phantom, *, known: bool = True) -> Ends:
    """The ends of a phantom where it is expected to stand."""
    return Ends(phantom.ends_mm, phantom.axes, known, phantom.called)


def stands_at(stage: Stage) -> Triple:
    """The stage's position as read back, machine mm. Raises DeviceError where it is lost."""
    place = np.asarray(stage.position(), dtype=np.float64)
    if not stage.homed:
        raise DeviceError(stage.who, "its position is lost", hint=HOME_AGAIN)
    return triple(place[:3])


def around(poses: Iterable[PlatePose], least_mm: float = 150.0) -> tuple[PlatePose, ...]:
    """Corners and middle of the box of ``poses``, at least ``least_mm`` wide."""
    at = np.array([(pose.x_mm, pose.y_mm) for pose in poses], dtype=np.float64)
    low, high = at.min(axis=0), at.max(axis=0)
    short = np.maximum(least_mm - (high - low), 0.0)
    (x0, y0), (x1, y1) = low - short / 2, high + short / 2
    corners = ((x0, y0), (x1, y0), (x1, y1), (x0, y1), ((x0 + x1) / 2, (y0 + y1) / 2))
    return tuple(PlatePose(float(x), float(y)) for x, y in corners)


@dataclass(slots=True)
class PartialRegistration:
    """What a registration has so far: its stations, and the touches of the next one."""

    stations: list[Station] = field(default_factory=list)
    taken: EndTouches = field(default_factory=list)


def register(
    stage: Stage,
    settings: StageTable,
    toucher: Toucher,
    so_far: PartialRegistration,
    phantom: Phantom,
    poses: Sequence[PlatePose],
    *,
    teat: int,
    report: Callable[[str], None],
) -> Registration:
    """Touch ``teat`` of ``phantom`` (as at its reference place) at each of ``poses``. ``so_far``
    gets what is touched; after the loss of an instrument, what is in it is not touched again.
    Raises RegistrationError, and as stage, operator and arm do.
    """
    stations, made = so_far.stations, wall_time().replace(microsecond=0)
    # of the mean of one end's touches
    u_mm = hypot(end_u_mm(toucher.arm, toucher.each), settings.repeatability_mm)
    for number, pose in list(enumerate(poses, 1))[len(stations) :]:
        there = replace(pose, yaw_rad=phantom.pose.yaw_rad)
        report(f"registering the stage: position {number} of {len(poses)}")
        stage.move_to(**settings.machine(there), feed_mm_min=settings.feed_mm_per_min)
        ends = ends_of(phantom.moved(there), known=False)
        try:
            point, _ = toucher.touch_one(teat, ends, so_far.taken)
        except (OperatorSkip, OperatorRepeat) as wish:  # of a trial, and there is none yet
            why = f"position {number} of the stage's registration was not touched"
            raise OperatorAbort(f"{why}: {wish.reason or wish}") from wish
        stations.append(Station(stands_at(stage), point.xyz_mm, u_mm))
        so_far.taken.clear()
    identity = " ".join(str(part) for part in asdict(stage.identity).values() if part)
    stated = StageAccuracy.model_validate(settings, from_attributes=True)
    arm = toucher.tip.arm.identity.serial_number
    return Registration(made, arm, identity, teat, tuple(stations), stated)
