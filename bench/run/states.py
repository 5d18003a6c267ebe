"""The states of a run and which may follow which: one table, which a test walks pair by pair and
docs/runs.md draws and explains.

Time spent away from the work (paused, or settling once more) is counted here, so that no figure of
speed has it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from enum import StrEnum

EVENT = "run state"  # the kind of a change of state, in the record


class RunState(StrEnum):
    """Where a run is."""

    PLANNED = "planned"
    PREPARING = "preparing"
    SETTLING = "settling"
    RUNNING = "running"
    PAUSED = "paused"
    SAFING = "safing"
    FINISHED = "finished"
    ABORTED = "aborted"
    FAULTED = "faulted"


_S = RunState
TABLE: Mapping[RunState, frozenset[RunState]] = {
    _S.PLANNED: frozenset({_S.PREPARING, _S.SAFING, _S.ABORTED, _S.FAULTED}),
    _S.PREPARING: frozenset({_S.SETTLING, _S.RUNNING, _S.PAUSED, _S.SAFING}),
    _S.SETTLING: frozenset({_S.RUNNING, _S.PAUSED, _S.SAFING}),
    _S.RUNNING: frozenset({_S.SETTLING, _S.PAUSED, _S.SAFING}),
    _S.PAUSED: frozenset({_S.PREPARING, _S.SETTLING, _S.RUNNING, _S.SAFING}),
    _S.SAFING: frozenset({_S.FINISHED, _S.ABORTED, _S.FAULTED}),
    _S.FINISHED: frozenset(),
    _S.ABORTED: frozenset(),
    _S.FAULTED: frozenset(),
}
ENDS = frozenset(state for state, following in TABLE.items() if not following)
AWAY = frozenset({_S.PAUSED, _S.SETTLING})


class RunStates:
    """The state of one run. ``tell`` gets each change, ``now_s`` is the time."""

    def __init__(self, tell: Callable[[RunState], None], now_s: Callable[[], float]) -> None:
        self._tell = tell
        self._now_s = now_s
        self._since_s = now_s()
        self._away_s = 0.0
        self.current = RunState.PLANNED

    def to(self, state: RunState) -> None:
        """Change to ``state``; staying is no change. Raises ValueError for a change that the table
        doesn't have.
        """
        if state is self.current:
            return
        if state not in TABLE[self.current]:
            only = ", ".join(sorted(TABLE[self.current])) or "nothing"
            raise ValueError(f"a run that is {self.current} can't be {state} next (only {only})")
        self._away_s, self._since_s = self.away_s, self._now_s()
        self.current = state
        self._tell(state)

    @contextmanager
    def during(self, state: RunState) -> Iterator[None]:
        """In ``state`` while this lasts, then back; where it ends by an exception the state stays,
        for that is where it happened.
        """
        before = self.current
        self.to(state)
        yield
        self.to(before)

    @property
    def away_s(self) -> float:
        """Seconds spent paused or settling so far."""
        return self._away_s + (self._now_s() - self._since_s if self.current in AWAY else 0.0)
