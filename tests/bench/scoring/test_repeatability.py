"""Repeated poses (ISO 9283, ISO 5725), the uncertainty budget and gage R&R, against worked numbers
and statsmodels.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.scoring.precision import (
    distance_accuracy,
    drift_mm,
    gage_study,
    pose_accuracy,
    precision,
)
from bench.truth.uncertainty import Component, TruthUncertainty

# four repeats, each 1 mm from their mean (10, 0, 0)
LINE = [[9.0, 0, 0], [11.0, 0, 0], [10.0, 1, 0], [10.0, -1, 0]]


def test_pose_accuracy_and_repeatability() -> None:
    ap, rp = pose_accuracy(np.subtract(LINE, [10.0, 3.0, 4.0]))
    assert ap == pytest.approx([0.0, -3.0, -4.0])
    assert rp == pytest.approx(1.0)  # mean l = 1, no spread of l
    # l = 1, 1, 2: mean 4/3, sd sqrt(1/3)
    ap, rp = pose_accuracy(np.array([[-1.0, 0, 0], [-1, 0, 0], [2, 0, 0]]))
    assert ap == pytest.approx([0.0, 0.0, 0.0])
    assert rp == pytest.approx(4 / 3 + 3 * sqrt(1 / 3))


def test_distance_accuracy() -> None:
    assert distance_accuracy(np.array([-3.0, -2.0, -1.0])) == pytest.approx((2.0, 3.0))


def test_drift_is_the_largest_change_of_accuracy() -> None:
    # the last block is not full
    points = np.array(
        [[0, 0, 0], [0, 0, 0], [1, 0, 0], [1, 0, 0], [0.5, 0, 0], [0.5, 0, 0], [9, 9, 9]]
    )
    assert drift_mm(points, repeats=2) == pytest.approx(1.0)
    assert drift_mm(points[:3], repeats=2) is None


def test_precision_of_a_worked_example() -> None:
    # within: variances 1, 1, 1. means 11, 12, 16: MS between = 3 * 7 = 21; s_L^2 = (21 - 1) / 3
    p = precision([[10, 11, 12], [11, 12, 13], [15, 16, 17]])
    assert p.s_r == pytest.approx(1.0)
    assert p.s_between == pytest.approx(sqrt(20 / 3))
    assert p.s_R == pytest.approx(sqrt(1 + 20 / 3))


def test_precision_says_only_what_the_groups_tell() -> None:
    assert precision([]).s_r is None
    assert precision([[1.0], [2.0]]).s_r is None
    one = precision([[1.0, 3.0], []])
    assert (one.groups, one.s_R) == (1, None)
    assert one.s_r == pytest.approx(sqrt(2))
    # less between than within: none, not a negative variance
    assert precision([[0.0, 2.0], [0.0, 2.0]]).s_between == 0.0


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


# AIAG, Measurement Systems Analysis, 4th edition, table III-B 6a: 3 appraisers, 3 trials, 10 parts
AIAG = np.array(
    [
        [
            [0.29, -0.56, 1.34, 0.47, -0.80, 0.02, 0.59, -0.31, 2.26, -1.36],
            [0.41, -0.68, 1.17, 0.50, -0.92, -0.11, 0.75, -0.20, 1.99, -1.25],
            [0.64, -0.58, 1.27, 0.64, -0.84, -0.21, 0.66, -0.17, 2.01, -1.31],
        ],
        [
            [0.08, -0.47, 1.19, 0.01, -0.56, -0.20, 0.47, -0.63, 1.80, -1.68],
            [0.25, -1.22, 0.94, 1.03, -1.20, 0.22, 0.55, 0.08, 2.12, -1.62],
            [0.07, -0.68, 1.34, 0.20, -1.28, 0.06, 0.83, -0.34, 2.19, -1.50],
        ],
        [
            [0.04, -1.38, 0.88, 0.14, -1.46, -0.29, 0.02, -0.46, 1.77, -1.49],
            [-0.11, -1.13, 1.09, 0.20, -1.07, -0.67, 0.01, -0.56, 1.45, -1.77],
            [-0.15, -0.96, 0.67, 0.11, -1.45, -0.49, 0.21, -0.49, 1.87, -2.16],
        ],
    ]
).transpose(2, 0, 1)


def test_the_manuals_example() -> None:
    study = gage_study(AIAG)
    assert study.sums_of_squares == pytest.approx((88.3619, 3.1673, 0.3590, 2.7589), abs=5e-5)
    assert study.pooled
    assert study.repeatability == pytest.approx(0.199933, abs=5e-7)
    assert study.appraiser == pytest.approx(0.226838, abs=5e-7)
    assert study.gage == pytest.approx(0.302373, abs=5e-6)
    assert study.part == pytest.approx(1.042327, abs=5e-7)
    assert study.gage / np.hypot(study.gage, study.part) == pytest.approx(0.279, abs=5e-4)
    assert study.distinct_categories == 4


@pytest.mark.slow
def test_the_table_against_statsmodels() -> None:
    import pandas as pd  # type: ignore[import-untyped]
    import statsmodels.formula.api as smf  # type: ignore[import-untyped]
    from statsmodels.stats.anova import anova_lm  # type: ignore[import-untyped]

    rng = np.random.default_rng(1)
    table = (
        rng.normal(0, 1, (6, 1, 1))
        + rng.normal(0, 0.5, (1, 4, 1))
        + rng.normal(0, 0.4, (6, 4, 1))
        + rng.normal(0, 0.2, (6, 4, 3))
    )
    study = gage_study(table)
    part, appraiser, _ = np.indices(table.shape)
    frame = pd.DataFrame({"part": part.ravel(), "who": appraiser.ravel(), "value": table.ravel()})
    theirs = anova_lm(smf.ols("value ~ C(part) * C(who)", frame).fit())
    assert study.sums_of_squares == pytest.approx(tuple(theirs["sum_sq"]))
    assert study.interaction_p == pytest.approx(float(theirs["PR(>F)"].iloc[2]))
    assert not study.pooled


def test_the_share_of_the_tolerance() -> None:
    study = gage_study(AIAG)
    assert study.share_of_tolerance(10.0) == pytest.approx(6 * study.gage / 10)


def test_touches_that_never_vary_have_no_spread() -> None:
    study = gage_study(np.broadcast_to(np.arange(4.0)[:, None, None], (4, 3, 2)))
    assert (study.gage, study.interaction_p, study.distinct_categories) == (0.0, None, 1)


@pytest.mark.parametrize("shape", [(3, 2), (1, 2, 2), (3, 1, 2), (3, 2, 1)])
def test_too_small_a_study_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="at least 2 of each"):
        gage_study(np.zeros(shape))
