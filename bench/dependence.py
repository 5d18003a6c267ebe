"""What the error of a run depends on: each found teat with its place, time, bath temperature and tilt, for `bench.scoring` to look through.

Time and temperature are asked within each teat at each pose where the script repeats its poses, for then the pose's own error falls out;
without repeats they are asked over the poses, where they can't be told from place. May not judge, and may not word.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Mapping
from dataclasses import dataclass

import numpy as np

from bench.record import RunRecord
from bench.scoring.ellipsoid import BiasTest, Ellipsoid, bias_ellipsoid, bias_test, pose_means, prediction_ellipsoid
from bench.scoring.plane import Cell, error_map
from bench.scoring.points import Bools, Floats
from bench.scoring.repeatability import Precision, precision
from bench.scoring.trends import Trend, trends
from bench.script import load_script
from bench.store import SCRIPT

WITHIN = ("time_s", "bath_c")


@dataclass(frozen=True, slots=True, eq=False)
class ErrorRows:
    """One row a visible teat and trial of one detector, in order of time.

    ``places_mm`` (n, 3) is the true end; ``found`` (n,); ``errors_mm`` (k, 3) belong to the found rows. The rest is (n,), not-a-number
    where it isn't known.
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
    def quantities(self) -> dict[str, Floats]:
        """What the errors may depend on, for the found rows."""
        columns = {"x_mm": self.places_mm[:, 0], "y_mm": self.places_mm[:, 1], "z_mm": self.places_mm[:, 2]}
        columns |= {"time_s": self.time_s, "bath_c": self.bath_c, "tilt_deg": self.tilt_deg}
        return {name: column[self.found] for name, column in columns.items()}

    def of_found(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """The names of the found rows."""
        return tuple(name for name, found in zip(names, self.found, strict=True) if found)


@dataclass(frozen=True, slots=True, eq=False)
class Bias:
    """Over the means of poses: where the next error will be, where the bias is (95 % both), and whether it is one."""

    next_error: Ellipsoid | None
    bias: Ellipsoid | None
    test: BiasTest


def error_rows(run: RunRecord, detector: str) -> ErrorRows:
    """The rows of one detector, of trials that count."""
    tilts = teat_tilts_deg(run)
    rows: list[tuple[float, ...]] = []
    names: list[tuple[str, str, str]] = []
    errors: list[Floats] = []
    for trial in run.counted:
        score = trial.scores.get(detector)
        if score is None:
            continue
        at = {teat: row for row, (_, teat) in enumerate(score.match.pairs)}
        for index, truth in enumerate(trial.truth):
            if not truth["visible"]:
                continue
            place = (truth["x_mm"], truth["y_mm"], truth["z_mm"])
            tilt = tilts.get((trial.id, str(truth["teat"])))
            rows.append((*place, _known(trial.head["captured_s"]), _known(trial.head["bath_c"]), _known(tilt), float(index in at)))
            names.append((trial.pose, trial.id, str(truth["teat"])))
            if index in at:
                errors.append(score.errors_mm[at[index]])
    table = np.array(rows, dtype=np.float64).reshape(-1, 7)
    poses, trials, teats = zip(*names, strict=True) if names else ((), (), ())
    found = np.array(errors, dtype=np.float64).reshape(-1, 3)
    return ErrorRows(table[:, :3], table[:, 6] > 0.5, found, table[:, 3], table[:, 4], table[:, 5], poses, trials, teats)


def run_trends(rows: ErrorRows) -> tuple[Trend, ...]:
    """Errors against x, y, z, time, bath temperature and tilt, adjusted together after Holm."""
    poses, teats, trials = (rows.of_found(names) for names in (rows.poses, rows.teats, rows.trials))
    strata: tuple[Hashable, ...] = tuple(zip(poses, teats, strict=True))
    repeated = any(count > 1 for count in Counter(strata).values())
    within: Mapping[str, tuple[Hashable, ...]] = dict.fromkeys(WITHIN, strata) if repeated else {}
    return trends(rows.quantities, rows.errors_mm, poses, within=within, within_groups=trials)


def plane_cells(rows: ErrorRows, step_mm: float | None = None) -> tuple[Cell, ...]:
    """The error map of the plane; without a step a cell is a place."""
    return error_map(rows.places_mm[:, :2], rows.errors_mm, rows.found, step_mm=step_mm)


def run_bias(rows: ErrorRows) -> Bias:
    """Ellipsoids of the poses' mean errors, and Hotelling's test of their mean."""
    means = pose_means(rows.errors_mm, rows.of_found(rows.poses))
    return Bias(prediction_ellipsoid(means), bias_ellipsoid(means), bias_test(means))


def run_precision(rows: ErrorRows) -> tuple[Precision, Precision, Precision]:
    """ISO 5725 along x, y and z: s_r of the repeats of a teat at a pose, s_R over all teats and poses."""
    groups: dict[tuple[str, str], list[Floats]] = {}
    for pose, teat, error in zip(rows.of_found(rows.poses), rows.of_found(rows.teats), rows.errors_mm, strict=True):
        groups.setdefault((pose, teat), []).append(error)
    x, y, z = (precision([[error[axis] for error in group] for group in groups.values()]) for axis in range(3))
    return x, y, z


def teat_tilts_deg(run: RunRecord) -> dict[tuple[str, str], float]:
    """How far each teat leans from the vertical, by trial and teat (its number or its name); nothing for a recording: it has no phantom."""
    script = run.folder / SCRIPT
    if not script.is_file():
        return {}
    tilts: dict[tuple[str, str], float] = {}
    for planned in load_script(script).planned:
        for number, teat in enumerate(planned.phantom.teats, 1):
            lean = np.hypot(*np.tan(teat.tilt_rad))
            for name in (str(number), teat.name):
                tilts[planned.id, name] = float(np.degrees(np.arctan(lean)))
    return tilts


def _known(value: float | None) -> float:
    return float("nan") if value is None else float(value)
