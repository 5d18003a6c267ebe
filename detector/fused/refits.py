"""Which fits are tried again: those that may bridge two teats, those whose ends may be too high or
low, short teats of another shape, and those of an unsure place; by limits that are learned.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from detector.fused.decide import Decision, pass_through
from detector.fused.evidence import WHOLE_END, Evidence
from detector.fused.parameters import Parameters
from detector.fused.refine import on_one_bar
from detector.geometry import Array

Limits = Mapping[str, float]  # `Learned.limits`


def doubts(
    teats: Array, evidence: Evidence, decision: Decision, limits: Limits, p: Parameters
) -> tuple[list[int], list[int]]:
    """Of teats (m, 8), those that may bridge two, and those that may be too high or low; a few
    each. Both have their sides, but not all of their end. A teat with both sides hardly bridges
    two.
    """
    end, least, whole_end = evidence.end[:, :2], limits["side"], limits["end, one side"]
    both = evidence.both[:, :2].min(axis=1) > least
    partial = end.min(axis=1) < np.where(both, limits["end, both sides"], whole_end)
    partial &= evidence.side[:, :2].min(axis=1) > least
    same = on_one_bar(teats)
    whole = [i for i in decision.accepted if not partial[i]]
    open_ = [i for i in _likeliest(decision) if partial[i] and not same[i, whole].any()]
    half = end.max(axis=1) > 0.5 * whole_end
    bridging = _one_each([i for i in open_ if half[i] and not both[i]], same)
    shifted = _one_each([i for i in open_ if both[i]], same)
    return bridging[: p.most_bridging], shifted[: p.most_shifted]


def _likeliest(decision: Decision) -> list[int]:
    """All fits, the likeliest first."""
    order: list[int] = np.argsort(-decision.odds, kind="stable").tolist()
    return order


def _one_each(rows: list[int], same: NDArray[np.bool_]) -> list[int]:
    """The first of ``rows`` in each place."""
    return [i for n, i in enumerate(rows) if not same[i, rows[:n]].any()]


def whole_ends(teats: Array, evidence: Evidence, decision: Decision) -> list[int]:
    """Of teats (m, 8), those that are accepted or show a whole end in both optical pictures."""
    whole = evidence.end[:, :2].min(axis=1) > WHOLE_END
    open_ = [i for i in _likeliest(decision) if whole[i] and decision.reasons[i]]
    return _one_each([*decision.accepted, *open_], on_one_bar(teats))


def shapes(
    teats: Array, evidence: Evidence, decision: Decision, limits: Limits, p: Parameters
) -> list[int]:
    """Of teats (m, 8), those that show an end in all pictures but don't fit: one a place."""
    unlike = evidence.misfit_px > limits["misfit, px"]
    unlike[[i for i, reason in enumerate(decision.reasons) if reason]] = True
    unlike &= evidence.side.max(axis=1) < limits["longest side"]
    tried = unlike & (evidence.end.min(axis=1) > limits["end, another shape"])
    same, kept = on_one_bar(teats), list[int]()
    sound = [i for i in decision.accepted if not unlike[i]]
    inside = np.asarray(pass_through(teats, teats[sound]).any(axis=1))
    for i in _likeliest(decision):
        if tried[i] and not same[i, kept + sound].any() and not inside[i]:
            kept.append(i)
    return kept[: p.most_shapes]


def unsure(
    teats: Array, evidence: Evidence, decision: Decision, limits: Limits, p: Parameters
) -> list[int]:
    """Of teats (m, 8), those of an unsure place: the accepted ones, and a few that only this speaks
    against, one a place, the likeliest first.
    """
    accepted = decision.accepted
    inside = np.asarray(pass_through(teats, teats[accepted]).any(axis=1))
    open_ = [i for i in _likeliest(decision) if decision.by_place[i] and not inside[i]]
    more = _one_each(open_, on_one_bar(teats))[: p.most_unsure]
    return [i for i in accepted if evidence.sd_mm[i] > limits["sd, mm"]] + more
