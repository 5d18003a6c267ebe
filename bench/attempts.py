"""A trial as often as the operator wants it: once, again from its set-up, or not at all. Tells him before each how far the run is.

What is skipped leaves the counts and is kept with its reason. May not know what a trial consists of.
"""

from __future__ import annotations

from collections.abc import Callable

from bench.attention import Attention
from bench.planning import PlannedTrial
from bench.store import Store
from bench.truth.touching import NoTruthError
from instruments.clock import Clock
from instruments.operators.operator import Operator, OperatorRepeat, OperatorSkip


class Attempts:
    """Runs ``planned`` trials, one for each call of ``run``, by ``once``."""

    def __init__(
        self, once: Callable[[PlannedTrial], None], planned: int, operator: Operator, clock: Clock, store: Store, attention: Attention
    ) -> None:
        self._once = once
        self._planned = planned
        self._operator = operator
        self._clock = clock
        self._store = store
        self._attention = attention
        self._taken_s: list[float] = []

    def run(self, trial: PlannedTrial) -> None:
        """Until the trial is in the store or has been skipped. Raises whatever else ``once`` raises."""
        started_s = self._clock.now()
        self._operator.next_trial(trial.number, self._planned, self._left_s())
        try:
            while self._again(trial):
                pass
        except OperatorSkip as skip:
            self._skipped(trial, f"the operator skipped it: {skip.reason}", skip.reason)
        except NoTruthError as none:
            self._skipped(trial, str(none), str(none))
        self._taken_s.append(self._clock.now() - started_s)

    def _again(self, trial: PlannedTrial) -> bool:
        """Whether the operator wants what was just done once more."""
        try:
            self._once(trial)
        except OperatorRepeat:
            self._attention.event("repeated", f"{trial.id}: the operator asked for it again from its set-up")
            return True
        return False

    def _skipped(self, trial: PlannedTrial, told: str, reason: str) -> None:
        row = {"trial": trial.id, "number": trial.number, "name": trial.name, "situation": trial.situation, "repeat": trial.repeat}
        self._store.skipped({**row, "t_s": self._clock.now(), "reason": reason})
        self._attention.event("skipped", f"{trial.id}: {told}")

    def _left_s(self) -> float | None:
        """By the mean of the trials so far; the first says nothing, it waits for the bath to heat up."""
        seen = self._taken_s[1:]
        return sum(seen) / len(seen) * (self._planned - len(self._taken_s)) if seen else None
