"""The report's tables: requirements, results per situation, errors, rates, provenance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bench.record import RunRecord
from bench.scoring.errors import ErrorSummary
from bench.scoring.pool import Pool
from bench.scoring.rates import Rate, percent
from bench.script import Rules
from bench.summary.wording import NOT_MEASURED, limit, margin, measured, number
from bench.verdicts import Judgement, scored
from detector.calibration import Calibration
from reports.page import Cell, Column, KeyValues, Requirement, Requirements, Table

CONFIDENCE = 0.95


def requirements(judgement: Judgement, rules: Rules) -> Requirements:
    """One row a requirement: rule, n, measured, limit, margin, verdict."""
    sources = {rule.name: rule.source for rule in rules.requirements}
    rows = tuple(
        Requirement(d.name, d.rule, d.n, _whole(measured(d)), limit(d), margin(d), d.verdict.value, sources.get(d.name, ""))
        for d in judgement.decisions
    )
    note = " ".join(d.sentence for d in judgement.decisions)
    return Requirements(f"Requirements, detector {judgement.detector}: {judgement.verdict.value}", rows, note)


def _whole(text: str) -> str:
    """A figure and its uncertainty on one line."""
    return text.replace("± ", "±\u00a0")


def situations(run: RunRecord) -> list[str]:
    """The situations of the run, in the order of their trials."""
    return list(dict.fromkeys(str(trial.head["situation"]) for trial in run.trials))


def found_by_situation(run: RunRecord, detector: str, rules: Rules) -> Table:
    """Found of visible in each situation, over all repeats, beside the thesis's own figures."""
    published = rules.published
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
                f"{theirs.found} of {theirs.present}" if theirs else "no figure",
            )
        )
    columns = (
        Column("situation"),
        Column("frame sets", "right"),
        Column("found of visible", "right"),
        Column("missed", "right"),
        Column("false", "right"),
        Column("hidden ends", "right", hint="ends that a camera can't see: neither missed nor false"),
        Column("scene success", "right", hint="every visible end found within the limit, nothing false, in time"),
        Column("thesis found", "right"),
    )
    note = (
        "A teat is found when an answer lies within the gate of its end (25 mm, or half the least spacing). "
        "The thesis judged by eye, one picture a situation."
    )
    return Table(f"Teats found, detector {detector}", columns, tuple(rows), note)


def rates(pool: Pool, detector: str) -> Table:
    """Rates over poses with their exact intervals."""
    counts = pool.counts
    lines = [
        ("scene success, poses", pool.success),
        ("hidden count right, poses", pool.hidden_right),
        ("in time, poses", pool.in_time),
        ("recall, teats", counts.recall),
        ("precision, answers", counts.precision),
    ]
    rows = tuple((name, str(rate.successes), str(rate.trials), _rate(rate), _interval(rate)) for name, rate in lines)
    columns = (Column("rate"), Column("of", "right"), Column("n", "right"), Column("value", "right"), Column("95 % interval", "right"))
    note = (
        "Exact (Clopper-Pearson) intervals. A pose succeeds when all its repeats do; teats of one scene are not independent, "
        "so the intervals of recall and precision are optimistic."
    )
    return Table(f"Rates, detector {detector}", columns, rows, note)


def errors(run: RunRecord, pool: Pool, detector: str, calibration: Calibration) -> tuple[Table, Table]:
    """Errors along world and camera axes, and distances; pooled and per situation."""
    world = pool.summary()
    camera = pool.summary(calibration.world_from_right.inverse().R)
    axes = [
        *((f"world {name}", axis) for name, axis in (("x", world.x), ("y", world.y), ("z", world.z))),
        *((f"camera {name}", axis) for name, axis in (("x (across)", camera.x), ("y (down)", camera.y), ("z (depth)", camera.z))),
    ]
    columns = (
        Column("axis"),
        Column("n", "right"),
        *(Column(name, "right", "mm") for name in ("bias", "sd", "rms", "mean |e|", "max |e|")),
    )
    rows = tuple((name, str(a.n), *(_mm(v) for v in (a.bias_mm, a.sd_mm, a.rms_mm, a.mean_abs_mm, a.max_abs_mm))) for name, a in axes)
    per_axis = Table(
        f"Errors along each axis, detector {detector}", columns, rows, "bias² + sd² = rms²; camera axes are the right camera's."
    )
    lines = [("all", world), *((name, scored(run, detector, name).summary()) for name in situations(run))]
    radial_columns = (
        Column("situation"),
        Column("n", "right"),
        *(Column(t, "right", "mm") for t in ("mean", "median", "rms", "p95", "max")),
    )
    gospa = "Distances are over found teats only; " + _gospa(pool)
    return per_axis, Table(f"Distance to the teat end, detector {detector}", radial_columns, tuple(_radial(*line) for line in lines), gospa)


def depth_limit(run: RunRecord, calibration: Calibration) -> str:
    """What no stereo method on this rig can beat a pixel, at this run's teats."""
    ends = np.array([[row["x_mm"], row["y_mm"], row["z_mm"]] for trial in run.trials for row in trial.truth]).reshape(-1, 3)
    if not len(ends):
        return NOT_MEASURED
    per_px = calibration.depth_per_disparity_px_mm(ends)
    return f"One pixel of disparity is {per_px.min():.1f} to {per_px.max():.1f} mm of depth at these teats (Z² / f B)."


def key_values(title: str, entries: Sequence[tuple[str, object]]) -> KeyValues:
    """A list of names and values as text."""
    return KeyValues(title, tuple((name, NOT_MEASURED if value is None else str(value)) for name, value in entries))


def _radial(name: str, summary: ErrorSummary) -> tuple[str, ...]:
    r = summary.radial
    return (name, str(r.n), *(_mm(v) for v in (r.mean_mm, r.median_mm, r.rms_mm, r.p95_mm, r.max_mm)))


def _gospa(pool: Pool) -> str:
    values = [score.gospa_mm for score in pool.scores]
    mean = float(np.mean(values)) if values else None
    return f"GOSPA, which also charges missed and false teats: mean {number(mean, 'mm')} a scene."


def _mm(value: float | None) -> str:
    return number(value)


def _rate(rate: Rate) -> str:
    return NOT_MEASURED if rate.value is None else percent(rate.value)


def _interval(rate: Rate) -> str:
    span = rate.interval(CONFIDENCE)
    return NOT_MEASURED if span is None else f"{100 * span[0]:.1f} to {100 * span[1]:.1f} %"
