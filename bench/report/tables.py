"""The report's tables: requirements, rates, results by situation and detector (also in Markdown),
and what each missed or wrong teat is attributed to.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache

import numpy as np

from bench.record.reader import RunRecord
from bench.record.schema import Row
from bench.report.wording import NOT_MEASURED, Heading, limit, listed, margin, measured, table
from bench.results.attribution import Cause, DetectionFault, attributed, counted
from bench.results.doubts import DOUBTS_FACT
from bench.results.verdicts import (
    LATENCY_RULE,
    Judgement,
    calls_of,
    failures_text,
    latency_of,
    scored,
)
from bench.scoring.decisions import Decision, Verdict
from bench.scoring.errors import Floats
from bench.scoring.joint import radial_95_mm
from bench.scoring.rates import Rate, percent, pose_successes
from bench.script.model import TRIALS, Rules, load_script
from bench.script.planned_trials import PublishedRate
from detector.calibration import Calibration
from detector.protocol import Outcome
from instruments.world.situations import spoken
from reports.page import Cell, Notes, Part, Requirement, Requirements, Score, Scoreboard, Table
from textfiles.text import capital, plural

CONFIDENCE = 0.95
RECALL, PRECISION = "recall, teats", "precision, answers"
GROUPED = (RECALL, PRECISION)  # come several in a scene: no trials of an interval


def requirements(judgement: Judgement, rules: Rules, *, first: bool = True) -> Requirements:
    """A row a requirement; those of the bench with the ``first`` detector only."""
    sources = {rule.name: rule.source for rule in rules.requirements}
    rows = []
    own = [d for d in judgement.decisions if first or d.name not in judgement.of_bench]
    for d in own:
        figures, source = (measured(d), limit(d), margin(d)), sources.get(d.name, "")
        rows.append(Requirement(d.name, d.rule, d.n, *figures, d.verdict.value, source))
    note = " ".join(f"{capital(d.name)}: {d.sentence}" for d in own)
    return Requirements(
        f"Requirements, detector {judgement.detector}: {judgement.verdict.value}", tuple(rows), note
    )


SHOWS = {
    Verdict.MET: "met",
    Verdict.NOT_MET: "not met",
    Verdict.INCONCLUSIVE: "not decided yet",
    Verdict.NOT_MEASURED: "nothing to decide it by",
}


def scoreboard(judgements: Sequence[Judgement]) -> Scoreboard:
    """Each requirement and what each detector shows of it; the bench's once."""
    several, of_bench = len(judgements) > 1, judgements[0].of_bench
    counts = [d.n for judgement in judgements for d in judgement.decisions if d.n]
    usual = max(sorted(set(counts)), key=counts.count, default=0)
    by_name = [{d.name: d for d in judgement.decisions} for judgement in judgements]

    def score(d: Decision) -> Score:
        of = f", from {d.n}" if d.n not in (usual, 0) else ""
        return Score(d.verdict.value, measured(d), f"{SHOWS[d.verdict]}{of}")

    rows, shared = [], set[str]()
    bench = [d for d in judgements[0].decisions if d.name in of_bench]
    sound = [d.name for d in bench if d.verdict is Verdict.MET]
    sound = sound if len(sound) > 1 else []  # in one row; each has its own in the fold
    for name in dict.fromkeys(name for each in by_name for name in each if name not in sound):
        decisions = [each.get(name) for each in by_name]
        limits = dict.fromkeys(limit(d) for d in decisions if d)
        scores = tuple(score(d) if d else None for d in decisions)
        called = capital(name)
        if name in of_bench:
            called, scores = f"Bench: {name}" if several else called, scores[:1]
            shared.add(called)
        rows.append((called, ", ".join(limits), scores))
    if sound:
        met = Score(Verdict.MET.value, f"{len(sound)} of {len(sound)}", "met")
        called = "The bench's own" if len(sound) == len(of_bench) else "The bench's other ones"
        rows.append((called, "", (met,)))
        shared.add(called)
    names = tuple(judgement.detector for judgement in judgements)
    of = f"; from {plural(usual, 'value')} unless noted" if usual else ""
    caption = f"What each detector shows{of}."
    return Scoreboard(caption, names, tuple(rows), shared=shared)


def situations(run: RunRecord) -> list[str]:
    """The situations of the run, in the order of their trials."""
    return list(dict.fromkeys(str(trial.head["situation"]) for trial in run.trials))


def published(rules: Rules) -> Mapping[str, PublishedRate]:
    """What the thesis found by situation, as the shipped script has it; the own script's first."""
    return load_script(TRIALS / "six-situations.toml").script.published | rules.published


def found_by_situation(
    run: RunRecord, detector: str, published: Mapping[str, PublishedRate]
) -> Table:
    """Found of visible in each situation, beside the thesis's."""
    rows = []
    for situation in situations(run):
        pool = scored(run, detector, situation)
        counts, theirs = pool.counts, published.get(situation)
        false = Cell(str(counts.false), tone="bad" if counts.false else "plain")
        found = f"{counts.matched} of {counts.visible}"
        scenes = f"{pool.frames.successes} of {pool.frames.trials}"
        ours: tuple[object, ...] = (found, counts.missed, false, counts.hidden, scenes)
        ours = ours if pool.answered else (None,) * len(ours)
        thesis = f"{theirs.found} of {theirs.present}" if theirs else "no figure"
        row = (len(pool.scores), *ours, thesis)
        rows.append((spoken(situation), *row))
    return table("found_by_situation", rows, detector=detector)


def rates(run: RunRecord, detector: str) -> Table:
    """Rates over poses with their exact intervals."""
    rows = []
    for name, rate in _rates(run, detector).items():
        span = None if name in GROUPED else rate.interval(CONFIDENCE)
        interval = span and f"{100 * span[0]:.1f} to {100 * span[1]:.1f} %"
        value = None if rate.value is None else percent(rate.value)
        rows.append((name, rate.successes, rate.trials, value, interval))
    return table("rates", rows, detector=detector)


def rates_by_situation(run: RunRecord, detector: str) -> Table:
    """The same rates, a row a situation."""
    rows = [
        (
            spoken(situation),
            *(_narrow(rate, name) for name, rate in _rates(run, detector, situation).items()),
        )
        for situation in situations(run)
    ]
    kinds = [Heading(name, "right", "k of n, interval") for name in _rates(run, detector)]
    return table("rates_by_situation", rows, more=kinds, detector=detector)


def _rates(run: RunRecord, detector: str, situation: str | None = None) -> dict[str, Rate]:
    found = scored(run, detector, situation)
    calls = calls_of(run, detector, situation)
    answered = [row["outcome"] != Outcome.TIMEOUT.value for _, row in calls]
    return {
        "scene success, poses": found.success,
        "hidden count right, poses": found.hidden_right,
        "in time, poses": found.in_time,
        "no time-out, poses": pose_successes([pose for pose, _ in calls], answered),
        RECALL: found.counts.recall,
        PRECISION: found.counts.precision,
        "every visible end found, poses": found.all_found,
        "none false, poses with an answer": found.none_false,
    }


def _narrow(rate: Rate, name: str) -> str:
    """``9 of 12 (43 to 95 %)``, broken before the bracket if anywhere."""
    span = rate.interval(CONFIDENCE)
    if span is None:
        return NOT_MEASURED
    found = f"{rate.successes} of {rate.trials}"
    if name in GROUPED:
        return found.replace(" ", "\u00a0")
    interval = f"({100 * span[0]:.0f} to {100 * span[1]:.0f} %)"
    return " ".join(text.replace(" ", "\u00a0") for text in (found, interval))


def covariance_of(row: Row) -> Floats | None:
    """The covariance (3, 3) of a row, mm^2; None where there is none or it is malformed."""
    return _covariance(row.get("covariance_mm2"))


@lru_cache(maxsize=8192)  # several chapters have those of all ends
def _covariance(text: str | None) -> Floats | None:
    matrix = np.array(json.loads(text) if text else [], dtype=np.float64)
    return matrix if matrix.shape == (3, 3) and np.isfinite(matrix).all() else None


def truth_known_mm(run: RunRecord) -> float | None:
    """The distance within which the least certain end lies with 95 %; None where none states u."""
    rows = [row for t in run.counted for row in t.truth if row["u_mm"] is not None]
    stated = [(covariance_of(row), row["u_mm"]) for row in rows]
    found = (radial_95_mm(u_mm**2 * np.eye(3) if own is None else own) for own, u_mm in stated)
    return max(found, default=None)


HEAD = (
    *("situation", "detector", "frame sets", "found of visible", "false"),
    *("mean, p95, max error (mm)", "median, p99 time (ms)", "no answer"),
)
ALL = "all"


def score_table(run: RunRecord) -> str:
    """The table in Markdown, with what it says below it; without truth, a sentence."""
    if not any(trial.scores for trial in run.trials):
        doubted = DOUBTS_FACT in run.facts
        why = "The calibration can't be that of these pictures" if doubted else "There is no truth"
        return f"{why}, so nothing was scored."
    names: list[str | None] = [*situations(run)]
    names += [None] * (len(names) > 1)
    rows = [_row(run, name, detector) for name in names for detector in run.detectors]
    widths = [max(map(len, column)) for column in zip(HEAD, *rows, strict=True)]
    head, *lines = (f"| {' | '.join(map(str.ljust, row, widths))} |" for row in (HEAD, *rows))
    rule = "|" + "|".join("-" * (width + 2) for width in widths) + "|"
    notes = []
    for detector in run.detectors:
        times = latency_of(run, detector)
        cold = listed([1e3 * seconds for seconds in times.cold_s], ".0f")
        cold = f"{cold} ms" if cold else NOT_MEASURED
        up_s = times.start_up_s
        start = "" if up_s is None else f", start-up {1e3 * up_s:.0f} ms at most"
        notes.append(f"{detector}: first call {cold}{start}. {times.starved}".strip())
    notes.append(f"Errors are of found teats only. {LATENCY_RULE}")
    return "\n".join([head, rule, *lines, "", *notes])


def _row(run: RunRecord, situation: str | None, detector: str) -> tuple[str, ...]:
    pool, times = scored(run, detector, situation), latency_of(run, detector, situation)
    counts, radial = pool.counts, pool.summary().radial
    errors = (radial.mean_mm, radial.p95_mm, radial.max_mm)
    seconds = map(times.percentile_s, (50, 99))
    return (
        # as Markdown takes it in a table
        (spoken(situation) if situation else ALL).replace("|", "\\|"),
        detector,
        str(len(pool.scores)),
        f"{counts.matched} of {counts.visible}" if pool.answered else NOT_MEASURED,
        str(counts.false) if pool.answered else NOT_MEASURED,
        listed([mm for mm in errors if mm is not None]) or NOT_MEASURED,
        listed([1e3 * s for s in seconds if s is not None], ".0f") or NOT_MEASURED,
        failures_text(times),
    )


def attribution_parts(run: RunRecord, calibration: Calibration | None = None) -> Iterator[Part]:
    """A table for each detector that was scored; and what isn't the detector's, one by one."""
    for detector in run.detectors:
        found = attributed(run, detector, calibration)
        counts = counted(found)
        rows = [(what.value, *(counts[what, cause] for cause in Cause)) for what in DetectionFault]
        causes = [Heading(cause.value, "right") for cause in Cause]
        yield table("attribution", rows, more=causes, detector=detector)
        others = tuple(
            f"{one.trial}{f', teat {one.teat}' if one.teat else ''}: {one.what.value}:"
            f" {one.cause.value}: {one.why}"
            for one in found
            if one.cause not in (Cause.DETECTOR, Cause.NOT_VISIBLE)
        )
        if others:
            yield Notes(f"Not the detector's, {detector}", others)
