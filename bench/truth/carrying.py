"""Truth that the stage carries: touched once for each thing that stands there, computed at every
later stage position, and checked by touch.

end(s) = touched + R (s - s_reference), with R the rigid registration's rotation and s the stage
position as read back. Only shifts are carried: a phantom that was turned, rearranged or shifted by
hand is another `fixed`, and is touched anew.

Check touches come before the phantom is rearranged, every n carried trials, and at the end. A check
beyond its limit invalidates the carried trials since the last good one; its own touches then are
the new reference. All state is in the store: `resumed` reads it back.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any

import numpy as np

from bench.record.reader import RunRecord
from bench.record.schema import Row
from bench.record.writer import Store
from bench.scoring.errors import Floats
from bench.truth.registration import Registration
from bench.truth.touching import Ends, ExpectedScene, NoTruthError, SoFar, TouchedTruth, TrialTruth
from bench.truth.uncertainty import (
    CARRY,
    REGISTRATION,
    Component,
    Triple,
    TrueEnd,
    TruthMethod,
    TruthUncertainty,
    triple,
)
from instruments.operators.operator import OperatorSkip
from instruments.world.phantom import Phantom, PlatePose
from textfiles.text import plural


@dataclass(frozen=True, slots=True)
class Reference:
    """Ends touched at one stage position (machine mm), with the teats' ``axes`` and ``names``;
    ``trial`` says when, ``fixed`` of what (`fixed_key`).
    """

    trial: str
    fixed: str
    stage_mm: Triple
    points: tuple[TrueEnd, ...]
    axes: tuple[Triple, ...]
    names: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers and text, for the store; `reference_from_dict` reads it back."""
        ends = [{"point_mm": list(p.xyz_mm), **p.uncertainty.as_dict()} for p in self.points]
        plain = {"trial": self.trial, "fixed": self.fixed, "stage_mm": list(self.stage_mm)}
        return {**plain, "axes": self.axes, "names": self.names, "ends": ends}


def reference_from_dict(stored: Mapping[str, Any]) -> Reference:
    points = tuple(
        TrueEnd.at(
            end["point_mm"],
            TruthUncertainty(tuple(Component(**line) for line in end["components"])),
        )
        for end in stored["ends"]
    )
    axes = tuple(triple(axis) for axis in stored["axes"])
    at, names = triple(stored["stage_mm"]), tuple(stored.get("names", ()))
    return Reference(stored["trial"], stored["fixed"], at, points, axes, names)


def fixed_key(phantom: Phantom, by_hand: PlatePose, yaw_rad: float) -> str:
    """A name for what the stage's shifts leave as it is: teats, the pose set by hand, the turn."""
    what = (phantom.moved(PlatePose()), by_hand, round(yaw_rad, 9))
    return hashlib.sha256(repr(what).encode()).hexdigest()[:16]


def carried(
    reference: Reference,
    registration: Registration,
    stage_mm: Triple,
    u_registration_mm: Callable[[Floats], float | None],
) -> list[TrueEnd]:
    """The ends with the stage at ``stage_mm``; ``u_registration_mm`` is the table frame's part."""
    way = registration.carry_mm(reference.stage_mm, stage_mm)
    covariance = registration.carry_covariance_mm2(reference.stage_mm, stage_mm)
    source = (
        f"carried {np.linalg.norm(way):.0f} mm from the touches of {reference.trial}: registration"
        f" of {len(registration.stations)} positions, the stage's axes and repeatability"
    )
    places = [np.array(point.xyz_mm) + way for point in reference.points]
    return [
        moved(point, there, covariance, source, u_registration_mm(there))
        for point, there in zip(reference.points, places, strict=True)
    ]


def moved(
    point: TrueEnd, to_mm: Floats, carry_mm2: Floats, source: str, registration_mm: float | None
) -> TrueEnd:
    """``point`` carried to (3,), with a line for the carry in its budget."""
    kept = [
        c if c.name != REGISTRATION or registration_mm is None else replace(c, u_mm=registration_mm)
        for c in point.uncertainty.components
    ]
    worst = float(np.sqrt(max(np.linalg.eigvalsh(carry_mm2)[-1], 0.0)))
    budget = TruthUncertainty((*kept, Component(CARRY, worst, source)))
    there, carry = TrueEnd.at(to_mm, budget), tuple(triple(row) for row in carry_mm2)
    return replace(there, how=TruthMethod.CARRIED, carry_mm2=carry)


REFERENCE_FACT, UNCONFIRMED_FACT = "truth reference", "truth unconfirmed"
LOST = "The stage lost its place, or phantom or arm were moved"


@dataclass(slots=True)
class CarryState:
    """What a carried truth rests on: the carried trials ``since`` the last good check, how many
    ``checks``, and trials ``unconfirmed`` for good since their check was skipped.
    """

    reference: Reference | None = None
    since: list[str] = field(default_factory=list)
    checks: int = 0
    unconfirmed: list[str] = field(default_factory=list)


@dataclass(eq=False)
class CarriedTruth(TouchedTruth):
    """Touched once, then carried by the stage, and checked by touch after ``every`` carried trials
    within ``limit_mm``. ``settled`` gets trials that a check confirmed or invalidated.
    """

    stage_mm: Callable[[], Triple]
    register: Callable[[], Registration]
    store: Store
    settled: Callable[[Sequence[str], bool], None]
    report: Callable[[str, str], None]
    now_s: Callable[[], float]
    _: KW_ONLY
    every: int
    limit_mm: float
    state: CarryState = field(default_factory=CarryState)
    registration: Registration | None = field(default=None, init=False)
    begun: str = field(default="", init=False)
    away: bool = field(default=False, init=False)

    def begin(self) -> None:
        """Get the registration, and report its faults."""
        self.registration = self.register()
        for fault in self.registration.faults:
            self.report("registration", fault)

    def before(self, shown: ExpectedScene) -> None:
        """Check the carried trials so far where it is time, or before the phantom is changed."""
        state, again = self.state, shown.trial == self.begun
        self.begun = shown.trial
        if state.reference is None:
            return
        rearranged = again or state.reference.fixed != shown.fixed
        if state.since and (rearranged or 0 < self.every <= len(state.since)):
            self._check(state.reference)
        if rearranged:  # what was touched stands no more, even where it is put back later
            self._give_up()
            why = (
                "is done again from its set-up"
                if again
                else "has other teats, a turn or a shift by hand, and only the stage's shifts carry"
            )
            self.report("state", f"{shown.trial} {why}: its ends are touched anew")
            self._refer(None)

    def unattended(self, shown: ExpectedScene) -> bool:
        """Carried, and the arm was put away before the trial before this one."""
        reference = self.state.reference
        return self.away and reference is not None and reference.fixed == shown.fixed

    def of_trial(self, shown: ExpectedScene, so_far: SoFar | None = None) -> TrialTruth:
        """Carried where the same thing was touched before; else touched, as the new reference."""
        reference = self.state.reference
        self.away = reference is not None and reference.fixed == shown.fixed
        if reference is not None and self.away:
            stage_mm = self.stage_mm()
            return TrialTruth(tuple(self._carried(reference, stage_mm)), (), stage_mm)
        truth = super().of_trial(shown, so_far)
        stage_mm = truth.stage_mm or self.stage_mm()
        axes = tuple(triple(axis) for axis in shown.ends.axes)
        names = shown.ends.names
        self._refer(Reference(shown.trial, shown.fixed, stage_mm, truth.points, axes, names))
        return truth

    def stored(self, trial: str, truth: TrialTruth) -> None:
        """Note that this trial was carried, for the next check."""
        if truth.how is TruthMethod.CARRIED:
            self.state.since.append(trial)

    def end(self) -> None:
        """Check what the last carried trials rest on; skipped, it leaves them unconfirmed."""
        if self.state.since and self.state.reference is not None:
            self._check(self.state.reference)
        self._give_up()

    def _check(self, reference: Reference) -> None:
        """Touch the ends again where the stage has them now; what follows is stored first."""
        state, number = self.state, self.state.checks + 1
        after = state.since[-1]
        self.away = False
        self.report("state", f"check touch {number} of the carried truth, after trial {after}")
        stage_mm = self.stage_mm()
        expected = self._carried(reference, stage_mm)
        places = np.array([point.xyz_mm for point in expected])
        ends = Ends(places, np.array(reference.axes), names=reference.names)
        try:
            seen, _ = self.toucher.touch_all(ends)
        except OperatorSkip as skip:  # a wish about this check, not about the trial to come
            self.report(
                "check touch",
                f"check touch {number} was skipped: {skip.reason}."
                f" {plural(len(state.since), 'trial', 'is')} unconfirmed so far",
            )
            return
        except NoTruthError as none:
            self._failed(number, (), f"check touch {number}: {none}")
            self._refer(None)
            return
        touches = np.array([point.xyz_mm for point in seen])
        off_mm, limit_mm = np.linalg.norm(touches - places, axis=1), self.limit_mm
        names = ("x_mm", "y_mm", "z_mm", "carried_x_mm", "carried_y_mm", "carried_z_mm")
        rows = [
            {
                "number": number,
                "teat": str(teat),
                "after_trial": after,
                "t_s": self.now_s(),
                **dict(zip(names, (*touch.tolist(), *place.tolist()), strict=True)),
                "off_mm": float(off),
                "limit_mm": limit_mm,
                "held": int(off <= limit_mm),
            }
            for teat, (touch, place, off) in enumerate(zip(touches, places, off_mm, strict=True), 1)
        ]
        worst = int(np.argmax(off_mm))
        found = (
            f"check touch {number}: the worst end, {ends.called(worst + 1)}, is {off_mm[worst]:.2f}"
            f" mm from where it was carried to, limit {limit_mm:g} mm"
        )
        if off_mm[worst] > limit_mm:
            self._failed(number, rows, found)
            name, points = f"check touch {number}", tuple(seen)
            self._refer(replace(reference, trial=name, stage_mm=stage_mm, points=points))
            return
        since = tuple(state.since)
        self.store.checked(rows, (), "")
        self.settled(since, True)
        self.report("check touch", f"{found}: {plural(len(since), 'trial', 'is')} confirmed")
        state.checks = number
        state.since.clear()

    def _failed(self, number: int, rows: Sequence[Row], found: str) -> None:
        """Invalidate what no good check has confirmed."""
        since = tuple(self.state.since)
        self.store.checked(rows, since, f"{found}; carried since the last good check. {LOST}")
        self.settled(since, False)
        self.report(
            "invalid",
            f"{found}. Invalidated, as carried since the last good check: {', '.join(since)}."
            f" {LOST}",
        )
        self.state.checks = number
        self.state.since.clear()

    def _give_up(self) -> None:
        """Mark the carried trials that no check has confirmed as unconfirmed for good."""
        if self.state.since:
            self.state.unconfirmed += self.state.since
            self.state.since.clear()
            self.store.fact(UNCONFIRMED_FACT, self.state.unconfirmed)

    def _refer(self, reference: Reference | None) -> None:
        self.state.reference = reference
        self.store.fact(REFERENCE_FACT, None if reference is None else reference.as_dict())

    def _carried(self, reference: Reference, stage_mm: Triple) -> list[TrueEnd]:
        if self.registration is None:
            raise ValueError("a carried truth has to begin before the first trial")
        return carried(reference, self.registration, stage_mm, self.toucher.tip.u_registration_mm)


def resumed(run: RunRecord) -> CarryState:
    """The state that a stopped run left."""
    stored, unconfirmed = run.facts.get(REFERENCE_FACT), list(run.facts.get(UNCONFIRMED_FACT, ()))
    last = run.checks[-1]["after_trial"] if run.checks else None
    order = [trial.id for trial in run.trials]
    later = run.trials[order.index(last) + 1 :] if last in order else run.trials
    since = [
        trial.id
        for trial in later
        if trial.how == TruthMethod.CARRIED
        and trial.invalid is None
        and trial.id not in unconfirmed
    ]
    checks = max((int(row["number"]) for row in run.checks), default=0)
    return CarryState(reference_from_dict(stored) if stored else None, since, checks, unconfirmed)
