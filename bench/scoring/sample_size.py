"""Before a run: how many poses a claim needs, and how small a difference a comparison can show; as
a plan in values and in words. A power is the chance to show what is there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import floor, sqrt

import numpy as np
import scipy

from bench.scoring.guard_band import acceptance_limit_mm, farthest_mm, leak
from bench.scoring.rates import (
    Rate,
    check_open,
    crossing,
    exact_percent,
    fewest,
    guarded_n,
    leak_allowed,
    percent,
    percent_apart,
    trials_needed,
    zero_failure_n,
)
from textfiles.bounds import FROM_0
from textfiles.text import plural

RATES = (0.95, 0.99, 0.999)
RARE = 1e-100  # a share so small is none: scipy's distributions overflow there


def failures_allowed(trials: int, rate: float, confidence: float = 0.95) -> int | None:
    """The most failures in `trials` poses that still show `rate`; None where not even 0 do."""
    if trials < zero_failure_n(rate, confidence):
        return None
    return fewest(lambda k: trials_needed(k, rate, confidence) > trials, 0) - 1


def shown_error_mm(
    trials: int,
    rate: float,
    limit_mm: float,
    u_mm: float,
    confidence: float = 0.95,
    failures: int = 0,
) -> float | None:
    """The largest distance that so many poses, all but `failures` within it, show to be below
    `limit_mm` in a share `rate`. None for too few poses, or a truth too uncertain.
    """
    most = leak_allowed(failures, trials, rate, confidence)
    return None if most is None else farthest_mm(limit_mm, u_mm, most)


def power_of_rate(trials: int, true_rate: float, rate: float, confidence: float = 0.95) -> float:
    """The chance that a detector of `true_rate` shows `rate` in so many poses."""
    allowed = failures_allowed(trials, rate, confidence)
    return 0.0 if allowed is None else float(scipy.special.bdtr(allowed, trials, 1.0 - true_rate))


def discordant_needed(alpha: float = 0.05) -> int:
    """Fewest scenes, all lost or all won, that exact McNemar calls significant: 6 for 5 %."""
    check_open("alpha", alpha)
    # 0.5^1100 is 0: no alpha is left
    return next(k for k in range(1, 1100) if 2.0 * 0.5**k < alpha)


def mcnemar_power(trials: int, lost: float, won: float, alpha: float = 0.05) -> float:
    """The chance that exact McNemar is significant where shares `lost` and `won` of the scenes are
    solved by the old or the new one only (Duffy, Biometrics 40, 1984).
    """
    from scipy.stats import binom  # a second of CPU time, which no run needs

    check_open("alpha", alpha)
    if min(lost, won) < 0.0 or lost + won > 1.0:
        raise ValueError(
            f"shares of discordant scenes: {lost} and {won} must not be negative, nor more than 1"
            " together"
        )
    if lost + won < RARE:
        return 0.0
    discordant = np.arange(trials + 1)
    chance, share = binom.pmf(discordant, trials, lost + won), lost / (lost + won)
    # the largest smaller count that is significant; -1 for none
    at = binom.ppf(alpha / 2.0, discordant, 0.5).astype(np.int64)
    critical = np.where(2.0 * scipy.special.bdtr(at, discordant, 0.5) < alpha, at, at - 1)
    tails = scipy.special.bdtr(critical, discordant, share) + scipy.special.bdtrc(
        discordant - critical - 1, discordant, share
    )
    return float(min(1.0, np.dot(chance, np.where(critical >= 0, tails, 0.0))))


def detectable_loss(trials: int, power: float = 0.8, alpha: float = 0.05) -> float | None:
    """Smallest share of scenes lost, none won, shown with `power`; None for none."""
    check_open("power", power)
    if trials < discordant_needed(alpha):
        return None
    return crossing(lambda lost: mcnemar_power(trials, lost, 0.0, alpha) - power, 0.0, 1.0)


def detectable_shift(
    poses: int, sd: float, power: float = 0.8, alpha: float = 0.05
) -> float | None:
    """The smallest mean difference, in the unit of `sd` (of the differences between poses), that so
    many poses show with `power`; None below 2 poses. Paired t, two-sided: noncentral t (Cohen,
    Statistical Power Analysis, 1988, 2.4).
    """
    check_open("power", power)
    _positive_sd(sd)
    if poses < 2:
        return None
    edge, freedom = float(scipy.special.stdtrit(poses - 1, 1.0 - alpha / 2.0)), poses - 1
    # P(|T| > edge) is the mean of a normal chance over the sample's own standard deviation
    # (Gauss-Legendre over its quantiles)
    nodes, weights = np.polynomial.legendre.leggauss(256)
    spread = edge * np.sqrt(
        scipy.special.gammaincinv(freedom / 2.0, (nodes + 1.0) / 2.0) * 2.0 / freedom
    )
    noncentrality = crossing(
        lambda d: (
            float(weights @ (scipy.special.ndtr(d - spread) + scipy.special.ndtr(-d - spread)))
            / 2.0
            - power
        ),
        0.0,
        20.0 + 10.0 * edge,
    )
    return noncentrality * sd / sqrt(poses)


def poses_for_shift(shift: float, sd: float, power: float = 0.8, alpha: float = 0.05) -> int:
    """Fewest poses that show a mean difference of `shift`: the inverse of `detectable_shift`."""
    _positive_sd(sd)
    if shift <= 0.0:
        raise ValueError(
            f"difference: {shift} must be above 0; no number of poses shows that two detectors are"
            " the same"
        )

    def shows(poses: int) -> bool:
        found = detectable_shift(poses, sd, power, alpha)
        return found is not None and found <= shift

    return fewest(shows, 1)


def _positive_sd(sd: float) -> None:
    if not 0.0 < sd < float("inf"):
        raise ValueError(f"standard deviation of the differences: {sd} must be above 0 and finite")


@dataclass(frozen=True, slots=True)
class Claim:
    """A rate to be shown: ``poses_needed`` for 0, 1, 2, … failures; the rest about the poses that
    there are and the error's limit. None where nothing shows it.
    """

    rate: float
    poses_needed: tuple[int, ...]
    failures_allowed: int | None = None
    chance: float | None = None
    at_the_edge: int | None = None
    error_shown_mm: float | None = None


@dataclass(frozen=True, slots=True)
class SampleSizePlan:
    """Claims, and what a comparison of two detectors can show. Lengths in mm, shares 0 to 1."""

    confidence: float
    claims: tuple[Claim, ...]
    power: float
    alpha: float
    discordant_needed: int
    poses: int | None = None
    true_rate: float | None = None
    rate_shown: float | None = None
    loss_shown: float | None = None
    sd_mm: float | None = None
    shift_shown_mm: float | None = None
    shift_mm: float | None = None
    poses_for_shift: int | None = None
    limit_mm: float | None = None
    u_mm: float | None = None
    accept_mm: float | None = None

    def lines(self) -> Iterator[str]:
        """The plan as lines of text."""
        sure = f"{exact_percent(self.confidence)} confidence (one-sided)"
        for claim in self.claims:
            with_failures = ", ".join(
                f"{needed} with {count}" for count, needed in enumerate(claim.poses_needed) if count
            )
            more = f" ({with_failures} failed)" if with_failures else ""
            yield (
                f"A rate of {exact_percent(claim.rate)} with {sure}: {claim.poses_needed[0]} poses"
                f" without a failure{more}."
            )
        yield (
            "Poses count, not frames: repeats of one pose are one trial. The largest error of so"
            " many poses bounds the same share of errors."
        )
        if self.poses is not None:
            yield from _text_of_poses(self, sure)
        if self.limit_mm is not None and self.u_mm is not None:
            yield from _text_of_error(self)
        alpha = exact_percent(self.alpha)
        yield (
            f"Two detectors on the same poses: at least {self.discordant_needed} must be lost, and"
            f" none won, for p < {alpha} (exact McNemar)."
        )
        if self.poses_for_shift:
            yield (
                f"A difference of {self.shift_mm:g} mm in their mean distance, where it varies by"
                f" {self.sd_mm:g} mm from pose to pose: {self.poses_for_shift} poses show it with a"
                f" chance of {exact_percent(self.power)}."
            )


def plan_poses(
    rates: Sequence[float] = RATES,
    confidence: float = 0.95,
    *,
    failures: int = 3,
    poses: int | None = None,
    true_rate: float | None = None,
    sd_mm: float | None = None,
    shift_mm: float | None = None,
    power: float = 0.8,
    limit_mm: float | None = None,
    u_mm: float | None = None,
) -> SampleSizePlan:
    """The plan for showing success ``rates`` (0 to 1) with up to so many ``failures``, and what
    ``poses`` can show; two detectors are compared with the chance ``power`` at the level 1 -
    ``confidence``, their difference ``shift_mm`` with the standard deviation ``sd_mm`` over poses.
    With ``limit_mm`` of the error and ``u_mm`` of the truth, near the limit. Raises ValueError.
    """
    for name, bounds, value in (("failures", FROM_0, failures), ("poses", FROM_0, poses)):
        if value is not None and not bounds.has(value):
            raise ValueError(f"{name} is {value!r}, not {bounds.what}")
    if shift_mm is not None and sd_mm is None:
        varies = "how much the difference varies from pose to pose"
        raise ValueError(f"`shift_mm` needs `sd_mm`: {varies} ('teatbench compare' shows it)")
    if (limit_mm is None) != (u_mm is None):
        raise ValueError("`limit_mm` and `u_mm` belong together: of the error, and of its truth")
    alpha, there = round(1.0 - confidence, 12), poses or None
    accept = None if limit_mm is None or u_mm is None else acceptance_limit_mm(limit_mm, u_mm)
    claims = []
    for rate in rates:
        needed = tuple(trials_needed(count, rate, confidence) for count in range(failures + 1))
        claim = Claim(rate, needed)
        if there is not None:
            chance = true_rate and power_of_rate(there, true_rate, rate, confidence)
            allowed = failures_allowed(there, rate, confidence)
            claim = replace(claim, failures_allowed=allowed, chance=chance)
        if accept is not None and limit_mm is not None and u_mm is not None:
            edge = guarded_n(0, rate, confidence, leak(accept, limit_mm, u_mm))
            shown = shown_error_mm(there or needed[0], rate, limit_mm, u_mm, confidence)
            claim = replace(claim, at_the_edge=edge, error_shown_mm=shown)
        claims.append(claim)
    needed_for_shift = None
    if shift_mm and sd_mm:
        needed_for_shift = poses_for_shift(shift_mm, sd_mm, power, alpha)
    return SampleSizePlan(
        confidence=confidence,
        claims=tuple(claims),
        limit_mm=limit_mm,
        u_mm=u_mm,
        accept_mm=accept,
        power=power,
        alpha=alpha,
        discordant_needed=discordant_needed(alpha),
        poses=poses,
        true_rate=true_rate,
        rate_shown=Rate(there, there).lower_bound(confidence) if there else None,
        loss_shown=detectable_loss(there, power, alpha) if there else None,
        sd_mm=sd_mm,
        shift_shown_mm=detectable_shift(there, sd_mm, power, alpha) if there and sd_mm else None,
        shift_mm=shift_mm,
        poses_for_shift=needed_for_shift,
    )


def _text_of_error(plan: SampleSizePlan) -> Iterator[str]:
    """How near to its limit the largest error may lie."""
    truth = f"An error below {plan.limit_mm:g} mm, against a truth of u = {plan.u_mm:g} mm along an"
    if plan.accept_mm is None:
        yield f"{truth} axis: no error can be accepted; the truth is too uncertain."
        return
    up_to = f"accepted up to {plan.accept_mm:.3f} mm"
    yield f"{truth} axis: {up_to}; near that limit more poses are needed:"
    for claim in plan.claims:
        poses = plural(plan.poses or claim.poses_needed[0], "pose")
        shown = "don't show it"
        if (most := claim.error_shown_mm) is not None:
            shown = f"show it where the largest is at most {floor(1000 * most) / 1000:.3f} mm"
        edge = "no number" if claim.at_the_edge is None else str(claim.at_the_edge)
        share = exact_percent(claim.rate)
        yield f"  {share}: {poses} {shown}; {edge} up to the acceptance limit."


def _text_of_poses(plan: SampleSizePlan, sure: str) -> Iterator[str]:
    if plan.rate_shown is None:
        yield "No pose shows anything."
        return
    shown = percent_apart(plan.rate_shown, *(claim.rate for claim in plan.claims))
    there = plan.poses or 0
    yield (
        f"{plural(there, 'pose')} without a failure {'shows' if there == 1 else 'show'} {shown}"
        f" with {sure}."
    )
    for claim in plan.claims:
        if claim.failures_allowed is None:
            missing = claim.poses_needed[0] - there
            are = "is" if missing == 1 else "are"
            yield f"  {exact_percent(claim.rate)}: can't be shown; {missing} more {are} needed."
            continue
        chance = ""
        if claim.chance is not None:
            truly = f"one that truly does {exact_percent(plan.true_rate or 0.0)}"
            chance = f"; {truly} shows it with {percent(claim.chance)}"
        allowed = f"up to {claim.failures_allowed} failed"
        yield f"  {exact_percent(claim.rate)}: shown with {allowed}{chance}."
    shown_loss = plan.loss_shown
    loss = "no loss at all" if shown_loss is None else f"a loss of {percent(shown_loss)} of poses"
    yield f"  Two detectors on them: {loss} shows with a chance of {exact_percent(plan.power)}."
    if plan.shift_shown_mm is not None:
        yield (
            f"  A difference of {plan.shift_shown_mm:.3g} mm in mean distance shows with that"
            f" chance (it varies by {plan.sd_mm:g} mm)."
        )
