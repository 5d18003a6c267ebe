"""How long a detector took, out of a run's record: one rule of what counts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field

from bench.record.reader import RunRecord
from bench.scoring.errors import percentile
from detector.protocol import Outcome

LATENCY_RULE = (
    "Answers and time-outs count; the first call of each process (cold) and its start-up stand"
    " apart, failures have no time. Percentiles are observed values."
)
STARVED_BELOW = 0.7  # share of a processor
LEAST_TIMED_S = 0.2  # in all: a system may count a process's time in steps of 16 ms
_TIMED = (Outcome.ANSWERED.value, Outcome.TIMEOUT.value)


@dataclass(frozen=True, slots=True)
class Latency:
    """seconds: what counts, in the order of the trials, and ``poses`` the pose of each. cold_s:
    first calls. start_up_s: the longest start of a process, None for none.

    unanswered: how often each outcome but an answer came about, of ``asked`` calls. cpu_s and
    loads: as in `Answer`, for each of ``seconds``.
    """

    seconds: tuple[float, ...] = ()
    cold_s: tuple[float, ...] = ()
    start_up_s: float | None = None
    unanswered: Mapping[str, int] = field(default_factory=dict)
    poses: tuple[Hashable, ...] = ()
    cpu_s: tuple[float | None, ...] = ()
    loads: tuple[float | None, ...] = ()
    asked: int = 0

    @property
    def silent(self) -> int:
        """Calls without an answer, whatever came of them."""
        return sum(self.unanswered.values())

    @property
    def failed(self) -> int:
        """Calls without a time: crashes, unusable answers, and calls after it was switched off."""
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

    @property
    def starved(self) -> str:
        """A warning where the machine gave the detector less than `STARVED_BELOW` of a processor.

        In the bench's process by processor seconds over elapsed; of another process by the
        machine's load.
        """
        timed = list(zip(self.cpu_s, self.seconds, self.loads, strict=True))
        used = [(cpu_s, seconds) for cpu_s, seconds, _ in timed if cpu_s is not None]
        loads = [load for cpu_s, _, load in timed if load is not None and cpu_s is None]
        cpu_s, wall_s = (sum(column) for column in zip(*used, strict=True)) if used else (0.0, 0.0)
        load = percentile(loads, 50) if loads else 0.0
        if wall_s >= LEAST_TIMED_S and cpu_s < STARVED_BELOW * wall_s:
            why = f"in {wall_s:.1f} s of detection it had a processor for {cpu_s:.1f} s; it waited"
            why += " for one, or for something else"
        elif load > 1.0 / STARVED_BELOW:
            why = f"half of the time {load:.1f} or more processes wanted each processor"
        else:
            return ""
        return (
            f"THE MACHINE WAS TOO BUSY FOR THESE TIMES TO HOLD: {why}. On an idle machine they may"
            " be shorter."
        )


def latency_of(run: RunRecord, detector: str, situation: str | None = None) -> Latency:
    """The times of one detector over the trials that count; of one situation where named."""
    rows = [
        (trial.pose, row)
        for trial in run.counted
        if situation in (None, trial.head["situation"])
        for row in trial.detections
        if row["detector"] == detector
    ]
    timed = [(pose, row) for pose, row in rows if row["outcome"] in _TIMED]
    warm = [(pose, row) for pose, row in timed if not row["cold"]]
    outcomes = Counter(row["outcome"] for _, row in rows)
    del outcomes[Outcome.ANSWERED.value]
    starts = [row["wall_start_up_s"] for _, row in rows if row["wall_start_up_s"] is not None]
    return Latency(
        seconds=tuple(row["wall_seconds"] for _, row in warm),
        cold_s=tuple(row["wall_seconds"] for _, row in timed if row["cold"]),
        start_up_s=max(starts, default=None),
        unanswered=outcomes,
        poses=tuple(pose for pose, _ in warm),
        cpu_s=tuple(row["wall_cpu_s"] for _, row in warm),
        loads=tuple(row["wall_load"] for _, row in warm),
        asked=len(rows),
    )


def failures_told(latency: Latency) -> str:
    """``3 timeout, 1 failure``; ``none``."""
    counts = sorted(latency.unanswered.items())
    return ", ".join(f"{count} {outcome}" for outcome, count in counts) or "none"
