"""How far the cameras' edges lie off each other about fitted teats: right rows against left, and
the thermal outlines against what the stereo fit predicts.
"""

from __future__ import annotations

import numpy as np

from detector.geometry import Array
from detector.outline.edges import CLEAR
from detector.outline.fine import FINE_OUTLINE, Fitted
from detector.outline.fit import normal_equations
from detector.outline.prior import Prior

_EDGE_PX, _ROBUST_PX = 0.2, 0.3  # of thermal edges: sd beyond noise; farther off counts for less
_SHIFT_SD, _SWELL_SD = 0.5, 0.5  # px, before a teat is looked at: no end, no rows


def row_offsets(fitted: Fitted, prior: Prior) -> tuple[Array, Array]:
    """Rows px (m,) by which the right picture's edges are off, each teat free; their weights."""
    n = len(FINE_OUTLINE.part)
    seen, weight = fitted.seen, fitted.weight
    H, _ = normal_equations(fitted.teats, seen, weight, prior)
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


def thermal_offsets(fitted: Fitted) -> tuple[Array, Array]:
    """Shifts (m, 2) sensor px of thermal outlines, each free to swell; their weights (m, 2)."""
    n = len(FINE_OUTLINE.part)
    at = slice(2 * n, 3 * n)
    seen, off = fitted.seen, fitted.seen.offset_px[:, at]
    clear = np.isfinite(off) & (seen.clarity[:, at] > CLEAR) & ~fitted.hidden[:, at]
    weight = np.where(clear, 1.0 / (seen.sd_px[:, at] ** 2 + _EDGE_PX**2), 0.0)
    off = np.where(clear, off, 0.0)
    moves = np.concatenate([np.nan_to_num(seen.normals[:, at]), np.ones((*off.shape, 1))], axis=2)
    least = np.diag([_SHIFT_SD**-2, _SHIFT_SD**-2, _SWELL_SD**-2])
    trusted = weight
    for _ in range(3):
        G = np.einsum("mki,mk,mkj->mij", moves, trusted, moves) + least
        b = np.einsum("mki,mk->mi", moves, trusted * off)
        shift = np.linalg.solve(G, b[..., None])[..., 0]
        left = off - np.einsum("mki,mi->mk", moves, shift)
        trusted = weight / (1 + (left / _ROBUST_PX) ** 2)
    return shift[:, :2], np.diagonal(G, axis1=1, axis2=2)[:, :2]
