"""Truth that the stage carries: ends touched once at a reference position, computed at every later
one.

end(s) = touched + R (s - s_reference), with R the rigid registration's rotation and s the stage
position as read back from the controller. Only shifts are carried: a phantom that was turned,
rearranged or shifted by hand is another `fixed`, and is touched anew. Pure: it may not know files,
instruments or persons.

Truth that the stage carries: touched once for each thing that stands there, and checked by touch.

Check touches come where the phantom still stands as it stood for the trials that they confirm:
before it is rearranged, every n carried trials, and at the end. A check beyond its limit
invalidates the carried trials since the last good one; its own touches then are the new reference.
All state is in the store: `resumed` reads it back.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from bench.record.reader import RunRecord
from bench.record.writer import Row
from bench.truth.registration import Registration
from bench.truth.touching import Ends, ExpectedScene, NoTruthError, Toucher, TrialTruth, rows_of
from bench.truth.uncertainty import (
    Component,
    How,
    Triple,
    TruthPoint,
    TruthUncertainty,
    moved,
    triple,
)
from instruments.operators.operator import OperatorSkip
from instruments.world.phantom import Phantom, PlatePose

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Reference:
    """Ends touched at one stage position (machine mm), with the teats' ``axes``; ``trial`` says
    when, ``fixed`` of what (`fixed_key`).
    """

    trial: str
    fixed: str
    stage_mm: Triple
    points: tuple[TruthPoint, ...]
    axes: tuple[Triple, ...]

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers and text, for the store; `reference_from_dict` reads it back."""
        ends = [{"point_mm": list(p.point_mm), **p.uncertainty.as_dict()} for p in self.points]
        return {
            "trial": self.trial,
            "fixed": self.fixed,
            "stage_mm": list(self.stage_mm),
            "axes": self.axes,
            "ends": ends,
        }


def reference_from_dict(stored: Mapping[str, Any]) -> Reference:
    """A reference from what `Reference.as_dict` gave."""
    points = []
    for end in stored["ends"]:
        x, y, z = end["point_mm"]
        points.append(
            TruthPoint(
                (x, y, z), TruthUncertainty.of(Component(**line) for line in end["components"])
            )
        )
    a, b, c = stored["stage_mm"]
    axes = tuple((x, y, z) for x, y, z in stored["axes"])
    return Reference(stored["trial"], stored["fixed"], (a, b, c), tuple(points), axes)


def fixed_key(phantom: Phantom, by_hand: PlatePose, yaw_rad: float) -> str:
    """A name for all that the stage's shifts leave as it is: the teats on their plate, the part of
    the pose set by hand, the turn.
    """
    what = (phantom.moved(PlatePose()), by_hand, round(yaw_rad, 9))
    return hashlib.sha256(repr(what).encode()).hexdigest()[:16]


def carried(
    reference: Reference,
    registration: Registration,
    stage_mm: Triple,
    u_registration_mm: Callable[[Floats], float | None],
) -> list[TruthPoint]:
    """The ends when the stage stands at ``stage_mm``; ``u_registration_mm`` is the table frame's
    part at a place, None without one.
    """
    way = registration.carry_mm(reference.stage_mm, stage_mm)
    covariance = registration.carry_covariance_mm2(reference.stage_mm, stage_mm)
    distance = float(np.linalg.norm(way))
    of = (
        f"registration of {len(registration.stations)} positions, the stage's axes and"
        " repeatability"
    )
    source = f"carried {distance:.0f} mm from the touches of {reference.trial}: {of}"
    ends = []
    for point in reference.points:
        there = np.array(point.point_mm) + way
        ends.append(moved(point, there, covariance, source, u_registration_mm(there)))
    return ends


@dataclass(frozen=True, slots=True)
class CheckTouch:
    """One end touched again: where the carry had it, and where it was."""

    teat: int
    touched_mm: Triple
    carried_mm: Triple
    limit_mm: float

    @property
    def off_mm(self) -> float:
        """Distance of the two."""
        return float(np.linalg.norm(np.subtract(self.touched_mm, self.carried_mm)))

    @property
    def held(self) -> bool:
        """Whether the carry was right, as far as the limit tells."""
        return self.off_mm <= self.limit_mm


def check_touches(
    touched: Sequence[TruthPoint], expected: Sequence[TruthPoint], limit_mm: float
) -> tuple[CheckTouch, ...]:
    """The touched ends beside the carried ones, in the order of the teats."""
    pairs = zip(touched, expected, strict=True)
    return tuple(
        CheckTouch(teat, a.point_mm, b.point_mm, limit_mm) for teat, (a, b) in enumerate(pairs, 1)
    )


REFERENCE_FACT, UNCONFIRMED_FACT = "truth reference", "truth unconfirmed"
LOST = "The stage lost its place, or phantom or arm were moved"


class TruthStore(Protocol):
    """What of the store is used."""

    def fact(self, key: str, value: object) -> None: ...
    def checked(
        self, touches: Sequence[Row], confirmed: Sequence[str], invalid: Sequence[str], reason: str
    ) -> None: ...


@dataclass(frozen=True, slots=True)
class CheckRule:
    """A check after ``every`` carried trials (0: only at the end and before a rearrangement), and
    how far off it may be.
    """

    every: int
    limit_mm: float


@dataclass(slots=True)
class CarryState:
    """What a carried truth rests on. ``since`` are the carried trials since the last good check,
    ``checks`` how many there were.

    ``unconfirmed`` are those whose check was skipped, and can't be made up for.
    """

    reference: Reference | None = None
    since: list[str] = field(default_factory=list)
    checks: int = 0
    unconfirmed: list[str] = field(default_factory=list)


class CarriedTruth:
    """Touched once for each thing that stands there, carried by the stage afterwards, and checked
    by touch.

    ``registration`` gives the registration, at `begin`; ``stage_mm`` reads back where the stage
    stands; ``tell`` is for the operator and the record. ``now_s`` is the time.
    """

    def __init__(
        self,
        toucher: Toucher,
        registration: Callable[[], Registration],
        stage_mm: Callable[[], Triple],
        rule: CheckRule,
        store: TruthStore,
        tell: Callable[[str, str], None],
        now_s: Callable[[], float],
        state: CarryState | None = None,
    ) -> None:
        self._toucher = toucher
        self._register = registration
        self._stage_mm = stage_mm
        self._rule = rule
        self._store = store
        self._tell = tell
        self._now_s = now_s
        self._state = state or CarryState()
        self._registration: Registration | None = None
        self._begun = ""
        self._away = False

    def begin(self) -> None:
        """Have the registration, and say what speaks against it."""
        self._registration = self._register()
        for fault in self._registration.faults:
            self._tell("registration", fault)

    def before(self, shown: ExpectedScene) -> None:
        """Check what the carried trials so far rest on, where it is time or where it is about to be
        changed.
        """
        state, again = self._state, shown.trial == self._begun
        self._begun = shown.trial
        if state.reference is None:
            return
        rearranged = again or state.reference.fixed != shown.fixed
        if state.since and (rearranged or 0 < self._rule.every <= len(state.since)):
            self._check(state.reference)
        if rearranged:  # what was touched stands no more, even where it is put back later
            self._give_up()
            why = (
                "is done again from its set-up"
                if again
                else "has other teats, a turn or a shift by hand, and only the stage's shifts carry"
            )
            self._tell("state", f"{shown.trial} {why}: its ends are touched anew")
            self._refer(None)

    def unattended(self, shown: ExpectedScene) -> bool:
        """Carried, and the arm was put away before the trial before this one."""
        reference = self._state.reference
        return self._away and reference is not None and reference.fixed == shown.fixed

    def of_trial(self, shown: ExpectedScene) -> TrialTruth:
        """Carried where the same thing was touched before, else touched, and the reference for what
        follows.
        """
        stage_mm, reference = self._stage_mm(), self._state.reference
        if reference is not None and reference.fixed == shown.fixed:
            self._away = True
            return TrialTruth(tuple(self._carried(reference, stage_mm)), (), stage_mm)
        self._away = False
        points, rows = self._toucher.touch_all(shown.ends)
        axes = tuple(triple(axis) for axis in shown.ends.axes)
        self._refer(Reference(shown.trial, shown.fixed, stage_mm, tuple(points), axes))
        return TrialTruth(tuple(points), rows_of(shown.trial, rows), stage_mm)

    def stored(self, trial: str, truth: TrialTruth) -> None:
        """Remember that this trial rests on the reference."""
        if truth.how is How.CARRIED:
            self._state.since.append(trial)

    def end(self) -> None:
        """Check what the last carried trials rest on. Who skips that leaves them unconfirmed."""
        if self._state.since and self._state.reference is not None:
            self._check(self._state.reference)
        self._give_up()

    def _check(self, reference: Reference) -> None:
        """Touch the ends again where the stage has them now. What follows from it is in the store
        before anything else happens.
        """
        state, number = self._state, self._state.checks + 1
        self._away = False
        self._tell(
            "state", f"check touch {number} of the carried truth, after trial {state.since[-1]}"
        )
        stage_mm = self._stage_mm()
        expected = self._carried(reference, stage_mm)
        try:
            touched, _ = self._toucher.touch_all(
                Ends(np.array([p.point_mm for p in expected]), np.array(reference.axes))
            )
        except OperatorSkip as skip:  # a wish about this check, not about the trial to come
            self._tell(
                "check touch",
                f"check touch {number} was skipped: {skip.reason}. {counted(len(state.since))}"
                " unconfirmed so far",
            )
            return
        except NoTruthError as none:
            self._failed(number, (), f"check touch {number}: {none}")
            self._refer(None)
            return
        touches = check_touches(touched, expected, self._rule.limit_mm)
        worst = max(touches, key=lambda one: one.off_mm)
        found = (
            f"check touch {number}: the worst end, teat {worst.teat}, is {worst.off_mm:.2f} mm from"
            f" where it was carried to, limit {worst.limit_mm:g} mm"
        )
        rows = [_check_row(number, state.since[-1], self._now_s(), one) for one in touches]
        if not worst.held:
            self._failed(number, rows, found)
            self._refer(
                Reference(
                    f"check touch {number}",
                    reference.fixed,
                    stage_mm,
                    tuple(touched),
                    reference.axes,
                )
            )
            return
        self._store.checked(rows, tuple(state.since), (), "")
        self._tell("check touch", f"{found}: {counted(len(state.since))} confirmed")
        state.checks = number
        state.since.clear()

    def _failed(self, number: int, rows: Sequence[Row], found: str) -> None:
        """Invalidate what no good check has confirmed."""
        since = tuple(self._state.since)
        self._store.checked(rows, (), since, f"{found}; carried since the last good check. {LOST}")
        self._tell(
            "invalid",
            f"{found}. Invalidated, as carried since the last good check: {', '.join(since)}."
            f" {LOST}",
        )
        self._state.checks = number
        self._state.since.clear()

    def _give_up(self) -> None:
        """What no check has confirmed by now, none can confirm any more."""
        if self._state.since:
            self._state.unconfirmed += self._state.since
            self._state.since.clear()
            self._store.fact(UNCONFIRMED_FACT, self._state.unconfirmed)

    def _refer(self, reference: Reference | None) -> None:
        self._state.reference = reference
        self._store.fact(REFERENCE_FACT, None if reference is None else reference.as_dict())

    def _carried(self, reference: Reference, stage_mm: Triple) -> list[TruthPoint]:
        if self._registration is None:
            raise ValueError("a carried truth has to begin before the first trial")
        return carried(reference, self._registration, stage_mm, self._toucher.u_registration_mm)


def resumed(run: RunRecord) -> CarryState:
    """The state that a stopped run left in its store: the reference, and which carried trials no
    good check has confirmed yet.
    """
    stored, unconfirmed = run.facts.get(REFERENCE_FACT), list(run.facts.get(UNCONFIRMED_FACT, ()))
    last = run.checks[-1]["after_trial"] if run.checks else None
    order = [trial.id for trial in run.trials]
    later = order[order.index(last) + 1 :] if last in order else order
    by_id = {trial.id: trial for trial in run.trials}
    since = [
        name
        for name in later
        if by_id[name].how == How.CARRIED
        and by_id[name].invalid is None
        and name not in unconfirmed
    ]
    checks = max((int(row["number"]) for row in run.checks), default=0)
    return CarryState(reference_from_dict(stored) if stored else None, since, checks, unconfirmed)


def counted(trials: int) -> str:
    """``1 trial is``, ``2 trials are``."""
    return "1 trial is" if trials == 1 else f"{trials} trials are"


def _check_row(number: int, after: str, t_s: float, one: CheckTouch) -> Row:
    x, y, z = one.touched_mm
    cx, cy, cz = one.carried_mm
    return {
        "number": number,
        "teat": str(one.teat),
        "after_trial": after,
        "t_s": t_s,
        "x_mm": x,
        "y_mm": y,
        "z_mm": z,
        "carried_x_mm": cx,
        "carried_y_mm": cy,
        "carried_z_mm": cz,
        "off_mm": one.off_mm,
        "limit_mm": one.limit_mm,
        "held": int(one.held),
    }
