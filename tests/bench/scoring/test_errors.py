"""Error summaries: the thesis's tables 5.1 to 5.3, and the identities that must hold for any
errors.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from bench.scoring.errors import (
    AxisSummary,
    Floats,
    RadialSummary,
    percentile,
    summarise,
    summarise_radial,
)
from bench.scoring.matching import gate_mm, match

TABLE_5_1 = [
    [-110.2, 284.2, 134.2],
    [-161.9, 192.6, 137.6],
    [-224.9, 199.4, 136.7],
    [-260.6, 267.1, 136.3],
]
TABLE_5_2 = [
    [-109.8, 285.7, 135.5],
    [-161.3, 191.7, 137.8],
    [-224.2, 197.4, 137.4],
    [-260.5, 269.9, 137.4],
]
TABLE_5_3 = [
    [-105.1, 290.8, 134.9],
    [-152.8, 201.8, 137.6],
    [-215.9, 206.9, 136.9],
    [-255.2, 275.2, 136.3],
]
ERRORS = st.integers(1, 30).flatmap(
    lambda n: hnp.arrays(np.float64, (n, 3), elements=st.floats(-50, 50))
)


def errors(found: list[list[float]]) -> Floats:
    """Through the matching, as a run would."""
    m = match(found, TABLE_5_1, [True] * 4, gate_mm(TABLE_5_1))
    assert m.pairs == ((0, 0), (1, 1), (2, 2), (3, 3))
    return np.array([np.subtract(found[i], TABLE_5_1[j]) for i, j in m.pairs])


def test_table_5_2_by_hand_picked_points() -> None:
    s = summarise(errors(TABLE_5_2))
    # what the thesis prints as its average error
    assert s.components.bias_mm == pytest.approx(0.54, abs=0.005)
    assert s.components.mean_abs_mm == pytest.approx(1.03, abs=0.0051)
    assert s.components.max_abs_mm == pytest.approx(2.8)
    assert s.radial.mean_mm == pytest.approx(2.09, abs=0.005)
    assert s.radial.max_mm == pytest.approx(3.01, abs=0.005)


def test_table_5_3_by_displaced_points() -> None:
    s = summarise(errors(TABLE_5_3))
    assert s.components.mean_abs_mm == pytest.approx(5.08, abs=0.0051)
    assert s.components.max_abs_mm == pytest.approx(9.2)
    assert s.radial.mean_mm == pytest.approx(10.69, abs=0.005)
    assert s.radial.max_mm == pytest.approx(12.94, abs=0.005)


@given(ERRORS)
def test_rms_squared_is_bias_squared_and_sd_squared(values: Floats) -> None:
    s = summarise(values)
    for axis in (s.x, s.y, s.z, s.components):
        assert axis.rms_mm is not None
        assert axis.bias_mm is not None
        assert axis.sd_mm is not None
        assert axis.rms_mm**2 == pytest.approx(axis.bias_mm**2 + axis.sd_mm**2, abs=1e-9)


@pytest.mark.slow
@given(ERRORS)
def test_camera_axes_keep_distances_and_turn_biases(values: Floats) -> None:
    # camera x is world y, camera z is world x
    camera_from_world = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    world, camera = summarise(values), summarise(values, camera_from_world)
    assert (camera.x, camera.y, camera.z) == (world.y, world.z, world.x)
    assert camera.radial.max_mm == pytest.approx(world.radial.max_mm)


def test_nothing_measured_is_none_and_not_zero() -> None:
    s = summarise([])
    assert s.x == s.components == AxisSummary(0)
    assert s.radial == RadialSummary(0)


@pytest.mark.slow
@given(st.lists(st.floats(0, 1e3), min_size=1, max_size=150), st.sampled_from([50, 95, 99]))
def test_a_percentile_is_the_smallest_value_with_that_share_at_or_below(
    values: list[float], percent: int
) -> None:
    p = percentile(values, percent)
    at_or_below, below = sum(v <= p for v in values), sum(v < p for v in values)
    assert p in values
    assert 100 * at_or_below >= percent * len(values) > 100 * below


def test_the_radial_figures_of_a_known_list() -> None:
    s = summarise_radial(np.arange(1.0, 101.0))
    assert (s.n, s.mean_mm, s.median_mm) == (100, 50.5, 50.5)
    assert (s.p95_mm, s.p99_mm, s.max_mm) == (95.0, 99.0, 100.0)


def test_bad_values_are_refused() -> None:
    with pytest.raises(ValueError, match="negative"):
        summarise_radial([1.0, -0.1])
    with pytest.raises(ValueError, match="no values"):
        percentile([], 95)
    with pytest.raises(ValueError, match="expected a list of numbers"):
        percentile([[1.0, 2.0]], 95)
