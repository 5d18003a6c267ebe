"""A trial as often as it takes: once, again from its set-up where somebody wants it or an instrument dropped out, or not at all.

Tells the operator before each how far the run is. What is skipped leaves the counts and is kept with its reason; a trial in flight is
done again whole. May not know what a trial consists of.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from bench.planning.trials import PlannedTrial
from bench.running.attention import Attention
from bench.store import Store
from bench.truth.touching import NoTruthError
from instruments.clock import Clock
from instruments.operators.operator import Operator, OperatorRepeat, OperatorSkip


class Attempts:
    """Runs ``planned`` trials, one for each call of ``run``, by ``once``.

    ``through`` does a piece of work until no instrument has interrupted it; ``away_s`` tells the time that was no work at all.
    ``poison`` are trials that aren't tried again, with the reason; ``each_s`` is what a trial is expected to take, where that is known.
    """

    def __init__(
        self,
        once: Callable[[PlannedTrial], None],
        planned: int,
        operator: Operator,
        clock: Clock,
        store: Store,
        attention: Attention,
        *,
        through: Callable[[str, Callable[[], None]], None] = lambda _, work: work(),
        away_s: Callable[[], float] = lambda: 0.0,
        poison: Mapping[str, str] | None = None,
        each_s: float | None = None,
    ) -> None:
        self._once = once
        self._planned = planned
        self._operator = operator
        self._clock = clock
        self._store = store
        self._attention = attention
        self._through = through
        self._away_s = away_s
        self._poison = dict(poison or {})
        self._each_s = each_s
        self._done = 0
        self._started_s: float | None = None  # of the trial under way
        self._taken_s: list[float] = []

    def run(self, trial: PlannedTrial) -> None:
        """Until the trial is in the store or has been skipped. Raises whatever else ``once`` raises."""
        started_s = self._started_s = self._working_s()
        self._operator.next_trial(trial.number, self._planned, self.left_s)
        try:
            if why := self._poison.get(trial.id):
                raise OperatorSkip(why)
            while self._again(trial):
                pass
        except OperatorSkip as skip:
            by = "the bench" if trial.id in self._poison else "the operator"
            self._skipped(trial, f"{by} skipped it: {skip.reason}", skip.reason)
        except NoTruthError as none:
            self._skipped(trial, str(none), str(none))
        self._done += 1
        self._started_s = None
        self._taken_s.append(self._working_s() - started_s)

    def passed(self) -> None:
        """A trial that needs nothing: it was done before this session."""
        self._done += 1

    @property
    def left_s(self) -> float | None:
        """By the mean of the trials so far, but for the first, and until then by what was expected."""
        seen = self._taken_s[1:]
        each_s = sum(seen) / len(seen) if seen else self._each_s
        if each_s is None:
            return None
        under_way_s = self._working_s() - self._started_s if self._started_s is not None else 0.0
        return each_s * (self._planned - self._done) - min(each_s, under_way_s)

    def _again(self, trial: PlannedTrial) -> bool:
        """Whether somebody wants what was just done once more."""
        try:
            self._through(f"trial {trial.id}", lambda: self._once(trial))
        except OperatorRepeat as wish:
            self._attention.event("repeated", f"{trial.id}: the operator asked for it again from its set-up{_because(wish)}")
            return True
        return False

    def _skipped(self, trial: PlannedTrial, told: str, reason: str) -> None:
        row = {"trial": trial.id, "number": trial.number, "name": trial.name, "situation": trial.situation, "repeat": trial.repeat}
        self._store.skipped({**row, "t_s": self._clock.now(), "reason": reason})
        self._attention.event("skipped", f"{trial.id}: {told}")

    def _working_s(self) -> float:
        return self._clock.now() - self._away_s()


def _because(wish: OperatorRepeat) -> str:
    """The reason, where one was given."""
    return f": {wish.reason}" if wish.reason else ""
