"""Is the error below its limit, in a share of all poses? The guard-banded decision on the largest error, or on a quantile of it.

Accepted below the guard band, refused above it, undecided between (`limits`); and inconclusive where too few poses were run. How many are
enough depends on how near the largest error lies to the limit, since the confidence is shared between chance in the draw of poses and
chance in the truth, which in one run is much the same at all poses (`rates.guarded_n`): 59 for 95/95 far from the limit, 91 at the edge
of the guard band. Knows no script.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Literal

import numpy as np
import numpy.typing as npt

from bench.scoring.decisions import Decision, Verdict, poses_told
from bench.scoring.limits import Along, acceptance_limit_mm, leak, refusal_limit_mm
from bench.scoring.points import Floats, as_values
from bench.scoring.rates import exact_percent, guarded_n, zero_failure_n
from bench.scoring.tolerance import quantile_bounds


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
    """Is the error below `limit_mm` in a share `rate` of poses? `errors_mm` (n,) are distances, or errors along one axis; u_mm that of
    the truth per axis, None where nobody stated it: then nothing is accepted.

    `poses` names the pose of each error (none given: each is a pose of its own); a pose counts once, with its worst error. "max": the
    largest error is decided. "quantile": the exact one-sided bounds of the quantile `rate`. `missed` teats have no error; they are told.
    """
    worst = worst_per_pose(np.abs(as_values(errors_mm, "errors")), poses)
    u = u_mm or 0.0
    accept = None if u_mm is None else acceptance_limit_mm(limit_mm, u, along)
    refuse = refusal_limit_mm(limit_mm, u)
    quantity = "distance" if along == "radial" else "error along an axis"
    what = f"largest {quantity}" if statistic == "max" else f"{exact_percent(rate)} quantile of the {quantity}"
    rule = _rule(what, accept, refuse, limit_mm, u_mm, rate, confidence)
    if not len(worst):
        nothing = "No teat was found, so no error was measured."
        return Decision(name, rule, 0, None, "mm", limit_mm, None, None, Verdict.NOT_MEASURED, nothing, accept)
    largest = float(worst.max())
    lower, upper = (largest, largest) if statistic == "max" else quantile_bounds(worst, rate, confidence)
    if lower is not None and lower >= refuse:
        measured, verdict, reason = lower, Verdict.NOT_MET, f"at or beyond the refusal limit of {refuse:.3f} mm"
    elif u_mm is None:
        measured, verdict = largest if upper is None else upper, Verdict.INCONCLUSIVE
        reason = f"but the truth states no uncertainty, so no error is accepted under {limit_mm:g} mm; state it (0 for an exact truth)"
    else:
        measured = largest if upper is None else upper
        risk = leak(measured, limit_mm, u, along)
        enough = guarded_n(int((worst > measured).sum()), rate, confidence, risk)
        verdict, reason = _accepted(measured, accept, limit_mm, len(worst), zero_failure_n(rate, confidence), enough, exact_percent(rate))
    without = f" Of the found teats only: {missed} {'was' if missed == 1 else 'were'} missed." if missed else ""
    sentence = f"The {what} over {poses_told(len(worst))} is {measured:.2f} mm, {reason}.{without}"
    band = refuse - limit_mm if accept is None or verdict is Verdict.NOT_MET else limit_mm - accept
    return Decision(name, rule, len(worst), measured, "mm", limit_mm, limit_mm - measured, band, verdict, sentence, accept)


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


def _rule(what: str, accept: float | None, refuse: float, limit_mm: float, u_mm: float | None, rate: float, confidence: float) -> str:
    accepted = "nothing" if accept is None else f"{accept:.3f} mm"
    stated = "u not stated" if u_mm is None else f"u = {u_mm:.3g} mm"
    return (
        f"{what} of the found teats: accepted up to {accepted}, refused from {refuse:.3f} mm (T = {limit_mm:g} mm, {stated}, "
        f"5 % false acceptance); at least {zero_failure_n(rate, confidence)} poses show it for {exact_percent(rate)} of poses with "
        f"{exact_percent(confidence)} confidence{', more near the acceptance limit' if u_mm else ''}"
    )


def _accepted(
    measured: float, accept: float | None, limit_mm: float, n: int, least: int, enough: int | None, share: str
) -> tuple[Verdict, str]:
    if accept is None:
        return Verdict.INCONCLUSIVE, f"but the truth is too uncertain to accept any error under {limit_mm:g} mm"
    if measured > accept:
        return Verdict.INCONCLUSIVE, f"above the acceptance limit of {accept:.3f} mm and not shown to be beyond {limit_mm:g} mm"
    within = f"within the acceptance limit of {accept:.3f} mm"
    if enough is None:
        return Verdict.INCONCLUSIVE, f"{within}, but so near to it the truth is too uncertain for the claim, however many poses are run"
    if n < enough:
        near = "" if enough <= max(n, least) else f" ({least} do where the largest lies further from it)"
        return Verdict.INCONCLUSIVE, f"{within}, but a claim for {share} of poses needs {enough - n} more{near}"
    return Verdict.MET, f"{within}; shown for {share} of poses"
