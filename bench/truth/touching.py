"""Has the operator touch teat ends and reads the arm in the world: several readings an end, each
judged at once, asked for again where refused; the end with its uncertainty budget; and a trial's
truth made of that.

**Outliers.** Readings of one end differ by hand and rounding, whose standard deviation s0 along an
axis is known. A reading is refused further than `FAR` times s from the median of all, s the larger
of s0 and the scatter shown, median distance / 1.538 (the median length of a standard normal vector
in space). Of two readings that far apart neither is used. With normal readings one end in some 3000
loses one falsely.

**Wrong teat.** Places are compared with each other: the teats touched already give the phantom's
shift. A touch is refused where another teat's shifted place is nearer by more than `TELL_MM`, where
it falls on an end that was touched already, or farther than `ASTRAY_MM` from its own place.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from math import hypot, sqrt
from typing import Any, Protocol

import numpy as np

from bench.record.recording import TruthRow
from bench.record.schema import Row
from bench.rig.arm_files import TableFrame
from bench.rig.model import ArmTable
from bench.scoring.errors import Floats
from bench.scoring.matching import LEAST_SPACING_MM
from bench.truth.uncertainty import (
    ARM,
    REGISTRATION,
    TIP_RADIUS,
    Component,
    Triple,
    TrueEnd,
    TruthMethod,
    TruthUncertainty,
)
from detector.outline.known_ends import EndOffsets
from instruments.clock import Clock, wall_time
from instruments.errors import DeviceError, LimitError, TouchAgainError
from instruments.microscribe.configuration import Identity
from instruments.microscribe.driver import Reading
from instruments.operators.operator import Release, Request, Touch
from instruments.world.phantom import called
from textfiles.text import plural

SPARE = 4  # touches of one end beyond those that are asked for, before it is given up
FAR = 5.0
MEDIAN_LENGTH = 1.5382
TELL_MM = 2.0  # nearer to the other teat by this, or the two are taken to be equally near
# of the expected distance between two ends: nearer than that, the tip stands at one of them twice
SAME_SHARE = 0.25

# of an end from where the script has it: no phantom is set up worse
ASTRAY_MM = 150.0
# of the touches of one end: where it is, (3,), and the row
EndTouches = list[tuple[Floats, dict[str, Any]]]
SoFar = dict[int, EndTouches]  # by teat


class NoTruthError(DeviceError):
    """A teat end could not be touched well, or is where none can be; the trial has no truth."""


class AstrayError(NoTruthError):
    """What was touched is nowhere near the script's place, as where a stage has lost its own."""


@dataclass(frozen=True, slots=True, eq=False)
class Ends:
    """What is to be touched: expected places (n, 3), ``axes`` (n, 3) from base to end, ``names``.
    Places are used only where they are ``known`` well enough.
    """

    expected_mm: Floats
    axes: Floats
    known: bool = True
    names: tuple[str, ...] = ()

    def called(self, teat: int) -> str:
        """What the operator is asked for ``teat`` (from 1)."""
        return self.names[teat - 1] if self.names else called(teat)


class ReadableArm(Protocol):
    @property
    def touches(self) -> bool: ...
    @property
    def identity(self) -> Identity: ...
    def touch(self, point_mm: Floats, axis: Floats) -> None: ...
    def read(self, n: int = 8, max_spread_mm: float = 1.0) -> Reading: ...


@dataclass(slots=True, eq=False)
class TipReader:
    """Reads ``arm`` as the rig says: the one place where a reading of the arm's own frame becomes a
    point of the table. Without a ``frame`` the arm's own frame is the world.
    """

    arm: ReadableArm
    settings: ArmTable
    frame: TableFrame | None

    def refuse_other_arm(self) -> None:
        """Raises LimitError where the frame is that of another arm than the one that is open."""
        serial_number = self.arm.identity.serial_number
        if self.frame is not None and self.frame.serial_number != serial_number:
            what = (
                f"the rig's table frame is of the arm {self.frame.serial_number}, but the arm that"
                f" answers is {serial_number}"
            )
            hint = "Make the frame anew with this arm: 'teatbench arm frame'"
            raise LimitError("arm", what, hint=hint)

    def goes(self, point_mm: Floats, axis: Floats) -> bool:
        """Have an arm that touches by itself go to the end at ``point_mm`` (3,) in the world, along
        its ``axis``; False of one that is moved by hand. Raises as the arm.
        """
        if not self.arm.touches:
            return False
        tip_mm = point_mm + self.settings.tip_radius_mm * axis
        if self.frame is not None:
            arm_from_world = self.frame.world_from_arm.inverse()
            tip_mm, axis = arm_from_world.apply(tip_mm), np.asarray(arm_from_world.R @ axis)
        self.arm.touch(tip_mm, axis)
        return True

    def read(self) -> Reading:
        settings = self.settings
        return self.in_world(self.arm.read(settings.packets, settings.max_spread_mm))

    def in_world(self, seen: Reading) -> Reading:
        if self.frame is None:
            return seen
        motion = self.frame.world_from_arm
        axis = None if seen.axis is None else motion.R @ seen.axis
        return replace(seen, tip_mm=motion.apply(seen.tip_mm), axis=axis)

    def u_registration_mm(self, point_mm: Floats) -> float | None:
        """The frame's part of the uncertainty of (3,), along an axis; None without a frame."""
        if self.frame is None:
            return None
        return self.frame.u_registration_mm(point_mm, self.settings.u_mm)


@dataclass(slots=True, eq=False)
class Toucher:
    """Has the operator touch ends, ``readings`` each (None: as many as the rig says); ``check``
    runs before each and may raise.
    """

    ask: Callable[[Request], object]
    tip: TipReader
    arm: ArmTable
    clock: Clock
    check: Callable[[], None]
    readings: int | None = None

    @property
    def each(self) -> int:
        """How many touches an end gets."""
        return self.readings or self.arm.touches

    def touch_all(self, ends: Ends, so_far: SoFar | None = None) -> tuple[list[TrueEnd], list[Row]]:
        """A truth for each end, and a row for each touch. ``so_far`` gets each touch, by teat; what
        an attempt before left in it counts where one more touch agrees. Raises NoTruthError.
        """
        done, rows = dict[int, TrueEnd](), list[Row]()
        so_far = {} if so_far is None else so_far
        again = self._compared(ends, so_far) if any(map(_kept, so_far.values())) else ""
        for teat in range(1, len(ends.expected_mm) + 1):
            places = {other: np.array(point.xyz_mm) for other, point in done.items()}
            taken = so_far.setdefault(teat, [])
            done[teat], touches = self._touch_end(teat, ends, places, taken, again)
            rows, again = rows + touches, ""
        self.ask(Release())
        return list(done.values()), rows

    def touch_one(
        self, teat: int, ends: Ends, taken: EndTouches | None = None
    ) -> tuple[TrueEnd, list[Row]]:
        """The same for one end alone; ``taken`` gets its touches; those in it count."""
        point, rows = self._touch_end(teat, ends, {}, [] if taken is None else taken)
        self.ask(Release())
        return point, rows

    def _compared(self, ends: Ends, so_far: SoFar) -> str:
        """Have one end touched once more, and forget all touches where it isn't where it was; gives
        back what to say then.
        """
        teat, kept = next((teat, kept) for teat, one in so_far.items() if (kept := _kept(one)))
        count, who, one = sum(map(len, so_far.values())), ends.called(teat), EndTouches()
        again = f"One touch of {who} shows whether the {count} of this pose so far still count."
        self._touch_end(teat, ends, {}, one, again, readings=1)
        off_mm = np.linalg.norm(_kept(one)[0][0] - np.mean([end for end, _ in kept], axis=0))
        if off_mm <= same_place_mm(self.arm, len(kept)):
            so_far[teat] += one
            for number, (_, row) in enumerate(so_far[teat], 1):
                row["touch"] = number
            return ""
        so_far.clear()
        return f"{who} is {off_mm:.1f} mm from where it was: all ends are touched anew."

    def _touch_end(
        self,
        teat: int,
        ends: Ends,
        done: Mapping[int, Floats],
        taken: EndTouches,
        again: str = "",
        readings: int | None = None,
    ) -> tuple[TrueEnd, list[Row]]:
        moves, readings = list[str](), readings or self.each
        while (missing := readings - len(kept := _kept(taken))) > 0:
            if len(taken) + len(moves) >= (most := readings + SPARE):
                reasons = [str(row["refused"]) for _, row in taken if row["refused"]] + moves
                at_mm = ends.expected_mm[teat - 1]
                off_mm = np.linalg.norm(taken[-1][0] - at_mm) if taken and ends.known else 0.0
                raise (AstrayError if off_mm > ASTRAY_MM else NoTruthError)(
                    "truth",
                    f"{ends.called(teat)}: {len(reasons)} of {most} touches could not be used; the"
                    f" last one: {reasons[-1].rstrip('.')}",
                    hint="Is the teat loose, does the phantom stand where the script says, and are"
                    " its teats counted as the layout counts them?",
                )
            self.check()
            number = readings - missing + 1
            if not self.tip.goes(ends.expected_mm[teat - 1], ends.axes[teat - 1]):
                self.ask(Touch(teat, len(ends.expected_mm), number, readings, again))
            try:
                seen = self.tip.read()
            except TouchAgainError as error:
                moves.append(str(error))
                again = f"{error} Touch {ends.called(teat)}, once more."
                continue
            # the arm reads the centre of the ball, which stands on the end
            end = seen.tip_mm - self.arm.tip_radius_mm * ends.axes[teat - 1]
            refused = mistaken(end, teat, ends, done)
            again = f"{refused} Touch {ends.called(teat)}." if refused else ""
            row = {
                "teat": str(teat),
                "touch": len(taken) + 1,
                "t_s": self.clock.now(),
                "wall_time": wall_time().isoformat(timespec="milliseconds"),
                **dict(zip(("x_mm", "y_mm", "z_mm"), map(float, seen.tip_mm), strict=True)),
                "spread_mm": float(seen.spread_mm),
                "packets": seen.n,
                "counts": json.dumps(seen.evidence),
                "refused": refused,
            }
            taken.append((end, row))
            kept = _kept(taken)
            if not again and len(kept) >= min(readings, 3):
                far = outliers(np.array([end for end, _ in kept]), reading_u_mm(self.arm))
                for at, reason in far.items():
                    kept[at][1]["refused"] = reason
                    note = f"A touch of {ends.called(teat)} is refused: {reason}. Once more."
                    again = again or note
        points = np.array([end for end, _ in kept])
        u_mm = self.tip.u_registration_mm(points.mean(axis=0))
        return touched(points, self.arm, registration_mm=u_mm), [row for _, row in taken]


def touched(tips_mm: Floats, arm: ArmTable, *, registration_mm: float | None = None) -> TrueEnd:
    """The mean of readings (n, 3), tip radius taken off, with its budget; ``registration_mm`` is
    the table frame's part. Raises ValueError without a reading.
    """
    tips = np.asarray(tips_mm, dtype=np.float64)
    if tips.ndim != 2 or tips.shape[1] != 3 or not len(tips):
        raise ValueError(f"touches must be (n, 3) with n at least 1, not {tips.shape}")
    n = len(tips)
    scatter = float(np.sqrt(np.mean(np.var(tips, axis=0, ddof=1)) / n)) if n > 1 else 0.0
    frame = "the table frame's three touches, each with the arm's accuracy, propagated to this end"
    ball = (
        f"ball tip of {arm.tip_radius_mm:g} mm, along a teat axis known within {arm.axis_u_rad:g}"
        " rad (rig file)"
    )
    apex = "how well a hand finds the apex of the rounded end (rig file)"
    who = arm.accuracy_source or "the arm's stated accuracy, no source named"
    by = f", {arm.accuracy_df:g} degrees of freedom, so widened" if arm.accuracy_df else ""
    lines: list[tuple[str, float | None, str]] = [
        (ARM, arm.u_mm, f"{who}{by}, taken along each axis (rig file)"),
        (REGISTRATION, registration_mm, frame),
        ("definition", arm.definition_mm, apex),
        (TIP_RADIUS, tip_radius_u_mm(arm) or None, ball),
        ("resolution", arm.rounding_mm, arm.rounding_source),
        ("scatter", scatter, f"standard deviation of the mean of {plural(n, 'touch')}"),
    ]
    budget = tuple(Component(name, u, source) for name, u, source in lines if u is not None)
    return TrueEnd.at(tips.mean(axis=0), TruthUncertainty(budget))


def reading_u_mm(arm: ArmTable) -> float:
    """Of one reading against another along an axis: hand and rounding, not accuracy."""
    return hypot(arm.definition_mm, arm.rounding_mm)


def same_place_mm(arm: ArmTable, readings: int = 1) -> float:
    """How far one reading may lie from the mean of ``readings`` before it of the same place."""
    return FAR * reading_u_mm(arm) * sqrt(1.0 + 1.0 / readings)


def end_u_mm(arm: ArmTable, readings: int) -> float:
    """Along an axis, of one end's mean against that of another place, before anything was read."""
    scatter = reading_u_mm(arm) / sqrt(readings)
    return hypot(arm.u_mm, arm.definition_mm, tip_radius_u_mm(arm), arm.rounding_mm, scatter)


def tip_radius_u_mm(arm: ArmTable) -> float:
    """Of a ball tip: its radius, turned by the teat axis's uncertainty, and the radius itself."""
    turned_mm = arm.tip_radius_mm * arm.axis_u_rad
    return hypot(turned_mm, arm.tip_radius_u_mm) if arm.tip_radius_mm else 0.0


def _kept(taken: EndTouches) -> EndTouches:
    return [one for one in taken if one[1]["refused"] is None]


def outliers(points_mm: Floats, s0_mm: float) -> dict[int, str]:
    """Rows of readings (n, 3) of one end that are refused, with the reason; of two both or none."""
    points = np.asarray(points_mm, dtype=np.float64)
    if len(points) < 2:
        return {}
    if len(points) == 2:
        apart, limit = float(np.linalg.norm(points[0] - points[1])), FAR * s0_mm * 2.0**0.5
        reason = f"two readings {apart:.2f} mm apart, limit {limit:.2f} mm: neither can be trusted"
        return dict.fromkeys((0, 1), reason) if apart > limit else {}
    away = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    limit = FAR * max(s0_mm, float(np.median(away)) / MEDIAN_LENGTH)
    text = f"mm from the median of {len(points)} readings, limit {limit:.2f} mm"
    return {int(row): f"{away[row]:.2f} {text}" for row in np.flatnonzero(away > limit)}


def mistaken(point: Floats, teat: int, ends: Ends, done: Mapping[int, Floats]) -> str | None:
    """Why a touch (3,) is not of ``teat`` (from 1); None where it may be."""
    expected = ends.expected_mm if ends.known else None
    for other, place in done.items():
        apart, same = float(np.linalg.norm(point - place)), LEAST_SPACING_MM
        if expected is not None:
            between = float(np.linalg.norm(expected[teat - 1] - expected[other - 1]))
            same = max(same, SAME_SHARE * between)
        if other != teat and apart < same:
            return (
                f"That is the end of {ends.called(other)} once more ({apart:.1f} mm from where it"
                " was touched)."
            )
    if expected is None:
        return None
    shifts = [place - expected[other - 1] for other, place in done.items()]
    away = np.linalg.norm(expected + (np.mean(shifts, axis=0) if shifts else 0.0) - point, axis=1)
    nearest = int(np.argmin(away)) + 1
    if nearest == teat or away[nearest - 1] + TELL_MM >= away[teat - 1]:
        off_mm = float(np.linalg.norm(expected[teat - 1] - point))
        return astray_text(ends.called(teat), off_mm) if off_mm > ASTRAY_MM else None
    return (
        f"That looks like {ends.called(nearest)}: it is {away[nearest - 1]:.0f} mm from that teat's"
        f" place, and {away[teat - 1]:.0f} mm from the place of {ends.called(teat)}."
    )


def astray_text(who: str, off_mm: float) -> str:
    """What is said of an end so far from where the script has it."""
    return (
        f"That is {off_mm:.0f} mm from the place of {who} (at most {ASTRAY_MM:g} mm are taken): the"
        " table frame or the layout is not that of this table."
    )


@dataclass(frozen=True, slots=True, eq=False)
class ExpectedScene:
    """What stands there for a trial: ``ends`` where expected, and `carrying.fixed_key`."""

    trial: str
    ends: Ends
    fixed: str


@dataclass(frozen=True, slots=True)
class TrialTruth:
    """The truth of one trial: a point a teat, a row a touch, the stage's position."""

    points: tuple[TrueEnd, ...]
    touches: tuple[Row, ...]
    stage_mm: Triple | None = None

    @property
    def how(self) -> TruthMethod:
        """Touched or carried: all ends of a trial are the same."""
        return self.points[0].how if self.points else TruthMethod.TOUCHED


def truth_row(
    trial_id: str, row: TruthRow, exact: Floats | None = None, seen: EndOffsets | None = None
) -> Row:
    """The row of the table ``truth``, with the budget of a truth of the bench's own, and in
    ``seen`` where the cameras show it.
    """
    found: dict[str, Any] = {
        "trial": trial_id,
        "teat": row.teat,
        **dict(zip(("x_mm", "y_mm", "z_mm"), map(float, row.xyz_mm), strict=True)),
        "u_mm": row.u_mm,
        "visible": int(row.visible),
        "exact_mm": None if exact is None else json.dumps(exact.tolist()),
        "covariance_mm2": None,
        "cameras": None if seen is None else json.dumps(asdict(seen)),
    }
    if isinstance(row, TrueEnd):
        found |= {
            "covariance_mm2": json.dumps(row.covariance_mm2.tolist()),
            "how": row.how.value,
            "budget": json.dumps(row.uncertainty.as_dict()),
        }
    return found


@dataclass(eq=False)
class TouchedTruth:
    """Every end of every trial is touched. The engine calls `begin`, then for each trial `before`,
    `unattended`, `of_trial` and `stored`, then `end`.
    """

    toucher: Toucher
    stage_mm: Callable[[], Triple | None]

    def begin(self) -> None:
        """All is homed; nothing has been shown yet."""

    def before(self, shown: ExpectedScene) -> None:
        """The phantom is about to be moved and set up for this."""

    def unattended(self, shown: ExpectedScene) -> bool:  # noqa: ARG002 - it always is attended
        """Whether no person has been or will be at the phantom for this trial."""
        return False

    def of_trial(self, shown: ExpectedScene, so_far: SoFar | None = None) -> TrialTruth:
        """The truth of what stands there; ``so_far`` as of `touch_all`. Raises NoTruthError."""
        points, rows = self.toucher.touch_all(shown.ends, so_far)
        touches = tuple({"trial": shown.trial, **row} for row in rows)
        return TrialTruth(tuple(points), touches, self.stage_mm())

    def stored(self, trial: str, truth: TrialTruth) -> None:
        """The trial is in the store."""

    def end(self) -> None:
        """After the last trial, as it still stands."""
