"""Ends of vertical lines, middles of horizontal ones, and the teat ends chosen from them (sections
4.1.5 to 4.1.7, appendices A.2.2 to A.2.4).

The original merges columns pair by pair, in place; the same steps on runs of equal columns take a
hundredth of the time. Pixels are counted from 0.

Where text and listing differ the listing stands, for it is what ran. The text's condition C (a
middle lies near two vertical ends) is in no listing and its distances are printed nowhere, so it
isn't applied; nor is the choice of "the optimal eight". What the original did wrong, and what
stands here:
- The window of 116 x 531 pixels stopped it with an error wherever it left the picture. With
  `window_outside="clip"` nothing is seen outside of the picture; "refuse" leaves it to the caller
  to stop, as the original did.
- Its way back from window to picture is one pixel off (it adds the window's first index, counted
  from 1, without taking 1 off). Kept.
- No candidate stopped it with an error: here the answer is empty.
- With a single teat found, its table kept a second row of zeros, which went on as a teat in the
  picture's corner. Not kept: the listings read a row of zeros as no row everywhere else.
- `hiddenteats = abs(k - 5)` counts what is missing of four, and is right only because k is one more
  than the teats found.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from detector.geometry import Array
from detector.thesis.parameters import ThesisParameters
from detector.thesis.thermal import Mask

Run = tuple[int, int]  # a column, and how many successive points have it


def half_up(value: float) -> int:
    """Matlab's round() for what isn't negative: halves go up."""
    return int(np.floor(value + 0.5))


def vertical_ends(mask: Mask, p: ThesisParameters) -> Array:
    """Upper ends (n, 2) px (column, row) of vertical lines in the mask, by column; the highest
    eight.

    A line is a merged column of at least 35 points; none gives (0, 2). The lost `countelement` is
    taken to count each value in rising order.
    """
    columns, rows = np.nonzero(mask.T)  # by column, then by row, as Matlab's find()
    merged = np.array(merge_columns(columns.tolist(), p.vertical_merge_px), dtype=np.int64)
    values, counts = np.unique(merged, return_counts=True)
    lines = values[counts >= p.vertical_least_points]
    if len(lines) == 0:
        return np.empty((0, 2))
    ends = np.column_stack([lines, [rows[merged == line].min() for line in lines]])
    highest = ends[np.argsort(ends[:, 1], kind="stable")][: p.vertical_most_lines]
    return highest[np.argsort(highest[:, 0], kind="stable")].astype(np.float64)


def window_centre(ends: Array) -> tuple[int, int]:
    """Rounded mean (column, row) of vertical ends (n, 2): the window's centre (A.1)."""
    x, y = ends.mean(axis=0)
    return half_up(float(x)), half_up(float(y))


def merge_columns(columns: Sequence[int], reach: int) -> list[int]:
    """Columns after each point has drawn those within `reach`, and itself, to the rounded mean.

    The listing, for each i, j: if |x_i - x_j| <= reach, both become round((x_i + x_j) / 2).
    """
    runs = [(column, len(list(same))) for column, same in groupby(columns)]
    done = 0
    while done < len(columns):
        at, offset = _locate(runs, done)
        column, count = runs[at]
        if any(0 < abs(other - column) <= reach for other, _ in runs):
            runs = _draw(runs, at, offset, reach)
            done += 1
        else:
            # nothing is in reach of this column: its other points change nothing either
            done += count - offset
    return [column for column, count in runs for _ in range(count)]


def _draw(runs: list[Run], at: int, offset: int, reach: int) -> list[Run]:
    """One turn of the outer loop, for the point `offset` points into run `at`."""
    mine = here = runs[at][0]
    before, after = list[Run](), list[Run]()
    later = [(here, runs[at][1] - offset - 1), *runs[at + 1 :]]
    for part, side in ((before, [*runs[:at], (here, offset)]), (after, later)):
        for column, many in side:
            if many and abs(column - mine) > reach and not (part and part[-1][0] == column):
                part.append((column, many))  # as `_meet` does; most are out of reach
            else:
                mine = _meet(part, mine, column, many, reach)
    for column, many in [(mine, 1), *after[:1]]:
        _append(before, column, many)
    return before + after[1:]


def _meet(result: list[Run], mine: int, column: int, many: int, reach: int) -> int:
    """Let `many` points of one column pass the one at `mine`; appends their places."""
    while many and column != mine and abs(column - mine) <= reach:
        middle = (mine + column + 1) // 2
        # once the point no longer moves, all the others follow it
        taken = many if middle == mine else 1
        _append(result, middle, taken)
        mine, many = middle, many - taken
    _append(result, column, many)
    return mine


def _append(runs: list[Run], column: int, count: int) -> None:
    if count and runs and runs[-1][0] == column:
        runs[-1] = (column, runs[-1][1] + count)
    elif count:
        runs.append((column, count))


def _locate(runs: list[Run], point: int) -> tuple[int, int]:
    for at, (_, count) in enumerate(runs):
        if point < count:
            return at, point
        point -= count
    raise IndexError(f"point {point} lies beyond the last run")


Integers = NDArray[np.int64]

_WINDOW_SLIP_PX = 1  # see above


def window_fits(shape: tuple[int, ...], centre: tuple[int, int], p: ThesisParameters) -> bool:
    """Whether the window at (column, row) lies within a picture (rows, columns)."""
    (x, y), (up, down), (before, after) = centre, p.window_rows, p.window_columns
    return up <= y < shape[0] - down and before <= x < shape[1] - after


def horizontal_middles(mask: Mask, centre: tuple[int, int], p: ThesisParameters) -> Array:
    """Middles (n, 2) px of short horizontal lines in the window at (column, row), by row."""
    top, left = max(centre[1] - p.window_rows[0], 0), max(centre[0] - p.window_columns[0], 0)
    bottom, right = (
        max(middle + after + 1, 0)
        for middle, (_, after) in ((centre[1], p.window_rows), (centre[0], p.window_columns))
    )
    rows, columns = np.nonzero(mask[top:bottom, left:right])  # by row, then column
    rows, columns = rows.astype(np.int64) + top, columns.astype(np.int64) + left
    rows = merge_rows(rows, columns, p.horizontal_merge_rows, p.horizontal_merge_columns)
    values, counts = np.unique(rows, return_counts=True)
    low, high = p.horizontal_points_between
    found = [
        (middle, int(row))
        for row in values[(counts > low) & (counts < high)]
        for middle in segment_middles(columns[rows == row], p)
    ]
    return np.array(found, dtype=np.float64).reshape(-1, 2) + _WINDOW_SLIP_PX


def merge_rows(rows: Integers, columns: Integers, row_reach: int, column_reach: int) -> Integers:
    """Rows (n,) after each point has pulled later ones nearby up to its row.

    For each i, j > i: if |y_i - y_j| <= row_reach and |x_i - x_j| <= column_reach, y_j = min(y_i,
    y_j). Points are sorted by row.
    """
    merged = rows.copy()
    for i in range(len(merged) - 1):
        y, after = merged[i], merged[i + 1 :]
        beside = np.abs(columns[i + 1 :] - columns[i]) <= column_reach
        after[(after > y) & (after <= y + row_reach) & beside] = y
    return merged


def segment_middles(columns: Integers, p: ThesisParameters) -> list[int]:
    """Middles, shifted by the published 2 px, of stretches with six of a line's points in 12 px."""
    x = np.sort(columns)
    span = p.segment_points - 1
    middles, k = [], 0
    while k + span < len(x):
        if x[k + span] - x[k] <= p.segment_widest_px:
            middles.append(half_up((int(x[k]) + int(x[k + span])) / 2) + p.segment_middle_shift_px)
        k = int(np.searchsorted(x, x[k] + p.segment_skip_px, side="right"))
    return middles


def teat_ends(middles: Array, p: ThesisParameters) -> tuple[Array, int]:
    """Teat ends (n, 2) px out of middles (m, 2), by column, and how many of four are hidden.

    Within 30 rows of the mean row, from the left, more than 30 columns apart, four at most.
    """
    if len(middles) == 0:
        return np.empty((0, 2)), p.teat_count
    row = half_up(float(middles[:, 1].mean()))
    ends: list[Array] = []
    for middle in middles[np.argsort(middles[:, 0], kind="stable")]:
        apart = not ends or abs(middle[0] - ends[-1][0]) > p.teat_least_spacing_px
        if len(ends) < p.teat_count and apart and abs(middle[1] - row) <= p.teat_row_tolerance_px:
            ends.append(middle)
    return np.array(ends, dtype=np.float64).reshape(-1, 2), p.teat_count - len(ends)
