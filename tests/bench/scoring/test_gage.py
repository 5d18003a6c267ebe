"""Gage R&R: the manual's own worked example, statsmodels' analysis of variance, and components that
were put in.
"""

from __future__ import annotations

import numpy as np
import pandas as pd  # type: ignore[import-untyped]
import pytest
import statsmodels.formula.api as smf  # type: ignore[import-untyped]
from statsmodels.stats.anova import anova_lm  # type: ignore[import-untyped]

from bench.scoring.precision import gage_study

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
    assert study.gage / study.total == pytest.approx(0.279, abs=5e-4)
    assert study.distinct_categories == 4


def test_the_table_against_statsmodels() -> None:
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


def test_the_components_that_were_put_in_are_found() -> None:
    rng = np.random.default_rng(2)
    shape = (60, 40, 4)
    table = (
        rng.normal(0, 5, (60, 1, 1))
        + rng.normal(0, 0.30, (1, 40, 1))
        + rng.normal(0, 0.25, (60, 40, 1))
        + rng.normal(0, 0.20, shape)
    )
    study = gage_study(table)
    assert study.repeatability == pytest.approx(0.20, rel=0.05)
    assert study.interaction == pytest.approx(0.25, rel=0.05)
    assert study.appraiser == pytest.approx(0.30, rel=0.3)
    assert study.part == pytest.approx(5.0, rel=0.25)


def test_the_share_of_the_tolerance() -> None:
    study = gage_study(AIAG)
    assert study.share_of_tolerance(10.0) == pytest.approx(6 * study.gage / 10)
    with pytest.raises(ValueError, match="not above 0"):
        study.share_of_tolerance(0.0)


def test_touches_that_never_vary_have_no_spread() -> None:
    study = gage_study(np.broadcast_to(np.arange(4.0)[:, None, None], (4, 3, 2)))
    assert (study.gage, study.interaction_p, study.distinct_categories) == (0.0, None, 1)


@pytest.mark.parametrize("shape", [(3, 2), (1, 2, 2), (3, 1, 2), (3, 2, 1)])
def test_too_small_a_study_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="at least 2 of each"):
        gage_study(np.zeros(shape))
