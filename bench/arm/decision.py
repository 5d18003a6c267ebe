"""Was the arm verified? The requirement of a script held against what the run knows of its arm: the checks before and after the
trials, and the dated verification that the rig names. Pure: facts in, a `Decision` out.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime, timedelta
from itertools import chain
from typing import Any

import numpy as np

from bench.arm.check import AFTER, BEFORE, CHECK_FACT, location_of, shift_mm
from bench.arm.verification import Limits, Verification, broken_by, from_dict, gaps_of
from bench.scoring.decisions import Decision, Verdict
from bench.script import ArmRequirement

VERIFICATION_FACT = "arm verification"


def decide_arm(rule: ArmRequirement, facts: Mapping[str, Any]) -> Decision:
    """Met where both checks and the dated verification keep every limit; not met where one breaks any; inconclusive where one of
    them is missing or shows too little; not measured where the rig names neither.

    There is no guard band: the figure is the arm's own error, with the divot's in it.
    """
    checks = {when: facts[CHECK_FACT.format(when)] for when in (BEFORE, AFTER) if CHECK_FACT.format(when) in facts}
    dated = from_dict(facts[VERIFICATION_FACT]) if VERIFICATION_FACT in facts else None
    n = sum(len(fact["touches"]) for fact in checks.values())
    if not checks and not dated:
        sentence = "The rig names neither a check point nor a verification of the arm (keys check_point_mm and verification)."
        return _decision(rule, 0, None, Verdict.NOT_MEASURED, sentence)
    found = [location_of(fact, when).largest_mm for when, fact in checks.items()] + ([dated.location_mm] if dated else [])
    against = [*chain.from_iterable(_check_faults(rule, fact, when) for when, fact in checks.items()), *_drift_faults(rule, checks)]
    against += _dated_faults(rule, dated, facts) if dated else []
    missing = [f"the arm was not checked {when} the trials" for when in (BEFORE, AFTER) if when not in checks]
    missing += chain.from_iterable(gaps_of(location_of(fact, _called(when)), rule.least_touches) for when, fact in checks.items())
    missing += [f"in the dated verification, {gap}" for gap in dated.gaps(_limits(rule))] if dated else []
    if not dated and rule.dated_required:
        missing.append("the rig names no dated verification")
    touches = n + (sum(test.n for test in dated.locations) if dated else 0)
    verdict = Verdict.NOT_MET if against else Verdict.INCONCLUSIVE if missing else Verdict.MET
    sentence = _sentence("; ".join(against + missing) or _shown(checks, dated))
    return _decision(rule, touches, max(found), verdict, sentence)


def _decision(rule: ArmRequirement, n: int, measured: float | None, verdict: Verdict, sentence: str) -> Decision:
    limit = rule.location_limit_mm
    margin = None if measured is None else limit - measured
    return Decision(rule.name, _rule(rule), n, measured, "mm", limit, margin, None, verdict, sentence)


def _rule(rule: ArmRequirement) -> str:
    lengths = "" if rule.length_limit_mm is None else f", a calibrated length within {rule.length_limit_mm:g} mm"
    dated = "required" if rule.dated_required else "where the rig names one"
    return (
        f"before and after the trials, touches of one divot within {rule.location_limit_mm:g} mm of their mean (articulated location, "
        f"ASME B89.4.22, ISO 10360-12), their mean within {rule.shift_limit_mm:g} mm of its place and moved by at most "
        f"{rule.drift_limit_mm:g} mm; a dated verification ({dated}) of this arm "
        f"at most {rule.max_age_days:g} days old{lengths}"
    )


def _check_faults(rule: ArmRequirement, fact: Mapping[str, Any], when: str) -> list[str]:
    faults = broken_by(location_of(fact, _called(when)), rule.location_limit_mm)
    shift = shift_mm(fact)
    if shift > rule.shift_limit_mm:
        faults.append(
            f"the check point was found {shift:.2f} mm from its place {when} the trials, limit {rule.shift_limit_mm:g} mm: "
            "was the arm homed, and was arm or table moved since the frame was made?"
        )
    return faults


def _drift_faults(rule: ArmRequirement, checks: Mapping[str, Mapping[str, Any]]) -> list[str]:
    if len(checks) < 2:
        return []
    first, last = (location_of(checks[when], when).centre_mm for when in (BEFORE, AFTER))
    drift = float(np.linalg.norm(last - first))
    if drift <= rule.drift_limit_mm:
        return []
    return [f"the check point moved by {drift:.2f} mm during the run, limit {rule.drift_limit_mm:g} mm: was arm or table pushed?"]


def _dated_faults(rule: ArmRequirement, dated: Verification, facts: Mapping[str, Any]) -> list[str]:
    faults = [f"in the dated verification, {text}" for text in dated.broken(_limits(rule))]
    serial = facts.get("identities", {}).get("arm", {}).get("serial_number")
    if serial is not None and dated.serial_number != serial:
        faults.append(f"the verification is of the arm {dated.serial_number}, but the run used {serial}")
    age = age_of(dated, facts)
    if age > timedelta(days=rule.max_age_days):
        faults.append(f"the verification was {age.days} days old, limit {rule.max_age_days:g} days")
    if age < timedelta(0):
        faults.append("the verification is dated after the run began: look at the computer's clock")
    return faults


def _called(when: str) -> str:
    return f"the check {when} the trials"


def _limits(rule: ArmRequirement) -> Limits:
    return Limits(rule.location_limit_mm, rule.length_limit_mm)


def age_of(dated: Verification, facts: Mapping[str, Any]) -> timedelta:
    """How old a verification was when the run began."""
    return datetime.fromisoformat(str(facts["wall_started"])) - dated.made


def _shown(checks: Mapping[str, Mapping[str, Any]], dated: Verification | None) -> str:
    largest = {when: location_of(fact, when).largest_mm for when, fact in checks.items()}
    checked = " and ".join(f"{value:.2f} mm {when}" for when, value in largest.items())
    return f"one divot read within {checked}" + (f"; verified on {dated.made:%Y-%m-%d}" if dated else "; no dated verification is named")


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}."
