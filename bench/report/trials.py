"""The report's part for each trial: frames, teats, readings; and which trials are the worst."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from bench.record.reader import RunRecord, TrialRecord
from bench.record.schema import Row
from bench.report.bath import capture_told, surface_at, surface_told
from bench.report.frames import IMAGES, pictures
from bench.report.truth import trial_truth
from bench.report.wording import number
from bench.scoring.scene import SceneScore
from detector.calibration import Calibration
from detector.protocol import Outcome
from reports.page import TrialPart
from reports.parts import Cell, KeyValues, Table, Tone, columns

AT_ONCE = 4  # trials: decoding and encoding pictures lets others work
MOST_WORST = 60
FIRST_LOOKS = 9


def trial_id(trial: TrialRecord) -> str:
    """The anchor of a trial's part of the page."""
    return f"trial-{int(trial.head['number']):03d}"


def trial_parts(run: RunRecord, calibration: Calibration, folder: Path) -> tuple[TrialPart, ...]:
    """A part a trial; its pictures are written into ``folder``/images."""
    (folder / IMAGES).mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(AT_ONCE) as threads:
        return tuple(threads.map(lambda trial: _part(run, trial, calibration, folder), run.trials))


def worst_trials(run: RunRecord) -> tuple[str, ...]:
    """The anchors of failed trials, worst first: by missed and false, then by largest error."""

    def fault(trial: TrialRecord) -> tuple[int, float]:
        scores = list(trial.scores.values())
        wrong = max((score.counts.missed + score.counts.false for score in scores), default=0)
        return wrong, max(
            (distance for score in scores for distance in score.radial_mm), default=0.0
        )

    failed = [
        trial for trial in run.counted if any(not score.success for score in trial.scores.values())
    ]
    return tuple(trial_id(trial) for trial in sorted(failed, key=fault, reverse=True)[:MOST_WORST])


def trial_table(run: RunRecord) -> Table:
    """All trials with links to their parts."""
    heads = columns(
        "trial | situation | detector | >found | >missed | >false | >max error [mm]",
        ">time [s] | scene",
    )
    rows = []
    for trial in run.trials:
        for detection in trial.detections:
            score = trial.scores.get(detection["detector"])
            worst = max(score.radial_mm, default=None) if score else None
            counts = score.counts if score else None
            seconds = detection["wall_seconds"]
            rows.append(
                (
                    Cell(trial.id, href=f"#{trial_id(trial)}"),
                    str(trial.head["situation"]),
                    str(detection["detector"]),
                    f"{counts.matched} of {counts.visible}" if counts else "not scored",
                    str(counts.missed) if counts else "",
                    str(counts.false) if counts else "",
                    Cell(
                        number(worst), sort=None if worst is None else round(worst, 4)
                    ),  # more digits make the page heavy, not the order right
                    Cell(f"{seconds:.3f}", sort=round(seconds, 4)),
                    Cell(*_told(trial, score)),
                )
            )
    return Table("All trials", heads, tuple(rows), searchable=True)


def first_looks(run: RunRecord) -> KeyValues | None:
    """Links to the trials that are worth the first look; None where none failed."""
    by_anchor = {trial_id(trial): trial for trial in run.trials}
    entries = [
        (by_anchor[anchor].id, anchor, _statuses(by_anchor[anchor]))
        for anchor in worst_trials(run)[:FIRST_LOOKS]
    ]
    if not entries:
        return None
    return KeyValues(
        "Look at these first",
        tuple((name, Cell(*status, href=f"#{anchor}")) for name, anchor, status in entries),
    )


def _statuses(trial: TrialRecord) -> tuple[str, Tone]:
    """What one says of the trial: its worst detector's status."""
    statuses = [_told(trial, score) for score in trial.scores.values()] or [_told(trial, None)]
    return next((status for status in statuses if status[1] == "bad"), statuses[0])


def _part(run: RunRecord, trial: TrialRecord, calibration: Calibration, folder: Path) -> TrialPart:
    status, tone = _statuses(trial)
    head = trial.head
    summary = (
        ("situation", str(head["situation"])),
        ("repeat", str(head["repeat"])),
        ("bath at capture", capture_told(run, trial)),
        ("teats' surface", surface_told(surface_at(run, trial))),
        *((f"time, {d['detector']}", _time_told(d)) for d in trial.detections),
        *((f"hidden, {d['detector']}", f"claims {d['hidden']}") for d in trial.detections),
    )
    notes = tuple(note for d in trial.detections for note in _notes(d))
    notes = (f"Note: {head['note']}", *notes) if head["note"] else notes
    notes = (f"In no count: {trial.invalid}", *notes) if trial.invalid else notes
    budget = trial_truth(trial)
    return TrialPart(
        id=trial_id(trial),
        heading=trial.id,
        situation=str(head["situation"]),
        status=status,
        tone=tone,
        summary=summary,
        images=tuple(pictures(run, trial, calibration, folder)),
        tables=(
            *(_teats(trial, d["detector"]) for d in trial.detections),
            *((budget,) if budget else ()),
        ),
        notes=notes,
    )


def _time_told(detection: Row) -> str:
    """The time of one call, and what it can't be compared with."""
    outcome = "" if detection["outcome"] == Outcome.ANSWERED.value else f", {detection['outcome']}"
    start_up_s = detection["wall_start_up_s"]
    start = "" if start_up_s is None else f" after a start-up of {start_up_s:.3f} s"
    return (
        f"{detection['wall_seconds']:.3f}"
        f" s{' (first call)' if detection['cold'] else ''}{start}{outcome}"
    )


def _notes(detection: Row) -> Iterator[str]:
    """Why there is no answer, or only a part of one, and what the program itself wrote."""
    if detection["reason"]:
        yield f"{detection['detector']}: {detection['reason']}"
    if detection["wall_stderr"]:
        yield f"{detection['detector']} wrote to its standard error: {detection['wall_stderr']}"


def _told(trial: TrialRecord, score: SceneScore | None) -> tuple[str, Tone]:
    return ("invalidated", "warn") if trial.invalid else _status(score)


def _status(score: SceneScore | None) -> tuple[str, Tone]:
    if score is None:
        return "not scored", "muted"
    if score.success:
        return "scene success", "good"
    counts = score.counts
    parts = [
        f"{counts.missed} missed" if counts.missed else "",
        f"{counts.false} false" if counts.false else "",
    ]
    parts += [
        "beyond the limit" if any(d > score.limit_mm for d in score.radial_mm) else "",
        "" if score.in_time else "too slow",
    ]
    return ", ".join(part for part in parts if part), "bad"


def _teats(trial: TrialRecord, detector: str) -> Table:
    """Truth and answer side by side; false answers below."""
    score = trial.scores.get(detector)
    found = [row for row in trial.found if row["detector"] == detector]
    heads = columns(
        "teat | >truth x, y, z [mm] | >u [mm] | >found x, y, z [mm] | >dx [mm] | >dy [mm]",
        ">dz [mm] | >distance [mm] | is",
    )
    pairs = (
        {truth: (answer, k) for k, (answer, truth) in enumerate(score.match.pairs)} if score else {}
    )
    rows: list[tuple[str | Cell, ...]] = []
    for index, row in enumerate(trial.truth):
        place, u = _xyz(row), "" if row["u_mm"] is None else f"{row['u_mm']:.2f}"
        if score and index in pairs:
            answer, k = pairs[index]
            distance = score.radial_mm[k]
            word = (
                Cell("found", "good")
                if distance <= score.limit_mm
                else Cell("found, beyond the limit", "warn")
            )
            rows.append(
                (
                    str(row["teat"]),
                    place,
                    u,
                    _xyz(found[answer]),
                    *(f"{e:+.2f}" for e in score.errors_mm[k]),
                    f"{distance:.2f}",
                    word,
                )
            )
        else:
            rows.append(
                (
                    str(row["teat"]),
                    place,
                    u,
                    "",
                    "",
                    "",
                    "",
                    "",
                    Cell("missed", "bad") if row["visible"] else Cell("hidden", "muted"),
                )
            )
    for answer in score.match.false if score else range(len(found)):
        rows.append(
            (
                "",
                "",
                "",
                _xyz(found[answer]),
                "",
                "",
                "",
                "",
                Cell("false", "bad") if score else Cell("not scored", "muted"),
            )
        )
    return Table(f"Teat ends, detector {detector}", heads, tuple(rows))


def _xyz(row: Mapping[str, Any]) -> str:
    return f"{row['x_mm']:.1f}, {row['y_mm']:.1f}, {row['z_mm']:.1f}"
