"""Verticals, horizontals and teat ends: against the thesis's tables and its loops written out."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage

from detector.thesis.lines import (
    half_up,
    horizontal_middles,
    merge_columns,
    merge_rows,
    segment_middles,
    teat_ends,
    vertical_ends,
    window_centre,
    window_fits,
)
from detector.thesis.parameters import Domain, ThesisParameters
from detector.thesis.thermal import order_filter
from tests.detector.thesis_tables import SECTION_4_1_7, TABLE_4_1, TABLE_4_2

P = ThesisParameters()
columns_of_points = st.lists(st.integers(0, 60), max_size=60)


def test_table_4_2_gives_section_4_1_7() -> None:
    ends, hidden = teat_ends(TABLE_4_2, P)
    assert ends.tolist() == SECTION_4_1_7.tolist()
    assert hidden == 0


def test_table_4_1_gives_a_window_that_just_fits_the_picture() -> None:
    # the means are 251.25 and 127.6 in Matlab's count, so the window's first column is the
    # picture's first: 251 - 250 = 1
    assert window_centre(TABLE_4_1 - 1) == (250, 127)
    assert window_fits((480, 640), (250, 127), P)
    for centre in ((249, 127), (360, 127), (250, 64), (250, 430)):
        assert not window_fits((480, 640), centre, P)


def test_lines_drawn_from_the_tables_come_out_as_the_tables() -> None:
    """All steps between the filters and section 4.1.7."""
    verticals = np.zeros((480, 640), dtype=np.bool_)
    horizontals = np.zeros((480, 640), dtype=np.bool_)
    for x, y in (TABLE_4_1 - 1).astype(int):
        verticals[y : y + 150, x] = True
    for x, y in (TABLE_4_2 - 1).astype(int):
        horizontals[y, x - 5 : x + 5] = True
    ends = vertical_ends(verticals, P)
    assert (ends + 1).tolist() == TABLE_4_1.tolist()
    middles = horizontal_middles(horizontals, window_centre(ends), P)
    # the first six of ten points have their middle 2 left of x (halves up), the published shift
    # adds 2, the slip of the window 1
    assert middles.tolist() == sorted(TABLE_4_2.tolist(), key=lambda middle: middle[1])
    assert teat_ends(middles, P)[0].tolist() == SECTION_4_1_7.tolist()


def literal_merge_columns(x: list[int], reach: int) -> list[int]:
    x = list(x)
    for i in range(len(x)):
        for j in range(len(x)):
            if abs(x[i] - x[j]) <= reach:
                x[j] = half_up((x[i] + x[j]) / 2)
                x[i] = x[j]
    return x


@pytest.mark.slow
@given(columns_of_points, st.integers(0, 6), st.booleans())
def test_merging_columns_is_the_double_loop(columns: list[int], reach: int, in_order: bool) -> None:
    columns = sorted(columns) if in_order else columns
    assert merge_columns(columns, reach) == literal_merge_columns(columns, reach)


@pytest.mark.slow
@given(
    st.lists(st.tuples(st.integers(0, 25), st.integers(0, 60)), max_size=50),
    st.integers(0, 3),
    st.integers(0, 20),
)
def test_merging_rows(points: list[tuple[int, int]], row_reach: int, column_reach: int) -> None:
    points = sorted(points)
    rows, columns = (np.array([p[k] for p in points], dtype=np.int64) for k in (0, 1))
    y = rows.tolist()
    for i in range(len(y) - 1):
        for j in range(i + 1, len(y)):
            if abs(y[i] - y[j]) <= row_reach and abs(points[i][1] - points[j][1]) <= column_reach:
                y[j] = min(y[i], y[j])
    assert merge_rows(rows, columns, row_reach, column_reach).tolist() == y


@pytest.mark.slow
@given(st.lists(st.integers(1, 80), max_size=60))
def test_segments_are_the_listings(columns: list[int]) -> None:
    x, k, middles = sorted(columns), 1, []  # the listing's own count, from 1
    while k + 5 <= len(x):
        if x[k + 5 - 1] - x[k - 1] <= 12:
            middles.append(half_up((x[k - 1] + x[k + 5 - 1]) / 2) + 2)
        step = next((f for f, value in enumerate(x[k:], start=1) if value > x[k - 1] + 10), None)
        if step is None:
            break
        k += step
    assert segment_middles(np.array(columns, dtype=np.int64), P) == middles


def test_a_line_needs_35_points_may_lean_and_ends_at_its_highest() -> None:
    mask, rows = np.zeros((300, 200), dtype=np.bool_), np.arange(40, 240)
    mask[50:85, 20] = True  # 35 points
    mask[50:84, 60] = True  # 34
    mask[rows, 130 + rows // 40] = True
    ends = vertical_ends(mask, P)
    assert ends[0].tolist() == [20, 50]
    assert ends[1:, 1].tolist() == [40]


def test_the_highest_eight_lines_are_kept_by_column() -> None:
    mask = np.zeros((300, 400), dtype=np.bool_)
    tops = [100, 20, 60, 40, 90, 30, 70, 50, 80, 10]
    for i, top in enumerate(tops):
        mask[top : top + 60, 20 + 35 * i] = True
    ends = vertical_ends(mask, P)
    assert ends[:, 1].tolist() == [20, 60, 40, 30, 70, 50, 80, 10]
    assert (np.diff(ends[:, 0]) > 0).all()


def test_no_line_gives_no_end() -> None:
    assert vertical_ends(np.zeros((50, 60), dtype=np.bool_), P).shape == (0, 2)
    assert horizontal_middles(np.zeros((50, 60), dtype=np.bool_), (30, 25), P).shape == (0, 2)
    assert teat_ends(np.empty((0, 2)), P)[1] == 4


@pytest.mark.parametrize("length", [5, 6, 49, 50])
def test_horizontal_lines_have_6_to_49_points(length: int) -> None:
    mask = np.zeros((200, 640), dtype=np.bool_)
    mask[100, 100 : 100 + length] = True
    assert (len(horizontal_middles(mask, (300, 110), P)) > 0) == (5 < length < 50)


def test_only_the_window_counts_and_it_may_leave_the_picture() -> None:
    mask = np.zeros((480, 640), dtype=np.bool_)
    for row, first in ((34, 20), (35, 60), (150, 100), (151, 140), (100, 381)):
        mask[row, first : first + 10] = True
    rows = horizontal_middles(mask, (100, 100), P)[:, 1]
    assert rows.tolist() == [36, 151]  # rows 35 to 150 of the window, each a pixel low as published
    assert horizontal_middles(mask, (-900, -900), P).shape == (0, 2)


def test_teat_ends_are_apart_level_and_four() -> None:
    row_of = [(50, 100), (75, 100), (90, 131), (120, 100), (170, 100), (230, 100), (300, 100)]
    # mean row 104.4: 131 is within 30 of it
    ends, hidden = teat_ends(np.array(row_of, dtype=np.float64), P)
    assert ends.tolist() == [[50, 100], [90, 131], [170, 100], [230, 100]]
    assert hidden == 0
    # 95 rows from their mean: neither
    ends, hidden = teat_ends(np.array([[50.0, 10.0], [150.0, 200.0]]), P)
    assert (len(ends), hidden) == (0, 4)
    ends, hidden = teat_ends(np.array([[50.0, 10.0]]), P)
    assert (ends.tolist(), hidden) == ([[50, 10]], 3)


@pytest.mark.parametrize(
    "domain", [P.horizontal_domain, P.vertical_domain, ((1, 0, 1), (0, 0, 0), (0, 1, 0))]
)
def test_order_filter_is_scipys_rank_filter(domain: Domain) -> None:
    mask: NDArray[np.bool_] = np.random.default_rng(4).random((60, 70)) < 0.8
    how = {"footprint": np.array(domain), "mode": "constant", "cval": 0}
    expected = ndimage.rank_filter(mask.astype(np.uint8), 0, **how)
    assert np.array_equal(order_filter(mask, domain), expected.astype(np.bool_))
