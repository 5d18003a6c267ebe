"""The arm's tip in the world, the one place where a reading of the arm's own frame becomes a point
of the table; and the check of the arm before and after a run, on a known divot.

The check finds an arm that was not homed, a pushed table or arm, a slipping joint. What was touched
becomes a fact of the run; the script's requirement decides.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from bench.rig.arm_files import LocationTest, TableFrame
from bench.rig.model import Arm
from instruments.clock import Clock
from instruments.errors import LimitError
from instruments.microscribe.configuration import Identity
from instruments.microscribe.stream import Reading
from instruments.operators.operator import CheckPoint, Release, Request


class ReadableArm(Protocol):
    """The driver's part that is used."""

    @property
    def identity(self) -> Identity: ...
    def read(self, n: int = 8, max_spread_mm: float = 1.0) -> Reading: ...


class TipReader:
    """Reads ``arm`` as the rig says. Without a ``frame`` the arm's own frame is the world."""

    def __init__(self, arm: ReadableArm, settings: Arm, frame: TableFrame | None) -> None:
        self._arm = arm
        self._settings = settings
        self._frame = frame

    def refuse_other_arm(self) -> None:
        """Raises LimitError where the frame is that of another arm than the one that is open."""
        serial_number = self._arm.identity.serial_number
        if self._frame is not None and self._frame.serial_number != serial_number:
            what = (
                f"the rig's table frame is of the arm {self._frame.serial_number}, but the arm that"
                f" answers is {serial_number}"
            )
            hint = "Make the frame anew with this arm: 'teatbench arm frame'"
            raise LimitError("arm", what, hint=hint)

    def read(self) -> Reading:
        """One reading of a still arm, in the world. Raises as the driver does."""
        settings = self._settings
        return self.in_world(self._arm.read(settings.packets, settings.max_spread_mm))

    def in_world(self, seen: Reading) -> Reading:
        """A reading of the arm's own frame in the world."""
        if self._frame is None:
            return seen
        motion = self._frame.world_from_arm
        return replace(seen, tip_mm=motion.apply(seen.tip_mm), axis=motion.R @ seen.axis)

    def u_registration_mm(self, point_mm: NDArray[np.float64]) -> float | None:
        """The frame's part of the uncertainty of (3,), along an axis; None without a frame."""
        if self._frame is None:
            return None
        return self._frame.u_registration_mm(point_mm, self._settings.u_mm)


BEFORE, AFTER = "before", "after"
CHECK_FACT = "arm check {}"  # before, after


def check_arm(
    ask: Callable[[Request], object],
    tip: TipReader,
    arm: Arm,
    clock: Clock,
    check: Callable[[], None],
) -> dict[str, Any]:
    """Have the operator touch the rig's check point; gives back the fact to store. ``check`` is
    called before each touch, and may raise.
    """
    touches = []
    for touch in range(1, arm.check_touches + 1):
        check()
        ask(CheckPoint(touch, arm.check_touches))
        seen = tip.read()
        row = {"t_s": clock.now(), "tip_mm": seen.tip_mm.tolist(), "axis": seen.axis.tolist()}
        spread = {"spread_mm": float(seen.spread_mm), "counts": [int(c) for c in seen.counts]}
        touches.append(row | spread)
    ask(Release())
    return {"check_point_mm": arm.check_point_mm, "touches": touches}


def location_of(fact: Mapping[str, Any], where: str) -> LocationTest:
    """The touches of a stored check, world frame."""
    touches = fact["touches"]
    return LocationTest(
        where, np.array([t["tip_mm"] for t in touches]), np.array([t["axis"] for t in touches])
    )


def shift_mm(fact: Mapping[str, Any]) -> float:
    """How far the mean of the touches lies from where the rig says that the divot is."""
    return float(np.linalg.norm(location_of(fact, "").centre_mm - np.array(fact["check_point_mm"])))


def check_text(fact: Mapping[str, Any], when: str) -> str:
    """The sentence for the events."""
    test = location_of(fact, when)
    return (
        f"arm check {when} the trials: {test.n} touches within {test.largest_mm:.2f} mm of their"
        f" mean, which is {shift_mm(fact):.2f} mm from the check point; the stylus swung by"
        f" {test.swing_deg:.0f} degrees"
    )
