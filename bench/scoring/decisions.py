"""From figures to verdicts: met, not met, inconclusive, not measured. The caller names the rule before the run; nothing here has a
default limit.

An error is accepted below the guard band, refused above it, and undecided between (`limits`); a rate is decided on its exact bounds
(`rates`); and a claim for which too few poses were run is inconclusive however good the figures look. Knows no script, no report: a
`Decision` is what either prints.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.special import gammaincinv

from bench.scoring.errors import percentile
from bench.scoring.limits import Along, acceptance_limit_mm, refusal_limit_mm
from bench.scoring.points import Floats, as_values
from bench.scoring.rates import Rate, percent, trials_needed, zero_failure_n
from bench.scoring.tolerance import quantile_bounds


class Verdict(StrEnum):
    """What is said of a requirement."""

    MET = "met"
    NOT_MET = "not met"
    INCONCLUSIVE = "inconclusive"
    NOT_MEASURED = "not measured"


@dataclass(frozen=True, slots=True)
class Decision:
    """One requirement decided. `measured`, `limit`, `accept`, `margin` and `uncertainty` are in `unit`.

    `margin` is positive on the good side of `limit`; `uncertainty` is one-sided at the rule's confidence (the guard band of an error, the
    distance from a rate to its bound), so a requirement is shown where the margin reaches it. `accept` is the acceptance limit of an
    error.
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
    """The worst: one not met is not met; else one inconclusive or not measured is inconclusive, and so is nothing at all; else met."""
    given = set(verdicts)
    if Verdict.NOT_MET in given:
        return Verdict.NOT_MET
    return Verdict.MET if given == {Verdict.MET} else Verdict.INCONCLUSIVE


def decide_error(
    name: str,
    errors_mm: npt.ArrayLike,
    *,
    limit_mm: float,
    u_mm: float,
    rate: float,
    confidence: float,
    poses: Sequence[Hashable] | None = None,
    statistic: Literal["max", "quantile"] = "max",
    along: Along = "radial",
) -> Decision:
    """Is the error below `limit_mm` in a share `rate` of poses? `errors_mm` (n,) are distances, or errors along one axis; u_mm that of
    the truth per axis.

    `poses` names the pose of each error (none given: each is a pose of its own); a pose counts once, with its worst error. "max": the
    largest error is decided, and `zero_failure_n` poses are needed to claim the rate. "quantile": the exact one-sided bounds of the
    quantile `rate`.
    """
    worst = worst_per_pose(np.abs(as_values(errors_mm, "errors")), poses)
    accept, refuse = acceptance_limit_mm(limit_mm, u_mm, along), refusal_limit_mm(limit_mm, u_mm)
    needed = zero_failure_n(rate, confidence)
    quantity = "distance" if along == "radial" else "error along an axis"
    what = f"largest {quantity}" if statistic == "max" else f"{_exact(rate)} quantile of the {quantity}"
    rule = (
        f"{what} of the found teats: accepted up to {_mm(accept)}, refused from {refuse:.3f} mm (T = {limit_mm:g} mm, u = {u_mm:.3g} mm, "
        f"5 % false acceptance); at least {needed} poses show it for {_exact(rate)} of poses with {_exact(confidence)} confidence"
    )
    if not len(worst):
        return Decision(
            name, rule, 0, None, "mm", limit_mm, None, None, Verdict.NOT_MEASURED, "No teat was found, so no error was measured.", accept
        )
    largest = float(worst.max())
    lower, upper = (largest, largest) if statistic == "max" else quantile_bounds(worst, rate, confidence)
    if lower is not None and lower >= refuse:
        measured, verdict, reason = lower, Verdict.NOT_MET, f"at or beyond the refusal limit of {refuse:.3f} mm"
    else:
        measured = largest if upper is None else upper
        verdict, reason = _accepted(measured, accept, limit_mm, missing=needed - len(worst), claim=f"{_exact(rate)} of poses")
    sentence = f"The {what} over {_poses(len(worst))} is {measured:.2f} mm, {reason}."
    band = refuse - limit_mm if accept is None else limit_mm - accept
    return Decision(name, rule, len(worst), measured, "mm", limit_mm, limit_mm - measured, band, verdict, sentence, accept)


def decide_rate(name: str, rate: Rate, *, required: float, confidence: float) -> Decision:
    """Is the true rate at least `required`? Met on the exact one-sided lower bound, not met on the upper one; `rate` counts poses."""
    rule = f"exact (Clopper-Pearson) one-sided bound of the rate over poses, {_exact(confidence)} confidence: at least {_exact(required)}"
    needed = trials_needed(rate.failures, required, confidence)
    low, high, value = rate.lower_bound(confidence), rate.upper_bound(confidence), rate.value
    if low is None or high is None or value is None:
        sentence = f"No pose was tried; {needed} without a failure would show {_exact(required)}."
        return Decision(name, rule, 0, None, "%", 100 * required, None, None, Verdict.NOT_MEASURED, sentence)
    if low >= required:
        verdict, reason = Verdict.MET, f"a rate of at least {percent(low)} is shown"
    elif high < required:
        verdict, reason = Verdict.NOT_MET, f"a rate of at most {percent(high)} is shown"
    else:
        more = needed - rate.trials
        verdict, reason = (
            Verdict.INCONCLUSIVE,
            f"only {percent(low)} is shown; {more} more poses without a further failure would show {_exact(required)}",
        )
    uncertainty = 100 * (high - value if verdict is Verdict.NOT_MET else value - low)
    sentence = f"{rate.successes} of {_poses(rate.trials)} succeeded ({percent(value)}): {reason}, with {_exact(confidence)} confidence."
    return Decision(name, rule, rate.trials, 100 * value, "%", 100 * required, 100 * value - 100 * required, uncertainty, verdict, sentence)


def decide_time(
    name: str,
    seconds: npt.ArrayLike,
    *,
    limit_s: float,
    statistic: Literal["p95", "max"],
    rate: float | None = None,
    confidence: float = 0.95,
) -> Decision:
    """Are the detections (n,) in time? Decided on what was timed; with a `rate`, "max" also needs the detections to claim it for that
    share."""
    values = as_values(seconds, "seconds")
    if rate is not None and statistic != "max":
        raise ValueError("decide_time: a rate is claimed on the largest time; use statistic='max' with it")
    needed = 1 if rate is None else zero_failure_n(rate, confidence)
    what = "largest time" if statistic == "max" else "95th percentile of the time"
    claim = "" if rate is None else f"; at least {needed} detections show it for {_exact(rate)} with {_exact(confidence)} confidence"
    rule = f"{what} of a detection at most {limit_s:g} s{claim}"
    if not len(values):
        return Decision(name, rule, 0, None, "s", limit_s, None, None, Verdict.NOT_MEASURED, "No detection was timed.")
    measured = float(values.max()) if statistic == "max" else percentile(values, 95)
    sentence = f"The {what} over {len(values)} detections is {measured:.3g} s, limit {limit_s:g} s"
    if measured > limit_s:
        verdict = Verdict.NOT_MET
    elif len(values) < needed:
        verdict, sentence = Verdict.INCONCLUSIVE, f"{sentence}; {needed - len(values)} more are needed for the claim"
    else:
        verdict = Verdict.MET
    return Decision(name, rule, len(values), measured, "s", limit_s, limit_s - measured, None, verdict, f"{sentence}.")


def decide_count(name: str, count: int, *, scenes: int, limit: int = 0, confidence: float = 0.95) -> Decision:
    """Are there at most `limit` (false teats, say) in the scenes run? The sentence gives the upper bound per scene (Garwood 1936,
    Poisson)."""
    if count < 0 or scenes < 0 or (count and not scenes):
        raise ValueError(f"decide_count: {count} in {scenes} scenes is impossible")
    rule = f"at most {limit} in all scenes that were run"
    if not scenes:
        return Decision(name, rule, 0, None, "", float(limit), None, None, Verdict.NOT_MEASURED, "No scene was scored.")
    bound = float(gammaincinv(count + 1, confidence)) / scenes
    sentence = f"{count} in {scenes} scenes: at most {bound:.2g} a scene in the long run, with {_exact(confidence)} confidence."
    verdict = Verdict.MET if count <= limit else Verdict.NOT_MET
    return Decision(name, rule, scenes, float(count), "", float(limit), float(limit - count), None, verdict, sentence)


def decide_condition(name: str, rule: str, *, held: int, of: int) -> Decision:
    """Did a condition of the bench (bath in band, arm verified, calibration fresh) hold every time it was looked at?"""
    rate = Rate(held, of)
    if not of:
        return Decision(name, rule, 0, None, "", 0.0, None, None, Verdict.NOT_MEASURED, "The condition was never looked at.")
    verdict = Verdict.NOT_MET if rate.failures else Verdict.MET
    sentence = f"Held {held} of {of} times."
    return Decision(name, rule, of, float(held), "", float(of), float(held - of), None, verdict, sentence)


def worst_per_pose(values: Floats, poses: Sequence[Hashable] | None) -> Floats:
    """The largest value of each pose (p,), poses in order of appearance; without poses each value is a pose of its own."""
    if poses is None:
        return values
    if len(poses) != len(values):
        raise ValueError(f"poses: {len(poses)} names for {len(values)} values; give the pose of each value")
    worst: dict[Hashable, float] = {}
    for pose, value in zip(poses, values.tolist(), strict=True):
        worst[pose] = max(worst.get(pose, value), value)
    return np.array(list(worst.values()), dtype=np.float64)


def _accepted(measured: float, accept: float | None, limit_mm: float, *, missing: int, claim: str) -> tuple[Verdict, str]:
    if accept is None:
        return Verdict.INCONCLUSIVE, f"but the truth is too uncertain to accept any error under {limit_mm:g} mm"
    if measured > accept:
        return Verdict.INCONCLUSIVE, f"above the acceptance limit of {accept:.3f} mm and not shown to be beyond {limit_mm:g} mm"
    within = f"within the acceptance limit of {accept:.3f} mm"
    if missing > 0:
        return Verdict.INCONCLUSIVE, f"{within}, but a claim for {claim} needs {missing} more"
    return Verdict.MET, f"{within}; shown for {claim}"


def _exact(fraction: float) -> str:
    return f"{100 * fraction:.6g} %"


def _mm(limit: float | None) -> str:
    return "nothing" if limit is None else f"{limit:.3f} mm"


def _poses(n: int) -> str:
    return "1 pose" if n == 1 else f"{n} poses"
