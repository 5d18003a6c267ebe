"""Cameras from views of a board: the stereo pair, alone, with fixed and with joint lenses, and
everything that says how good it is; and the thermal camera, as a third one on a heated board that
the left camera sees too, or as homographies from point pairs.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.special import stdtrit

from bench.calibrate.merge import pair_of_part
from bench.calibrate.views import BoardViews, refuse_missing
from bench.calibrate.world import read_table
from bench.config import ConfigError
from bench.rig.loading import AnyRig, any_rig
from detector.calibration import (
    DEFAULT_PLANE_DEPTH_MM,
    Homographies,
    ParameterCovariance,
    Part,
    Polarity,
    Record,
    ThermalCamera,
    derive_homographies,
)
from detector.calibration.boards import Board
from detector.calibration.bundle import POSE, BundleError
from detector.calibration.cameras import (
    DISTANCE_RATIO,
    LENS_MODELS,
    CameraFit,
    Coverage,
    Halves,
    TooFewViewsError,
    away_text,
    calibrate_camera,
    coverage,
    join_cameras,
    pair_of,
    place_board,
    split_half,
)
from detector.calibration.diagnosis import (
    Finding,
    MeasuredBoard,
    bent,
    measured_again,
    outlier_views,
    remeasure,
    swapped,
)
from detector.calibration.homographies import MappedPairs, fit_homography
from detector.calibration.values import Pair, covariance_of_points
from detector.geometry import Array, Camera, Motion

PAIR = ("left", "right")
PAIR_COLUMNS = ("thermal_x", "thermal_y", "left_x", "left_y", "right_x", "right_y")
NORMAL_95 = 1.96
WORKING_MM = 1200.0  # about where the thesis's teats stand
HELD_MM = (150.0, 5000.0)  # no board is in focus nearer, or seen farther
LEAST_LOOKED_AT = 3  # views or points of a check: of fewer no mark is significant
LEAST_FOR_HALVES = 10  # pairs of views; a half of fewer than five says nothing


@dataclass(frozen=True, slots=True, eq=False)
class CamerasResult:
    """Everything found. ``halves``, ``held_out`` are None where there were too few views."""

    views: BoardViews
    alone: Mapping[str, CameraFit]
    fixed: CameraFit
    joint: CameraFit
    coverage: Mapping[str, Coverage]
    halves: Halves | None
    held_out: MeasuredBoard | None
    findings: tuple[Finding, ...]

    @property
    def pair(self) -> Pair:
        """The answer, in the right camera's frame."""
        return pair_of(self.joint)

    @property
    def covariance(self) -> ParameterCovariance:
        """Of lenses and stereo, as a calibration file names them."""
        return _covariance(self.joint, "stereo")

    def part(self, record: Record) -> Part:
        pair, covariance = self.pair, self.covariance
        return Part(
            pair.left, pair.right, pair.right_from_left, covariance=covariance, record=record
        )

    def text(self) -> list[str]:
        """Baseline, focal lengths and reprojection error, with 95 % intervals."""
        pair, fit = self.pair, self.joint.fit
        at = [fit.names.index(("right", name)) for name in POSE[3:]]
        along = pair.right_from_left.T / np.linalg.norm(pair.right_from_left.T)
        sd_mm = float(np.sqrt(along @ fit.covariance[np.ix_(at, at)] @ along))
        baseline_mm = float(np.linalg.norm(pair.right_from_left.T))
        lines = [f"baseline: {baseline_mm:.2f} ± {NORMAL_95 * sd_mm:.2f} mm"]
        for camera in PAIR:
            focal = []
            for name, value in zip(("fx", "fy"), fit.rig.cameras[camera].fc, strict=True):
                sd = fit.sd(camera, name)
                within = "" if sd is None else f" ± {NORMAL_95 * sd:.2f}"
                focal.append(f"{name} {value:.2f}{within}")
            lines.append(f"focal lengths, {camera}: {', '.join(focal)} px")
        for camera in PAIR:
            views = [*self.joint.view_rms_px(camera).values()]
            rms, (low, high) = float(np.sqrt(np.mean(np.square(views)))), _rms_interval(views)
            text = f"{rms:.3f} px rms ({low:.3f} to {high:.3f})"
            lines.append(f"reprojection error, {camera}: {text}")
        return [*lines, "intervals: 95 %; that of the reprojection error by the views' scatter"]

    @property
    def shown_mm(self) -> tuple[float, float]:
        """The nearest and the farthest board."""
        spans = [each.distances_mm for each in self.coverage.values() if each.distances_mm]
        return min(low for low, _ in spans), max(high for _, high in spans)

    def not_shown(self, working_mm: float) -> tuple[str, ...]:
        """The instruction to show the board where it is to be measured; () where it was."""
        near, far = self.shown_mm
        if near / DISTANCE_RATIO <= working_mm <= far * DISTANCE_RATIO:
            return ()
        away = away_text(near, far)
        return (f"show the board {working_mm / 1000:.2g} m away, where teats stand: {away}",)

    def good_to_mm(self, depths_mm: Array) -> Array:
        """Expanded uncertainty (k = 2) (n,) mm along the worst direction, before the pair."""
        axis = self.pair.right_from_left.T / 2.0
        points = np.array([[axis[0], axis[1], depth] for depth in np.asarray(depths_mm)])
        found = covariance_of_points(self.pair, self.covariance, points, self.joint.fit.sigma_px)
        return np.asarray(2.0 * np.sqrt(np.linalg.eigvalsh(found)[:, -1]))


def _rms_interval(view_rms_px: Sequence[float]) -> tuple[float, float]:
    """95 % interval of the rms over all views, by Student's t on their mean squares."""
    squares = np.square(view_rms_px)
    mean, count = float(squares.mean()), len(squares)
    if count < 2:
        return 0.0, float("inf")
    half = float(stdtrit(count - 1, 0.975) * squares.std(ddof=1) / np.sqrt(count))
    return float(np.sqrt(max(mean - half, 0.0))), float(np.sqrt(mean + half))


def _covariance(found: CameraFit, pose: str) -> ParameterCovariance:
    """As a calibration file names the parameters; ``pose`` is the name of the motion's."""
    fit = found.fit
    names = tuple((pose, name) if name in POSE else (owner, name) for owner, name in fit.names)
    return ParameterCovariance(names, fit.covariance)


@contextmanager
def _fitting(what: str) -> Iterator[None]:
    """Raises ConfigError for views that can't be fitted."""
    try:
        yield
    except BundleError as why:
        raise ConfigError.plain(str(why)) from why
    except (np.linalg.LinAlgError, cv2.error) as why:
        text = f"the views of {what} can't be fitted together ({why}): look whether each picture"
        raise ConfigError.plain(f"{text} shows the board, and each pair one pose") from why


@_fitting("the cameras")
def calibrate_pair(
    views: BoardViews, *, model: str = "k1 k2 p1 p2", square_pixels: bool = False
) -> CamerasResult:
    """The whole job, with a lens ``model`` of `LENS_MODELS`. Raises ConfigError."""
    if model not in LENS_MODELS:
        raise ConfigError.plain(f"model is {model!r}, not one of: {', '.join(LENS_MODELS)}")
    refuse_missing(views, *PAIR)
    seen = {camera: views.views(camera) for camera in PAIR}
    size = views.image_size
    lens: dict[str, Any] = {"model": model, "square_pixels": square_pixels}
    alone = {name: calibrate_camera(name, seen[name], size[name], **lens) for name in PAIR}
    joint = join_cameras(alone, joint_lenses=PAIR, **lens)
    shown = {camera: _shown(views, camera, alone[camera]) for camera in PAIR}
    pairs, pair = views.pairs(), pair_of(joint)
    halves = held_out = None
    if len(pairs) >= LEAST_FOR_HALVES:
        try:
            halves = split_half(seen, size["left"], **lens)
        except TooFewViewsError:
            pass
        else:  # each half of the views measured with the calibration that the other half made
            first, second = (
                remeasure(halves.pairs[1 - start], views.board, pairs[start::2]) for start in (0, 1)
            )
            held_out = MeasuredBoard(views.board, (*first.views, *second.views))
    found = _units(views.board, shown, pair.right_from_left)
    found += swapped(pair.right_from_left)
    if not found:
        used = remeasure(pair, views.board, pairs)
        found += measured_again(held_out or used, pair)
        found += [] if any(finding.name == "bent board" for finding in found) else bent(used)
    for camera in PAIR:
        found += outlier_views(joint.view_rms_px(camera), camera)
    fixed = join_cameras(alone)
    return CamerasResult(views, alone, fixed, joint, shown, halves, held_out, tuple(found))


def _units(board: Board, shown: Mapping[str, Coverage], right_from_left: Motion) -> list[Finding]:
    """Whether the board's file is in another unit: it then stood where no board can be held."""
    spans = [each.distances_mm for each in shown.values() if each.distances_mm]
    near, far = min(low for low, _ in spans), max(high for _, high in spans)
    baseline_mm = float(np.linalg.norm(right_from_left.T))
    factor = 10.0 if far < HELD_MM[0] else 0.1 if near > HELD_MM[1] else None
    if factor is None:
        return []
    said = (
        f"by its file, with points {board.pitch_mm:g} mm apart, the board was {near:.0f} to"
        f" {far:.0f} mm away and the baseline is {baseline_mm:.4g} mm: are the points"
        f" {factor * board.pitch_mm:g} mm apart?"
    )
    return [Finding("wrong unit", said)]


def _shown(views: BoardViews, camera: str, alone: CameraFit) -> Coverage:
    pixels = [view.pixels_px for view in views.views(camera)]
    return coverage(pixels, views.image_size[camera], alone.fit.poses)


def check_pair(part: Part, views: BoardViews) -> tuple[MeasuredBoard, tuple[Finding, ...]]:
    """The board measured with the pair, and findings. Raises ConfigError without pair or view."""
    pair = replace(pair_of_part(part), world_from_right=Motion.identity())
    refuse_missing(views, *PAIR)
    for camera, lens in (("left", pair.left), ("right", pair.right)):
        sizes = views.image_size[camera], lens.image_size
        if sizes[0] != sizes[1]:
            seen, known = ("{} x {}".format(*size) for size in sizes)
            raise ConfigError.plain(
                f"the {camera} pictures are {seen} px, the calibration is for {known}: made for"
                " other cameras"
            )
    pairs = views.pairs()
    if not pairs:
        raise ConfigError.plain(
            "the board was found in no view of both cameras: is the board the one in the pictures,"
            " and all of it in view of both?"
        )
    again = remeasure(pair, views.board, pairs)
    return again, tuple(measured_again(again, pair))


@dataclass(frozen=True, slots=True)
class ThermalFormat:
    """How the thermal camera's picture comes: what a picture alone doesn't show."""

    sensor_size: tuple[int, int] = (160, 120)
    mirrored: bool = False
    polarity: Polarity = "hot_is_white"
    model: str = "k1"

    def camera(self, size: tuple[int, int], lens: Camera | None) -> ThermalCamera:
        return ThermalCamera(size, self.sensor_size, self.mirrored, self.polarity, lens)


def delivered_by(rig: AnyRig) -> ThermalFormat:
    """How a rig's thermal pictures come, by its calibration, else by its file."""
    rig = any_rig(rig)
    if rig.made_calibration is not None:
        known = rig.made_calibration.thermal
        return ThermalFormat(known.sensor_size, known.mirrored, known.polarity)
    table = rig.rig.cameras.thermal
    if table is None:
        return ThermalFormat()
    return ThermalFormat(mirrored=bool(table.mirrored), polarity=table.polarity or "hot_is_white")


@dataclass(frozen=True, slots=True, eq=False)
class ThermalResult:
    """The thermal camera, its pose, and the homographies at ``plane_depth_mm``."""

    views: BoardViews
    camera: ThermalCamera
    thermal_from_left: Motion
    homographies: Homographies
    alone: CameraFit
    joint: CameraFit
    coverage: Coverage

    def part(self, record: Record) -> Part:
        return Part(
            thermal=self.camera,
            thermal_from_left=self.thermal_from_left,
            homographies=self.homographies,
            covariance=_covariance(self.joint, "thermal pose"),
            record=record,
        )


@_fitting("the thermal camera")
def calibrate_thermal(
    views: BoardViews,
    cameras: Part,
    delivered: ThermalFormat,
    plane_depth_mm: float = DEFAULT_PLANE_DEPTH_MM,
) -> ThermalResult:
    """The third camera against a pair, by un-mirrored pictures. Raises ConfigError."""
    pair, size = pair_of_part(cameras), views.image_size.get("thermal", (0, 0))
    refuse_missing(views, "left", "thermal")
    alone = calibrate_camera("thermal", views.views("thermal"), size, model=delivered.model)
    both = {"left": place_board("left", views.views("left"), pair.left), "thermal": alone}
    joint = join_cameras(both, joint_lenses=("thermal",), model=delivered.model)
    lens, pose = joint.fit.rig.cameras["thermal"], joint.fit.rig.from_reference["thermal"]
    poses = pose, pair.right_from_left
    if joint.fit.rms_px > size[0] / delivered.sensor_size[0]:
        what = f"corners miss by {joint.fit.rms_px:.1f} px, more than a pixel of the thermal sensor"
        raise ConfigError.plain(f"{what}: do its pictures come mirrored (`mirrored`), or not?")
    maps = derive_homographies(lens, pair.left, pair.right, *poses, plane_depth_mm)
    given = views, delivered.camera(size, lens), pose, maps, alone, joint
    return ThermalResult(*given, _shown(views, "thermal", alone))


@dataclass(frozen=True, slots=True, eq=False)
class PairsResult:
    """Homographies from point pairs, for a rig whose thermal camera has no pose."""

    left: MappedPairs
    right: MappedPairs

    def part(self, image_size: tuple[int, int], delivered: ThermalFormat, record: Record) -> Part:
        return Part(
            thermal=delivered.camera(image_size, None),
            homographies=Homographies(self.left.H, self.right.H, None),
            record=record,
        )


def map_pairs(path: Path | str) -> PairsResult:
    """From a table of point pairs (`PAIR_COLUMNS`, px; thermal un-mirrored). Raises ConfigError."""
    thermal, left, right = np.split(np.array([*read_table(path, PAIR_COLUMNS).values()]).T, 3, 1)
    try:
        return PairsResult(fit_homography(thermal, left), fit_homography(thermal, right))
    except ValueError as error:
        raise ConfigError.plain(f"{path}: {error}") from error
