"""Where a rehearsal is and what it met there: the engine's progress, and its record without
pictures.

What would end the run, or leave a trial without a truth, is a finding; what the run gets over by
itself is only told.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from datetime import datetime
from pathlib import Path

from bench.dry_run.pose_checks import Finding
from bench.files import Picture
from bench.record.reader import TrialRecord
from bench.record.schema import Row
from bench.record.writer import Store
from bench.run.estimate import TimeSpent
from bench.run.states import EVENT
from bench.script.planned_trials import PlannedTrial
from instruments.clock import wall_time as time_of_day

BEFORE, AFTER = "before the trials", "after the trials"
INTERRUPTED = "the run was interrupted"
OPERATOR_SKIPPED = "the operator skipped it"
# kinds of events: what no run should have
FINDINGS = {"trip": "interlock", "fault": "fault", "invalid": "truth"}
GOT_OVER = {
    "dropped out": "an instrument dropped out and came back",
    "suspended": "the bath left its band, and settled again",
    "repeated": "a trial was repeated",
    "registration": "the stage's registration is in doubt",
}


class RehearsalStore(Store):
    """A record whose events are ``heard``, whose ``trials`` are counted, and which keeps no
    pictures.
    """

    def __init__(
        self,
        folder: Path,
        session: int | None = None,
        *,
        wall: Callable[[], datetime] = time_of_day,
    ) -> None:
        self.heard: Callable[[str, str], None] = lambda _kind, _text: None
        self.trials = 0
        super().__init__(folder, session, wall=wall)

    @classmethod
    def begun(cls, folder: Path, files: Mapping[str, str]) -> RehearsalStore:
        """A new one in ``folder``, with the texts in ``files``."""
        new = Store.create(folder, files)
        new.close()
        return cls(folder, new.session)

    def event(self, t_s: float | None, kind: str, text: str, wall_time: datetime) -> None:
        super().event(t_s, kind, text, wall_time)
        self.heard(kind, text)

    def finished(self, done: TrialRecord) -> None:
        super().finished(done)
        self.trials += 1

    def frames(
        self,
        trial: str,  # noqa: ARG002
        images: Mapping[str, Picture],  # noqa: ARG002
        exposed_s: Mapping[str, float | None],  # noqa: ARG002
    ) -> list[Row]:
        return []


class Course:
    """Progress of a rehearsal of ``planned``; ``shown`` gets how
    many trials are done, of how many.
    """

    def __init__(
        self, planned: Sequence[PlannedTrial], spent: TimeSpent, shown: Callable[[int, int], None]
    ) -> None:
        self._by_number = {one.number: one for one in planned}
        self._planned = len(planned)
        self._begun = 0
        self._spent = spent
        self._shown = shown
        self.interrupted = False
        self.trial_now: PlannedTrial | None = None
        self.findings: list[Finding] = []
        self.recovered: Counter[str] = Counter()

    def state(self, text: str) -> None:
        """Nobody reads along."""

    def trial(self, done: int, total: int, name: str) -> None:  # noqa: ARG002 - the trials say it themselves
        self.trial_now = self._by_number[done + 1] if name else None
        self._shown(self._begun, self._planned)
        self._begun += 1

    def warn(self, text: str) -> None:
        """An event says the same."""

    def aside(self) -> AbstractContextManager[None]:
        return nullcontext()

    @property
    def where(self) -> str:
        """The trial's name, or a word for where there is none."""
        if self.trial_now is not None:
            return self.trial_now.name
        return AFTER if self._begun else BEFORE

    def met(self, kind: str, text: str) -> None:
        """Something is wrong here."""
        if Finding(self.where, kind, text) not in self.findings:
            self.findings.append(Finding(self.where, kind, text))

    def heard(self, kind: str, text: str) -> None:
        """An event of the record."""
        if kind == EVENT:
            self._spent.state(text)
        elif kind in FINDINGS and not (kind == "fault" and self._has("interlock")):
            self.met(FINDINGS[kind], text)
        elif kind == "skipped" and not self._has("reach"):
            self._skipped(text)
        elif kind == "aborted":
            self._aborted(text)
        elif kind in GOT_OVER:
            self.recovered[GOT_OVER[kind]] += 1

    def _skipped(self, text: str) -> None:
        """Hands skip what is out of reach, and that was met; otherwise answers do, as they were
        meant to, or the bench has no truth.
        """
        if OPERATOR_SKIPPED in text:
            self.recovered["the operator's script skips a trial"] += 1
        else:
            self.met("truth", text)

    def _aborted(self, text: str) -> None:
        """The arm that doesn't reach ends a rehearsal, answers may, and anybody by Ctrl-C."""
        self.interrupted = text.startswith(INTERRUPTED)
        if not self.interrupted and not self._has("reach"):
            self.met("aborted", text)

    def _has(self, kind: str) -> bool:
        return any(one.trial == self.where and one.kind == kind for one in self.findings)
