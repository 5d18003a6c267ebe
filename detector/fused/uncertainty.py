"""How sure a fitted teat end is: covariances from the edges that were found, and from what edges can't say of themselves.

Strategy: first order (JCGM 102:2011). Four things move an end: the noise of each edge; what neighbouring edges have in common (paint, a
shadow, a neighbour's limb), as one unknown shift for each short stretch of outline, the larger the less of the outline is seen; how far
an end's shape is from half an ellipsoid's, along the axis; and the calibration. The module may not know temperatures.
"""

from __future__ import annotations

import numpy as np

from detector.calibration import Calibration
from detector.fused.fit import apex_jacobian, normal_equations
from detector.fused.model import axes
from detector.fused.parameters import Parameters
from detector.fused.refine import FINE_OUTLINE, Fitted
from detector.geometry import Array

_NEAR_PX = 0.3
_STRETCH = 4  # points of an outline that share a shift: some 10 px


def end_covariances(fitted: Fitted, p: Parameters) -> Array:
    """Covariances (m, 3, 3) mm^2 of the ends in the right camera's frame, without the calibration's share."""
    H, _ = normal_equations(fitted.teats, fitted.seen, fitted.weight, p.prior)
    inverse = np.linalg.inv(H)
    weight = fitted.weight
    j = np.where(weight[..., None] > 0, fitted.seen.jacobian, 0.0)
    gain = np.einsum("mij,mkj,mk->mik", inverse, j, weight)  # how each edge moves the parameters, (m, 8, k)
    scatter = _scatter(fitted)
    noise = inverse * scatter[:, None, None]
    m, k = weight.shape
    common = gain.reshape(m, gain.shape[1], k // _STRETCH, _STRETCH).sum(axis=3)
    shift = fitted.seen.floor_px.reshape(m, -1, _STRETCH)[:, :, 0] * p.stretch_bias
    shared = np.einsum("mis,ms,mjs->mij", common, (shift / _support(fitted)[:, None]) ** 2, common)
    to_end, axis = apex_jacobian(fitted.teats), axes(fitted.teats)
    shape = p.end_shape_sd_mm**2 * np.einsum("mi,mj->mij", axis, axis)
    return np.asarray(to_end @ (noise + shared) @ to_end.transpose(0, 2, 1) + shape)


def _support(fitted: Fitted) -> Array:
    """The share (m,) of the optical outlines that shows an edge where it should be: where a part doesn't, the rest is the more doubtful."""
    k = 2 * len(FINE_OUTLINE.part)
    near = np.abs(np.nan_to_num(fitted.seen.offset_px[:, :k], nan=9.0)) < _NEAR_PX
    return np.asarray(np.maximum((near & (fitted.weight[:, :k] > 0)).mean(axis=1), 0.2))


def _scatter(fitted: Fitted) -> Array:
    """How much larger (m,) the edges' squared distances from the outline are than they claim, at least 1."""
    weight = fitted.weight
    square = np.where(weight > 0, np.nan_to_num(fitted.seen.offset_px) ** 2, 0.0)
    freedom = np.maximum((weight > 0).sum(axis=1) - fitted.teats.shape[1], 1)
    return np.asarray(np.maximum((square * weight).sum(axis=1) / freedom, 1.0))


def world_covariances(own: Array, ends_mm: Array, calibration: Calibration) -> Array:
    """Covariances (m, 3, 3) mm^2 in the world: the ends' ``own`` in the right camera's frame, and the calibration's share
    at ``ends_mm`` (m, 3).
    """
    R = calibration.world_from_right.R
    total = R @ own @ R.T
    if calibration.covariance is None or len(own) == 0:
        return np.asarray(total)
    return np.asarray(total + calibration.covariance_of(calibration.world_from_right.apply(ends_mm)))
