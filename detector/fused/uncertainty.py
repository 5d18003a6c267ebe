"""Covariances of fitted teat ends, first order (JCGM 102:2011), through the fit's gain.

Six sources: each edge's noise; what neighbouring edges share (paint, shadow, sampling), by the
scatter of stretches about the outline; the limb correction; the end's deviation from half an
ellipsoid; the unseen part of the end; the calibration.
"""

from __future__ import annotations

import numpy as np

from detector.calibration import Calibration
from detector.fused.fit import Parameters, apex_jacobian, normal_equations
from detector.fused.model import END, SIDE_A, SIDE_B, axes
from detector.fused.refine import FINE_OUTLINE, THERMAL_FLOOR_PX, Fitted
from detector.geometry import Array

_NEAR_PX = 0.3
_LEAST_MM2 = 1e-6  # so that a covariance always has an inverse
_STRETCH = 4  # points of an outline that share a shift: some 10 px


def end_covariances(fitted: Fitted, p: Parameters) -> Array:
    """(m, 3, 3) mm^2 of the ends, right camera's frame, without the calibration's share."""
    m, k = fitted.weight.shape
    optical = 2 * len(FINE_OUTLINE.part)
    gain = _gain(fitted, p)
    noise = gain * np.where(fitted.weight > 0, np.nan_to_num(fitted.seen.sd_px), 0.0)[:, None]
    limb = gain[..., :optical] * fitted.seen.limb_px[:, None, :optical]
    stretches = gain.reshape(m, 3, k // _STRETCH, _STRETCH).sum(axis=3)
    shift = np.full((m, 1, k // _STRETCH), THERMAL_FLOOR_PX)
    shift[..., : optical // _STRETCH] = _stretch_shift(fitted, p)[:, None, None]
    axis = axes(fitted.teats)[..., None]
    unseen = _unseen_end(fitted) * p.unseen_end_sd_mm
    moves = [
        noise,
        stretches * shift,
        p.limb_share * _by_part(limb),
        p.limb_share_of_stretch * limb.reshape(m, 3, optical // _STRETCH, _STRETCH).sum(axis=3),
        np.hypot(p.end_shape_sd_mm, unseen)[:, None, None] * axis,
    ]
    return np.asarray(
        sum(np.einsum("mik,mjk->mij", move, move) for move in moves) + _LEAST_MM2 * np.eye(3)
    )


def _gain(fitted: Fitted, p: Parameters) -> Array:
    """How the ends move with each edge (m, 3, k), mm a px."""
    H, _ = normal_equations(fitted.teats, fitted.seen, fitted.weight, p.prior)
    j = np.where(fitted.weight[..., None] > 0, fitted.seen.jacobian, 0.0) * fitted.weight[..., None]
    return np.asarray(apex_jacobian(fitted.teats) @ np.linalg.solve(H, j.transpose(0, 2, 1)))


def _by_part(limb: Array) -> Array:
    """Moves (m, 3, views * n) summed by part (m, 3, 3 parts): both pictures show the same light."""
    part = np.tile(FINE_OUTLINE.part, limb.shape[2] // len(FINE_OUTLINE.part))
    return np.stack([limb[..., part == p].sum(axis=2) for p in (SIDE_A, END, SIDE_B)], axis=2)


def _stretch_shift(fitted: Fitted, p: Parameters) -> Array:
    """Common sd (m,) px of a stretch of the optical outlines; larger where a part is unseen."""
    k = 2 * len(FINE_OUTLINE.part)
    used = fitted.weight[:, :k] > 0
    offset = np.where(used, np.clip(np.nan_to_num(fitted.seen.offset_px[:, :k]), -1, 1), 0.0)
    count = used.reshape(len(used), -1, _STRETCH).sum(axis=2)
    mean = offset.reshape(*count.shape, _STRETCH).sum(axis=2) / np.maximum(count, 1)
    whole = count >= _STRETCH - 1
    scatter = np.where(
        whole.any(axis=1), (mean**2 * whole).sum(axis=1) / np.maximum(whole.sum(axis=1), 1), 1.0
    )
    support = np.maximum(
        (used & (np.abs(np.nan_to_num(fitted.seen.offset_px[:, :k], nan=9.0)) < _NEAR_PX)).mean(
            axis=1
        ),
        0.2,
    )
    return np.asarray(np.sqrt(p.stretch_least_px**2 + p.stretch_share**2 * scatter) / support)


def _unseen_end(fitted: Fitted) -> Array:
    """The share (m,) of the end's optical outline that shows no edge where it should be."""
    at = np.tile(FINE_OUTLINE.part == END, 2)
    k = len(at)
    near = np.abs(np.nan_to_num(fitted.seen.offset_px[:, :k], nan=9.0)) < 2 * _NEAR_PX
    return np.asarray(1.0 - (near & (fitted.weight[:, :k] > 0))[:, at].mean(axis=1))


def world_covariances(own: Array, ends_mm: Array, calibration: Calibration) -> Array:
    """(m, 3, 3) mm^2, world: ``own`` (right camera's frame) and calibration's at ``ends_mm``."""
    R = calibration.world_from_right.R
    total = R @ own @ R.T
    if calibration.covariance is None or len(own) == 0:
        return np.asarray(total)
    return np.asarray(
        total + calibration.covariance_of(calibration.world_from_right.apply(ends_mm))
    )
