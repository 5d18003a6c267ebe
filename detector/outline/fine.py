"""The fine pass: teats near the right places are fitted closely, with the full model of edges, and
only to sides that both pictures show.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detector import outline as package
from detector.geometry import Array
from detector.outline.fit import CameraView, OutlineEdges, look, step, weights
from detector.outline.model import Outline, Rows
from detector.outline.prior import Prior

ROUGH_OUTLINE, FINE_OUTLINE = Outline.of(55.0, 8, 12), Outline.of(Prior().length_mm, 28, 24)
FINE_STEPS = 4
# floors beyond which an edge counts for less
ROUGH_SCALE, _FINE_SCALE = 20.0, 3.0
_LEAST_SIDE = 0.4  # share of a side's edges that are `_CLOSE`, or the side isn't seen
_CLOSE = 12.0  # in floors
# a side is no teat's where at least the first share is seen in one picture, and at most the second
# in the other
_LEAST_ALONE, _MOST_OTHER = 0.7, 0.15
_LIMITS = np.array([_CLOSE, _LEAST_SIDE, _LEAST_ALONE, _MOST_OTHER])
_STILL_PX = 0.02  # an outline that moves by less needs no new look


@dataclass(frozen=True, slots=True, eq=False)
class Fitted(Rows):
    """Teats (m, 8), right camera's frame, the edges about them, and weights (m, k)."""

    teats: Array
    seen: OutlineEdges
    weight: Array
    hidden: NDArray[np.bool_]  # (m, k): behind another teat, or left out
    followed: NDArray[np.bool_]  # (m,): up both sides to where the last of an end is seen
    shaped: NDArray[np.bool_]  # (m,): not of the usual shape: of any taper and height of its end


def fine(
    teats: Array,
    hidden: NDArray[np.bool_] | None,
    views: tuple[CameraView, ...],
    prior: Prior,
    seen: OutlineEdges | None = None,
    steps: int = FINE_STEPS,
    first: int = 0,
) -> Fitted:
    """Teats (m, 8) after ``steps`` fine steps, ``first`` of them done; ``seen``: if known, which
    follows them; what is ``hidden`` (m, k): if anything.
    """
    if hidden is None:
        hidden = np.zeros((len(teats), len(views) * len(FINE_OUTLINE.part)), dtype=bool)
    seen = look(teats, views, FINE_OUTLINE, fine=True) if seen is None else seen
    for number in range(first, first + steps):
        teats = stepped(teats, seen, trusted(seen, hidden, number), prior, views, fine=True)
    weight = trusted(seen, hidden, first + steps)
    no = np.zeros(len(teats), dtype=bool)
    return Fitted(teats, seen, weight, hidden, no, no)


def stepped(
    teats: Array,
    seen: OutlineEdges,
    weight: Array,
    prior: Prior,
    views: tuple[CameraView, ...],
    *,
    fine: bool,
) -> Array:
    """Teats (m, 8) after one step; what is ``seen`` of them follows: optical edges are found anew
    where outlines moved.
    """
    moved, outline = step(teats, seen, weight, prior), FINE_OUTLINE if fine else ROUGH_OUTLINE
    moves = (seen.jacobian @ (moved - teats)[..., None])[..., 0]
    np.subtract(seen.offset_px, moves, out=seen.offset_px)
    still = (np.abs(moves[:, : 2 * len(outline.part)]) < _STILL_PX).all(axis=1)
    if not still.all():
        look(moved, views[:2], outline, fine=fine, known=seen, which=np.flatnonzero(~still))
    return moved


def trusted(seen: OutlineEdges, hidden: NDArray[np.bool_], number: int) -> Array:
    """Weights (m, k) in the fine pass; after its first step only sides that both pictures show,
    where nothing of them is ``hidden``. What only one shows is likely another thing's outline.
    """
    weight = np.where(hidden, 0.0, weights(seen, _FINE_SCALE))
    if number == 0:
        return weight
    counts = len(FINE_OUTLINE.along_mm), len(FINE_OUTLINE.over_end)
    package.kernels.trusted(weight, seen.offset_px, seen.floor_px, hidden, *counts, _LIMITS)
    return weight
