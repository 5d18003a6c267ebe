"""Where a move may go, how long it may take, and whether it got there.

Machine coordinates by axis letter: mm, degrees for A. A length with A is the firmware's: the root
of the sum of all squares.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from instruments.errors import DeviceError, LimitError, ProtocolError
from instruments.stage.protocol import AXES, Position
from instruments.stage.settings import StageSettings

TOLERANCE_MM = 0.01
_SLACK_S = 10.0

Target = dict[str, float]


@dataclass(frozen=True, slots=True)
class Move:
    """A move under way: axis letter to mm, when it must be over, and whether it is a jog."""

    target_mm: Target
    deadline_s: float
    allowed_s: float
    jog: bool = False


def declared(values: Mapping[str, float | None], axes: str, *, who: str) -> Target:
    """``values`` without None. Raises LimitError for an undeclared axis."""
    target = {axis: value for axis, value in values.items() if value is not None}
    if missing := [axis for axis in target if axis not in axes]:
        hint = f"It is declared with {axes}: if it has more, say so in the rig file's [stage] axes."
        raise LimitError(who, f"this stage has no axis {', '.join(missing)}", hint=hint)
    return target


def feed(target: Target, wanted_mm_min: float | None, settings: StageSettings) -> float:
    """The feed to send: the wanted one, or what the slowest of the axes can."""
    rates = dict(zip(AXES, settings.rate_mm_min, strict=False))
    return min(rates[axis] for axis in target) if wanted_mm_min is None else wanted_mm_min


def allowed_s(way_mm: Mapping[str, float], feed_mm_min: float, settings: StageSettings) -> float:
    """How long the move may take before something is wrong: twice what it should, and some more."""
    way = math.hypot(*way_mm.values())
    return _SLACK_S + 2 * 60 * way / min(feed_mm_min, *settings.rate_mm_min)


def check_within(target: Target, settings: StageSettings, line: str, *, who: str) -> None:
    """Raise LimitError for a target outside the travel that the controller's settings give."""
    limits = settings.limits
    for axis, value in target.items():
        if not limits[axis].hold(round(value, 3)):  # as it is sent
            unit = "deg" if axis == "A" else "mm"
            travel = f"{limits[axis].low_mm:g} to {limits[axis].high_mm:g} {unit}"
            what = f"{axis} = {value:.3f} {unit} is outside the travel, {travel}"
            hint = "Machine coordinates are negative, 0 is at the switch."
            raise LimitError(who, what, asked=line, hint=hint)


def check_arrived(move: Move, here: Target, settings: StageSettings, *, who: str) -> None:
    """Raise DeviceError unless every axis is at its target within its resolution."""
    steps = dict(zip(AXES, settings.steps_per_mm, strict=False))
    for axis, value in move.target_mm.items():
        if not abs(here[axis] - value) <= max(TOLERANCE_MM, 0.5 / steps[axis] + 0.001):
            what, hint = f"the stage is not at its target, {axis} = {value:.3f}", "Home it again."
            if move.jog:
                hint = (
                    "The jog was ended early, by a hold at the panel or by brake(); its position is"
                    " kept."
                )
            raise DeviceError(who, what, seen=f"{axis} = {here[axis]:.3f}", hint=hint)


def by_letter(numbers: Position, axes: str, *, who: str) -> Target:
    """X, Y, Z, and A where declared, of a position. Raises ProtocolError for one with fewer."""
    letters = AXES if "A" in axes else AXES[:3]
    if len(numbers) < len(letters):
        what = f"{len(numbers)} numbers in a position, {len(letters)} are needed"
        raise ProtocolError(who, what, hint="A rotation A needs a controller with four axes.")
    return dict(zip(letters, numbers, strict=False))
