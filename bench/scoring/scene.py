"""The score of one trial, and of many as one: what was found, how far off, whether the scene
succeeded.

A scene succeeds when every visible teat was found within the limit, nothing false was found, and
the answer came in time. The hidden count is scored beside it. `doubtful` names the teats whose
error lies in the guard band, where the truth's uncertainty could turn it: a decision on a rate
takes neither such successes nor such failures as shown.

Scenes merge by adding counts, never by averaging averages. Frames of one pose are repeats: a pose
succeeds when all of them do, and every rate with an interval counts poses.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from operator import attrgetter
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.scoring.errors import ErrorSummary, Floats, as_points, summarise
from bench.scoring.guard_band import (
    acceptance_limit_mm,
    farthest_mm,
    leak,
    refusal_limit_mm,
)
from bench.scoring.looks import FIRST, Looks, RateTest, allowed_leak
from bench.scoring.matching import Counts, Match, as_flags, assign, counted, gate_mm
from bench.scoring.rates import Rate, leak_allowed, pose_successes
from bench.scoring.sample_size import failures_allowed


@dataclass(frozen=True, slots=True, eq=False)
class SceneScore:
    """The score of one scene; `errors_mm` (k, 3) are found - truth of `match.pairs`."""

    match: Match
    errors_mm: Floats
    seconds: float
    in_time: bool
    limit_mm: float
    u_mm: float
    success: bool
    doubtful: tuple[int, ...]
    hidden_claimed: int | None

    @property
    def counts(self) -> Counts:
        """Counts that add over scenes."""
        return self.match.counts

    @property
    def gospa_mm(self) -> float:
        """GOSPA of the scene, c = the gate."""
        return self.match.gospa_mm

    @property
    def radial_mm(self) -> tuple[float, ...]:
        """Distance of each matched teat, in the order of `match.pairs`."""
        return self.match.distances_mm

    @property
    def accurate(self) -> bool:
        """All visible teats within the limit and nothing false, whenever the answer came."""
        right = not self.match.missed and not self.match.false
        return right and max(self.radial_mm, default=0.0) <= self.limit_mm

    @property
    def surely_succeeded(self) -> bool:
        """A success that the truth's uncertainty can't turn."""
        return self.success and not self.doubtful

    @property
    def surely_failed(self) -> bool:
        """A failure that not only errors in the guard band made."""
        if self.success:
            return False
        off = [d for d in self.radial_mm if d > self.limit_mm]
        near = self.in_time and not self.match.missed and not self.match.false and bool(off)
        return not near or max(off) >= refusal_limit_mm(self.limit_mm, self.u_mm)

    @property
    def hidden_right(self) -> bool | None:
        """Whether the count of hidden teats was right; None where the detector made no claim."""
        return None if self.hidden_claimed is None else self.hidden_claimed == self.match.hidden

    def as_dict(self) -> dict[str, Any]:
        """Everything as JSON takes it; `scene_from_dict` reads it back."""
        m = self.match
        return {
            "pairs": [list(pair) for pair in m.pairs],
            "radial_mm": list(m.distances_mm),
            "errors_mm": self.errors_mm.tolist(),
            "hidden_pairs": [list(pair) for pair in m.hidden_pairs],
            "missed": list(m.missed),
            "false": list(m.false),
            "hidden": m.hidden,
            "gate_mm": m.gate_mm,
            "gospa_mm": m.gospa_mm,
            **{name: getattr(self, name) for name in _PLAIN},
            "doubtful": list(self.doubtful),
            "hidden_claimed": self.hidden_claimed,
            "hidden_right": self.hidden_right,
        }


_PLAIN = ("seconds", "in_time", "limit_mm", "u_mm", "success")


def score_scene(
    found_mm: npt.ArrayLike,
    truth_mm: npt.ArrayLike,
    visible: npt.ArrayLike,
    *,
    u_mm: float,
    seconds: float,
    limit_mm: float,
    time_limit_s: float,
    hidden_claimed: int | None = None,
) -> SceneScore:
    """Score findings (n, 3) against teats (m, 3) with flags (m,), world mm; u_mm is the truth's
    along an axis. Raises ValueError on impossible input.
    """
    found, truth = as_points(found_mm, "found"), as_points(truth_mm, "truth")
    if not 0.0 <= seconds < inf:
        raise ValueError(
            f"seconds: {seconds} must be finite and not negative; a detection that timed out took"
            " its time limit or more"
        )
    if hidden_claimed is not None and hidden_claimed < 0:
        raise ValueError(
            f"hidden_claimed: {hidden_claimed} teats; None says that the detector makes no claim"
        )
    answers, ends = found.tolist(), truth.tolist()
    result = assign(answers, ends, as_flags(visible, len(ends)), gate_mm(ends))
    rows = []
    for i, j in result.pairs:
        x, y, z = answers[i]
        a, b, c = ends[j]
        rows.append((x - a, y - b, z - c))
    errors = np.array(rows) if rows else np.zeros((0, 3))
    errors.setflags(write=False)
    in_time, largest = seconds <= time_limit_s, max(result.distances_mm, default=0.0)
    success = in_time and largest <= limit_mm and not result.missed and not result.false
    accept = acceptance_limit_mm(limit_mm, u_mm)
    sure = -1.0 if accept is None else accept
    doubtful: tuple[int, ...] = ()
    if largest > sure:
        refuse = refusal_limit_mm(limit_mm, u_mm)
        near = zip(result.pairs, result.distances_mm, strict=True)
        doubtful = tuple(j for (_, j), d in near if sure < d < refuse)
    limit, u, right = float(limit_mm), float(u_mm), bool(success)
    return SceneScore(
        result, errors, float(seconds), bool(in_time), limit, u, right, doubtful, hidden_claimed
    )


def scene_from_dict(stored: Mapping[str, Any]) -> SceneScore:
    """A score from what `as_dict` gave, exactly. Raises ValueError that names the missing key."""
    try:
        result = Match(
            pairs=tuple((int(i), int(j)) for i, j in stored["pairs"]),
            distances_mm=tuple(float(d) for d in stored["radial_mm"]),
            hidden_pairs=tuple((int(i), int(j)) for i, j in stored["hidden_pairs"]),
            missed=tuple(int(j) for j in stored["missed"]),
            false=tuple(int(i) for i in stored["false"]),
            hidden=int(stored["hidden"]),
            gate_mm=float(stored["gate_mm"]),
        )
        claimed, errors = stored["hidden_claimed"], as_points(stored["errors_mm"], "errors_mm")
        errors.setflags(write=False)
        return SceneScore(
            match=result,
            errors_mm=errors,
            seconds=float(stored["seconds"]),
            in_time=bool(stored["in_time"]),
            limit_mm=float(stored["limit_mm"]),
            u_mm=float(stored["u_mm"]),
            success=bool(stored["success"]),
            doubtful=tuple(int(j) for j in stored["doubtful"]),
            hidden_claimed=None if claimed is None else int(claimed),
        )
    except KeyError as missing:
        raise ValueError(
            f"stored score: key {missing} is missing; the run was stored by another version, score"
            " it again"
        ) from missing


@dataclass(frozen=True, slots=True)
class Pool:
    """Scenes, and the pose of each; ``silent``: which of them have no answer. One without is no
    success. Where none has one nothing was measured: all counts and rates are of nothing.
    """

    scores: tuple[SceneScore, ...] = ()
    poses: tuple[Hashable, ...] = ()
    silent: frozenset[int] = frozenset()

    @property
    def answered(self) -> int:
        """Scenes with an answer."""
        return len(self.scores) - len(self.silent)

    @property
    def counts(self) -> Counts:
        """All teats and findings counted."""
        return counted(s.match for s in self._measured)

    @property
    def frames(self) -> Rate:
        """Scenes that succeeded, of the scenes; for an interval use `success`."""
        return Rate(sum(s.success for s in self._measured), len(self._measured))

    @property
    def _measured(self) -> tuple[SceneScore, ...]:
        return self.scores if self.answered else ()

    @property
    def success(self) -> Rate:
        """Poses that succeeded in all repeats, of the poses."""
        return self._poses_where(attrgetter("success"))

    @property
    def accurate(self) -> Rate:
        """Poses that succeeded in all repeats but for the time, of the poses."""
        return self._poses_where(attrgetter("accurate"))

    def _poses_where(self, holds: Callable[[SceneScore], bool | None]) -> Rate:
        """Poses that hold in all repeats, of the poses; scenes with None are left out."""
        held = [holds(score) for score in self._measured]
        known = [of for of in held if of is not None]
        return pose_successes(
            [pose for pose, of in zip(self.poses, held, strict=False) if of is not None], known
        )

    @property
    def uncertain(self) -> bool:
        """Whether the truth of any scene is."""
        return any(s.u_mm > 0.0 for s in self.scores)

    def surely_succeeded(self, rate: float, confidence: float, looks: Looks = FIRST) -> Rate:
        """Poses whose success the truth's uncertainty can't turn, of the poses: sure up to the
        distance at which so many poses claim `rate` falsely in no more than 1 - `confidence`; at a
        further look, to that at which few enough bad poses are seen as good.
        """
        if looks.again:
            most: float | None = allowed_leak(RateTest(rate, confidence, looks))
        else:
            poses, sure_of = len(set(self.poses)), looks.first_confidence(confidence)
            failures = failures_allowed(poses, rate, sure_of)
            most = None if failures is None else leak_allowed(failures, poses, rate, sure_of)

        reach: dict[tuple[float, float], float | None] = {}
        if most is not None:
            for score in self.scores:
                if score.radial_mm and score.surely_succeeded:
                    limits = score.limit_mm, score.u_mm
                    reach[limits] = max(reach.get(limits) or 0.0, *score.radial_mm)
            for limits, seen_mm in reach.items():
                if leak(seen_mm or 0.0, *limits) > most:  # else none is beyond it
                    reach[limits] = farthest_mm(*limits, most)

        def sure(score: SceneScore) -> bool:
            within_mm = reach.get((score.limit_mm, score.u_mm), score.limit_mm)
            if not score.surely_succeeded:
                return False
            return not score.radial_mm or (
                within_mm is not None and max(score.radial_mm) <= within_mm
            )

        return self._poses_where(sure)

    @property
    def perhaps_succeeded(self) -> Rate:
        """Poses that succeeded, or whose failures the truth's uncertainty could turn."""
        return self._poses_where(lambda score: not score.surely_failed)

    @property
    def worst_false(self) -> tuple[int, ...]:
        """The false findings of each pose's worst repeat, of those with an answer."""
        worst: dict[Hashable, int] = {}
        for at, (pose, score) in enumerate(zip(self.poses, self.scores, strict=True)):
            if at not in self.silent:
                worst[pose] = max(worst.get(pose, 0), len(score.match.false))
        return tuple(worst.values())

    @property
    def none_false(self) -> Rate:
        """Poses without a false finding, of those with an answer."""
        worst = self.worst_false
        return Rate(worst.count(0), len(worst))

    @property
    def all_found(self) -> Rate:
        """Poses of which every visible end was found in all repeats, of the poses."""
        return self._poses_where(lambda score: not score.match.missed)

    @property
    def hidden_right(self) -> Rate:
        """Poses whose hidden teats were counted right, of those where the detector made a claim."""
        return self._poses_where(attrgetter("hidden_right"))

    @property
    def in_time(self) -> Rate:
        """Poses answered in time in all repeats, of the poses."""
        return self._poses_where(attrgetter("in_time"))

    @property
    def errors_mm(self) -> Floats:
        """found - truth of every matched teat, (n, 3), world axes."""
        return np.concatenate([np.zeros((0, 3)), *(s.errors_mm for s in self.scores)])

    @property
    def error_poses(self) -> tuple[Hashable, ...]:
        """The pose of each row of `errors_mm`."""
        return tuple(
            p for p, s in zip(self.poses, self.scores, strict=True) for _ in range(len(s.errors_mm))
        )

    def summary(self, camera_from_world: Floats | None = None) -> ErrorSummary:
        """All matched teats; with a rotation (3, 3), along the camera's axes."""
        return summarise(self.errors_mm, camera_from_world)


def pool(
    scores: Sequence[SceneScore],
    poses: Sequence[Hashable] | None = None,
    answered: Sequence[bool] | None = None,
) -> Pool:
    """Scores to a pool; without names each scene is a pose of its own (don't add such pools).
    ``answered``: whether each has an answer; by default all have.
    """
    silent = frozenset(at for at, one in enumerate(answered or ()) if not one)
    names = tuple(range(len(scores))) if poses is None else tuple(poses)
    return Pool(tuple(scores), names, silent)
