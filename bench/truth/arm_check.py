"""The check of the arm before and after a run, on a known divot.

It finds an arm that was not homed, a pushed table or arm, a slipping joint. What was touched
becomes a fact of the run; the script's requirement decides.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from bench.rig.arm_files import LocationTest, axes_of, swing_text
from bench.rig.model import ArmTable
from bench.scoring.errors import Floats
from bench.truth.touching import SPARE, TipReader
from instruments.clock import Clock
from instruments.errors import TouchAgainError
from instruments.operators.operator import CheckPoint, Release, Request
from textfiles.text import plural

BEFORE, AFTER, AMID = "before", "after", "amid"
CHECK_FACT = "arm check {}"  # before, after


def check_arm(
    ask: Callable[[Request], object],
    tip: TipReader,
    arm: ArmTable,
    clock: Clock,
    check: Callable[[], None],
    before: Mapping[str, Any] | None = None,
    near_mm: float = 0.0,
    again: str = "",
) -> dict[str, Any]:
    """Touch the rig's check point; gives back the fact to store. ``check`` may raise; ``again``:
    why it is asked for. The touches of a check ``before`` count where the first one lies within
    ``near_mm`` of their mean: nothing has moved since. The fact then says how many are ``new``.
    """
    touches: list[dict[str, Any]] = []
    refused = 0
    while len(touches) < arm.check_touches:
        check()
        of = 1 if before and not touches else arm.check_touches
        ask(CheckPoint(len(touches) + 1, of, again))
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
        if of == 1 and before and _apart_mm(before, seen.tip_mm) <= near_mm:
            ask(Release())
            both = [*before["touches"], *touches]
            return {"check_point_mm": arm.check_point_mm, "touches": both, "new": 1}
    ask(Release())
    return {"check_point_mm": arm.check_point_mm, "touches": touches}


def _apart_mm(before: Mapping[str, Any], tip_mm: Floats) -> float:
    return float(np.linalg.norm(tip_mm - location_of(before, "").centre_mm))


def new_touches(fact: Mapping[str, Any]) -> int:
    """How many touches of a check are its own; the others are those of the check before."""
    return int(fact.get("new", len(fact["touches"])))


def moved_mm(before: Mapping[str, Any], after: Mapping[str, Any]) -> float:
    """How far the mean of the touches of one check lies from that of the new ones of the next."""
    new = after["touches"][-new_touches(after) :]
    return _apart_mm(before, np.mean([touch["tip_mm"] for touch in new], axis=0))


def location_of(fact: Mapping[str, Any], where: str) -> LocationTest:
    """The touches of a stored check, world frame."""
    touches = fact["touches"]
    axes = axes_of([t["axis"] for t in touches])
    return LocationTest(where, np.array([t["tip_mm"] for t in touches]), axes)


def shift_mm(fact: Mapping[str, Any]) -> float:
    """How far the mean of the touches lies from where the rig says that the divot is."""
    return float(np.linalg.norm(location_of(fact, "").centre_mm - np.array(fact["check_point_mm"])))


def check_text(fact: Mapping[str, Any], when: str) -> str:
    test, new = location_of(fact, when), new_touches(fact)
    touches = plural(test.n, "touch")
    if new < test.n:
        touches += f" ({new} new: nothing has moved since the others)"
    return (
        f"arm check {when} the trials: {touches} within {test.largest_mm:.2f} mm of their"
        f" mean, which is {shift_mm(fact):.2f} mm from the check point; {swing_text(test)}"
    )
