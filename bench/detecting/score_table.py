"""Situations by detectors as one table for a terminal and for a README: found, false, errors, time. Pure: a run's record in, text out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from bench.detecting.latency import LATENCY_RULE, failures_told, latency_of
from bench.record import RunRecord
from bench.summary.tables import situations
from bench.verdicts import scored

HEAD = (
    "situation", "detector", "frame sets", "found of visible", "false", "mean, p95, max error (mm)", "median, p99 time (ms)", "no answer",
)  # fmt: skip
ALL = "all"


def score_table(run: RunRecord) -> str:
    """The table in Markdown, with what it says below it; without truth, a sentence."""
    if not any(trial.scores for trial in run.trials):
        return "There is no truth, so nothing was scored."
    rows = [HEAD, *(_row(run, situation, detector) for situation in _situations(run) for detector in run.detectors)]
    widths = [max(len(row[column]) for row in rows) for column in range(len(HEAD))]
    lines = [_line(row, widths) for row in rows]
    rule = "|" + "|".join("-" * (width + 2) for width in widths) + "|"
    return "\n".join([lines[0], rule, *lines[1:], "", *_notes(run)])


def _situations(run: RunRecord) -> list[str | None]:
    names = situations(run)
    return [*names, None] if len(names) > 1 else [*names]


def _row(run: RunRecord, situation: str | None, detector: str) -> tuple[str, ...]:
    pool, times = scored(run, detector, situation), latency_of(run, detector, situation)
    counts, radial = pool.counts, pool.summary().radial
    errors = "not measured" if radial.n == 0 else f"{radial.mean_mm:.2f}, {radial.p95_mm:.2f}, {radial.max_mm:.2f}"
    time = "not measured" if times.median_s is None or times.p99_s is None else f"{1e3 * times.median_s:.0f}, {1e3 * times.p99_s:.0f}"
    found = f"{counts.matched} of {counts.visible}"
    return (_cell(situation or ALL), detector, str(len(pool.scores)), found, str(counts.false), errors, time, failures_told(times))


def _line(row: Sequence[str], widths: Sequence[int]) -> str:
    return "| " + " | ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)) + " |"


def _cell(text: str) -> str:
    """A name that anybody gave, as Markdown takes it in a table."""
    return text.replace("|", "\\|")


def _notes(run: RunRecord) -> Iterator[str]:
    for detector in run.detectors:
        times = latency_of(run, detector)
        cold = ", ".join(f"{1e3 * seconds:.0f}" for seconds in times.cold_s) or "not measured"
        start = f", start-up {1e3 * times.start_up_s:.0f} ms at most" if times.start_up_s is not None else ""
        yield f"{detector}: first call {cold} ms{start}. {times.starved}".strip()
    yield f"Errors are of found teats only. {LATENCY_RULE}"
