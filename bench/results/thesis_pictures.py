"""The thesis's own criterion: a teat counts as found where the answer lies on its end in the
picture (section 5.2.7: "detection of any point of the end of the teat is a perfect result"): within
a teat's radius of the axis of its rounded end, taken as upright.

Read from the stages that its detector leaves in the record: ends in the thermal picture, the places
where the homographies put them in the optical pictures (unrefined), and where the optical pictures
moved these (refined).
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.record.reader import TrialRecord, points_mm
from bench.record.schema import Row
from bench.scoring.errors import Bools, Floats
from detector.calibration import Calibration

RADIUS_MM = 11.0  # of a phantom's teat; some 13 px in the optical pictures
GATE_PX = 40.0  # the side of the region that refinement searches (section 4.2)
PICTURES = ("thermal", "left", "left refined", "right", "right refined")
STAGES = {
    "thermal": ("teat ends", "points_px"),
    "left": ("nominations", "left_px"),
    "left refined": ("ends", "left_px"),
    "right": ("nominations", "right_px"),
    "right refined": ("ends", "right_px"),
}


@dataclass(frozen=True, slots=True, eq=False)
class ImageDistances:
    """One row a visible end and trial: distances of its answer in each of `PICTURES` (n, 5) px, and
    unrefined and refined (n, 2) mm; ``astray``: ends nominated at no teat, by situation.
    """

    situations: tuple[str, ...]
    teats: tuple[str, ...]
    off_px: Floats
    on_end: Bools
    off_mm: Floats
    astray: Mapping[str, int]

    def of(self, situation: str | None = None, teat: str | None = None) -> Bools:
        """The rows of one situation and teat (n,); of all for None."""
        each = zip(self.situations, self.teats, strict=True)
        rows = [situation in (None, s) and teat in (None, t) for s, t in each]
        return np.array(rows, dtype=np.bool_)

    def moved(self, rows: Bools) -> tuple[int, int]:
        """How many ends the optical pictures moved nearer to the truth, and how many farther."""
        nearer = (self.off_px[:, (2, 4)] - self.off_px[:, (1, 3)])[rows]
        return int((nearer < 0.0).sum()), int((nearer > 0.0).sum())


def in_pictures(
    trials: Sequence[TrialRecord], detector: str, calibration: Calibration
) -> ImageDistances | None:
    """Of a detector that leaves the thesis's stages; None for any other."""
    seen: list[tuple[TrialRecord, list[Row], Floats]] = []
    for trial in trials:
        traces = [d["trace"] for d in trial.detections if d["detector"] == detector]
        # long ones of other detectors are not read
        named = json.loads(traces[0]) if traces and '"edges"' in traces[0] else {}
        if "thermal" in named and "edges" in named:
            seen.append((trial, [row for row in trial.truth if row["visible"]], _answers(named)))
    if not seen:
        return None
    rows = [(str(trial.head["situation"]), row) for trial, visible, _ in seen for row in visible]
    ends = points_mm(row for _, row in rows)
    apex, _ = _seen(ends, calibration)  # at once: four points take as long as hundreds
    paired, astray, first = list[tuple[NDArray[np.intp], Floats]](), Counter[str](), 0
    for trial, visible, answers_px in seen:
        at, of = _paired(apex[:, first : first + len(visible)], answers_px)
        paired.append((first + at, answers_px[:, of]))
        astray[str(trial.head["situation"])] += answers_px.shape[1] - len(of)
        first += len(visible)
    found, answers = zip(*paired, strict=True)
    answers_px = np.concatenate(answers, axis=1)
    compared = _compared(ends, np.concatenate(found), answers_px, calibration)
    situations, teats = tuple(of for of, _ in rows), tuple(str(row["teat"]) for _, row in rows)
    return ImageDistances(situations, teats, *compared, astray)


def _answers(trace: Mapping[str, Any]) -> Floats:
    """The answer's ends (5, n, 2) px in `PICTURES`; none where a stage was not reached."""
    found = [trace.get(stage, {}).get(key, []) for stage, key in STAGES.values()]
    try:
        return np.array(found, dtype=np.float64).reshape(len(PICTURES), -1, 2)
    except (TypeError, ValueError):  # another detector's stages of these names
        return np.empty((len(PICTURES), 0, 2))


def _paired(apex: Floats, answers_px: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Of true ends (5, k, 2) and answers (5, n, 2): which belong together in optical pictures."""
    from scipy.optimize import linear_sum_assignment  # late: loads for a fifth of a second

    far = np.linalg.norm(answers_px[1::2, None] - apex[1::2, :, None], axis=3)  # (2, k, n)
    cost = np.nan_to_num(far.min(axis=0), nan=1e6)
    at, of = linear_sum_assignment(np.minimum(cost, 2.0 * GATE_PX))
    good = cost[at, of] < GATE_PX
    return at[good], of[good]


def _compared(
    ends_mm: Floats, at: NDArray[np.intp], answers_px: Floats, calibration: Calibration
) -> tuple[Floats, Bools, Floats]:
    """Of true ends (k, 3), and answers (5, n, 2) of those ``at`` (n,): distances (k, 5), whether on
    the end (k, 5), mm (k, 2).
    """
    apex, focal = _seen(ends_mm, calibration)
    middle, _ = _seen(ends_mm - np.array([0.0, 0.0, RADIUS_MM]), calibration)
    off_px, from_axis_px = np.full((2, len(ends_mm), len(PICTURES)), np.nan)
    # from the axis of the rounded end, from its apex to its middle
    along = middle[:, at] - apex[:, at]
    there = answers_px - apex[:, at]
    off_px[at] = np.linalg.norm(there, axis=2).T
    share = np.clip((there * along).sum(axis=2) / (along**2).sum(axis=2), 0.0, 1.0)
    from_axis_px[at] = np.linalg.norm(there - share[..., None] * along, axis=2).T
    depth = calibration.world_from_right.inverse().apply(ends_mm)[:, 2:3]
    off_mm = np.full((len(ends_mm), 2), np.nan)
    for k, (one, other) in enumerate(((1, 3), (2, 4))):
        found = calibration.place(answers_px[one], answers_px[other])
        off_mm[at, k] = np.linalg.norm(found - ends_mm[at], axis=1)
    with np.errstate(invalid="ignore"):
        on_end = np.asarray(from_axis_px <= RADIUS_MM * focal / depth)
    return off_px, on_end, off_mm


def _seen(points_mm: Floats, calibration: Calibration) -> tuple[Floats, Floats]:
    """Points (k, 3) in the five pictures, (5, k, 2), and their focal lengths (5,), px."""
    left, right = calibration.project(points_mm)
    lens, pose = calibration.thermal.lens, calibration.thermal_from_right
    thermal, focal_px = np.full_like(left, np.nan), np.nan
    if lens is not None and pose is not None:
        in_right = calibration.world_from_right.inverse().apply(points_mm)
        thermal, focal_px = lens.project(pose.apply(in_right)), lens.fc[0]
    focal = (focal_px, *(calibration.left.fc[0],) * 2, *(calibration.right.fc[0],) * 2)
    return np.array([thermal, left, left, right, right]), np.array(focal)
