"""Of `thesis.py`, what is measured in pictures.

By the thesis an end is found in a picture (section 5.2.7: "detection of any point of the end of the
teat is a perfect result") where the answer lies on the rounded end that the picture shows: within a
teat's radius of its axis, taken as upright. Unrefined ends are where the homographies put the
thermal ones; each optical picture refines them by itself.
"""

import json
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from detector import Array, Calibration
from instruments import spoken

RADIUS_MM = 11.0  # of a phantom's teat; some 13 px in the optical pictures
GATE_PX = 40.0  # the side of the region that refinement searches (section 4.2)
# by picture: where the detector's trace has its ends
STAGES = {
    "thermal": ("teat ends", "points_px"),
    "left": ("nominations", "left_px"),
    "left, refined": ("ends", "left_px"),
    "right": ("nominations", "right_px"),
    "right, refined": ("ends", "right_px"),
}
IN_PICTURES = (*STAGES, "refining moved the end", "at no teat")
COUNTS = ("situation", "printed", "within the gate in mm", *IN_PICTURES)
IN_PX = tuple(f"{picture} (px)" for picture in STAGES)
DISTANCES = ("situation", "teat", "answers", *IN_PX, "unrefined (mm)", "refined (mm)")


class End(NamedTuple):
    """A visible end: whether its teat is found in mm, and the end in each picture (5,); distances
    of its answer (7,), five in px and two in mm, not-a-number without one.
    """

    situation: str
    teat: str
    in_mm: bool
    on_end: Array
    off: Array


class Pictured(NamedTuple):
    """A trial's visible ends, and how many answers are at none of them."""

    situation: str
    ends: Sequence[End]
    astray: int


def seen(points_mm: Array, calibration: Calibration) -> tuple[Array, Array]:
    """Points (k, 3) in the five pictures, (5, k, 2) px, and their focal lengths (5, 1) px."""
    left, right = calibration.project(points_mm)
    lens, pose = calibration.thermal.lens, calibration.thermal_from_right
    thermal, focal = np.full_like(left, np.nan), np.nan
    if lens is not None and pose is not None:
        in_right = calibration.world_from_right.inverse().apply(points_mm)
        thermal, focal = lens.project(pose.apply(in_right)), lens.fc[0]
    fc = focal, *(calibration.left.fc[0],) * 2, *(calibration.right.fc[0],) * 2
    return np.array([thermal, left, left, right, right]), np.array(fc)[:, None]


def pictured(trial: Any, detector: str, calibration: Calibration) -> Pictured | None:
    """A trial of a detector that leaves the thesis's stages in the record; None of any other."""
    traces = [row["trace"] for row in trial.detections if row["detector"] == detector]
    trace = json.loads(traces[0]) if traces and '"edges"' in traces[0] else {}
    if "thermal" not in trace or detector not in trial.scores:
        return None
    found = [trace.get(stage, {}).get(key, []) for stage, key in STAGES.values()]
    try:
        answers = np.array(found, dtype=float).reshape(len(STAGES), -1, 2)
    except ValueError:  # another detector's stages of these names
        answers = np.empty((len(STAGES), 0, 2))
    matched = {teat for _, teat in trial.scores[detector].match.pairs}
    visible = {number: row for number, row in enumerate(trial.truth) if row["visible"]}
    points = [[row[f"{axis}_mm"] for axis in "xyz"] for row in visible.values()]
    true_mm = np.array(points).reshape(-1, 3)
    apex, focal = seen(true_mm, calibration)
    middle, _ = seen(true_mm - np.array([0.0, 0.0, RADIUS_MM]), calibration)
    # which belong together: by their distances in the optical pictures, unrefined
    far = np.linalg.norm(answers[1::2, None] - apex[1::2, :, None], axis=3)
    cost = np.nan_to_num(far.min(axis=0), nan=1e6)
    at, of = linear_sum_assignment(np.minimum(cost, 2.0 * GATE_PX))
    near = cost[at, of] < GATE_PX
    at, of = at[near], of[near]
    # from the axis of the rounded end, from its apex to its middle
    along, there = (middle - apex)[:, at], answers[:, of] - apex[:, at]
    share = np.clip((there * along).sum(axis=2) / (along**2).sum(axis=2), 0.0, 1.0)
    from_axis = np.linalg.norm(there - share[..., None] * along, axis=2)
    depth = calibration.world_from_right.inverse().apply(true_mm)[at, 2]
    on_end = np.zeros((len(visible), len(STAGES)), dtype=bool)
    on_end[at] = (from_axis <= RADIUS_MM * focal / depth).T
    off = np.full((len(visible), len(STAGES) + 2), np.nan)
    off[at, : len(STAGES)] = np.linalg.norm(there, axis=2).T
    for column, left, right in ((-2, 1, 3), (-1, 2, 4)):
        placed = calibration.place(answers[left, of], answers[right, of])
        off[at, column] = np.linalg.norm(placed - true_mm[at], axis=1)
    situation = str(trial.head["situation"])
    ends = [
        End(situation, str(row["teat"]), number in matched, *of_end)
        for (number, row), *of_end in zip(visible.items(), on_end, off, strict=True)
    ]
    return Pictured(situation, ends, answers.shape[1] - len(of))


def counted(trials: Sequence[Pictured]) -> Iterator[object]:
    """The values of `COUNTS` after the first two."""
    ends = [end for trial in trials for end in trial.ends]
    found = np.array([[end.in_mm, *end.on_end] for end in ends]).reshape(-1, 1 + len(STAGES))
    yield from (f"{count} of {len(ends)}" for count in found.sum(axis=0))
    moved = np.array([end.off[[2, 4]] - end.off[[1, 3]] for end in ends])
    yield f"{(moved < 0.0).sum()} nearer, {(moved > 0.0).sum()} farther"
    yield sum(trial.astray for trial in trials)


def by_teat(trials: Sequence[Pictured]) -> Iterator[tuple[object, ...]]:
    """Rows of `DISTANCES`: medians over the frame sets in which a teat has an answer."""
    ends = [end for trial in trials for end in trial.ends]
    for situation, teat in dict.fromkeys((end.situation, end.teat) for end in ends):
        off = np.array([end.off for end in ends if (end.situation, end.teat) == (situation, teat)])
        found = off[np.isfinite(off[:, 1])]
        medians = np.median(found, axis=0) if len(found) else np.full(off.shape[1], np.nan)
        values = [f"{value:.1f}" if np.isfinite(value) else "not measured" for value in medians]
        yield spoken(situation), teat, f"{len(found)} of {len(off)}", *values
