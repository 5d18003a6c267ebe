"""Many scenes as one: counts and errors side by side, so that situations, detectors and runs merge
by adding, never by averaging averages.

A pose is named by the caller; frames of one pose are repeats, and every rate that gets an interval
counts poses (a pose succeeds when all its repeats do).
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np

from bench.scoring.errors import ErrorSummary, Floats, summarise
from bench.scoring.matching import Counts, added
from bench.scoring.rates import Rate, pose_successes
from bench.scoring.sample_size import failures_allowed, shown_error_mm
from bench.scoring.scene import SceneScore


@dataclass(frozen=True, slots=True)
class Pool:
    """Scenes with the name of the pose that each belongs to, in order. Adding two pools puts one
    behind the other.
    """

    scores: tuple[SceneScore, ...] = ()
    poses: tuple[Hashable, ...] = ()

    def __post_init__(self) -> None:
        if len(self.scores) != len(self.poses):
            raise ValueError(
                f"pool: {len(self.scores)} scores with {len(self.poses)} pose names; name the pose"
                " of each score"
            )

    def __add__(self, other: Pool) -> Pool:
        return Pool(self.scores + other.scores, self.poses + other.poses)

    @property
    def counts(self) -> Counts:
        """All teats and findings counted."""
        return added(s.counts for s in self.scores)

    @property
    def frames(self) -> Rate:
        """Scenes that succeeded, of the scenes. Repeats are not independent: for an interval use
        `success`.
        """
        return Rate(sum(s.success for s in self.scores), len(self.scores))

    @property
    def success(self) -> Rate:
        """Poses that succeeded in all repeats, of the poses."""
        return pose_successes(self.poses, [s.success for s in self.scores])

    def surely_succeeded(self, rate: float, confidence: float) -> Rate:
        """Poses whose success the truth's uncertainty can't turn in any repeat, of the poses, where
        `rate` is to be shown.

        Up to which distance a success is sure follows from the number of poses alone
        (`power.shown_error_mm`, for as many failures as they may have), so that the claim is false
        in no more than 1 - `confidence` whatever the truth's errors; with poses too few for the
        claim, and for enough of them, up to the acceptance limit.
        """
        poses = len(set(self.poses))
        failures = failures_allowed(poses, rate, confidence)
        reach: dict[tuple[float, float], float | None] = {}
        if failures is not None:
            for limit_mm, u_mm in {(s.limit_mm, s.u_mm) for s in self.scores}:
                most = shown_error_mm(poses, rate, limit_mm, u_mm, confidence, failures)
                reach[limit_mm, u_mm] = most

        def sure(score: SceneScore) -> bool:
            most = reach.get((score.limit_mm, score.u_mm), score.limit_mm)
            return score.surely_succeeded and (
                not score.radial_mm or (most is not None and max(score.radial_mm) <= most)
            )

        return pose_successes(self.poses, [sure(s) for s in self.scores])

    @property
    def perhaps_succeeded(self) -> Rate:
        """Poses that succeeded, or whose failures the truth's uncertainty could turn."""
        return pose_successes(self.poses, [not s.surely_failed for s in self.scores])

    @property
    def worst_false(self) -> tuple[int, ...]:
        """The false findings of each pose's worst repeat."""
        worst: dict[Hashable, int] = {}
        for pose, score in zip(self.poses, self.scores, strict=True):
            worst[pose] = max(worst.get(pose, 0), len(score.match.false))
        return tuple(worst.values())

    @property
    def hidden_right(self) -> Rate:
        """Poses whose hidden teats were counted right in all repeats, of the poses where the
        detector made a claim.
        """
        claims = [
            (p, s.hidden_right)
            for p, s in zip(self.poses, self.scores, strict=True)
            if s.hidden_right is not None
        ]
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
        return (
            np.concatenate([s.errors_mm for s in self.scores]) if self.scores else np.zeros((0, 3))
        )

    @property
    def error_poses(self) -> tuple[Hashable, ...]:
        """The pose of each row of `errors_mm`."""
        return tuple(
            p for p, s in zip(self.poses, self.scores, strict=True) for _ in range(len(s.errors_mm))
        )

    def summary(self, camera_from_world: Floats | None = None) -> ErrorSummary:
        """All matched teats; with a rotation (3, 3), along the camera's axes."""
        return summarise(self.errors_mm, camera_from_world)


def pool(scores: Sequence[SceneScore], poses: Sequence[Hashable] | None = None) -> Pool:
    """Scenes to a pool; without names each scene is a pose of its own (its name then is a new
    number, so don't add such pools).
    """
    return Pool(tuple(scores), tuple(range(len(scores))) if poses is None else tuple(poses))
