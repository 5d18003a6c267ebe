"""Where a trial's truth comes from, as the engine asks for it; and the plain way: every end touched in every trial.

The engine asks in this order: `begin` once, then for each trial `before`, `unattended`, `of_trial` and, when it is in the store,
`stored`; `end` after the last. The other way, `bench.truth.carrying`, touches once and lets the stage carry.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from bench.store import Row
from bench.truth.point import How, Triple, TruthPoint
from bench.truth.touching import Ends, Toucher


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """What stands there for a trial: ``ends`` where they are expected, and `carry.fixed_key` of what no shift changes."""

    trial: str
    ends: Ends
    fixed: str


@dataclass(frozen=True, slots=True)
class TrialTruth:
    """The truth of one trial: a point for each teat, a row for each touch, and where the stage stood (None without one)."""

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

    def before(self, shown: Shown) -> None:
        """The phantom is about to be moved and set up for this."""
        ...

    def unattended(self, shown: Shown) -> bool:
        """Whether nobody has been near the phantom since the last trial was shown, nor is needed for this one."""
        ...

    def of_trial(self, shown: Shown) -> TrialTruth:
        """It stands there, and the cameras have seen it. Raises NoTruthError, and as operator and instruments do."""
        ...

    def stored(self, trial: str, truth: TrialTruth) -> None:
        """The trial is in the store."""
        ...

    def end(self) -> None:
        """After the last trial, as it still stands."""
        ...


class TouchedTruth:
    """Every end of every trial is touched; ``stage_mm`` asks where the stage stands, for the record."""

    def __init__(self, toucher: Toucher, stage_mm: Callable[[], Triple | None]) -> None:
        self._toucher = toucher
        self._stage_mm = stage_mm

    def begin(self) -> None:
        """Nothing to prepare."""

    def before(self, shown: Shown) -> None:
        """Nothing to check."""

    def unattended(self, shown: Shown) -> bool:  # noqa: ARG002 - it always is attended
        """The arm may be in the picture until the operator says that it isn't."""
        return False

    def of_trial(self, shown: Shown) -> TrialTruth:
        points, rows = self._toucher.touch_all(shown.ends)
        return TrialTruth(tuple(points), rows_of(shown.trial, rows), self._stage_mm())

    def stored(self, trial: str, truth: TrialTruth) -> None:
        """Nothing to remember."""

    def end(self) -> None:
        """Nothing to check."""


def rows_of(trial: str, rows: Sequence[Row]) -> tuple[Row, ...]:
    """Rows of touches, as those of this trial."""
    return tuple({"trial": trial, **row} for row in rows)
