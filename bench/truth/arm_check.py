"""The check of the arm before and after a run, on a known divot.

It finds an arm that was not homed, a pushed table or arm, a slipping joint. What was touched
becomes a fact of the run; the script's requirement decides.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from bench.rig.arm_files import LocationTest, axes_of, swing_text
from bench.rig.model import Arm
from bench.truth.touching import SPARE, TipReader
from instruments.clock import Clock
from instruments.errors import TouchAgainError
from instruments.operators.operator import CheckPoint, Release, Request

BEFORE, AFTER = "before", "after"
CHECK_FACT = "arm check {}"  # before, after


def check_arm(
    ask: Callable[[Request], object],
    tip: TipReader,
    arm: Arm,
    clock: Clock,
    check: Callable[[], None],
) -> dict[str, Any]:
    """Touch the rig's check point; gives back the fact to store. ``check`` may raise."""
    touches: list[dict[str, Any]] = []
    again, refused = "", 0
    while len(touches) < arm.check_touches:
        check()
        ask(CheckPoint(len(touches) + 1, arm.check_touches, again))
        try:
            seen, again = tip.read(), ""
        except TouchAgainError as error:
            again, refused = str(error), refused + 1
            if refused > SPARE:
                raise
            continue
        axis = None if seen.axis is None else seen.axis.tolist()
        row = {"t_s": clock.now(), "tip_mm": seen.tip_mm.tolist(), "axis": axis}
        touches.append(row | {"spread_mm": float(seen.spread_mm), "counts": seen.evidence})
    ask(Release())
    return {"check_point_mm": arm.check_point_mm, "touches": touches}


def location_of(fact: Mapping[str, Any], where: str) -> LocationTest:
    """The touches of a stored check, world frame."""
    touches = fact["touches"]
    axes = axes_of([t["axis"] for t in touches])
    return LocationTest(where, np.array([t["tip_mm"] for t in touches]), axes)


def shift_mm(fact: Mapping[str, Any]) -> float:
    """How far the mean of the touches lies from where the rig says that the divot is."""
    return float(np.linalg.norm(location_of(fact, "").centre_mm - np.array(fact["check_point_mm"])))


def check_text(fact: Mapping[str, Any], when: str) -> str:
    test = location_of(fact, when)
    return (
        f"arm check {when} the trials: {test.n} touches within {test.largest_mm:.2f} mm of their"
        f" mean, which is {shift_mm(fact):.2f} mm from the check point; {swing_text(test)}"
    )
