"""From a run's record to its decisions: each requirement of the script or rules held against the scores of one detector."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bench.arm.decision import decide_arm
from bench.calibration_age import decide_calibration
from bench.detecting.latency import Latency, latency_of
from bench.record import RunRecord
from bench.scoring.decisions import Decision, Verdict, decide_condition, decide_count, decide_rate, decide_time, overall
from bench.scoring.error_decision import decide_error
from bench.scoring.pool import Pool, pool
from bench.script import (
    ArmRequirement,
    BathRequirement,
    CalibrationRequirement,
    ErrorRequirement,
    FalseRequirement,
    Requirement,
    Rules,
    SuccessRequirement,
    TimeRequirement,
)
from bench.store.check import NOT_AS_WRITTEN

DetectorRequirement = ErrorRequirement | TimeRequirement | SuccessRequirement | FalseRequirement


@dataclass(frozen=True, slots=True)
class Judgement:
    """One detector's decisions, in the order of the script's requirements, and the verdict that they add up to.

    ``of_bench`` names the requirements that the bench has to meet, not the detector.
    """

    detector: str
    decisions: tuple[Decision, ...]
    of_bench: frozenset[str] = frozenset()

    @property
    def verdict(self) -> Verdict:
        """The worst of the decisions."""
        return overall(decision.verdict for decision in self.decisions)


def judge(run: RunRecord, rules: Rules) -> tuple[Judgement, ...]:
    """Each detector's judgement. An unfinished run is judged on the trials that it has."""
    bench = ArmRequirement | BathRequirement | CalibrationRequirement
    of_bench = frozenset(rule.name for rule in rules.requirements if isinstance(rule, bench))
    return tuple(
        Judgement(name, held_back((_decide(rule, run, scored(run, name), name) for rule in rules.requirements), run.damage), of_bench)
        for name in run.detectors
    )


def held_back(decisions: Iterable[Decision], damage: Sequence[str]) -> tuple[Decision, ...]:
    """The decisions; where the record is damaged, all of them inconclusive."""
    if not damage:
        return tuple(decisions)
    return tuple(replace(d, verdict=Verdict.INCONCLUSIVE, sentence=f"{NOT_AS_WRITTEN}. {d.sentence}") for d in decisions)


def run_verdict(judgements: Sequence[Judgement]) -> Verdict:
    """The verdict on the whole run: the worst of its detectors."""
    return overall(judgement.verdict for judgement in judgements)


def scored(run: RunRecord, detector: str, situation: str | None = None) -> Pool:
    """The scores of one detector, with the pose of each; of one situation where named."""
    trials = [t for t in run.counted if detector in t.scores and situation in (None, t.head["situation"])]
    return pool([t.scores[detector] for t in trials], [t.pose for t in trials])


def _decide(rule: Requirement, run: RunRecord, scores: Pool, detector: str) -> Decision:
    match rule:
        case BathRequirement():
            return _bath(rule, run)
        case ArmRequirement():
            return decide_arm(rule, run.facts)
        case CalibrationRequirement():
            return decide_calibration(rule, run.facts)
        case _:
            return decide_detector(rule, scores, latency_of(run, detector), truth_u_mm([run], scores, detector))


def decide_detector(rule: DetectorRequirement, scores: Pool, timed: Latency, u_mm: float | None) -> Decision:
    """What a detector has to meet, held against its scores and times, of one run or of several; ``u_mm`` as ``truth_u_mm`` gives it.

    Nothing is met by silence: a frame set without an answer shows no error, no false teat and no time.
    """
    decision = _decided(rule, scores, timed, u_mm)
    silent = timed.silent if isinstance(rule, ErrorRequirement | FalseRequirement) else timed.failed
    told = f"It did not answer on {silent} of {timed.asked} frame sets"
    if silent and silent == timed.asked:
        nothing = replace(decision, n=0, measured=None, margin=None, uncertainty=None)
        return replace(nothing, verdict=Verdict.NOT_MEASURED, sentence=f"{told}.")
    if silent and decision.verdict is Verdict.MET:
        sentence = f"{decision.sentence} {told}, which shows nothing for them."
        return replace(decision, verdict=Verdict.INCONCLUSIVE, sentence=sentence)
    return decision


def _decided(rule: DetectorRequirement, scores: Pool, timed: Latency, u_mm: float | None) -> Decision:
    match rule:
        case ErrorRequirement():
            return decide_error(
                rule.name,
                np.linalg.norm(scores.errors_mm, axis=1),
                limit_mm=rule.limit_mm,
                u_mm=u_mm,
                rate=rule.rate,
                confidence=rule.confidence,
                poses=scores.error_poses,
                statistic=rule.statistic,
                missed=scores.counts.missed,
            )
        case SuccessRequirement():
            rate, sure = rule.rate, rule.confidence
            shown, possible = scores.surely_succeeded(rate, sure), scores.perhaps_succeeded
            decision = decide_rate(rule.name, scores.success, required=rate, confidence=sure, shown=shown, possible=possible)
        case FalseRequirement():
            of, false = len(scores.scores), scores.counts.false
            return decide_count(rule.name, false, scenes=of, confidence=rule.confidence, per_pose=scores.worst_false)
        case TimeRequirement():
            how, rate_of, sure = rule.statistic, rule.rate, rule.confidence
            decision = decide_time(
                rule.name, timed.seconds, limit_s=rule.limit_s, statistic=how, rate=rate_of, confidence=sure, poses=timed.poses
            )
    return replace(decision, sentence=f"{decision.sentence} {timed.starved}".strip())


def truth_u_mm(runs: Sequence[RunRecord], scores: Pool, detector: str) -> float | None:
    """The largest uncertainty of a truth that the detector was scored against; None where one of them states none."""
    trials = [trial for run in runs for trial in run.counted if detector in trial.scores]
    stated = all(row["u_mm"] is not None for trial in trials for row in trial.truth if row["visible"])
    return max((score.u_mm for score in scores.scores), default=0.0) if stated else None


def _bath(rule: BathRequirement, run: RunRecord) -> Decision:
    set_point_c = run.facts.get("set_point_c")
    temps = [trial.head["bath_c"] for trial in run.trials if trial.head["bath_c"] is not None]
    held = sum(abs(temp - set_point_c) <= rule.band_k for temp in temps)
    return decide_condition(rule.name, f"bath within {rule.band_k:g} K of the set point at every capture", held=held, of=len(temps))
