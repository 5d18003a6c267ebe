"""Does the error depend on something? Lines through errors against place, time, bath temperature or
tilt, with their significance.

Rows of one pose share its error, so a row is not a trial: the slope's standard error is the
jackknife over groups (poses; Efron and Stein, Annals of Statistics 9, 1981; as a cluster-robust
variance, CV3 of MacKinnon, Nielsen and Webb, Journal of Applied Econometrics 38, 2023), with
Student's t of groups - 1. What varies within poses (time, temperature) can be asked within them:
each stratum then has a level of its own, which takes its pose's own error out. Many questions
at once are adjusted after Holm.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from math import sqrt

import numpy as np
import numpy.typing as npt
from scipy.special import stdtr, stdtrit

from bench.scoring.comparison import holm
from bench.scoring.errors import Floats, as_points, as_values, numbered

RESPONSES = ("x", "y", "z", "distance")
LEAST_TREND_POSES = 5  # groups: fewer leave the spread of the slope itself unknown


@dataclass(frozen=True, slots=True)
class Trend:
    """Slope of a response (mm) per unit of a quantity, from rows in so many independent groups;
    `span` is the quantity's range.

    All None where there are too few groups, or the quantity did not vary. `p_holm` is adjusted for
    all questions asked with it.
    """

    quantity: str
    response: str
    n: int
    groups: int
    span: float
    slope: float | None = None
    low: float | None = None
    high: float | None = None
    p_value: float | None = None
    p_holm: float | None = None

    @property
    def significant(self) -> bool:
        """At 5 % for the whole family of questions."""
        p = self.p_value if self.p_holm is None else self.p_holm
        return p is not None and p < 0.05


def trends(
    quantities: Mapping[str, npt.ArrayLike],
    errors_mm: npt.ArrayLike,
    groups: Sequence[Hashable],
    *,
    within: Mapping[str, Sequence[Hashable]] | None = None,
    within_groups: Sequence[Hashable] | None = None,
    confidence: float = 0.95,
) -> tuple[Trend, ...]:
    """Every quantity (n,) against the errors' x, y, z (signed) and distance; rows where a quantity
    is not-a-number are left out for it.

    `groups` names the independent unit (pose) of each row. `within` names, for a quantity, the
    strata (teat at a pose) to ask it within; the independent unit then is that of `within_groups`
    (the frame set).
    """
    errors = as_points(errors_mm, "errors")
    responses = dict(zip(RESPONSES, (*errors.T, np.linalg.norm(errors, axis=1)), strict=True))
    found: list[Trend] = []
    for quantity, values in quantities.items():
        column = np.asarray(values, dtype=np.float64).reshape(-1)
        kept = np.isfinite(column)
        strata = (within or {}).get(quantity)
        units = groups if strata is None or within_groups is None else within_groups
        names = list(compress(units, kept))
        levels = None if strata is None else list(compress(strata, kept))
        for response, values_mm in responses.items():
            line = trend(column[kept], values_mm[kept], names, within=levels, confidence=confidence)
            found.append(replace(line, quantity=quantity, response=response))
    return adjusted(found)


def trend(
    values: npt.ArrayLike,
    response: npt.ArrayLike,
    groups: Sequence[Hashable],
    *,
    within: Sequence[Hashable] | None = None,
    confidence: float = 0.95,
) -> Trend:
    """One line: `response` (n,) against `values` (n,), rows grouped by `groups` (n,), with a level
    for each of `within` (n,) if given.
    """
    x, y = as_values(values, "values"), as_values(response, "response")
    if not len(x) == len(y) == len(groups) or (within is not None and len(within) != len(x)):
        raise ValueError(
            f"trend: {len(x)} values, {len(y)} responses, {len(groups)} groups; give one of each"
            " for every row"
        )
    group, stratum = numbered(groups), numbered(within if within is not None else [0] * len(x))
    count = int(group.max()) + 1 if len(x) else 0
    empty = Trend("", "", len(x), count, float(np.ptp(x)) if len(x) else 0.0)
    if count < LEAST_TREND_POSES:
        return empty
    sxx, sxy, less_xx, less_xy = _sums(x - x.mean(), y - y.mean(), group, stratum, count)
    if sxx <= 1e-12 * max(1.0, float(np.square(x).max())) * len(x) or np.any(
        sxx - less_xx <= 1e-9 * sxx
    ):
        return empty  # it did not vary, or only in one group
    slope, without = sxy / sxx, (sxy - less_xy) / (sxx - less_xx)
    error = sqrt((count - 1) / count * float(np.square(without - without.mean()).sum()))
    reach = float(stdtrit(count - 1, (1.0 + confidence) / 2.0)) * error
    p_value = (
        2.0 * float(stdtr(count - 1, -abs(slope) / error)) if error > 0.0 else float(slope == 0.0)
    )
    return replace(empty, slope=slope, low=slope - reach, high=slope + reach, p_value=p_value)


def adjusted(found: Sequence[Trend]) -> tuple[Trend, ...]:
    """The same with `p_holm` set, for all that were measured."""
    asked = [one.p_value for one in found if one.p_value is not None]
    values = iter(holm(asked))
    return tuple(one if one.p_value is None else replace(one, p_holm=next(values)) for one in found)


def _sums(
    x: Floats, y: Floats, group: npt.NDArray[np.intp], stratum: npt.NDArray[np.intp], count: int
) -> tuple[float, float, Floats, Floats]:
    """Sxx and Sxy about each stratum's means, and how much of them goes with each group when it is
    left out (strata's means then move).
    """
    blocks, block = (
        (np.arange(count), group)
        if not stratum.any()
        else np.unique(stratum * count + group, return_inverse=True)
    )
    block = block.ravel()

    def add(code: npt.NDArray[np.intp], size: int) -> tuple[Floats, ...]:
        return tuple(
            np.bincount(code, w, minlength=size).astype(np.float64)
            for w in (np.ones_like(x), x, y, x * x, x * y)
        )

    whole, part = add(stratum, int(stratum.max()) + 1), add(block, len(blocks))
    of = blocks // count
    before = _about_mean(*whole)
    after = _about_mean(*(w[of] - p for w, p in zip(whole, part, strict=True)))
    less = [
        np.bincount(blocks % count, b[of] - a, minlength=count).astype(np.float64)
        for b, a in zip(before, after, strict=True)
    ]
    return float(before[0].sum()), float(before[1].sum()), less[0], less[1]


def _about_mean(n: Floats, x: Floats, y: Floats, xx: Floats, xy: Floats) -> tuple[Floats, Floats]:
    some = np.maximum(n, 1.0)
    there = n > 0.5
    return np.where(there, xx - x * x / some, 0.0), np.where(there, xy - x * y / some, 0.0)
