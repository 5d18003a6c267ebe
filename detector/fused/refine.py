"""From starts to fitted teats: first roughly and for many, then finely for those that are left, each place only once.

Strategy: the rough pass looks far, for plain steps, at few points; what then has hardly an edge where its outline is, or is where a better one is,
goes. The fine pass looks close, with the full model of an edge. The module may not know temperatures.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from detector.fused.edges import Profile
from detector.fused.fit import Seen, View, look, step, weights
from detector.fused.model import Outline, apexes
from detector.fused.parameters import Parameters
from detector.fused.sweep import Starts
from detector.geometry import Array

ROUGH_OUTLINE, FINE_OUTLINE = Outline.of(55.0, 10, 14), Outline.of(60.0, 30, 30)
_ROUGH = Profile(7.0, 1.0, 5.0, 0.5, 1.2, limb=False)
_FINE = Profile(5.0, 0.5, 2.0, 0.25, 0.8, limb=True)
_LEAST_GAIN = 0.3
_ROUGH_STEPS, _FINE_STEPS = 4, 4
_ROUGH_SCALE_PX, _FINE_SCALE_PX = 1.0, 0.15  # beyond which an edge counts for less
_LEAST_SHARE, _NEAR_PX = 0.35, 1.5  # of the rough outline, near an edge
_SAME_MM = np.array([2.5, 2.5, 8.0])  # two rough fits nearer than this are one; depth is the least sure


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """Teats (m, 8) in the right camera's frame, the edges about them, and the weights (m, k) of these."""

    teats: Array
    seen: Seen
    weight: Array


def refine(starts: Starts, views: tuple[View, ...], p: Parameters) -> Fitted:
    """The teats that the starts lead to, none in the same place as a better one."""
    order = np.argsort(-starts.score, kind="stable")[: p.most_starts]
    teats = _rough(starts.teats[order], views, p)
    seen = look(teats, views, FINE_OUTLINE, _FINE, 1.5)
    for _ in range(_FINE_STEPS):
        teats = step(teats, seen, weights(seen, _FINE_SCALE_PX, _LEAST_GAIN), p.prior)
        seen = look(teats, views, FINE_OUTLINE, _FINE, 1.5, seen.jacobian)
    return Fitted(teats, seen, weights(seen, _FINE_SCALE_PX, _LEAST_GAIN))


def _rough(teats: Array, views: tuple[View, ...], p: Parameters) -> Array:
    seen = look(teats, views, ROUGH_OUTLINE, _ROUGH, 4.0)
    for _ in range(_ROUGH_STEPS):
        teats = step(teats, seen, weights(seen, _ROUGH_SCALE_PX, _LEAST_GAIN), p.prior)
        seen = look(teats, views, ROUGH_OUTLINE, _ROUGH, 4.0, seen.jacobian)
    near = (weights(seen, _ROUGH_SCALE_PX, _LEAST_GAIN) > 0) & (np.abs(np.nan_to_num(seen.offset_px, nan=9.0)) < _NEAR_PX)
    share, ends = near.mean(axis=1), apexes(teats)
    kept: list[int] = []
    for i in np.argsort(-share, kind="stable"):
        if share[i] > _LEAST_SHARE and len(kept) < p.most_fits and all(np.abs((ends[i] - ends[k]) / _SAME_MM).max() > 1 for k in kept):
            kept.append(int(i))
    return teats[kept]
