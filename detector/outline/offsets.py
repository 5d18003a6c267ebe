"""How far the cameras' edges lie off each other about fitted teats: right rows against left, and
the thermal outlines against what the stereo fit predicts.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from detector.geometry import Array, or_zero
from detector.outline.edges import CLEAR
from detector.outline.fine import FINE_OUTLINE, Fitted
from detector.outline.fit import CameraView, OutlineEdges, look, squares, usual
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
    n, seen, weight = len(FINE_OUTLINE.part), fitted.seen, fitted.weight
    at = slice(n, 2 * n)
    off, down = np.where(weight > 0, seen.offset_px, 0.0), np.zeros_like(weight)
    down[:, at] = np.where(weight[:, at] > 0, seen.normals[:, at, 1], 0.0)
    # what moving the teat explains of rows and of edges
    (H, b), (_, a) = (squares(seen.jacobian, each, weight) for each in (down, off))
    explained = np.linalg.solve(H + np.diag(usual(prior)[1]), b[..., None])[..., 0]
    weight_of_rows = (weight * down**2).sum(axis=1) - (b * explained).sum(axis=1)
    score = (weight * down * off).sum(axis=1) - (a * explained).sum(axis=1)
    return score / np.maximum(weight_of_rows, 1e-9), weight_of_rows


def thermal_offsets(seen: OutlineEdges, hidden: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Of the last view's outlines, sensor px: shifts along columns and rows, and by how much each
    swells (m, 3); weights of the shifts (m, 2).
    """
    at = slice(-len(FINE_OUTLINE.part), None)
    off = seen.offset_px[:, at]
    clear = np.isfinite(off) & (seen.clarity[:, at] > CLEAR) & ~hidden[:, at]
    weight = np.where(clear, 1.0 / (seen.sd_px[:, at] ** 2 + _EDGE_PX**2), 0.0)
    off = np.where(clear, off, 0.0)
    moves = np.concatenate([or_zero(seen.normals[:, at]), np.ones((*off.shape, 1))], axis=2)
    least = np.diag([_SHIFT_SD**-2, _SHIFT_SD**-2, _SWELL_SD**-2])
    trusted = weight
    for _ in range(3):
        pull = (moves * trusted[..., None]).transpose(0, 2, 1)
        G = pull @ moves + least
        shift = np.linalg.solve(G, pull @ off[..., None])
        left = off - (moves @ shift)[..., 0]
        trusted = weight / (1 + (left / _ROBUST_PX) ** 2)
    return shift[..., 0], np.diagonal(G, axis1=1, axis2=2)[:, :2]


def thermal_offsets_far(teats: Array, view: CameraView) -> Array:
    """Columns and rows (m, 2), sensor px, that the thermal outlines of teats (m, 8) are off, up to
    `THERMAL_REACH_PX`; not-a-number where none is seen. An outline is found within some pixels of
    where it is looked for: so other shifts are tried, the same for all teats, until all show one.
    """
    best = np.full((len(teats), 2), np.nan)
    for shifts in (_THERMAL_SHIFTS[:1], _THERMAL_SHIFTS[1:]) if len(teats) else ():
        for found in _thermal_near(teats, view, np.array(shifts)):
            if np.isfinite(found[:, 0]).sum() > np.isfinite(best[:, 0]).sum():
                best = found
        if np.isfinite(best[:, 0]).all():
            break
    return best


def _thermal_near(teats: Array, view: CameraView, moved: Array) -> Array:
    """The same (k, m, 2), looked for where the picture is ``moved`` (k, 2), and again where it is
    found.
    """
    m, n, found = len(teats), len(FINE_OUTLINE.part), np.full((len(moved), len(teats), 2), np.nan)
    rows, cc = np.arange(len(moved)), np.array(view.camera.cc)
    for _ in range(_AGAIN):
        places = (tuple(place) for place in (cc + moved).tolist())
        cameras = (replace(view.camera, cc=place) for place in places)
        views = tuple(replace(view, camera=camera) for camera in cameras)
        every = look(teats, views, FINE_OUTLINE, fine=True, slopes_too=False)
        arrays = (getattr(every, name) for name in OutlineEdges.__slots__)
        seen = OutlineEdges(*(array.reshape(-1, n, *array.shape[2:]) for array in arrays))
        near = np.abs(seen.offset_px) < _CLOSE_PX
        whole = near.mean(axis=1) >= LEAST_SEEN
        whole &= near[:, FINE_OUTLINE.part == END].mean(axis=1) >= LEAST_END
        shifts, weights = thermal_offsets(seen, np.zeros(near.shape, bool))
        off, weight = (each.reshape(m, -1, 2) for each in (shifts[:, :2], weights))
        some = weight > _LEAST_INFORMATION
        # the median of those that show one, 0 without
        ranked, count = np.sort(np.where(some, off, np.inf), axis=0), some.sum(axis=0)
        middle = [np.take_along_axis(ranked, i[None], 0)[0] for i in ((count - 1) // 2, count // 2)]
        step_px = np.where(count > 0, 0.5 * (middle[0] + middle[1]), 0.0)
        stays = (np.abs(step_px) < STAYS_PX).all(axis=1)
        some &= whole.reshape(m, -1, 1) & (np.abs(off - step_px) < _CLOSE_PX)
        found[rows[stays]] = np.where(some, off + moved, np.nan).swapaxes(0, 1)[stays]
        moved = moved + step_px
        on = ~stays & (np.abs(moved).max(axis=1) <= THERMAL_REACH_PX)
        rows, moved = rows[on], moved[on]
        if len(rows) == 0:
            break
    return found
