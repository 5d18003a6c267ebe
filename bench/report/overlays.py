"""What is drawn over the frames of a trial: truth, stages of the detector, found points with their
confidence regions.

Any stage of a trace with `left_px`, `right_px` or `thermal_px` (n, 2) is drawn by its name; the
stages that only the bench's own detectors have are read by their names. Coordinates are the image's
pixels.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.record.reader import TrialRecord
from bench.record.schema import Row
from detector.calibration import Calibration
from detector.fused.model import COUNT, Outline, contours, pixels_of
from detector.geometry import Motion
from reports.frames import Circle, Cross, Ellipse, Label, LayerTone, Overlay, Polyline, Rect, Shape

Points = NDArray[np.float64]
Project = Callable[[Points], Points]

# 95 % of a plane's normal distribution lies within this Mahalanobis distance squared
CHI2_95_OF_2 = 5.991
OUTLINE = Outline.of(60.0, 4, 9)  # of a model, as far as it is drawn
STEP_MM = 0.05  # for the slope of a projection
NAMES: dict[LayerTone, str] = {
    "truth": "truth",
    "nomination": "thermal nomination",
    "region": "search region",
    "point": "final point",
    "model": "fitted model",
    "spread": "95 % region stated",
    "other": "other stages",
}
FINAL = {"ends"}  # stages that repeat the answer


def project_all(calibration: Calibration, world_mm: Points) -> dict[str, Points | None]:
    """Pixels (n, 2) of world points (n, 3) by camera, thermal un-mirrored; None without a pose."""
    left, right = calibration.project(world_mm)
    in_right = calibration.world_from_right.inverse().apply(world_mm)
    lens, pose = calibration.thermal.lens, calibration.thermal_from_right
    return {
        "left": left,
        "right": right,
        "thermal": lens.project(pose.apply(in_right)) if lens and pose else None,
    }


def overlays(
    trial: TrialRecord, camera: str, truth_px: Points | None, calibration: Calibration
) -> tuple[Overlay, ...]:
    """All layers over one camera's frame; ``truth_px`` (n, 2) is the truth in its pixels."""
    shapes: dict[LayerTone, list[Shape]] = {tone: [] for tone in NAMES}
    shapes["truth"] += _truth(trial, truth_px)
    for detection in trial.detections:
        trace, name = json.loads(detection["trace"]), str(detection["detector"])
        for tone, shape in (
            *_stages(trace, camera, name),
            *_models(trace, camera, calibration, name),
        ):
            shapes[tone].append(shape)
        for row in trial.found:
            if row["detector"] == name:
                shapes["point"] += _final(row, camera)
                shapes["spread"] += _spread(row, camera, calibration)
    return tuple(
        Overlay(tone, NAMES[tone], tuple(found)) for tone, found in shapes.items() if found
    )


def stage_overlays(detection: Row) -> tuple[Overlay, ...]:
    """Over the thesis's picture of edges: the points taken from it, and those nominated."""
    trace = json.loads(detection["trace"])
    taken = [
        (stage, p)
        for stage in ("vertical ends", "horizontal middles")
        for p in points_of(trace, stage, "points_px")
    ]
    other = Overlay(
        "other", NAMES["other"], tuple(Circle(p[0], p[1], 4, stage) for stage, p in taken)
    )
    ends = points_of(trace, "teat ends", "points_px")
    nominated = Overlay(
        "nomination", NAMES["nomination"], tuple(Cross(x, y, 6, title="nominated") for x, y in ends)
    )
    return tuple(layer for layer in (other, nominated) if layer.shapes)


def points_of(trace: Mapping[str, Any], stage: str, key: str) -> Points:
    """The finite points (n, 2) of a stage; none where it has no such thing."""
    points = _rows(trace.get(stage, {}).get(key), 2)
    return points[np.isfinite(points).all(axis=1)]


def _rows(value: Any, width: int) -> Points:
    """A stage's numbers as rows (n, width); none where they have another shape."""
    try:
        array = np.array(value if isinstance(value, list) else [], dtype=np.float64)
    except (TypeError, ValueError):  # text, or rows of different lengths
        return np.empty((0, width))
    return array.reshape(-1, width) if array.size % width == 0 else np.empty((0, width))


def _truth(trial: TrialRecord, at: Points | None) -> Iterator[Shape]:
    if at is None:
        return
    for row, (x, y) in zip(trial.truth, at, strict=True):
        if np.isfinite([x, y]).all():
            yield Circle(x, y, 7, f"truth {row['teat']}{'' if row['visible'] else ' (hidden)'}")
            yield Label(x + 9, y - 5, str(row["teat"]))


def _stages(
    trace: Mapping[str, Any], camera: str, detector: str
) -> Iterator[tuple[LayerTone, Shape]]:
    """Points of stages in this camera's picture; the thesis's own stages by their names."""
    for stage in trace:
        tone: LayerTone = "nomination" if stage == "nominations" else "other"
        if stage not in FINAL:
            for x, y in points_of(trace, stage, f"{camera}_px"):
                yield tone, Cross(x, y, 6, title=f"{detector}: {stage}")
    if camera == "thermal":
        for x, y in points_of(trace, "teat ends", "points_px"):
            yield "nomination", Cross(x, y, 6, title=f"{detector}: nominated")
        return
    region = trace.get("regions", {}).get(camera)
    if isinstance(region, dict) and len(region["shape"]) >= 2:
        rows, columns = region["shape"][-2:]
        for x, y in points_of(trace, "nominations", f"{camera}_px"):
            yield (
                "region",
                Rect(
                    np.round(x) - columns / 2,
                    np.round(y) - rows / 2,
                    columns,
                    rows,
                    f"{detector}: search region",
                ),
            )


def _models(
    trace: Mapping[str, Any], camera: str, calibration: Calibration, detector: str
) -> Iterator[tuple[LayerTone, Shape]]:
    """The outlines of fused's fitted teats (right camera), reasons of rejection, thermal ends."""
    if camera == "thermal":
        yield from _warm_ends(trace, calibration, detector)
    decided = trace.get("decisions", {})
    teats = _rows(decided.get("teats"), COUNT)
    reasons = decided.get("reasons") if isinstance(decided.get("reasons"), list) else []
    if not len(teats):
        return
    lens, motion = _seen_by(camera, calibration)
    if lens is None or motion is None:
        return
    for line, reason in zip(
        pixels_of(contours(teats, motion, OUTLINE).points, lens), reasons, strict=False
    ):
        if np.isfinite(line).all():
            told = f"{detector}: rejected, {reason}" if reason else f"{detector}: fitted teat"
            tone: LayerTone = "other" if reason else "model"
            yield tone, Polyline(tuple((float(x), float(y)) for x, y in line), title=told)


def _seen_by(camera: str, calibration: Calibration) -> tuple[Any, Motion | None]:
    """Lens of a camera, and its frame from the right camera's."""
    return {
        "left": (calibration.left, calibration.right_from_left.inverse()),
        "right": (calibration.right, Motion.identity()),
        "thermal": (calibration.thermal.lens, calibration.thermal_from_right),
    }[camera]


def _warm_ends(
    trace: Mapping[str, Any], calibration: Calibration, detector: str
) -> Iterator[tuple[LayerTone, Shape]]:
    """fused nominates in the sensor's pixels, of which the picture may have several each."""
    size = calibration.thermal.image_size[0] / calibration.thermal.sensor_size[0]
    for what in ("end", "bar"):
        for x, y in points_of(trace, "thermal", f"{what}_px"):
            yield (
                "nomination",
                Cross(
                    (x + 0.5) * size - 0.5,
                    (y + 0.5) * size - 0.5,
                    6,
                    title=f"{detector}: warm {what}",
                ),
            )


def _final(row: Row, camera: str) -> Iterator[Shape]:
    at = row.get(f"{camera}_px")
    if at:
        x, y = json.loads(at)
        if np.isfinite([x, y]).all():
            yield Cross(x, y, 6, turned=True, title=f"{row['detector']}: end")


def _spread(row: Row, camera: str, calibration: Calibration) -> Iterator[Shape]:
    """The stated covariance in this camera: an ellipse for 95 % of cases."""
    if row["covariance_mm2"] is None:
        return
    end = np.array([row["x_mm"], row["y_mm"], row["z_mm"]])
    around = np.vstack([end, end + STEP_MM * np.eye(3), end - STEP_MM * np.eye(3)])
    seen = project_all(calibration, around)[camera]
    covariance = np.array(json.loads(row["covariance_mm2"]), dtype=np.float64)
    if (
        seen is None
        or not np.isfinite(seen).all()
        or covariance.shape != (3, 3)
        or not np.isfinite(covariance).all()
    ):
        return
    slope = (seen[1:4] - seen[4:7]).T / (2 * STEP_MM)  # px / mm, (2, 3)
    sizes, directions = np.linalg.eigh(slope @ covariance @ slope.T)
    minor, major = np.sqrt(CHI2_95_OF_2 * np.clip(sizes, 0.0, None))
    turn_deg = np.degrees(np.arctan2(directions[1, 1], directions[0, 1]))
    told = f"{row['detector']}: stated 95 % region, {major:.1f} by {minor:.1f} px"
    yield Ellipse(
        float(seen[0, 0]), float(seen[0, 1]), float(major), float(minor), float(turn_deg), told
    )
