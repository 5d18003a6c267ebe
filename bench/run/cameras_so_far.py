"""What a run's known ends say of its cameras up to now; ``trials``: of its last sessions."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from bench.record.reader import TrialRecord
from bench.results.cameras_agree import DEFAULT, check_cameras
from bench.scoring.joint import JointCovariance
from detector.protocol import CamerasOff, Context


class CamerasSoFar:
    """The check of a run's cameras for the detectors' context."""

    def __init__(self, trials: Iterable[TrialRecord] = ()) -> None:
        self._seen: dict[str, list[dict[str, Any]]] = defaultdict(list)
        self._u_mm = 0.0
        for trial in trials:
            self.add(trial.pose, trial.truth)

    def add(self, pose: str, truth: Iterable[Mapping[str, Any]]) -> None:
        """One more frame set of a pose, by its rows of the table ``truth``."""
        for row in truth:
            self._seen[pose] += [json.loads(row["cameras"])] if row["cameras"] else []
            self._u_mm = max(self._u_mm, row["u_mm"] or 0.0)

    @property
    def context(self) -> Context | None:
        """The disparity where it is beyond its limit with confidence, else None. The truth's
        uncertainty counts as if all of it were common to all ends.
        """
        seen = {pose: rows for pose, rows in self._seen.items() if rows}
        n = sum(map(len, seen.values()))
        shared = np.tile(self._u_mm * np.eye(3), (n, 1, 1))
        truth = JointCovariance(shared, np.zeros((n, 3, 3)), ("truth",) * 3)
        found = check_cameras(seen, truth).disparity
        if found is None or not found.exceeds(DEFAULT.limit_px):
            return None
        return Context(cameras=CamerasOff(found.value, found.uncertainty, found.poses))
