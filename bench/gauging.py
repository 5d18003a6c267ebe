"""Gage R&R of the ground truth from the record: each teat end touched several times, and set up again, in one run or in several.

A part is a teat at a pose. With several runs of one script each run is an appraiser, with one run each repeat of the pose. The analysis
wants every cell full, so what was touched less often than the rest is left out, and told. May not judge, and may not word.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bench.record import RunRecord
from bench.scoring.gage import GageStudy, gage_study
from bench.scoring.points import Floats

Part = tuple[str, str]
Touches = dict[Part, dict[str, list[tuple[float, float, float]]]]


@dataclass(frozen=True, slots=True)
class TruthGage:
    """The studies along the world's x, y and z, mm; None where the record doesn't hold one, and ``why`` then says why not.

    ``left_out`` parts had too few touches or set-ups.
    """

    studies: tuple[GageStudy, GageStudy, GageStudy] | None
    left_out: int = 0
    why: str = ""


def truth_gage(runs: Sequence[RunRecord]) -> TruthGage:
    """The study over all touches that were not refused, of trials that count."""
    touches = _touches(runs)
    if not touches:
        return TruthGage(None, why="no teat end was touched")
    cells = {part: [points for points in by.values() if len(points) > 1] for part, by in touches.items()}
    sizes = Counter(len(full) for full in cells.values() if len(full) > 1)
    if not sizes:
        return TruthGage(None, len(cells), "no end was touched twice in each of two set-ups; repeat the poses, or give a second run")
    appraisers = max(sizes, key=lambda size: (sizes[size] * size, size))  # as many set-ups as keep the most of what was measured
    parts = [full[:appraisers] for full in cells.values() if len(full) >= appraisers]
    if len(parts) < 2:
        return TruthGage(None, len(cells), "only one end was touched in several set-ups")
    repeats = min(len(points) for part in parts for points in part)
    table: Floats = np.array([[points[:repeats] for points in part] for part in parts])
    x, y, z = (gage_study(table[..., axis]) for axis in range(3))
    return TruthGage((x, y, z), len(cells) - len(parts))


def _touches(runs: Sequence[RunRecord]) -> Touches:
    found: Touches = {}
    for number, run in enumerate(runs):
        for trial in run.counted:
            for row in trial.touches:
                if row["refused"] is None:
                    appraiser = f"run {number}" if len(runs) > 1 else trial.id
                    part = found.setdefault((trial.pose, str(row["teat"])), {})
                    part.setdefault(appraiser, []).append(_point(row))
    return found


def _point(row: Mapping[str, float]) -> tuple[float, float, float]:
    return row["x_mm"], row["y_mm"], row["z_mm"]
