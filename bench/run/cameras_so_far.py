"""What the known ends of a run say of its cameras up to now."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from bench.record.recording import TruthRow
from bench.results.cameras_agree import DEFAULT, check_cameras
from bench.scoring.joint import JointCovariance
from detector.outline.known_ends import EndOffsets
from detector.protocol import CamerasOff, Context


class CamerasSoFar:
    """What the known ends of a run say of its cameras up to now, for the detectors to be told."""

    def __init__(self) -> None:
        self._seen: dict[str, list[dict[str, Any]]] = defaultdict(list)
        self._u_mm = 0.0

    def add(self, pose: str, ends: Mapping[str, EndOffsets], truth: Sequence[TruthRow]) -> None:
        """One more frame set of a pose, where its ``ends`` are seen, and its truth."""
        self._seen[pose] += [asdict(one) for one in ends.values()]
        self._u_mm = max([self._u_mm, *(row.u_mm or 0.0 for row in truth)])

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
