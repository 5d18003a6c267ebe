"""Errors with what they may depend on (place, time, bath temperature, tilt), pooled by pose and
teat, and the gage R&R study of the truth.

Time and temperature are asked within a teat's pose where poses are repeated; else over the poses,
where they can't be separated from place. In the gage study a part is a teat at a pose; an appraiser
is a run, or, of one run, a repeat. Cells must be full; the rest is left out and counted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import compress
from operator import itemgetter
from pathlib import Path

import numpy as np

from bench.config import parse_config, read_text
from bench.record.reader import RunRecord
from bench.record.schema import SCRIPT
from bench.results.verdicts import scored_trials
from bench.scoring.errors import Bools, Floats, numbered
from bench.scoring.joint import JointCovariance
from bench.scoring.precision import GageStudy, Precision, gage_study, precision
from bench.scoring.spread import (
    BiasTest,
    Ellipsoid,
    Regressor,
    Trend,
    bias_ellipsoid,
    bias_test,
    pose_means,
    prediction_ellipsoid,
    trends,
)
from bench.script.model import Script, layouts_of, planned_of
from bench.script.planned_trials import PlannedTrial
from bench.truth.joint import End, joint_truth

WITHIN = ("time_s", "bath_c")
UNPLANNED = np.full(3, np.nan)


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
    # planned places (k, 3) of the found rows, and what is known of their truth
    planned_mm: Floats | None = None
    truth: JointCovariance | None = None

    @property
    def teat_names(self) -> tuple[str, ...]:
        """Each teat once, in order."""
        return tuple(sorted(set(self.teats)))

    def of_teat(self, teat: str) -> ErrorRows:
        """The rows of one teat."""
        rows = np.array([name == teat for name in self.teats], dtype=np.bool_)
        columns = (self.time_s[rows], self.bath_c[rows], self.tilt_deg[rows])
        poses, trials, teats = (
            tuple(compress(all_of, rows)) for all_of in (self.poses, self.trials, self.teats)
        )
        own = rows[self.found]
        planned = None if self.planned_mm is None else self.planned_mm[own]
        truth = None if self.truth is None else self.truth.of(own)
        errors = self.errors_mm[own]
        some = self.places_mm[rows], self.found[rows], errors, *columns
        return ErrorRows(*some, poses, trials, teats, planned, truth)

    @property
    def quantities(self) -> dict[str, Regressor]:
        """What the errors may depend on, for the found rows. The place is the planned one; in a
        recording, which has no plan, the truth's.
        """
        places = self.places_mm[self.found] if self.planned_mm is None else self.planned_mm
        u_mm = np.zeros(3)
        if self.truth is not None and len(self.truth.fresh):
            u_mm = np.sqrt(np.einsum("naa->na", self.truth.covariances_mm2).max(axis=0))
        measured = self.planned_mm is None
        found = {
            name: Regressor(column, float(u), measured)
            for name, column, u in zip(("x_mm", "y_mm", "z_mm"), places.T, u_mm, strict=True)
        }
        others = {"time_s": self.time_s, "bath_c": self.bath_c, "tilt_deg": self.tilt_deg}
        return found | {name: Regressor(column[self.found]) for name, column in others.items()}

    @property
    def of_mean(self) -> Floats:
        """What each found row weighs (k,) in the mean over poses of each pose's mean."""
        poses = self.of_found(self.poses)
        each = Counter(poses)
        return np.array([1.0 / (len(each) * each[pose]) for pose in poses], dtype=np.float64)

    @property
    def common_mm2(self) -> Floats | None:
        """Covariance (3, 3) of what the truths of that mean have in common."""
        return None if self.truth is None else self.truth.of_mean(self.of_mean)

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
    """Over pose means: region of the next error, region of the bias (95 % both), its test, the
    means (p, 3), and the covariance (3, 3) that their truths share.
    """

    next_error: Ellipsoid | None
    bias: Ellipsoid | None
    test: BiasTest
    means_mm: Floats
    common_mm2: Floats | None = None


@lru_cache(maxsize=4)  # of two runs' two detectors: several tables and figures are made of each
def error_rows(run: RunRecord, detector: str) -> ErrorRows:
    """The rows of one detector, of trials that count."""
    planned = planned_ends(run)
    rows: list[tuple[float | None, ...]] = []
    names: list[tuple[str, str, str]] = []
    errors: list[Floats] = []
    ends: list[End] = []
    for trial in scored_trials(run, detector):
        score = trial.scores[detector]
        at = {teat: row for row, (_, teat) in enumerate(score.match.pairs)}
        for index, truth in enumerate(trial.truth):
            if not truth["visible"]:
                continue
            teat = str(truth["teat"])
            _, tilt_deg = planned.get((trial.id, teat), (UNPLANNED, None))
            known = (trial.head["captured_s"], trial.head["bath_c"], tilt_deg)
            rows.append((*_point(truth), *known, index in at))
            names.append((trial.pose, trial.id, teat))
            if index in at:
                errors.append(score.errors_mm[at[index]])
                ends.append((trial, truth))
    table = np.array(rows, dtype=np.float64).reshape(-1, 7)  # None becomes not-a-number
    poses, trials, teats = zip(*names, strict=True) if names else ((), (), ())
    found = np.array(errors, dtype=np.float64).reshape(-1, 3)
    columns = table[:, 3], table[:, 4], table[:, 5]
    places = None
    if planned:
        keys = [(trial.id, str(row["teat"])) for trial, row in ends]
        at_mm = [planned.get(key, (UNPLANNED, 0.0))[0] for key in keys]
        places = np.array(at_mm).reshape(-1, 3)
    of_all = table[:, :3], table[:, 6] > 0.5, found, *columns
    return ErrorRows(*of_all, poses, trials, teats, places, joint_truth(run, ends))


def run_trends(rows: ErrorRows) -> tuple[Trend, ...]:
    """Errors against x, y, z, time, bath temperature and tilt, adjusted together after Holm."""
    poses, teats, trials = (rows.of_found(names) for names in (rows.poses, rows.teats, rows.trials))
    strata: tuple[Hashable, ...] = tuple(zip(poses, teats, strict=True))
    repeated = any(count > 1 for count in Counter(strata).values())
    within: Mapping[str, tuple[Hashable, ...]] = dict.fromkeys(WITHIN, strata) if repeated else {}
    asked: Mapping[str, Regressor] = rows.quantities
    return trends(
        *(asked, rows.errors_mm, poses), within=within, within_groups=trials, truth=rows.truth
    )


def run_bias(rows: ErrorRows) -> Bias:
    """Ellipsoids of the poses' mean errors, and Hotelling's test of their mean."""
    return _bias(pose_means(rows.errors_mm, rows.of_found(rows.poses)), rows)


def _bias(means_mm: Floats, rows: ErrorRows) -> Bias:
    common_mm2 = rows.common_mm2
    return Bias(
        prediction_ellipsoid(means_mm, common_mm2=common_mm2),
        bias_ellipsoid(means_mm, common_mm2=common_mm2),
        bias_test(means_mm, common_mm2),
        means_mm,
        common_mm2,
    )


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
        found.append(TeatErrors(teat, means, worst_trials, _bias(means, of)))
    return tuple(found)


def pose_places(rows: ErrorRows) -> tuple[PosePlace, ...]:
    """Each teat at each pose, in order of teat, then of time."""
    at: dict[tuple[str, str], list[int]] = {}
    for row, key in enumerate(zip(rows.teats, rows.poses, strict=True)):
        at.setdefault(key, []).append(row)
    distances = np.full(len(rows.found), np.nan)
    distances[rows.found] = np.linalg.norm(rows.errors_mm, axis=1)
    at_place = numbered([*zip(rows.teats, rows.poses, strict=True)])
    sums = np.array([np.bincount(at_place, along) for along in rows.places_mm.T])
    means = dict(zip(at, (sums / np.bincount(at_place)).T.tolist(), strict=True))
    places = []
    for teat, pose in sorted(at, key=lambda key: (key[0], at[key][0])):
        here = at[teat, pose]
        missed = [rows.trials[row] for row in here if not rows.found[row]]
        seen = [(float(distances[row]), rows.trials[row]) for row in here if rows.found[row]]
        worst_mm, worst = max(seen, key=itemgetter(0), default=(None, None))  # the first of equals
        x, y, z = means[teat, pose]
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


def planned_ends(run: RunRecord) -> dict[tuple[str, str], tuple[Floats, float]]:
    """Where the script has each end (world, mm) and how far its teat leans from the vertical (deg),
    by trial and teat; nothing for a recording.
    """
    found: dict[tuple[str, str], tuple[Floats, float]] = {}
    path = run.folder / SCRIPT
    for planned in _planned_in(path, read_text(path)) if path.is_file() else ():
        phantom = planned.phantom.moved(planned.pose)
        for number, (teat, end) in enumerate(zip(phantom.teats, phantom.ends_mm, strict=True), 1):
            lean = float(np.degrees(np.arctan(np.hypot(*np.tan(teat.tilt_rad)))))
            keys = (planned.id, str(number)), (planned.id, teat.name)
            found |= dict.fromkeys(keys, (end, lean))
    return found


@lru_cache(maxsize=2)  # each detector's tables ask, and a drawn scene takes milliseconds
def _planned_in(path: Path, text: str) -> tuple[PlannedTrial, ...]:
    # a detector that isn't at hand any more is no hindrance
    script = parse_config(path, text, Script, stored=True)
    return planned_of(script, layouts_of(script, path.parent))


Part = tuple[str, str]
Touches = dict[Part, dict[str, list[tuple[float, float, float]]]]


@dataclass(frozen=True, slots=True)
class TruthGage:
    """The studies along x, y and z, mm, or ``why`` there are none; parts that were left out; what
    all touches have in common along each axis, standard uncertainty as stated.
    """

    studies: tuple[GageStudy, GageStudy, GageStudy] | None
    left_out: int = 0
    why: str = ""
    common_mm: tuple[float, ...] = (0.0, 0.0, 0.0)


def truth_gage(runs: Sequence[RunRecord], poses: Collection[str] = ()) -> TruthGage:
    """The study over all touches that were not refused, of trials that count, and of ``poses``."""
    touches: Touches = {}
    for number, run in enumerate(runs):
        for trial in (one for one in run.counted if not poses or one.pose in poses):
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
    # the largest of several runs, which have an arm and a frame in common
    common_mm = np.zeros(3)
    for run in runs:
        ends = [(t, row) for t in run.counted if t.touches for row in t.truth]
        shared = joint_truth(run, ends).of_mean(np.full(len(ends), 1.0 / max(len(ends), 1)))
        common_mm = np.maximum(common_mm, np.sqrt(np.diag(shared)))
    common = tuple(map(float, common_mm))
    return TruthGage((x, y, z), len(cells) - len(parts), common_mm=common)


def _point(row: Mapping[str, float]) -> tuple[float, float, float]:
    return row["x_mm"], row["y_mm"], row["z_mm"]
