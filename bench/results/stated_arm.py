"""The arm's stated uncertainty, and what a run's touches and the dated verification say of it.

The touches of one divot scatter as an arm of the stated u along each axis would: n of them have
3 (n - 1) degrees of freedom about their mean. A length's error is that of two touches and of the
gauge. What all touches of one divot have in common shows in lengths only, and between divots.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from math import sqrt
from typing import Any

import numpy as np
import scipy

from bench.rig.arm_files import LengthTest, LocationTest, Verification, from_dict
from bench.rig.model import ArmTable
from bench.scoring.stated_u import (
    LIMIT_LEVEL,
    StatedCheck,
    chance_of_refusal,
    largest_limit_mm,
    refuted,
    squares_limit,
)
from bench.script.model import ArmRequirement, Requirement
from bench.truth.arm_check import AFTER, BEFORE, CHECK_FACT, location_of

STATED_FACT = "arm uncertainty"
VERIFICATION_FACT = "arm verification"


def stated_fact(arm: ArmTable) -> dict[str, Any]:
    """What the rig file states of the arm; ``df`` None: taken as exact."""
    return {
        "u_mm": arm.accuracy_mm,
        "source": arm.accuracy_source,
        "df": arm.accuracy_df,
        "resolution_mm": arm.rounding_mm,
    }


def check_touches(name: str, stated: Mapping[str, Any], *tests: LocationTest) -> StatedCheck:
    """The scatter of each test about its own mean."""
    squares = sum(float(np.sum(test.deviations_mm**2)) for test in tests)
    df = 3 * sum(test.n - 1 for test in tests)
    return StatedCheck(name, squares / _touch_mm2(stated), df, stated["df"])


def check_verification(stated: Mapping[str, Any], dated: Verification) -> Iterator[StatedCheck]:
    """Its divots; and its lengths, where there are some."""
    yield check_touches("divots of the dated verification", stated, *dated.locations)
    if dated.lengths:
        squares = sum(
            one.error_mm**2 / (one.touches * _touch_mm2(stated) + one.calibrated_u_mm**2)
            for one in dated.lengths
        )
        name = "lengths of the dated verification"
        yield StatedCheck(name, squares, len(dated.lengths), stated["df"])


def arm_checks(facts: Mapping[str, Any]) -> list[StatedCheck]:
    """All checks of the arm's stated uncertainty that a run's facts allow; none of an older run."""
    if (stated := facts.get(STATED_FACT)) is None:
        return []
    keys = [key for when in (BEFORE, AFTER) if (key := CHECK_FACT.format(when)) in facts]
    if keys and "new" in facts[keys[-1]]:
        keys = keys[-1:]  # it has the touches of the other
    tests = [location_of(facts[key], key) for key in keys]
    checks = [check_touches("check touches of the run", stated, *tests)] if tests else []
    if VERIFICATION_FACT in facts:
        checks += check_verification(stated, from_dict(facts[VERIFICATION_FACT]))
    return checks


def too_small(facts: Mapping[str, Any]) -> str:
    """Says that the stated uncertainty is too small, and by how much; "" where nothing says so."""
    found = refuted(arm_checks(facts))
    if not found:
        return ""
    u_mm, worst = facts[STATED_FACT]["u_mm"], max(found, key=lambda check: check.ratio)
    return (
        f"the {worst.name} differ as those of an arm of u = {worst.ratio * u_mm:.2f} mm do; stated"
        f" are {u_mm:g} mm (chi-square {worst.squares:.1f} with {worst.df} degrees of freedom,"
        f" p = {worst.p_value:.2g})"
    )


def _touch_mm2(stated: Mapping[str, Any]) -> float:
    """Variance of one touch of a divot along an axis."""
    return float(stated["u_mm"] ** 2 + stated["resolution_mm"] ** 2)


REPORTED_ABOVE = 0.05  # chance that a limit refuses an arm that is as stated


def location_limit_mm(
    rule: ArmRequirement, stated: Mapping[str, Any] | None, sizes: Sequence[int]
) -> float:
    """The script's limit on touches of one divot, or what the arm's statement gives for so many."""
    if rule.location_limit_mm is not None or stated is None:
        return rule.location_limit_mm or float("inf")
    return largest_limit_mm(sqrt(_touch_mm2(stated)), sizes, stated["df"])


def drift_limit_mm(
    rule: ArmRequirement, stated: Mapping[str, Any] | None, sizes: Sequence[int]
) -> float:
    """The same for the difference between the means of two groups."""
    if rule.drift_limit_mm is not None or stated is None:
        return rule.drift_limit_mm or float("inf")
    return _drift_mm(stated, sizes)


def unmoved_mm(rules: Iterable[Requirement], arm: ArmTable) -> float:
    """How near to the mean of an earlier check's touches one more has to be to show that nothing
    has moved: as two whole checks may differ.
    """
    stated, sizes = stated_fact(arm), (arm.check_touches,) * 2
    limits = [
        drift_limit_mm(one, stated, sizes) for one in rules if isinstance(one, ArmRequirement)
    ]
    return min(limits, default=_drift_mm(stated, sizes))


def _drift_mm(stated: Mapping[str, Any], sizes: Sequence[int]) -> float:
    squared = squares_limit(3, LIMIT_LEVEL, stated["df"])
    return sqrt(_touch_mm2(stated) * sum(1.0 / n for n in sizes) * squared)


def length_limit_mm(
    rule: ArmRequirement, stated: Mapping[str, Any] | None, lengths: Sequence[LengthTest]
) -> float | None:
    """The same for the largest error of a calibrated length; None where none is asked for."""
    if rule.length_limit_mm is not None or stated is None or not lengths:
        return rule.length_limit_mm
    return _length_limit_mm(stated, lengths)


def _length_limit_mm(stated: Mapping[str, Any], lengths: Sequence[LengthTest]) -> float:
    """That the least certain of them exceeds as seldom as all of them may."""
    squared = squares_limit(1, LIMIT_LEVEL / len(lengths), stated["df"])
    return max(_length_sds(stated, lengths)) * sqrt(squared)


def _length_sds(stated: Mapping[str, Any], lengths: Sequence[LengthTest]) -> list[float]:
    touch = _touch_mm2(stated)
    return [sqrt(one.touches * touch + one.calibrated_u_mm**2) for one in lengths]


def contradictions(
    rule: ArmRequirement,
    stated: Mapping[str, Any],
    touches: Sequence[int],
    dated: Verification | None,
) -> Iterator[str]:
    """A sentence for each limit of the script that refuses an arm exactly as the rig states it in
    more than `REPORTED_ABOVE` of runs. ``touches``: of the check point, before and after trials.
    """
    u_mm, df = sqrt(_touch_mm2(stated)), stated["df"]
    sizes = [*touches, *(test.n for test in (dated.locations if dated else ()))]
    chances: list[tuple[str, float | None, float, float]] = []
    if rule.location_limit_mm is not None and sizes:
        chance, fits = chance_of_refusal(rule.location_limit_mm, u_mm, sizes, df), 0.0
        fits = largest_limit_mm(u_mm, sizes, df)
        chances.append(("location_limit_mm", rule.location_limit_mm, chance, fits))
    if rule.length_limit_mm is not None and dated and dated.lengths:
        sds = _length_sds(stated, dated.lengths)
        beyond = (float(scipy.special.ndtr(-rule.length_limit_mm / sd)) for sd in sds)
        within = np.prod([1.0 - 2.0 * one for one in beyond])
        fits = _length_limit_mm(stated, dated.lengths)
        chances.append(("length_limit_mm", rule.length_limit_mm, 1.0 - float(within), fits))
    for key, limit_mm, chance, fits in chances:
        if chance > REPORTED_ABOVE:
            yield (
                f"{key} = {limit_mm:g} mm contradicts the arm's stated accuracy of"
                f" {stated['u_mm']:g} mm along an axis: it refuses an arm that is exactly as stated"
                f" in {100 * chance:.0f} % of runs. Leave it out, and the limit follows from the"
                f" statement ({fits:.2f} mm); or state the arm as it is (accuracy_mm)"
            )
