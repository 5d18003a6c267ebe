"""The pictures of a trial for the report: JPEG of the frames, cut to the teats at first sight, with
overlays. They can be made again at any time, so nothing is synced to the disk.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.record.reader import RunRecord, TrialRecord
from bench.report.overlays import Points, overlays, project_all, stage_overlays
from detector.calibration import Calibration
from reports.frames import ImageView

JPEG_QUALITY = 80
MARGIN_PX = 90  # round the teats, in the enlarged view of the optical frames
CAMERAS = ("left", "right", "thermal")
IMAGES = "images"


def pictures(
    run: RunRecord, trial: TrialRecord, calibration: Calibration, folder: Path
) -> Iterator[ImageView]:
    """Every view of a trial; its files are written into ``folder``/images, which must be there."""
    truth = project_all(
        calibration,
        np.array([[r["x_mm"], r["y_mm"], r["z_mm"]] for r in trial.truth]).reshape(-1, 3),
    )
    paths = {row["camera"]: row["path"] for row in trial.frames}
    for camera in CAMERAS:
        image = grey(run.folder / paths[camera]) if camera in paths else None
        if image is None:
            continue  # the store's check names a frame that is gone; the page does without
        mirrored = camera == "thermal" and calibration.thermal.mirrored
        if mirrored:
            image = np.ascontiguousarray(image[:, ::-1])  # as the detector and the overlays count
        name = f"{IMAGES}/{trial.id}-{camera}.jpg"
        (folder / name).write_bytes(_jpeg(image, name))
        height, width = image.shape
        points = truth[camera]
        label = f"{camera}, un-mirrored" if mirrored else camera
        yield ImageView(
            label=label,
            src=name,
            width=width,
            height=height,
            alt=f"{label} frame of trial {trial.id}",
            overlays=overlays(trial, camera, points, calibration),
            view_box=None if camera == "thermal" else round_teats(points, width, height),
            original=f"../{paths[camera]}",
        )
    for detection in trial.detections:
        yield from _edges(run, trial, str(detection["detector"]), folder)


def _edges(run: RunRecord, trial: TrialRecord, detector: str, folder: Path) -> Iterator[ImageView]:
    """The detector's edge picture, where it has one, with the points that were taken from it."""
    path = next((row["path"] for row in trial.frames if row["camera"] == f"{detector}-edges"), None)
    image = None if path is None else grey(run.folder / path)
    if path is None or image is None:
        return
    name = f"{IMAGES}/{trial.id}-{detector}-edges.png"
    done, data = cv2.imencode(".png", 255 - image, [cv2.IMWRITE_PNG_BILEVEL, 1])
    if not done:
        raise ValueError(f"OpenCV can't write {name} as PNG")
    (folder / name).write_bytes(bytes(data))
    detection = next(d for d in trial.detections if d["detector"] == detector)
    height, width = image.shape
    label = f"{detector}: edges in the thermal frame"
    yield ImageView(
        label,
        name,
        width,
        height,
        f"{label}, trial {trial.id}",
        stage_overlays(detection),
        original=f"../{path}",
    )


def round_teats(points: Points | None, width: int, height: int) -> tuple[int, int, int, int] | None:
    """A 4:3 part of the frame around the teat ends; the whole frame where it has none."""
    if (
        points is None
        or not np.isfinite(points).all()
        or not ((points >= 0) & (points < (width, height))).all(axis=1).any()
    ):
        return None
    low, high = points.min(axis=0) - MARGIN_PX, points.max(axis=0) + MARGIN_PX
    view_width = int(min(width, max(high[0] - low[0], (high[1] - low[1]) * 4 / 3)))
    view_height = int(min(height, view_width * 3 / 4))
    if min(view_width, view_height) < 1:  # a frame of a few pixels has no part
        return None
    middle = (low + high) / 2
    x = int(np.clip(middle[0] - view_width / 2, 0, width - view_width))
    y = int(np.clip(middle[1] - view_height / 2, 0, height - view_height))
    return x, y, view_width, view_height


def grey(path: Path) -> NDArray[np.uint8] | None:
    """A frame as 8-bit grey or None; read through memory: OpenCV wants ASCII paths on Windows."""
    if not path.is_file():
        return None
    data = np.frombuffer(path.read_bytes(), np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if data.size else None
    return None if image is None else np.asarray(image, dtype=np.uint8)


def _jpeg(image: NDArray[np.uint8], name: str) -> bytes:
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise ValueError(f"OpenCV can't write {name} as JPEG")
    return bytes(data)
