"""Errors with what they may depend on (place, time, bath temperature, tilt), pooled by pose and
teat, and the gage R&R study of the truth.

Time and temperature are asked within a teat's pose where poses are repeated; else over the poses,
where they can't be separated from place. In the gage study a part is a teat at a pose; an appraiser
is a run, or, of one run, a repeat. Cells must be full; the rest is left out and counted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from itertools import compress
from operator import itemgetter

import numpy as np

from bench.config import read_config
from bench.record.reader import RunRecord
from bench.record.schema import SCRIPT
from bench.results.verdicts import scored_trials
from bench.scoring.errors import Bools, Floats
from bench.scoring.precision import GageStudy, Precision, gage_study, precision
from bench.scoring.spread import (
    BiasTest,
    Ellipsoid,
    Trend,
    bias_ellipsoid,
    bias_test,
    pose_means,
    prediction_ellipsoid,
    trends,
)
from bench.script.model import Script, layouts_of, planned_of

WITHIN = ("time_s", "bath_c")


@dataclass(frozen=True, slots=True, eq=False)
class ErrorRows:
    """One row a visible teat and trial of one detector, in order of time; ``errors_mm`` (k, 3) are
    of the ``found`` rows. What is not known is not-a-number.
    """

    places_mm: Floats
    found: Bools
    errors_mm: Floats
    time_s: Floats
    bath_c: Floats
    tilt_deg: Floats
    poses: tuple[str, ...]
    trials: tuple[str, ...]
    teats: tuple[str, ...]

    @property
    def teat_names(self) -> tuple[str, ...]:
        """Each teat once, in order."""
        return tuple(sorted(set(self.teats)))

    def of_teat(self, teat: str) -> ErrorRows:
        """The rows of one teat."""
        rows = np.array([name == teat for name in self.teats], dtype=np.bool_)
        columns = (self.time_s[rows], self.bath_c[rows], self.tilt_deg[rows])
        names = (tuple(compress(all_of, rows)) for all_of in (self.poses, self.trials, self.teats))
        errors = self.errors_mm[rows[self.found]]
        return ErrorRows(self.places_mm[rows], self.found[rows], errors, *columns, *names)

    @property
    def quantities(self) -> dict[str, Floats]:
        """What the errors may depend on, for the found rows."""
        columns = dict(zip(("x_mm", "y_mm", "z_mm"), self.places_mm.T, strict=True))
        columns |= {"time_s": self.time_s, "bath_c": self.bath_c, "tilt_deg": self.tilt_deg}
        return {name: column[self.found] for name, column in columns.items()}

    def of_found(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """The names of the found rows."""
        return tuple(compress(names, self.found))


@dataclass(frozen=True, slots=True, eq=False)
class TeatErrors:
    """One teat over its p poses: mean errors (p, 3), trials with the worst repeat, ellipsoids."""

    teat: str
    means_mm: Floats
    worst_trials: tuple[str, ...]
    bias: Bias


@dataclass(frozen=True, slots=True)
class PosePlace:
    """One teat at one pose: mean place of its end, how often it was to be found and was, its worst
    distance with the trial of it, and the first trial that missed it; None for none.
    """

    teat: str
    pose: str
    place_mm: tuple[float, float, float]
    repeats: int
    found: int
    worst_mm: float | None
    worst_trial: str | None
    missed_trial: str | None


@dataclass(frozen=True, slots=True, eq=False)
class Bias:
    """Over pose means: region of the next error, region of the bias (95 % both), and its test."""

    next_error: Ellipsoid | None
    bias: Ellipsoid | None
    test: BiasTest


def error_rows(run: RunRecord, detector: str, situation: str | None = None) -> ErrorRows:
    """The rows of one detector, of trials that count; of one situation where named."""
    tilts = teat_tilts_deg(run)
    rows: list[tuple[float | None, ...]] = []
    names: list[tuple[str, str, str]] = []
    errors: list[Floats] = []
    for trial in scored_trials(run, detector, situation):
        score = trial.scores[detector]
        at = {teat: row for row, (_, teat) in enumerate(score.match.pairs)}
        for index, truth in enumerate(trial.truth):
            if not truth["visible"]:
                continue
            teat = str(truth["teat"])
            known = (trial.head["captured_s"], trial.head["bath_c"], tilts.get((trial.id, teat)))
            rows.append((*_point(truth), *known, index in at))
            names.append((trial.pose, trial.id, teat))
            if index in at:
                errors.append(score.errors_mm[at[index]])
    table = np.array(rows, dtype=np.float64).reshape(-1, 7)  # None becomes not-a-number
    poses, trials, teats = zip(*names, strict=True) if names else ((), (), ())
    found = np.array(errors, dtype=np.float64).reshape(-1, 3)
    columns = table[:, 3], table[:, 4], table[:, 5]
    return ErrorRows(table[:, :3], table[:, 6] > 0.5, found, *columns, poses, trials, teats)


def run_trends(rows: ErrorRows) -> tuple[Trend, ...]:
    """Errors against x, y, z, time, bath temperature and tilt, adjusted together after Holm."""
    poses, teats, trials = (rows.of_found(names) for names in (rows.poses, rows.teats, rows.trials))
    strata: tuple[Hashable, ...] = tuple(zip(poses, teats, strict=True))
    repeated = any(count > 1 for count in Counter(strata).values())
    within: Mapping[str, tuple[Hashable, ...]] = dict.fromkeys(WITHIN, strata) if repeated else {}
    return trends(rows.quantities, rows.errors_mm, poses, within=within, within_groups=trials)


def run_bias(rows: ErrorRows) -> Bias:
    """Ellipsoids of the poses' mean errors, and Hotelling's test of their mean."""
    return _bias(pose_means(rows.errors_mm, rows.of_found(rows.poses)))


def _bias(means_mm: Floats) -> Bias:
    return Bias(prediction_ellipsoid(means_mm), bias_ellipsoid(means_mm), bias_test(means_mm))


def teat_errors(rows: ErrorRows) -> tuple[TeatErrors, ...]:
    """Each teat's errors in the order of its poses; without teats that were never found."""
    found = []
    for teat in rows.teat_names:
        of = rows.of_teat(teat)
        poses, trials = of.of_found(of.poses), of.of_found(of.trials)
        worst: dict[str, tuple[float, str]] = {}
        distances = np.linalg.norm(of.errors_mm, axis=1).tolist()
        for pose, trial, distance in zip(poses, trials, distances, strict=True):
            worst[pose] = max(worst.get(pose, (-1.0, "")), (distance, trial))
        means = pose_means(of.errors_mm, poses)
        worst_trials = tuple(trial for _, trial in worst.values())
        found.append(TeatErrors(teat, means, worst_trials, _bias(means)))
    return tuple(found)


def pose_places(rows: ErrorRows) -> tuple[PosePlace, ...]:
    """Each teat at each pose, in order of teat, then of time."""
    at: dict[tuple[str, str], list[int]] = {}
    for row, key in enumerate(zip(rows.teats, rows.poses, strict=True)):
        at.setdefault(key, []).append(row)
    distances = np.full(len(rows.found), np.nan)
    distances[rows.found] = np.linalg.norm(rows.errors_mm, axis=1)
    places = []
    for teat, pose in sorted(at, key=lambda key: (key[0], at[key][0])):
        here = at[teat, pose]
        missed = [rows.trials[row] for row in here if not rows.found[row]]
        seen = [(float(distances[row]), rows.trials[row]) for row in here if rows.found[row]]
        worst_mm, worst = max(seen, key=itemgetter(0), default=(None, None))  # the first of equals
        x, y, z = rows.places_mm[here].mean(axis=0).tolist()
        first_missed = missed[0] if missed else None
        counts = len(here), len(here) - len(missed)
        places.append(PosePlace(teat, pose, (x, y, z), *counts, worst_mm, worst, first_missed))
    return tuple(places)


def run_precision(rows: ErrorRows) -> tuple[Precision, Precision, Precision]:
    """ISO 5725 along x, y and z: s_r of repeats at a pose, s_R over all teats and poses."""
    groups: dict[tuple[str, str], list[Floats]] = {}
    names = zip(rows.of_found(rows.poses), rows.of_found(rows.teats), strict=True)
    for name, error in zip(names, rows.errors_mm, strict=True):
        groups.setdefault(name, []).append(error)
    x, y, z = (precision([np.array(g)[:, k] for g in groups.values()]) for k in range(3))
    return x, y, z


def teat_tilts_deg(run: RunRecord) -> dict[tuple[str, str], float]:
    """Lean of each teat from the vertical, by trial and teat; nothing for a recording."""
    path = run.folder / SCRIPT
    if not path.is_file():
        return {}
    # a detector that isn't at hand any more is no hindrance
    script = read_config(path, Script, stored=True)
    tilts: dict[tuple[str, str], float] = {}
    for planned in planned_of(script, layouts_of(script, run.folder)):
        for number, teat in enumerate(planned.phantom.teats, 1):
            lean = np.hypot(*np.tan(teat.tilt_rad))
            for name in (str(number), teat.name):
                tilts[planned.id, name] = float(np.degrees(np.arctan(lean)))
    return tilts


Part = tuple[str, str]
Touches = dict[Part, dict[str, list[tuple[float, float, float]]]]


@dataclass(frozen=True, slots=True)
class TruthGage:
    """The studies along x, y and z, mm, or ``why`` there are none; parts that were left out."""

    studies: tuple[GageStudy, GageStudy, GageStudy] | None
    left_out: int = 0
    why: str = ""


def truth_gage(runs: Sequence[RunRecord]) -> TruthGage:
    """The study over all touches that were not refused, of trials that count."""
    touches: Touches = {}
    for number, run in enumerate(runs):
        for trial in run.counted:
            appraiser = f"run {number}" if len(runs) > 1 else trial.id
            for row in trial.touches:
                if row["refused"] is None:
                    part = touches.setdefault((trial.pose, str(row["teat"])), {})
                    part.setdefault(appraiser, []).append(_point(row))
    if not touches:
        return TruthGage(None, why="no teat end was touched")
    cells = {
        part: [points for points in by.values() if len(points) > 1] for part, by in touches.items()
    }
    sizes = Counter(len(full) for full in cells.values() if len(full) > 1)
    if not sizes:
        why = "no end was touched twice in each of two set-ups; repeat the poses, or give a second"
        return TruthGage(None, len(cells), f"{why} run")
    # as many set-ups as keep the most of what was measured
    appraisers = max(sizes, key=lambda size: (sizes[size] * size, size))
    parts = [full[:appraisers] for full in cells.values() if len(full) >= appraisers]
    if len(parts) < 2:
        return TruthGage(None, len(cells), "only one end was touched in several set-ups")
    repeats = min(len(points) for part in parts for points in part)
    table: Floats = np.array([[points[:repeats] for points in part] for part in parts])
    x, y, z = (gage_study(table[..., axis]) for axis in range(3))
    return TruthGage((x, y, z), len(cells) - len(parts))


def _point(row: Mapping[str, float]) -> tuple[float, float, float]:
    return row["x_mm"], row["y_mm"], row["z_mm"]
