"""How long a detector took, out of a run's record: one rule of what counts, for verdicts, report and table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field

from bench.record import RunRecord
from bench.scoring.errors import percentile
from detector.protocol import Outcome

LATENCY_RULE = (
    "Answers and time-outs count; the first call of each process (cold) and its start-up stand apart, failures have no time. "
    "Percentiles are observed values."
)
_TIMED = (Outcome.ANSWERED.value, Outcome.TIMEOUT.value)


@dataclass(frozen=True, slots=True)
class Latency:
    """seconds: what counts, in the order of the trials, and ``poses`` the pose of each. cold_s: first calls. start_up_s: the longest start
    of a process, None for none.

    unanswered: how often each outcome but an answer came about, of ``asked`` calls.
    """

    seconds: tuple[float, ...] = ()
    cold_s: tuple[float, ...] = ()
    start_up_s: float | None = None
    unanswered: Mapping[str, int] = field(default_factory=dict)
    poses: tuple[Hashable, ...] = ()
    asked: int = 0

    @property
    def silent(self) -> int:
        """Calls without an answer, whatever came of them."""
        return sum(self.unanswered.values())

    @property
    def failed(self) -> int:
        """Calls that have no time either: crashes, answers that can't be used, and what followed when it was switched off."""
        return self.silent - self.unanswered.get(Outcome.TIMEOUT.value, 0)

    @property
    def median_s(self) -> float | None:
        """None where nothing was timed."""
        return percentile(self.seconds, 50) if self.seconds else None

    @property
    def p95_s(self) -> float | None:
        """As the median."""
        return percentile(self.seconds, 95) if self.seconds else None

    @property
    def p99_s(self) -> float | None:
        """As the median."""
        return percentile(self.seconds, 99) if self.seconds else None


def latency_of(run: RunRecord, detector: str, situation: str | None = None) -> Latency:
    """The times of one detector over the trials that count; of one situation where named."""
    trials = [trial for trial in run.counted if situation in (None, trial.head["situation"])]
    rows = [row for trial in trials for row in trial.detections if row["detector"] == detector]
    poses = [trial.pose for trial in trials for row in trial.detections if row["detector"] == detector and row["outcome"] in _TIMED]
    timed = [row for row in rows if row["outcome"] in _TIMED]
    starts = [row["wall_start_up_s"] for row in rows if row["wall_start_up_s"] is not None]
    return Latency(
        tuple(row["wall_seconds"] for row in timed if not row["cold"]),
        tuple(row["wall_seconds"] for row in timed if row["cold"]),
        max(starts, default=None),
        Counter(row["outcome"] for row in rows if row["outcome"] != Outcome.ANSWERED.value),
        tuple(pose for pose, row in zip(poses, timed, strict=True) if not row["cold"]),
        len(rows),
    )


def failures_told(latency: Latency) -> str:
    """``3 timeout, 1 failure``; ``none``."""
    return ", ".join(f"{count} {outcome}" for outcome, count in sorted(latency.unanswered.items())) or "none"
