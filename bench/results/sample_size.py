"""What a number of poses can show, as a plan in values and in words."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import floor

from bench.scoring.guard_band import acceptance_limit_mm, leak
from bench.scoring.rates import (
    Rate,
    exact_percent,
    guarded_n,
    percent,
    percent_apart,
    plural,
    trials_needed,
)
from bench.scoring.sample_size import (
    detectable_loss,
    detectable_shift,
    discordant_needed,
    failures_allowed,
    poses_for_shift,
    power_of_rate,
    shown_error_mm,
)


@dataclass(frozen=True, slots=True)
class Claim:
    """A rate to be shown. ``poses_needed`` for 0, 1, 2, … failures; the rest is about the poses
    that there are, None where none were named.

    ``failures_allowed`` is None too where no number of successes in them shows the rate. Where
    limit and uncertainty of the error were named: ``at_the_edge`` poses show it up to the
    acceptance limit (None: no number does), and the poses that there are, else the fewest without a
    failure, up to ``error_shown_mm``.
    """

    rate: float
    poses_needed: tuple[int, ...]
    failures_allowed: int | None = None
    chance: float | None = None
    at_the_edge: int | None = None
    error_shown_mm: float | None = None


@dataclass(frozen=True, slots=True)
class Plan:
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


def make_plan(
    rates: Sequence[float],
    confidence: float,
    *,
    failures: int = 3,
    poses: int | None = None,
    true_rate: float | None = None,
    sd_mm: float | None = None,
    shift_mm: float | None = None,
    power: float = 0.8,
    limit_mm: float | None = None,
    u_mm: float | None = None,
) -> Plan:
    """The plan for showing ``rates``, and for comparing with the chance ``power`` at the two-sided
    level 1 - ``confidence``.

    ``limit_mm`` of the error with ``u_mm``, the truth's standard uncertainty along an axis: what
    poses near the limit need.
    """
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
    return Plan(
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


def plan_lines(plan: Plan) -> Iterator[str]:
    """The plan as lines of text."""
    sure = f"{exact_percent(plan.confidence)} confidence"
    for claim in plan.claims:
        with_failures = ", ".join(
            f"{needed} with {count}" for count, needed in enumerate(claim.poses_needed) if count
        )
        more = f" ({with_failures} failed)" if with_failures else ""
        yield (
            f"A rate of {exact_percent(claim.rate)} with {sure}: {claim.poses_needed[0]} poses"
            f" without a failure{more}."
        )
    yield (
        "Poses count, not frames: repeats of one pose are one trial. The largest error of so many"
        " poses bounds the same share of errors."
    )
    if plan.poses is not None:
        yield from _told_of_poses(plan, sure)
    if plan.limit_mm is not None and plan.u_mm is not None:
        yield from _told_of_error(plan)
    alpha = exact_percent(plan.alpha)
    yield (
        f"Two detectors on the same poses: at least {plan.discordant_needed} must be lost, and none"
        f" won, for p < {alpha} (exact McNemar)."
    )
    if plan.poses_for_shift:
        yield (
            f"A difference of {plan.shift_mm:g} mm in their mean distance, where it varies by"
            f" {plan.sd_mm:g} mm from pose to pose: {plan.poses_for_shift} poses show it with a"
            f" chance of {exact_percent(plan.power)}."
        )


def _told_of_error(plan: Plan) -> Iterator[str]:
    """How near to its limit the largest error may lie."""
    against = f"against a truth of u = {plan.u_mm:g} mm along an axis"
    truth = f"An error below {plan.limit_mm:g} mm, {against}"
    if plan.accept_mm is None:
        yield f"{truth}: no error can be accepted; the truth is too uncertain."
        return
    yield f"{truth}: accepted up to {plan.accept_mm:.3f} mm; near that limit more poses are needed:"
    for claim in plan.claims:
        poses = plan.poses or claim.poses_needed[0]
        most = claim.error_shown_mm
        shown = "don't show it"
        if most is not None:
            shown = f"show it where the largest is at most {floor(1000 * most) / 1000:.3f} mm"
        edge = "no number" if claim.at_the_edge is None else str(claim.at_the_edge)
        told = f"{plural(poses, 'pose')} {shown}; {edge} up to the acceptance limit."
        yield f"  {exact_percent(claim.rate)}: {told}"


def _told_of_poses(plan: Plan, sure: str) -> Iterator[str]:
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
