"""What each missed, wrong or unjudged teat is attributed to: detector, truth, bench, operator, or
not visible. A fault of the bench is never a failure of the detector.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

from bench.record.reader import RunRecord, TrialRecord
from bench.safety.stability import State
from bench.scoring.scene import SceneScore

OPERATORS_EVENT = "the operator skipped it"


class Cause(StrEnum):
    """Whose it is."""

    DETECTOR = "detector"
    TRUTH = "truth"
    BENCH = "bench"
    OPERATOR = "operator"
    NOT_VISIBLE = "not visible"


class What(StrEnum):
    """What became of a teat, or of a whole trial."""

    MISSED = "missed"
    OFF = "further off than the limit"
    FALSE = "false finding"
    NOT_JUDGED = "trial not judged"


@dataclass(frozen=True, slots=True)
class Attributed:
    """One thing that is not as it should be; ``teat`` is empty for a false one or a trial."""

    trial: str
    detector: str
    teat: str
    what: What
    cause: Cause
    why: str


def attributed(run: RunRecord, detector: str) -> tuple[Attributed, ...]:
    """Everything of ``detector`` in the order of the trials; then trials that nobody judged."""
    return (
        *(one for trial in run.trials for one in _of_trial(trial, detector)),
        *_not_judged(run, detector),
    )


def counted(found: tuple[Attributed, ...]) -> Counter[tuple[What, Cause]]:
    """How many of each kind are whose."""
    return Counter((one.what, one.cause) for one in found)


def _of_trial(trial: TrialRecord, detector: str) -> Iterator[Attributed]:
    score = trial.scores.get(detector)
    if score is None:
        return
    for what, teat, cause, why in _wrong(trial, score, detector):
        if trial.invalid is not None:
            cause, why = Cause.TRUTH, trial.invalid
        elif trial.head["bath_state"] not in (None, State.STABLE.value) and cause is Cause.DETECTOR:
            cause, why = (
                Cause.BENCH,
                f"the bath was {trial.head['bath_state']}, not stable, when the frames were taken",
            )
        yield Attributed(trial.id, detector, teat, what, cause, why)


def _wrong(
    trial: TrialRecord, score: SceneScore, detector: str
) -> Iterator[tuple[What, str, Cause, str]]:
    names = [str(row["teat"]) for row in trial.truth]
    reasons = [row["reason"] for row in trial.detections if row["detector"] == detector]
    unseen = "it was visible and nothing was found within the gate"
    for teat in score.match.missed:
        yield What.MISSED, names[teat], Cause.DETECTOR, str(next(filter(None, reasons), unseen))
    for (_, teat), distance in zip(score.match.pairs, score.radial_mm, strict=True):
        if distance > score.limit_mm:
            near = teat in score.doubtful
            why = f"{distance:.2f} mm off, limit {score.limit_mm:g} mm"
            more = f"; the truth's uncertainty ({score.u_mm:.2f} mm) could turn it" if near else ""
            yield What.OFF, names[teat], Cause.TRUTH if near else Cause.DETECTOR, why + more
    for number in score.match.false:
        yield What.FALSE, "", Cause.DETECTOR, f"finding {number + 1} is at no teat"
    found = {teat for _, teat in score.match.hidden_pairs}
    for teat, row in enumerate(trial.truth):
        if not row["visible"] and teat not in found:
            yield What.MISSED, names[teat], Cause.NOT_VISIBLE, "some camera can't see its end"


def _not_judged(run: RunRecord, detector: str) -> Iterator[Attributed]:
    """Trials that were left out, and those that the run did not come to."""
    by_operator = {
        event["text"].split(":")[0]
        for event in run.events
        if event["kind"] == "skipped" and OPERATORS_EVENT in event["text"]
    }
    for row in run.skipped:
        trial, reason = str(row["trial"]), str(row["reason"])
        cause = Cause.BENCH if "the bench died in it" in reason else Cause.TRUTH
        cause = Cause.OPERATOR if trial in by_operator else cause
        yield Attributed(trial, detector, "", What.NOT_JUDGED, cause, reason)
    known = {trial.id for trial in run.trials} | {str(row["trial"]) for row in run.skipped}
    cause = Cause.OPERATOR if run.ending == "aborted" else Cause.BENCH
    why = f"the run was {run.ending} before it"
    for pose in run.facts.get("pose set", {}).get("poses", ()):
        if str(pose[0]) not in known:
            yield Attributed(str(pose[0]), detector, "", What.NOT_JUDGED, cause, why)
