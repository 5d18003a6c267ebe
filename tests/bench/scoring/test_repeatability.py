"""Repeated poses (ISO 9283, ISO 5725) and the uncertainty budget, against worked numbers and known
populations.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.scoring.precision import distance_accuracy, drift_mm, pose_accuracy, precision
from bench.truth.uncertainty import Component, TruthUncertainty

# four repeats, each 1 mm from their mean (10, 0, 0)
LINE = [[9.0, 0, 0], [11.0, 0, 0], [10.0, 1, 0], [10.0, -1, 0]]


def test_pose_accuracy_and_repeatability() -> None:
    p = pose_accuracy(LINE, [10.0, 3.0, 4.0])
    assert p.ap_mm == pytest.approx(5.0)
    assert p.ap_xyz_mm == pytest.approx((0.0, -3.0, -4.0))
    assert p.rp_mm == pytest.approx(1.0)  # mean l = 1, no spread of l
    # l = 1, 1, 2: mean 4/3, sd sqrt(1/3)
    uneven = pose_accuracy([[0, 0, 0], [0, 0, 0], [3, 0, 0]], [1, 0, 0])
    assert uneven.ap_mm == pytest.approx(0.0)
    assert uneven.rp_mm == pytest.approx(4 / 3 + 3 * sqrt(1 / 3))


def test_one_repeat_has_no_repeatability_and_none_has_nothing() -> None:
    assert pose_accuracy([[1, 2, 3]], [1, 2, 5]).ap_mm == pytest.approx(2.0)
    assert pose_accuracy([[1, 2, 3]], [1, 2, 5]).rp_mm is None
    assert pose_accuracy([], [1, 2, 5]).ap_mm is None


def test_distance_accuracy() -> None:
    d = distance_accuracy([99.0, 100.0, 101.0], 102.0)
    assert d.ad_mm == pytest.approx(2.0)
    assert d.rd_mm == pytest.approx(3.0)
    assert distance_accuracy([], 1.0).ad_mm is None
    assert distance_accuracy([1.0], 1.0).rd_mm is None


def test_drift_is_the_largest_change_of_accuracy() -> None:
    # the last block is not full
    points = np.array(
        [[0, 0, 0], [0, 0, 0], [1, 0, 0], [1, 0, 0], [0.5, 0, 0], [0.5, 0, 0], [9, 9, 9]]
    )
    assert drift_mm(points, [0, 0, 0], repeats=2) == pytest.approx(1.0)
    assert drift_mm(points[:3], [0, 0, 0], repeats=2) is None
    with pytest.raises(ValueError, match="blocks of 0"):
        drift_mm(points, [0, 0, 0], repeats=0)


def test_precision_of_a_worked_example() -> None:
    # within: variances 1, 1, 1. means 11, 12, 16: MS between = 3 * 7 = 21; s_L^2 = (21 - 1) / 3
    p = precision([[10, 11, 12], [11, 12, 13], [15, 16, 17]])
    assert p.s_r == pytest.approx(1.0)
    assert p.s_between == pytest.approx(sqrt(20 / 3))
    assert p.s_R == pytest.approx(sqrt(1 + 20 / 3))


def test_precision_finds_the_components_that_were_put_in() -> None:
    rng = np.random.default_rng(5)
    groups = [rng.normal(rng.normal(0, 2.0), 0.5, rng.integers(2, 9)) for _ in range(2000)]
    p = precision(groups)
    assert p.s_r == pytest.approx(0.5, rel=0.03)
    assert p.s_between == pytest.approx(2.0, rel=0.05)


def test_precision_says_only_what_the_groups_tell() -> None:
    assert precision([]).s_r is None
    assert precision([[1.0], [2.0]]).s_r is None
    one = precision([[1.0, 3.0], []])
    assert (one.groups, one.s_R) == (1, None)
    assert one.s_r == pytest.approx(sqrt(2))
    # less between than within: none, not a negative variance
    assert precision([[0.0, 2.0], [0.0, 2.0]]).s_between == 0.0


def test_bad_points_are_refused() -> None:
    with pytest.raises(ValueError, match="commanded: expected one point"):
        pose_accuracy(LINE, [[1, 2, 3]])


@given(st.lists(st.floats(0, 5), min_size=1, max_size=6))
def test_no_component_is_larger_than_the_whole(values: list[float]) -> None:
    budget = TruthUncertainty(tuple(Component(f"c{k}", u, "test") for k, u in enumerate(values)))
    assert budget.u_mm == pytest.approx(sqrt(sum(u * u for u in values)))
    assert max(values) <= budget.u_mm + 1e-12 <= sum(values) + 1e-9
    assert budget.as_dict()["u_mm"] == budget.u_mm


def test_a_budget_has_to_make_sense() -> None:
    with pytest.raises(ValueError, match="arm given twice"):
        TruthUncertainty((Component("arm", 1, "a"), Component("arm", 1, "b")))
    with pytest.raises(ValueError, match="no component"):
        TruthUncertainty(())
    with pytest.raises(ValueError, match="'arm': nan"):
        Component("arm", float("nan"), "a")
