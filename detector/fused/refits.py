"""Which fits are tried again: those that may bridge two teats, those whose ends may be too high or
low, short teats of another shape, and those of an unsure place.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from detector.fused.decide import Decision, pass_through
from detector.fused.evidence import WHOLE_END, Evidence
from detector.fused.parameters import Parameters
from detector.fused.refine import on_one_bar
from detector.geometry import Array

_WHOLE_END, _WHOLE_END_BOTH, _LEAST_SIDE = 0.7, 0.85, 0.5
_SHAPED_END, _WHOLE_SIDE, _CLOSE_FIT_PX = 0.4, 0.97, 0.05
_UNSURE_MM = 0.3  # of an end's sd


def doubts(
    teats: Array, evidence: Evidence, decision: Decision, p: Parameters
) -> tuple[list[int], list[int]]:
    """Of teats (m, 8), those that may bridge two, and those that may be too high or low; a few
    each. Both have their sides, but not all of their end. A teat with both sides hardly bridges
    two.
    """
    end, both = evidence.end[:, :2], evidence.both[:, :2].min(axis=1) > _LEAST_SIDE
    partial = end.min(axis=1) < np.where(both, _WHOLE_END_BOTH, _WHOLE_END)
    partial &= evidence.side[:, :2].min(axis=1) > _LEAST_SIDE
    same = on_one_bar(teats)
    whole = [i for i in decision.accepted if not partial[i]]
    order = np.argsort(-decision.odds, kind="stable").tolist()
    open_ = [i for i in order if partial[i] and not same[i, whole].any()]
    half = end.max(axis=1) > 0.5 * _WHOLE_END
    bridging = _one_each([i for i in open_ if half[i] and not both[i]], same)
    shifted = _one_each([i for i in open_ if both[i]], same)
    return bridging[: p.most_bridging], shifted[: p.most_shifted]


def _one_each(rows: list[int], same: NDArray[np.bool_]) -> list[int]:
    """The first of ``rows`` in each place."""
    return [i for n, i in enumerate(rows) if not same[i, rows[:n]].any()]


def whole_ends(teats: Array, evidence: Evidence, decision: Decision) -> list[int]:
    """Of teats (m, 8), those that are accepted or show a whole end in both optical pictures."""
    whole = evidence.end[:, :2].min(axis=1) > WHOLE_END
    order = np.argsort(-decision.odds, kind="stable").tolist()
    open_ = [i for i in order if whole[i] and decision.reasons[i]]
    return _one_each([*decision.accepted, *open_], on_one_bar(teats))


def shapes(teats: Array, evidence: Evidence, decision: Decision, p: Parameters) -> list[int]:
    """Of teats (m, 8), those that show an end in all pictures but don't fit: one a place."""
    unlike = evidence.misfit_px > _CLOSE_FIT_PX
    unlike[[i for i, reason in enumerate(decision.reasons) if reason]] = True
    unlike &= evidence.side.max(axis=1) < _WHOLE_SIDE
    tried = unlike & (evidence.end.min(axis=1) > _SHAPED_END)
    same, kept = on_one_bar(teats), list[int]()
    sound = [i for i in decision.accepted if not unlike[i]]
    inside = np.asarray(pass_through(teats, teats[sound]).any(axis=1))
    for i in np.argsort(-decision.odds, kind="stable").tolist():
        if tried[i] and not same[i, kept + sound].any() and not inside[i]:
            kept.append(i)
    return kept[: p.most_shapes]


def unsure(teats: Array, evidence: Evidence, decision: Decision, p: Parameters) -> list[int]:
    """Of teats (m, 8), those of an unsure place: the accepted ones, and a few that only this speaks
    against, one a place, the likeliest first.
    """
    accepted = decision.accepted
    inside = np.asarray(pass_through(teats, teats[accepted]).any(axis=1))
    order = np.argsort(-decision.odds, kind="stable").tolist()
    open_ = [i for i in order if decision.by_place[i] and not inside[i]]
    more = _one_each(open_, on_one_bar(teats))[: p.most_unsure]
    return [i for i in accepted if evidence.sd_mm[i] > _UNSURE_MM] + more
