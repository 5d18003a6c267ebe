"""The score of one trial: what was found, how far off, and whether the scene as a whole succeeded.

A scene succeeds when every visible teat was found within the limit, nothing false was found, and
the answer came in time. The hidden count is scored beside it. Success is counted on the seen error
as it stands; `doubtful` names the teats whose error lies in the guard band, where the truth's
uncertainty could turn it, and a decision on a rate takes neither such successes nor such failures
as shown.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite
from operator import sub
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.scoring.errors import Floats, as_points
from bench.scoring.guard_band import acceptance_limit_mm, refusal_limit_mm
from bench.scoring.matching import Counts, Match, as_flags, assign, gate_between


@dataclass(frozen=True, slots=True, eq=False)
class SceneScore:
    """`errors_mm` (k, 3) are found - truth in world axes, one row a pair of `match.pairs` (visible
    teats only); compare scores by `as_dict()`.
    """

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
    def surely_succeeded(self) -> bool:
        """A success that the truth's uncertainty can't turn: no error in the guard band."""
        return self.success and not self.doubtful

    @property
    def surely_failed(self) -> bool:
        """A failure that the truth's uncertainty can't turn: something else than errors in the
        guard band made it one.
        """
        if self.success:
            return False
        off = [d for d in self.radial_mm if d > self.limit_mm]
        near = self.in_time and not self.match.missed and not self.match.false and bool(off)
        return not near or max(off) >= refusal_limit_mm(self.limit_mm, self.u_mm)

    @property
    def hidden_right(self) -> bool | None:
        """Whether the detector's count of hidden teats was right; None where it made no claim."""
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
    standard uncertainty along an axis.

    A detection that failed or timed out is scored as no findings, with the time it took. Raises
    ValueError on impossible input.
    """
    found, truth = as_points(found_mm, "found"), as_points(truth_mm, "truth")
    if not (isfinite(seconds) and seconds >= 0.0):
        raise ValueError(
            f"seconds: {seconds} must be finite and not negative; a detection that timed out took"
            " its time limit or more"
        )
    if hidden_claimed is not None and hidden_claimed < 0:
        raise ValueError(
            f"hidden_claimed: {hidden_claimed} teats; None says that the detector makes no claim"
        )
    answers, ends = found.tolist(), truth.tolist()
    result = assign(answers, ends, as_flags(visible, len(ends)), gate_between(ends))
    errors = np.array([list(map(sub, answers[i], ends[j])) for i, j in result.pairs])
    in_time, largest = seconds <= time_limit_s, max(result.distances_mm, default=0.0)
    accept, refuse = acceptance_limit_mm(limit_mm, u_mm), refusal_limit_mm(limit_mm, u_mm)
    sure = -1.0 if accept is None else accept
    near = zip(result.pairs, result.distances_mm, strict=True) if largest > sure else ()
    return SceneScore(
        match=result,
        errors_mm=_frozen(errors),
        seconds=float(seconds),
        in_time=bool(in_time),
        limit_mm=float(limit_mm),
        u_mm=float(u_mm),
        success=bool(in_time and largest <= limit_mm and not result.missed and not result.false),
        doubtful=tuple([j for (_, j), d in near if sure < d < refuse]),
        hidden_claimed=hidden_claimed,
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
        claimed = stored["hidden_claimed"]
        return SceneScore(
            match=result,
            errors_mm=_frozen(as_points(stored["errors_mm"], "errors_mm")),
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


def _frozen(errors: Floats) -> Floats:
    errors = errors.reshape(-1, 3)
    errors.setflags(write=False)
    return errors
