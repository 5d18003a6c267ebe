"""How unsure the end of a fitted teat is: by its edges, its shape and what is seen of it.

And the shift of edges by their place between pixels, which is estimated and removed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from detector.calibration import Calibration
from detector.fused.decide import UNLIKE_SIDES, WHOLE_SIDE, one_sees_a_side, thermal_ends
from detector.fused.evidence import WHOLE_END, Evidence
from detector.fused.parameters import Parameters
from detector.fused.refine import any_shape
from detector.geometry import Array
from detector.outline.fine import FINE_OUTLINE, Fitted
from detector.outline.fit import apex_jacobian, normal_equations
from detector.outline.model import END, HEIGHT, RADIUS, SIDE_A, SIDE_B, apexes, axes
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
    place = seen.pixels_px + np.nan_to_num(seen.offset_px)[..., None] * seen.normals
    waves = np.zeros((m, fitted.weight.shape[1], 2))
    for view in range(2):
        at = slice(view * n, (view + 1) * n)
        wave = seen.normals[:, at] ** 3 * np.sin(2 * np.pi * place[:, at])
        waves[:, at, view] = np.nan_to_num(wave).sum(axis=2)
    by_waves, weighted = _moved_by(waves, fitted, p), fitted.weight[..., None] * waves
    off = np.where(fitted.weight > 0, seen.offset_px, 0.0)
    # what moving the teats explains of the waves is no evidence
    left = weighted - fitted.weight[..., None] * (_moves(fitted) @ by_waves)
    information = np.einsum("mkv,mkw->vw", left, waves) / _STRETCH
    evidence = np.einsum("mkv,mk->v", left, off) / _STRETCH
    information += np.eye(2) / _ALIAS_SD_PX**2
    amplitude_px = np.linalg.solve(information, evidence)
    change, moved = -(waves @ amplitude_px), -(by_waves @ amplitude_px)
    after = seen.offset_px + change - (_moves(fitted) @ moved[..., None])[..., 0]
    unsure_px = np.sqrt((_ALIAS_SHARE * amplitude_px) ** 2 + np.diag(np.linalg.inv(information)))
    ends = apex_jacobian(fitted.teats) @ by_waves * unsure_px
    return (
        replace(fitted, teats=fitted.teats + moved, seen=replace(seen, offset_px=after)),
        np.asarray(np.einsum("miv,mjv->mij", ends, ends)),
    )


def _moves(fitted: Fitted) -> Array:
    """The Jacobian of edges in use (m, k, 8)."""
    return np.where(fitted.weight[..., None] > 0, fitted.seen.jacobian, 0.0)


def _equations(fitted: Fitted, p: Parameters) -> tuple[Array, Array]:
    """The normal equations' matrices (m, 8, 8), and how edges pull at their right sides
    (m, k, 8), a px.
    """
    H, _ = normal_equations(fitted.teats, fitted.seen, fitted.weight, p.prior)
    return H, _moves(fitted) * fitted.weight[..., None]


def _moved_by(edges_px: Array, fitted: Fitted, p: Parameters) -> Array:
    """How teats move (m, 8, w) with their edges, each of which moves outward by (m, k, w)."""
    H, pull = _equations(fitted, p)
    return np.asarray(np.linalg.solve(H, pull.transpose(0, 2, 1) @ edges_px))


def _end_gain(fitted: Fitted, p: Parameters) -> Array:
    """How ends move with each edge (m, 3, k), mm a px."""
    H, pull = _equations(fitted, p)
    of_ends = np.linalg.solve(H, apex_jacobian(fitted.teats).transpose(0, 2, 1))
    return np.asarray((pull @ of_ends).transpose(0, 2, 1))


_SHOWN_PX, _SUPPORT_PX = 0.6, 0.3  # how far off an edge may be that shows an end, or an outline
# the half of an end that is farthest out, in both optical pictures: it says where the end is
_TIP = np.tile(FINE_OUTLINE.part == END, 2)
_TIP[np.flatnonzero(_TIP).reshape(2, 4, -1)[:, [0, -1]].ravel()] = False
_LEAST_MM2 = 1e-6  # so that a covariance always has an inverse
# of a short teat's end: along its axis and anywhere; in full where its edges are this far off, and
# at the least
_SHAPE_ALONG_MM, _SHAPE_ACROSS_MM, _SHAPE_PX, _LEAST_SHAPE = 0.7, 0.2, 0.1, 0.3
_LEFT_OVER = 0.4, 5.0  # at least and at most
# in plain light, and of a short teat of any shape; the more is left over, the longer are the tails
_USUAL, _MORE = (0.72, 0.62), (0.83, 0.4)
_STRETCH = 4  # points of an outline that share a shift: some 10 px
# to decide: what is left over, px that a stretch has in common, mm of an end's shape
_USUAL_TO_DECIDE, _MORE_TO_DECIDE = (0.79, 0.62), (0.8, 0.4)
_LEAST_TO_DECIDE_PX, _SHAPE_TO_DECIDE_MM = 0.007, 0.025


def end_covariances(fitted: Fitted, p: Parameters, *, to_decide: bool = False) -> Array:
    """(m, 3, 3) mm^2 of the ends, right camera's frame, without the calibration's share. Those
    ``to_decide`` by whether there is a teat are larger where less of its outline is seen.

    First order (JCGM 102:2011), through the fit's gain, from: each edge's noise; what neighbouring
    edges share (paint, shadow, sampling), by the scatter of stretches about the outline and by how
    unlike the lines' light is; the limb correction; the end's deviation from half an ellipsoid; the
    unseen part of the end.
    """
    result = np.empty((len(fitted.teats), 3, 3))
    for shaped, priors in ((False, p), (True, any_shape(p))):
        at = np.flatnonzero(fitted.shaped == shaped)
        if len(at):
            result[at] = _by_edges(fitted.take(at), priors, to_decide)
    if to_decide:
        at = np.flatnonzero(fitted.shaped)
        result[at] += _shape_covariances(fitted.take(at))
    return result


def _by_edges(fitted: Fitted, p: Parameters, to_decide: bool) -> Array:
    m, k = fitted.weight.shape
    optical = 2 * len(FINE_OUTLINE.part)
    gain = _end_gain(fitted, p)
    sd = np.where(fitted.weight > 0, np.nan_to_num(fitted.seen.sd_px), 0.0)
    noise = gain * (sd * _left_over(fitted, to_decide)[:, None])[:, None]
    limb = gain[..., :optical] * fitted.seen.limb_px[:, None, :optical]
    # both pictures show the same light
    part = np.tile(FINE_OUTLINE.part, 2)
    by_part = np.stack([limb[..., part == q].sum(axis=2) for q in (SIDE_A, END, SIDE_B)], axis=2)
    stretches = gain.reshape(m, 3, k // _STRETCH, _STRETCH).sum(axis=3)
    shift = np.full((m, 1, k // _STRETCH), THERMAL_FLOOR_PX)
    off, used = np.abs(fitted.seen.offset_px[:, :optical]), fitted.weight[:, :optical] > 0
    support = np.maximum((used & (off < _SUPPORT_PX)).mean(axis=1), 0.2) if to_decide else 1.0
    common = _stretch_shift(fitted, p, to_decide) / support
    shift[..., : optical // _STRETCH] = common[:, None, None]
    axis = axes(fitted.teats)[..., None]
    shown = (used & (off < _SHOWN_PX))[:, part == END if to_decide else _TIP].mean(axis=1)
    unseen = (1.0 - shown) ** 2 * p.unseen_end_sd_mm
    if to_decide:
        of_part, of_stretch = p.limb_shares_to_decide
        by_stretch = limb.reshape(m, 3, optical // _STRETCH, _STRETCH).sum(axis=3)
        by_light = [of_part * by_part, of_stretch * by_stretch]
    else:
        unlike = gain[..., :optical] @ fitted.seen.unlike_px[:, :optical, None]
        by_light = [p.limb_share * by_part, p.unlike_light_share * unlike]
    shape_mm = _SHAPE_TO_DECIDE_MM if to_decide else p.end_shape_sd_mm
    shape = np.hypot(shape_mm, unseen)[:, None, None] * axis
    moves = [noise, stretches * shift, *by_light, shape]
    every = np.concatenate(moves, axis=2)
    return np.asarray(every @ every.transpose(0, 2, 1) + _LEAST_MM2 * np.eye(3))


def _shape_covariances(fitted: Fitted) -> Array:
    """What the unlikeness of a teat's end to half an ellipsoid adds, (m, 3, 3) mm^2."""
    axis = axes(fitted.teats)
    along = np.einsum("mi,mj->mij", axis, axis)
    return np.asarray(_SHAPE_ALONG_MM**2 * along + _SHAPE_ACROSS_MM**2 * np.eye(3))


def _left_over(fitted: Fitted, to_decide: bool) -> Array:
    """How much the optical edges scatter about the fitted outlines, (m,), in the sds that their
    lines give: the square root of the a posteriori variance factor (Baarda 1968), robustly.
    """
    at = slice(0, 2 * len(FINE_OUTLINE.part))
    off, sd = fitted.seen.offset_px[:, at], fitted.seen.sd_px[:, at]
    used = (fitted.weight[:, at] > 0) & np.isfinite(off)
    off = np.where(used, np.abs(off) / np.where(used, sd, 1.0), np.inf)
    off.sort(axis=1)
    middle = off[np.arange(len(off)), used.sum(axis=1) // 2]
    ratio = np.clip(middle / 0.6745, *_LEFT_OVER)
    known = (_USUAL_TO_DECIDE, _MORE_TO_DECIDE) if to_decide else (_USUAL, _MORE)
    usual, more = (np.where(fitted.shaped, *values[::-1]) for values in known)
    return np.asarray(ratio * (ratio / usual) ** more)


def _stretch_shift(fitted: Fitted, p: Parameters, to_decide: bool) -> Array:
    """Common sd (m,) px of a stretch of the optical outlines."""
    k = 2 * len(FINE_OUTLINE.part)
    used = fitted.weight[:, :k] > 0
    offset = np.where(used, np.clip(np.nan_to_num(fitted.seen.offset_px[:, :k]), -1, 1), 0.0)
    count = used.reshape(len(used), -1, _STRETCH).sum(axis=2)
    mean = offset.reshape(*count.shape, _STRETCH).sum(axis=2) / np.maximum(count, 1)
    whole = count >= _STRETCH - 1
    scatter = np.where(
        whole.any(axis=1), (mean**2 * whole).sum(axis=1) / np.maximum(whole.sum(axis=1), 1), 1.0
    )
    unlike = np.where(used, np.abs(fitted.seen.unlike_px[:, :k]), 0.0).sum(axis=1)
    by_light = p.stretch_unlike_share * unlike / np.maximum(used.sum(axis=1), 1)
    least = _LEAST_TO_DECIDE_PX if to_decide else by_light
    return np.asarray(np.sqrt(least**2 + p.stretch_share**2 * scatter))


def world_covariances(own: Array, ends_mm: Array, calibration: Calibration) -> Array:
    """(m, 3, 3) mm^2, world: ``own`` (right camera's frame) and calibration's at ``ends_mm``."""
    R = calibration.world_from_right.R
    total = R @ own @ R.T
    if calibration.covariance is None or len(own) == 0:
        return np.asarray(total)
    return np.asarray(
        total + calibration.covariance_of(calibration.world_from_right.apply(ends_mm))
    )


_LEAST_OTHER_SIDE = 0.2  # of a teat's own other side
_NEIGHBOUR_PX = 0.1  # how far beyond a side warmth goes on, sensor px, where a neighbour is
_DISPARITY_A_PX2 = 6.3  # sd of the disparity, px, of the square of the misfit
_FAR_WITHIN_PX, _MORE_WITHIN = -0.3, 1.9  # sensor px; of a variance
# one picture shows more of both than the other: of a side, of an end
_UNLIKE_SIDE, _UNLIKE_END = 0.2, 0.1
_BESIDE_MM, _BESIDE_DOWN_MM = 32.0, 60.0  # where another teat may be before a side of one


def widened(own: Array, depth_mm: Array, evidence: Evidence, calibration: Calibration) -> Array:
    """Covariances ``own`` (m, 3, 3) of fits ``depth_mm`` (m,) away, widened to the disparity by
    which fits with such edges were off, and where the thermal outline is far within theirs.
    """
    mm_a_px = depth_mm**2 / (calibration.right.fc[0] * calibration.baseline_mm)
    least_mm = mm_a_px * _DISPARITY_A_PX2 * evidence.misfit_px**2
    wider = np.maximum(1.0, least_mm**2 / own[:, 2, 2])
    within = np.nan_to_num(evidence.thermal_px).min(axis=1) < _FAR_WITHIN_PX
    wider *= np.where(within, _MORE_WITHIN, 1.0)
    return np.asarray(own * wider[:, None, None])


def unlike_covariances(teats: Array, evidence: Evidence, p: Parameters) -> Array:
    """(m, 3, 3) mm^2 of the ends of teats (m, 8), right camera's frame: what a teat that isn't the
    model's, or of which too little is seen, adds to its fit's covariance.
    """
    axis = axes(teats)
    across = np.cross(axis, teats[:, :3])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    optical, thermal_end = evidence.end[:, :2].mean(axis=1), evidence.thermal_px[:, END]
    partly = optical < WHOLE_END
    # the other side of an end that is seen in part may be a neighbour's
    one_side = (evidence.both[:, :2].min(axis=1) <= p.least_side) | (
        partly & (evidence.both[:, 2] <= _LEAST_OTHER_SIDE)
    )
    short = evidence.shaped | (evidence.side.max(axis=1) < WHOLE_SIDE)
    in_part = partly & np.isnan(thermal_end)
    unlike_mm = teats[:, RADIUS] * np.abs(teats[:, HEIGHT] - 1.0)
    in_part_mm = np.where(evidence.followed, p.end_led_to_sd_mm, p.end_in_part_sd_mm)
    in_part_mm[evidence.stops] = p.end_at_stop_sd_mm
    along2 = (p.end_unlike_share * unlike_mm) ** 2 + in_part_mm**2 * in_part
    along2 += (p.end_misfit_mm_a_px2 * evidence.end_misfit_px**2) ** 2
    shape = short * np.clip(evidence.misfit_px / _SHAPE_PX, _LEAST_SHAPE, 1.0)
    along2 += (shape * _SHAPE_ALONG_MM) ** 2
    anywhere2 = shape**2 * (p.short_sd_mm**2 + evidence.shaped * _SHAPE_ACROSS_MM**2)
    along2 += thermal_ends(evidence, p) * p.thermal_end_sd_mm**2
    short_seen = evidence.shaped | (evidence.side[:, :2].max(axis=1) < WHOLE_SIDE)
    across2 = one_side * np.where(short_seen, p.short_one_side_sd_mm, p.one_side_sd_mm) ** 2
    covered = ~one_side & (evidence.both[:, 2] <= _LEAST_OTHER_SIDE)
    across2 += covered * np.where(evidence.followed, p.covered_led_to_sd_mm, p.covered_sd_mm) ** 2
    beyond = np.nan_to_num(evidence.thermal_px[:, [SIDE_A, SIDE_B]], nan=-1.0).max(axis=1)
    across2 += (one_side & (beyond > _NEIGHBOUR_PX)) * p.neighbour_sd_mm**2
    sight = teats[:, :3] / np.linalg.norm(teats[:, :3], axis=1, keepdims=True)
    sides, ends = (np.ptp(share[:, :2], axis=1) for share in (evidence.both, evidence.end))
    deep2 = (sides > UNLIKE_SIDES) * (p.one_sees_mm_a_px * evidence.misfit_px) ** 2
    deep2 += one_sees_a_side(evidence) * p.one_sees_in_part_sd_mm**2
    unlike = (sides > _UNLIKE_SIDE) & (ends > _UNLIKE_END) & np.isfinite(thermal_end)
    deep2 += (unlike | (ends > UNLIKE_SIDES)) * p.unlike_sd_mm**2
    deep2 += _alone(teats, evidence, p) * p.alone_sd_mm**2
    return np.asarray(
        np.einsum("m,mi,mj->mij", along2, axis, axis)
        + np.einsum("m,mi,mj->mij", across2, across, across)
        + np.einsum("m,mi,mj->mij", deep2, sight, sight)
        + np.einsum("m,ij->mij", anywhere2, np.eye(3))
    )


def _alone(teats: Array, evidence: Evidence, p: Parameters) -> NDArray[np.bool_]:
    """Which of teats (m, 8) show one side in every picture, and no other teat is near: what hides
    the other side is unknown, and its edge may be taken for the teat's.
    """
    ends = apexes(teats)
    across, down, _ = np.abs(ends[:, None] - ends).transpose(2, 0, 1)
    near = (across < _BESIDE_MM) & (down < _BESIDE_DOWN_MM)
    one_side = evidence.both.max(axis=1) <= p.least_side
    return np.asarray(one_side & ~evidence.shaped & (near.sum(axis=1) == 1))
