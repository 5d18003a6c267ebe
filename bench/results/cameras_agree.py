"""Do the cameras show the touched teat ends where the calibration says? The bench's own check of
its cameras, pooled over a run, whichever detectors are under test; and the same figure of what a
detector answers, which a knocked camera puts off alike.

An end's disparity tells of depth, rows and the thermal picture of the rest. A truth that is off
alike all through a run (registration, arm) moves the disparity too: by its standard uncertainty
along the line of sight, which is part of the uncertainty stated here.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import stdtrit

from bench.config import ConfigError
from bench.record.reader import TrialRecord, points_mm, read_run
from bench.record.schema import DATABASE
from bench.scoring.decisions import Decision, Verdict
from bench.script.model import CamerasRequirement
from detector.calibration import Calibration
from detector.fused.known_ends import (
    NO_THERMAL_MM,
    REACH_PX,
    THERMAL_REACH_PX,
    EndOffsets,
    offsets_at,
)
from detector.fused.pictures import UnusableError
from detector.geometry import Array
from instruments.camera.frame import FrameSet
from instruments.camera.recording import Recording, RecordingError, TruthRow

LEAST_POSES, MOST_POSES = 3, 24
CONFIDENCE = 0.95  # of an interval, two-sided
NAMES = ("disparity", "rows", "thermal columns", "thermal rows")
LEAST_TOLD = 0.2  # of the ends; fewer are told by chance
SHARED = 0.5  # of what the cameras are off, in a detector's answers: it is the cameras'
# where no requirement says another
LIMIT_PX, THERMAL_LIMIT_PX = (
    float(CamerasRequirement.model_fields[name].default)
    for name in ("limit_px", "thermal_limit_px")
)
NEXT_UNSEEN = (
    "Look at the frames: is every camera where it was, sharp and lit, and are the ends those of the"
    " truth? Then 'teatbench calibrate check' with a board."
)


def where_seen(
    frames: FrameSet, calibration: Calibration, truth: Sequence[TruthRow]
) -> Mapping[str, EndOffsets]:
    """Of the visible teats of ``truth``, by name; nothing where the pictures can't be used."""
    try:
        return _seen(frames, calibration, truth)
    except (UnusableError, np.linalg.LinAlgError):
        return {}


def _seen(
    frames: FrameSet, calibration: Calibration, truth: Sequence[TruthRow]
) -> Mapping[str, EndOffsets]:
    """The same. Raises UnusableError, LinAlgError."""
    rows = [row for row in truth if row.visible]
    if not rows:
        return {}
    offsets = offsets_at(frames, calibration, np.array([row.xyz_mm for row in rows]))
    return {row.teat: one for row, one in zip(rows, offsets, strict=True)}


def spread(frames: Iterable[str]) -> frozenset[str]:
    """At most `MOST_POSES` of the frames, evenly spread: enough for the check of a recording."""
    every = list(frames)
    some = np.linspace(0, len(every) - 1, min(len(every), MOST_POSES)).round().astype(int)
    return frozenset(every[k] for k in some)


@dataclass(frozen=True, slots=True)
class CameraOffset:
    """One figure of a run's cameras: ``value`` with its expanded uncertainty, px (of the sensor for
    the thermal camera), over ``poses``. A pixel is ``mm`` of a teat end's depth, or a camera turned
    by ``deg``.
    """

    name: str
    value: float
    uncertainty: float
    poses: int
    mm: float
    deg: float

    @property
    def text(self) -> str:
        """``disparity off by 0.50 +- 0.04 px``."""
        return f"{self.name} off by {self.value:z.2f} ± {self.uncertainty:.2f} px"


@dataclass(frozen=True, slots=True)
class CamerasCheck:
    """What the cameras show of known ends: each figure that at least `LEAST_POSES` poses tell, of
    how many poses; how many of the ends told, and how many in the thermal picture (None where there
    is none).
    """

    offsets: tuple[CameraOffset, ...] = ()
    poses: int = 0
    ends: int = 0
    told: int = 0
    thermal: int | None = None

    def __getitem__(self, name: str) -> CameraOffset | None:
        return next((one for one in self.offsets if one.name == name), None)

    @property
    def depth_error_mm(self) -> float:
        """How far the disparity alone puts an end off in depth, at the least, with confidence; 0
        where it may be right.
        """
        one = self[NAMES[0]]
        return 0.0 if one is None else max(abs(one.value) - one.uncertainty, 0.0) * one.mm

    def sure(self, limit_px: float, thermal_limit_px: float) -> list[CameraOffset]:
        """The figures that are beyond their limits by more than their uncertainty."""
        limits = limits_of(limit_px, thermal_limit_px)
        return [o for o in self.offsets if abs(o.value) - o.uncertainty > limits[o.name]]

    @property
    def unseen(self) -> tuple[str, ...]:
        """What can't be measured although pictures are there, in words."""
        if self.poses < LEAST_POSES:
            return ()
        if self.told < LEAST_TOLD * self.ends:
            columns, rows = REACH_PX
            reach = f"more than {columns:g} px of columns or {rows:g} px of rows"
            return (_beyond(f"{self.told} of {self.ends} ends told in left and right", reach),)
        if self.thermal is None or self.thermal >= LEAST_TOLD * self.told:
            return ()
        reach = f"more than {THERMAL_REACH_PX:g} sensor pixels"
        return (_beyond(f"{self.thermal} of {self.told} ends told in the thermal picture", reach),)


def limits_of(limit_px: float, thermal_limit_px: float) -> Mapping[str, float]:
    """Of each figure."""
    return dict(zip(NAMES, [limit_px] * 2 + [thermal_limit_px] * 2, strict=True))


def _beyond(who: str, reach: str) -> str:
    return f"only {who}: off beyond what can be measured ({reach}), or not shown"


def check_cameras(seen: Mapping[str, Sequence[Mapping[str, Any]]], u_mm: float) -> CamerasCheck:
    """Of the `EndOffsets` of each pose, as dicts; ``u_mm``: of the known ends. Figures are the mean
    over poses of each pose's median; repeats of a pose count once.
    """
    medians, ends, told, thermal, looked = [], 0, 0, 0, False
    for rows in seen.values():
        figures = [
            [
                np.nan if one is None else float(one)
                for one in (row["disparity_px"], row["rows_px"], *row["thermal_px"])
            ]
            + [row["mm_a_px"], row["thermal_mm_a_px"], row["deg_a_px"]]
            for row in rows
        ]
        values = np.array(figures, dtype=np.float64)
        ends, told = ends + len(values), told + int(np.isfinite(values[:, 0]).sum())
        thermal += int(np.isfinite(values[:, 2]).sum())
        looked = looked or bool((values[:, 5] != NO_THERMAL_MM).any())
        medians.append(_median(values))
    if not medians:
        return CamerasCheck()
    by_pose = np.array(medians)
    mm, thermal_mm, deg = np.median(by_pose[:, 4:], axis=0)
    # what so few tell is chance
    shown = NAMES if thermal >= LEAST_TOLD * told else NAMES[:2]
    found = []
    for k, name in enumerate(shown if told >= LEAST_TOLD * ends else ()):
        common = {"disparity": u_mm / mm, "rows": 0.0}.get(name, u_mm / thermal_mm)
        if (one := _pooled(name, by_pose[:, k], common, float(mm), float(deg))) is not None:
            found.append(one)
    return CamerasCheck(tuple(found), len(by_pose), ends, told, thermal if looked else None)


def _pooled(name: str, values: Array, common: float, mm: float, deg: float) -> CameraOffset | None:
    """The mean of what poses (n,) tell; ``common``: standard uncertainty that all share, px."""
    values = values[np.isfinite(values)]
    n = len(values)
    if n < LEAST_POSES:
        return None
    scatter = float(stdtrit(n - 1, 0.5 + CONFIDENCE / 2) * values.std(ddof=1) / np.sqrt(n))
    return CameraOffset(
        name, float(values.mean()), float(np.hypot(scatter, 2 * common)), n, mm, deg
    )


def _median(rows: Array) -> Array:
    """Of each column (n, k), whatever is not a number left out."""
    return np.array(
        [np.median(c[np.isfinite(c)]) if np.isfinite(c).any() else np.nan for c in rows.T]
    )


def can_tell(seen: Mapping[str, Mapping[str, EndOffsets]]) -> bool:
    """Whether what the poses show of their ends, by name, is enough for figures."""
    rows = {pose: [asdict(one) for one in ends.values()] for pose, ends in seen.items() if ends}
    check = check_cameras(rows, 0.0)
    return check[NAMES[0]] is not None and not check.unseen


def truth_rows(trial: TrialRecord) -> list[TruthRow]:
    """A trial's known ends as a recording has them."""
    situation = str(trial.head["situation"])
    return [
        TruthRow(
            situation, r["teat"], (r["x_mm"], r["y_mm"], r["z_mm"]), bool(r["visible"]), r["u_mm"]
        )
        for r in trial.truth
    ]


def check_folder(
    folder: Path, calibration: Calibration, anew: Sequence[FrameSet] = ()
) -> CamerasCheck:
    """Of a run's or recording's frames and known ends; of frames taken ``anew`` of the ends of its
    last frame. Fewer than `LEAST_POSES` poses are pooled over their ends. Raises ConfigError.
    """
    try:
        recording = Recording(folder)
        truth = recording.truth
        if (folder / DATABASE).exists():
            truth = {trial.id: tuple(truth_rows(trial)) for trial in read_run(folder).counted}
        known = [
            frame for frame in recording.frames if any(r.visible for r in truth.get(frame, ()))
        ]
        if not known:
            raise ConfigError.plain(
                f"{folder}: there are no frames with visible known ends. Name the folder of a run"
                " that touched teats, or of a recording with truth.csv"
            )
        some = [known[-1]] * len(anew) if anew else sorted(spread(known))
        shots = anew or map(recording.load, some)
        seen = [
            (f"{number} {frame}", _seen(shot, calibration, truth[frame]))
            for number, (frame, shot) in enumerate(zip(some, shots, strict=True))
        ]
    except (RecordingError, UnusableError, np.linalg.LinAlgError) as error:
        raise ConfigError.plain(f"{folder}: its pictures can't be checked: {error}") from error
    each = len(set(some)) < LEAST_POSES
    rows: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for pose, ends in seen:
        for teat, one in ends.items():
            rows[teat if anew else f"{pose} {teat}" if each else pose].append(asdict(one))
    u_mm = max((row.u_mm or 0.0 for frame in some for row in truth[frame]), default=0.0)
    return check_cameras(rows, u_mm)


def cameras_of(trials: Sequence[TrialRecord]) -> CamerasCheck:
    """Of a run's touched ends, as its record has them."""
    by_pose: dict[str, list[dict[str, Any]]] = defaultdict(list)
    u_mm = 0.0
    for trial in trials:
        for row in trial.truth:
            if row.get("cameras"):
                by_pose[trial.pose].append(json.loads(row["cameras"]))
                u_mm = max(u_mm, row["u_mm"] or 0.0)
    return check_cameras(by_pose, u_mm)


def answers_of(
    trials: Sequence[TrialRecord], detector: str, calibration: Calibration
) -> CameraOffset | None:
    """The disparity that a detector's answers are off the truth in common, as `cameras_of` has it
    of the cameras; None where fewer than `LEAST_POSES` poses have an answer at an end.
    """
    by_pose: dict[str, list[float]] = defaultdict(list)
    scales, u_mm = [], 0.0
    for trial in trials:
        score = trial.scores.get(detector)
        if score is None or not score.match.pairs:
            continue
        rows = [trial.truth[k] for _, k in score.match.pairs]
        true = points_mm(rows)
        columns = [
            np.subtract(left[:, 0], right[:, 0])
            for left, right in map(calibration.project, (true + score.errors_mm, true))
        ]
        by_pose[trial.pose] += (columns[0] - columns[1]).tolist()
        scales += calibration.depth_per_disparity_px_mm(true).tolist()
        u_mm = max(u_mm, *(row["u_mm"] or 0.0 for row in rows))
    if not scales:
        return None
    mm, deg = float(np.median(scales)), float(np.degrees(1.0 / calibration.right.fc[0]))
    medians = np.array([np.median(values) for values in by_pose.values()])
    return _pooled(NAMES[0], medians, u_mm / mm, mm, deg)


def shared(cameras: CameraOffset, answers: CameraOffset) -> bool:
    """Whether answers may have what the cameras are off: half of it, or what they scatter by."""
    apart = abs(answers.value - cameras.value)
    alike = answers.value * np.sign(cameras.value) >= SHARED * abs(cameras.value)
    return bool(alike or apart <= np.hypot(answers.uncertainty, cameras.uncertainty))


def told_apart(cameras: CamerasCheck, answers: CameraOffset | None, limit_px: float) -> str:
    """Whose it is that answers are off in common, in words; empty where they aren't surely off by
    more than the limit.
    """
    if answers is None or abs(answers.value) - answers.uncertainty <= limit_px:
        return ""
    sentence = (
        f"its ends have their {answers.text} alike over {answers.poses} poses, as if the right"
        f" camera were turned by {abs(answers.value) * answers.deg:.2f}°"
    )
    seen = cameras[NAMES[0]]
    if seen is None:
        return f"{sentence}; the cameras could not be checked, so it may be either's fault"
    if cameras.depth_error_mm > 0.0 and shared(seen, answers):
        return f"{sentence}, and so have the cameras ({seen.text}): calibration, not detector"
    return f"{sentence}, but the cameras have not ({seen.text}): detector, not calibration"


def decide_cameras(rule: CamerasRequirement, trials: Sequence[TrialRecord]) -> Decision:
    """As `decide`, of a run's touched ends."""
    return decide(rule, cameras_of(trials))


def decide(rule: CamerasRequirement, check: CamerasCheck) -> Decision:
    """Not met where a figure is beyond its limit by more than its uncertainty; met where all are
    within by as much; not measured where no picture was held against a touched end.
    """
    limits, offsets = limits_of(rule.limit_px, rule.thermal_limit_px), check.offsets
    nothing = Decision(
        name=rule.name,
        rule=f"touched ends are seen within {rule.limit_px:g} px of where the calibration puts"
        f" them (disparity, rows), and within {rule.thermal_limit_px:g} sensor pixels in the"
        f" thermal picture; mean over poses, with {CONFIDENCE:.0%} confidence",
        unit="px",
        limit=rule.limit_px,
        sentence=f"It needs touched ends of at least {LEAST_POSES} poses that the cameras show.",
    )
    if check[NAMES[0]] is None:
        if not check.unseen:
            return nothing
        text = f"{_capital(check.unseen[0])}. {NEXT_UNSEEN}"
        return replace(nothing, n=check.poses, verdict=Verdict.INCONCLUSIVE, sentence=text)
    sure = check.sure(rule.limit_px, rule.thermal_limit_px)
    open_ = [one for one in offsets if abs(one.value) + one.uncertainty > limits[one.name]]
    worst = max(sure or offsets, key=lambda one: abs(one.value) / limits[one.name])
    text = "; ".join([*(one.text for one in sure or open_ or offsets[:2]), *check.unseen])
    if depth := next((one for one in sure if one.name == NAMES[0]), None):
        off = abs(depth.value)
        text += (
            f"; that disparity is as if the right camera were turned by {off * depth.deg:.2f}°, and"
            f" puts every stereo detector's ends some {off * depth.mm:.1f} mm off in depth"
        )
    text += f" ({check.told} of {check.ends} ends told)"
    unclear = Verdict.INCONCLUSIVE if open_ or check.unseen else Verdict.MET
    advice = f" It is the calibration's fault, not a detector's: {cure(sure)}." if sure else ""
    if check.unseen and not sure:
        advice = f" {NEXT_UNSEEN}"
    return replace(
        nothing,
        n=worst.poses,
        measured=abs(worst.value),
        limit=limits[worst.name],
        margin=limits[worst.name] - abs(worst.value),
        uncertainty=worst.uncertainty,
        verdict=Verdict.NOT_MET if sure else unclear,
        sentence=f"{_capital(text)}.{advice}",
    )


def cure(off: Sequence[CameraOffset]) -> str:
    """Which step of the calibration is to be made again for what is off."""
    optical = any(one.name in NAMES[:2] for one in off)
    step = "cameras" if optical else "thermal"
    rest = "what follows from it, then 'merge'" if optical else "'merge'"
    return f"look for a camera that was knocked; calibrate again ('calibrate {step}', {rest})"


def _capital(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}"
