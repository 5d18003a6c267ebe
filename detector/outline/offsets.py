"""How far the cameras' edges lie off each other about fitted teats: right rows against left, and
the thermal outlines against what the stereo fit predicts.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from detector.geometry import Array
from detector.outline.edges import CLEAR
from detector.outline.fine import FINE_OUTLINE, Fitted
from detector.outline.fit import OutlineEdges, View, information, look, usual
from detector.outline.model import END
from detector.outline.prior import Prior

_EDGE_PX, _ROBUST_PX = 0.2, 0.3  # of thermal edges: sd beyond noise; farther off counts for less
_SHIFT_SD, _SWELL_SD = 0.5, 0.5  # px, before a teat is looked at: no end, no rows
THERMAL_REACH_PX = 10.0  # sensor px
_THERMAL_SHIFTS = sorted(product((0.0, -4.0, 4.0, -8.0, 8.0), repeat=2), key=np.linalg.norm)
LEAST_SEEN = 0.6  # share of an outline's edges that are close
LEAST_END = 0.5  # the same of its end: wrong fits have 0.46 at most
_CLOSE_PX, STAYS_PX, _AGAIN = 0.5, 0.3, 5
_LEAST_INFORMATION = 15.0  # of an outline: sd 0.26 px; one far off counts for less anyway


def row_offsets(fitted: Fitted, prior: Prior) -> tuple[Array, Array]:
    """Rows px (m,) by which the right picture's edges are off, each teat free; their weights."""
    n = len(FINE_OUTLINE.part)
    seen, weight = fitted.seen, fitted.weight
    H = information(seen, weight, usual(prior)[1])
    used = weight > 0
    j = np.where(used[..., None], seen.jacobian, 0.0) * weight[..., None]
    r = np.where(used, seen.offset_px, 0.0)
    down = np.zeros_like(r)
    down[:, n : 2 * n] = seen.normals[:, n : 2 * n, 1]
    down = np.where(used, down, 0.0)
    b, a = (np.einsum("mki,mk->mi", j, x) for x in (down, r))
    explained = np.linalg.solve(H, b[..., None])[..., 0]
    weight_of_rows = (weight * down**2).sum(axis=1) - (b * explained).sum(axis=1)
    score = (weight * down * r).sum(axis=1) - (a * explained).sum(axis=1)
    return score / np.maximum(weight_of_rows, 1e-9), weight_of_rows


def thermal_offsets(seen: OutlineEdges, hidden: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Shifts (m, 2) sensor px of the last view's outlines, each free to swell; weights (m, 2)."""
    at = slice(-len(FINE_OUTLINE.part), None)
    off = seen.offset_px[:, at]
    clear = np.isfinite(off) & (seen.clarity[:, at] > CLEAR) & ~hidden[:, at]
    weight = np.where(clear, 1.0 / (seen.sd_px[:, at] ** 2 + _EDGE_PX**2), 0.0)
    off = np.where(clear, off, 0.0)
    moves = np.concatenate([np.nan_to_num(seen.normals[:, at]), np.ones((*off.shape, 1))], axis=2)
    least = np.diag([_SHIFT_SD**-2, _SHIFT_SD**-2, _SWELL_SD**-2])
    trusted = weight
    for _ in range(3):
        pull = (moves * trusted[..., None]).transpose(0, 2, 1)
        G = pull @ moves + least
        shift = np.linalg.solve(G, pull @ off[..., None])
        left = off - (moves @ shift)[..., 0]
        trusted = weight / (1 + (left / _ROBUST_PX) ** 2)
    return shift[:, :2, 0], np.diagonal(G, axis1=1, axis2=2)[:, :2]


def thermal_offsets_far(teats: Array, view: View) -> Array:
    """Columns and rows (m, 2), sensor px, that the thermal outlines of teats (m, 8) are off, up to
    `THERMAL_REACH_PX`; not-a-number where none is seen. An outline is found within some pixels of
    where it is looked for: so other shifts are tried, the same for all teats, until all show one.
    """
    best = np.full((len(teats), 2), np.nan)
    for shift in _THERMAL_SHIFTS if len(teats) else ():
        found = _thermal_near(teats, view, np.array(shift))
        ends, most = (int(np.isfinite(one[:, 0]).sum()) for one in (found, best))
        if ends > most:
            best = found
        if ends == len(teats):
            break
    return best


def _thermal_near(teats: Array, view: View, moved: Array) -> Array:
    """The same, looked for where the picture is moved by (2,), and again where it is found."""
    for _ in range(_AGAIN):
        camera = replace(view.camera, cc=tuple((np.array(view.camera.cc) + moved).tolist()))
        seen = look(teats, (replace(view, camera=camera),), FINE_OUTLINE, fine=True)
        off, weight = thermal_offsets(seen, np.zeros(seen.offset_px.shape, dtype=bool))
        near = np.abs(seen.offset_px) < _CLOSE_PX
        whole = near.mean(axis=1) >= LEAST_SEEN
        whole &= near[:, FINE_OUTLINE.part == END].mean(axis=1) >= LEAST_END
        some = weight > _LEAST_INFORMATION
        pairs = zip(off.T, some.T, strict=True)
        step_px = np.array([np.median(o[c]) if c.any() else 0.0 for o, c in pairs])
        if (np.abs(step_px) < STAYS_PX).all():
            some &= whole[:, None] & (np.abs(off - step_px) < _CLOSE_PX)
            return np.where(some, off + moved, np.nan)
        moved = moved + step_px
        if np.abs(moved).max() > THERMAL_REACH_PX:
            break
    return np.full((len(teats), 2), np.nan)
