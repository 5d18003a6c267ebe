"""Calibrations that are a little wrong: what detectors are told is changed, the scene is not.

Strategy: one size for all errors, in pixels of the principal point, and every other parameter wrong by what moves a picture about as far.
Errors are drawn once a member and scaled, so that a curve shows the size of the errors and not another draw.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from detector.calibration import Calibration

FOCAL_PX = 1290.0  # a turn by one pixel's angle, tables 3.1 and 3.2
BASELINE_MM_PER_PX = 0.4  # 0.2 mm at half a pixel: what section 3.2.1.2 prints as its uncertainty
_PRINCIPAL = tuple((camera, name) for camera in ("left", "right") for name in ("cx", "cy"))
_TURN = tuple(("stereo", f"om{i}") for i in (1, 2, 3))
_BASELINE = tuple(("stereo", f"T{i}") for i in (1, 2, 3))
SPREAD_PER_PX = {
    **dict.fromkeys(_PRINCIPAL, 1.0),
    **dict.fromkeys(_TURN, 1.0 / FOCAL_PX),
    **dict.fromkeys(_BASELINE, BASELINE_MM_PER_PX),
}


def told(size_px: float, seed: int, calibration: Calibration) -> Calibration:
    """The calibration with errors of that size, in the same directions for one seed. The thermal camera keeps its place to the left."""
    drawn = np.random.Generator(np.random.PCG64([seed, *b"miscalibration"])).standard_normal(len(SPREAD_PER_PX))
    pair = calibration.pair
    for (owner, name), one, unit in zip(SPREAD_PER_PX, SPREAD_PER_PX.values(), drawn.tolist(), strict=True):
        pair = pair.moved(owner, name, size_px * one * unit)
    return replace(calibration, left=pair.left, right=pair.right, right_from_left=pair.right_from_left)
