"""From a run's record to its decisions: each requirement held against the scores and times of one
detector, and the arm's against its checks and its dated verification.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from bench.config import read_config
from bench.record.check import NOT_AS_WRITTEN
from bench.record.reader import RunRecord, TrialRecord
from bench.record.schema import RULES, SCRIPT, Row
from bench.results.cameras_agree import cameras_of, decide_cameras
from bench.results.stated_arm import (
    STATED_FACT,
    VERIFICATION_FACT,
    arm_checks,
    contradictions,
    drift_limit_mm,
    length_limit_mm,
    location_limit_mm,
    too_small,
)
from bench.results.teats_seen import TEATS_FACT
from bench.rig.arm_files import Verification, VerificationLimits, broken_by, from_dict, gaps_of
from bench.scoring.decisions import (
    Decision,
    Verdict,
    decide_condition,
    decide_count,
    decide_error,
    decide_rate,
    decide_time,
    overall,
)
from bench.scoring.errors import percentile
from bench.scoring.looks import FIRST, Looks
from bench.scoring.scene import Pool, pool
from bench.scoring.stated_u import LIMIT_LEVEL
from bench.script.calibration_age import decide_calibration
from bench.script.model import (
    ArmRequirement,
    BathRequirement,
    CalibrationRequirement,
    CamerasRequirement,
    ErrorRequirement,
    FalseRequirement,
    Requirement,
    Rules,
    Script,
    SuccessRequirement,
    TimeRequirement,
)
from bench.truth.arm_check import (
    AFTER,
    BEFORE,
    CHECK_FACT,
    location_of,
    moved_mm,
    new_touches,
    shift_mm,
)
from detector.protocol import Outcome
from textfiles.text import sentence

_CHECKS = {when: CHECK_FACT.format(when) for when in (BEFORE, AFTER)}
TESTS_FACT = "tests_not_passed"  # requirement -> test -> "failed", "error" or "failed as expected"


def decide_arm(rule: ArmRequirement, facts: Mapping[str, Any]) -> Decision:
    """Not met where a check or the dated verification breaks a limit, or refutes the stated
    uncertainty; inconclusive where one is missing. The figure is the arm's own error.
    """
    shown = _ArmEvidence(rule, facts)
    tests, dated, limit = shown.tests, shown.dated, shown.limits.location_mm
    nothing = Decision(
        name=rule.name,
        rule=_rule(rule, shown.limits),
        unit="mm",
        limit=limit,
        sentence="The rig names neither a check point nor a verification of the arm (keys"
        " check_point_mm and verification).",
    )
    if not tests and not dated:
        return nothing
    against, missing = [*shown.against()], [*shown.missing()]
    contradicted: Iterable[str] = ()
    if against and (stated := facts.get(STATED_FACT)):
        contradicted = contradictions(rule, stated, [test.n for test in tests.values()], dated)
    reasons = "; ".join([*against, *missing, *contradicted]) or shown.in_order()
    figures = [test.largest_mm for test in tests.values()]
    largest = max([*figures, dated.location_mm] if dated else figures)
    return replace(
        nothing,
        n=sum(test.n for test in (*tests.values(), *(dated.locations if dated else ()))),
        measured=largest,
        margin=limit - largest,
        verdict=(Verdict.NOT_MET if against else Verdict.INCONCLUSIVE if missing else Verdict.MET),
        sentence=sentence(reasons),
    )


@dataclass(frozen=True, slots=True)
class _ArmLimits(VerificationLimits):
    """With that on the check point's move between before and after."""

    drift_mm: float = float("inf")


class _ArmEvidence:
    """What a run's facts show of its arm, and the limits that a rule sets it."""

    def __init__(self, rule: ArmRequirement, facts: Mapping[str, Any]) -> None:
        self._rule, self._facts = rule, facts
        self._checks = {when: facts[key] for when, key in _CHECKS.items() if key in facts}
        self.dated = from_dict(facts[VERIFICATION_FACT]) if VERIFICATION_FACT in facts else None
        self.tests = {
            when: location_of(fact, f"the check {when} the trials")
            for when, fact in self._checks.items()
        }
        # The rule's, and where it leaves one out that which follows from the arm's statement
        stated, usual = facts.get(STATED_FACT), (rule.least_touches, rule.least_touches)
        touches = [*map(new_touches, self._checks.values())]
        dated = self.dated
        located = (*self.tests.values(), *(dated.locations if dated else ()))
        self.limits = _ArmLimits(
            location_limit_mm(rule, stated, [test.n for test in located] or usual),
            length_limit_mm(rule, stated, dated.lengths if dated else ()),
            drift_limit_mm(rule, stated, touches if len(touches) == len(usual) else usual),
        )

    def against(self) -> Iterator[str]:
        """A sentence for each limit that is broken."""
        rule, limits, checks, dated = self._rule, self.limits, self._checks, self.dated
        for when, test in self.tests.items():
            yield from broken_by(test, limits.location_mm)
            if (shift := shift_mm(checks[when])) > rule.shift_limit_mm:
                yield (
                    f"the check point was found {shift:.2f} mm from its place {when} the trials,"
                    f" limit {rule.shift_limit_mm:g} mm: was the arm homed, and was arm or table"
                    " moved since the frame was made?"
                )
        if len(self.tests) == 2:
            drift = moved_mm(checks[BEFORE], checks[AFTER])
            if drift > limits.drift_mm:
                yield (
                    f"the check point moved by {drift:.2f} mm during the run, limit"
                    f" {limits.drift_mm:.3g} mm: was arm or table pushed?"
                )
        if dated:
            yield from (f"in the dated verification, {text}" for text in dated.broken(limits))
            serial = self._facts.get("identities", {}).get("arm", {}).get("serial_number")
            if serial is not None and dated.serial_number != serial:
                of = f"the verification is of the arm {dated.serial_number}"
                yield f"{of}, but the run used {serial}"
            age = age_of(dated, self._facts)
            if age > timedelta(days=rule.max_age_days):
                yield f"the verification was {age.days} days old, limit {rule.max_age_days:g} days"
            if age < timedelta(0):
                yield "the verification is dated after the run began: look at the computer's clock"
        if wrong := too_small(self._facts):
            yield f"{wrong}: state what the arm shows (accuracy_mm), or have it put right"

    def missing(self) -> Iterator[str]:
        """A sentence for each thing that was not shown; an emulated arm needs no dated one."""
        rule, dated = self._rule, self.dated
        yield from (
            f"the arm was not checked {when} the trials"
            for when in _CHECKS
            if when not in self.tests
        )
        for test in self.tests.values():
            yield from gaps_of(test, rule.least_touches)
        needed = rule.dated_required and not _emulated(self._facts)
        if dated:
            yield from (f"in the dated verification, {gap}" for gap in dated.gaps(self.limits))
            if needed and not dated.lengths and rule.length_limit_mm is None:
                yield "in the dated verification, no calibrated length was measured"
        elif needed:
            yield (
                "the rig names no dated verification with a length check ('teatbench arm verify"
                " --length-mm')"
            )

    def in_order(self) -> str:
        """What was read where nothing is wrong."""
        dated, facts = self.dated, self._facts
        read = " and ".join(f"{test.largest_mm:.2f} mm {when}" for when, test in self.tests.items())
        said = f"verified on {dated.made:%Y-%m-%d}" if dated else "no dated verification is named"
        if not dated and _emulated(facts):
            said += " (an emulated arm needs none)"
        if checks := arm_checks(facts):
            u_mm, ratio = facts[STATED_FACT]["u_mm"], max(check.ratio for check in checks)
            said += f"; touches show an arm of u = {ratio * u_mm:.2f} mm, stated are {u_mm:g} mm"
        return f"one divot read within {read}; {said}"


def _emulated(facts: Mapping[str, Any]) -> bool:
    """Whether the arm was."""
    return facts.get("kind") == "emulated" or "arm" in facts.get("emulated", ())


def _rule(rule: ArmRequirement, limits: _ArmLimits) -> str:
    length_mm = limits.length_mm
    follows = f", as an arm that is as stated does but in {100 * LIMIT_LEVEL:g} % of runs"
    follows = follows if rule.location_limit_mm is None else ""
    lengths = "" if length_mm is None else f", a calibrated length within {length_mm:.3g} mm"
    dated = "required, with a length check, of a real arm"
    dated = dated if rule.dated_required else "where the rig names one"
    return (
        f"before and after the trials, touches of one divot within {limits.location_mm:.3g} mm of"
        f" their mean (articulated location, ASME B89.4.22, ISO 10360-12{follows}), their mean"
        f" within {rule.shift_limit_mm:g} mm of its place and moved by at most"
        f" {limits.drift_mm:.3g} mm;"
        f" a dated verification ({dated}) of this arm at most {rule.max_age_days:g} days"
        f" old{lengths}; the stated uncertainty not refuted by chi-square, 5 % false alarms"
    )


def age_of(dated: Verification, facts: Mapping[str, Any]) -> timedelta:
    """How old a verification was when the run began."""
    return datetime.fromisoformat(str(facts["wall_started"])) - dated.made


DetectorRequirement = ErrorRequirement | TimeRequirement | SuccessRequirement | FalseRequirement


@dataclass(frozen=True, slots=True)
class Judgement:
    """One detector's decisions in order; ``of_bench`` names those that the bench has to meet."""

    detector: str
    decisions: tuple[Decision, ...]
    of_bench: frozenset[str] = frozenset()

    @property
    def verdict(self) -> Verdict:
        """The worst of the decisions."""
        return overall(decision.verdict for decision in self.decisions)


def stored_rules(folder: Path) -> Rules:
    """The script as the run used it, or the rules that a recording was scored by."""
    script = folder / SCRIPT
    if script.is_file():
        return read_config(script, Script, stored=True)
    return read_config(folder / RULES, Rules, stored=True)


def judge(run: RunRecord, rules: Rules) -> tuple[Judgement, ...]:
    """Each detector's judgement, on the trials that there are; none is met without a verdict."""
    bench = ArmRequirement | BathRequirement | CalibrationRequirement | CamerasRequirement
    of_bench = frozenset(rule.name for rule in rules.requirements if isinstance(rule, bench))
    nothing = "" if any(trial.scores for trial in run.trials) else "Nothing was scored"
    unfinished = nothing if run.ending == "finished" else "The run is not finished"
    why, found = NOT_AS_WRITTEN if run.damage else unfinished, []
    for name in run.detectors:
        made = (_decide(r, run, scored(run, name), name, rules.looks) for r in rules.requirements)
        sure = (_doubted(decision, rules, too_small(run.facts)) for decision in made)
        decided = (beside_tests(decision, [run]) for decision in sure)
        found.append(Judgement(name, held_back(decided, why), of_bench))
    return tuple(found)


def _doubted(decision: Decision, rules: Rules, wrong: str) -> Decision:
    """The decision; inconclusive where a guard band of a wrong uncertainty let it be met."""
    guarded = {
        rule.name
        for rule in rules.requirements
        if isinstance(rule, ErrorRequirement | SuccessRequirement)
    }
    if not wrong or decision.name not in guarded or decision.verdict is not Verdict.MET:
        return decision
    sentence = f"The guard band is too narrow: {wrong}. {decision.sentence}"
    return replace(decision, verdict=Verdict.INCONCLUSIVE, sentence=sentence)


def beside_tests(decision: Decision, runs: Iterable[RunRecord]) -> Decision:
    """The decision; not met where one of its tests failed, inconclusive where one ended otherwise
    than by passing.
    """
    facts = (run.facts.get(TESTS_FACT, {}).get(decision.name, {}) for run in runs)
    ended = {test: how for tests in facts for test, how in tests.items()}
    if not ended:
        return decision
    said, verdict = ", ".join(f"{test} ({how})" for test, how in ended.items()), decision.verdict
    if verdict in (Verdict.MET, Verdict.INCONCLUSIVE):
        verdict = Verdict.NOT_MET if "failed" in ended.values() else Verdict.INCONCLUSIVE
    sentence = f"Not all its tests passed: {said}. {decision.sentence}"
    return replace(decision, verdict=verdict, sentence=sentence)


def held_back(decisions: Iterable[Decision], why: str) -> tuple[Decision, ...]:
    """The decisions; where there is a reason ``why``, all that was measured is inconclusive."""
    return tuple(
        replace(d, verdict=Verdict.INCONCLUSIVE, sentence=f"{why}. {d.sentence}")
        if why and d.verdict is not Verdict.NOT_MEASURED
        else d
        for d in decisions
    )


def run_verdict(judgements: Sequence[Judgement]) -> Verdict:
    """The verdict on the whole run: the worst of its detectors."""
    return overall(judgement.verdict for judgement in judgements)


def scored_trials(run: RunRecord, detector: str, situation: str | None = None) -> list[TrialRecord]:
    """The trials that count and were scored; of one situation where named."""
    return [
        t for t in run.counted if detector in t.scores and situation in (None, t.head["situation"])
    ]


def calls_of(
    run: RunRecord, detector: str, situation: str | None = None
) -> list[tuple[Hashable, Row]]:
    """The pose and row of each call of a detector; of one situation where named."""
    return [
        (trial.pose, row)
        for trial in run.counted
        if situation in (None, trial.head["situation"])
        for row in trial.detections
        if row["detector"] == detector
    ]


@lru_cache(maxsize=64)  # of each situation, too: most tables and figures ask for it
def scored(run: RunRecord, detector: str, situation: str | None = None) -> Pool:
    """The scores of one detector, with the pose of each; of one situation where named."""
    trials = scored_trials(run, detector, situation)
    answered = [has_answer(trial, detector) for trial in trials]
    return pool([t.scores[detector] for t in trials], [t.pose for t in trials], answered)


def has_answer(trial: TrialRecord, detector: str) -> bool:
    """Whether the detector gave one, also of no teat; a time-out and a failure are none."""
    rows = [row for row in trial.detections if row["detector"] == detector]
    return all(row["outcome"] == Outcome.ANSWERED.value for row in rows)


def _decide(
    rule: Requirement, run: RunRecord, scores: Pool, detector: str, planned: int
) -> Decision:
    match rule:
        case BathRequirement():
            set_point_c = run.facts.get("set_point_c")
            temps = [t.head["bath_c"] for t in run.trials if t.head["bath_c"] is not None]
            held = sum(abs(temp - set_point_c) <= rule.band_k for temp in temps)
            what = f"bath within {rule.band_k:g} K of the set point at every capture"
            decision = decide_condition(rule.name, what, held=held, of=len(temps))
            # The bath's decision; inconclusive where nothing showed that the teats are as warm
            why = run.facts.get(TEATS_FACT)
            if why is None:
                return decision
            sentence = f"{decision.sentence} The temperature at the teats was not measured: {why}."
            met = decision.verdict is Verdict.MET
            verdict = Verdict.INCONCLUSIVE if met else decision.verdict
            return replace(decision, verdict=verdict, sentence=sentence)
        case ArmRequirement():
            return decide_arm(rule, run.facts)
        case CalibrationRequirement():
            return decide_calibration(rule, run.facts)
        case CamerasRequirement():
            return decide_cameras(rule, cameras_of(run))
    u_mm = truth_u_mm([run], scores, detector)
    return decide_detector(rule, scores, latency_of(run, detector), u_mm, Looks(planned))


def decide_detector(
    rule: DetectorRequirement,
    scores: Pool,
    timed: Latency,
    u_mm: float | None,
    looks: Looks = FIRST,
) -> Decision:
    """A detector's requirement decided on scores and times of one or several runs, after earlier
    ``looks`` at them. Frame sets without an answer show nothing, so that none is met by silence.
    """
    decision = _decided(rule, scores, timed, u_mm, looks)
    silent = timed.silent if isinstance(rule, ErrorRequirement | FalseRequirement) else timed.failed
    unanswered = f"It did not answer on {silent} of {timed.asked} frame sets"
    if silent and silent == timed.asked:
        nothing = replace(decision, n=0, measured=None, margin=None, uncertainty=None)
        return replace(nothing, verdict=Verdict.NOT_MEASURED, sentence=f"{unanswered}.")
    if silent and decision.verdict is Verdict.MET:
        sentence = f"{decision.sentence} {unanswered}, which shows nothing for them."
        return replace(decision, verdict=Verdict.INCONCLUSIVE, sentence=sentence)
    return decision


def _decided(
    rule: DetectorRequirement, scores: Pool, timed: Latency, u_mm: float | None, looks: Looks
) -> Decision:
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
                missed=scores.counts.missed,
                looks=looks,
            )
        case FalseRequirement():
            return decide_count(
                rule.name,
                scores.counts.false,
                scenes=scores.answered,
                confidence=rule.confidence,
                per_pose=scores.worst_false,
            )
        case SuccessRequirement():
            decision = decide_rate(
                rule.name,
                scores.success,
                required=rule.rate,
                confidence=rule.confidence,
                shown=scores.surely_succeeded(rule.rate, rule.confidence, looks),
                possible=scores.perhaps_succeeded,
                looks=looks,
                leaks=scores.uncertain,
            )
        case TimeRequirement():
            decision = decide_time(
                rule.name,
                timed.seconds,
                limit_s=rule.limit_s,
                statistic=rule.statistic,
                rate=rule.rate,
                confidence=rule.confidence,
                poses=timed.poses,
                looks=looks,
            )
    sentence, verdict = decision.sentence, decision.verdict
    late = not isinstance(rule, SuccessRequirement) or scores.accurate != scores.success
    if late and timed.starved:  # said where times count
        sentence += f" {timed.starved}"
    if isinstance(rule, SuccessRequirement) and late:
        at_all = f"{scores.accurate.successes} of {scores.accurate.trials} poses"
        sentence += f" Without the time limit {at_all} succeeded."
    refused_busy = timed.starved and verdict is Verdict.NOT_MET
    if refused_busy and not _fails_without_time(rule, scores, looks):
        verdict = Verdict.INCONCLUSIVE
    return replace(decision, sentence=sentence, verdict=verdict)


def _fails_without_time(rule: DetectorRequirement, scores: Pool, looks: Looks) -> bool:
    """Whether a rate isn't met however long answers may take; a time then decides nothing."""
    if not isinstance(rule, SuccessRequirement):
        return False
    decided = decide_rate(
        rule.name, scores.accurate, required=rule.rate, confidence=rule.confidence, looks=looks
    )
    return decided.verdict is Verdict.NOT_MET


def truth_u_mm(runs: Sequence[RunRecord], scores: Pool, detector: str) -> float | None:
    """The largest uncertainty of a truth scored against; None where one of them states none."""
    trials = [trial for run in runs for trial in scored_trials(run, detector)]
    seen = [row["u_mm"] for trial in trials for row in trial.truth if row["visible"]]
    return None if None in seen else max((score.u_mm for score in scores.scores), default=0.0)


LATENCY_RULE = (
    "Answers and time-outs count; the first call of each process (cold) and its start-up stand"
    " apart, failures have no time. Percentiles are observed values."
)
STARVED_BELOW = 0.7  # share of a processor
BUSY = "THE MACHINE WAS TOO BUSY FOR THESE TIMES TO HOLD"
LEAST_TIMED_S = 0.2  # in all: a system may count a process's time in steps of 16 ms
_TIMED = (Outcome.ANSWERED.value, Outcome.TIMEOUT.value)


@dataclass(frozen=True, slots=True)
class Latency:
    """Times in the order of the trials, with pose, processor time and load; first calls stand
    apart. ``unanswered`` counts each outcome but an answer, of ``asked`` calls.
    """

    seconds: tuple[float, ...] = ()
    cold_s: tuple[float, ...] = ()
    start_up_s: float | None = None
    unanswered: Mapping[str, int] = field(default_factory=dict)
    poses: tuple[Hashable, ...] = ()
    cpu_s: tuple[float | None, ...] = ()
    loads: tuple[float | None, ...] = ()
    asked: int = 0

    @property
    def silent(self) -> int:
        """Calls without an answer."""
        return sum(self.unanswered.values())

    @property
    def failed(self) -> int:
        """Calls without a time: crashes, unusable answers, and calls after it was switched off."""
        return self.silent - self.unanswered.get(Outcome.TIMEOUT.value, 0)

    def percentile_s(self, percent: float) -> float | None:
        """None where nothing was timed."""
        return percentile(self.seconds, percent) if self.seconds else None

    @property
    def starved(self) -> str:
        """A warning where the machine gave the detector less than `STARVED_BELOW` of a processor:
        by processor seconds in the bench's process, by the machine's load in another.
        """
        timed = list(zip(self.cpu_s, self.seconds, self.loads, strict=True))
        used = [(cpu_s, seconds) for cpu_s, seconds, _ in timed if cpu_s is not None]
        loads = [load for cpu_s, _, load in timed if load is not None and cpu_s is None]
        cpu_s, wall_s = (sum(column) for column in zip(*used, strict=True)) if used else (0.0, 0.0)
        load = percentile(loads, 50) if loads else 0.0
        if wall_s >= LEAST_TIMED_S and cpu_s < STARVED_BELOW * wall_s:
            why = f"in {wall_s:.1f} s of detection it had a processor for {cpu_s:.1f} s; it waited"
            why += " for one, or for something else"
        elif load > 1.0 / STARVED_BELOW:
            why = f"half of the time {load:.1f} or more processes wanted each processor"
        else:
            return ""
        return f"{BUSY}: {why}. On an idle machine they may be shorter."


def latency_of(run: RunRecord, detector: str, situation: str | None = None) -> Latency:
    """The times of one detector over the trials that count; of one situation where named."""
    return latency(calls_of(run, detector, situation))


def latency(rows: Sequence[tuple[Hashable, Row]]) -> Latency:
    """The times of calls, each with its pose."""
    timed = [(pose, row) for pose, row in rows if row["outcome"] in _TIMED]
    warm = [(pose, row) for pose, row in timed if not row["cold"]]
    outcomes = Counter(row["outcome"] for _, row in rows)
    del outcomes[Outcome.ANSWERED.value]
    starts = [row["wall_start_up_s"] for _, row in rows if row["wall_start_up_s"] is not None]
    return Latency(
        seconds=tuple(row["wall_seconds"] for _, row in warm),
        cold_s=tuple(row["wall_seconds"] for _, row in timed if row["cold"]),
        start_up_s=max(starts, default=None),
        unanswered=outcomes,
        poses=tuple(pose for pose, _ in warm),
        cpu_s=tuple(row["wall_cpu_s"] for _, row in warm),
        loads=tuple(row["wall_load"] for _, row in warm),
        asked=len(rows),
    )


def failures_text(latency: Latency) -> str:
    """``3 timeout, 1 failure``; ``none``."""
    counts = sorted(latency.unanswered.items())
    return ", ".join(f"{count} {outcome}" for outcome, count in counts) or "none"
