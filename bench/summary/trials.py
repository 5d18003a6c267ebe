"""The report's part for each trial: its frames with what is drawn over them, its teats, its readings."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.record import RunRecord, TrialRecord
from bench.scoring.scene import SceneScore
from bench.store import Picture, png_bytes, write_synced
from bench.summary.bath import surface_at, surface_told
from bench.summary.truth import trial_truth
from bench.summary.wording import number
from detector.calibration import Calibration
from reports.page import Cell, Circle, Column, Cross, ImageView, Label, Overlay, Rect, Shape, Table, Tone, TrialPart

JPEG_QUALITY = 80
MARGIN_PX = 90  # round the teats, in the enlarged view of the optical frames
CAMERAS = ("left", "right", "thermal")
Points = NDArray[np.float64]


def trial_id(trial: TrialRecord) -> str:
    """The anchor of a trial's part of the page."""
    return f"trial-{int(trial.head['number']):03d}"


def trial_parts(run: RunRecord, calibration: Calibration, folder: Path) -> Iterator[TrialPart]:
    """A part a trial; its pictures are written into ``folder``/images."""
    for trial in run.trials:
        yield _part(run, trial, calibration, folder)


def trial_table(run: RunRecord) -> Table:
    """All trials with links to their parts."""
    columns = (
        Column("trial"), Column("situation"), Column("detector"),
        Column("found", "right"), Column("missed", "right"), Column("false", "right"),
        Column("max error", "right", "mm"), Column("time", "right", "s"), Column("scene"),
    )  # fmt: skip
    rows = []
    for trial in run.trials:
        for detection in trial.detections:
            score = trial.scores.get(detection["detector"])
            worst = max(score.radial_mm, default=None) if score else None
            counts = score.counts if score else None
            seconds = detection["wall_seconds"]
            rows.append(
                (
                    Cell(trial.id, href=f"#{trial_id(trial)}"),
                    str(trial.head["situation"]),
                    str(detection["detector"]),
                    f"{counts.matched} of {counts.visible}" if counts else "not scored",
                    str(counts.missed) if counts else "",
                    str(counts.false) if counts else "",
                    Cell(number(worst), sort=worst),
                    Cell(f"{seconds:.3f}", sort=seconds),
                    _told(trial, score)[0],
                )
            )
    return Table("All trials", columns, tuple(rows), searchable=True)


def _part(run: RunRecord, trial: TrialRecord, calibration: Calibration, folder: Path) -> TrialPart:
    scores = list(trial.scores.values())
    statuses = [_told(trial, score) for score in scores] or [_told(trial, None)]
    status, tone = next((s for s in statuses if s[1] == "bad"), statuses[0])
    head = trial.head
    summary = (
        ("situation", str(head["situation"])),
        ("repeat", str(head["repeat"])),
        ("bath at capture", number(head["bath_c"], "°C") + (f", {head['bath_state']}" if head["bath_state"] else "")),
        ("teats' surface", surface_told(surface_at(run, trial))),
        *((f"time, {d['detector']}", f"{d['wall_seconds']:.3f} s") for d in trial.detections),
        *((f"hidden, {d['detector']}", f"claims {d['hidden']}") for d in trial.detections),
    )
    notes = tuple(f"{d['detector']}: {d['reason']}" for d in trial.detections if d["reason"])
    notes = (f"In no count: {trial.invalid}", *notes) if trial.invalid else notes
    budget = trial_truth(trial)
    return TrialPart(
        id=trial_id(trial),
        heading=trial.id,
        situation=str(head["situation"]),
        status=status,
        tone=tone,
        summary=summary,
        images=tuple(_images(run, trial, calibration, folder)),
        tables=(*(_teats(trial, d["detector"]) for d in trial.detections), *((budget,) if budget else ())),
        notes=notes,
    )


def _told(trial: TrialRecord, score: SceneScore | None) -> tuple[str, Tone]:
    return ("invalidated", "warn") if trial.invalid else _status(score)


def _status(score: SceneScore | None) -> tuple[str, Tone]:
    if score is None:
        return "not scored", "muted"
    if score.success:
        return "scene success", "good"
    counts = score.counts
    parts = [f"{counts.missed} missed" if counts.missed else "", f"{counts.false} false" if counts.false else ""]
    parts += ["beyond the limit" if any(d > score.limit_mm for d in score.radial_mm) else "", "" if score.in_time else "too slow"]
    return ", ".join(part for part in parts if part), "bad"


def _teats(trial: TrialRecord, detector: str) -> Table:
    """Truth and answer side by side; false answers below."""
    score = trial.scores.get(detector)
    found = [row for row in trial.found if row["detector"] == detector]
    columns = (
        Column("teat"), Column("truth x, y, z", "right", "mm"), Column("u", "right", "mm"), Column("found x, y, z", "right", "mm"),
        Column("dx", "right", "mm"), Column("dy", "right", "mm"), Column("dz", "right", "mm"),
        Column("distance", "right", "mm"), Column("is"),
    )  # fmt: skip
    pairs = {truth: (answer, k) for k, (answer, truth) in enumerate(score.match.pairs)} if score else {}
    rows: list[tuple[str | Cell, ...]] = []
    for index, row in enumerate(trial.truth):
        place, u = _xyz(row), "" if row["u_mm"] is None else f"{row['u_mm']:.2f}"
        if score and index in pairs:
            answer, k = pairs[index]
            distance = score.radial_mm[k]
            word = Cell("found", "good") if distance <= score.limit_mm else Cell("found, beyond the limit", "warn")
            rows.append(
                (str(row["teat"]), place, u, _xyz(found[answer]), *(f"{e:+.2f}" for e in score.errors_mm[k]), f"{distance:.2f}", word)
            )
        else:
            rows.append(
                (str(row["teat"]), place, u, "", "", "", "", "", Cell("missed", "bad") if row["visible"] else Cell("hidden", "muted"))
            )
    for answer in score.match.false if score else range(len(found)):
        rows.append(("", "", "", _xyz(found[answer]), "", "", "", "", Cell("false", "bad") if score else Cell("not scored", "muted")))
    return Table(f"Teat ends, detector {detector}", columns, tuple(rows))


def _xyz(row: Mapping[str, Any]) -> str:
    return f"{row['x_mm']:.1f}, {row['y_mm']:.1f}, {row['z_mm']:.1f}"


def _images(run: RunRecord, trial: TrialRecord, calibration: Calibration, folder: Path) -> Iterator[ImageView]:
    truth = project_all(calibration, np.array([[r["x_mm"], r["y_mm"], r["z_mm"]] for r in trial.truth]).reshape(-1, 3))
    paths = {row["camera"]: row["path"] for row in trial.frames}
    for camera in CAMERAS:
        if camera not in paths:
            continue
        image = _grey(run.folder / paths[camera])
        if image is None:
            continue  # the store's check names a frame that is gone; the page does without
        if camera == "thermal" and calibration.thermal.mirrored:
            image = np.ascontiguousarray(image[:, ::-1])  # as the detector and the overlays count
        height, width = image.shape
        name = f"images/{trial.id}-{camera}.jpg"
        _write_jpeg(folder / name, image)
        points = truth[camera]
        label = f"{camera}, un-mirrored" if camera == "thermal" and calibration.thermal.mirrored else camera
        yield ImageView(
            label=label,
            src=name,
            width=width,
            height=height,
            alt=f"{label} frame of trial {trial.id}",
            overlays=tuple(_overlays(trial, camera, points)),
            view_box=None if camera == "thermal" else _round_teats(points, width, height),
            original=f"../{paths[camera]}",
        )
    for detection in trial.detections:
        yield from _stage_image(run, trial, detection["detector"], folder)


def _stage_image(run: RunRecord, trial: TrialRecord, detector: str, folder: Path) -> Iterator[ImageView]:
    """The detector's edge picture, where it has one, with the points that were taken from it."""
    path = next((row["path"] for row in trial.frames if row["camera"] == f"{detector}-edges"), None)
    detection = next(d for d in trial.detections if d["detector"] == detector)
    image = None if path is None else _grey(run.folder / path)
    if path is None or image is None:
        return
    name = f"images/{trial.id}-{detector}-edges.png"
    write_synced(folder / name, png_bytes(255 - image))
    trace = json.loads(detection["trace"])
    points = [(stage, p) for stage in ("vertical ends", "horizontal middles") for p in _points(trace, stage, "points_px")]
    overlays = [Overlay("other", "line ends and middles", tuple(Circle(p[0], p[1], 4, stage) for stage, p in points))]
    ends = _points(trace, "teat ends", "points_px")
    overlays.append(Overlay("nomination", "thermal nomination", tuple(Cross(x, y, 6, title="nominated") for x, y in ends)))
    label = f"{detector}: edges in the thermal frame"
    height, width = image.shape
    alt = f"{label}, trial {trial.id}"
    yield ImageView(label, name, width, height, alt, tuple(o for o in overlays if o.shapes), original=f"../{path}")


def project_all(calibration: Calibration, world_mm: Points) -> dict[str, Points | None]:
    """Pixels (n, 2) of world points (n, 3) in each camera; None for a thermal camera without a pose. Thermal ones are un-mirrored."""
    left, right = calibration.project(world_mm)
    in_right = calibration.world_from_right.inverse().apply(world_mm)
    lens, pose = calibration.thermal.lens, calibration.thermal_from_right
    return {"left": left, "right": right, "thermal": lens.project(pose.apply(in_right)) if lens and pose else None}


def _overlays(trial: TrialRecord, camera: str, truth: Points | None) -> Iterator[Overlay]:
    if truth is not None and len(truth):
        marks = [(row, point) for row, point in zip(trial.truth, truth, strict=True) if np.isfinite(point).all()]
        rings: list[Shape] = [Circle(p[0], p[1], 7, f"truth {r['teat']}{'' if r['visible'] else ' (hidden)'}") for r, p in marks]
        yield Overlay("truth", "truth", (*rings, *(Label(p[0] + 9, p[1] - 5, str(r["teat"])) for r, p in marks)))
    for detection in trial.detections:
        trace = json.loads(detection["trace"])
        if camera == "thermal":
            nominated = _points(trace, "teat ends", "points_px")
        else:
            nominated = _points(trace, "nominations", f"{camera}_px")
            yield from _regions(trace, camera, nominated)
        if len(nominated):
            yield Overlay("nomination", "thermal nomination", tuple(Cross(x, y, 6, title="nominated") for x, y in nominated))
        if camera != "thermal":
            yield from _final(trial, detection["detector"], camera)


def _regions(trace: Mapping[str, Any], camera: str, nominated: Points) -> Iterator[Overlay]:
    region = trace.get("regions", {}).get(camera)
    if isinstance(region, dict) and len(nominated):
        rows, columns = region["shape"][-2:]
        boxes = [Rect(np.round(x) - columns / 2, np.round(y) - rows / 2, columns, rows, "search region") for x, y in nominated]
        yield Overlay("region", "region", tuple(boxes))


def _final(trial: TrialRecord, detector: str, camera: str) -> Iterator[Overlay]:
    ends = [json.loads(row[f"{camera}_px"]) for row in trial.found if row["detector"] == detector and row[f"{camera}_px"]]
    if ends:
        yield Overlay("point", "final point", tuple(Cross(x, y, 6, turned=True, title=f"{detector}: end") for x, y in ends))


def _points(trace: Mapping[str, Any], stage: str, key: str) -> Points:
    value = trace.get(stage, {}).get(key)
    points = np.array(value if isinstance(value, list) else [], dtype=np.float64).reshape(-1, 2)
    return points[np.isfinite(points).all(axis=1)]


def _round_teats(points: Points | None, width: int, height: int) -> tuple[int, int, int, int] | None:
    """A 4:3 part of the frame with the teat ends and what hangs on them; the whole frame where none is in it."""
    if points is None or not len(points) or not np.isfinite(points).all():
        return None
    low, high = points.min(axis=0) - MARGIN_PX, points.max(axis=0) + MARGIN_PX
    view_width = int(min(width, max(high[0] - low[0], (high[1] - low[1]) * 4 / 3)))
    view_height = int(min(height, view_width * 3 / 4))
    middle = (low + high) / 2
    x = int(np.clip(middle[0] - view_width / 2, 0, width - view_width))
    y = int(np.clip(middle[1] - view_height / 2, 0, height - view_height))
    return x, y, view_width, view_height


def _grey(path: Path) -> NDArray[np.uint8] | None:
    """A frame as 8-bit grey; None where it is gone. Read through memory: OpenCV opens only ASCII paths on Windows."""
    if not path.is_file():
        return None
    image = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_GRAYSCALE)
    return None if image is None else np.asarray(image, dtype=np.uint8)


def _write_jpeg(path: Path, image: Picture) -> None:
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise ValueError(f"OpenCV can't write {path} as JPEG")
    write_synced(path, bytes(data))
