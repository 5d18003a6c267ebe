"""Many scenes as one: counts and errors side by side, so that situations, detectors and runs merge by adding, never by averaging averages.

A pose is named by the caller; frames of one pose are repeats, and every rate that gets an interval counts poses (a pose succeeds when all
its repeats do).
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np

from bench.scoring.errors import ErrorSummary, summarise
from bench.scoring.matching import Counts, added
from bench.scoring.points import Floats
from bench.scoring.rates import Rate, pose_successes
from bench.scoring.scene import SceneScore


@dataclass(frozen=True, slots=True)
class Pool:
    """Scenes with the name of the pose that each belongs to, in order. Adding two pools puts one behind the other."""

    scores: tuple[SceneScore, ...] = ()
    poses: tuple[Hashable, ...] = ()

    def __post_init__(self) -> None:
        if len(self.scores) != len(self.poses):
            raise ValueError(f"pool: {len(self.scores)} scores with {len(self.poses)} pose names; name the pose of each score")

    def __add__(self, other: Pool) -> Pool:
        return Pool(self.scores + other.scores, self.poses + other.poses)

    @property
    def counts(self) -> Counts:
        """All teats and findings counted."""
        return added(s.counts for s in self.scores)

    @property
    def frames(self) -> Rate:
        """Scenes that succeeded, of the scenes. Repeats are not independent: for an interval use `success`."""
        return Rate(sum(s.success for s in self.scores), len(self.scores))

    @property
    def success(self) -> Rate:
        """Poses that succeeded in all repeats, of the poses."""
        return pose_successes(self.poses, [s.success for s in self.scores])

    @property
    def hidden_right(self) -> Rate:
        """Poses whose hidden teats were counted right in all repeats, of the poses where the detector made a claim."""
        claims = [(p, s.hidden_right) for p, s in zip(self.poses, self.scores, strict=True) if s.hidden_right is not None]
        return pose_successes([p for p, _ in claims], [bool(right) for _, right in claims])

    @property
    def in_time(self) -> Rate:
        """Poses answered in time in all repeats, of the poses."""
        return pose_successes(self.poses, [s.in_time for s in self.scores])

    @property
    def seconds(self) -> tuple[float, ...]:
        """The time of each detection."""
        return tuple(s.seconds for s in self.scores)

    @property
    def errors_mm(self) -> Floats:
        """found - truth of every matched teat, (n, 3), world axes."""
        return np.concatenate([s.errors_mm for s in self.scores]) if self.scores else np.zeros((0, 3))

    @property
    def error_poses(self) -> tuple[Hashable, ...]:
        """The pose of each row of `errors_mm`."""
        return tuple(p for p, s in zip(self.poses, self.scores, strict=True) for _ in range(len(s.errors_mm)))

    def errors_of_teat(self, teat: int) -> Floats:
        """The errors (n, 3) of one teat, by its index in the truth."""
        rows = [s.errors_mm[k] for s in self.scores for k, (_, j) in enumerate(s.match.pairs) if j == teat]
        return np.array(rows, dtype=np.float64).reshape(-1, 3)

    def summary(self, camera_from_world: Floats | None = None) -> ErrorSummary:
        """All matched teats; with a rotation (3, 3), along the camera's axes."""
        return summarise(self.errors_mm, camera_from_world)


def pool(scores: Sequence[SceneScore], poses: Sequence[Hashable] | None = None) -> Pool:
    """Scenes to a pool; without names each scene is a pose of its own (its name then is a new number, so don't add such pools)."""
    return Pool(tuple(scores), tuple(range(len(scores))) if poses is None else tuple(poses))
