"""The report's part for each trial: frames, teats, readings; and which trials are the worst."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from bench.record.reader import RunRecord, TrialRecord
from bench.record.schema import Row
from bench.report.bath import capture_told, surface_at, surface_told
from bench.report.frames import IMAGES, pictures
from bench.report.truth import trial_truth
from bench.report.wording import number, table, xyz
from bench.scoring.scene import SceneScore
from detector.calibration import Calibration
from detector.protocol import Outcome
from reports.page import Cell, KeyValues, Table, Tone, TrialPart

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


def worst_trials(run: RunRecord) -> tuple[TrialRecord, ...]:
    """The failed trials, worst first: by missed and false, then by largest error."""

    def fault(trial: TrialRecord) -> tuple[int, float]:
        scores = trial.scores.values()
        wrong = max(score.counts.missed + score.counts.false for score in scores)
        return wrong, max((mm for score in scores for mm in score.radial_mm), default=0.0)

    failed = [
        trial for trial in run.counted if any(not score.success for score in trial.scores.values())
    ]
    return tuple(sorted(failed, key=fault, reverse=True)[:MOST_WORST])


def trial_table(run: RunRecord) -> Table:
    """All trials with links to their parts."""
    heads = (
        "trial | situation | detector | >found | >missed | >false | >max error [mm] | >time [s]"
        " | scene"
    )
    rows = []
    for trial in run.trials:
        for detection in trial.detections:
            score = trial.scores.get(detection["detector"])
            counts, worst = ("not scored", "", ""), None
            if score:
                found = f"{score.counts.matched} of {score.counts.visible}"
                counts = (found, str(score.counts.missed), str(score.counts.false))
                worst = max(score.radial_mm, default=None)
            seconds = detection["wall_seconds"]
            rows.append(
                (
                    Cell(trial.id, href=f"#{trial_id(trial)}"),
                    str(trial.head["situation"]),
                    str(detection["detector"]),
                    *counts,
                    # more digits make the page heavy, not the order right
                    Cell(number(worst), sort=None if worst is None else round(worst, 4)),
                    Cell(f"{seconds:.3f}", sort=round(seconds, 4)),
                    Cell(*_status(trial, score)),
                )
            )
    return table("All trials", heads, rows, searchable=True)


def first_looks(run: RunRecord) -> KeyValues | None:
    """Links to the trials that are worth the first look; None where none failed."""
    entries = tuple(
        (trial.id, Cell(*_statuses(trial), href=f"#{trial_id(trial)}"))
        for trial in worst_trials(run)[:FIRST_LOOKS]
    )
    return KeyValues("Look at these first", entries) if entries else None


def _statuses(trial: TrialRecord) -> tuple[str, Tone]:
    """What one says of the trial: its worst detector's status."""
    statuses = [_status(trial, score) for score in trial.scores.values() or (None,)]
    return next((status for status in statuses if status[1] == "bad"), statuses[0])


def _part(run: RunRecord, trial: TrialRecord, calibration: Calibration, folder: Path) -> TrialPart:
    status, tone = _statuses(trial)
    head, detections, budget = trial.head, trial.detections, trial_truth(trial)
    notes = [f"In no count: {trial.invalid}"] if trial.invalid else []
    notes += [f"Note: {head['note']}"] if head["note"] else []
    return TrialPart(
        id=trial_id(trial),
        heading=trial.id,
        situation=str(head["situation"]),
        status=status,
        tone=tone,
        summary=(
            ("situation", str(head["situation"])),
            ("repeat", str(head["repeat"])),
            ("bath at capture", capture_told(run, trial)),
            ("teats' surface", surface_told(surface_at(run, trial))),
            *((f"time, {d['detector']}", _time_told(d)) for d in detections),
            *((f"hidden, {d['detector']}", f"claims {d['hidden']}") for d in detections),
        ),
        images=tuple(pictures(run, trial, calibration, folder)),
        tables=(*(_teats(trial, d["detector"]) for d in detections), *([budget] if budget else [])),
        notes=(*notes, *(note for d in detections for note in _notes(d))),
    )


def _time_told(detection: Row) -> str:
    """The time of one call, and what it can't be compared with."""
    first = " (first call)" if detection["cold"] else ""
    start_up_s = detection["wall_start_up_s"]
    start = "" if start_up_s is None else f" after a start-up of {start_up_s:.3f} s"
    outcome = "" if detection["outcome"] == Outcome.ANSWERED.value else f", {detection['outcome']}"
    return f"{detection['wall_seconds']:.3f} s{first}{start}{outcome}"


def _notes(detection: Row) -> Iterator[str]:
    """Why there is no answer, or only a part of one, and what the program itself wrote."""
    if detection["reason"]:
        yield f"{detection['detector']}: {detection['reason']}"
    if detection["wall_stderr"]:
        yield f"{detection['detector']} wrote to its standard error: {detection['wall_stderr']}"


def _status(trial: TrialRecord, score: SceneScore | None) -> tuple[str, Tone]:
    if trial.invalid:
        return "invalidated", "warn"
    if score is None:
        return "not scored", "muted"
    if score.success:
        return "scene success", "good"
    faults = {
        f"{score.counts.missed} missed": score.counts.missed,
        f"{score.counts.false} false": score.counts.false,
        "beyond the limit": any(mm > score.limit_mm for mm in score.radial_mm),
        "too slow": not score.in_time,
    }
    return ", ".join(told for told, is_so in faults.items() if is_so), "bad"


def _teats(trial: TrialRecord, detector: str) -> Table:
    """Truth and answer side by side; false answers below."""
    score = trial.scores.get(detector)
    found = [row for row in trial.found if row["detector"] == detector]
    pairs = (
        {truth: (answer, k) for k, (answer, truth) in enumerate(score.match.pairs)} if score else {}
    )
    rows: list[tuple[object, ...]] = []
    for index, row in enumerate(trial.truth):
        answered: tuple[object, ...] = ("",) * 5
        told = Cell("missed", "bad") if row["visible"] else Cell("hidden", "muted")
        if score and index in pairs:
            answer, k = pairs[index]
            mm = score.radial_mm[k]
            answered = (xyz(found[answer]), *score.errors_mm[k], mm)
            told = Cell("found", "good")
            if mm > score.limit_mm:
                told = Cell("found, beyond the limit", "warn")
        rows.append((str(row["teat"]), xyz(row), row["u_mm"], *answered, told))
    for answer in score.match.false if score else range(len(found)):
        told = Cell("false", "bad") if score else Cell("not scored", "muted")
        rows.append(("", "", "", xyz(found[answer]), "", "", "", "", told))
    heads = (
        "teat | >truth x, y, z [mm] | >u [mm] ~.2f? | >found x, y, z [mm] | >dx [mm] ~+.2f"
        " | >dy [mm] ~+.2f | >dz [mm] ~+.2f | >distance [mm] ~.2f | is"
    )
    return table(f"Teat ends, detector {detector}", heads, rows)
