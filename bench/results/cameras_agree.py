"""Do the cameras show the touched teat ends where the calibration says? The bench's own check of
its cameras, pooled over a run, whichever detectors are under test.

An end's disparity tells of depth, rows and the thermal picture of the rest. A truth that is off
alike all through a run (registration, arm) moves the disparity too: by its standard uncertainty
along the line of sight, which is part of the uncertainty stated here.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from bench.record.reader import TrialRecord
from bench.scoring.decisions import Decision, Verdict
from bench.script.model import CamerasRequirement
from detector.calibration import Calibration
from detector.fused.known_ends import EndOffsets, offsets_at
from detector.fused.pictures import UnusableError
from detector.geometry import Array
from instruments.camera.frame import FrameSet
from instruments.camera.recording import TruthRow

LEAST_POSES = 3
CONFIDENCE = 0.95  # of an interval, two-sided
NAMES = ("disparity", "rows", "thermal columns", "thermal rows")


def where_seen(
    frames: FrameSet, calibration: Calibration, truth: Sequence[TruthRow]
) -> Mapping[str, EndOffsets]:
    """Of the visible teats of ``truth``, by name; nothing where the pictures can't be used."""
    rows = [row for row in truth if row.visible]
    if not rows:
        return {}
    try:
        offsets = offsets_at(frames, calibration, np.array([row.xyz_mm for row in rows]))
    except (UnusableError, np.linalg.LinAlgError):
        return {}
    return {row.teat: one for row, one in zip(rows, offsets, strict=True)}


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
        return f"{self.name} off by {self.value:.2f} ± {self.uncertainty:.2f} px"


def camera_offsets(trials: Sequence[TrialRecord]) -> tuple[CameraOffset, ...]:
    """Of each figure that at least so many poses tell. The mean over poses of each pose's median;
    repeats of a pose count once.
    """
    by_pose: dict[str, list[tuple[float, ...]]] = defaultdict(list)
    u_mm = 0.0
    for trial in trials:
        for row in trial.truth:
            if row.get("cameras"):
                seen = json.loads(row["cameras"])
                figures = [seen["disparity_px"], seen["rows_px"], *seen["thermal_px"]]
                scale = [seen["mm_a_px"], seen["thermal_mm_a_px"], seen["deg_a_px"]]
                by_pose[trial.pose].append(
                    tuple(np.nan if one is None else float(one) for one in (*figures, *scale))
                )
                u_mm = max(u_mm, row["u_mm"] or 0.0)
    if not by_pose:
        return ()
    with np.errstate(all="ignore"):
        medians = np.array([_median(np.array(rows)) for rows in by_pose.values()])
    mm, thermal_mm, deg = np.median(medians[:, 4:], axis=0)
    found = []
    for k, name in enumerate(NAMES):
        values = medians[:, k][np.isfinite(medians[:, k])]
        n = len(values)
        if n < LEAST_POSES:
            continue
        common = {"disparity": u_mm / mm, "rows": 0.0}.get(name, u_mm / thermal_mm)
        scatter = float(stdtrit(n - 1, 0.5 + CONFIDENCE / 2) * values.std(ddof=1) / np.sqrt(n))
        uncertainty = float(np.hypot(scatter, 2.0 * common))
        found.append(
            CameraOffset(name, float(values.mean()), uncertainty, n, float(mm), float(deg))
        )
    return tuple(found)


def depth_error_mm(trials: Sequence[TrialRecord]) -> float:
    """How far the cameras' disparity alone puts an end off in depth, at the least, with confidence;
    0 where it may be right.
    """
    for one in camera_offsets(trials):
        if one.name == NAMES[0]:
            return max(abs(one.value) - one.uncertainty, 0.0) * one.mm
    return 0.0


def _median(rows: Array) -> Array:
    """Of each column (n, k), whatever is not a number left out."""
    return np.array(
        [np.median(c[np.isfinite(c)]) if np.isfinite(c).any() else np.nan for c in rows.T]
    )


def decide_cameras(rule: CamerasRequirement, trials: Sequence[TrialRecord]) -> Decision:
    """Not met where a figure is beyond its limit by more than its uncertainty; met where all are
    within by as much; not measured where no picture was held against a touched end.
    """
    limits = dict.fromkeys(NAMES[:2], rule.limit_px)
    limits |= dict.fromkeys(NAMES[2:], rule.thermal_limit_px)
    offsets = camera_offsets(trials)
    nothing = Decision(
        name=rule.name,
        rule=f"touched ends are seen within {rule.limit_px:g} px of where the calibration puts"
        f" them (disparity, rows), and within {rule.thermal_limit_px:g} sensor pixels in the"
        f" thermal picture; mean over poses, with {CONFIDENCE:.0%} confidence",
        unit="px",
        limit=rule.limit_px,
        sentence=f"It needs touched ends of at least {LEAST_POSES} poses that the cameras show.",
    )
    if not any(one.name == "disparity" for one in offsets):
        return nothing
    sure = [one for one in offsets if abs(one.value) - one.uncertainty > limits[one.name]]
    open_ = [one for one in offsets if abs(one.value) + one.uncertainty > limits[one.name]]
    worst = max(sure or offsets, key=lambda one: abs(one.value) / limits[one.name])
    text = "; ".join(one.text for one in sure or open_ or offsets[:2])
    if depth := next((one for one in sure if one.name == "disparity"), None):
        off = abs(depth.value)
        text += (
            f"; that disparity is as if the right camera were turned by {off * depth.deg:.2f}°, and"
            f" puts every stereo detector's ends some {off * depth.mm:.1f} mm off in depth"
        )
    verdict = Verdict.NOT_MET if sure else Verdict.INCONCLUSIVE if open_ else Verdict.MET
    advice = " It is the calibration's fault, not a detector's: calibrate again." if sure else ""
    return Decision(
        name=rule.name,
        rule=nothing.rule,
        n=worst.poses,
        measured=abs(worst.value),
        unit="px",
        limit=limits[worst.name],
        margin=limits[worst.name] - abs(worst.value),
        uncertainty=worst.uncertainty,
        verdict=verdict,
        sentence=f"{text[0].upper()}{text[1:]}.{advice}",
    )
