"""Has the operator touch teat ends and reads the arm: several readings an end, each judged at once,
asked for again where refused.

May not know of trials, nor what the ends are wanted for.

Where a trial's truth comes from, as the engine asks for it; and the plain way: every end touched in
every trial.

The engine asks in this order: `begin` once, then for each trial `before`, `unattended`, `of_trial`
and, when it is in the store, `stored`; `end` after the last. The other way, `bench.truth.carrying`,
touches once and lets the stage carry.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bench.record.writer import Row
from bench.rig.model import Arm
from bench.truth.arm_tip import TipReader, WorldTip
from bench.truth.touch_checks import mistaken, outliers, touched_before
from bench.truth.uncertainty import How, Triple, TruthPoint, reading_u_mm, touched
from instruments.clock import Clock, wall_time
from instruments.errors import DeviceError
from instruments.microscribe.errors import ArmMovesError
from instruments.operators.operator import Release, Request, Touch
from instruments.teat_end import end_under_ball_mm

SPARE = 4  # touches of one end beyond those that are asked for, before it is given up

Floats = NDArray[np.float64]


class NoTruthError(DeviceError):
    """A teat end could not be touched well: the touches asked for again were refused too. The trial
    has no truth.
    """


@dataclass(frozen=True, slots=True, eq=False)
class Ends:
    """What is to be touched: ``expected_mm`` (n, 3) are the places of all the ends, ``axes`` (n, 3)
    unit vectors from base to end.

    Where the places are not ``known`` well enough to tell teats apart (how the stage's axes lie is
    just being found out), they aren't used.
    """

    expected_mm: Floats
    axes: Floats
    known: bool = True

    @property
    def count(self) -> int:
        """How many teats there are."""
        return len(self.expected_mm)


@dataclass(slots=True)
class _Reading:
    seen: WorldTip
    end_mm: Floats
    t_s: float
    wall: str
    refused: str | None = None


class Toucher:
    """Has the operator touch by ``ask``, with ``arm``'s settings, ``readings`` an end. ``check`` is
    called before each touch, and may raise.
    """

    def __init__(
        self,
        ask: Callable[[Request], object],
        tip: TipReader,
        arm: Arm,
        clock: Clock,
        check: Callable[[], None],
        readings: int | None = None,
    ) -> None:
        self._ask = ask
        self._tip = tip
        self._arm = arm
        self._clock = clock
        self._check = check
        self.readings = readings or arm.touches

    def touch_all(self, ends: Ends) -> tuple[list[TruthPoint], list[Row]]:
        """A truth for each end, and a row for each touch, refused ones too. Raises NoTruthError,
        and as operator and driver do.
        """
        done: dict[int, TruthPoint] = {}
        rows: list[Row] = []
        for teat in range(1, ends.count + 1):
            done[teat], touches = self._touch_end(
                teat, ends, {other: np.array(p.point_mm) for other, p in done.items()}
            )
            rows += touches
        self._ask(Release())
        return list(done.values()), rows

    def touch_one(self, teat: int, ends: Ends) -> tuple[TruthPoint, list[Row]]:
        """The same for one end alone."""
        point, rows = self._touch_end(teat, ends, {})
        self._ask(Release())
        return point, rows

    def u_registration_mm(self, point_mm: Floats) -> float | None:
        """What the table frame adds to the uncertainty at (3,); None where the world is the arm's
        frame.
        """
        return self._tip.u_registration_mm(point_mm)

    def _touch_end(
        self, teat: int, ends: Ends, done: dict[int, Floats]
    ) -> tuple[TruthPoint, list[Row]]:
        taken = _TouchSet(teat, ends, done)
        again = ""
        while (missing := self.readings - len(taken.kept)) > 0:
            taken.refuse_endless(self.readings + SPARE)
            self._check()
            number = self.readings - missing + 1
            self._ask(Touch(teat, ends.count, number, self.readings, again))
            again = self._read(taken)
        points = np.array([r.end_mm for r in taken.kept])
        truth = touched(
            points, self._arm, registration_mm=self._tip.u_registration_mm(points.mean(axis=0))
        )
        return truth, [_row(teat, number, r) for number, r in enumerate(taken.readings, 1)]

    def _read(self, taken: _TouchSet) -> str:
        """One reading, judged; gives back why a touch is asked for again, or nothing."""
        try:
            seen = self._tip.read()
        except ArmMovesError as moves:
            taken.moved.append(str(moves))
            return f"{moves} Touch teat {taken.teat} once more."
        end = end_under_ball_mm(
            seen.point_mm, taken.ends.axes[taken.teat - 1], self._arm.tip_radius_mm
        )
        reason = touched_before(end, taken.teat, taken.done)
        if reason is None and taken.ends.known:
            reason = mistaken(end, taken.teat, taken.ends.expected_mm, taken.done)
        taken.readings.append(
            _Reading(
                seen, end, self._clock.now(), wall_time().isoformat(timespec="milliseconds"), reason
            )
        )
        if reason:
            return f"{reason} Touch teat {taken.teat}."
        if len(taken.kept) < min(self.readings, 3):
            return ""
        return taken.refuse_outliers(reading_u_mm(self._arm))


@dataclass(slots=True)
class _TouchSet:
    """What was read of one end so far. ``moved`` are the touches that gave no reading, since the
    arm was not held still.
    """

    teat: int
    ends: Ends
    done: dict[int, Floats]
    readings: list[_Reading] = field(default_factory=list)
    moved: list[str] = field(default_factory=list)

    @property
    def kept(self) -> list[_Reading]:
        return [r for r in self.readings if r.refused is None]

    def refuse_outliers(self, s0_mm: float) -> str:
        """Mark what doesn't belong to the others; gives back the sentence for the operator, or
        nothing.
        """
        kept = self.kept
        refused = outliers(np.array([r.end_mm for r in kept]), s0_mm)
        for row, reason in refused.items():
            kept[row].refused = reason
        return (
            f"A touch of teat {self.teat} is refused: {next(iter(refused.values()))}. Once more."
            if refused
            else ""
        )

    def refuse_endless(self, most: int) -> None:
        """Raises NoTruthError after ``most`` touches."""
        if len(self.readings) + len(self.moved) < most:
            return
        reasons = [r.refused for r in self.readings if r.refused] + self.moved
        what = (
            f"teat {self.teat}: {len(reasons)} of {most} touches could not be used; the last one:"
            f" {reasons[-1]}"
        )
        hint = (
            "Is the teat loose, does the phantom stand where the script says, and are its teats"
            " counted as the layout counts them?"
        )
        raise NoTruthError("truth", what, hint=hint)


def _row(teat: int, number: int, reading: _Reading) -> Row:
    x, y, z = (float(v) for v in reading.seen.point_mm)
    return {
        "teat": str(teat),
        "touch": number,
        "t_s": reading.t_s,
        "wall_time": reading.wall,
        "x_mm": x,
        "y_mm": y,
        "z_mm": z,
        "spread_mm": reading.seen.spread_mm,
        "packets": reading.seen.n,
        "counts": json.dumps([int(count) for count in reading.seen.counts]),
        "refused": reading.refused,
    }


@dataclass(frozen=True, slots=True, eq=False)
class ExpectedScene:
    """What stands there for a trial: ``ends`` where they are expected, and `carry.fixed_key` of
    what no shift changes.
    """

    trial: str
    ends: Ends
    fixed: str


@dataclass(frozen=True, slots=True)
class TrialTruth:
    """The truth of one trial: a point for each teat, a row for each touch, and where the stage
    stood (None without one).
    """

    points: tuple[TruthPoint, ...]
    touches: tuple[Row, ...]
    stage_mm: Triple | None = None

    @property
    def how(self) -> How:
        """Touched or carried: all ends of a trial are the same."""
        return self.points[0].how if self.points else How.TOUCHED


class TruthSource(Protocol):
    """What the engine asks."""

    def begin(self) -> None:
        """All is homed; nothing has been shown yet."""
        ...

    def before(self, shown: ExpectedScene) -> None:
        """The phantom is about to be moved and set up for this."""
        ...

    def unattended(self, shown: ExpectedScene) -> bool:
        """Whether nobody has been near the phantom since the last trial was shown, nor is needed
        for this one.
        """
        ...

    def of_trial(self, shown: ExpectedScene) -> TrialTruth:
        """It stands there, and the cameras have seen it. Raises NoTruthError, and as operator and
        instruments do.
        """
        ...

    def stored(self, trial: str, truth: TrialTruth) -> None:
        """The trial is in the store."""
        ...

    def end(self) -> None:
        """After the last trial, as it still stands."""
        ...


class TouchedTruth:
    """Every end of every trial is touched; ``stage_mm`` asks where the stage stands, for the
    record.
    """

    def __init__(self, toucher: Toucher, stage_mm: Callable[[], Triple | None]) -> None:
        self._toucher = toucher
        self._stage_mm = stage_mm

    def begin(self) -> None:
        """Nothing to prepare."""

    def before(self, shown: ExpectedScene) -> None:
        """Nothing to check."""

    def unattended(self, shown: ExpectedScene) -> bool:  # noqa: ARG002 - it always is attended
        """The arm may be in the picture until the operator says that it isn't."""
        return False

    def of_trial(self, shown: ExpectedScene) -> TrialTruth:
        points, rows = self._toucher.touch_all(shown.ends)
        return TrialTruth(tuple(points), rows_of(shown.trial, rows), self._stage_mm())

    def stored(self, trial: str, truth: TrialTruth) -> None:
        """Nothing to remember."""

    def end(self) -> None:
        """Nothing to check."""


def rows_of(trial: str, rows: Sequence[Row]) -> tuple[Row, ...]:
    """Rows of touches, as those of this trial."""
    return tuple({"trial": trial, **row} for row in rows)
