"""From figures to verdicts: met, not met, inconclusive, not measured. The caller names the rule
before the run; nothing here has a default limit.

A rate is decided on its exact bounds (`rates`), an error on its guard band (`error_decision`); a
claim for which too few poses were run is inconclusive however good the figures look. What bounds
anything counts poses. Knows no script, no report: a `Decision` is what either prints.

Is the error below its limit, in a share of all poses? The guard-banded decision on the largest
error, or on a quantile of it.

Accepted below the guard band, refused above it, undecided between (`limits`); and inconclusive
where too few poses were run. How many are enough depends on how near the largest error lies to the
limit, since the confidence is shared between chance in the draw of poses and chance in the truth,
which in one run is much the same at all poses (`rates.guarded_n`): 59 for 95/95 far from the limit,
91 at the edge of the guard band. Knows no script.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.special import gammaincinv

from bench.scoring.errors import Floats, as_values, percentile, quantile_bounds
from bench.scoring.guard_band import Along, acceptance_limit_mm, leak, refusal_limit_mm
from bench.scoring.rates import (
    Rate,
    exact_percent,
    guarded_n,
    percent,
    percent_apart,
    pose_successes,
    trials_needed,
    zero_failure_n,
)


class Verdict(StrEnum):
    """What is said of a requirement."""

    MET = "met"
    NOT_MET = "not met"
    INCONCLUSIVE = "inconclusive"
    NOT_MEASURED = "not measured"


@dataclass(frozen=True, slots=True)
class Decision:
    """One requirement decided. `measured`, `limit`, `accept`, `margin` and `uncertainty` are in
    `unit`.

    `margin` is positive on the good side of `limit`; `uncertainty` is one-sided at the rule's
    confidence (the guard band of an error, the distance from a rate to its bound), so what is shown
    has a margin of at least it. `accept` is the acceptance limit of an error.
    """

    name: str
    rule: str
    n: int
    measured: float | None
    unit: str
    limit: float
    margin: float | None
    uncertainty: float | None
    verdict: Verdict
    sentence: str
    accept: float | None = None

    def as_dict(self) -> dict[str, object]:
        """Plain numbers, text and None."""
        return {**asdict(self), "verdict": self.verdict.value}


def overall(verdicts: Iterable[Verdict]) -> Verdict:
    """The worst: one not met is not met; else one inconclusive or not measured is inconclusive, and
    so is nothing at all; else met.
    """
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
) -> Decision:
    """Is the true rate at least `required`? Met on the exact one-sided lower bound, not met on the
    upper one; `rate` counts poses.

    Where the truth is uncertain, `shown` are the successes that it can't turn, and the lower bound
    is theirs; `possible` are all but the failures that it can't turn, and the upper bound is theirs
    (`pool`).
    """
    sure, open_to = shown or rate, possible or rate
    least, share, surely = (
        trials_needed(sure.failures, required, confidence),
        exact_percent(required),
        exact_percent(confidence),
    )
    rule = (
        f"exact (Clopper-Pearson) one-sided bound of the rate over poses, {surely} confidence: at"
        f" least {share}"
    )
    low, high, value = sure.lower_bound(confidence), open_to.upper_bound(confidence), rate.value
    if low is None or high is None or value is None:
        sentence = f"No pose was tried; {least} without a failure would show {share}."
        return Decision(
            name, rule, 0, None, "%", 100 * required, None, None, Verdict.NOT_MEASURED, sentence
        )
    if low < required <= high:
        more = f"{_more(least - rate.trials)} without a further failure would show {share}"
        verdict, reason = (
            Verdict.INCONCLUSIVE,
            f"only {percent_apart(low, required)} is shown; {more}",
        )
    elif high < required:
        verdict, reason = (
            Verdict.NOT_MET,
            f"a rate of at most {percent_apart(high, required)} is shown",
        )
    else:
        verdict, reason = Verdict.MET, f"a rate of at least {percent_apart(low, required)} is shown"
    uncertainty = 100 * (high - value if verdict is Verdict.NOT_MET else value - low)
    counted = (
        f"{rate.successes} of {poses_told(rate.trials)} succeeded"
        f" ({percent(value)}{_doubted(rate, sure, open_to)})"
    )
    sentence = f"{counted}: {reason}, with {surely} confidence."
    return Decision(
        name,
        rule,
        rate.trials,
        100 * value,
        "%",
        100 * required,
        100 * value - 100 * required,
        uncertainty,
        verdict,
        sentence,
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
) -> Decision:
    """Are the detections (n,) in time? Decided on what was timed, and it says what share of poses
    that shows; with a `rate` it is inconclusive where less is shown than that. A p95 is claimed for
    95 %.

    `poses` names the pose of each time (none given: each is a pose of its own); a pose is in time
    when all its detections are.
    """
    values = as_values(seconds, "seconds")
    if rate is not None and statistic == "p95" and rate != 0.95:
        raise ValueError(
            f"decide_time: a p95 says it of 95 % and not of {exact_percent(rate)}; use"
            " statistic='max' to claim another rate"
        )
    what = "largest time" if statistic == "max" else "95th percentile of the time"
    needed = (
        None
        if rate is None
        else f"{zero_failure_n(rate, confidence)} poses in time show it for {exact_percent(rate)}"
    )
    claim = f"; at least {needed}, {exact_percent(confidence)} confidence" if needed else ""
    rule = f"{what} of a detection at most {limit_s:g} s{claim}"
    if not len(values):
        return Decision(
            name,
            rule,
            0,
            None,
            "s",
            limit_s,
            None,
            None,
            Verdict.NOT_MEASURED,
            "No detection was timed.",
        )
    measured = float(values.max()) if statistic == "max" else percentile(values, 95)
    in_time = pose_successes(
        range(len(values)) if poses is None else poses, (values <= limit_s).tolist()
    )
    low = in_time.lower_bound(confidence) or 0.0
    shown = (
        f"{in_time.successes} of {poses_told(in_time.trials)} in time, which shows"
        f" {percent_apart(low, rate or 0.95)}"
    )
    sentence = (
        f"The {what} over {_times(len(values), 'detection')} is {measured:.3g} s, limit {limit_s:g}"
        f" s; {shown}"
    )
    if measured > limit_s:
        verdict = Verdict.NOT_MET
    elif rate is not None and low < rate:
        missing = trials_needed(in_time.failures, rate, confidence) - in_time.trials
        verdict, sentence = (
            Verdict.INCONCLUSIVE,
            f"{sentence}; the claim for {exact_percent(rate)} needs {_more(missing)}",
        )
    else:
        verdict = Verdict.MET
    return Decision(
        name,
        rule,
        in_time.trials,
        measured,
        "s",
        limit_s,
        limit_s - measured,
        None,
        verdict,
        f"{sentence}.",
    )


def decide_count(
    name: str,
    count: int,
    *,
    scenes: int,
    limit: int = 0,
    confidence: float = 0.95,
    per_pose: Sequence[int] | None = None,
) -> Decision:
    """Are there at most `limit` (false teats, say) in the scenes run? The sentence gives the upper
    bound per scene (Garwood 1936, Poisson).

    `per_pose` is the count of each pose's worst scene: the bound counts poses, since repeats of one
    pose aren't independent. None given: each scene is a pose of its own.
    """
    if count < 0 or scenes < 0 or (count and not scenes):
        raise ValueError(f"decide_count: {count} in {scenes} scenes is impossible")
    rule = f"at most {limit} in all scenes that were run"
    if not scenes:
        return Decision(
            name,
            rule,
            0,
            None,
            "",
            float(limit),
            None,
            None,
            Verdict.NOT_MEASURED,
            "No scene was scored.",
        )
    worst, poses = (count, scenes) if per_pose is None else (sum(per_pose), len(per_pose))
    bound = float(gammaincinv(worst + 1, confidence)) / poses
    where = _times(scenes, "scene") + (f" of {poses_told(poses)}" if poses != scenes else "")
    sentence = (
        f"{count} in {where}: at most {bound:.2g} a scene in the long run, with"
        f" {exact_percent(confidence)} confidence."
    )
    verdict = Verdict.MET if count <= limit else Verdict.NOT_MET
    return Decision(
        name,
        rule,
        poses,
        float(count),
        "",
        float(limit),
        float(limit - count),
        None,
        verdict,
        sentence,
    )


def decide_condition(name: str, rule: str, *, held: int, of: int) -> Decision:
    """Did a condition of the bench (bath in band, arm verified, calibration fresh) hold every time
    it was looked at?
    """
    rate = Rate(held, of)
    if not of:
        return Decision(
            name,
            rule,
            0,
            None,
            "",
            0.0,
            None,
            None,
            Verdict.NOT_MEASURED,
            "The condition was never looked at.",
        )
    verdict = Verdict.NOT_MET if rate.failures else Verdict.MET
    sentence = f"Held {held} of {of} times."
    return Decision(
        name, rule, of, float(held), "", float(of), float(held - of), None, verdict, sentence
    )


def poses_told(n: int) -> str:
    """``1 pose``, ``59 poses``."""
    return "1 pose" if n == 1 else f"{n} poses"


def _times(n: int, thing: str) -> str:
    return f"{n} {thing}" if n == 1 else f"{n} {thing}s"


def _more(n: int) -> str:
    return f"{n} more {'pose' if n == 1 else 'poses'}"


def _doubted(rate: Rate, sure: Rate, open_to: Rate) -> str:
    """How many poses the truth's uncertainty could turn."""
    fail, pass_ = rate.successes - sure.successes, open_to.successes - rate.successes
    parts = [
        f"{fail} of them could be failures" if fail else "",
        f"{pass_} of the failures could be successes" if pass_ else "",
    ]
    told = " and ".join(part for part in parts if part)
    return f"; within the truth's uncertainty {told}" if told else ""


def decide_error(
    name: str,
    errors_mm: npt.ArrayLike,
    *,
    limit_mm: float,
    u_mm: float | None,
    rate: float,
    confidence: float,
    poses: Sequence[Hashable] | None = None,
    statistic: Literal["max", "quantile"] = "max",
    along: Along = "radial",
    missed: int = 0,
) -> Decision:
    """Is the error below `limit_mm` in a share `rate` of poses? `errors_mm` (n,) are distances, or
    errors along one axis; u_mm that of the truth per axis, None where nobody stated it: then
    nothing is accepted.

    `poses` names the pose of each error (none given: each is a pose of its own); a pose counts
    once, with its worst error. "max": the largest error is decided. "quantile": the exact one-sided
    bounds of the quantile `rate`. `missed` teats have no error; they are told.
    """
    worst = worst_per_pose(np.abs(as_values(errors_mm, "errors")), poses)
    u = u_mm or 0.0
    accept = None if u_mm is None else acceptance_limit_mm(limit_mm, u, along)
    refuse = refusal_limit_mm(limit_mm, u)
    quantity = "distance" if along == "radial" else "error along an axis"
    what = (
        f"largest {quantity}"
        if statistic == "max"
        else f"{exact_percent(rate)} quantile of the {quantity}"
    )
    rule = _rule(what, accept, refuse, limit_mm, u_mm, rate, confidence)
    if not len(worst):
        nothing = "No teat was found, so no error was measured."
        return Decision(
            name, rule, 0, None, "mm", limit_mm, None, None, Verdict.NOT_MEASURED, nothing, accept
        )
    largest = float(worst.max())
    lower, upper = (
        (largest, largest) if statistic == "max" else quantile_bounds(worst, rate, confidence)
    )
    if lower is not None and lower >= refuse:
        measured, verdict, reason = (
            lower,
            Verdict.NOT_MET,
            f"at or beyond the refusal limit of {refuse:.3f} mm",
        )
    elif u_mm is None:
        measured, verdict = largest if upper is None else upper, Verdict.INCONCLUSIVE
        reason = (
            f"but the truth states no uncertainty, so no error is accepted under {limit_mm:g} mm;"
            " state it (0 for an exact truth)"
        )
    else:
        measured = largest if upper is None else upper
        risk = leak(measured, limit_mm, u, along)
        enough = guarded_n(int((worst > measured).sum()), rate, confidence, risk)
        verdict, reason = _accepted(
            measured,
            accept,
            limit_mm,
            len(worst),
            zero_failure_n(rate, confidence),
            enough,
            exact_percent(rate),
        )
    without = (
        f" Of the found teats only: {missed} {'was' if missed == 1 else 'were'} missed."
        if missed
        else ""
    )
    sentence = f"The {what} over {poses_told(len(worst))} is {measured:.2f} mm, {reason}.{without}"
    band = refuse - limit_mm if accept is None or verdict is Verdict.NOT_MET else limit_mm - accept
    return Decision(
        name,
        rule,
        len(worst),
        measured,
        "mm",
        limit_mm,
        limit_mm - measured,
        band,
        verdict,
        sentence,
        accept,
    )


def worst_per_pose(values: Floats, poses: Sequence[Hashable] | None) -> Floats:
    """The largest value of each pose (p,), poses in order of appearance; without poses each value
    is a pose of its own.
    """
    if poses is None:
        return values
    if len(poses) != len(values):
        raise ValueError(
            f"poses: {len(poses)} names for {len(values)} values; give the pose of each value"
        )
    worst: dict[Hashable, float] = {}
    for pose, value in zip(poses, values.tolist(), strict=True):
        worst[pose] = max(worst.get(pose, value), value)
    return np.array(list(worst.values()), dtype=np.float64)


def _rule(
    what: str,
    accept: float | None,
    refuse: float,
    limit_mm: float,
    u_mm: float | None,
    rate: float,
    confidence: float,
) -> str:
    accepted = "nothing" if accept is None else f"{accept:.3f} mm"
    stated = "u not stated" if u_mm is None else f"u = {u_mm:.3g} mm"
    return (
        f"{what} of the found teats: accepted up to {accepted}, refused from {refuse:.3f} mm (T ="
        f" {limit_mm:g} mm, {stated}, 5 % false acceptance); at least"
        f" {zero_failure_n(rate, confidence)} poses show it for {exact_percent(rate)} of poses with"
        f" {exact_percent(confidence)}"
        f" confidence{', more near the acceptance limit' if u_mm else ''}"
    )


def _accepted(
    measured: float,
    accept: float | None,
    limit_mm: float,
    n: int,
    least: int,
    enough: int | None,
    share: str,
) -> tuple[Verdict, str]:
    if accept is None:
        return (
            Verdict.INCONCLUSIVE,
            f"but the truth is too uncertain to accept any error under {limit_mm:g} mm",
        )
    if measured > accept:
        return (
            Verdict.INCONCLUSIVE,
            (
                f"above the acceptance limit of {accept:.3f} mm and not shown to be beyond"
                f" {limit_mm:g} mm"
            ),
        )
    within = f"within the acceptance limit of {accept:.3f} mm"
    if enough is None:
        return (
            Verdict.INCONCLUSIVE,
            (
                f"{within}, but so near to it the truth is too uncertain for the claim, however"
                " many poses are run"
            ),
        )
    if n < enough:
        near = (
            ""
            if enough <= max(n, least)
            else f" ({least} do where the largest lies further from it)"
        )
        return (
            Verdict.INCONCLUSIVE,
            f"{within}, but a claim for {share} of poses needs {enough - n} more{near}",
        )
    return Verdict.MET, f"{within}; shown for {share} of poses"
