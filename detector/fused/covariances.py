"""How unsure the end of a fitted teat is: by its edges, its shape and what is seen of it.

And the shift of edges by their place between pixels, which is estimated and removed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np

from detector.calibration import Calibration
from detector.fused.decide import Fits, one_sided
from detector.fused.learned import Learned, in_order
from detector.fused.parameters import Parameters
from detector.fused.refine import any_shape
from detector.geometry import Array, or_zero
from detector.outline.fine import FINE_OUTLINE, Fitted
from detector.outline.fit import apex_jacobian, information, usual
from detector.outline.model import (
    END,
    HEIGHT,
    LEAN_X,
    LEAN_Z,
    RADIUS,
    SIDE_A,
    SIDE_B,
    TAPER,
    apexes,
    axes,
)
from detector.outline.prior import disparities_px
from detector.outline.views import THERMAL_FLOOR_PX

_ALIAS_SD_PX = 0.03  # of the wave's amplitude about 0, before edges are looked at
_ALIAS_SHARE = 0.25  # how wrong the wave's form is


def unaliased(fitted: Fitted, p: Parameters) -> tuple[Fitted, Array]:
    """The teats, moved by what their edges are off through the pixels' grid, and these edges; and
    what that leaves unsure of their ends, (m, 3, 3) mm^2.

    A lens that is sharper than its pixels gives an edge a shift with the period of a pixel: along a
    row in proportion to sin(2 pi x) and, for a slanted edge, the cube of its normal's part. On an
    upright side it is the same all the way, and so one of place or depth. How large it is, is
    estimated for each optical picture from what the fits of all teats leave over.
    """
    m, n, seen = len(fitted.teats), len(FINE_OUTLINE.part), fitted.seen
    place = seen.pixels_px + or_zero(seen.offset_px)[..., None] * seen.normals
    waves = np.zeros((m, fitted.weight.shape[1], 2))
    for view in range(2):
        at = slice(view * n, (view + 1) * n)
        wave = seen.normals[:, at] ** 3 * np.sin(2 * np.pi * place[:, at])
        waves[:, at, view] = or_zero(wave).sum(axis=2)
    H, moves = information(seen, fitted.weight, usual(p.prior)[1]), _moves(fitted)
    pull = (moves * fitted.weight[..., None]).transpose(0, 2, 1)
    by_waves = np.linalg.solve(H, pull @ waves)
    off = np.where(fitted.weight > 0, seen.offset_px, 0.0)
    # what moving the teats explains of the waves is no evidence
    left = fitted.weight[..., None] * (waves - moves @ by_waves)
    known = np.einsum("mkv,mkw->vw", left, waves) / _STRETCH
    evidence = np.einsum("mkv,mk->v", left, off) / _STRETCH
    known += np.eye(2) / _ALIAS_SD_PX**2
    amplitude_px = np.linalg.solve(known, evidence)
    change, moved = -(waves @ amplitude_px), -(by_waves @ amplitude_px)
    after = seen.offset_px + change - (moves @ moved[..., None])[..., 0]
    unsure_px = np.sqrt((_ALIAS_SHARE * amplitude_px) ** 2 + np.diag(np.linalg.inv(known)))
    ends = apex_jacobian(fitted.teats) @ by_waves * unsure_px
    return (
        replace(fitted, teats=fitted.teats + moved, seen=replace(seen, offset_px=after)),
        np.asarray(np.einsum("miv,mjv->mij", ends, ends)),
    )


def _moves(fitted: Fitted) -> Array:
    """The Jacobian of edges in use (m, k, 8)."""
    return np.where(fitted.weight[..., None] > 0, fitted.seen.jacobian, 0.0)


_SHOWN_PX = 0.6  # how far off an edge may be that shows an end
# the half of an end that is farthest out, in both optical pictures: it says where the end is
_TIP = np.tile(FINE_OUTLINE.part == END, 2)
_TIP[np.flatnonzero(_TIP).reshape(2, 4, -1)[:, [0, -1]].ravel()] = False
_LEAST_MM2 = 1e-6  # so that a covariance always has an inverse
_LEFT_OVER = 0.4, 5.0  # at least and at most
_STRETCH = 4  # points of an outline that share a shift: some 10 px


def end_covariances(fitted: Fitted, p: Parameters) -> Array:
    """(m, 3, 3) mm^2 of the ends, the fits' frame, without the calibration's share.

    First order (JCGM 102:2011), through the fit's gain, from: each edge's noise; what neighbouring
    edges share (paint, shadow, sampling), by the scatter of stretches about the outline and by how
    unlike the lines' light is; the limb correction; the unseen part of the end.
    """
    m, k = fitted.weight.shape
    sure = [usual(prior)[1] for prior in (any_shape(p.prior), p.prior)]
    H = information(fitted.seen, fitted.weight, np.where(fitted.shaped[:, None], *sure))
    of_ends = np.linalg.solve(H, apex_jacobian(fitted.teats).transpose(0, 2, 1))
    # how ends move with each edge (m, 3, k), mm a px
    gain = (_moves(fitted) * fitted.weight[..., None]) @ of_ends
    gain = np.ascontiguousarray(gain.transpose(0, 2, 1))
    optical = 2 * len(FINE_OUTLINE.part)
    sd = np.where(fitted.weight > 0, fitted.seen.sd_px, 0.0)
    noise = gain * (sd * _left_over(fitted)[:, None])[:, None]
    limb = gain[..., :optical] * fitted.seen.limb_px[:, None, :optical]
    # both pictures show the same light
    part = np.tile(FINE_OUTLINE.part, 2)
    by_part = np.stack([limb[..., part == q].sum(axis=2) for q in (SIDE_A, END, SIDE_B)], axis=2)
    stretches = gain.reshape(m, 3, k // _STRETCH, _STRETCH).sum(axis=3)
    shift = np.full((m, 1, k // _STRETCH), THERMAL_FLOOR_PX)
    off, used = np.abs(fitted.seen.offset_px[:, :optical]), fitted.weight[:, :optical] > 0
    shift[..., : optical // _STRETCH] = _stretch_shift(fitted, p)[:, None, None]
    shown = (used & (off < _SHOWN_PX))[:, _TIP].mean(axis=1)
    unseen = ((1.0 - shown) ** 2 * p.unseen_end_sd_mm)[:, None] * axes(fitted.teats)
    unlike = gain[..., :optical] @ fitted.seen.unlike_px[:, :optical, None]
    light = [p.limb_share * by_part, p.unlike_light_share * unlike]
    every = np.concatenate([noise, stretches * shift, *light, unseen[..., None]], axis=2)
    return np.asarray(every @ every.transpose(0, 2, 1) + _LEAST_MM2 * np.eye(3))


def _left_over(fitted: Fitted) -> Array:
    """How much the optical edges scatter about the fitted outlines, (m,), in the sds that their
    lines give: the square root of the a posteriori variance factor (Baarda 1968), robustly.
    """
    at = slice(0, 2 * len(FINE_OUTLINE.part))
    off, sd = fitted.seen.offset_px[:, at], fitted.seen.sd_px[:, at]
    used = (fitted.weight[:, at] > 0) & np.isfinite(off)
    off = np.where(used, np.abs(off) / np.where(used, sd, 1.0), np.inf)
    off.sort(axis=1)
    middle = off[np.arange(len(off)), used.sum(axis=1) // 2]
    return np.asarray(np.clip(middle / 0.6745, *_LEFT_OVER))


def _stretch_shift(fitted: Fitted, p: Parameters) -> Array:
    """Common sd (m,) px of a stretch of the optical outlines."""
    k = 2 * len(FINE_OUTLINE.part)
    used = fitted.weight[:, :k] > 0
    offset = np.where(used, np.clip(fitted.seen.offset_px[:, :k], -1, 1), 0.0)
    count = used.reshape(len(used), -1, _STRETCH).sum(axis=2)
    mean = offset.reshape(*count.shape, _STRETCH).sum(axis=2) / np.maximum(count, 1)
    whole = count >= _STRETCH - 1
    scatter = np.where(
        whole.any(axis=1), (mean**2 * whole).sum(axis=1) / np.maximum(whole.sum(axis=1), 1), 1.0
    )
    unlike = np.where(used, np.abs(fitted.seen.unlike_px[:, :k]), 0.0).sum(axis=1)
    by_light = p.stretch_unlike_share * unlike / np.maximum(used.sum(axis=1), 1)
    return np.asarray(np.sqrt(by_light**2 + p.stretch_share**2 * scatter))


def world_covariances(own: Array, ends_mm: Array, calibration: Calibration) -> Array:
    """(m, 3, 3) mm^2, world: ``own`` (right camera's frame) and calibration's at ``ends_mm``."""
    R = calibration.world_from_right.R
    total = R @ own @ R.T
    if calibration.covariance is None or len(own) == 0:
        return np.asarray(total)
    return np.asarray(
        total + calibration.covariance_of(calibration.world_from_right.apply(ends_mm))
    )


class Term(NamedTuple):
    """What makes an end unsure in a ``way``: a share of the standard deviation that its edges give,
    or that the fits of its place have between them (``doubtful``: the more so, the less the odds);
    mm or, along the line of sight, px of disparity. A learned factor.
    """

    way: Literal["edges", "between", "doubtful", "along", "across", "sight"]
    of: Callable[[Fits], Array]


def _one(f: Fits) -> Array:
    return np.ones(len(f.teats))


def _short(f: Fits) -> Array:
    return np.asarray(1.0 - f.of.side.max(axis=1))


def _warm_beside(f: Fits) -> Array:
    """The share of its worse side that the thermal picture doesn't show, as beside warm things."""
    return np.asarray(1.0 - f.of.both[:, 2])


def _in_depth(f: Fits) -> Array:
    """How much more than across a fit of one side leans in depth."""
    across, depth = np.abs(f.teats[:, [LEAN_X, LEAN_Z]]).T
    return np.asarray(one_sided(f) * np.maximum(depth - across, 0.0))


# standard deviations, a unit of the factor
TERMS: dict[str, Term] = {
    "edges": Term("edges", _one),
    "edges, misfit": Term("edges", lambda f: f.of.misfit_px),
    "between fits": Term("between", _one),
    "between fits, doubtful": Term("doubtful", _one),
    "along, misfit of the end": Term("along", lambda f: f.of.end_misfit_px),
    "along, misfit of the end, unlike a ball": Term(
        "along", lambda f: f.of.end_misfit_px * f.teats[:, RADIUS] * np.abs(f.teats[:, HEIGHT] - 1)
    ),
    "along, misfit of the end, of any shape": Term(
        "along", lambda f: f.of.end_misfit_px * f.of.shaped
    ),
    "along, led to by its sides and not warm": Term(
        "along", lambda f: f.of.followed * (1.0 - f.of.end[:, 2])
    ),
    "along, one side and leaning in depth": Term("along", _in_depth),
    "across, one side and leaning in depth": Term("across", _in_depth),
    "across, one side, radius off the usual squared": Term(
        "across", lambda f: one_sided(f) * f.off_usual**2
    ),
    "across, taper": Term("across", lambda f: np.abs(f.teats[:, TAPER])),
    "across, short sides": Term("across", _short),
    "across, warm beside it": Term("across", _warm_beside),
    "sight, one side and leaning in depth": Term("sight", _in_depth),
    "sight, short sides": Term("sight", _short),
    "sight, warm beside it": Term("sight", _warm_beside),
}


def variance_terms(
    own: Array, between: Array, odds: Array, fits: Fits, calibration: Calibration
) -> Array:
    """Of `TERMS`, (m, k, 3, 3), the fits' frame: of fits of log ``odds`` (m,) the covariances by
    their edges, ``own``, and ``between`` the fits of a place.
    """
    axis, ends = axes(fits.teats), apexes(fits.teats)
    distance = np.linalg.norm(ends, axis=1, keepdims=True)
    sight = ends / distance
    across = np.cross(axis, sight)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    px = disparities_px(ends, calibration)[:, None]
    moves = {"along": axis, "across": across, "sight": sight * distance / px}
    by = {way: np.einsum("mi,mj->mij", move, move) for way, move in moves.items()}
    by |= {"edges": own, "between": between}
    by["doubtful"] = between / (1.0 + np.exp(odds))[:, None, None]
    every = (by[t.way] * np.square(t.of(fits))[:, None, None] for t in TERMS.values())
    return np.stack(list(every), axis=1)


def stated(terms: Array, learned: Learned) -> Array:
    """(m, 3, 3) mm^2 of ends by what was learned, of `variance_terms`."""
    return np.asarray(np.einsum("mkij,k->mij", terms, in_order(learned.factors, TERMS) ** 2))
