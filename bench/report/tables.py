"""The report's tables: requirements, rates, results by situation and detector (also in Markdown),
and what each missed or wrong teat is attributed to.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from bench.record.reader import RunRecord, TrialRecord
from bench.report.wording import NOT_MEASURED, limit, margin, measured
from bench.results.attribution import Attributed, Cause, What, attributed, counted
from bench.results.latency import LATENCY_RULE, failures_told, latency_of
from bench.results.verdicts import Judgement, scored
from bench.scoring.errors import Floats
from bench.scoring.rates import Rate, percent, pose_successes
from bench.script.model import Rules
from detector.calibration import Calibration
from detector.protocol import Outcome
from reports.parts import Cell, KeyValues, Notes, Part, Requirement, Requirements, Table, columns

CONFIDENCE = 0.95
NARROW = "k of n with its exact 95 % interval, which for few poses is wide: so little do they show."


def requirements(judgement: Judgement, rules: Rules) -> Requirements:
    """One row a requirement: rule, n, measured, limit, margin, verdict."""
    sources = {rule.name: rule.source for rule in rules.requirements}
    rows = tuple(
        Requirement(
            d.name,
            d.rule,
            d.n,
            measured(d),
            limit(d),
            margin(d),
            d.verdict.value,
            sources.get(d.name, ""),
        )
        for d in judgement.decisions
    )
    note = " ".join(d.sentence for d in judgement.decisions)
    return Requirements(
        f"Requirements, detector {judgement.detector}: {judgement.verdict.value}", rows, note
    )


def situations(run: RunRecord) -> list[str]:
    """The situations of the run, in the order of their trials."""
    return list(dict.fromkeys(str(trial.head["situation"]) for trial in run.trials))


def found_by_situation(
    run: RunRecord, detector: str, published: Mapping[str, tuple[int, int]]
) -> Table:
    """Found of visible in each situation, beside the thesis's (found, present)."""
    rows: list[tuple[str | Cell, ...]] = []
    for situation in situations(run):
        pool = scored(run, detector, situation)
        counts, theirs = pool.counts, published.get(situation)
        rows.append(
            (
                situation,
                str(len(pool.scores)),
                f"{counts.matched} of {counts.visible}",
                str(counts.missed),
                Cell(str(counts.false), tone="bad" if counts.false else "plain"),
                str(counts.hidden),
                f"{pool.frames.successes} of {pool.frames.trials}",
                f"{theirs[0]} of {theirs[1]}" if theirs else "no figure",
            )
        )
    heads = columns(
        "situation | >frame sets | >found of visible | >missed | >false",
        ">hidden ends # ends that a camera can't see: neither missed nor false",
        ">scene success # every visible end found within the limit, nothing false, in time",
        ">thesis found",
    )
    note = (
        "A teat is found when an answer lies within the gate of its end (25 mm, or half the least"
        " spacing). The thesis judged by eye, one picture a situation."
    )
    return Table(f"Teats found, detector {detector}", heads, tuple(rows), note)


def rates(run: RunRecord, detector: str) -> Table:
    """Rates over poses with their exact intervals."""
    rows = tuple(
        (name, str(rate.successes), str(rate.trials), _rate(rate), _interval(rate))
        for name, rate in _rates(run, detector).items()
    )
    heads = columns("rate | >of | >n | >value | >95 % interval")
    note = (
        "Exact (Clopper-Pearson) intervals. A pose succeeds when all its repeats do; teats of one"
        " scene are not independent, so the intervals of recall and precision are optimistic."
    )
    return Table(f"Rates, detector {detector}", heads, rows, note)


def rates_by_situation(run: RunRecord, detector: str) -> Table:
    """The same rates, a row a situation."""
    rows = [
        (situation, *(_cell(rate) for rate in _rates(run, detector, situation).values()))
        for situation in situations(run)
    ]
    heads = columns("situation", *(f">{name} [k of n, interval]" for name in _rates(run, detector)))
    return Table(f"Rates by situation, detector {detector}", heads, tuple(rows), NARROW)


def _rates(run: RunRecord, detector: str, situation: str | None = None) -> dict[str, Rate]:
    found = scored(run, detector, situation)
    return {
        "scene success, poses": found.success,
        "hidden count right, poses": found.hidden_right,
        "in time, poses": found.in_time,
        "no time-out, poses": _answered(run, detector, situation),
        "recall, teats": found.counts.recall,
        "precision, answers": found.counts.precision,
    }


def _answered(run: RunRecord, detector: str, situation: str | None) -> Rate:
    """Poses at which no call timed out, of the poses."""
    trials = [trial for trial in run.counted if situation in (None, trial.head["situation"])]
    calls = [
        (trial.pose, row["outcome"])
        for trial in trials
        for row in trial.detections
        if row["detector"] == detector
    ]
    return pose_successes(
        [pose for pose, _ in calls], [outcome != Outcome.TIMEOUT.value for _, outcome in calls]
    )


def ends_mm(trials: Iterable[TrialRecord]) -> Floats:
    """The true teat ends (n, 3) of these trials."""
    rows = [row for trial in trials for row in trial.truth]
    return np.array([[row[f"{axis}_mm"] for axis in "xyz"] for row in rows]).reshape(-1, 3)


def depth_limit(run: RunRecord, calibration: Calibration) -> str:
    """What no stereo method on this rig can beat a pixel, at this run's teats."""
    ends = ends_mm(run.trials)
    if not len(ends):
        return NOT_MEASURED
    per_px = calibration.depth_per_disparity_px_mm(ends)
    return (
        f"One pixel of disparity is {per_px.min():.1f} to {per_px.max():.1f} mm of depth at these"
        " teats (Z² / f B)."
    )


def key_values(title: str, entries: Sequence[tuple[str, object]]) -> KeyValues:
    """A list of names and values as text."""
    return KeyValues(
        title,
        tuple((name, NOT_MEASURED if value is None else str(value)) for name, value in entries),
    )


def _rate(rate: Rate) -> str:
    return NOT_MEASURED if rate.value is None else percent(rate.value)


def _interval(rate: Rate) -> str:
    span = rate.interval(CONFIDENCE)
    return NOT_MEASURED if span is None else f"{100 * span[0]:.1f} to {100 * span[1]:.1f} %"


def _cell(rate: Rate) -> str:
    """``9 of 12 (43 to 95 %)``, broken before the bracket if anywhere."""
    span = rate.interval(CONFIDENCE)
    if span is None:
        return NOT_MEASURED
    low, high = (f"{100 * bound:.0f}" for bound in span)
    return f"{rate.successes} of {rate.trials} ({low} to {high} %)".replace(" ", "\u00a0").replace(
        "\u00a0(", " ("
    )


HEAD = (
    "situation",
    "detector",
    "frame sets",
    "found of visible",
    "false",
    "mean, p95, max error (mm)",
    "median, p99 time (ms)",
    "no answer",
)
ALL = "all"


def score_table(run: RunRecord) -> str:
    """The table in Markdown, with what it says below it; without truth, a sentence."""
    if not any(trial.scores for trial in run.trials):
        return "There is no truth, so nothing was scored."
    rows = [
        HEAD,
        *(
            _row(run, situation, detector)
            for situation in _situations(run)
            for detector in run.detectors
        ),
    ]
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
    errors = (
        NOT_MEASURED
        if radial.n == 0
        else f"{radial.mean_mm:.2f}, {radial.p95_mm:.2f}, {radial.max_mm:.2f}"
    )
    time = (
        NOT_MEASURED
        if times.median_s is None or times.p99_s is None
        else f"{1e3 * times.median_s:.0f}, {1e3 * times.p99_s:.0f}"
    )
    found = f"{counts.matched} of {counts.visible}"
    return (
        _unmarked(situation or ALL),
        detector,
        str(len(pool.scores)),
        found,
        str(counts.false),
        errors,
        time,
        failures_told(times),
    )


def _line(row: Sequence[str], widths: Sequence[int]) -> str:
    return (
        "| " + " | ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)) + " |"
    )


def _unmarked(text: str) -> str:
    """A name that anybody gave, as Markdown takes it in a table."""
    return text.replace("|", "\\|")


def _notes(run: RunRecord) -> Iterator[str]:
    for detector in run.detectors:
        times = latency_of(run, detector)
        cold = ", ".join(f"{1e3 * seconds:.0f}" for seconds in times.cold_s) or NOT_MEASURED
        start = (
            f", start-up {1e3 * times.start_up_s:.0f} ms at most"
            if times.start_up_s is not None
            else ""
        )
        yield f"{detector}: first call {cold} ms{start}. {times.starved}".strip()
    yield f"Errors are of found teats only. {LATENCY_RULE}"


NOTE = (
    "Each missed or wrong teat is one party's. Truth: within the guard band of its uncertainty, or"
    " it was taken back. Bench: taken while the bath was not stable, or not come to. Not visible:"
    " some camera can't see the end; the detector need not find it. Verdicts count as their rules"
    " say; this table says where to look first."
)


def attribution_parts(run: RunRecord) -> Iterator[Part]:
    """A table for each detector that was scored; and what isn't the detector's, one by one."""
    for detector in run.detectors:
        found = attributed(run, detector)
        counts = counted(found)
        rows = tuple((what.value, *(str(counts[what, cause]) for cause in Cause)) for what in What)
        heads = columns("what", *(f">{cause.value}" for cause in Cause))
        yield Table(f"Whose it is, detector {detector}", heads, rows, NOTE)
        others = tuple(
            _told(one) for one in found if one.cause not in (Cause.DETECTOR, Cause.NOT_VISIBLE)
        )
        if others:
            yield Notes(f"Not the detector's, {detector}", others)


def _told(one: Attributed) -> str:
    teat = f", teat {one.teat}" if one.teat else ""
    return f"{one.trial}{teat}: {one.what.value}: {one.cause.value}: {one.why}"
