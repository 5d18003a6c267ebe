"""From figures to verdicts: met, not met, inconclusive, not measured. No limit has a default.

A rate is decided on its exact bounds, an error on its guard band: accepted below it, refused above
it, undecided between. Bounds count poses; too few poses are inconclusive however good the figures.
The confidence in an error is shared between chance in the draw of poses and chance in the truth
(`rates.guarded_n`): 59 poses for 95/95 far from the limit, 91 at the edge of the guard band. A
further look at poses that were judged before takes what is left of that chance (`looks`).
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Literal

import numpy as np
import numpy.typing as npt

from bench.scoring.errors import Floats, as_values, numbered, percentile
from bench.scoring.guard_band import acceptance_limit_mm, leak, refusal_limit_mm
from bench.scoring.looks import FIRST, Looks, RateTest
from bench.scoring.rates import (
    Rate,
    exact_percent,
    guarded_n,
    percent,
    percent_apart,
    pose_successes,
    shown_rate,
    zero_failure_n,
)
from textfiles.text import plural


class Verdict(StrEnum):
    """What is said of a requirement."""

    MET = "met"
    NOT_MET = "not met"
    INCONCLUSIVE = "inconclusive"
    NOT_MEASURED = "not measured"


TIMES = "times"  # the unit of a condition that held at so many looks


@dataclass(frozen=True, slots=True, kw_only=True)
class Decision:
    """One requirement decided; by default not measured. ``margin`` is positive on the good side,
    ``uncertainty`` one-sided; ``accept`` is an error's acceptance limit; ``missing``: how many more
    poses without a failure would show it, None where it is no matter of poses.
    """

    name: str
    rule: str
    n: int = 0
    measured: float | None = None
    unit: str = ""
    limit: float
    margin: float | None = None
    uncertainty: float | None = None
    verdict: Verdict = Verdict.NOT_MEASURED
    sentence: str
    accept: float | None = None
    missing: int | None = None


def overall(verdicts: Iterable[Verdict]) -> Verdict:
    """The worst; inconclusive also where one is not measured, or where there are none."""
    given = set(verdicts)
    if Verdict.NOT_MET in given:
        return Verdict.NOT_MET
    return Verdict.MET if given == {Verdict.MET} else Verdict.INCONCLUSIVE


def decide_rate(
    name: str,
    rate: Rate,
    *,
    required: float,
    confidence: float,
    shown: Rate | None = None,
    possible: Rate | None = None,
    looks: Looks = FIRST,
    leaks: bool = False,
) -> Decision:
    """Is the true rate at least `required`? By bounds over poses: the lower of `shown` (sure
    successes), the upper of `possible` (all but sure failures). ``leaks``: as `RateTest.lower`.
    """
    sure, open_to = shown or rate, possible or rate
    test = RateTest(required, confidence, looks)
    share, surely = exact_percent(required), exact_percent(confidence)
    least = zero_failure_n(required, looks.first_confidence(confidence))
    none = f"No pose was tried; {least} without a failure would show {share}."
    nothing = Decision(
        name=name,
        rule=f"{test.words}: at least {share}",
        unit="%",
        limit=100 * required,
        sentence=none,
    )
    low, high, value = test.lower(sure, leaks=leaks), test.upper(open_to), rate.value
    if low is None or high is None or value is None:
        return nothing
    verdict, reason = Verdict.MET, f"a rate of at least {percent_apart(low, required)} is shown"
    missing = None
    if high < required:
        verdict = Verdict.NOT_MET
        reason = f"a rate of at most {percent_apart(high, required)} is shown"
    elif low < required:
        verdict = Verdict.INCONCLUSIVE
        missing = test.more(sure, leaks=leaks)
        more = _more(missing, "would show", share)
        reason = f"only {percent_apart(low, required)} is shown; {more}"
    fail, succeed = rate.successes - sure.successes, open_to.successes - rate.successes
    turned = [
        f"{fail} of them could be failures" if fail else "",
        f"{succeed} of the failures could be successes" if succeed else "",
    ]
    doubted = " and ".join(filter(None, turned))
    within = f"; within the truth's uncertainty {doubted}" if doubted else ""
    return replace(
        nothing,
        n=rate.trials,
        measured=100 * value,
        margin=100 * value - 100 * required,
        uncertainty=100 * (high - value if verdict is Verdict.NOT_MET else value - low),
        verdict=verdict,
        sentence=f"{rate.successes} of {plural(rate.trials, 'pose')} succeeded ({percent(value)}"
        f"{within}): {reason}, with {surely} confidence (one-sided).",
        missing=missing,
    )


def decide_time(
    name: str,
    seconds: npt.ArrayLike,
    *,
    limit_s: float,
    statistic: Literal["p95", "max"],
    rate: float | None = None,
    confidence: float = 0.95,
    poses: Sequence[Hashable] | None = None,
    looks: Looks = FIRST,
) -> Decision:
    """Are the detections (n,) in time? With a `rate` inconclusive where the poses show less. A pose
    is in time when all its detections are.
    """
    values = as_values(seconds, "seconds")
    if rate is not None and statistic == "p95" and rate != 0.95:
        raise ValueError(
            f"decide_time: a p95 says it of 95 % and not of {exact_percent(rate)}; use"
            " statistic='max' to claim another rate"
        )
    what = "largest time" if statistic == "max" else "95th percentile of the time"
    rule = f"{what} of a detection at most {limit_s:g} s"
    if rate is not None:
        rule += (
            f"; at least {zero_failure_n(rate, confidence)} poses in time show it for"
            f" {exact_percent(rate)}, {exact_percent(confidence)} confidence (one-sided)"
        )
    nothing = Decision(
        name=name, rule=rule, unit="s", limit=limit_s, sentence="No detection was timed."
    )
    if not len(values):
        return nothing
    measured = float(values.max()) if statistic == "max" else percentile(values, 95)
    in_time = pose_successes(
        range(len(values)) if poses is None else poses, (values <= limit_s).tolist()
    )
    test = RateTest(rate or 0.95, confidence, looks)
    low = test.lower(in_time) or 0.0
    sentence = (
        f"The {what} over {plural(len(values), 'detection')} is {measured:.3g} s, limit {limit_s:g}"
        f" s; {in_time.successes} of {plural(in_time.trials, 'pose')} in time, which shows"
        f" {percent_apart(low, rate or 0.95)}"
    )
    verdict, missing = Verdict.MET if measured <= limit_s else Verdict.NOT_MET, None
    if verdict is Verdict.MET and rate is not None and low < rate:
        verdict, missing = Verdict.INCONCLUSIVE, test.more(in_time)
        sentence += f"; {_more(missing, 'would show it for', exact_percent(rate))}"
    return replace(
        nothing,
        n=in_time.trials,
        measured=measured,
        margin=limit_s - measured,
        verdict=verdict,
        sentence=f"{sentence}.",
        missing=missing,
    )


def decide_count(
    name: str,
    count: int,
    *,
    scenes: int,
    confidence: float = 0.95,
    per_pose: Sequence[int] | None = None,
) -> Decision:
    """Is there none (such as a false teat) in the scenes that were answered? With the upper bound
    of the share of poses that have one (Clopper-Pearson): several come together, so their mean has
    no such bound. `per_pose` is the count of each pose's worst scene (None: each scene is a pose).
    """
    rule = "at most 0 in all scenes that were run and answered"
    if not scenes:
        return Decision(name=name, rule=rule, limit=0.0, sentence="No scene was scored.")
    worst = [1] * min(count, scenes) + [0] * max(scenes - count, 0)
    having = Rate(sum(map(bool, worst if per_pose is None else per_pose)), len(per_pose or worst))
    where = plural(scenes, "scene")
    if having.trials != scenes:
        where += f" of {plural(having.trials, 'pose')}"
    bound = percent(having.upper_bound(confidence) or 0.0)
    seen = f", in {having.successes} of the poses" if having.successes else ""
    return Decision(
        name=name,
        rule=rule,
        n=having.trials,
        measured=float(count),
        limit=0.0,
        margin=float(-count),
        verdict=Verdict.NOT_MET if count else Verdict.MET,
        sentence=f"{count} in {where}{seen}: in the long run at most {bound} of poses have one,"
        f" with {exact_percent(confidence)} confidence (one-sided).",
    )


def decide_condition(name: str, rule: str, *, held: int, of: int) -> Decision:
    """Did a condition of the bench (bath in band, arm verified) hold each time it was looked at?"""
    failures = Rate(held, of).failures
    if not of:
        sentence = "The condition was never looked at."
        return Decision(name=name, rule=rule, unit=TIMES, limit=0.0, sentence=sentence)
    return Decision(
        name=name,
        rule=rule,
        n=of,
        unit=TIMES,
        measured=float(held),
        limit=float(of),
        margin=float(-failures),
        verdict=Verdict.NOT_MET if failures else Verdict.MET,
        sentence=f"Held {held} of {plural(of, 'time')}.",
    )


def decide_error(
    name: str,
    errors_mm: npt.ArrayLike,
    *,
    limit_mm: float,
    u_mm: float | None,
    rate: float,
    confidence: float,
    poses: Sequence[Hashable] | None = None,
    missed: int = 0,
    looks: Looks = FIRST,
) -> Decision:
    """Is the distance (n,) below `limit_mm` in a share `rate` of poses? Decided on the largest;
    without u_mm nothing is accepted.
    """
    worst = worst_per_pose(np.abs(as_values(errors_mm, "errors")), poses)
    accept = None if u_mm is None else acceptance_limit_mm(limit_mm, u_mm)
    refuse = refusal_limit_mm(limit_mm, u_mm or 0.0)
    n, share = len(worst), exact_percent(rate)
    sure = confidence if looks.again else looks.first_confidence(confidence)
    least, counted = zero_failure_n(rate, sure), looks.fewest_poses(n, rate, confidence)
    accepted = "nothing" if accept is None else f"{accept:.3f} mm"
    nothing = Decision(
        name=name,
        rule=(
            f"{_guard_band(limit_mm, u_mm, accepted, refuse)}; at least {least} poses show it for"
            f" {share} of poses with {exact_percent(sure)} confidence (one-sided)"
            f"{', more near the acceptance limit' if u_mm else ''}"
        ),
        unit="mm",
        limit=limit_mm,
        sentence="No teat was found, so no error was measured.",
        accept=accept,
    )
    if not n:
        return nothing
    measured, verdict, missing = float(worst.max()), Verdict.INCONCLUSIVE, None
    most = f"the acceptance limit of {accepted}"
    if measured >= refuse:
        verdict = Verdict.NOT_MET
        reason = f"at or beyond the refusal limit of {refuse:.3f} mm"
    elif u_mm is None or accept is None:
        reason = _nothing_accepted(limit_mm, u_mm)
    elif measured > accept:
        reason = f"above {most} and not shown to be beyond {limit_mm:g} mm"
    else:
        enough = guarded_n(0, rate, sure, leak(measured, limit_mm, u_mm))
        verdict, claim = _claim(n, least, enough, share, counted)
        if verdict is Verdict.INCONCLUSIVE and enough is not None and counted < least:
            missing = enough - n
        reason = f"within {most}{claim}"
    if u_mm is not None and accept is not None:
        level = min(measured, accept)
        beyond = int((worst > level).sum())
        if not (looks.again and beyond):
            rate_shown = shown_rate(beyond, counted, sure, leak(level, limit_mm, u_mm))
            within = f"{n - beyond} of {plural(n, 'pose')} within {level:.2f} mm"
            reason += f"; {within} show {percent_apart(rate_shown, rate)}"
    band = refuse - limit_mm if accept is None or verdict is Verdict.NOT_MET else limit_mm - accept
    without = f" Only found teats count here; {missed} {'was' if missed == 1 else 'were'} missed."
    return replace(
        nothing,
        n=n,
        measured=measured,
        margin=limit_mm - measured,
        uncertainty=band,
        verdict=verdict,
        sentence=f"The largest distance over {plural(n, 'pose')} is {measured:.2f} mm,"
        f" {reason}.{without if missed else ''}",
        missing=missing,
    )


def _guard_band(limit_mm: float, u_mm: float | None, accepted: str, refuse_mm: float) -> str:
    """The rule's first half: what is accepted and refused, by the truth's uncertainty."""
    stated = "u not stated" if u_mm is None else f"u = {u_mm:.3g} mm"
    return (
        f"largest distance of the found teats: accepted up to {accepted}, refused from"
        f" {refuse_mm:.3f} mm (T = {limit_mm:g} mm, {stated}, 5 % false acceptance)"
    )


def _nothing_accepted(limit_mm: float, u_mm: float | None) -> str:
    if u_mm is None:
        return (
            f"but the truth states no uncertainty, so no error is accepted under {limit_mm:g} mm;"
            " state it (0 for an exact truth)"
        )
    return f"but the truth is too uncertain to accept any error under {limit_mm:g} mm"


def _more(more: int | None, would: str, share: str) -> str:
    """How many more poses a further look needs; each look before it raises that number."""
    if more is None:
        return f"no further look can show {share}, since earlier ones took all that there was"
    return (
        f"{plural(more, 'more pose')} without a further failure {would} {share}, as a further look"
    )


def _claim(n: int, least: int, enough: int | None, share: str, counted: int) -> tuple[Verdict, str]:
    """Whether `n` poses within the acceptance limit are `enough`, of which a look at `counted` has
    decided; far from the limit `least` would be.
    """
    if enough is None:
        return Verdict.INCONCLUSIVE, (
            ", but so near to it the truth is too uncertain for the claim, however many poses are"
            " run"
        )
    if counted >= enough:
        return Verdict.MET, f"; shown for {share} of poses"
    if counted >= least:
        return Verdict.INCONCLUSIVE, (
            f", but so near to it a claim for {share} of poses needs {enough} poses in one look,"
            f" and one at {counted} was taken: begin anew with {enough} that no look has seen"
            f" ({least} do where the largest lies further from it)"
        )
    far = f" ({least} do where the largest lies further from it)" if enough > least else ""
    return Verdict.INCONCLUSIVE, f", but a claim for {share} of poses needs {enough - n} more{far}"


def worst_per_pose(values: Floats, poses: Sequence[Hashable] | None) -> Floats:
    """The largest value of each pose (p,), in order of appearance; None: each value is a pose."""
    if poses is None:
        return values
    codes = numbered(poses, len(values))
    worst = np.full(int(codes.max(initial=-1)) + 1, -np.inf)
    np.maximum.at(worst, codes, values)
    return worst
