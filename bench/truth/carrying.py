"""Truth that the stage carries: touched once for each thing that stands there, and checked by touch.

Check touches come where the phantom still stands as it stood for the trials that they confirm: before it is rearranged, every n
carried trials, and at the end. A check beyond its limit invalidates the carried trials since the last good one; its own touches then
are the new reference. All state is in the store: `resumed` reads it back.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from bench.record import RunRecord
from bench.store import Row
from bench.truth.carry import CheckTouch, Reference, carried, check_touches, reference_from_dict
from bench.truth.point import How, Triple, TruthPoint, triple
from bench.truth.registration import Registration
from bench.truth.source import Shown, TrialTruth, rows_of
from bench.truth.touching import Ends, NoTruthError, Toucher
from instruments.operators.operator import OperatorSkip

REFERENCE_FACT, UNCONFIRMED_FACT = "truth reference", "truth unconfirmed"
LOST = "The stage lost its place, or phantom or arm were moved"


class TruthStore(Protocol):
    """What of the store is used."""

    def fact(self, key: str, value: object) -> None: ...
    def checked(self, touches: Sequence[Row], confirmed: Sequence[str], invalid: Sequence[str], reason: str) -> None: ...


@dataclass(frozen=True, slots=True)
class CheckRule:
    """A check after ``every`` carried trials (0: only at the end and before a rearrangement), and how far off it may be."""

    every: int
    limit_mm: float


@dataclass(slots=True)
class CarryState:
    """What a carried truth rests on. ``since`` are the carried trials since the last good check, ``checks`` how many there were.

    ``unconfirmed`` are those whose check was skipped, and can't be made up for.
    """

    reference: Reference | None = None
    since: list[str] = field(default_factory=list)
    checks: int = 0
    unconfirmed: list[str] = field(default_factory=list)


class CarriedTruth:
    """Touched once for each thing that stands there, carried by the stage afterwards, and checked by touch.

    ``registration`` gives the registration, at `begin`; ``stage_mm`` reads back where the stage stands; ``tell`` is for the operator
    and the record. ``now_s`` is the time.
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

    def before(self, shown: Shown) -> None:
        """Check what the carried trials so far rest on, where it is time or where it is about to be changed."""
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

    def unattended(self, shown: Shown) -> bool:
        """Carried, and the arm was put away before the trial before this one."""
        reference = self._state.reference
        return self._away and reference is not None and reference.fixed == shown.fixed

    def of_trial(self, shown: Shown) -> TrialTruth:
        """Carried where the same thing was touched before, else touched, and the reference for what follows."""
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
        """Touch the ends again where the stage has them now. What follows from it is in the store before anything else happens."""
        state, number = self._state, self._state.checks + 1
        self._away = False
        self._tell("state", f"check touch {number} of the carried truth, after trial {state.since[-1]}")
        stage_mm = self._stage_mm()
        expected = self._carried(reference, stage_mm)
        try:
            touched, _ = self._toucher.touch_all(Ends(np.array([p.point_mm for p in expected]), np.array(reference.axes)))
        except OperatorSkip as skip:  # a wish about this check, not about the trial to come
            self._tell("check touch", f"check touch {number} was skipped: {skip.reason}. {counted(len(state.since))} unconfirmed so far")
            return
        except NoTruthError as none:
            self._failed(number, (), f"check touch {number}: {none}")
            self._refer(None)
            return
        touches = check_touches(touched, expected, self._rule.limit_mm)
        worst = max(touches, key=lambda one: one.off_mm)
        found = (
            f"check touch {number}: the worst end, teat {worst.teat}, is {worst.off_mm:.2f} mm from where it was carried to, "
            f"limit {worst.limit_mm:g} mm"
        )
        rows = [_check_row(number, state.since[-1], self._now_s(), one) for one in touches]
        if not worst.held:
            self._failed(number, rows, found)
            self._refer(Reference(f"check touch {number}", reference.fixed, stage_mm, tuple(touched), reference.axes))
            return
        self._store.checked(rows, tuple(state.since), (), "")
        self._tell("check touch", f"{found}: {counted(len(state.since))} confirmed")
        state.checks = number
        state.since.clear()

    def _failed(self, number: int, rows: Sequence[Row], found: str) -> None:
        """Invalidate what no good check has confirmed."""
        since = tuple(self._state.since)
        self._store.checked(rows, (), since, f"{found}; carried since the last good check. {LOST}")
        self._tell("invalid", f"{found}. Invalidated, as carried since the last good check: {', '.join(since)}. {LOST}")
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
    """The state that a stopped run left in its store: the reference, and which carried trials no good check has confirmed yet."""
    stored, unconfirmed = run.facts.get(REFERENCE_FACT), list(run.facts.get(UNCONFIRMED_FACT, ()))
    last = run.checks[-1]["after_trial"] if run.checks else None
    order = [trial.id for trial in run.trials]
    later = order[order.index(last) + 1 :] if last in order else order
    by_id = {trial.id: trial for trial in run.trials}
    since = [name for name in later if by_id[name].how == How.CARRIED and by_id[name].invalid is None and name not in unconfirmed]
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
