"""The report's part for each trial: pictures, teats, readings; and which trials are the worst.

The pictures are the record's own frames, cut to the teats at first sight, with truth, the
detector's stages and found points over them. Any stage of a trace with `left_px`, `right_px` or
`thermal_px` (n, 2) is drawn by its name. Coordinates are the image's pixels. Depth frames, and what
may be printed or mailed, are JPEG copies; they can be made again at any time, so nothing is synced
to the disk.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.record.reader import RunRecord, TrialRecord, points_mm
from bench.record.recording import png_size
from bench.record.schema import Row
from bench.report.bath import capture_text, surface_at, surface_text
from bench.report.tables import covariance_of
from bench.report.truth import trial_truth
from bench.report.wording import number, table, xyz
from bench.results.verdicts import Judgement
from bench.scoring.decisions import Verdict
from bench.scoring.errors import Floats
from bench.scoring.scene import SceneScore
from detector.calibration import Calibration
from detector.geometry import Camera, Motion
from detector.outline.model import COUNT, Outline, numbers_of, outlines
from detector.protocol import Outcome
from instruments.world.situations import spoken
from reports.frames import (
    Circle,
    Cross,
    Ellipse,
    ImageView,
    Label,
    LayerTone,
    Overlay,
    Polyline,
    Rect,
    Shape,
    answer_mark,
    places_of,
)
from reports.page import Cell, Highlight, KeyValues, Result, Table, Tone, TrialPart

DECIDED = (Verdict.MET, Verdict.NOT_MET)
MOST_WORST = 60
NTH = ("Worst", "Second worst", "Third worst")  # looked at, and a typical one
CUT_WIDTH_PX, CUT_MARGIN_PX = 640, 22  # what is shown round the teats on the first page
FIRST_LOOKS = 9


def trial_id(trial: TrialRecord) -> str:
    """The anchor of a trial's part of the page."""
    return f"trial-{int(trial.head['number']):03d}"


def anchors_of(run: RunRecord) -> dict[str, str]:
    """Each trial's link by its id."""
    return {trial.id: f"#{trial_id(trial)}" for trial in run.trials}


def trial_part(
    run: RunRecord,
    trial: TrialRecord,
    calibration: Calibration,
    folder: Path,
    up: str = "../",
    copied: Collection[str] | None = None,
) -> TrialPart:
    """A trial's part for a page in ``folder``, from which ``up`` leads to the run's. The frames of
    the trials ``copied``, by default of all, are written into ``folder``/images.
    """
    head, detections, budget = trial.head, trial.detections, trial_truth(trial)
    notes = [f"In no count: {trial.invalid}"] if trial.invalid else []
    notes += [f"Note: {head['note']}"] if head["note"] else []
    return TrialPart(
        id=trial_id(trial),
        heading=trial.id,
        situation=spoken(head["situation"]),
        results=_results(trial),
        summary=(
            ("situation", spoken(head["situation"])),
            ("repeat", str(head["repeat"])),
            ("bath at capture", capture_text(run, trial)),
            ("teats' surface", surface_text(surface_at(run, trial))),
            *((f"time, {d['detector']}", _time_text(d)) for d in detections),
            *((f"hidden, {d['detector']}", f"claims {d['hidden']}") for d in detections),
        ),
        images=tuple(_pictures(run, trial, calibration, (folder, up), copied)),
        tables=(*(_teats(trial, d["detector"]) for d in detections), *([budget] if budget else [])),
        notes=(*notes, *(note for d in detections for note in _notes(d))),
    )


def undecided_of(judgements: Sequence[Judgement]) -> frozenset[str]:
    """The detectors on which the run has shown too little: their failures are looked at first."""
    return frozenset(one.detector for one in judgements if one.verdict not in DECIDED)


def _fault(trial: TrialRecord, name: str) -> tuple[bool, int, float]:
    """How wrong a detector was: failed at all, then by missed and false, by its largest error."""
    score = trial.scores.get(name)
    if score is None:
        return False, -1, 0.0
    wrong = score.counts.missed + score.counts.false
    return not score.success, wrong, max(score.radial_mm, default=0.0)


def _worst_first(trials: Iterable[TrialRecord], name: str) -> list[TrialRecord]:
    """Failures before successes; of both each pose's worst trial, then each one's second, since
    repeats of a pose look alike.
    """
    seen, turns = Counter[tuple[bool, str]](), []
    for trial in sorted(trials, key=lambda trial: _fault(trial, name), reverse=True):
        success = trial.scores[name].success if name in trial.scores else True
        turns.append((success, seen[success, trial.pose], trial))
        seen[success, trial.pose] += 1
    return [trial for *_, trial in sorted(turns, key=lambda turn: turn[:2])]


def failures_in_turn(
    run: RunRecord, undecided: Collection[str] = ()
) -> tuple[tuple[TrialRecord, str], ...]:
    """The failed trials, each detector's own in turn, worst first; ``undecided`` ones' before."""
    ranks = []
    for name in sorted(run.detectors, key=lambda name: name not in undecided):
        own = [t for t in run.counted if name in t.scores and not t.scores[name].success]
        ranks.append([(trial, name) for trial in _worst_first(own, name)])
    found: dict[str, tuple[TrialRecord, str]] = {}
    while any(ranks):
        for rank in ranks:
            while rank and rank[0][0].id in found:
                del rank[0]
            if rank:
                found[rank[0][0].id] = rank[0]
    return tuple(found.values())[:MOST_WORST]


def worst_trials(run: RunRecord, undecided: Collection[str] = ()) -> tuple[TrialRecord, ...]:
    """The failed trials in the order of ``failures_in_turn``."""
    return tuple(trial for trial, _ in failures_in_turn(run, undecided))


def first_trials(
    run: RunRecord, undecided: Collection[str] = ()
) -> dict[str, tuple[TrialRecord, str]]:
    """The worst trials by id with why, each detector's in turn, and a typical one."""
    scored = [trial for trial in run.counted if trial.scores and trial.truth]
    names = [name for name in run.detectors if any(name in trial.scores for trial in scored)]
    if not names:
        return {}
    names.sort(key=lambda name: name not in undecided)
    ranks = {name: _worst_first(scored, name) for name in names}
    usual = sorted(scored, key=lambda trial: _fault(trial, names[0]), reverse=True)
    turns = [(names[k % len(names)], NTH[k // len(names)]) for k in range(max(3, len(names)))]
    chosen: dict[str, tuple[TrialRecord, str]] = {}
    for name, nth in [*turns, (names[0], "Typical")]:
        rank = usual[len(usual) // 2 :] if nth == "Typical" else ranks[name]
        for trial in [trial for trial in rank if trial.id not in chosen][:1]:
            chosen[trial.id] = trial, f"{nth} of {name}" if len(names) > 1 else nth
    return chosen


def look_at(trial: TrialRecord, why: str, part: TrialPart, calibration: Calibration) -> Highlight:
    """Its views cut to the teats, with truth and answers drawn in."""
    images, there = [], {image.camera: image for image in part.images}
    for camera, truth_px in project_all(calibration, points_mm(trial.truth)).items():
        image = there.get(camera)
        if image is None:
            continue
        size = max(1.0, image.width / CUT_WIDTH_PX)
        box = round_teats(truth_px, image.width, image.height, round(CUT_MARGIN_PX * size))
        drawn = [layer for layer in image.overlays if layer.tone == "truth"]
        for name, who in _places(trial).items():
            rows = [row for row in trial.found if row["detector"] == name]
            at = [json.loads(row[f"{camera}_px"]) for row in rows if row.get(f"{camera}_px")]
            if camera in ("thermal", "depth") and rows:
                # a detector states no pixels of its ends there: they are where its ends are
                seen = project_all(calibration, points_mm(rows))[camera]
                at = [] if seen is None else seen.tolist()
            shapes = tuple(
                answer_mark(who, x, y, 5 * size) for x, y in at if np.isfinite([x, y]).all()
            )
            if shapes:
                drawn.append(Overlay("point", NAMES["point"], shapes, who))
        alt, layers = f"{image.alt}, at the teats", tuple(drawn)
        images.append(replace(image, label=camera, alt=alt, overlays=layers, view_box=box))
    images.sort(key=lambda image: image.camera != "left")
    heading = f"{part.situation}, trial {trial.head['number']}"
    return Highlight(part.id, heading, why, _results(trial, farthest=True), tuple(images))


def _places(trial: TrialRecord) -> dict[str, int]:
    return places_of(str(detection["detector"]) for detection in trial.detections)


def _results(trial: TrialRecord, *, farthest: bool = False) -> tuple[Result, ...]:
    """What came out, whose it is where there are several; ``farthest`` adds the largest error."""
    found, places = [], _places(trial)
    for name, who in places.items():
        score = trial.scores.get(name)
        text, tone = _status(trial, score)
        worst = max(score.radial_mm, default=None) if score and farthest else None
        text = f"{name}: {text}" if len(places) > 1 else text
        found.append(Result(f"{text}, farthest {worst:.1f} mm" if worst else text, tone, who))
    return tuple(found) or (Result(*_status(trial, None)),)


def trial_table(run: RunRecord) -> Table:
    """All trials with links to their parts."""
    rows = []
    for trial in run.trials:
        for detection in trial.detections:
            score = trial.scores.get(detection["detector"])
            counts, worst = ("not scored", "", ""), None
            if score:
                found = f"{score.counts.matched} of {score.counts.visible}"
                counts = (found, str(score.counts.missed), str(score.counts.false))
                worst = max(score.radial_mm, default=None)
            seconds, link = detection["wall_seconds"], Cell(trial.id, href=f"#{trial_id(trial)}")
            # more digits make the page heavy, not the order right
            far = Cell(number(worst), sort=None if worst is None else round(worst, 4))
            time = Cell(f"{seconds:.3f}", sort=round(seconds, 4))
            what = (str(detection["detector"]), Cell(*_status(trial, score)))
            rows.append((link, *what, spoken(trial.head["situation"]), *counts, far, time))
    return table("trials", rows)


def first_looks(run: RunRecord, undecided: Collection[str] = ()) -> KeyValues | None:
    """Links to the trials that are worth the first look; None where none failed."""
    entries = []
    for trial, name in failures_in_turn(run, undecided)[:FIRST_LOOKS]:
        text, tone = _status(trial, trial.scores[name])
        text = f"{name}: {text}" if len(run.detectors) > 1 else text
        entries.append((trial.id, Cell(text, tone, href=f"#{trial_id(trial)}")))
    return KeyValues("Look at these first", tuple(entries)) if entries else None


def _time_text(detection: Row) -> str:
    """The time of one call, and what it can't be compared with."""
    first = " (first call)" if detection["cold"] else ""
    start_up_s = detection["wall_start_up_s"]
    start = "" if start_up_s is None else f" after a start-up of {start_up_s:.3f} s"
    outcome = "" if detection["outcome"] == Outcome.ANSWERED.value else f", {detection['outcome']}"
    return f"{detection['wall_seconds']:.3f} s{first}{start}{outcome}"


def _notes(detection: Row) -> Iterator[str]:
    """Why there is no answer, or only a part of one, and what the program itself wrote."""
    if detection["reason"]:
        yield f"{detection['detector']}: {detection['reason']}"
    if detection["wall_stderr"]:
        yield f"{detection['detector']} wrote to its standard error: {detection['wall_stderr']}"


def _status(trial: TrialRecord, score: SceneScore | None) -> tuple[str, Tone]:
    if trial.invalid:
        return "invalidated", "warn"
    if score is None:
        return "not scored", "muted"
    if score.success:
        return "scene success", "good"
    faults = {
        f"{score.counts.missed} missed": score.counts.missed,
        f"{score.counts.false} false": score.counts.false,
        "beyond the limit": any(mm > score.limit_mm for mm in score.radial_mm),
        "too slow": not score.in_time,
    }
    return ", ".join(text for text, is_so in faults.items() if is_so), "bad"


def _teats(trial: TrialRecord, detector: str) -> Table:
    """Truth and answer side by side; false answers below."""
    score = trial.scores.get(detector)
    found = [row for row in trial.found if row["detector"] == detector]
    pairs = (
        {truth: (answer, k) for k, (answer, truth) in enumerate(score.match.pairs)} if score else {}
    )
    rows: list[tuple[object, ...]] = []
    for index, row in enumerate(trial.truth):
        errors: tuple[object, ...] = ("",) * 5
        text = Cell("missed", "bad") if row["visible"] else Cell("hidden", "muted")
        if score and index in pairs:
            answer, k = pairs[index]
            mm = score.radial_mm[k]
            errors = (mm, *score.errors_mm[k], xyz(found[answer]))
            beyond = Cell("found, beyond the limit", "warn")
            text = beyond if mm > score.limit_mm else Cell("found", "good")
        rows.append((str(row["teat"]), text, *errors, xyz(row), row["u_mm"]))
    text = Cell("false", "bad") if score else Cell("not scored", "muted")
    for answer in score.match.false if score else range(len(found)):
        rows.append(("", text, *[""] * 4, xyz(found[answer]), "", ""))
    return table("teats", rows, detector=detector)


JPEG_QUALITY = 80
MARGIN_PX = 90  # round the teats, in the enlarged view of the optical frames
IMAGES = "images"
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
    "other": "rejected fits, other stages",
}
FINAL = {"ends"}  # stages that repeat the answer


def _pictures(
    run: RunRecord,
    trial: TrialRecord,
    calibration: Calibration,
    place: tuple[Path, str],
    copied: Collection[str] | None,
) -> Iterator[ImageView]:
    """Every view of a trial. A frame that is gone is left out: the store's check names it."""
    (folder, up), paths = place, {row["camera"]: row["path"] for row in trial.frames}
    for camera, path, points in views_of(run, trial, calibration):
        if (size := png_size(path)) is None:
            continue
        mirrored = camera == "thermal" and calibration.thermal.mirrored
        label = f"{camera}, left and right exchanged back" if mirrored else camera
        src = original = up + paths[camera]
        if copied is None or trial.id in copied or camera == "depth":
            if (image := shown(camera, path)) is None:
                continue
            src = f"{IMAGES}/{trial.id}-{camera}.jpg"
            _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
            (folder / IMAGES).mkdir(parents=True, exist_ok=True)
            (folder / src).write_bytes(bytes(data))
        yield ImageView(
            *(label, src, *size),
            alt=f"{label} frame of trial {trial.id}",
            overlays=overlays(trial, camera, points, calibration),
            view_box=None if camera == "thermal" else round_teats(points, *size),
            original=original,
            shown_as="mirrored" if mirrored else "",
            camera=camera,
        )
    for detection in trial.detections:
        # the detector's edge picture, where it has one, with the points that were taken from it
        picture = f"{detection['detector']}-edges"
        size = png_size(run.folder / paths[picture]) if picture in paths else None
        if size is None:
            continue
        label = f"{detection['detector']}: edges in the thermal frame"
        places = _places(trial)
        who = places[str(detection["detector"])] if len(places) > 1 else 0
        layers, alt = stage_overlays(detection, who), f"{label}, trial {trial.id}"
        src = up + paths[picture]
        yield ImageView(label, src, *size, alt, layers, shown_as="inverted", camera=picture)


def views_of(
    run: RunRecord, trial: TrialRecord, calibration: Calibration
) -> Iterator[tuple[str, Path, Floats | None]]:
    """Each camera that took a frame, its file, and the true ends (n, 2) in it, un-mirrored."""
    paths = {row["camera"]: run.folder / row["path"] for row in trial.frames}
    for camera, points in project_all(calibration, points_mm(trial.truth)).items():
        if camera in paths:
            yield camera, paths[camera], points


def round_teats(
    points: Floats | None, width: int, height: int, margin_px: int = MARGIN_PX
) -> tuple[int, int, int, int] | None:
    """A 4:3 part of the frame around the teat ends; the whole frame where it has none."""
    if (
        points is None
        or not np.isfinite(points).all()
        or not ((points >= 0) & (points < (width, height))).all(axis=1).any()
    ):
        return None
    low, high = points.min(axis=0) - margin_px, points.max(axis=0) + margin_px
    view_width = int(min(width, max(high[0] - low[0], (high[1] - low[1]) * 4 / 3)))
    view_height = int(min(height, view_width * 3 / 4))
    if min(view_width, view_height) < 1:  # a frame of a few pixels has no part
        return None
    room, size = np.array([width - view_width, height - view_height]), (view_width, view_height)
    x, y = np.clip((low + high) / 2 - np.array(size) / 2, 0, room).astype(int).tolist()
    return x, y, *size


def shown(camera: str, path: Path) -> NDArray[np.uint8] | None:
    """A frame as 8-bit grey, or None; of depth near is bright, black where nothing was measured."""
    data = np.frombuffer(path.read_bytes() if path.is_file() else b"", np.uint8)
    how = cv2.IMREAD_UNCHANGED if camera == "depth" else cv2.IMREAD_GRAYSCALE
    image: NDArray[Any] | None = cv2.imdecode(data, how) if data.size else None
    if image is None or camera != "depth":
        return image
    if image.dtype != np.uint16 or not image.any():
        return None
    near, far = np.percentile(image[image > 0], [0.5, 99.5])
    level = 255.0 - 223.0 * (image - near) / max(1.0, float(far - near))
    return np.where(image > 0, np.clip(level, 32.0, 255.0), 0.0).astype(np.uint8)


@lru_cache(maxsize=2)
def _cameras(calibration: Calibration) -> dict[str, tuple[Camera, Motion, Motion] | None]:
    """Each camera's lens and its motions from the right camera and from the world; None where it
    has no pose. The thermal camera's are of the un-mirrored picture.
    """
    right_from_world = calibration.world_from_right.inverse()
    thermal, depth = calibration.thermal, calibration.depth_from_world
    seen = {
        "left": (calibration.left, calibration.right_from_left.inverse()),
        "right": (calibration.right, Motion.identity()),
        "thermal": (thermal.lens, calibration.thermal_from_right),
    }
    if calibration.depth and depth:
        seen["depth"] = (calibration.depth, depth @ calibration.world_from_right)
    return {
        camera: (lens, from_right, from_right @ right_from_world) if lens and from_right else None
        for camera, (lens, from_right) in seen.items()
    }


def project_all(calibration: Calibration, world_mm: Floats) -> dict[str, Floats | None]:
    """Pixels (n, 2) of world points (n, 3) by camera, thermal un-mirrored; None without a pose."""
    return {camera: _seen(calibration, camera, world_mm) for camera in _cameras(calibration)}


def _seen(calibration: Calibration, camera: str, world_mm: Floats) -> Floats | None:
    known = _cameras(calibration)[camera]
    return known and known[0].project(known[2].apply(world_mm))


def overlays(
    trial: TrialRecord, camera: str, truth_px: Floats | None, calibration: Calibration
) -> tuple[Overlay, ...]:
    """All layers over one camera's frame; ``truth_px`` (n, 2) is the truth in its pixels."""
    shapes: dict[tuple[LayerTone, int], list[Shape]] = {(tone, 0): [] for tone in NAMES}
    if truth_px is not None:
        for row, (x, y) in zip(trial.truth, truth_px, strict=True):
            if np.isfinite([x, y]).all():
                hidden = "" if row["visible"] else " (hidden)"
                shapes["truth", 0].append(Circle(x, y, 7, f"truth {row['teat']}{hidden}"))
                shapes["truth", 0].append(Label(x, y - 5, str(row["teat"]), 9))
    places, spreads = _places(trial), _spreads(trial.found, camera, calibration)
    for detection in trial.detections:
        trace, name = _trace(detection["trace"]), str(detection["detector"])
        who = places[name]
        drawn = [*_stages(trace, camera, name), *_models(trace, camera, calibration, name)]
        for place, row in enumerate(trial.found):
            if row["detector"] == name:
                if at := row.get(f"{camera}_px"):
                    x, y = json.loads(at)
                    if np.isfinite([x, y]).all():
                        drawn.append(("point", answer_mark(who, x, y, 6, f"{name}: end")))
                drawn += [("spread", spreads[place])] if place in spreads else []
        for tone, shape in drawn:
            # of one detector its stages have colours of their own
            whose = who if tone == "point" or len(places) > 1 else 0
            shapes.setdefault((tone, whose), []).append(shape)
    return tuple(
        Overlay(tone, NAMES[tone], tuple(found), who)
        for (tone, who), found in shapes.items()
        if found
    )


_trace = lru_cache(maxsize=8)(json.loads)  # of a trial's detectors, for each camera; not changed


def stage_overlays(detection: Row, who: int = 0) -> tuple[Overlay, ...]:
    """Over the thesis's picture of edges: the points taken from it, and those nominated."""
    trace = _trace(detection["trace"])
    taken = tuple(
        Circle(x, y, 4, stage)
        for stage in ("vertical ends", "horizontal middles")
        for x, y in points_of(trace, stage, "points_px")
    )
    ends = points_of(trace, "teat ends", "points_px")
    nominated = tuple(Cross(x, y, 6, title="nominated") for x, y in ends)
    other = Overlay("other", NAMES["other"], taken, who)
    layers = (other, Overlay("nomination", NAMES["nomination"], nominated, who))
    return tuple(layer for layer in layers if layer.shapes)


def points_of(trace: Mapping[str, Any], stage: str, key: str) -> Floats:
    """The finite points (n, 2) of a stage; none where it has no such thing."""
    points = _rows(trace.get(stage, {}).get(key), 2)
    return points[np.isfinite(points).all(axis=1)]


def _rows(value: Any, width: int) -> Floats:
    """A stage's numbers as rows (n, width); none where they have another shape."""
    try:
        array = np.array(value if isinstance(value, list) else [], dtype=np.float64)
    except (TypeError, ValueError):  # text, or rows of different lengths
        return np.empty((0, width))
    return array.reshape(-1, width) if array.size % width == 0 else np.empty((0, width))


def _stages(
    trace: Mapping[str, Any], camera: str, detector: str
) -> Iterator[tuple[LayerTone, Shape]]:
    """Floats of stages in this camera's picture; the thesis's own stages by their names."""
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
        high, wide = region["shape"][-2:]
        for x, y in np.round(points_of(trace, "nominations", f"{camera}_px")):
            title = f"{detector}: search region"
            yield "region", Rect(x - wide / 2, y - high / 2, wide, high, title)


def _models(
    trace: Mapping[str, Any], camera: str, calibration: Calibration, detector: str
) -> Iterator[tuple[LayerTone, Shape]]:
    """The outlines of fused's fitted teats, reasons of rejection, thermal ends."""
    if camera == "thermal":
        # fused nominates in the sensor's pixels, of which the picture may have several each
        size = calibration.thermal.image_size[0] / calibration.thermal.sensor_size[0]
        for what in ("end", "bar"):
            for x, y in (points_of(trace, "thermal", f"{what}_px") + 0.5) * size - 0.5:
                yield "nomination", Cross(x, y, 6, title=f"{detector}: warm {what}")
    decided = trace.get("decisions", {})
    teats = _rows(decided.get("teats"), COUNT)
    reasons = decided.get("reasons") if isinstance(decided.get("reasons"), list) else []
    if not len(teats) or (known := _cameras(calibration)[camera]) is None:
        return
    lens, from_right, _ = known
    turned = _rows(decided.get("right_from_teats"), 3)
    from_teats = from_right @ Motion(turned, np.zeros(3)) if len(turned) else from_right
    lines, _, _ = outlines(teats, numbers_of(lens, from_teats)[None], OUTLINE)
    whole = np.asarray(np.isfinite(lines).all(axis=(1, 2)))
    for line, is_whole, reason in zip(lines.tolist(), whole, reasons, strict=False):
        if is_whole:
            text = f"{detector}: rejected, {reason}" if reason else f"{detector}: fitted teat"
            tone: LayerTone = "other" if reason else "model"
            yield tone, Polyline(tuple(map(tuple, line)), title=text)


def _spreads(found: Sequence[Row], camera: str, calibration: Calibration) -> dict[int, Ellipse]:
    """By place in ``found``, the covariance stated in this camera: an ellipse for 95 % of cases."""
    stated = {at: own for at, row in enumerate(found) if (own := covariance_of(row)) is not None}
    rows = [found[at] for at in stated]
    steps = STEP_MM * np.vstack([np.zeros(3), np.eye(3), -np.eye(3)])
    around = points_mm(rows)[:, None] + steps
    seen = _seen(calibration, camera, around.reshape(-1, 3))
    if seen is None or not rows:
        return {}
    seen = seen.reshape(-1, 7, 2)
    whole = np.asarray(np.isfinite(seen).all(axis=(1, 2)))
    slope = (seen[whole, 1:4] - seen[whole, 4:7]).swapaxes(1, 2) / (2 * STEP_MM)  # px / mm
    covariances = np.array([*stated.values()])[whole]
    sizes, directions = np.linalg.eigh(slope @ covariances @ slope.swapaxes(1, 2))
    axes_px = np.sqrt(CHI2_95_OF_2 * np.clip(sizes, 0.0, None)).tolist()
    turns_deg = np.degrees(np.arctan2(directions[:, 1, 1], directions[:, 0, 1])).tolist()
    places = [at for at, is_whole in zip(stated, whole, strict=True) if is_whole]
    ellipses = {}
    for at, (x, y), (minor, major), turn_deg in zip(
        places, seen[whole, 0].tolist(), axes_px, turns_deg, strict=True
    ):
        text = f"{found[at]['detector']}: stated 95 % region, {major:.1f} by {minor:.1f} px"
        ellipses[at] = Ellipse(x, y, major, minor, turn_deg, text)
    return ellipses
