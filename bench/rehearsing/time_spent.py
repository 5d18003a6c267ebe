"""What the time of a rehearsal goes to, by kind of step: told by the run's state and by what is being asked of the operator.

Every second is one kind's, so the kinds add up to the whole. May not know trials.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

from bench.running.run_state import RunState

PREPARING, SETTLING, MOVES, SET_UPS, CAPTURES, TOUCHES = "preparing", "settling", "moves", "set-ups", "captures", "touches"
WAITING, SAFING = "waiting for instruments", "going to safe"
KINDS = (PREPARING, SETTLING, MOVES, SET_UPS, CAPTURES, TOUCHES, WAITING, SAFING)
STATES: Mapping[str, str] = MappingProxyType(
    {
        RunState.PREPARING.value: PREPARING,
        RunState.SETTLING.value: SETTLING,
        RunState.PAUSED.value: WAITING,
        RunState.SAFING.value: SAFING,
    }
)


class TimeSpent:
    """Begins with preparing. ``now_s`` is the time."""

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s = now_s
        self._since_s = now_s()
        self._base = self._kind = PREPARING
        self._before = PREPARING
        self._spent = dict.fromkeys(KINDS, 0.0)
        self.first_settling_s: float | None = None

    def state(self, state: str) -> None:
        """The run is in ``state`` now; back at the trials, what was under way goes on."""
        kind = STATES.get(state)
        if kind is not None:
            self._before, self._base = self._kind, kind
            self._to(kind)
        elif state == RunState.RUNNING:
            settled, self._base = self._kind == SETTLING, MOVES
            self._to(self._before if self._before in (CAPTURES, TOUCHES) else MOVES)
            if settled and self.first_settling_s is None:
                self.first_settling_s = self._spent[SETTLING]

    def work(self, kind: str) -> None:
        """The bench does something of ``kind`` now; before the trials all that it does is preparing."""
        self._to(kind if self._base == MOVES else self._base)

    def asking(self, kind: str) -> None:
        """The operator is busy with something of ``kind`` now."""
        self._to(kind)

    def book(self, seconds: float) -> None:
        """``seconds`` more for what is under way, which didn't pass on the clock."""
        self._spent[self._kind] += seconds

    @property
    def seconds(self) -> dict[str, float]:
        """By kind, up to now."""
        self._to(self._kind)
        return dict(self._spent)

    def _to(self, kind: str) -> None:
        now_s = self._now_s()
        self._spent[self._kind] += now_s - self._since_s
        self._since_s, self._kind = now_s, kind
