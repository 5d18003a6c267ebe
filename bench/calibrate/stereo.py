"""The stereo pair from views of a board: alone, with fixed and with joint lenses, and everything
that says how good it is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bench.calibrate.views import BoardViews
from detector.calibration import ParameterCovariance, Part, Record
from detector.calibration.bundle import POSE
from detector.calibration.cameras import (
    Calibrated,
    Halves,
    TooFewViewsError,
    View,
    calibrate_camera,
    join_cameras,
    pair_of,
    split_half,
)
from detector.calibration.coverage import Coverage, coverage
from detector.calibration.diagnosis import (
    Finding,
    Remeasured,
    bent,
    measured_again,
    outlier_views,
    remeasure,
    swapped,
)
from detector.calibration.values import Pair, covariance_of_points
from detector.geometry import Array

PAIR = ("left", "right")
LEAST_FOR_HALVES = 10  # pairs of views; a half of fewer than five says nothing


@dataclass(frozen=True, slots=True)
class Lens:
    """Which lens model is fitted, of `detector.calibration.cameras.LENS_MODELS`."""

    model: str = "k1 k2 p1 p2"
    square_pixels: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class CamerasResult:
    """Everything found. ``halves`` and ``held_out`` are None where there were too few views for
    them.
    """

    views: BoardViews
    lens: Lens
    alone: Mapping[str, Calibrated]
    fixed: Calibrated
    joint: Calibrated
    coverage: Mapping[str, Coverage]
    halves: Halves | None
    held_out: Remeasured | None
    findings: tuple[Finding, ...]

    @property
    def pair(self) -> Pair:
        """The answer, in the right camera's frame."""
        return pair_of(self.joint)

    @property
    def covariance(self) -> ParameterCovariance:
        """Of lenses and stereo, as a calibration file names them."""
        fit = self.joint.fit
        return ParameterCovariance(
            tuple(("stereo", name) if name in POSE else (owner, name) for owner, name in fit.names),
            fit.covariance,
        )

    def part(self, record: Record) -> Part:
        """What the file of this step holds."""
        pair = self.pair
        return Part(
            left=pair.left,
            right=pair.right,
            right_from_left=pair.right_from_left,
            covariance=self.covariance,
            record=record,
        )

    def good_to_mm(self, depths_mm: Array) -> Array:
        """Expanded uncertainty (k = 2) (n,) of a point's place, along its worst direction, midway
        before the pair at these distances.

        The calibration's own, with pixels as noisy as the corners were.
        """
        axis = self.pair.right_from_left.T / 2.0
        points = np.array([[axis[0], axis[1], depth] for depth in np.asarray(depths_mm)])
        found = covariance_of_points(self.pair, self.covariance, points, self.joint.fit.sigma_px)
        return np.asarray(2.0 * np.sqrt(np.linalg.eigvalsh(found)[:, -1]))


def calibrate_pair(views: BoardViews, lens: Lens) -> CamerasResult:
    """The whole job. Raises BundleError (a sentence) for views that can't fix the cameras."""
    seen = {camera: views.views(camera) for camera in PAIR}
    alone = {
        camera: calibrate_camera(
            camera,
            seen[camera],
            views.image_size[camera],
            model=lens.model,
            square_pixels=lens.square_pixels,
        )
        for camera in PAIR
    }
    if views.image_size["left"] != views.image_size["right"]:
        raise TooFewViewsError(
            "left and right pictures differ in size: are they from the same pair?"
        )
    fixed = join_cameras(alone)
    joint = join_cameras(
        alone, joint_lenses=PAIR, model=lens.model, square_pixels=lens.square_pixels
    )
    shown = {
        camera: coverage(
            [view.pixels_px for view in seen[camera]],
            views.image_size[camera],
            alone[camera].fit.poses,
        )
        for camera in PAIR
    }
    halves = _halves(views, seen, lens)
    held_out = _held_out(views, halves) if halves else None
    findings = _findings(views, joint, held_out)
    return CamerasResult(views, lens, alone, fixed, joint, shown, halves, held_out, findings)


def _halves(views: BoardViews, seen: Mapping[str, Sequence[View]], lens: Lens) -> Halves | None:
    if len(views.pairs()) < LEAST_FOR_HALVES:
        return None
    try:
        return split_half(
            seen, views.image_size["left"], model=lens.model, square_pixels=lens.square_pixels
        )
    except TooFewViewsError:
        return None


def _held_out(views: BoardViews, halves: Halves) -> Remeasured:
    """Each half of the views measured with the calibration that the other half made."""
    pairs = views.pairs()
    first, second = (
        remeasure(halves.pairs[1 - start], views.board, pairs[start::2]) for start in (0, 1)
    )
    return Remeasured(views.board, (*first.views, *second.views))


def _findings(
    views: BoardViews, joint: Calibrated, held_out: Remeasured | None
) -> tuple[Finding, ...]:
    pair = pair_of(joint)
    found = swapped(pair.right_from_left)
    if not found:
        used = remeasure(pair, views.board, views.pairs())
        found += measured_again(held_out or used, pair)
        found += [] if any(finding.name == "bent board" for finding in found) else bent(used)
    for camera in PAIR:
        found += outlier_views(joint.view_rms_px(camera), camera)
    return tuple(found)
