"""What each missed, wrong or unjudged teat is attributed to. A fault of the bench is never a
failure of the detector.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from bench.record.reader import RunRecord, TrialRecord
from bench.results.cameras_agree import DEFAULT, answers_of, cameras_of, share_shift
from bench.results.status import state_in
from bench.safety.stability import BathState
from bench.scoring.joint import radial_95_mm
from detector.calibration import Calibration

OPERATORS_EVENT = "the operator skipped it"


class Cause(StrEnum):
    """What is at fault."""

    DETECTOR = "detector"
    TRUTH = "truth"
    BENCH = "bench"
    CALIBRATION = "calibration"
    OPERATOR = "operator"
    NOT_VISIBLE = "not visible"


class DetectionFault(StrEnum):
    """What is wrong with a teat, or with a whole trial."""

    MISSED = "missed"
    OFF = "further off than the limit"
    FALSE = "false finding"
    NOT_JUDGED = "trial not judged"


@dataclass(frozen=True, slots=True)
class AttributedFault:
    """One fault; ``teat`` is empty for a false finding or a trial."""

    trial: str
    detector: str
    teat: str
    what: DetectionFault
    cause: Cause
    why: str


def attributed(
    run: RunRecord, detector: str, calibration: Calibration | None = None
) -> tuple[AttributedFault, ...]:
    """The faults of ``detector`` in the order of the trials, then the trials that were not judged.
    An answer that doesn't share the cameras' shift stays the detector's.
    """
    found = []
    check = cameras_of(run)
    depth_mm, seen = check.depth_error_mm, check.disparity
    answers = answers_of(run, detector, calibration) if calibration else None
    if answers is not None and seen is not None and not share_shift(seen, answers):
        depth_mm = 0.0
    off = "; ".join(one.text for one in check.beyond(DEFAULT))
    for trial in run.trials:
        bath = trial.head["bath_state"]
        for what, teat, cause, why in _wrong(trial, detector):
            if trial.invalid is not None:
                cause, why = Cause.TRUTH, trial.invalid
            elif bath not in (None, BathState.STABLE.value) and cause is Cause.DETECTOR:
                cause = Cause.BENCH
                why = f"the bath was {bath}, not stable, when the frames were taken"
            elif cause is Cause.DETECTOR and depth_mm > 0.5 * trial.scores[detector].limit_mm:
                cause = Cause.CALIBRATION
                why += f"; but the cameras put every end some {depth_mm:.1f} mm off in depth"
            elif cause is Cause.DETECTOR and off and not trial.scores[detector].counts.found:
                cause, why = Cause.CALIBRATION, f"{why}; but the cameras have their {off}"
            found.append(AttributedFault(trial.id, detector, teat, what, cause, why))
    judged_not = (
        AttributedFault(trial, detector, "", DetectionFault.NOT_JUDGED, cause, why)
        for trial, cause, why in _not_judged(run)
    )
    return (*found, *judged_not)


def counted(found: tuple[AttributedFault, ...]) -> Counter[tuple[DetectionFault, Cause]]:
    """How many of each kind, by cause."""
    return Counter((one.what, one.cause) for one in found)


def _wrong(trial: TrialRecord, detector: str) -> Iterator[tuple[DetectionFault, str, Cause, str]]:
    score = trial.scores.get(detector)
    if score is None:
        return
    names = [str(row["teat"]) for row in trial.truth]
    reasons = [row["reason"] for row in trial.detections if row["detector"] == detector]
    unseen = "it was visible and nothing was found within the gate"
    why = str(next(filter(None, reasons), unseen))
    for teat in score.match.missed:
        yield DetectionFault.MISSED, names[teat], Cause.DETECTOR, why
    for (_, teat), distance in zip(score.match.pairs, score.radial_mm, strict=True):
        if distance > score.limit_mm:
            why, cause = f"{distance:.2f} mm off, limit {score.limit_mm:g} mm", Cause.DETECTOR
            if teat in score.doubtful:
                known_mm, cause = radial_95_mm(score.u_mm**2 * np.eye(3)), Cause.TRUTH
                why += f"; the truth, known to {known_mm:.2f} mm in 95 %, could turn it"
            yield DetectionFault.OFF, names[teat], cause, why
    for number in score.match.false:
        yield DetectionFault.FALSE, "", Cause.DETECTOR, f"finding {number + 1} is at no teat"
    found, why = {teat for _, teat in score.match.hidden_pairs}, "some camera can't see its end"
    for teat, row in enumerate(trial.truth):
        if not row["visible"] and teat not in found:
            yield DetectionFault.MISSED, names[teat], Cause.NOT_VISIBLE, why


def _not_judged(run: RunRecord) -> Iterator[tuple[str, Cause, str]]:
    """Trials that were left out, and those that the run did not come to."""
    by_operator = {
        event["text"].split(":")[0]
        for event in run.events
        if event["kind"] == "skipped" and OPERATORS_EVENT in event["text"]
    }
    skipped = {str(row["trial"]): str(row["reason"]) for row in run.skipped}
    for trial, reason in skipped.items():
        cause = Cause.BENCH if "the bench died in it" in reason else Cause.TRUTH
        yield trial, Cause.OPERATOR if trial in by_operator else cause, reason
    known = {trial.id for trial in run.trials} | skipped.keys()
    if (state := state_in(run)) == "running":
        return  # it comes to them yet
    cause = Cause.OPERATOR if state == "aborted" else Cause.BENCH
    for pose in run.facts.get("pose set", {}).get("poses", ()):
        if str(pose[0]) not in known:
            yield str(pose[0]), cause, f"the run was {state} before it"
