"""From figures to verdicts: met, not met, inconclusive, not measured. The caller names the rule
before the run; nothing here has a default limit.

A rate is decided on its exact bounds (`rates`), an error on its guard band (`guard_band`): accepted
below it, refused above it, undecided between. A claim for which too few poses were run is
inconclusive however good the figures look; what bounds anything counts poses. For an error, how
many are enough depends on how near the largest one lies to the limit, since the confidence is
shared between chance in the draw of poses and chance in the truth, which in one run is much the
same at all poses (`rates.guarded_n`): 59 for 95/95 far from the limit, 91 at the edge of the guard
band.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.special import gammaincinv

from bench.scoring.errors import Floats, as_values, numbered, percentile, quantile_bounds
from bench.scoring.guard_band import acceptance_limit_mm, leak, refusal_limit_mm
from bench.scoring.rates import (
    Rate,
    exact_percent,
    guarded_n,
    percent,
    percent_apart,
    plural,
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Decision:
    """One requirement decided; by default it is not measured. `measured`, `limit`, `accept`,
    `margin` and `uncertainty` are in `unit`.

    `margin` is positive on the good side of `limit`; `uncertainty` is one-sided at the rule's
    confidence (the guard band of an error, the distance from a rate to its bound), so what is shown
    has a margin of at least it. `accept` is the acceptance limit of an error.
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
    least = trials_needed(sure.failures, required, confidence)
    share, surely = exact_percent(required), exact_percent(confidence)
    rule = (
        f"exact (Clopper-Pearson) one-sided bound of the rate over poses, {surely} confidence: at"
        f" least {share}"
    )
    none = f"No pose was tried; {least} without a failure would show {share}."
    nothing = Decision(name=name, rule=rule, unit="%", limit=100 * required, sentence=none)
    low, high, value = sure.lower_bound(confidence), open_to.upper_bound(confidence), rate.value
    if low is None or high is None or value is None:
        return nothing
    verdict, reason = Verdict.MET, f"a rate of at least {percent_apart(low, required)} is shown"
    if high < required:
        verdict = Verdict.NOT_MET
        reason = f"a rate of at most {percent_apart(high, required)} is shown"
    elif low < required:
        verdict = Verdict.INCONCLUSIVE
        more = plural(least - rate.trials, "more pose")
        reason = (
            f"only {percent_apart(low, required)} is shown; {more} without a further failure would"
            f" show {share}"
        )
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
        f"{within}): {reason}, with {surely} confidence.",
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
    rule = f"{what} of a detection at most {limit_s:g} s"
    if rate is not None:
        rule += (
            f"; at least {zero_failure_n(rate, confidence)} poses in time show it for"
            f" {exact_percent(rate)}, {exact_percent(confidence)} confidence"
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
    low = in_time.lower_bound(confidence) or 0.0
    sentence = (
        f"The {what} over {plural(len(values), 'detection')} is {measured:.3g} s, limit {limit_s:g}"
        f" s; {in_time.successes} of {plural(in_time.trials, 'pose')} in time, which shows"
        f" {percent_apart(low, rate or 0.95)}"
    )
    verdict = Verdict.MET if measured <= limit_s else Verdict.NOT_MET
    if verdict is Verdict.MET and rate is not None and low < rate:
        verdict = Verdict.INCONCLUSIVE
        missing = trials_needed(in_time.failures, rate, confidence) - in_time.trials
        sentence += f"; the claim for {exact_percent(rate)} needs {plural(missing, 'more pose')}"
    return replace(
        nothing,
        n=in_time.trials,
        measured=measured,
        margin=limit_s - measured,
        verdict=verdict,
        sentence=f"{sentence}.",
    )


def decide_count(
    name: str,
    count: int,
    *,
    scenes: int,
    confidence: float = 0.95,
    per_pose: Sequence[int] | None = None,
) -> Decision:
    """Is there none (false teats, say) in the scenes run? The sentence gives the upper
    bound per scene (Garwood 1936, Poisson).

    `per_pose` is the count of each pose's worst scene: the bound counts poses, since repeats of one
    pose aren't independent. None given: each scene is a pose of its own.
    """
    if count < 0 or scenes < 0 or (count and not scenes):
        raise ValueError(f"decide_count: {count} in {scenes} scenes is impossible")
    rule = "at most 0 in all scenes that were run"
    nothing = Decision(name=name, rule=rule, limit=0.0, sentence="No scene was scored.")
    if not scenes:
        return nothing
    worst, poses = (count, scenes) if per_pose is None else (sum(per_pose), len(per_pose))
    bound = float(gammaincinv(worst + 1, confidence)) / poses
    where = plural(scenes, "scene") + (f" of {plural(poses, 'pose')}" if poses != scenes else "")
    return replace(
        nothing,
        n=poses,
        measured=float(count),
        margin=float(-count),
        verdict=Verdict.NOT_MET if count else Verdict.MET,
        sentence=f"{count} in {where}: at most {bound:.2g} a scene in the long run, with"
        f" {exact_percent(confidence)} confidence.",
    )


def decide_condition(name: str, rule: str, *, held: int, of: int) -> Decision:
    """Did a condition of the bench (bath in band, arm verified, calibration fresh) hold every time
    it was looked at?
    """
    nothing = Decision(
        name=name, rule=rule, limit=float(of), sentence="The condition was never looked at."
    )
    failures = Rate(held, of).failures
    if not of:
        return nothing
    return replace(
        nothing,
        n=of,
        measured=float(held),
        margin=float(-failures),
        verdict=Verdict.NOT_MET if failures else Verdict.MET,
        sentence=f"Held {held} of {of} times.",
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
    statistic: Literal["max", "quantile"] = "max",
    missed: int = 0,
) -> Decision:
    """Is the error below `limit_mm` in a share `rate` of poses? `errors_mm` (n,) are distances;
    u_mm is that of the truth per axis, None where nobody stated it: then nothing is accepted.

    `poses` names the pose of each error (none given: each is a pose of its own); a pose counts
    once, with its worst error. "max": the largest error is decided. "quantile": the exact one-sided
    bounds of the quantile `rate`. `missed` teats have no error; they are told.
    """
    worst = worst_per_pose(np.abs(as_values(errors_mm, "errors")), poses)
    accept = None if u_mm is None else acceptance_limit_mm(limit_mm, u_mm)
    refuse = refusal_limit_mm(limit_mm, u_mm or 0.0)
    least, share = zero_failure_n(rate, confidence), exact_percent(rate)
    what = "largest distance" if statistic == "max" else f"{share} quantile of the distance"
    accepted = "nothing" if accept is None else f"{accept:.3f} mm"
    stated = "u not stated" if u_mm is None else f"u = {u_mm:.3g} mm"
    rule = (
        f"{what} of the found teats: accepted up to {accepted}, refused from {refuse:.3f} mm (T ="
        f" {limit_mm:g} mm, {stated}, 5 % false acceptance); at least {least} poses show it for"
        f" {share} of poses with {exact_percent(confidence)} confidence"
        f"{', more near the acceptance limit' if u_mm else ''}"
    )
    none = "No teat was found, so no error was measured."
    nothing = Decision(
        name=name, rule=rule, unit="mm", limit=limit_mm, sentence=none, accept=accept
    )
    n = len(worst)
    if not n:
        return nothing
    lower: float | None = float(worst.max())
    upper = lower
    if statistic == "quantile":
        lower, upper = quantile_bounds(worst, rate, confidence)
    measured = float(worst.max()) if upper is None else upper
    verdict = Verdict.INCONCLUSIVE
    within = f"within the acceptance limit of {accepted}"
    if lower is not None and lower >= refuse:
        measured, verdict = lower, Verdict.NOT_MET
        reason = f"at or beyond the refusal limit of {refuse:.3f} mm"
    elif u_mm is None:
        reason = (
            f"but the truth states no uncertainty, so no error is accepted under {limit_mm:g} mm;"
            " state it (0 for an exact truth)"
        )
    elif accept is None:
        reason = f"but the truth is too uncertain to accept any error under {limit_mm:g} mm"
    elif measured > accept:
        reason = (
            f"above the acceptance limit of {accepted} and not shown to be beyond {limit_mm:g} mm"
        )
    else:
        risk = leak(measured, limit_mm, u_mm)
        enough = guarded_n(int((worst > measured).sum()), rate, confidence, risk)
        if enough is None:
            reason = (
                f"{within}, but so near to it the truth is too uncertain for the claim, however"
                " many poses are run"
            )
        elif n < enough:
            reason = f"{within}, but a claim for {share} of poses needs {enough - n} more"
            if enough > max(n, least):
                reason += f" ({least} do where the largest lies further from it)"
        else:
            verdict, reason = Verdict.MET, f"{within}; shown for {share} of poses"
    without = (
        f" Of the found teats only: {missed} {'was' if missed == 1 else 'were'} missed."
        if missed
        else ""
    )
    return replace(
        nothing,
        n=n,
        measured=measured,
        margin=limit_mm - measured,
        uncertainty=(
            refuse - limit_mm if accept is None or verdict is Verdict.NOT_MET else limit_mm - accept
        ),
        verdict=verdict,
        sentence=f"The {what} over {plural(n, 'pose')} is {measured:.2f} mm, {reason}.{without}",
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
    codes = numbered(poses)
    worst = np.full(int(codes.max(initial=-1)) + 1, -np.inf)
    np.maximum.at(worst, codes, values)
    return worst
