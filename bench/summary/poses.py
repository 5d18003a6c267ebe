"""The report's part on the poses: which they were and how they were chosen, the error over the plane, and ISO 9283 where poses repeat."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from bench.record import RunRecord, TrialRecord
from bench.scoring.repeatability import drift_mm, pose_accuracy
from bench.summary.wording import number
from reports.figures import error_map
from reports.page import Column, Figure, Notes, Paragraph, Part, Table

POSE_SET = "pose set"
MAP_FROM = 9  # places: fewer make no map
CYCLES_FROM = 10  # repeats of a pose: ISO 9283 asks for 30, and fewer than these say nothing

Floats = NDArray[np.float64]


def pose_parts(run: RunRecord, limit_mm: float) -> Iterator[Part]:
    """How the poses were chosen; then for each detector what depends on the place, as far as the run has it."""
    chosen = run.facts.get(POSE_SET)
    if chosen:
        yield Notes(f"How the poses were chosen (order: {chosen['order']}; seed of the script: {chosen['seed']})", tuple(chosen["chosen"]))
    else:
        yield Paragraph("The poses are those of the recording; how they were chosen isn't in it.")
    for detector in run.detectors:
        yield from _map(run, detector, limit_mm)
        yield from _repeatability(run, detector)


def _map(run: RunRecord, detector: str, limit_mm: float) -> Iterator[Part]:
    """Of trials with one teat: of several, errors at one pose would lie beside each other as if they were places."""
    single = [trial for trial in run.counted if detector in trial.scores and len(trial.truth) == 1]
    if len({trial.pose for trial in single}) < MAP_FROM:
        return
    seen = [trial for trial in single if trial.truth[0]["visible"]]
    found = [trial for trial in seen if trial.scores[detector].radial_mm]
    missed = _places([trial for trial in seen if not trial.scores[detector].radial_mm])
    at, errors = _places(found), [trial.scores[detector].radial_mm[0] for trial in found]
    svg = error_map(
        at[:, 0], at[:, 1], errors, limit_mm, missed_x_mm=missed[:, 0], missed_y_mm=missed[:, 1], name=f"map-{detector}"
    )  # fmt: skip
    within = sum(error <= limit_mm for error in errors)
    alt = f"{len(seen)} places: {within} within {limit_mm:g} mm, {len(found) - within} beyond, {len(missed)} not found"
    yield Figure(svg, f"Error over the plane, {detector}; the area of a disc is the error. {alt}.", alt, wide=True)


def _places(trials: list[TrialRecord]) -> Floats:
    return np.array([(trial.truth[0]["x_mm"], trial.truth[0]["y_mm"]) for trial in trials], dtype=np.float64).reshape(-1, 2)


def _repeatability(run: RunRecord, detector: str) -> Iterator[Part]:
    """AP, RP and drift of each teat at each pose that was reached often enough."""
    columns = (
        Column("pose"), Column("teat"), Column("n", "right"),
        Column("AP", "right", "mm"), Column("AP along x", "right", "mm"), Column("along y", "right", "mm"),
        Column("along z", "right", "mm"),
        Column("RP", "right", "mm"), Column("drift of AP", "right", "mm"),
    )  # fmt: skip
    rows = []
    for (pose, teat), errors in _errors_at(run, detector).items():
        if len(errors) < CYCLES_FROM:
            continue
        at = pose_accuracy(errors, np.zeros(3))
        drift = drift_mm(errors, np.zeros(3), max(2, len(errors) // 3))
        along = at.ap_xyz_mm or (None, None, None)
        rows.append((pose, teat, str(at.n), number(at.ap_mm), *(number(value) for value in along), number(at.rp_mm), number(drift)))
    if rows:
        note = (
            "Of what was found, against the truth of the same trial. RP: mean distance from their own mean, and three standard deviations."
        )
        yield Table(f"Pose accuracy and repeatability, {detector} (ISO 9283)", columns, tuple(rows), note)


def _errors_at(run: RunRecord, detector: str) -> dict[tuple[str, str], Floats]:
    """Errors (n, 3) in order of time by pose and teat."""
    found: dict[tuple[str, str], list[Floats]] = {}
    for trial in run.counted:
        score = trial.scores.get(detector)
        if score is None:
            continue
        for (_, truth), error in zip(score.match.pairs, score.errors_mm, strict=True):
            found.setdefault((trial.pose, str(trial.truth[truth]["teat"])), []).append(error)
    return {key: np.array(errors) for key, errors in sorted(found.items())}
