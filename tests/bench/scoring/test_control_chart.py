"""Rules of a control chart by a table, and what chance alone makes of them."""

from __future__ import annotations

import numpy as np
import pytest

from bench.scoring.control_chart import BASE, D2, ControlLimits, broken, limits_of, trend

ONE, TWO, FOUR, EIGHT = "beyond 3", "2 of the last 3", "4 of the last 5", "8 of the last 8"


@pytest.mark.parametrize(
    ("off", "rule"),
    [
        ([0.0, 3.1], ONE),
        ([0.0, -3.1], ONE),
        ([0.0, 2.9], ""),
        ([2.1, 0.0, 2.1], TWO),
        ([2.1, 0.0, -2.1], ""),
        ([2.1, 0.0, 0.0, 2.1], ""),
        ([2.1, 2.1, 0.5], ""),  # the last one itself lies inside
        ([1.1, 1.1, 0.0, 1.1, 1.1], FOUR),
        ([1.1, 1.1, 0.0, 1.1, -1.1], ""),
        ([0.3] * 8, EIGHT),
        ([0.3] * 7, ""),
        ([-0.3] * 7 + [0.0], ""),
        ([0.1] * 9, ""),  # below the resolution: on the mean
    ],
)
def test_each_rule(off: list[float], rule: str) -> None:
    found = broken(np.array(off) * 2.0 + 5.0, ControlLimits(5.0, 2.0, 0.3))
    assert found[-1].startswith(rule) if rule else found[-1] == ""
    assert len(found) == len(off)


def test_limits_are_those_of_the_first_values() -> None:
    first = [1.0, 2.0] * (BASE // 2)
    assert limits_of(first[:-1], 0.01) is None
    assert limits_of([*first, 99.0], 0.01) == ControlLimits(1.5, 1.0 / D2, 0.01)
    assert limits_of([1.0] * BASE, 0.01) == ControlLimits(1.0, 0.01, 0.01)


@pytest.mark.slow
def test_chance_alone_seldom_warns() -> None:
    rng, days = np.random.default_rng(1), np.arange(40.0).tolist()
    last = trends = 0
    for values in rng.standard_normal((600, 40)):
        limits = limits_of(values, 1e-6)
        assert limits
        last += bool(broken(values, limits)[-1])
        trends += trend(days, values) is not None
    assert 0.015 < last / 600 < 0.05  # once in 92 runs with exact limits, in 25 with 20 runs'
    assert trends / 600 < 0.01


def test_a_trend_has_its_slope_and_interval() -> None:
    rng, days = np.random.default_rng(2), np.arange(0.0, 60.0, 2.0)
    values = np.where(days < 29.0, 0.0, (days - 29.0) * 0.1 / 7.0) + rng.normal(
        0.0, 0.02, len(days)
    )
    found = trend(days.tolist(), values)
    assert found
    assert found.low < 0.1 < found.high
    assert found.a_week == pytest.approx(0.1, abs=0.02)
    assert found.days == pytest.approx(30.0)
    assert trend(days[-4:].tolist(), values[-4:]) is None
    assert trend((days / 10.0).tolist(), values) is None  # within three days
